"""Correlative matching over a small window: every pose of a grid scored by looking its points up in a raster.

For windows of about a metre this is several times quicker than the correlation by FFT of correlative_matching, whose
score it shares (after Olson, Real-time correlative scan matching, ICRA 2009).
"""

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from .. import se2
from ..arrays import Floats, Ints
from ..graph.work import SCORES
from .cloud_rasters import CloudRasters, surface_field
from .clouds import Clouds

_LEAST_SHARE = 0.5
"""Of the best score, that another local maximum must reach."""
_SEPARATION = (4, 3, 3)
"""Steps of heading, x and y within which a better pose hides others."""


@dataclass(frozen=True, slots=True)
class Window:
    """Grid of poses around a guess; its step in x and y is the raster's cell."""

    distance: float
    """Half-width in x and y, m."""
    angle: float
    """Half-width in heading, rad."""
    angle_step: float = 0.04
    """Step of the heading, rad; at 3 m about the step in x and y."""
    spread: float = 0.12
    """Standard deviation of a point about the target's surface, m; about the step."""


def best_poses(clouds: Clouds, raster: CloudRasters, rows: Ints, guess: Floats, window: Window, count: int) -> Floats:
    """Score all poses around a guess at which a cloud may lie on cloud 0 and return the best local maxima.

    score = mean over source points of exp(-d^2 / 2 spread^2) cos(angle between normals), d = distance to the nearest point.

    Parameters
    ----------
    clouds, raster : the target is cloud 0. rows : (p,) source points in the clouds' arrays. guess : (3,) T_target_source.
    count : most poses that are returned.

    Returns
    -------
    (c, 3) poses of the grid, the best first.
    """
    if not len(rows) or not raster.shape[0].prod():
        return np.zeros((0, 3))
    field = surface_field(clouds, raster, window.spread).reshape(raster.shape[0])
    turns, half = int(np.ceil(window.angle / window.angle_step)), int(np.ceil(window.distance / raster.cell))
    shift, many = np.arange(-half, half + 1), 2 * half + 1
    # What all shifts of a point meet is a window of the field: there is nothing around it.
    windows = sliding_window_view(np.pad(field, many), (many, many))
    headings = guess[2] + np.arange(-turns, turns + 1) * window.angle_step
    points = clouds.points[rows].astype(np.float64)
    normals = (clouds.normals[rows, 0] - 1j * clouds.normals[rows, 1]).astype(np.complex64)
    scores = np.empty((len(headings), len(shift), len(shift)), np.float32)
    raster.work[SCORES] += scores.size * len(rows)
    for n, heading in enumerate(headings):
        laid = se2.transform(np.array([guess[0], guess[1], heading]), points)
        cell = np.floor((laid - raster.origin[0]) / raster.cell).astype(np.intp)
        x, y = np.clip(cell + (many - half), 0, np.subtract(windows.shape[:2], 1)).T
        seen = windows[x, y].reshape(len(rows), -1)
        scores[n] = ((normals * np.complex64(np.exp(-1j * heading))) @ seen).real.reshape(scores.shape[1:])
    best = _maxima(scores, count)
    return np.column_stack([guess[:2] + shift[best[:, 1:]] * raster.cell, headings[best[:, 0]]])


def _maxima(scores: NDArray[np.float32], count: int) -> Ints:
    """Return indices (c, 3) of the best scores, none within the separation of a better one."""
    left = scores.copy()
    chosen: list[tuple[np.intp, ...]] = []
    least = _LEAST_SHARE * float(scores.max(initial=0.0))
    while len(chosen) < count:
        top = np.unravel_index(int(np.argmax(left)), left.shape)
        if left[top] <= least:
            break
        chosen.append(top)
        left[tuple(slice(max(0, t - w), t + w + 1) for t, w in zip(top, _SEPARATION, strict=True))] = 0.0
    return np.array(chosen, dtype=np.intp).reshape(-1, 3)
