"""Stamps of a CARMEN log judged by the order of its lines: false ones, and those that stand still while the robot drives.

GMapping's corrected logs repeat each laser message as an ODOM whose stamp was never set. Between two of their scans the ODOM
messages are the wheels', and at each scan they leap to the corrected pose.
"""

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, Ints, runs_of
from ..sensor_log import stand_still

CONFIRMED = 0.5
"""s; a recorder may hold a range back until the next one confirms it."""
_NEXT = 2.0
"""s; a part of a log that follows another begins so much later at most."""
_FAR = 10.0
"""s; no message waits so long for its line."""
_IN_A_ROW = 3
"""Messages; a clock that was set back gives more."""
_PERIODS = 10.0
"""Times between readings by which a stamp of 0 must be too early to be one that was never set."""
_SPEED, _TURN_RATE, _PERIOD = 0.5, 0.5, 0.1
"""m/s and rad/s at which robots usually move, s between messages of one that stands: made-up stamps are of such a robot."""


@dataclass(frozen=True, slots=True, eq=False)
class LineClock:
    """The time of the odometry by line, by which the stamps of other messages are judged."""

    lines: Ints
    """(n,) ascending."""
    stamps: Floats
    """(n,) s."""
    travelled: Floats
    """(n,) m, distance driven until then."""
    made: bool
    """Whether the stamps are made up, and no stamp of the log counts."""
    of_scans: bool
    """Whether odometry and scans cannot be of different clocks: they share messages, or their stamps are made up."""

    def sound(self, lines: Ints, stamps: Floats, what: str, warnings: list[str]) -> Floats:
        """Return stamps (m,), s, of other messages in the order of their lines (m,), those that cannot be placed by lines."""
        if len(lines) == 0 or len(self.lines) == 0:
            return stamps
        by_line = np.interp(lines, self.lines, self.stamps)
        if self.made:
            return by_line
        if stand_still(stamps, np.interp(lines, self.lines, self.travelled)):
            warnings.append(
                f"the stamps of {len(stamps)} {what} messages stand still while the robot drives: the messages are placed by"
                " their lines among the odometry"
            )
            return by_line
        return placed(lines, stamps, false_stamps(stamps), what, warnings)


AS_WRITTEN = LineClock(np.zeros(0, dtype=np.intp), np.zeros(0), np.zeros(0), False, False)
"""Without odometry every stamp stays."""


def judged(
    odometry: Floats, odometry_lines: Ints, laser: Floats, laser_lines: Ints, warnings: list[str]
) -> tuple[Floats, LineClock]:
    """Judge the stamps of the odometry by the lines of all messages that bear its pose.

    Parameters
    ----------
    odometry : (n, 4) s, m, m, rad: stamp and pose, in the order of lines.
    laser : (m, 4) the same of laser messages, where they give the odometry's pose.

    Returns
    -------
    The odometry to be used (k, 4), stamps sound, in the order of lines, and its time by line.
    """
    if len(odometry) == 0:
        return odometry, AS_WRITTEN
    rows, lines = np.concatenate([odometry, laser]), np.concatenate([odometry_lines, laser_lines])
    order = np.argsort(lines, kind="stable")
    rows, lines, wheels = rows[order], lines[order], order < len(odometry)
    again = np.zeros(len(rows), dtype=bool)
    again[1:] = wheels[1:] & ~wheels[:-1] & np.all(rows[1:, 1:] == rows[:-1, 1:], axis=1)
    made = stand_still(rows[~again, 0], _travelled(rows[~again]))
    # The laser may have another clock, but where all of the odometry repeats it there is no other order.
    others = wheels & ~again if (wheels & ~again).any() else ~wheels
    before, after = _neighbours(lines, lines[others], rows[others, 0])
    unset = again & (made | ((before <= after) & ((rows[:, 0] < before) | (rows[:, 0] > after))))
    corrected = int(unset.sum()) > max(len(laser) // 2, _IN_A_ROW)
    used = ~wheels | ~unset if corrected else wheels if made else wheels & ~unset
    if corrected:
        warnings.append(
            f"this log was corrected, as by GMapping: {int(unset.sum())} ODOM messages repeat the pose of the laser message"
            " before them with a stamp that was never set. The poses of the laser messages are the odometry; the other ODOM"
            " messages, whose poses leap at each of them, show where the robot stands alone"
        )
    elif unset.any() and not made:
        warnings.append(
            f"{int(unset.sum())} ODOM messages repeat the pose of the laser message before them with a stamp never set;"
            " they are left out"
        )
    rows, lines, wheels = rows[used].copy(), lines[used], wheels[used]
    if corrected:
        # What moves between two laser messages is the wheels', uncorrected; a robot that stands keeps its place meanwhile.
        stands = np.append(False, np.all(np.diff(rows[:, 1:], axis=0) == 0.0, axis=1))
        rows[:, 1:], kept = _remove_leaps(rows[:, 1:], wheels), ~wheels | (stands & (not made))
        rows, lines = rows[kept], lines[kept]
    if made:
        still = int(np.sum((np.diff(rows[:, 0]) <= 0.0) & (np.diff(_travelled(rows)) > 0.0)))
        warnings.append(
            f"the stamps of this log cannot be used: {still} of {len(rows)} have that of the message before while the robot"
            f" drives on. The messages are taken in the order of the lines, as of a robot at {_SPEED:g} m/s; speeds, durations"
            " and delays say nothing"
        )
        rows[:, 0] = _made_up(rows)
    else:
        rows[:, 0] = placed(lines, rows[:, 0], false_stamps(rows[:, 0]), "odometry", warnings)
    return rows, LineClock(lines, rows[:, 0], _travelled(rows), made, made or corrected)


def _remove_leaps(poses: Floats, wheels: Bools) -> Floats:
    """Return the poses (n, 3) of a corrected log without leaps; some (n,) are the odometry's own, the others of laser messages.

    Between two laser messages at P and Q the odometry leads from P to E, and C = E^-1 Q is what the correction changed: a pose
    X after a share a of the way becomes X exp(a log C).
    """
    laser, number = np.flatnonzero(~wheels), np.arange(len(wheels))
    following = np.searchsorted(laser, number)
    before, between = wheels & (following == 0), wheels & (following > 0) & (following < len(laser))
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])
    i = number[between]
    start, goal = laser[following[i] - 1], laser[following[i]]
    length = way[goal - 1] - way[start]
    share = (i - start) / (goal - 1 - start)
    np.divide(way[i] - way[start], length, out=share, where=length > 0.0)
    change = se2.log(se2.between(poses[goal - 1], poses[goal]))
    smooth = poses.copy()
    smooth[i] = se2.compose(poses[i], se2.exp(share[:, None] * change))
    if before.any():
        smooth[before] = se2.compose(se2.compose(poses[laser[0]], se2.inverse(poses[laser[0] - 1])), poses[before])
    return smooth


def _travelled(rows: Floats) -> Floats:
    """Return the distance driven until each reading (n, 4), m."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(rows[:, 1:3], axis=0).T))])


def _made_up(rows: Floats) -> Floats:
    """Return stamps (n,), s, for readings (n, 4) of a robot at usual speeds."""
    steps = np.diff(rows[:, 1:], axis=0)
    way, turn = np.hypot(steps[:, 0], steps[:, 1]), np.abs(np.angle(np.exp(1j * steps[:, 2])))
    return np.concatenate([[0.0], np.cumsum(np.maximum.reduce([way / _SPEED, turn / _TURN_RATE, np.full(len(way), _PERIOD)]))])


def _neighbours(lines: Ints, other_lines: Ints, other_stamps: Floats) -> tuple[Floats, Floats]:
    """Return the stamps, s, of the others (m,) before and behind each line (n,); infinite where there is none."""
    place = np.searchsorted(other_lines, lines)
    padded = np.concatenate([[-np.inf], other_stamps, [np.inf]])
    same = np.append(other_lines, -1)[np.minimum(place, len(other_lines))] == lines
    return padded[place], padded[place + 1 + same]


def false_stamps(stamps: Floats) -> Bools:
    """Return which stamps (n,), s, as they were written, cannot be: a few in a row, far off those before and after them, or 0.

    Where the rest is not in order, as in logs whose lines were mixed, none is called false.
    """
    false = np.zeros(len(stamps), dtype=bool)
    zero = stamps == 0.0
    set_ones = np.flatnonzero(~zero)
    if zero.any() and len(set_ones) > 1:
        before, after = _neighbours(np.arange(len(stamps)), set_ones, stamps[set_ones])
        late = max(CONFIRMED, _PERIODS * float(np.median(np.abs(np.diff(stamps[set_ones])))))
        false = zero & ((before > late) | (np.isfinite(after) & (after > _FAR)))
    rest = np.flatnonzero(~false)
    if np.any(np.diff(stamps[rest]) < -_FAR):
        ordered = longest_ascent(stamps[rest])
        before, after = _neighbours(np.arange(len(rest)), np.flatnonzero(ordered), stamps[rest[ordered]])
        far = ~ordered & ((stamps[rest] < before - _FAR) | (stamps[rest] > after + _FAR))
        for first, last in runs_of(far):
            false[rest[first:last]] = last - first <= _IN_A_ROW
    left = int(np.sum(np.diff(stamps[~false]) < -CONFIRMED))
    sound = 10 * left <= int(false.sum()) <= len(stamps) // 3
    return false if sound else np.zeros(len(stamps), dtype=bool)


def longest_ascent(values: Floats) -> Bools:
    """Return which values (n,) make up the longest subsequence that never falls (patience sorting, Fredman 1975)."""
    tops, piles, below = list[float](), list[int](), np.full(len(values), -1)
    for k, value in enumerate(values.tolist()):
        place = bisect_right(tops, value)
        below[k] = piles[place - 1] if place else -1
        tops[place : place + 1], piles[place : place + 1] = [value], [k]
    chosen, k = np.zeros(len(values), dtype=bool), piles[-1] if piles else -1
    while k >= 0:
        chosen[k], k = True, int(below[k])
    return chosen


def placed(lines: Ints, stamps: Floats, false: Bools, what: str, warnings: list[str]) -> Floats:
    """Return stamps (n,), s, with the false ones between those of the lines before and after."""
    if not false.any():
        return stamps
    first = int(np.argmax(false))
    warnings.append(
        f"{int(false.sum())} of {len(stamps)} {what} messages have a stamp that no clock gives (the first is"
        f" {stamps[first]:.4g} s in line {lines[first]}): they are placed by the order of the lines"
    )
    return np.where(false, np.interp(lines, lines[~false], stamps[~false]), stamps)


def time_order(stamps: Floats, what: str, warnings: list[str], set_back: dict[str, float]) -> Ints:
    """Return the order (n,) that sorts stamps, and warn of late ones; set_back takes by how much at most, s, by what."""
    late = int(np.count_nonzero(stamps < np.maximum.accumulate(stamps) - CONFIRMED))
    if late:
        warnings.append(f"{late} of {len(stamps)} {what} messages came out of time order; sorted by stamp")
        set_back[what] = 0.0 if _in_parts(stamps) else float(np.max(np.maximum.accumulate(stamps) - stamps))
    return np.argsort(stamps, kind="stable")


def _in_parts(stamps: Floats) -> bool:
    """Return whether stamps (n,) are those of one clock in parts that only stand in another order, as `cat` writes them."""
    steps = np.diff(stamps, prepend=np.inf)
    begins = np.flatnonzero((steps < -CONFIRMED) | (steps > _NEXT))
    first, last = np.minimum.reduceat(stamps, begins), np.maximum.reduceat(stamps, begins)
    order = np.argsort(first)
    gap, as_written = first[order][1:] - last[order][:-1], np.diff(order) == 1
    return bool(np.all((gap >= -CONFIRMED) & (as_written | (gap <= _NEXT))))
