"""Where a robot is in a map that is there already, while it drives: from an unknown start, and how sure that is."""

from .localizer import Localizer
from .records import LocalizerState, Scanner

__all__ = ["Localizer", "LocalizerState", "Scanner"]
