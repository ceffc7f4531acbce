"""How far an estimate is from the truth: trajectory (ATE, RPE, heading) and anchors.

The estimate is first aligned with the truth by the rigid motion that fits the positions best (Umeyama 1991 without scale), and
read at the stamps of the truth by interpolation; where it has no pose within `max_gap`, that stamp of the truth is left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from .. import se2
from ..arrays import TINY, Bools, Floats, Ints
from ..errors import DataError
from ..se2 import align

_PAUSE = 1e6
"""s between two recordings that are compared as one: more than any gap that is bridged."""
EDGE = 1e-3
"""s by which rounded stamps may stick out of a trajectory."""


class Paired(NamedTuple):
    """A trajectory and the true one."""

    stamps: Floats
    """(n,) s, ascending."""
    poses: Floats
    """(n, 3) T_map_base."""
    true_stamps: Floats
    """(k,) s, ascending."""
    true_poses: Floats
    """(k, 3) T_truth_base."""

    @staticmethod
    def of(estimate: tuple[Floats, Floats], truth: tuple[Floats, Floats]) -> "Paired":
        """Return stamps and poses of a file each in the order of time."""
        return Paired(*in_order(*estimate), *in_order(*truth))

    @staticmethod
    def one_after_another(recordings: "Sequence[Paired]") -> "Paired":
        """Return all recordings as one; stamps are moved apart, for they may be of the same hour or of clocks set again."""
        if len(recordings) == 1:
            return recordings[0]
        moved, free = list[Paired](), 0.0
        for one in recordings:
            begin = free - min(one.stamps[0], one.true_stamps[0])
            moved.append(one._replace(stamps=one.stamps + begin, true_stamps=one.true_stamps + begin))
            free = max(moved[-1].stamps[-1], moved[-1].true_stamps[-1]) + _PAUSE
        return Paired(*(np.concatenate(column) for column in zip(*moved, strict=True)))

    def compared(self, errors: "TrajectoryErrors") -> tuple[Floats, Floats]:
        """Return the estimated and the true poses (m, 3) at the stamps that were compared."""
        estimate = se2.interpolate_trajectory(self.stamps, self.poses, self.true_stamps[errors.matched])
        return estimate, self.true_poses[errors.matched]


def in_order(stamps: Floats, poses: Floats) -> tuple[Floats, Floats]:
    """Return a trajectory with its stamps (n,) in order."""
    order = np.argsort(stamps, kind="stable")
    return stamps[order], poses[order]


@dataclass(frozen=True, slots=True, eq=False)
class ErrorStatistics:
    """Figures of a set of non-negative errors, all in the errors' unit."""

    rmse: float
    mean: float
    median: float
    std: float
    max: float
    count: int


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryErrors:
    """A trajectory against the truth."""

    T_truth_map: Floats
    """(3,) rigid motion that lays the estimate over the truth."""
    matched: Ints
    """(m,) indices of the true poses that were compared."""
    position: Floats
    """(m,) m, distance between true and aligned position."""
    ate: ErrorStatistics
    """Of `position`, m: the absolute trajectory error (its rmse is what is usually quoted)."""
    heading: ErrorStatistics | None
    """Of |heading difference| after alignment, rad; None where the truth has no heading."""
    rpe_delta: float
    """Length of the stretches of the relative pose error, m of the true path."""
    rpe_position: ErrorStatistics | None
    """m per stretch; None where the truth has no heading or is shorter than one stretch."""
    rpe_heading: ErrorStatistics | None
    """rad per stretch; None likewise."""

    def in_truth(self, points: Floats) -> Floats:
        """Return points (p, 2) of the map in the frame of the truth."""
        return se2.transform(self.T_truth_map, points)


@dataclass(frozen=True, slots=True, eq=False)
class AnchorErrors:
    """Estimated anchors against the true ones, after the alignment of the trajectory."""

    ids: tuple[str, ...]
    """Anchors that were compared, in the order of the truth."""
    distances: Floats
    """(a,) m."""
    rmse: float
    """m; nan where nothing was compared."""
    missing: tuple[str, ...]
    """True anchors without an estimate."""


def statistics(errors: Floats) -> ErrorStatistics:
    """Return the figures of the errors (n,), n >= 1."""
    rmse, mean, median = float(np.sqrt(np.mean(errors**2))), float(np.mean(errors)), float(np.median(errors))
    return ErrorStatistics(rmse, mean, median, float(np.std(errors)), float(np.max(errors)), len(errors))


def evaluate_trajectory(
    stamps: Floats,
    poses: Floats,
    true_stamps: Floats,
    true_poses: Floats,
    *,
    max_gap: float = 1.0,
    rpe_delta: float = 1.0,
) -> TrajectoryErrors:
    """Compare a trajectory with the truth; true headings that are all equal are none (files of positions write the identity).

    Parameters
    ----------
    stamps, poses : (n,) s and (n, 3) T_map_base, the estimate.
    true_stamps, true_poses : (k,) s and (k, 3) T_truth_base.
    max_gap : s; a true stamp between estimated poses farther apart, or outside them by more, is left out.
    rpe_delta : m of true path per stretch of the relative pose error; stretches follow one another without overlap.

    Raises
    ------
    DataError : fewer than two true stamps lie within the estimate.
    """
    matched = np.flatnonzero(covered(stamps, true_stamps, max_gap))
    if len(matched) < 2:
        raise DataError(
            f"only {len(matched)} of {len(true_stamps)} true stamps ({_span(true_stamps)}) lie within the trajectory"
            f" ({_span(stamps)}): are both of the same recording and clock?"
        )
    truth = true_poses[matched]
    estimate = se2.interpolate_trajectory(stamps, poses, true_stamps[matched])
    T_truth_map = align(estimate[:, :2], truth[:, :2])
    estimate = se2.compose(T_truth_map, estimate)
    position = np.hypot(*(estimate[:, :2] - truth[:, :2]).T)
    heading = rpe_position = rpe_heading = None
    if np.ptp(true_poses[:, 2]) > 0:
        heading = statistics(np.abs(se2.wrap_angle(estimate[:, 2] - truth[:, 2])))
        rpe_position, rpe_heading = _relative_errors(estimate, truth, rpe_delta)
    return TrajectoryErrors(T_truth_map, matched, position, statistics(position), heading, rpe_delta, rpe_position, rpe_heading)


def covered(stamps: Floats, queries: Floats, max_gap: float, overhang: float = EDGE) -> Bools:
    """Return which queries (q,) lie at a stamp, between stamps (n,) at most max_gap apart, or stick out by the overhang, s."""
    if not len(stamps):
        return np.zeros(len(queries), dtype=bool)
    after = np.clip(np.searchsorted(stamps, queries), 1, max(len(stamps) - 1, 1))
    before, behind = stamps[after - 1], stamps[np.minimum(after, len(stamps) - 1)]
    inside = (queries >= before - overhang) & (queries <= behind + overhang) & (behind - before <= max_gap)
    return np.asarray(inside | (np.minimum(np.abs(queries - before), np.abs(queries - behind)) <= EDGE))


def _span(stamps: Floats) -> str:
    return f"{stamps[0]:.3f} .. {stamps[-1]:.3f} s" if len(stamps) else "none"


def _relative_errors(estimate: Floats, truth: Floats, delta: float) -> tuple[ErrorStatistics | None, ErrorStatistics | None]:
    """Return the figures of E = (truth_i^-1 truth_j)^-1 (estimate_i^-1 estimate_j) over stretches i..j of the path."""
    ends = stretches(truth[:, :2], delta)
    if len(ends) < 2:
        return None, None
    i, j = ends[:-1], ends[1:]
    error = se2.between(se2.between(truth[i], truth[j]), se2.between(estimate[i], estimate[j]))
    return statistics(np.hypot(error[:, 0], error[:, 1])), statistics(np.abs(error[:, 2]))


def stretches(positions: Floats, delta: float) -> Ints:
    """Return indices (k,) that cut a path (n, 2) into stretches: each is the shortest that is at least delta long."""
    way, ends, after = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(positions, axis=0).T))]), list[int](), 0
    while after < len(way):
        ends.append(after)
        # Rounding of the running sum must not make a stretch of exactly delta one sample longer.
        after = max(int(np.searchsorted(way, way[after] + (1.0 - TINY) * delta)), after + 1)
    return np.array(ends, dtype=np.intp)


def evaluate_anchors(
    ids: tuple[str, ...], positions: Floats, true_ids: tuple[str, ...], true_positions: Floats, T_truth_map: Floats
) -> AnchorErrors:
    """Compare anchors by name; estimates that are nan count as missing.

    Parameters
    ----------
    ids, positions : names and (a, 2) m in the map frame.
    true_ids, true_positions : names and (b, 2) m in the frame of the truth.
    T_truth_map : (3,) alignment of the trajectory.
    """
    place = {name: xy for name, xy in zip(ids, positions, strict=True) if np.all(np.isfinite(xy))}
    common = tuple(name for name in true_ids if name in place)
    truth = np.array([xy for name, xy in zip(true_ids, true_positions, strict=True) if name in place]).reshape(-1, 2)
    estimate = se2.transform(T_truth_map, np.array([place[name] for name in common]).reshape(-1, 2))
    distances = np.hypot(*(estimate - truth).T)
    rmse = float(np.sqrt(np.mean(distances**2))) if common else float("nan")
    return AnchorErrors(common, distances, rmse, tuple(name for name in true_ids if name not in place))
