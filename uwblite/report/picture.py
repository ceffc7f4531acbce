"""The map as a picture: grid, paths, anchors and loop closures on one RGB array, with axes, scale bar and legend."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from ..arrays import Floats, Ints
from ..grid.occupancy_grid import FREE, OccupancyGrid
from .canvas import ACCEPTED, ANCHOR, DOUBTED, HEIGHT, PATHS, PROPOSED, START, STRONG, WIDTH, Canvas, Colour, rgb
from .drawn_map import DrawnAnchor, DrawnMap, ellipse, free_sides, name_box
from .svg_map import round_length

FLOOR: Colour = rgb("ffffff")
PAPER: Colour = rgb("e2e5e9")
INK: Colour = rgb("343a44")
WALL: Colour = rgb("181c24")

SIZE = 1400
"""Pixels of the longer side of a picture, about."""
_SMALLEST = 240
"""Pixels; the picture is at least this wide and high, so that the strip below has room."""
_SCALE = 2
"""Pixels per pixel of the font; ticks have one."""
_GAP, _TICK = 8, 6
"""Pixels: between mark and text; of a tick, as half of a mark."""
_PAD, _ROW = 2 * _GAP, _SCALE * HEIGHT + _GAP
"""Pixels: the border of the strip below, and its rows."""
_TICK_EVERY, _LONGEST_BAR = 130, 220
"""Pixels between ticks, about, and of the scale bar at most."""
_AXIS = 2 * _PAD
"""Pixels of the axes at the origin."""
_LONGEST_NAME = 16
"""Letters of an anchor's name."""
_THIN, _THICK, _WIDE = 1.3, 2.2, 6.0
"""Pixels of lines: closures and ellipses, paths, doubted stretches."""
_FAINT, _CLEAR = 0.15, 0.6
"""Opacities: areas, doubted stretches."""
_TURN = np.linspace(0.0, 2.0 * np.pi, 73)
"""rad; corners of an ellipse."""
_TRIANGLE = np.stack([np.sin(_TURN), -np.cos(_TURN)], axis=1)[:-1:24]

_LEVELS = 250
"""Shades of a cell, by its probability; the middle one is that of a cell that nobody saw."""
_BLENDED = (0.15, 0.5, 0.75)
"""Probabilities of pure floor, paper and wall."""
_CHANNELS = [np.interp(np.linspace(0.0, 1.0, _LEVELS + 1), _BLENDED, c) for c in zip(FLOOR, PAPER, WALL, strict=True)]
_SHADES = np.rint(np.stack(_CHANNELS, axis=1)).astype(np.uint8)
_WALL_SHOWS = 0.1
"""Log-odds of a cell that is shown of all those in a pixel."""

_ERRORS = (0.1, 0.2, 0.5, 1.0, 2.0)
"""m; bounds of the colours of errors."""
_ERROR_COLOURS = [rgb(code) for code in ("2178b4", "56b4be", "bee1aa", "fadc78", "f09646", "c83c3c")]
"""From better than the first bound to worse than the last; distinct in grey as well (dark, light, dark with a legend)."""

Image = NDArray[np.uint8]


class Key(NamedTuple):
    """An entry of the strip below the map."""

    text: str
    colour: Colour = INK
    mark: str = ""
    """'line', 'disc', 'ring', 'triangle', 'square' or 'bar'."""
    width: float = 0.0
    """Pixels of its mark."""

    @property
    def wide(self) -> int:
        return math.ceil(self.width) + _GAP + _SCALE * (WIDTH + 1) * len(self.text) + _PAD + _GAP


def _mark(text: str, colour: Colour, mark: str) -> Key:
    return Key(text, colour, mark, 2 * _PAD if mark == "line" else 2 * _GAP)


@dataclass(frozen=True, slots=True, eq=False)
class Tint:
    """Colours of the free cells of a map."""

    colours: Image
    """(rows, cols, 3); black = as any free cell."""
    keys: Sequence[Key]
    """What they mean."""


def draw_map(drawn: DrawnMap, *, caption: str = "", size: int = SIZE, tint: Tint | None = None) -> Image:
    """Draw a map; return it as (height, width, 3) red, green, blue, row 0 and largest y on top.

    Parameters
    ----------
    size : pixels of the longer side, about; the scale is chosen so that cells are whole pixels where they can be.
    """
    low, high = drawn.box()
    extent, size = float((high - low).max()), max(size, _SMALLEST)
    resolution = drawn.grid.geometry.resolution if drawn.grid is not None else extent / size
    scale = _pixels_per_metre(extent, resolution, size)
    low = np.floor(low / resolution) * resolution
    width, height = np.maximum(np.ceil((high - low) * scale), _SMALLEST).astype(int).tolist()
    length = round_length(min(_LONGEST_BAR, width / 4) / scale)
    keys = [Key(f"{length:g} m", INK, "bar", length * scale), *([Key(caption)] if caption else []), *_legend(drawn)]
    rows = rows_of(width, [*keys, *(tint.keys if tint is not None else ())])
    image = np.full((height + _ROW * len(rows) + _GAP, width, 3), PAPER, dtype=np.uint8)
    canvas = Canvas(image[:height])

    def pixel(points: Floats) -> Floats:
        return np.stack([(points[..., 0] - low[0]) * scale, height - (points[..., 1] - low[1]) * scale], axis=-1)

    if drawn.grid is not None:
        _paste(canvas.image, drawn.grid, low, scale, tint)
    _draw_axes(canvas, low, scale)
    closures = pixel(np.array([c.ends for c in drawn.closures if c.accepted]).reshape(-1, 2, 2))
    canvas.lines(closures.reshape(-1, 4), _THIN, ACCEPTED, STRONG)
    for number, path in enumerate(drawn.paths):
        _draw_path(canvas, pixel(path), PATHS[number % len(PATHS)])
    for stretch in drawn.doubted:
        canvas.polyline(pixel(stretch), _WIDE, DOUBTED, _CLEAR)
    line = _SCALE * HEIGHT
    frame = np.stack([low, low + np.array([width, height]) / scale])
    for anchor, side in zip(drawn.anchors, free_sides(drawn, frame, [line / max(width, height)]), strict=True):
        if np.isfinite(anchor.position).all():
            _draw_anchor(canvas, anchor, side, pixel)
    _draw_strip(Canvas(image[height:]), rows)
    return image


def draw_errors(grid: OccupancyGrid, points: Floats, errors: Floats, anchors: Sequence[DrawnAnchor], caption: str) -> Image:
    """Draw a map whose free space is coloured by the expected errors (m,), m, of a position at places (m, 2), m, of it.

    A cell has the error of the nearest place.
    """
    from scipy.spatial import cKDTree  # a tenth of a second, which no other picture needs

    colours = np.zeros((*grid.log_odds.shape, 3), dtype=np.uint8)
    rows, cols = np.nonzero(grid.states() == FREE)
    nearest = cKDTree(points).query(grid.geometry.centre_of(rows, cols))[1]
    colours[rows, cols] = np.array(_ERROR_COLOURS)[np.searchsorted(_ERRORS, errors[nearest])]
    names = [*(f"to {bound:g} m" for bound in _ERRORS), "more"]
    keys = [_mark(name, colour, "square") for name, colour in zip(names, _ERROR_COLOURS, strict=True)]
    return draw_map(DrawnMap(grid, anchors=anchors), caption=caption, size=2 * SIZE // 3, tint=Tint(colours, keys))


def side_by_side(images: Sequence[Image]) -> Image:
    height = max(len(image) for image in images)
    fill = [((0, height - len(image)), (0, 0), (0, 0)) for image in images]
    return np.concatenate([np.pad(i, f, constant_values=FLOOR[0]) for i, f in zip(images, fill, strict=True)], axis=1)


def _pixels_per_metre(extent: float, resolution: float, size: int) -> float:
    """Return a scale at which a cell is a whole number of pixels, or a pixel a whole number of cells."""
    cell = size / (extent / resolution)
    return max(math.floor(cell), 1) / resolution if cell >= 1.0 else 1.0 / (math.ceil(1.0 / cell) * resolution)


def _paste(image: Image, grid: OccupancyGrid, low: Floats, scale: float, tint: Tint | None = None) -> None:
    """Copy the cells into the picture; of several cells in a pixel the surest wall shows, or the surest floor."""
    height, width = image.shape[:2]
    pixels = scale * grid.geometry.resolution
    each, together = max(round(pixels), 1), max(round(1.0 / pixels), 1)
    first = np.rint((grid.geometry.origin - low) / grid.geometry.resolution).astype(int)
    # Rows and columns of cells that share a pixel begin there; where none do, each is one of its own.
    row_starts, col_starts = (
        np.unique((begin + np.arange(n)) // together, return_index=True)[1]
        for begin, n in zip(first[::-1], grid.log_odds.shape, strict=True)
    )
    surest_wall, surest_floor = (
        _joined(_joined(grid.log_odds, row_starts, together, extreme, 0), col_starts, together, extreme, 1)
        for extreme in (np.maximum, np.minimum)
    )
    cells = np.where(surest_wall > _WALL_SHOWS, surest_wall, surest_floor)
    # The block of cells that each row and column of pixels shows; the picture may reach farther than they do.
    row, col = (height - 1 - np.arange(height)) // each - first[1] // together, np.arange(width) // each - first[0] // together
    rows, cols = (np.flatnonzero((place >= 0) & (place < n)) for place, n in zip((row, col), cells.shape, strict=True))
    shown = _SHADES[np.rint(_LEVELS * expit(cells)).astype(np.uint8)]
    if tint is not None:
        colours = tint.colours[np.ix_(row_starts, col_starts)]
        shown = np.where(colours.any(axis=2, keepdims=True) & (cells < 0.0)[..., None], colours, shown)
    if len(rows) and len(cols):
        image[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1] = shown.take(col[cols], axis=1).take(row[rows], axis=0)


def _joined(cells: NDArray[np.float32], starts: Ints, most: int, extreme: np.ufunc, axis: int) -> NDArray[np.float32]:
    """Return what `reduceat` does, for groups of so many rows or columns at most, several times as fast."""
    found, last = cells.take(starts, axis), np.append(starts[1:], cells.shape[axis]) - 1
    for k in range(1, most):
        extreme(found, cells.take(np.minimum(starts + k, last), axis), out=found)
    return found


def _draw_axes(canvas: Canvas, low: Floats, scale: float) -> None:
    """Draw ticks with metres along the left and lower edge, and the origin with its axes where it is on the picture."""
    size, step = canvas.size, round_length(_TICK_EVERY / scale)
    for axis, inward in enumerate(np.array([[0.0, -1.0], [1.0, 0.0]])):
        first, last = low[axis] / step, (low[axis] + size[axis] / scale) / step
        for value in np.arange(math.ceil(first), math.floor(last) + 1) * step:
            along = (value - low[axis]) * scale
            edge = np.array([0.0, size[1] - along] if axis else [along, size[1]])
            canvas.lines(np.array([[*edge, *(edge + _TICK * inward)]]), _THIN, INK)
            if 2 * _PAD < along < size[axis] - 2 * _PAD:
                half = np.array([(WIDTH + 1) * len(f"{value + 0.0:g}"), HEIGHT]) / 2
                canvas.text(edge + (_TICK + _GAP + half) * inward - half, f"{value + 0.0:g}", INK, 1, PAPER)
    origin = np.array([-low[0] * scale, size[1] + low[1] * scale])
    if ((origin >= 0) & (origin < size)).all():
        for name, ahead in zip("xy", _AXIS * np.array([[1.0, 0.0], [0.0, -1.0]]), strict=True):
            tip, aside = origin + ahead, ahead[::-1] / _GAP
            canvas.lines(np.array([[*origin, *tip]]), _THICK, INK)
            canvas.polygon(np.array([tip + 2 * np.abs(aside).max() * ahead / _AXIS, tip + aside, tip - aside]), INK)
            canvas.text(tip + np.array([_GAP, -HEIGHT]), name, INK, 1, FLOOR)
        canvas.discs(origin[None], _THICK, INK)


def _draw_path(canvas: Canvas, path: Floats, colour: Colour) -> None:
    """Draw a path (n, 2), pixels, with a disc at its start and a ring at its end."""
    canvas.polyline(path, _THICK, colour, STRONG)
    for end, radius, ink in ((path[:1], _TICK + 1, FLOOR), (path[:1], _TICK, START), (path[-1:], _TICK + 1, colour)):
        canvas.discs(end, radius, ink)
    canvas.discs(path[-1:], _TICK / 2 + 1, FLOOR)


def _draw_anchor(canvas: Canvas, anchor: DrawnAnchor, side: str, pixel: Callable[[Floats], Floats]) -> None:
    """Draw an anchor's ellipse of two standard deviations, its place and its name."""
    colour = PROPOSED if anchor.kind == "proposed" else ANCHOR
    if (axes := ellipse(anchor.covariance)) is not None:
        major, minor, turn = axes
        ahead, aside = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
        outline = pixel(anchor.position + np.outer(major * np.cos(_TURN), ahead) + np.outer(minor * np.sin(_TURN), aside))
        canvas.polygon(outline[:-1], colour, _FAINT)
        canvas.polyline(outline, _THIN, colour, STRONG)
    place = pixel(anchor.position)
    canvas.polygon(place + 1.5 * _GAP * _TRIANGLE, FLOOR)
    canvas.polygon(place + _GAP * _TRIANGLE, colour)
    name = anchor.id if len(anchor.id) <= _LONGEST_NAME else anchor.id[: _LONGEST_NAME - 2] + ".."
    (left, _), (_, top) = _SCALE * HEIGHT * name_box(side, len(name))
    wide = np.array([_SCALE * (WIDTH + 1) * len(name), _SCALE * HEIGHT])
    canvas.text(np.clip(place + np.array([left, -top]), 0, np.maximum(canvas.size - wide, 0)), name, colour, _SCALE, FLOOR)


def _legend(drawn: DrawnMap) -> list[Key]:
    """Return the entries for what is on the picture."""
    many = min(len(drawn.paths), len(PATHS))
    names = ["path"] if many == 1 else [f"recording {k + 1}" for k in range(many)]
    keys = [_mark(name, colour, "line") for name, colour in zip(names, PATHS, strict=False)]
    keys += [_mark("start", START, "disc"), _mark("end", PATHS[0], "ring")] if many else []
    kinds = {a.kind for a in drawn.placed()}
    ellipses = any(a.covariance is not None for a in drawn.anchors)
    keys += [_mark("anchor, 2 sigma" if ellipses else "anchor", ANCHOR, "triangle")] if kinds - {"proposed"} else []
    keys += [_mark("proposed", PROPOSED, "triangle")] if "proposed" in kinds else []
    keys += [_mark("loop closure", ACCEPTED, "line")] if any(c.accepted for c in drawn.closures) else []
    return keys + ([_mark("not to be trusted", DOUBTED, "line")] if drawn.doubted else [])


def rows_of(width: int, keys: Sequence[Key]) -> list[list[Key]]:
    """Return the entries of the strip below row by row."""
    rows: list[list[Key]] = []
    room = 0
    for key in keys:
        if not rows or key.wide > room:
            rows.append([])
            room = width - _PAD
        rows[-1].append(key)
        room -= key.wide
    return rows


def _draw_strip(canvas: Canvas, rows: Sequence[Sequence[Key]]) -> None:
    canvas.image[1:] = FLOOR
    for number, row in enumerate(rows):
        place = np.array([_PAD, _ROW * (number + 0.5) + _GAP / 2])
        for key in row:
            _draw_key(canvas, place, key)
            place = place + np.array([key.wide, 0.0])


def _draw_key(canvas: Canvas, place: Floats, key: Key) -> None:
    """Draw an entry whose left end is there."""
    ends = np.array([[*place, *(place + np.array([key.width, 0.0]))]])
    middle = ends.reshape(2, 2).mean(axis=0)
    if key.mark in ("line", "bar"):
        canvas.lines(ends, _THICK, key.colour)
    if key.mark == "bar":
        stroke = np.array([0.0, _TICK, 0.0, -_TICK])
        canvas.lines(np.tile(ends.reshape(2, 2), 2) + stroke, _THICK, key.colour)
    elif key.mark == "triangle":
        canvas.polygon(middle + _GAP * _TRIANGLE, key.colour)
    elif key.mark == "square":
        canvas.polygon(middle + _GAP * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]), key.colour)
    elif key.mark in ("disc", "ring"):
        canvas.discs(middle[None], _TICK, key.colour)
        canvas.discs(middle[None][: key.mark == "ring"], _TICK / 2, FLOOR)
    large = key.wide <= canvas.size[0]
    corner = place + np.array([key.width + _GAP * bool(key.mark), -HEIGHT if large else -HEIGHT / 2])
    canvas.text(corner, key.text, INK, _SCALE if large else 1)
