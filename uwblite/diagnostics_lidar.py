"""Checks of the scans: rhythm, valid beams, units, field of view, and whether laser and wheels agree on turning.

When the robot turns left by a, everything the laser sees moves right by a. Matching scans a moment apart by a shift of
beams measures the turn without any map; the wheels tell another. From many such pairs follow whether the laser is
mounted upside down (the sign), the clock offset (the lag at which both agree best) and the wheels' heading scale.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import se2
from .findings import Findings, Floats, timing
from .sensor_log import LaserScans, SensorLog

Ints = NDArray[np.int64]

PAIRS = 1000
"""Scan pairs matched at most."""


def check_scans(log: SensorLog, found: Findings) -> dict[str, Any]:
    """Check the scans and return their figures."""
    scans = log.scans
    assert scans is not None
    figures: dict[str, Any] = timing(scans.stamps, "lidar", found, expected_gap=1.0)
    beams = scans.ranges.shape[1]
    view = abs(scans.angle_increment) * (beams - 1)
    figures |= {
        "beams": beams,
        "field of view deg": round(float(np.degrees(view)), 1),
        "range max m": round(scans.range_max, 3),
    }
    sample = scans.ranges[:: max(1, len(scans.ranges) // 400)].astype(np.float64)
    with np.errstate(invalid="ignore"):
        hit = (sample >= scans.range_min) & (sample <= scans.range_max)
    figures["share of beams that hit"] = round(float(hit.mean()), 3)
    figures["share that saw nothing"] = round(float(np.isposinf(sample).mean()), 3)
    figures["share that is invalid"] = round(float(np.isnan(sample).mean()), 3)
    _check_units(sample[hit], scans, view, found)
    _check_valid(hit, figures, found)
    if beams >= 30 and len(scans.stamps) >= 20:
        figures["turning"] = _check_turning(log, scans, found)
    return figures


def _check_units(seen: Floats, scans: LaserScans, view: float, found: Findings) -> None:
    if view > 2.0 * np.pi + 0.1:
        found.serious(
            "lidar",
            f"the field of view is {np.degrees(view):.0f} degrees: the angles look like degrees taken for radians",
            "angles must be radians",
        )
    if len(seen) and np.median(seen) > 150.0:
        found.serious(
            "lidar", f"the usual reading is {np.median(seen):.0f} m: they look like millimetres", "write metres into the log"
        )
    elif len(seen) and np.quantile(seen, 0.95) < 0.05:
        found.serious("lidar", f"95 % of the readings are below {np.quantile(seen, 0.95):.3f} m", "check the unit: metres")
    if len(seen) and np.ptp(seen) == 0.0:
        found.serious("lidar", "all readings are equal", "the laser is off, covered, or not the laser")


def _check_valid(hit: np.ndarray[Any, np.dtype[np.bool_]], figures: dict[str, Any], found: Findings) -> None:
    share = figures["share of beams that hit"]
    if share < 0.1:
        found.warning(
            "lidar",
            f"only {100 * share:.0f} % of the beams hit anything within {figures['range max m']:.1f} m",
            "the place is wider than the laser reaches: drive along the walls; the radio must hold the middle",
        )
    elif figures["share that is invalid"] > 0.4:
        found.note(
            "lidar",
            f"{100 * figures['share that is invalid']:.0f} % of the readings are error codes",
            "dark or slanting surfaces; they are left out and clear no space",
        )
    blocked = (hit.mean(axis=0) > 0.999) if len(hit) > 20 else np.zeros(1, dtype=bool)
    if 0.02 < float(blocked.mean()) < 0.5 and share < 0.95:
        found.note(
            "lidar",
            f"{int(blocked.sum())} beams hit in every scan",
            "parts of the robot may stand in the laser's view; readings below range_min are left out",
        )


def _check_turning(log: SensorLog, scans: LaserScans, found: Findings) -> dict[str, float]:
    first, second = _turning_pairs(log, scans)
    if len(first) < 20:
        found.note("lidar", "the robot hardly turns in place", "clock offset and mounting of the laser cannot be checked")
        return {}
    lags = np.arange(-1.0, 1.001, 0.02)
    middle = 0.5 * scans.time_increment * scans.ranges.shape[1]
    wheels = np.stack([_wheel_turn(log, scans, first, second, middle + lag) for lag in lags])
    sign = -1.0 if log.mounting.laser_flipped else 1.0
    told, other = (_Agreement.of(log, scans, first, second, wheels, s * sign) for s in (1.0, -1.0))
    turned_over = other.misfit.min() < 0.5 * told.misfit.min()
    right = other if turned_over else told
    best = int(np.argmin(right.misfit))
    figures = {
        "pairs": len(first),
        "misfit rad": round(float(told.misfit.min()), 4),
        "misfit if mounted the other way up rad": round(float(other.misfit.min()), 4),
        "clock offset s": round(float(-lags[best]), 3),
    }
    typical = float(np.median(np.abs(wheels[len(lags) // 2])))
    if right.misfit[best] > 0.5 * typical:
        found.warning(
            "lidar",
            f"laser and wheels disagree on turning (typically by {right.misfit[best]:.2f} rad of {typical:.2f} rad)",
            "check the stamps, the beam order and the wheels' heading",
        )
        return figures
    if turned_over:
        found.serious(
            "lidar",
            f"the laser is mounted {'upright' if log.mounting.laser_flipped else 'upside down'}: that way its turns agree"
            f" {told.misfit.min() / max(other.misfit.min(), 1e-6):.0f} times better with the wheels",
            "leave out --laser-flipped" if log.mounting.laser_flipped else "use --laser-flipped",
        )
    gain = right.errors[len(lags) // 2] - right.errors[best]
    clear = right.misfit[best] < 0.7 * right.misfit[len(lags) // 2] and gain.mean() > 2.0 * gain.std() / np.sqrt(gain.size)
    if abs(lags[best]) > 0.06 and clear:
        found.warning(
            "lidar",
            f"the laser's clock is {-lags[best]:+.2f} s off the odometry's",
            "uwblite corrects small offsets; stamp both with one clock, each when its reading begins",
        )
    _check_scale(right.turn, wheels[best], figures, found)
    return figures


def _check_scale(laser: Floats, wheels: Floats, figures: dict[str, float], found: Findings) -> None:
    clear = np.abs(wheels) > 0.1
    if clear.sum() < 20:
        return
    ratio = laser[clear] / wheels[clear]
    scale, error = (
        float(np.median(ratio)),
        float(1.2533 * 1.4826 * np.median(np.abs(ratio - np.median(ratio))) / np.sqrt(clear.sum())),
    )
    figures["turn by laser / turn by wheels"] = round(scale, 3)
    if abs(scale - 1.0) > max(0.12, 4.0 * error):
        found.warning(
            "odometry",
            f"the wheels say about {1.0 / scale:.2f} times the turns that the laser sees",
            "set the track width of the base; uwblite corrects it where the recording shows it",
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Agreement:
    """Turns by the laser under one assumption of its mounting, and how well the wheels agree."""

    turn: Floats
    """(p,) rad, counter-clockwise."""
    errors: Floats
    """(lags, pairs) differences to the wheels without their sign, of the clearer half of the pairs, rad; at most 0.3."""

    @property
    def misfit(self) -> Floats:
        """(lags,) mean difference, rad."""
        return np.asarray(self.errors.mean(axis=1), dtype=np.float64)

    @staticmethod
    def of(log: SensorLog, scans: LaserScans, first: Ints, second: Ints, wheels: Floats, sign: float) -> "_Agreement":
        turn, sharp = _matched_turn(scans, first, second, _laser_shift(log, scans, first, second) * (1.0, sign))
        clear = sharp >= np.quantile(sharp, 0.5)
        return _Agreement(sign * turn, np.minimum(np.abs(wheels[:, clear] - sign * turn[clear]), 0.3))


def _turning_pairs(log: SensorLog, scans: LaserScans) -> tuple[Ints, Ints]:
    """Choose scan pairs about half a second apart between which the robot turns and hardly drives."""
    step = max(1, round(0.5 / max(float(np.median(np.diff(scans.stamps))), 1e-3)))
    first = np.arange(len(scans.stamps) - step)
    second = first + step
    near = scans.stamps[second] - scans.stamps[first] < 2.0
    start, end = (se2.interpolate_trajectory(log.odometry.stamps, log.odometry.poses, scans.stamps[k]) for k in (first, second))
    motion = se2.between(start, end)
    turn, drive = np.abs(motion[:, 2]), np.hypot(motion[:, 0], motion[:, 1])
    view = abs(scans.angle_increment) * scans.ranges.shape[1]
    chosen = np.flatnonzero(near & (turn > 0.05) & (turn < 0.4 * view) & (drive < 0.15 + 0.3 * turn))
    chosen = chosen[:: max(1, len(chosen) // PAIRS)]
    return first[chosen], second[chosen]


def _wheel_turn(log: SensorLog, scans: LaserScans, first: Ints, second: Ints, lag: float) -> Floats:
    heading = np.unwrap(log.odometry.poses[:, 2])
    at = [np.interp(scans.stamps[k] + lag, log.odometry.stamps, heading) for k in (first, second)]
    return np.asarray(at[1] - at[0], dtype=np.float64)


def _laser_shift(log: SensorLog, scans: LaserScans, first: Ints, second: Ints) -> Floats:
    """Return where the laser is at the second scan in its own frame at the first (p, 2), m, by the wheels."""
    base = (se2.interpolate_trajectory(log.odometry.stamps, log.odometry.poses, scans.stamps[k]) for k in (first, second))
    start, end = (se2.compose(pose, log.mounting.T_base_laser) for pose in base)
    return se2.between(start, end)[:, :2]


def _matched_turn(scans: LaserScans, first: Ints, second: Ints, shift: Floats) -> tuple[Floats, Floats]:
    """Return the turn (p,) between scans by the shift of beams that matches best, rad, and how clear it is (0..1).

    The first scan is seen from where the laser moved (p, 2), so that only the turn is left; the mean absolute
    difference of clipped ranges is taken over all turns up to 40 % of the beams.
    """
    every = max(1, scans.ranges.shape[1] // 180)
    reach = min(scans.range_max, 12.0)
    angles = scans.angles[::every]
    used, place = np.unique(np.concatenate([first, second]), return_inverse=True)
    profile = np.nan_to_num(scans.ranges[used, ::every].astype(np.float64), nan=reach, posinf=reach)
    profile = np.where(profile < scans.range_min, reach, np.minimum(profile, reach))
    before = _seen_from(profile[place[: len(first)]], angles, shift, reach)
    after = profile[place[len(first) :]]
    beams, most = len(angles), int(0.4 * len(angles))
    turns = range(-most, most + 1)
    cost = np.empty((len(first), len(turns)))
    for column, turn in enumerate(turns):
        low, high = max(0, -turn), min(beams, beams - turn)
        cost[:, column] = np.abs(after[:, low:high] - before[:, low + turn : high + turn]).mean(axis=1)
    best = np.clip(np.argmin(cost, axis=1), 1, len(turns) - 2)
    rows = np.arange(len(first))
    left, middle, right = cost[rows, best - 1], cost[rows, best], cost[rows, best + 1]
    fine = best - most + 0.5 * (left - right) / np.maximum(left - 2.0 * middle + right, 1e-9)
    clear = 1.0 - middle / np.maximum(np.median(cost, axis=1), 1e-9)
    return np.asarray(fine * every * scans.angle_increment, dtype=np.float64), clear


def _seen_from(profile: Floats, angles: Floats, shift: Floats, reach: float) -> Floats:
    """Return range profiles (p, b) as seen from a laser moved by shift (p, 2), m, its heading kept; at most reach, m."""
    x = profile * np.cos(angles) - shift[:, :1]
    y = profile * np.sin(angles) - shift[:, 1:]
    moved = np.arctan2(y, x)
    # The same turn of the circle as before; what is hidden now keeps the order of the beams.
    moved = angles + se2.wrap_angle(moved - angles)
    order = np.sign(angles[-1] - angles[0])
    moved = order * np.maximum.accumulate(order * moved, axis=1)
    ranges = np.where(profile >= reach, reach, np.minimum(np.hypot(x, y), reach))
    return np.stack([np.interp(order * angles, order * a, r) for a, r in zip(moved, ranges, strict=True)])
