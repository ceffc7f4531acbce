"""Ranges at poses of the map: their errors, the likelihood of a window of them, and the pose that they determine."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from .. import se2
from ..arrays import Floats, Ints, Table
from ..radio.range_errors import RangeErrors

_TAIL, _DETOUR, WILD, _WIDTH = 0.4, 0.4, 0.05, 60.0
"""Share of ranges with a detour and its mean, m; share of gross errors and their width, m: the mixture of radio.nlos_mixture.
The map's own ranges have a tail of 0.15 and 0.25 m where its robot drove, those of another robot on another path 0.22 and 0.28
m in the middle of eleven buildings; how many of them are late in a place that is new differs, so that more are expected."""
ANYWHERE_WIDTH = 30.0
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


def judged(error: Floats, sigma: Floats) -> tuple[Floats, Floats]:
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


@dataclass(frozen=True, slots=True, eq=False)
class Ranges(Table):
    """The window's ranges as arrays."""

    anchor: Ints
    """(m,)."""
    places: Floats
    """(m, 2) of the anchors, m."""
    tags: Floats
    """(m, 2) of the tag, in the present frame of the base, m."""
    values: Floats
    """(m,) horizontal distances, m."""
    sigma: Floats
    """(m,) m; including the drift since then."""
    way: Floats
    """(m,) odometer at each, m; ascending."""
    white: Floats
    """(m,) m; the part of it that is new in every range."""
    length: Floats
    """(m,) correlation length of the rest, m."""

    def __len__(self) -> int:
        return len(self.values)


DRIFT = 0.03
"""m of drift per metre driven: scale and heading of wheels that are not calibrated."""


PER_RANGE, PER_EXPECTED = 35, 50
"""Operations on elements of arrays for the likelihood of a range at a pose, and for the error of the map's own ranges there."""
_LATTICE, _LATTICE_STEPS = (1.5, 1.5, 0.6), (8, 8, 4)
"""m, m, rad about a pose, and steps to either side: several times what a start may be off by."""
_AT_ONCE = 512
"""Poses of the lattice whose ranges fit into the processor's cache."""
_MOST_MOMENTS = 40
"""Most ranges from which moments are computed, to bound the work."""
MOMENTS = PER_RANGE * _MOST_MOMENTS * 17 * 17 * 9
"""Operations for the moments."""


def range_errors(poses: Floats, ranges: Ranges) -> tuple[Floats, Floats, Floats]:
    """Return errors (h, m), m, measured minus expected, offsets (h, m, 2) from the anchors and lever arms (h, m, 2)."""
    lever = se2.rotate(poses[:, None, 2], ranges.tags[None])
    offset = poses[:, None, :2] + lever - ranges.places
    return ranges.values - np.hypot(offset[..., 0], offset[..., 1]), offset, lever


def _misfits(poses: Floats, ranges: Ranges) -> Floats:
    """Return the errors (h, m) alone, m, for many poses in a third of the time."""
    c, s = (v[:, None] for v in se2.cos_sin(poses[:, 2]))
    x, y = ranges.tags.T
    dx = c * x - s * y + (poses[:, :1] - ranges.places[:, 0])
    dy = s * x + c * y + (poses[:, 1:2] - ranges.places[:, 1])
    return np.asarray(ranges.values - np.sqrt(dx * dx + dy * dy))


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Each range beside the one before it to the same anchor."""

    before: Ints
    """(m,) its number; a first range's own."""
    stay: Floats
    """(m,) probability, 0..1, that its error is still the same but for the white noise; 0 of a first one. Gross errors do not
    last."""
    change: Floats
    """(m,) m, standard deviation of the difference then."""
    share: Floats
    """(m,) of the information of an independent range that it has, 0..1; 1 of a first one."""


def series(ranges: Ranges) -> Series:
    """Return how the ranges to each anchor follow one another: errors by multipath and shadows last for some metres."""
    order = np.argsort(ranges.anchor, kind="stable")
    follows = np.diff(ranges.anchor[order], prepend=-1) == 0
    before = np.arange(len(ranges))
    before[order[follows]] = order[np.flatnonzero(follows) - 1]
    again = before != np.arange(len(ranges))
    # Two tags are apart where the robot has not moved.
    driven = np.maximum(ranges.way - ranges.way[before], np.hypot(*(ranges.tags - ranges.tags[before]).T))
    stay = np.where(again, (1.0 - WILD) * np.exp(-driven / ranges.length), 0.0)
    change = np.sqrt(2.0 * ranges.white**2 + (DRIFT * driven) ** 2)
    many = repeated((ranges.white / ranges.sigma) ** 2, ranges.length, driven)
    return Series(before, stay, change, np.where(again, 1.0 / many, 1.0))


@dataclass(frozen=True, slots=True)
class Detours:
    """How ranges are late, beside a normal error: shares of the density that a normal error has at 0."""

    core: float
    """Of the normal error."""
    late: float
    """Of an exponentially distributed detour."""
    length: float
    """Its mean, m."""


ANYWHERE = Detours(0.7, 0.3, 0.5)
"""Where nothing is known of the place: a third of the ranges is late."""
VISITED = Detours(0.83, 0.12, 0.4)
"""Of ranges from which the map's own errors at the place are taken off: in twelve drives in maps of other drives, three
buildings each of four worlds, 6 to 18 % were late by 0.2 to 0.7 m (means), where without that 10 to 46 % were."""


def expected_errors(poses: Floats, ranges: Ranges, errors: tuple[RangeErrors, ...]) -> Floats:
    """Return by how much the map's own ranges were off where the tag was (h, m), at poses (h, 3), m.

    Parameters
    ----------
    errors : (a,) of the anchors.
    """
    late = np.zeros((len(poses), len(ranges)))
    for anchor in np.unique(ranges.anchor):
        own = np.flatnonzero(ranges.anchor == anchor)
        late[:, own] = errors[anchor].at(poses[:, None, :2] + se2.rotate(poses[:, None, 2], ranges.tags[own][None]))
    return late


def range_likelihood(poses: Floats, ranges: Ranges, wider: float = 0.0, expected: Floats | None = None) -> Floats:
    """Return the log-likelihoods (h,) of the ranges at poses (h, 3), 0 = all as expected; with NLOS and gross errors.

    The error of ranges to one anchor stays what it was, with a probability that fades with the way, or is drawn anew.

    Parameters
    ----------
    wider : added to every sigma, m: the poses are those of a grid. expected : (h, m) errors of the map's own ranges there, m.
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
    """Return the errors (h, m) of ranges, m, and their likelihoods (h, m), each drawn anew."""
    # Single precision, and the normal distribution by a tanh (Page, Applied Statistics 1977; off by 2e-4): a third of the time.
    misfit, sigma, detours = _misfits(poses, ranges), ranges.sigma + wider, ANYWHERE
    if expected is not None:
        misfit, detours = misfit - expected, VISITED
    error = misfit.astype(np.float32)
    gross, z = gross_share(sigma).astype(np.float32), error / sigma.astype(np.float32)
    square = z * z
    late = np.exp(np.maximum(error, 0.0) / -detours.length) * (1.0 + np.tanh(z * (0.7978846 + 0.0356774 * square)))
    return error, np.asarray(detours.core * np.exp(-0.5 * square) + 0.5 * detours.late * late + gross, dtype=np.float32)


def refined_by_ranges(poses: Floats, ranges: Ranges) -> Floats:
    """Return poses (h, 3) moved to where the ranges agree best nearby: Gauss-Newton with a Cauchy kernel."""
    poses = poses.copy()
    for _ in range(8):
        hessian, gradient = range_factors(poses, ranges)
        step = -np.linalg.solve(hessian + np.diag([1e-3, 1e-3, 1e-2]), gradient[:, :, None])[:, :, 0]
        length = np.maximum(np.hypot(step[:, 0], step[:, 1]), np.abs(step[:, 2]))
        poses += step * np.minimum(1.0, 0.5 / np.maximum(length, 1e-9))[:, None]
    poses[:, 2] = se2.wrap_angle(poses[:, 2])
    return poses


def range_moments(pose: Floats, ranges: Ranges) -> tuple[Floats, Floats]:
    """Return the mean (3,) and covariance (3, 3) of the pose by the ranges alone, about a pose (3,) where they agree best.

    With NLOS the likelihood is flat where its curvature, without the late ranges, would give a sharp peak: so the
    moments are summed over a lattice of poses.
    """
    axes = [np.linspace(-reach, reach, 2 * count + 1) for reach, count in zip(_LATTICE, _LATTICE_STEPS, strict=True)]
    off = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    few = np.unique(np.linspace(0, len(ranges) - 1, _MOST_MOMENTS).astype(np.intp))
    some, parts = ranges.rows(few), np.array_split(pose + off, len(off) // _AT_ONCE)
    # Errors that change with the direction of driving neither last nor are drawn anew: each range counts with its share.
    weight = np.concatenate([shared_likelihood(part, some) for part in parts])
    weight *= series(ranges).share.sum() / series(some).share.sum()
    weight = np.exp(weight - weight.max())
    weight /= weight.sum()
    mean = weight @ off
    steps = np.array([axis[1] - axis[0] for axis in axes])
    off -= mean
    # Each point of the lattice represents a cell: the variance within the cell is added.
    covariance = (off * weight[:, None]).T @ off + np.diag(steps**2 / 12.0)
    return np.concatenate([pose[:2] + mean[:2], [se2.wrap_angle(pose[2] + mean[2])]]), covariance


def range_factors(poses: Floats, ranges: Ranges) -> tuple[Floats, Floats]:
    """Return the quadratic form (h, 3, 3) and gradient (h, 3) of the whitened range errors at poses (h, 3)."""
    jacobian, weighted, error = _linear(poses, ranges)
    return weighted.transpose(0, 2, 1) @ jacobian, -np.einsum("hmk,hm->hk", weighted, error)


def bias_effect(poses: Floats, ranges: Ranges, anchors: int) -> Floats:
    """Return by how much (h, 3, a) poses (h, 3) by ranges move with an error that all ranges to an anchor have in common."""
    jacobian, weighted, _ = _linear(poses, ranges)
    own = (ranges.anchor[:, None] == np.arange(anchors)).astype(np.float64)
    return np.linalg.solve(weighted.transpose(0, 2, 1) @ jacobian + POOR, weighted.transpose(0, 2, 1) @ own)


POOR = np.diag([0.01, 0.01, 0.1])
"""Information of a pose of which nothing is known within 10 m and 3 rad."""


def _linear(poses: Floats, ranges: Ranges) -> tuple[Floats, Floats, Floats]:
    """Return the Jacobian (h, m, 3) of expected ranges, the same times their weights, and their errors (h, m), m."""
    error, offset, lever = range_errors(poses, ranges)
    distance = np.maximum(np.hypot(offset[..., 0], offset[..., 1]), 0.05)
    unit = offset / distance[..., None]
    jacobian = np.concatenate([unit, (unit[..., 1] * lever[..., 0] - unit[..., 0] * lever[..., 1])[..., None]], axis=-1)
    weight = series(ranges).share / (1.0 + np.square(error / (2.0 * ranges.sigma))) / ranges.sigma**2
    return jacobian, jacobian * weight[..., None], error
