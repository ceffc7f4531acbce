"""Checks of the wheels: rhythm, motion, axes, and whether the path can place anchors at all."""

from typing import Any

import numpy as np

from ..arrays import Floats
from ..screening.units import heading_agreement
from ..sensor_log import Odometry
from .findings import Findings, timing

STRAIGHT = 0.02
"""Width of the path by its length below which the two sides of it cannot be distinguished."""


def check_odometry(odometry: Odometry, found: Findings) -> dict[str, Any]:
    """Check the wheels and return their figures."""
    figures: dict[str, Any] = timing(odometry.stamps, "odometry", found, expected_gap=0.5)
    steps = odometry.steps
    length = np.hypot(steps[:, 0], steps[:, 1])
    span = np.diff(odometry.stamps)
    moving = (length > 1e-6) & (span > 0)
    speed = float(np.median(length[moving] / span[moving])) if moving.any() else 0.0
    figures["path m"] = round(float(length.sum()), 3)
    figures["turned rad"] = round(float(np.abs(steps[:, 2]).sum()), 3)
    figures["speed m/s"] = round(speed, 4)
    if 0.0 < speed < 0.004:
        found.warning("odometry", f"the usual speed is {1000 * speed:.2f} mm/s", "check the unit: positions must be metres")
    figures["heading"] = _check_heading(odometry, found)
    figures["width of the path by its length"] = round(straightness(odometry.poses[:, :2]), 4)
    if figures["rate Hz"] and figures["rate Hz"] < 5.0:
        found.warning(
            "odometry",
            f"only {figures['rate Hz']:.1f} readings a second",
            "ranges and rays are placed between them by interpolation; 10 Hz or more is better",
        )
    return figures


def _check_heading(odometry: Odometry, found: Findings) -> dict[str, float]:
    """Compare the heading with the direction of motion; the screening finds a wrong unit or sign."""
    plain, varied = heading_agreement(odometry)
    others = (heading_agreement(odometry, -1.0)[0], heading_agreement(odometry, np.pi / 180.0)[0])
    if varied and plain < 0.7 and max(others) < plain + 0.2:
        found.warning(
            "odometry",
            f"the robot often moves across its heading (agreement {plain:.2f} of 1)",
            "right for an omnidirectional base; otherwise check the heading's unit and sign",
        )
    return {"agreement with the motion": round(plain, 3)}


def straightness(xy: Floats) -> float:
    """Return the width of the path by its length: ratio of the standard deviations along its principal axes."""
    values = np.linalg.eigvalsh(np.cov(xy.T)) if len(xy) > 2 else np.zeros(2)
    return float(np.sqrt(max(values[0], 0.0) / values[1])) if values[1] > 0 else 0.0
