"""Checks of the wheels: rhythm, motion, units, axes, jumps, and whether the path can place anchors at all."""

from typing import Any

import numpy as np

from .. import se2
from ..arrays import Floats
from ..sensor_log import Odometry
from .findings import Findings, timing

FASTEST = 3.0
"""A ground robot of this kind is not faster, m/s."""
FASTEST_TURN = 8.0
"""Nor does it turn faster, rad/s."""
SHORTEST_PATH = 2.0
"""A shorter drive shows little of anything, m."""
STRAIGHT = 0.02
"""Width of the path by its length below which the two sides of it cannot be told apart."""


def check_odometry(odometry: Odometry, found: Findings) -> dict[str, Any]:
    """Check the wheels and return their figures."""
    figures: dict[str, Any] = timing(odometry.stamps, "odometry", found, expected_gap=0.5)
    steps = se2.between(odometry.poses[:-1], odometry.poses[1:])
    length = np.hypot(steps[:, 0], steps[:, 1])
    span = np.diff(odometry.stamps)
    moving = (length > 1e-6) & (span > 0)
    speed = float(np.median(length[moving] / span[moving])) if moving.any() else 0.0
    figures["path m"] = round(float(length.sum()), 3)
    figures["turned rad"] = round(float(np.abs(steps[:, 2]).sum()), 3)
    figures["speed m/s"] = round(speed, 4)
    _check_motion(length, speed, odometry, found)
    _check_jumps(length, np.abs(steps[:, 2]), span, odometry.stamps, found)
    figures["heading"] = _check_heading(odometry, length, found)
    figures["width of the path by its length"] = round(_straightness(odometry.poses[:, :2]), 4)
    if figures["rate Hz"] and figures["rate Hz"] < 5.0:
        found.warning(
            "odometry",
            f"only {figures['rate Hz']:.1f} readings a second",
            "ranges and rays are placed between them by interpolation; 10 Hz or more is better",
        )
    return figures


def _check_motion(length: Floats, speed: float, odometry: Odometry, found: Findings) -> None:
    path = float(length.sum())
    if path < SHORTEST_PATH:
        turned = float(np.ptp(np.unwrap(odometry.poses[:, 2])))
        found.serious(
            "odometry",
            f"the robot hardly moves: {path:.2f} m in {np.ptp(odometry.stamps):.0f} s (turning {turned:.1f} rad)",
            "check that the base reports its wheels, and its unit (metres); drive through the place",
        )
    elif speed > 10.0 * FASTEST:
        found.serious(
            "odometry",
            f"the usual speed is {speed:.0f} m/s: the positions look like millimetres or centimetres",
            "write metres into the log; uwblite convert has unit factors",
        )
    elif speed < 0.004:
        found.warning("odometry", f"the usual speed is {1000 * speed:.2f} mm/s", "check the unit: positions must be metres")


def _check_jumps(length: Floats, turn: Floats, span: Floats, stamps: Floats, found: Findings) -> None:
    time = np.maximum(span, 0.02)
    typical = max(float(np.median(length[length > 0] / time[length > 0])) if np.any(length > 0) else 0.0, 0.1)
    jumps = np.flatnonzero(
        ((length > 0.3) & (length / time > max(FASTEST, 10.0 * typical))) | (turn / time > 2.0 * FASTEST_TURN)
    )
    if len(jumps):
        where = ", ".join(f"{stamps[k] - stamps[0]:.1f}" for k in jumps[:5])
        found.add(
            "serious" if len(jumps) > 3 else "warning",
            "odometry",
            f"{len(jumps)} jumps (the largest {length[jumps].max():.2f} m) at t = {where}{' ...' if len(jumps) > 5 else ''} s",
            "the base was reset or carried, or messages are lost; cut the recording there, or raise the odometry's noise",
        )


def _check_heading(odometry: Odometry, length: Floats, found: Findings) -> dict[str, float]:
    """Compare the heading with the direction of motion: they agree, forwards or backwards, for wheels that do not slide.

    The agreement is |mean exp(2 i (direction - heading))|, which is 1 for perfect wheels and near 0 for a wrong unit.
    """
    apart = _spread_out(odometry.poses[:, :2], length)
    if len(apart) < 12:
        return {}
    move = np.diff(odometry.poses[apart, :2], axis=0)
    direction = np.arctan2(move[:, 1], move[:, 0])
    heading = 0.5 * (
        odometry.poses[apart[:-1], 2]
        + odometry.poses[apart[:-1], 2]
        + se2.wrap_angle(odometry.poses[apart[1:], 2] - odometry.poses[apart[:-1], 2])
    )
    weight = np.hypot(move[:, 0], move[:, 1])

    def agreement(factor: float) -> float:
        return float(np.abs(np.sum(weight * np.exp(2j * (direction - factor * heading)))) / np.sum(weight))

    plain, mirrored, degrees = agreement(1.0), agreement(-1.0), agreement(np.pi / 180.0)
    varied = float(np.abs(np.sum(weight * np.exp(2j * direction))) / np.sum(weight)) < 0.9
    if varied and plain < 0.7:
        if mirrored > plain + 0.2:
            found.serious(
                "odometry",
                f"the heading turns against the path (agreement {plain:.2f}, mirrored {mirrored:.2f})",
                "x forward, y left, angles counter-clockwise: change the sign of y or of the heading",
            )
        elif degrees > plain + 0.2:
            found.serious(
                "odometry",
                f"the heading looks like degrees (agreement {degrees:.2f} against {plain:.2f})",
                "headings must be radians",
            )
        else:
            found.warning(
                "odometry",
                f"the robot often moves across its heading (agreement {plain:.2f} of 1)",
                "right for an omnidirectional base; otherwise check the heading's unit and sign",
            )
    return {"agreement with the motion": round(plain, 3)}


def _spread_out(xy: Floats, length: Floats, distance: float = 0.2) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Return samples about a distance apart along the path, m."""
    piece = np.floor(np.concatenate([[0.0], np.cumsum(length)]) / distance)
    return np.flatnonzero(np.diff(piece, prepend=-1.0) > 0)


def _straightness(xy: Floats) -> float:
    """Return the width of the path by its length: ratio of the standard deviations along its principal axes."""
    values = np.linalg.eigvalsh(np.cov(xy.T)) if len(xy) > 2 else np.zeros(2)
    return float(np.sqrt(max(values[0], 0.0) / values[1])) if values[1] > 0 else 0.0
