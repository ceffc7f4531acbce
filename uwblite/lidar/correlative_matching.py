"""Correlative scan matching: the pose of a cloud in another one when the guess may be wrong by metres and tens of degrees.

The target becomes a field that at each cell holds exp(-d^2 / 2 spread^2) times the nearest surface's normal as a complex
number; the source becomes an image of its normals. For one heading the scores of all shifts are one correlation,

    score(T) = mean over source points of exp(-d^2 / 2 spread^2) cos(angle between normals),

computed by FFT (after Olson, Real-time correlative scan matching, ICRA 2009, which evaluates it shift by shift). A wall
seen from its other side lowers the score. Every pose of the grid is scored; none is pruned.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from .. import se2
from ..arrays import Floats, Ints
from ..config import setting
from ..graph.work import SCORES
from .cloud_rasters import rasterize, surface_field
from .clouds import Clouds

Singles = NDArray[np.float32]

_CELLS_PER_REACH = 4


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


@dataclass(frozen=True, slots=True, eq=False)
class SearchResult:
    """Peaks of the score, the best first."""

    poses: Floats
    """(c, 3) T_target_source; m, m, rad; on the grid."""
    scores: Floats
    """(c,) at most 1; mean agreement of the source's points."""


def search(
    target: Clouds,
    source: Clouds,
    T_target_source: Floats,
    window: tuple[float, float, float],
    config: CorrelativeConfig | None = None,
) -> SearchResult:
    """Score every pose of a grid around a guess and return the best few.

    Parameters
    ----------
    target, source : one cloud each, in its own frame.
    T_target_source : (3,) centre of the grid; m, m, rad.
    window : half widths of the grid in x, y, m, and heading, rad.

    Returns
    -------
    SearchResult; without candidates where nothing fits at all.
    """
    config = config or CorrelativeConfig()
    scores, headings, shift_x, shift_y = score_grid(target, source, T_target_source, window, config)
    found = _peaks(scores, config)
    poses = np.stack(
        [
            T_target_source[0] + shift_x[found[:, 2]] * config.resolution,
            T_target_source[1] + shift_y[found[:, 1]] * config.resolution,
            se2.wrap_angle(headings[found[:, 0]]),
        ],
        axis=-1,
    )
    return SearchResult(poses, scores[tuple(found.T)].astype(np.float64))


def score_grid(
    target: Clouds, source: Clouds, T_target_source: Floats, window: tuple[float, float, float], config: CorrelativeConfig
) -> tuple[Singles, Floats, Ints, Ints]:
    """Score every pose of the grid.

    Returns
    -------
    scores : (h, r, c) by heading, shift along y, shift along x.
    headings : (h,) rad.
    shift_x, shift_y : (c,), (r,) cells from the guess.
    """
    half = [int(np.ceil(w / config.resolution - 1e-9)) for w in window[:2]]
    turns = int(np.ceil(window[2] / config.angle_step - 1e-9))
    headings = T_target_source[2] + np.arange(-turns, turns + 1) * config.angle_step
    shift_x, shift_y = (np.arange(-n, n + 1) for n in half)
    scores = np.zeros((len(headings), len(shift_y), len(shift_x)), np.float32)
    if target.normals.any() and source.normals.any():
        raster = rasterize(target, config.resolution, _CELLS_PER_REACH * config.resolution)
        field = surface_field(target, raster, config.spread).reshape(raster.shape[0]).T
        # Points that no shift brings onto the field are left out; of the rest none may wrap around onto it.
        shape = tuple(fft.next_fast_len(field.shape[k] + 2 * half[1 - k]) for k in (0, 1))
        spectrum = fft.fft2(field, shape)
        normals = source.normals[:, 0] + 1j * source.normals[:, 1]
        for k, heading in enumerate(headings):
            image = _source_image(source, normals, heading, T_target_source, raster.origin[0], field.shape, half, shape, config)
            product = np.conj(fft.fft2(image)) * spectrum
            product *= np.complex64(np.exp(-1j * heading))
            rows = fft.ifft(product, axis=0)[shift_y]
            target.work[SCORES] += image.size
            scores[k] = fft.ifft(rows, axis=1)[:, shift_x].real
        scores /= len(source.points)
    return scores, headings, shift_x, shift_y


def _source_image(
    source: Clouds, normals: NDArray[np.complex128], heading: float, guess: Floats, origin: Floats,
    field: tuple[int, ...], half: list[int], shape: tuple[int, ...], config: CorrelativeConfig,
) -> NDArray[np.complex64]:
    """Return the source turned to the heading and put at the guess, its normals summed in the cells of the target's field."""
    c, s = np.cos(heading), np.sin(heading)
    x, y = source.points.T
    column = np.floor((c * x - s * y + guess[0] - origin[0]) / config.resolution).astype(np.intp)
    row = np.floor((s * x + c * y + guess[1] - origin[1]) / config.resolution).astype(np.intp)
    inside = (column >= -half[0]) & (column < field[1] + half[0]) & (row >= -half[1]) & (row < field[0] + half[1])
    cell = (row[inside] % shape[0]) * shape[1] + column[inside] % shape[1]
    image = np.empty(shape[0] * shape[1], np.complex64)
    image.real = np.bincount(cell, normals.real[inside], len(image))
    image.imag = np.bincount(cell, normals.imag[inside], len(image))
    return image.reshape(shape)


def _peaks(scores: Singles, config: CorrelativeConfig) -> Ints:
    """Return indices (c, 3) of local maxima, the best first, none within the separation of a better one."""
    around = scores.copy()
    for axis in range(3):
        now, before = np.moveaxis(around, axis, 0), np.moveaxis(around.copy(), axis, 0)
        np.maximum(now[1:], before[:-1], out=now[1:])
        np.maximum(now[:-1], before[1:], out=now[:-1])
    best = scores.max(initial=0.0)
    peaks = np.argwhere((scores == around) & (scores >= config.least_share * best) & (scores > 0.0))
    peaks = peaks[np.argsort(-scores[tuple(peaks.T)], kind="stable")]
    unit = np.array([config.separation_angle / config.angle_step, *[config.separation / config.resolution] * 2])
    chosen: list[Ints] = []
    while len(peaks) and len(chosen) < config.candidates:
        chosen.append(peaks[0])
        peaks = peaks[(np.abs(peaks - peaks[0]) >= unit).any(axis=1)]
    return np.array(chosen, dtype=np.intp).reshape(-1, 3)
