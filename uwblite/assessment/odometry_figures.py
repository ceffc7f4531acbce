"""The rhythm of a sensor, and figures of the wheels, before a map is made; and what they show."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from ..arrays import Floats
from ..findings import NOTE, WARNING, Finding
from ..screening.units import CLEARLY, heading_agreement, heading_reading
from ..sensor_log import Odometry

FINEST = 1.5e-6
"""s; stamps are written no finer than 1e-6, which `record` puts between rows that came in one piece: no time lies between."""
_SOME = 0.02
"""Share of the time in silences, or of equal stamps, from which on they cost accuracy."""
_LONG = 5.0
"""s; a single silence that costs accuracy."""


def rhythm(stamps: Floats, *, expected_gap: float, repeated: float | None = None) -> dict[str, float]:
    """Return the figures of a sensor's rhythm.

    Parameters
    ----------
    stamps : (n,) s, non-decreasing.
    expected_gap : a silence longer than this is a gap, s (or five periods, where that is longer).
    repeated : share of equal stamps that is not right, where some are; None = any is wrong.
    """
    steps = np.diff(stamps)
    some = steps > FINEST
    period = float(np.median(steps[some])) if some.any() else 0.0
    gap = max(expected_gap, 5.0 * period)
    longest = int(np.argmax(steps)) if len(steps) else 0
    equal = float(np.mean(~some)) if len(steps) else 0.0
    return {
        "count": len(stamps),
        "duration s": round(float(stamps[-1] - stamps[0]), 3),
        "rate Hz": round(1.0 / period, 3) if period else 0.0,
        "longest gap s": round(float(steps.max(initial=0.0)), 3),
        "longest gap at s": round(float(stamps[longest] - stamps[0]), 3),
        "gaps": int(np.sum(steps > gap)),
        "gaps longer than s": round(gap, 3),
        "silent s": round(float(steps[steps > gap].sum()), 3),
        "share of equal stamps": round(equal, 4),
        "share of wrongly equal stamps": round(equal if repeated is None else repeated, 4),
    }


def check_silences(sensor: str, figures: dict[str, Any]) -> Iterator[Finding]:
    """Say when a sensor was silent; a warning where that is for long, or for much of the recording."""
    if not figures["gaps"]:
        return
    much = figures["silent s"] > _SOME * figures["duration s"] or figures["longest gap s"] > _LONG
    text = (
        f"{figures['gaps']} silences longer than {figures['gaps longer than s']:.1f} s; the longest is "
        f"{figures['longest gap s']:.1f} s at t = {figures['longest gap at s']:.1f} s"
    )
    cure = "check cable, power and processor load at these times"
    yield Finding("silences", WARNING if much else NOTE, text, cure, sensor)


def check_equal_stamps(sensor: str, figures: dict[str, Any]) -> Iterator[Finding]:
    """Warn of stamps that equal the one before: of low resolution, or of readings that arrived in one piece."""
    share = figures["share of wrongly equal stamps"]
    if share > _SOME:
        text = f"{100 * share:.0f} % of the stamps equal the one before"
        cure = "stamps of low resolution, or readings that arrived in one piece: stamp each reading when it is made"
        yield Finding("equal-stamps", NOTE if sensor == "radio" else WARNING, text, cure, sensor)


STRAIGHT = 0.02
"""Width of the path by its length below which the two sides of it cannot be distinguished."""
_SLOWEST = 5.0
"""Hz; ranges and rays between two readings that are farther apart are placed badly at usual speeds."""


def odometry_figures(odometry: Odometry) -> dict[str, Any]:
    """Return rhythm, path and speed of the wheels."""
    figures: dict[str, Any] = rhythm(odometry.stamps, expected_gap=0.5)
    steps = odometry.steps
    length, span = np.hypot(steps[:, 0], steps[:, 1]), np.diff(odometry.stamps)
    moving = (length > 1e-6) & (span > 0)
    speed = float(np.median(length[moving] / span[moving])) if moving.any() else 0.0
    figures["path m"] = round(float(length.sum()), 3)
    figures["turned rad"] = round(float(np.abs(steps[:, 2]).sum()), 3)
    figures["speed m/s"] = round(speed, 4)
    figures["heading"] = {"agreement with the motion": round(heading_agreement(odometry)[0], 3)}
    figures["width of the path by its length"] = round(straightness(odometry.poses[:, :2]), 4)
    return figures


def check_odometry(odometry: Odometry, figures: dict[str, Any]) -> Iterator[Finding]:
    """Yield what the figures of the wheels show; the screening says whether the robot drove on during a silence."""
    yield from (replace(finding, severity=NOTE) for finding in check_silences("odometry", figures))
    yield from check_equal_stamps("odometry", figures)
    yield from check_motion_along_heading(odometry)
    if figures["rate Hz"] and figures["rate Hz"] < _SLOWEST:
        text = f"only {figures['rate Hz']:.1f} readings a second"
        cure = "ranges and rays are placed between them by interpolation; 10 Hz or more is better"
        yield Finding("slow-odometry", WARNING, text, cure, "odometry")


def check_motion_along_heading(odometry: Odometry) -> Iterator[Finding]:
    """Warn of a robot that moves across its heading, where neither another sign nor another unit explains that."""
    reading = heading_reading(odometry)
    if not reading.sound and max(reading.mirrored, reading.degrees) < reading.plain + CLEARLY:
        text = f"the robot often moves across its heading (agreement {reading.plain:.2f} of 1)"
        cure = "right for an omnidirectional base; otherwise check the heading's unit and sign, and the axes"
        yield Finding("moves-across-heading", WARNING, text, cure, "odometry")


def straightness(xy: Floats) -> float:
    """Return the width of the path by its length: ratio of the standard deviations along its principal axes."""
    values = np.linalg.eigvalsh(np.cov(xy.T)) if len(xy) > 2 else np.zeros(2)
    return float(np.sqrt(max(values[0], 0.0) / values[1])) if values[1] > 0 else 0.0
