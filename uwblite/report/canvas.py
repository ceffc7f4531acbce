"""Smooth strokes, discs and text on an RGB array: a canvas of a few functions, so that no plotting library is needed."""

import numpy as np
from numpy.typing import NDArray

from ..arrays import Bools, Floats
from .bitmap_font import text_mask

Colour = tuple[int, int, int]

_FINE = 3
"""Sub-pixels per pixel and axis: ink is laid on a finer grid and averaged, which smooths the edges."""


class Canvas:
    """A picture to draw on; coordinates are pixels, (x, y) with y down, pixel centres at .5.

    Parameters
    ----------
    image : (height, width, 3) uint8; drawn on in place.
    """

    def __init__(self, image: NDArray[np.uint8]) -> None:
        self.image = image

    def lines(self, segments: Floats, width: float, colour: Colour, opacity: float = 1.0) -> None:
        """Draw straight lines with round ends; where they overlap the ink is not laid twice.

        Parameters
        ----------
        segments : (n, 4) x, y, x, y of both ends.
        width : pixels.
        colour : red, green, blue, 0..255.
        opacity : 0..1.
        """
        segments = segments[np.isfinite(segments).all(axis=1)]
        if len(segments) == 0:
            return
        length = np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1])
        # Points half a sub-pixel apart leave no gaps.
        count = np.ceil(np.minimum(length, sum(self.image.shape[:2]) * 4) * 2 * _FINE).astype(np.intp) + 1
        owner = np.repeat(np.arange(len(segments)), count)
        step = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
        fraction = step / np.maximum(count - 1, 1)[owner]
        x = segments[owner, 0] + fraction * (segments[:, 2] - segments[:, 0])[owner]
        y = segments[owner, 1] + fraction * (segments[:, 3] - segments[:, 1])[owner]
        self._dab(x, y, width / 2.0, colour, opacity)

    def polyline(self, points: Floats, width: float, colour: Colour, opacity: float = 1.0) -> None:
        """Draw a line through points (n, 2)."""
        if len(points):
            points = points if len(points) > 1 else np.repeat(points, 2, axis=0)
            self.lines(np.concatenate([points[:-1], points[1:]], axis=1), width, colour, opacity)

    def discs(self, centres: Floats, radius: float, colour: Colour) -> None:
        """Draw filled discs around centres (n, 2)."""
        centres = centres[np.isfinite(centres).all(axis=1)]
        self._dab(centres[:, 0], centres[:, 1], radius, colour, 1.0)

    def polygon(self, points: Floats, colour: Colour, opacity: float = 1.0) -> None:
        """Fill a convex polygon (n, 2), corners in either order."""
        height, width = self.image.shape[:2]
        if not np.isfinite(points).all():
            return
        x0, y0 = np.clip(np.floor(points.min(axis=0)), 0, [width, height]).astype(int).tolist()
        x1, y1 = np.clip(np.ceil(points.max(axis=0)), 0, [width, height]).astype(int).tolist()
        if x1 <= x0 or y1 <= y0:
            return
        x = x0 + (np.arange((x1 - x0) * _FINE) + 0.5) / _FINE
        low, high = _span(points, y0 + (np.arange((y1 - y0) * _FINE) + 0.5) / _FINE)
        self._lay((x >= low[:, None]) & (x <= high[:, None]), x0, y0, colour, opacity)

    def text(self, x: float, y: float, text: str, colour: Colour, scale: int = 2, halo: Colour | None = None) -> None:
        """Write a line of text with its top left corner at (x, y), on a halo of another colour where one is given."""
        ink = np.pad(text_mask(text, scale), scale)
        if halo is not None:
            spread = np.zeros_like(ink)
            for dy in range(-scale, scale + 1):
                for dx in range(-scale, scale + 1):
                    spread |= np.roll(ink, (dy, dx), axis=(0, 1))
            self._ink(spread.astype(np.float32), round(x) - scale, round(y) - scale, halo, 0.85)
        self._ink(ink.astype(np.float32), round(x) - scale, round(y) - scale, colour, 1.0)

    def _dab(self, x: Floats, y: Floats, radius: float, colour: Colour, opacity: float) -> None:
        """Lay discs of ink around points, together."""
        height, width = self.image.shape[:2]
        near = (x > -radius) & (x < width + radius) & (y > -radius) & (y < height + radius)
        if not near.any():
            return
        column, row = (np.floor(v[near] * _FINE).astype(np.intp) for v in (x, y))
        reach = int(np.ceil(radius * _FINE))
        low_x, low_y = column.min() - reach, row.min() - reach
        low_x, low_y = low_x - low_x % _FINE, low_y - low_y % _FINE
        size_x, size_y = (int(v.max()) + reach + 1 - low for v, low in ((column, low_x), (row, low_y)))
        size_x, size_y = size_x + -size_x % _FINE, size_y + -size_y % _FINE
        centre = np.zeros((size_y, size_x), dtype=np.bool_)
        centre[row - low_y, column - low_x] = True
        places, ink = np.flatnonzero(centre), np.zeros(centre.size, dtype=np.bool_)
        dy, dx = np.mgrid[-reach : reach + 1, -reach : reach + 1]
        brush = dx**2 + dy**2 <= (radius * _FINE) ** 2
        for offset in (dy * size_x + dx)[brush].tolist():
            ink[places + offset] = True
        self._lay(ink.reshape(centre.shape), int(low_x) // _FINE, int(low_y) // _FINE, colour, opacity)

    def _lay(self, ink: Bools, x: int, y: int, colour: Colour, opacity: float) -> None:
        """Average fine ink to pixels and blend it in with its first pixel at (x, y)."""
        rows, columns = ink.shape[0] // _FINE, ink.shape[1] // _FINE
        fine = ink.view(np.uint8).reshape(rows, _FINE, columns, _FINE)
        by_row, cover = fine.sum(axis=1, dtype=np.uint8), np.zeros((rows, columns), dtype=np.uint8)
        for k in range(_FINE):
            cover += by_row[:, :, k]
        self._ink(np.divide(cover, _FINE * _FINE, dtype=np.float32), x, y, colour, opacity)

    def _ink(self, cover: NDArray[np.float32], x: int, y: int, colour: Colour, opacity: float) -> None:
        """Blend a colour in where cover (rows, columns) is not 0; what lies outside the picture is dropped."""
        height, width = self.image.shape[:2]
        top, left = max(-y, 0), max(-x, 0)
        part = cover[top : max(height - y, 0), left : max(width - x, 0)]
        row, column = np.nonzero(part)
        share, where = (part[row, column] * np.float32(opacity))[:, None], (row + y + top, column + x + left)
        area = self.image[where]
        self.image[where] = np.rint(area + share * (np.array(colour, dtype=np.float32) - area)).astype(np.uint8)


def _span(points: Floats, rows: Floats) -> tuple[Floats, Floats]:
    """Return from where to where (r,) a convex polygon (n, 2) reaches on each row (r,); inf to -inf where it does not."""
    one, other = points, np.roll(points, -1, axis=0)
    rise = other[:, 1] - one[:, 1]
    # An edge counts for the rows from its lower end up to, not including, its upper one; a level edge for none.
    bottom, top = np.minimum(one[:, 1], other[:, 1]), np.maximum(one[:, 1], other[:, 1])
    crossed = (rows[:, None] >= bottom) & (rows[:, None] < top)
    share = (rows[:, None] - one[:, 1]) / np.where(rise == 0.0, 1.0, rise)
    x = one[:, 0] + share * (other[:, 0] - one[:, 0])
    return np.where(crossed, x, np.inf).min(axis=1), np.where(crossed, x, -np.inf).max(axis=1)
