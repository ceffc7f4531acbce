"""Names for arrays of one element type (shapes stand where an array is used), and robust spreads of their values."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

MAD_TO_SIGMA = 1.4826
"""Standard deviation / median absolute deviation of normal errors: the inverse of their 0.75 quantile."""
_SIGMA_OF_MEDIAN = 1.2533
"""Standard deviation of a median of normal values / that of their mean: sqrt(pi / 2)."""


def spread(errors: Floats) -> float:
    """Return the robust standard deviation of errors (m,) about zero, by their median size; half may be outliers."""
    return MAD_TO_SIGMA * float(np.median(np.abs(errors)))


def spread_about_median(values: Floats) -> float:
    """Return the robust standard deviation of values (m,) about their median."""
    return spread(values - np.median(values))


def sigma_of_median(values: Floats) -> float:
    """Return the standard deviation of the median of values (m,)."""
    return _SIGMA_OF_MEDIAN * spread_about_median(values) / float(np.sqrt(len(values)))
