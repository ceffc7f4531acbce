"""Checks of the scans: rhythm, valid beams, units, field of view, and whether laser and wheels agree on turning."""

from typing import Any

import numpy as np

from ..arrays import Floats
from ..lidar.laser_mounting import compare
from ..screening import wheel_motion
from ..sensor_log import SensorLog
from .findings import Findings, timing


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
    hit = scans.hits(sample)
    figures["share of beams that hit"] = round(float(hit.mean()), 3)
    figures["share that saw nothing"] = round(float(np.isposinf(sample).mean()), 3)
    figures["share that is invalid"] = round(float(np.isnan(sample).mean()), 3)
    _check_units(sample[hit], found)
    _check_valid(figures, found)
    if beams >= 30 and len(scans.stamps) >= 20:
        figures["turning"] = _check_turning(log, found)
    return figures


def _check_units(seen: Floats, found: Findings) -> None:
    if len(seen) and np.quantile(seen, 0.95) < 0.05:
        found.serious("lidar", f"95 % of the readings are below {np.quantile(seen, 0.95):.3f} m", "check the unit: metres")
    if len(seen) and np.ptp(seen) == 0.0:
        found.serious("lidar", "all readings are equal", "the laser is off, covered, or not the laser")


def _check_valid(figures: dict[str, Any], found: Findings) -> None:
    share = figures["share of beams that hit"]
    if share < 0.1:
        found.warning(
            "lidar",
            f"only {100 * share:.0f} % of the beams hit anything within {figures['range max m']:.1f} m",
            "the place is wider than the laser reaches: drive along the walls; in the middle only ranges constrain the pose",
        )
    elif figures["share that is invalid"] > 0.4:
        found.note(
            "lidar",
            f"{100 * figures['share that is invalid']:.0f} % of the readings are error codes",
            "dark or slanting surfaces; they are left out and clear no space",
        )


def _check_turning(log: SensorLog, found: Findings) -> dict[str, float]:
    turning = compare(log)
    if turning is None:
        found.note("lidar", "the robot hardly turns in place", "clock offset and mounting of the laser cannot be checked")
        return {}
    figures = {
        "pairs": turning.pairs,
        "misfit rad": round(turning.as_given, 4),
        "misfit if mounted the other way up rad": round(turning.other, 4),
        "laser_delay s": round(turning.delay, 3),
    }
    if not turning.agree:
        found.warning(
            "lidar",
            f"laser and wheels disagree on turning (typically by {turning.misfit:.2f} rad of {turning.typical:.2f} rad)",
            "check the stamps, the beam order and the wheels' heading",
        )
        return figures
    if abs(turning.delay) > 0.06 and turning.delay_clear:
        found.warning(
            "lidar",
            f"the laser's stamps are {abs(turning.delay):.2f} s too {'early' if turning.delay > 0.0 else 'late'} for the "
            f"odometry's clock (laser_delay {turning.delay:+.2f} s, to be added to them)",
            "uwblite corrects small offsets; stamp both with one clock, each when its reading begins",
        )
    _check_scale(log, figures, found)
    return figures


def _check_scale(log: SensorLog, figures: dict[str, float], found: Findings) -> None:
    """Compare the turns of matched scans with the wheels': shifts of beams are too coarse where the laser has few."""
    pairs = wheel_motion.compare(log)
    ratio, sigma = (float("nan"), float("nan")) if pairs is None else wheel_motion.turn_ratio(pairs)
    if not ratio > 0.0:
        return
    figures["turn by laser / turn by wheels"] = round(ratio, 3)
    if abs(ratio - 1.0) > max(0.12, 4.0 * sigma):
        found.warning(
            "odometry",
            f"the wheels measure about {1.0 / ratio:.2f} times the turns of the laser",
            "set the track width of the base; uwblite corrects it where the recording shows it",
        )
