"""Evidence for a calibration value that parts of a recording show apart: is it, and is it the same in all?

Three explanations compete: the value is 0, it is a constant, it changes from part to part without a common mean. A value whose
estimates scatter more than their standard deviations say is no constant to that extent: the scatter is an error that all
explanations have alike, so that it takes evidence from a constant and does not pass for precision.
"""

import numpy as np

from ..arrays import Floats

_SCATTERS = 60
"""Scatters tried between a hundredth of the least standard deviation and ten times the prior's, evenly in their logarithm."""


def log_odds_of_constant(values: Floats, sigmas: Floats, prior: float) -> float:
    """Return the logarithm of the odds of a constant against 0, by the parts or by the two halves, whichever shows it less.

    A value that changes once is alike in neighbouring parts, and scatters only between the halves.

    Parameters
    ----------
    values, sigmas : (p,) estimates of the parts in the order of time, without a prior, and their standard deviations; inf =
        shows nothing. prior : standard deviation of a constant.
    """
    second = 2 * np.arange(len(values)) >= len(values)
    total = np.bincount(second, sigmas**-2.0, 2)
    means = np.bincount(second, values * sigmas**-2.0, 2) / np.maximum(total, _NOTHING)
    with np.errstate(divide="ignore"):
        of_halves = np.asarray(total**-0.5, dtype=np.float64)
    return min(_log_odds(values, sigmas, prior), _log_odds(means, of_halves, prior))


def _log_odds(values: Floats, sigmas: Floats, prior: float) -> float:
    """Return the logarithm of the odds of a constant with the prior N(0, prior^2) against 0.

    Each part's estimate is N(v, s^2 + t^2) with the common value v; the scatter t has a uniform prior of its logarithm, and is
    integrated out on either side.
    """
    low = 0.01 * float(min(sigmas.min(initial=np.inf), prior))
    scatter = np.append(0.0, np.geomspace(low, 10.0 * prior, _SCATTERS))[:, None]
    precision = 1.0 / (sigmas**2 + scatter**2)
    total, pulled = precision.sum(axis=1), precision @ values
    without = 0.5 * np.sum(np.log(np.maximum(precision, _NOTHING)), axis=1) - 0.5 * np.sum(precision * values**2, axis=1)
    gain = 0.5 * pulled**2 / (total + prior**-2.0) - 0.5 * np.log1p(total * prior**2)
    return float(np.logaddexp.reduce(without + gain) - np.logaddexp.reduce(without))


_NOTHING = 1e-300
"""Precision of a part that shows nothing; it is the same on either side."""


def without_prior(values: Floats, sigmas: Floats, prior: float) -> tuple[Floats, Floats]:
    """Return estimates (p,) and standard deviations (p,) without the part of the prior N(0, prior^2) in them."""
    precision = np.maximum(sigmas**-2.0 - prior**-2.0, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(precision > 0.0, values * sigmas**-2.0 / precision, 0.0), precision**-0.5
