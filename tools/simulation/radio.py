"""Ranges of a DWM1001 tag: distances with errors that are noise only in part.

range = scale * distance + bias(anchor) + multipath(anchor, place) + antenna(directions) + excess(occlusion) + noise.

Multipath is a smooth random field in space: standing still or driving slowly, the same wrong answer comes again and again.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from .fields import smooth_field

Floats = NDArray[np.float64]

NLOS_LEVELS: dict[str, tuple[float, float, float]] = {
    "off": (0.0, 0.0, 0.0),
    "light": (0.10, 0.0, 0.1),
    "normal": (0.30, 0.0, 0.3),
    "heavy": (0.80, 0.6, 0.4),
}
"""Mean excess behind an obstacle, m; share of the floor that is shadowed by unseen things; share of shadowed ranges lost."""


@dataclass(frozen=True)
class RadioModel:
    """Error sizes of the ranges."""

    noise_sd: float = 0.03
    """m, independent from range to range."""
    bias_sd: float = 0.06
    """m, constant per anchor."""
    multipath_sd: float = 0.06
    """m, smooth over the floor."""
    multipath_length: float = 1.5
    """m, distance over which the multipath error stays alike."""
    antenna_sd: float = 0.03
    """m, by the direction in which either antenna is hit."""
    scale: float = 1.0
    """Range reported / distance."""
    loss: float = 0.20
    """Share of the ranges lost for no reason."""
    per_epoch: int = 4
    """The most anchors a tag ranges to at once."""
    max_range: float = 60.0
    """m."""


def antenna_pattern(rng: np.random.Generator, angle: Floats) -> Floats:
    """Return a periodic function of the direction (n,), rad, of unit variance on average."""
    size, phase = rng.standard_normal(3) / np.sqrt(1.5), rng.uniform(0.0, 2.0 * np.pi, 3)
    return sum(size[k] * np.cos((k + 1) * angle + phase[k]) for k in range(3))


def crossings(tags: Floats, anchor: Floats, walls: Floats, columns: Floats) -> Floats:
    """Return how many obstacles stand between tags (n, 2) and an anchor (2,); two walls of a box count as one obstacle."""
    ray = anchor - tags
    count = np.zeros(len(tags))
    for x1, y1, x2, y2 in walls:
        e, a = np.array([x2 - x1, y2 - y1]), np.array([x1, y1]) - tags
        cross = ray[:, 0] * e[1] - ray[:, 1] * e[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (a[:, 0] * e[1] - a[:, 1] * e[0]) / cross
            u = (a[:, 0] * ray[:, 1] - a[:, 1] * ray[:, 0]) / cross
        count += 0.5 * ((t > 0) & (t < 1) & (u >= 0) & (u <= 1))
    length2 = np.maximum((ray * ray).sum(axis=1), 1e-12)
    for k in range(columns.shape[-2]):
        centre, radius = columns[..., k, :2], columns[..., k, 2]
        u = np.clip(((centre - tags) * ray).sum(axis=1) / length2, 0.0, 1.0)
        count += np.hypot(*(tags + u[:, None] * ray - centre).T) < radius
    return count


def excess(
    shadow: Floats, points: Floats, level: str, rng: np.random.Generator, there: np.random.Generator | None = None
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the extra length (n,), m, of shadowed ranges and which of them are lost.

    The excess is exponentially distributed and mostly the same for a slow robot behind the same obstacle; `there` draws
    what stays with the place.
    """
    there = rng if there is None else there
    mean, unseen, lost = NLOS_LEVELS[level]
    patch = smooth_field(there, points, 2.0)
    shadow = np.maximum(shadow, (ndtr(patch) < unseen).astype(np.float64))
    correlated = 0.8 * smooth_field(there, points, 0.7) + 0.6 * rng.standard_normal(len(points))
    depth = np.minimum(shadow, 2.0)
    extra = depth * mean * (0.2 - 0.8 * np.log(np.clip(1.0 - ndtr(correlated), 1e-3, 1.0)))
    return extra, rng.random(len(points)) < 1.0 - (1.0 - lost) ** depth
