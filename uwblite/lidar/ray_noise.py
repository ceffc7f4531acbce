"""Noise of single rays."""

import numpy as np

from ..arrays import Floats

_NEAR, _SHARE = 0.01, 0.01
"""Standard deviation of a range by data sheets: 10 mm up to 1 m, and 1 % beyond (URG-04LX; other scanners are better)."""


def range_sigma(reach: Floats) -> Floats:
    """Return the standard deviation, m, of ranges (n,), m."""
    return np.maximum(_NEAR, _SHARE * reach)
