"""The map as a picture: grid, trajectory, anchors and loop closures on one RGB array, with axes, scale bar and legend."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import Floats
from ..grid.geometry import GridGeometry, central_box
from ..grid.occupancy_grid import OccupancyGrid
from .canvas import ACCEPTED, ANCHOR, DOUBTED, PATHS, PROPOSED, START, Canvas, Colour, rgb

FLOOR: Colour = rgb("ffffff")
PAPER: Colour = rgb("e2e5e9")
INK: Colour = rgb("343a44")

_ROW = 44
"""Pixels of the row with scale bar and caption."""
_LEGEND_ROW = 26
_WIDE = 12
"""Pixels of a character of the larger writing."""
_TICK_EVERY = 130.0
"""Pixels between ticks, about."""


class Key(NamedTuple):
    """An entry of the legend."""

    text: str
    colour: Colour
    mark: str
    """'line', 'disc', 'ring' or 'triangle'."""


def foot_height(width: int, keys: Sequence[Key]) -> int:
    """Return the pixels that the strip below the map takes."""
    return _ROW + _LEGEND_ROW * len(_rows(width, keys))


def draw_axes(image: NDArray[np.uint8], low: Floats, scale: float) -> None:
    """Draw ticks with metres along the left and lower edge, and the origin with its axes where it is on the picture.

    Parameters
    ----------
    image : (height, width, 3); drawn on in place.
    low : (2,) m, map frame, of the lower left corner.
    scale : pixels per metre.
    """
    canvas = Canvas(image)
    height, width = image.shape[:2]
    step = round_length(_TICK_EVERY / scale)
    for axis, length in enumerate((width, height)):
        for value in np.arange(math.ceil(low[axis] / step), math.floor((low[axis] + length / scale) / step) + 1) * step:
            at, label = (value - low[axis]) * scale, f"{value + 0.0:g}"
            if axis == 0:
                canvas.lines(np.array([[at, height - 7.0, at, height]]), 1.5, INK)
                place, shown = (at - 3 * len(label), height - 18.0), 20 < at < width - 30
            else:
                canvas.lines(np.array([[0.0, height - at, 7.0, height - at]]), 1.5, INK)
                place, shown = (11.0, height - at - 4), 10 < height - at < height - 30
            if shown:
                canvas.text(*place, label, INK, 1, PAPER)
    _draw_origin(canvas, np.array([-low[0] * scale, height + low[1] * scale]))


def _draw_origin(canvas: Canvas, at: Floats) -> None:
    height, width = canvas.image.shape[:2]
    if not (0 <= at[0] < width and 0 <= at[1] < height):
        return
    for name, step in (("x", np.array([34.0, 0.0])), ("y", np.array([0.0, -34.0]))):
        canvas.lines(np.concatenate([at, at + step])[None], 2.0, INK)
        side = np.array([-step[1], step[0]]) / 34.0
        canvas.polygon(np.array([at + step + step * 8 / 34, at + step + 4 * side, at + step - 4 * side]), INK)
        x, y = (at + step * 1.25 + np.array([3.0, -10.0])).tolist()
        canvas.text(x, y, name, INK, 1, FLOOR)
    canvas.discs(at[None], 3.5, INK)


def draw_foot(image: NDArray[np.uint8], top: int, scale: float, caption: str, keys: Sequence[Key]) -> None:
    """Draw the strip below the map: a scale bar of a round length, the caption, and the legend."""
    image[top:] = FLOOR
    image[top : top + 1] = PAPER
    canvas = Canvas(image)
    width = image.shape[1]
    length = round_length(min(220.0, width / 4.0) / scale)
    bar, y = length * scale, top + 24.0
    canvas.polygon(np.array([[16, y - 2.5], [16 + bar, y - 2.5], [16 + bar, y + 2.5], [16, y + 2.5]]), INK)
    for x in (16.0, 16.0 + bar):
        canvas.polygon(np.array([[x - 1, y - 7], [x + 1, y - 7], [x + 1, y + 7], [x - 1, y + 7]]), INK)
    canvas.text(16 + bar + 12, y - 7, f"{length:g} m", INK)
    left = 16 + bar + 12 + _WIDE * len(f"{length:g} m") + 36
    large = width - left - 16 >= _WIDE * len(caption)
    each = _WIDE if large else _WIDE // 2
    if 0 < each * len(caption) <= width - left - 16:
        canvas.text(width - 16 - each * len(caption), y - (7 if large else 4), caption, INK, 2 if large else 1)
    for number, row in enumerate(_rows(width, keys)):
        x = 16.0
        for key in row:
            _draw_key(canvas, x, top + _ROW + _LEGEND_ROW * number + 8.0, key)
            x += _wide(key)


def _draw_key(canvas: Canvas, x: float, y: float, key: Key) -> None:
    middle = np.array([[x + 10.0, y]])
    if key.mark == "line":
        canvas.lines(np.array([[x, y, x + 20.0, y]]), 3.0, key.colour)
    elif key.mark == "triangle":
        canvas.polygon(middle + 8.0 * np.array([[0.0, -1.1], [0.95, 0.6], [-0.95, 0.6]]), key.colour)
    else:
        canvas.discs(middle, 6.0, key.colour)
        if key.mark == "ring":
            canvas.discs(middle, 3.0, FLOOR)
    canvas.text(x + 28.0, y - 7.0, key.text, INK)


def _rows(width: int, keys: Sequence[Key]) -> list[list[Key]]:
    """Return the legend's entries row by row."""
    rows: list[list[Key]] = []
    room = 0
    for key in keys:
        if not rows or _wide(key) > room:
            rows.append([])
            room = width - 32
        rows[-1].append(key)
        room -= _wide(key)
    return rows


def _wide(key: Key) -> int:
    return 28 + _WIDE * len(key.text) + 22


def round_length(longest: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not longer, m."""
    power = 10.0 ** math.floor(math.log10(longest))
    return float(max(f * power for f in (1.0, 2.0, 5.0) if f * power <= longest))


Image = NDArray[np.uint8]

WALL: Colour = rgb("181c24")

_MOST_SPREAD = 2.0
"""m of an ellipse's half axes for which room is made."""
_MARGIN = 0.8
"""m; free border around what is drawn."""
_ANCHOR_REACH = 100.0
"""m; no anchor is reached farther away than this and the extent of the path."""
_SMALLEST = 240
"""Pixels; the picture is at least this wide and high, so that the strip below has room."""


@dataclass(frozen=True, slots=True, eq=False)
class PictureAnchor:
    """An anchor to draw."""

    id: str
    position: Floats
    """(2,) m, map frame."""
    covariance: Floats | None = None
    """(2, 2) m^2; drawn as an ellipse of two standard deviations."""
    proposed: bool = False
    """It does not stand there yet."""


@dataclass(frozen=True, slots=True, eq=False)
class Overlay:
    """What is drawn on a map besides the path."""

    anchors: Sequence[PictureAnchor] = ()
    """Positions that are not finite are left out."""
    closures: Floats | None = None
    """(c, 4) x, y, x, y of the two poses of each accepted loop closure, m."""
    doubted: Sequence[Floats] = ()
    """(n, 2) x, y along each stretch of the path that is not to be trusted, m."""


def draw_map(
    grid: OccupancyGrid | None,
    trajectory: Floats,
    overlay: Overlay = Overlay(),
    *,
    caption: str = "",
    size: int = 1400,
    colours: Image | None = None,
) -> Image:
    """Draw a map; return it as (height, width, 3) red, green, blue, row 0 and largest y on top.

    Parameters
    ----------
    grid : cells; None = none were mapped.
    trajectory : (n, 2 or more) x, y of the base, m, map frame; a row of nan parts recordings,
        which have colours of their own.
    size : pixels of the longer side, about; the scale is chosen so that cells are whole pixels where they can be.
    colours : (rows, cols, 3) of the cells; None = `shaded`.
    """
    path, size = trajectory[:, :2], max(size, _SMALLEST)
    placed, closures = [a for a in overlay.anchors if np.isfinite(a.position).all()], overlay.closures
    low, high = _extent(grid, path, placed)
    resolution = grid.geometry.resolution if grid is not None else max(float((high - low).max()) / size, 1e-3)
    scale = _pixels_per_metre(float((high - low).max()), resolution, size)
    low = np.floor(low / resolution) * resolution
    width, height = (np.maximum(np.ceil((high - low) * scale), _SMALLEST).astype(int)).tolist()
    tracks = _recordings(path)
    keys = _legend(len(tracks), placed, closures)
    keys += [Key("not to be trusted", DOUBTED, "line")] if overlay.doubted else []
    image = np.empty((height + foot_height(width, keys), width, 3), dtype=np.uint8)
    image[:] = PAPER
    if grid is not None:
        _paste(image[:height], grid.log_odds if colours is None else colours, grid.geometry, low, scale)

    def pixel(points: Floats) -> Floats:
        return np.stack([(points[..., 0] - low[0]) * scale, height - (points[..., 1] - low[1]) * scale], axis=-1)

    draw_axes(image[:height], low, scale)
    canvas = Canvas(image[:height])
    if closures is not None and len(closures):
        ends = np.concatenate([pixel(closures[:, :2]), pixel(closures[:, 2:])], axis=1)
        canvas.lines(ends, 1.3, ACCEPTED, 0.75)
    for number, track in enumerate(map(pixel, tracks)):
        _draw_track(canvas, track, PATHS[number % len(PATHS)])
    for stretch in overlay.doubted:
        canvas.polyline(pixel(stretch), 6.0, DOUBTED, 0.6)
    for anchor in placed:
        _draw_anchor(canvas, anchor, pixel)
    draw_foot(image, height, scale, caption, keys)
    return image


def _legend(recordings: int, anchors: Sequence[PictureAnchor], closures: Floats | None) -> list[Key]:
    """Return the entries for what is on the picture."""
    names = ["path"] if recordings == 1 else [f"recording {k}" for k in range(1, min(recordings, len(PATHS)) + 1)]
    keys = [Key(name, colour, "line") for name, colour in zip(names, PATHS, strict=False)] if recordings else []
    keys += [Key("start", START, "disc"), Key("end", PATHS[0], "ring")] if recordings else []
    if there := [a for a in anchors if not a.proposed]:
        ellipses = any(a.covariance is not None for a in there)
        keys.append(Key("anchor, 2 sigma" if ellipses else "anchor", ANCHOR, "triangle"))
    keys += [Key("proposed", PROPOSED, "triangle")] if any(a.proposed for a in anchors) else []
    keys += [Key("loop closure", ACCEPTED, "line")] if closures is not None and len(closures) else []
    return keys


def _recordings(track: Floats) -> list[Floats]:
    """Return the pieces of a path between its rows of nan."""
    gaps = np.flatnonzero(~np.isfinite(track).all(axis=1))
    pieces = np.split(track, np.unique(np.concatenate([gaps, gaps + 1])))
    return [piece for piece in pieces if len(piece) and np.isfinite(piece).all()]


def _extent(grid: OccupancyGrid | None, path: Floats, anchors: list[PictureAnchor]) -> tuple[Floats, Floats]:
    """Return the corners of the box around everything known but for what strays far from the rest, m."""
    ellipses = [a.position + away for a in anchors for away in _spread(a)]
    boxes = [path[np.isfinite(path).all(axis=1)], np.array(ellipses).reshape(-1, 2)]
    if len(boxes[0]):
        low, high = central_box(boxes[0])
        reach = max(float((high - low).max()), _ANCHOR_REACH)
        boxes = [np.clip(boxes[0], low, high), np.clip(boxes[1], low - reach, high + reach)]
    if grid is not None and (observed := grid.log_odds != 0.0).any():
        rows, cols = np.flatnonzero(observed.any(axis=1)), np.flatnonzero(observed.any(axis=0))
        boxes.append(grid.geometry.centre_of(rows[[0, -1]], cols[[0, -1]]))
    points = np.concatenate(boxes)
    points = points if len(points) else np.zeros((1, 2))
    return points.min(axis=0) - _MARGIN, points.max(axis=0) + _MARGIN


def _spread(anchor: PictureAnchor) -> Floats:
    """Return the corners (2, 2) of an anchor's ellipse from its middle, m; of a vast one only a part."""
    if anchor.covariance is None or not np.isfinite(anchor.covariance).all():
        return np.zeros((1, 2))
    reach = np.minimum(2.0 * np.sqrt(np.maximum(np.diag(anchor.covariance), 0.0)), _MOST_SPREAD)
    return np.stack([-reach, reach])


def _pixels_per_metre(extent: float, resolution: float, size: int) -> float:
    """Return a scale at which a cell is a whole number of pixels, or a pixel a whole number of cells."""
    cell = size / (extent / resolution)
    return max(math.floor(cell), 1) / resolution if cell >= 1.0 else 1.0 / (math.ceil(1.0 / cell) * resolution)


def shaded(grid: OccupancyGrid) -> Image:
    """Return the colours (rows, cols, 3) of the cells: the more certain a cell, the closer to white or black."""
    return _painted(grid.log_odds)


def _painted(cells: NDArray[Any]) -> Image:
    """Return the colours (rows, cols, 3) of log-odds (rows, cols); colours stay as they are."""
    if cells.ndim == 3:
        return cells
    image = np.full((*cells.shape, 3), PAPER, dtype=np.uint8)
    paper, floor, ink = (np.array(c, dtype=np.float32) for c in (PAPER, FLOOR, WALL))
    for start in range(0, len(cells), 256):
        part, colours = cells[start : start + 256], image[start : start + 256]
        known = part != 0.0
        p = (1.0 / (1.0 + np.exp(-part[known]))).astype(np.float32)
        free, wall = np.clip((0.5 - p) / 0.35, 0.0, 1.0)[:, None], np.clip((p - 0.5) / 0.25, 0.0, 1.0)[:, None]
        colours[known] = np.rint(paper + free * (floor - paper) + wall * (ink - paper))
    return image


def _paste(image: Image, cells: NDArray[Any], geometry: GridGeometry, low: Floats, scale: float) -> None:
    """Copy the cells, log-odds or colours, into the picture; where several cells share a pixel the darkest shows."""
    height, width = image.shape[:2]
    pixels = scale * geometry.resolution
    first_col, first_row = np.rint((geometry.origin - low) / geometry.resolution).astype(int).tolist()
    if pixels >= 1.0:
        each = round(pixels)
        row = (height - 1 - np.arange(height)) // each - first_row
        col = np.arange(width) // each - first_col
        rows, cols = np.flatnonzero((row >= 0) & (row < geometry.rows)), np.flatnonzero((col >= 0) & (col < geometry.cols))
        if len(rows) and len(cols):
            shown = _painted(cells).take(col[cols], axis=1).take(row[rows], axis=0)
            image[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1] = shown
        return
    together = round(1.0 / pixels)
    row, col = (first_row + np.arange(geometry.rows)) // together, (first_col + np.arange(geometry.cols)) // together
    rows, row_starts = np.unique(row, return_index=True)
    cols, col_starts = np.unique(col, return_index=True)

    def reduced(extreme: np.ufunc) -> NDArray[Any]:
        return np.asarray(extreme.reduceat(extreme.reduceat(cells, row_starts, axis=0), col_starts, axis=1))

    # Log-odds are the larger, the darker a cell is.
    darkest, brightest = (_painted(reduced(e)) for e in (np.minimum, np.maximum)[:: -1 if cells.ndim == 2 else 1])
    shown = np.where(darkest[:, :, :1] < PAPER[0] - 20, darkest, brightest)
    seen_rows, seen_cols = (rows >= 0) & (rows < height), (cols >= 0) & (cols < width)
    image[np.ix_(height - 1 - rows[seen_rows], cols[seen_cols])] = shown[np.ix_(seen_rows, seen_cols)]


def _draw_track(canvas: Canvas, track: Floats, colour: Colour) -> None:
    """Draw a path (n, 2), pixels, with a disc at its start and a ring at its end."""
    canvas.polyline(track, 2.2, colour, 0.85)
    for end, radius, ink in (
        (track[:1], 7.0, FLOOR),
        (track[:1], 5.5, START),
        (track[-1:], 7.0, colour),
        (track[-1:], 4.0, FLOOR),
    ):
        canvas.discs(end, radius, ink)


def _draw_anchor(canvas: Canvas, anchor: PictureAnchor, pixel: Callable[[Floats], Floats]) -> None:
    """Draw an anchor's ellipse of two standard deviations, its place and its name."""
    colour = PROPOSED if anchor.proposed else ANCHOR
    turn = np.linspace(0.0, 2.0 * math.pi, 73)
    if anchor.covariance is not None and np.isfinite(anchor.covariance).all():
        variance, axes = np.linalg.eigh(anchor.covariance)
        ellipse = (axes * (2.0 * np.sqrt(np.maximum(variance, 0.0)))) @ np.stack([np.cos(turn), np.sin(turn)])
        outline = pixel(anchor.position + ellipse.T)
        canvas.polygon(outline[:-1], colour, 0.15)
        canvas.polyline(outline, 1.5, colour, 0.9)
    x, y = pixel(anchor.position).tolist()
    corners = np.array([[0.0, -1.1], [0.95, 0.6], [-0.95, 0.6]])
    canvas.polygon(np.array([x, y]) + 12.5 * corners, FLOOR)
    canvas.polygon(np.array([x, y]) + 9.0 * corners, colour)
    name = anchor.id if len(anchor.id) <= 16 else anchor.id[:14] + ".."
    canvas.text(*_room_for(canvas.image, x, y, 12 * len(name), 14), name, colour, 2, FLOOR)


def _room_for(image: Image, x: float, y: float, wide: int, high: int) -> tuple[float, float]:
    """Return the upper left corner for a name beside a mark, pixels: to the right of it, else to the left, below or above,
    wherever it covers the fewest dark pixels."""
    height, width = image.shape[:2]
    beside = ((x + 14.0, y - 9.0), (x - 14.0 - wide, y - 9.0), (x - wide / 2, y + 12.0), (x - wide / 2, y - 16.0 - high))

    def covered(corner: tuple[float, float]) -> tuple[bool, int]:
        left, top = round(corner[0]), round(corner[1])
        inside = left >= 4 and top >= 4 and left + wide <= width - 4 and top + high <= height - 4
        below = image[max(top, 0) : max(top + high, 0), max(left, 0) : max(left + wide, 0)]
        return not inside, int(np.sum(below.max(axis=2, initial=0) < _DARK))

    left, top = min(beside, key=covered)
    return min(max(left, 4.0), max(width - 4.0 - wide, 4.0)), min(max(top, 4.0), height - 8.0 - high)


_DARK = 80
"""Brightest channel of a wall, about."""
