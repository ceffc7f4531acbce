"""What stands around a map's picture: axes with metres, the origin, a scale bar, a caption and a legend."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import Floats
from .canvas import Canvas, Colour, rgb

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
