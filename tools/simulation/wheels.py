"""Odometry of a differential drive whose wheels and track differ a little from its settings."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .drive import Motion

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class WheelErrors:
    """Faults of the odometry; `draw` gives those of one robot."""

    distance_scale: float
    """Reported distance / true distance."""
    heading_scale: float
    """Reported turn / true turn (wrong track width)."""
    drift: float
    """Reported turn per metre of straight travel, rad/m (unequal wheels)."""
    distance_noise: float
    """sd of the reported distance after 1 m, m; grows with the square root of the way."""
    heading_noise_travel: float
    """sd of the reported heading after 1 m, rad; grows with the square root of the way."""
    heading_noise_turn: float
    """sd of the reported heading after turning 1 rad, rad; grows with the square root of the turn."""


def draw_errors(rng: np.random.Generator, scale: float) -> WheelErrors:
    """Draw the faults of one robot: fixed magnitudes within +-25 %, signs at random, all times `scale`."""

    def about(value: float) -> float:
        return float(scale * value * rng.uniform(0.75, 1.25) * rng.choice([-1.0, 1.0]))

    return WheelErrors(
        distance_scale=1.0 + about(0.02),
        heading_scale=1.0 + about(0.015),
        drift=about(0.0038),
        distance_noise=0.02 * scale,
        heading_noise_travel=0.02 * scale,
        heading_noise_turn=0.02 * scale,
    )


def draw_slips(motion: Motion, rng: np.random.Generator, count: int, spin: float = 0.0) -> list[dict[str, float]]:
    """Draw wheel slips while driving: over `seconds` the wheels count way and turn that the robot did not make.

    Parameters
    ----------
    spin : m/s that wheels count beyond the robot's own motion where they spin for seconds; 0 = they slip for a moment.
    """
    speed = np.hypot(*np.gradient(motion.poses[:, :2], motion.stamps, axis=0).T)
    moving = motion.stamps[speed > 0.8 * speed.max()]
    if spin > 0.0:
        return [
            {
                "start": round(float(start), 2),
                "seconds": (seconds := round(float(rng.uniform(2.0, 6.0)), 2)),
                "heading": round(float(seconds * rng.uniform(0.1, 0.4) * rng.choice([-1.0, 1.0])), 3),
                "distance": round(float(seconds * spin * rng.uniform(0.7, 1.0)), 3),
            }
            for start in np.sort(rng.choice(moving, size=count, replace=False))
        ]
    return [
        {
            "start": round(float(start), 2),
            "seconds": round(float(rng.uniform(0.7, 1.5)), 2),
            "heading": round(float(rng.uniform(0.15, 0.5) * rng.choice([-1.0, 1.0])), 3),
            "distance": round(float(rng.uniform(0.08, 0.25)), 3),
        }
        for start in np.sort(rng.choice(moving, size=count, replace=False))
    ]


def odometry(
    motion: Motion,
    stamps: Floats,
    errors: WheelErrors,
    slips: list[dict[str, float]],
    rng: np.random.Generator,
    floor: tuple[Floats, Floats] | None = None,
) -> Floats:
    """Return the odometry poses (n, 3) at the stamps (n,): T_odom_base, beginning at the origin; theta unwrapped.

    The floor adds to way, m, and turn, rad, of each step (n - 1,).
    """
    true = motion.at(stamps)
    turn = np.diff(true[:, 2])
    heading = true[:-1, 2] + 0.5 * turn
    step = np.diff(true[:, :2], axis=0)
    way = step[:, 0] * np.cos(heading) + step[:, 1] * np.sin(heading)
    n = len(way)
    wheel_way = errors.distance_scale * way + errors.distance_noise * np.sqrt(np.abs(way)) * rng.standard_normal(n)
    variance = errors.heading_noise_travel**2 * np.abs(way) + errors.heading_noise_turn**2 * np.abs(turn)
    wheel_turn = errors.heading_scale * turn + errors.drift * way + np.sqrt(variance) * rng.standard_normal(n)
    if floor is not None:
        wheel_way, wheel_turn = wheel_way + floor[0], wheel_turn + floor[1]
    for slip in slips:
        during = (stamps[:-1] >= slip["start"]) & (stamps[:-1] < slip["start"] + slip["seconds"])
        wheel_turn[during] += slip["heading"] / max(1, during.sum())
        wheel_way[during] += slip["distance"] / max(1, during.sum())
    theta = np.concatenate([[0.0], np.cumsum(wheel_turn)])
    middle = theta[:-1] + 0.5 * wheel_turn
    x = np.concatenate([[0.0], np.cumsum(wheel_way * np.cos(middle))])
    y = np.concatenate([[0.0], np.cumsum(wheel_way * np.sin(middle))])
    return np.stack([x, y, theta], axis=1)
