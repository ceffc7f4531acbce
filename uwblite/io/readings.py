"""What readers of recordings share: ranges by the names of anchors, scans brought to one geometry, a reach that is not stated.

Cheap spinning lidars send 672 to 682 readings a turn, as their motor runs; logs of others mix 180 and 181 beams, of which some
interlace: scans of one beam fewer lie between the beams of the others, in turn with them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import CHUNK, Floats, Ints, chunks
from ..sensor_log import MOST_METRES, UwbRanges


def ranges_of(
    stamps: Floats, anchor: Ints, names: Sequence[str], metres: Floats, quality: Floats, tag: Ints | None = None
) -> UwbRanges:
    """Return ranges in the order of time and anchors in that of their names.

    Parameters
    ----------
    stamps, metres, quality : (n,) s, m, 0..100.
    anchor : (n,) index into the names, of which equal ones are one anchor.
    tag : (n,) which of the robot's tags; None = it has one.
    """
    ids, order = tuple(sorted(set(names))), np.argsort(stamps, kind="stable")
    place = {name: k for k, name in enumerate(ids)}
    rank = np.array([place[name] for name in names], dtype=np.intp)[anchor]
    return UwbRanges(stamps[order], rank[order], metres[order], quality[order], ids, None if tag is None else tag[order])


MOST_TAGS = 9
"""Tags on one robot that a recording keeps apart: UWB, UWB2 ... UWB9."""
_SAME_VIEW = 0.03
"""Share of the field of view by which geometries of one lidar differ at most."""
_STEEPEST = 4.0
"""Change of range from beam to beam, in units of range times the angle between them, up to which both are on one surface:
one that is seen 14 degrees off its plane."""
_NOISE = 0.05
"""m; a change that noise alone explains."""


@dataclass(frozen=True, slots=True)
class ScanGeometry:
    """Where the beams of a scan point."""

    angle_min: float
    """rad."""
    angle_increment: float
    """rad."""
    beams: int

    @property
    def angles(self) -> Floats:
        """(b,) rad."""
        return np.asarray(self.angle_min + self.angle_increment * np.arange(self.beams), dtype=np.float64)

    @property
    def full_turn(self) -> bool:
        """Whether the last beam is beside the first."""
        return abs(self.beams * abs(self.angle_increment) - 2.0 * np.pi) < 1.5 * abs(self.angle_increment)

    def is_of_one_lidar_with(self, other: "ScanGeometry") -> bool:
        """Return whether both look the same way over the same field of view, up to a few per cent or two beams."""
        view = self.beams * self.angle_increment
        slack = max(2.0 * abs(self.angle_increment), 2.0 * abs(other.angle_increment), _SAME_VIEW * abs(view))
        begin = abs(self.angle_min - other.angle_min)
        return begin <= slack and abs(view - other.beams * other.angle_increment) <= slack


def resampled(ranges: NDArray[np.float32], have: ScanGeometry, want: ScanGeometry) -> NDArray[np.float32]:
    """Return scans (k, b) of one geometry as another one's (k, w).

    Between two beams on one surface the range is interpolated; elsewhere that of the nearer beam serves. Where no beam is
    within half an increment, nothing is known (nan).
    """
    step, place = have.angle_increment, (want.angles - have.angle_min) / have.angle_increment
    if have.full_turn:
        place = np.mod(place + 0.5, 2.0 * np.pi / abs(step)) - 0.5
    low = np.floor(place).astype(np.intp)
    share = (place - low).astype(np.float32)
    ends = np.stack([low, low + 1])
    ends = ends % have.beams if have.full_turn else np.clip(ends, 0, have.beams - 1)
    first, second = ranges[:, ends[0]], ranges[:, ends[1]]
    with np.errstate(invalid="ignore"):
        change = second - first
        joint = np.abs(change) <= _STEEPEST * abs(step) * np.minimum(first, second) + _NOISE
        resampled = np.where(joint, first + share * change, np.where(share < 0.5, first, second))
    if not have.full_turn:
        resampled[:, (place < -0.5) | (place > have.beams - 0.5)] = np.nan
    return resampled.astype(np.float32)


def resampling_warning(resized: int, scans: int, beams: int) -> str:
    """Say that scans of another number of beams were resampled."""
    return f"{resized} of {scans} scans have other beams than most; they were resampled to {beams} beams"


def clean(ranges: NDArray[np.float32], range_min: float, range_max: float, *, zero_is_nothing: bool = False) -> None:
    """Make readings, m, +inf for nothing seen and nan for too near and error, in the memory given (REP-117).

    Parameters
    ----------
    zero_is_nothing : a 0 is no echo, as drivers of ROS older than REP-117 write it.
    """
    for rows in chunks(len(ranges), max(CHUNK // ranges.shape[1], 1)):
        some = ranges[rows]
        with np.errstate(invalid="ignore"):
            nothing = some >= np.float32(range_max)
            nothing |= zero_is_nothing & (some == 0.0)
            np.putmask(some, ~(some >= np.float32(range_min)), np.nan)
        np.putmask(some, nothing, np.inf)


def reach_of(ranges: NDArray[np.float32], warnings: list[str]) -> float:
    """Return a reach, m, in place of one that is not stated: just beyond the largest of readings (k, b) that a lidar may make.

    Drivers write the largest number of their type where they saw nothing: what is beyond becomes +inf, in the memory given.
    """
    seen = ranges[np.isfinite(ranges) & (np.abs(ranges) < MOST_METRES)]
    reach = float(seen.max()) + _BEYOND if len(seen) else DEFAULT_REACH
    with np.errstate(invalid="ignore"):
        ranges[ranges > np.float32(reach)] = np.inf
    warnings.append(
        f"the scans state no reach (range_max is 0, infinite or no number): the largest reading is used, {reach:.2f} m; what"
        " was beyond reach cannot be told from what was not measured"
    )
    return reach


DEFAULT_REACH = 80.0
"""m; reach of the scanners whose recordings do not state it."""
_BEYOND = 0.01
"""m; a reading of the reach itself would mean that nothing was seen."""


_SMOOTH = 0.3
"""Difference of following readings, m, from which on they are of different surfaces."""


def beams_lie_between(longer: NDArray[np.floating], shorter: NDArray[np.floating], lines: tuple[Ints, Ints]) -> bool:
    """Return whether the beams of shorter scans (n, b) lie in the middle between those of longer ones (m, b + 1).

    An offset of s beams makes r(k + s) - r(k) = s dr/dk. Least squares would take noise for an offset of a half, so dr/dk is
    taken once from the two readings and once from those beside them (an instrumental variable).

    Parameters
    ----------
    longer, shorter : readings, m; nan = none. lines : (m,) and (n,) numbers of the scans in the log, increasing.
    """
    rows = _pairs_in_turn(*lines)
    # A scanner that interlaces alternates; one whose number of beams was changed does not.
    if 2 * len(rows[0]) < len(shorter):
        return False
    one, other = longer[rows[0]].astype(np.float64), shorter[rows[1]].astype(np.float64)
    between, around = one[:, 2:-1] - one[:, 1:-2], (one[:, 3:] - one[:, :-3]) / 3.0
    off = other[:, 1:-1] - one[:, 1:-2]
    with np.errstate(invalid="ignore"):
        used = (np.abs(between) < _SMOOTH) & (np.abs(around) < _SMOOTH) & (np.abs(off) < _SMOOTH)
    shift, whole = (float(np.sum((around * change)[used])) for change in (off, between))
    return shift > 0.25 * whole


def _pairs_in_turn(longer: Ints, shorter: Ints) -> tuple[Ints, Ints]:
    """Return the rows (p,), (p,) of longer and shorter scans that follow each other, in either order."""
    kind = np.repeat([0, 1], [len(longer), len(shorter)])
    row = np.concatenate([np.arange(len(longer)), np.arange(len(shorter))])
    order = np.argsort(np.concatenate([longer, shorter]), kind="stable")
    kind, row = kind[order], row[order]
    turns = np.flatnonzero(kind[1:] != kind[:-1])
    first, second = row[turns], row[turns + 1]
    begins = kind[turns] == 0
    return np.where(begins, first, second), np.where(begins, second, first)
