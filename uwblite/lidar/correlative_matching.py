"""Correlative scan matching: the pose of a cloud in another one when the guess may be wrong by metres and tens of degrees.

The target becomes a field that at each cell holds exp(-d^2 / 2 spread^2) times the nearest surface's normal as a complex
number; the source becomes an image of its normals. For one heading the scores of all shifts are one correlation,

    score(T) = mean over source points of exp(-d^2 / 2 spread^2) cos(angle between normals),

computed by FFT of its two components, or for few shifts one by one, as in Olson, Real-time correlative scan matching, ICRA
2009. A wall seen from its other side lowers the score. Every pose of the grid is scored; none is pruned.
"""

from dataclasses import dataclass
from itertools import product
from typing import ClassVar

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from .. import se2
from ..arrays import TINY, Floats, Ints
from ..config import setting
from ..graph.work import SCORES
from .cloud_rasters import rasterize, surface_field
from .clouds import Clouds

Singles = NDArray[np.float32]

Window = tuple[float, float, float]
"""Half widths of a grid of poses in x and y, m, and heading, rad."""

_CELLS_PER_REACH = 4
_NEIGHBOURS = np.array([offset for offset in product((0, 1, 2), repeat=3) if offset != (1, 1, 1)])
"""(26, 3) of a cell in the middle of three by three by three."""
_TRANSFORM = 6
"""Scores of single points that take as long as the transforms of one cell of an image."""


@dataclass(frozen=True, slots=True)
class CorrelativeConfig:
    """Grid of poses, and how candidates are chosen by their scores."""

    resolution: float = setting(0.15, above=0.0, advanced=True)
    """Step of x and y, m; time goes with its inverse square."""
    angle_step: float = setting(0.03, above=0.0, advanced=True)
    """Step of the heading, rad; at the source's far points about the resolution."""
    spread: float = setting(0.12, above=0.0, advanced=True)
    """Standard deviation of a point about the target's surface, m; about the resolution."""
    candidates: int = setting(5, minimum=1, advanced=True)
    """Most poses that are returned."""
    separation: float = setting(0.5, advanced=True)
    """m; poses closer than that and than separation_angle are one candidate."""
    separation_angle: ClassVar[float] = 0.2
    """rad."""
    least_share: ClassVar[float] = 0.5
    """Of the best score, that another candidate must reach."""


def search(
    target: Clouds, source: Clouds, T_target_source: Floats, window: Window, config: CorrelativeConfig | None = None
) -> Floats:
    """Return the poses (c, 3) around a guess of one cloud in another at which their score peaks; the best first, or none."""
    config = config or CorrelativeConfig()
    scores, headings, shift_x, shift_y = score_grid(target, source, T_target_source, window, config)
    turn, row, column = _peaks(scores, config).T
    shift = np.stack([shift_x[column], shift_y[row]], axis=1) * config.resolution
    return np.column_stack([T_target_source[:2] + shift, se2.wrap_angle(headings[turn])])


def score_grid(
    target: Clouds, source: Clouds, T_target_source: Floats, window: Window, config: CorrelativeConfig
) -> tuple[Singles, Floats, Ints, Ints]:
    """Return the scores (h, r, c) of a grid by heading, y and x, headings (h,), rad, and shifts in x (c,) and y (r,), cells."""
    from scipy import fft  # most recordings that are only checked need no search

    steps = np.array([config.resolution, config.resolution, config.angle_step])
    wide, tall, turns = np.ceil(np.array(window) / steps - TINY).astype(np.intp).tolist()
    headings = T_target_source[2] + np.arange(-turns, turns + 1) * config.angle_step
    shift_x, shift_y = np.arange(-wide, wide + 1), np.arange(-tall, tall + 1)
    scores = np.zeros((len(headings), len(shift_y), len(shift_x)), np.float32)
    raster, reach = rasterize(target, config.resolution, _CELLS_PER_REACH * config.resolution), np.array([tall, wide])
    field = surface_field(raster, config.spread).T
    parts = [np.ascontiguousarray(part) for part in (field.real, field.imag)]
    turned = _turned(source, T_target_source[:2] - raster.origin[0], headings, config.resolution, -reach, field.shape + reach)
    ends = np.array([end(cell, axis=1) for cell, _ in turned if cell.size for end in (np.min, np.max)], dtype=np.intp)
    if not len(ends):
        return scores, headings, shift_x, shift_y
    # None may wrap around onto the field.
    least = np.maximum(field.shape + np.maximum(reach - ends.min(axis=0), 0), ends.max(axis=0) + reach + 1)
    shape = tuple(fft.next_fast_len(int(size), real=True) for size in least)
    one_by_one = len(source.points) * scores[0].size < _TRANSFORM * np.prod(shape)
    if one_by_one:
        around = [(2 * side, 2 * side) for side in reach.tolist()]
        windows = [sliding_window_view(np.pad(part, around), scores[0].shape) for part in parts]
    else:
        spectra = [fft.rfft2(part, shape) for part in parts]
    for k, (cell, normals) in enumerate(turned):
        if one_by_one:
            target.work[SCORES] += cell.shape[1] * scores[k].size
            at = tuple(cell + reach[:, None])
            for normal, shifted in zip(normals.T, windows, strict=True):
                scores[k] += np.tensordot(normal, shifted[at], axes=1)
        else:
            target.work[SCORES] += int(np.prod(shape))
            number = np.ravel_multi_index(tuple(cell), shape, mode="wrap")
            images = (np.bincount(number, normal, np.prod(shape)).reshape(shape) for normal in normals.T)
            x, y = (np.conj(fft.rfft2(image.astype(np.float32))) * of for image, of in zip(images, spectra, strict=True))
            scores[k] = fft.irfft(fft.ifft(x + y, axis=0)[shift_y], shape[1], axis=1)[:, shift_x]
    scores /= len(source.points)
    return scores, headings, shift_x, shift_y


def _turned(
    source: Clouds, place: Floats, headings: Floats, cell: float, low: Ints, high: Ints
) -> list[tuple[Ints, Singles]]:
    """Return for each heading (h,) the cells (2, n), y and x, of the points that lie from low (2,) to below high (2,), and
    their normals (n, 2), the source's frame being at a place (2,), m."""
    found = []
    for heading in headings:
        x, y = np.floor(se2.transform([*place, heading], source.points).T / cell).astype(np.intp)
        own = np.flatnonzero((y >= low[0]) & (y < high[0]) & (x >= low[1]) & (x < high[1]))
        found.append((np.stack([y[own], x[own]]), se2.rotate(heading, source.normals[own]).astype(np.float32)))
    return found


def _peaks(scores: Singles, config: CorrelativeConfig) -> Ints:
    """Return indices (c, 3) of local maxima, the best first, none within the separation of a better one."""
    peaks = np.argwhere((scores >= config.least_share * scores.max(initial=0.0)) & (scores > 0.0))
    padded = np.pad(scores, 1)
    for offset in _NEIGHBOURS:
        peaks = peaks[scores[tuple(peaks.T)] >= padded[tuple((peaks + offset).T)]]
    peaks = peaks[np.argsort(-scores[tuple(peaks.T)], kind="stable")]
    unit = np.array([config.separation_angle / config.angle_step, *[config.separation / config.resolution] * 2])
    chosen: list[Ints] = []
    while len(peaks) and len(chosen) < config.candidates:
        chosen.append(peaks[0])
        peaks = peaks[(np.abs(peaks - peaks[0]) >= unit).any(axis=1)]
    return np.array(chosen, dtype=np.intp).reshape(-1, scores.ndim)
