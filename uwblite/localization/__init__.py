"""Localisation of a robot in an existing map while it drives: from an unknown start, with its uncertainty."""

from .localizer import Localizer
from .records import LocalizerState, Scanner

__all__ = ["Localizer", "LocalizerState", "Scanner"]
