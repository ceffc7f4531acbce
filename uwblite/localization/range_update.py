"""Robust update of every hypothesis by one range, with its errors by anchor (slow), by place in the map and by direction."""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from .. import se2
from ..arrays import Floats
from ..radio.range_errors import RangeErrors, pattern_waves
from .hypotheses import FIRST_ANCHOR, PATTERN, Hypotheses, symmetric

_TAIL, _DETOUR, WILD, _WIDTH = 0.4, 0.4, 0.05, 60.0
"""Share of ranges with a detour and its mean, m; share of gross errors and their width, m: the mixture of radio.nlos_mixture.
The map's own ranges have a tail of 0.15 and 0.25 m where its robot drove, those of another robot on another path 0.22 and 0.28
m in the middle of eleven buildings; how many of them are late in a place that is new differs, so that more are expected."""
_ANYWHERE = 30.0
"""m over which ranges are distributed where the place is unknown: the reach of the radio indoors."""


@dataclass(frozen=True, slots=True, eq=False)
class RangeFacts:
    """One range and its parameters."""

    anchor: int
    """Number of the anchor in the map."""
    place: Floats
    """(2,) of the anchor, m."""
    range: float
    """m, as measured, less the anchor's bias."""
    square: float
    """m^2, squared height of the anchor above the tag."""
    sigma: float
    """m, white part of the noise."""
    scale: float
    """Relative error of all ranges."""
    errors: RangeErrors | None = None
    """By the tag's place, from the map."""

    @property
    def white(self) -> float:
        """Standard deviation of the part of the noise that is new in every range, m."""
        noise = self.errors.noise if self.errors is not None else None
        return float(np.sqrt(0.5)) * self.sigma if noise is None else min(noise.white, self.sigma)

    @property
    def length(self) -> float:
        """Correlation length of the rest, m."""
        noise = self.errors.noise if self.errors is not None else None
        return _LENGTH if noise is None else noise.length


def repeated(white: Floats | float, length: Floats | float, driven: Floats | float) -> Floats:
    """Return how many ranges (...) to one anchor have the information of one independent one.

    Parameters
    ----------
    white : (...) share of the variance that is new in every range, 0..1. length : (...) correlation length of the rest, m.
    driven : (...) m since the last range to the anchor.

    Notes
    -----
    Multipath and shadows, which are the same until the tag has moved: the mean of errors with covariance ``exp(-d / length)``
    every d has the variance of independent ones every ``2 length``. The white part of the noise is new every time.
    """
    return np.asarray(white + (1.0 - white) * np.maximum(2.0 * length / np.maximum(driven, _SAME_PLACE), 1.0))


_LENGTH, _SAME_PLACE = 1.5, 0.01
"""m; length of the errors in a map that does not say it, as RadioModel; and way below which nothing is new."""


def ranged(bank: Hypotheses, fact: RangeFacts, tag: Floats, share: float = 1.0) -> tuple[Hypotheses, Floats, Floats, Floats]:
    """Correct every hypothesis by one range.

    Parameters
    ----------
    tag : (2,) place of the tag at the range's time in the present frame of the base, m. share : of an independent range's
        information that it has, 0..1; the likelihood is that of the whole.

    Returns
    -------
    The hypotheses, and for each the weight (h,), 0..1, that the range got, its log-likelihood (h,), 0 = the likeliest, and
    that of a range from anywhere (h,).

    Notes
    -----
    How the pattern and the place's error change with the pose is left out of the Jacobian: 0.1 m per radian, 0.05 m per metre.
    """
    theta = bank.mean[:, 2]
    lever = se2.rotate(theta, np.broadcast_to(tag, (len(bank), 2)))
    offset = bank.mean[:, :2] + lever - fact.place
    distance = np.sqrt(np.maximum(np.sum(offset**2, axis=1) + fact.square, 1e-4))
    columns = fact.anchor + np.array([FIRST_ANCHOR, (FIRST_ANCHOR + bank.mean.shape[1]) // 2])
    waves = pattern_waves(np.arctan2(-offset[:, 1], -offset[:, 0]) - theta)
    shift = np.einsum("hk,hk->h", waves, bank.mean[:, PATTERN]) + bank.mean[:, columns].sum(axis=1)
    if fact.errors is not None:
        shift += fact.errors.at(offset + fact.place)
    error = fact.range - (1.0 + fact.scale) * distance - shift
    jacobian = np.zeros(bank.mean.shape)
    jacobian[:, PATTERN] = waves
    unit = (1.0 + fact.scale) * offset / distance[:, None]
    jacobian[:, :2] = unit
    jacobian[:, 2] = -unit[:, 0] * lever[:, 1] + unit[:, 1] * lever[:, 0]
    jacobian[:, columns] = 1.0
    spread = np.einsum("hij,hj->hi", bank.covariance, jacobian)
    own = np.einsum("hi,hi->h", jacobian, spread)
    sigma = np.sqrt(own + fact.sigma**2)
    weight, likelihood = _judged(error, sigma)
    gain = spread / (own + fact.sigma**2 / (share * np.maximum(weight, 1e-3)))[:, None]
    gain *= (weight > 1e-3)[:, None]
    mean = bank.mean + gain * error[:, None]
    mean[:, 2] = se2.wrap_angle(mean[:, 2])
    covariance = symmetric(bank.covariance - gain[:, :, None] * spread[:, None, :])
    anywhere = np.log(sigma * np.sqrt(2.0 * np.pi) / _ANYWHERE)
    return Hypotheses(mean, covariance, bank.log_weight), weight, likelihood, anywhere


def _judged(error: Floats, sigma: Floats) -> tuple[Floats, Floats]:
    """Return the weights (h,) of errors (h,) with standard deviations (h,) and their log-likelihoods, 0 = the likeliest."""
    z = error / sigma
    core = (1.0 - _TAIL - WILD) * np.exp(-0.5 * z**2)
    ratio = sigma / _DETOUR
    late = _TAIL * ratio * np.sqrt(2.0 * np.pi) * np.exp(np.minimum(0.5 * ratio**2 - error / _DETOUR, 50.0)) * ndtr(z - ratio)
    total = core + late + gross_share(sigma)
    return core / total, np.log(total)


def gross_share(sigma: Floats) -> Floats:
    """Return the density (...) of gross errors, that of a normal error of 0 with standard deviations (...), m, being 1."""
    return np.asarray(WILD * np.sqrt(2.0 * np.pi) / _WIDTH * sigma)
