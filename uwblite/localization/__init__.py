"""Localisation of a robot in an existing map while it drives: from an unknown start, with its uncertainty."""

from .localizer import Localizer
from .pose_estimator import LocalizerState
from .sensing import Scanner

__all__ = ["Localizer", "LocalizerState", "Scanner"]
