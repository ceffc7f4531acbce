"""Ranges at poses of the map: their errors, the likelihood of a window of them, and the pose that they determine."""

from collections.abc import Container
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..arrays import Floats, Ints, Table
from ..radio.range_errors import RangeErrors
from ..radio.range_noise import RangeNoiseConfig

PER_RANGE, PER_EXPECTED = 50, 50
"""Operations on elements of arrays for the likelihood of a range at a pose, and for the error of the map's own ranges there."""
FEW = 40
"""Most ranges that many poses are compared by, evenly spread, to bound the work."""
DRIFT = 0.03
"""m of drift per metre driven: scale and heading of wheels that are not calibrated."""
ANYWHERE = 30.0
"""m over which ranges are distributed where the place is unknown: the reach of the radio indoors."""
SLOW_SIGMA = 0.1
"""m; common error of ranges to one anchor that fades: multipath, antennas, the anchor's place."""
BIAS_SIGMA = 0.1
"""m; error of all ranges to one anchor that stays, as CalibrationConfig.range_bias_sound: another tag has another delay."""
_SAME_PLACE = 0.01
"""m; way below which nothing is new in a range."""
_NOISE = RangeNoiseConfig()
"""Of a map that does not state it."""


_LATE, _DETOUR = 0.2, 0.5
"""Share of ranges with a detour, and its mean, m: 6 to 46 % by 0.2 to 0.7 m in twelve drives, fewer where the errors of the
map's own ranges at the place are taken off."""
_WILD, _WIDTH = 0.03, 2.0 * ANYWHERE
"""Share of gross errors, and their width, m; as many are an echo's."""
_ECHO = 4.0
"""m, mean delay of an echo that is taken for the direct path. For each metre between 5 and 7 m, 0.1 to 0.4 % of the ranges in
four buildings of another simulator are so much too long, 0.03 % of ours, and none of 45,000 real ones in two open rooms."""


def mixture(error: NDArray[Any], sigma: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the densities (...) of errors with standard deviations (...), m: those without a detour, and all of them.

    The mixture of radio.nlos_mixture for thousands of poses, a normal error of 0 having the density 1. The normal distribution
    is that of Page, Applied Statistics 1977 (off by 2e-4).
    """
    z, weight = error / sigma, float(np.sqrt(2.0 * np.pi))
    core = (1.0 - _LATE - 2.0 * _WILD) * np.exp(-0.5 * z * z)
    density = core + (weight * _WILD / _WIDTH) * sigma
    for share, delay in ((_LATE, _DETOUR), (_WILD, _ECHO)):
        ratio = sigma / delay
        over = z - ratio
        longer = np.exp(np.minimum(ratio * (0.5 * ratio - z), _LARGEST))
        longer *= 1.0 + np.tanh(over * (_PAGE[0] + _PAGE[1] * over * over))
        density += (0.5 * weight * share) * ratio * longer
    return core, density


_PAGE = (float(np.sqrt(2.0 / np.pi)), 0.0356774)
_LARGEST = 50.0
"""Exponent that both kinds of numbers hold."""


@dataclass(frozen=True, slots=True, eq=False)
class KnownAnchors(Table):
    """Anchors of the map (a,); the expected range is ``(1 + scale) sqrt(D^2 + rise) + bias``, see graph.range_edges."""

    ids: tuple[str, ...]
    positions: Floats
    """(a, 2) m, map frame."""
    bias: Floats
    """m."""
    rise: Floats
    """m^2, squared height above the tag, as far as it is known: by the map's recording, or stated for the robot."""
    sigma: Floats
    """m, spread of the map's range residuals."""
    bias_sigma: Floats
    """m, of the error that all ranges to it have in common: another tag than the map's, and the anchor's place."""
    scale: float = 0.0
    """Relative error of all ranges, 1."""
    errors: tuple[RangeErrors, ...] = ()
    """(a,) what remains, by the tag's place; empty where the map does not say it."""

    @property
    def noise(self) -> Floats:
        """(a, 2) m, standard deviation of the noise that is new in every range, and correlation length of the rest."""
        if self.errors:
            return np.array([(min(e.noise.white, s), e.noise.length) for e, s in zip(self.errors, self.sigma, strict=True)])
        white = np.sqrt(1.0 - _NOISE.slow_share) * self.sigma
        return np.column_stack([white, np.full_like(white, _NOISE.correlation_length)])

    def only(self, names: Container[str]) -> "KnownAnchors":
        """Return the anchors that have one of these names."""
        rows = [k for k, name in enumerate(self.ids) if name in names]
        errors = tuple(self.errors[k] for k in rows if self.errors)
        return replace(self.rows(np.array(rows, dtype=np.intp)), ids=tuple(self.ids[k] for k in rows), errors=errors)


@dataclass(frozen=True, slots=True, eq=False)
class Ranges(Table):
    """The ranges (m,) of a window."""

    anchor: Ints
    places: Floats
    """(m, 2) of the anchors, m."""
    tags: Floats
    """(m, 2) where the tag was at each range, in the present frame of the base, m: its arm and the way since."""
    values: Floats
    """Horizontal distances, m."""
    sigma: Floats
    """m; including the drift since then."""
    way: Floats
    """Odometer at each, m; ascending."""
    white: Floats
    """m; the part of it that is new in every range."""
    length: Floats
    """Correlation length of the rest, m."""

    def __len__(self) -> int:
        return len(self.values)


def repeated(white: Floats | float, length: Floats | float, driven: Floats | float) -> Floats:
    """Return how many ranges (...) to one anchor have the information of an independent one, each driven m after the other.

    Multipath and shadows are the same until the tag has moved: the mean of errors with covariance ``exp(-d / length)`` every d
    has the variance of independent ones every ``2 length``. The white share of the variance, 0..1, is new every time.
    """
    return np.asarray(white + (1.0 - white) * np.maximum(2.0 * length / np.maximum(driven, _SAME_PLACE), 1.0))


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Each range (m,) beside the one before it to the same anchor."""

    before: Ints
    """Its number; a first range's own."""
    stay: Floats
    """Probability that its error is still the same but for the white noise; 0 of a first one. Gross errors do not last."""
    change: Floats
    """m, standard deviation of the difference then."""
    share: Floats
    """Of the information of an independent range that it has, 0..1; 1 of a first one."""


def series(ranges: Ranges) -> Series:
    """Return how the ranges to each anchor follow one another: errors by multipath and shadows last for some metres."""
    order = np.argsort(ranges.anchor, kind="stable")
    follows = np.diff(ranges.anchor[order], prepend=-1) == 0
    before = np.arange(len(ranges))
    before[order[follows]] = order[np.flatnonzero(follows) - 1]
    again = before != np.arange(len(ranges))
    # Two tags are apart where the robot has not moved.
    driven = np.maximum(ranges.way - ranges.way[before], np.hypot(*(ranges.tags - ranges.tags[before]).T))
    stay = np.where(again, (1.0 - _WILD) * np.exp(-driven / ranges.length), 0.0)
    change = np.sqrt(2.0 * ranges.white**2 + (DRIFT * driven) ** 2)
    many = repeated((ranges.white / ranges.sigma) ** 2, ranges.length, driven)
    return Series(before, stay, change, np.where(again, 1.0 / many, 1.0))


def expected_errors(poses: Floats, ranges: Ranges, errors: tuple[RangeErrors, ...]) -> Floats:
    """Return by how much the map's own ranges to its anchors (a,) were off where the tag was (h, m), at poses (h, 3), m."""
    late = np.zeros((len(poses), len(ranges)))
    for anchor in np.unique(ranges.anchor):
        own = np.flatnonzero(ranges.anchor == anchor)
        late[:, own] = errors[anchor].at(poses[:, None, :2] + se2.rotate(poses[:, None, 2], ranges.tags[own][None]))
    return late


def range_likelihood(poses: Floats, ranges: Ranges, wider: float = 0.0, expected: Floats | None = None) -> Floats:
    """Return the log-likelihoods (h,) of the ranges at poses (h, 3), 0 = all as expected; with NLOS and gross errors.

    The error of ranges to one anchor stays what it was, with a probability that fades with the way, or is drawn anew. Of poses
    of a grid every sigma is wider, m; expected (h, m) are the errors of the map's own ranges there, m.
    """
    if not len(ranges):
        return np.zeros(len(poses))
    error, fresh = _drawn(poses, ranges, wider, expected)
    chain = series(ranges)
    again = np.flatnonzero(chain.stay)
    change = (chain.change + wider)[again]
    jump = (error[:, again] - error[:, chain.before[again]]) / change.astype(np.float32)
    stay = chain.stay[again].astype(np.float32)
    same = ((ranges.sigma + wider)[again] / change).astype(np.float32) * np.exp(-0.5 * jump * jump)
    fresh[:, again] += stay * (same - fresh[:, again])
    return np.asarray(np.log(fresh).sum(axis=1, dtype=np.float64))


def shared_likelihood(poses: Floats, ranges: Ranges) -> Floats:
    """Return the log-likelihoods (h,) of the ranges, each drawn anew and counted with its share of an independent one's."""
    return np.asarray(np.log(_drawn(poses, ranges)[1]) @ series(ranges).share)


def _drawn(
    poses: Floats, ranges: Ranges, wider: float = 0.0, expected: Floats | None = None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the errors (h, m) of ranges, m, and their likelihoods (h, m), each drawn anew; in single precision."""
    dx, dy, _, _ = _offsets(poses, ranges)
    error = ranges.values - np.sqrt(dx * dx + dy * dy) - (0.0 if expected is None else expected)
    single, sigma = error.astype(np.float32), (ranges.sigma + wider).astype(np.float32)
    return single, mixture(single, sigma)[1]


def _offsets(poses: Floats, ranges: Ranges) -> tuple[Floats, Floats, Floats, Floats]:
    """Return x and y (h, m) from the anchors to the tag, and from the base to the tag, m, at poses (h, 3)."""
    c, s = (v[:, None] for v in se2.cos_sin(poses[:, 2]))
    x, y = ranges.tags.T
    lx, ly = c * x - s * y, s * x + c * y
    return lx + (poses[:, :1] - ranges.places[:, 0]), ly + (poses[:, 1:2] - ranges.places[:, 1]), lx, ly


def range_errors(poses: Floats, ranges: Ranges) -> tuple[Floats, Floats]:
    """Return errors (h, m), m, measured minus expected, and the expected ranges' Jacobian (h, m, 3) by the pose."""
    dx, dy, lx, ly = _offsets(poses, ranges)
    distance = np.hypot(dx, dy)
    ux, uy = (d / np.maximum(distance, _SAME_PLACE) for d in (dx, dy))
    return ranges.values - distance, np.stack([ux, uy, uy * lx - ux * ly], axis=-1)


def range_factors(poses: Floats, ranges: Ranges) -> tuple[Floats, Floats]:
    """Return the quadratic form (h, 3, 3) and gradient (h, 3) of the whitened range errors at poses (h, 3).

    With a Cauchy kernel of two standard deviations.
    """
    error, jacobian = range_errors(poses, ranges)
    weight = series(ranges).share / (ranges.sigma**2 + np.square(0.5 * error))
    weighted = jacobian * weight[..., None]
    return weighted.transpose(0, 2, 1) @ jacobian, -np.einsum("hmk,hm->hk", weighted, error)


POOR = np.diag(np.square([0.1, 0.1, 0.3]))
"""Information of a pose of which nothing is known within 10 m and 3 rad."""
