"""Smooth strokes, discs and text on an RGB array: a canvas of a few functions, so that no plotting library is needed."""

import math
import re

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from ..arrays import Bools, Floats, numbered

WIDTH, HEIGHT = 5, 9
"""Pixels of one character; characters are set one pixel apart."""

_FONT = """
0 0e 11 13 15 19 11 0e  1 04 0c 04 04 04 04 0e  2 0e 11 01 06 08 10 1f  3 1e 01 01 0e 01 01 1e  4 02 06 0a 12 1f 02 02
5 1f 10 1e 01 01 11 0e  6 06 08 10 1e 11 11 0e  7 1f 01 02 04 08 08 08  8 0e 11 11 0e 11 11 0e  9 0e 11 11 0f 01 02 0c
A 0e 11 11 1f 11 11 11  B 1e 11 11 1e 11 11 1e  C 0e 11 10 10 10 11 0e  D 1c 12 11 11 11 12 1c  E 1f 10 10 1e 10 10 1f
F 1f 10 10 1e 10 10 10  G 0e 11 10 17 11 11 0f  H 11 11 11 1f 11 11 11  I 0e 04 04 04 04 04 0e  J 07 02 02 02 02 12 0c
K 11 12 14 18 14 12 11  L 10 10 10 10 10 10 1f  M 11 1b 15 15 11 11 11  N 11 19 15 15 13 11 11  O 0e 11 11 11 11 11 0e
P 1e 11 11 1e 10 10 10  Q 0e 11 11 11 15 12 0d  R 1e 11 11 1e 14 12 11  S 0f 10 10 0e 01 01 1e  T 1f 04 04 04 04 04 04
U 11 11 11 11 11 11 0e  V 11 11 11 11 11 0a 04  W 11 11 11 15 15 1b 11  X 11 11 0a 04 0a 11 11  Y 11 11 0a 04 04 04 04
Z 1f 01 02 04 08 10 1f  a 00 00 0e 01 0f 11 0f  b 10 10 1e 11 11 11 1e  c 00 00 0e 10 10 10 0e  d 01 01 0f 11 11 11 0f
e 00 00 0e 11 1f 10 0e  f 06 09 08 1c 08 08 08  g 00 00 0f 11 11 11 0f 01 0e  h 10 10 1e 11 11 11 11
i 04 00 0c 04 04 04 0e  j 02 00 06 02 02 02 02 12 0c  k 10 10 12 14 18 14 12  l 0c 04 04 04 04 04 0e
m 00 00 1a 15 15 15 15  n 00 00 1e 11 11 11 11  o 00 00 0e 11 11 11 0e  p 00 00 1e 11 11 11 1e 10 10
q 00 00 0f 11 11 11 0f 01 01  r 00 00 16 19 10 10 10  s 00 00 0f 10 0e 01 1e  t 08 08 1c 08 08 09 06
u 00 00 11 11 11 11 0f  v 00 00 11 11 11 0a 04  w 00 00 11 15 15 15 0a  x 00 00 11 0a 04 0a 11
y 00 00 11 11 11 11 0f 01 0e  z 00 00 1f 02 04 08 1f  . 00 00 00 00 00 0c 0c  , 00 00 00 00 00 0c 04 08
: 00 0c 0c 00 0c 0c 00  - 00 00 00 1f 00 00 00  + 00 04 04 1f 04 04 00  _ 00 00 00 00 00 00 1f  / 01 01 02 04 08 10 10
( 02 04 08 08 08 04 02  ) 08 04 02 02 02 04 08  % 19 19 02 04 08 13 13  # 0a 0a 1f 0a 1f 0a 0a  = 00 00 1f 00 1f 00 00
? 0e 11 01 06 04 00 04
"""
"""Characters, each with its rows of pixels in hexadecimal; two blanks part them."""
_ROWS = {" ": "", **{glyph[0]: glyph[2:] for glyph in re.split(r"  |\n", _FONT.strip())}}
"""Rows of a character from the top; of a row five bits, the left pixel first."""
_UNKNOWN = "1f 11 11 11 11 11 1f"


def text_mask(text: str, scale: int = 1) -> Bools:
    """Return the ink of a line of text (height, width), so many pixels per pixel of the font; what it lacks becomes boxes."""
    ink = np.zeros((HEIGHT, max(len(text), 1) * (WIDTH + 1) - 1), dtype=np.bool_)
    for place, character in enumerate(text):
        for row, bits in enumerate(_ROWS.get(character, _UNKNOWN).split()):
            ink[row, place * (WIDTH + 1) :][:WIDTH] = [bit == "1" for bit in f"{int(bits, 16):0{WIDTH}b}"]
    return ink.repeat(scale, axis=0).repeat(scale, axis=1)


Colour = tuple[int, int, int]
"""Red, green, blue, 0..255."""


def rgb(code: str) -> Colour:
    """Return a colour given in hexadecimal, as HTML has it."""
    red, green, blue = bytes.fromhex(code)
    return red, green, blue


PALETTE = {
    "path0": ("2563eb", "6a9bff"),
    "path1": ("7c3ab4", "7c3ab4"),
    "path2": ("00808c", "00808c"),
    "path3": ("5c4033", "5c4033"),
    "accepted": ("ea7814", "ff9a40"),
    "rejected": ("8a93a0", "96a0ae"),
    "anchor": ("d01c3c", "ff6480"),
    "start": ("169650", "3fc47c"),
    "doubted": ("fabe14", "fabe14"),
    "nlos": ("d81b60", "ff6aa5"),
}
"""By names, on a light ground and on a dark one: recordings, closures, anchors, and what does not agree with the map."""
PATHS = tuple(rgb(light) for name, (light, _) in PALETTE.items() if name.startswith("path"))
ACCEPTED, REJECTED, ANCHOR, START, DOUBTED = (
    rgb(PALETTE[n][0]) for n in ("accepted", "rejected", "anchor", "start", "doubted")
)
PROPOSED: Colour = rgb("6e28a0")
"""Anchors that do not stand there yet."""


def share(colour: Colour, alpha: float = 1.0) -> tuple[float, float, float, float]:
    """Return a colour as red, green, blue, alpha, 0..1."""
    r, g, b = (v / 255.0 for v in colour)
    return (r, g, b, alpha)


_Place = NDArray[np.signedinteger]
"""(2,) column and row of a pixel."""
_FINE = 3
"""Sub-pixels per pixel and axis: ink is laid on a finer grid and averaged, which smooths the edges."""
STRONG = 0.85
"""Opacity of lines, and of the ground behind text."""


class Canvas:
    """A picture (height, width, 3) to draw on in place; coordinates are pixels, (x, y) with y down, pixel centres at .5."""

    def __init__(self, image: NDArray[np.uint8]) -> None:
        self.image = image
        self.size = np.array(image.shape[1::-1])
        """(2,) width and height."""

    def lines(self, segments: Floats, width: float, colour: Colour, opacity: float = 1.0) -> None:
        """Draw straight lines (n, 4), x, y, x, y of both ends, round there; where they overlap the ink is not laid twice."""
        segments = segments[np.isfinite(segments).all(axis=1)]
        start, way = segments[:, :2], segments[:, 2:] - segments[:, :2]
        length = np.minimum(np.hypot(*way.T), (2 * self.size).sum())
        # Points half a sub-pixel apart leave no gaps.
        count = np.ceil(length * 2 * _FINE).astype(np.intp) + 1
        owner, step = numbered(count)
        fraction = step / np.maximum(count - 1, 1)[owner]
        self._dab(start[owner] + fraction[:, None] * way[owner], width / 2.0, colour, opacity)

    def polyline(self, points: Floats, width: float, colour: Colour, opacity: float) -> None:
        self.lines(np.concatenate([points[:-1], points[1:]], axis=1), width, colour, opacity)

    def discs(self, centres: Floats, radius: float, colour: Colour) -> None:
        """Draw filled discs around centres (n, 2)."""
        self._dab(centres, radius, colour, 1.0)

    def polygon(self, points: Floats, colour: Colour, opacity: float = 1.0) -> None:
        """Fill a convex polygon (n, 2), finite, corners in either order."""
        low = np.clip(np.floor(points.min(axis=0)), 0, self.size).astype(int)
        high = np.clip(np.ceil(points.max(axis=0)), 0, self.size).astype(int)
        if (high > low).all():
            x, y = (a + (np.arange((b - a) * _FINE) + 0.5) / _FINE for a, b in zip(low, high, strict=True))
            left, right = _span(points, y)
            self._lay((x >= left[:, None]) & (x <= right[:, None]), low, colour, opacity)

    def text(self, corner: Floats, text: str, colour: Colour, scale: int = 2, halo: Colour | None = None) -> None:
        """Write a line of text with its top left corner (2,) there, on a halo of another colour where one is given."""
        place, ink = np.rint(corner).astype(int) - scale, np.pad(text_mask(text, scale), scale)
        if halo is not None:
            self._ink(binary_dilation(ink, np.ones((2 * scale + 1,) * 2)), place, halo, STRONG)
        self._ink(ink, place, colour, 1.0)

    def _dab(self, points: Floats, radius: float, colour: Colour, opacity: float) -> None:
        """Lay discs of ink around points, together."""
        points = points[((points > -radius) & (points < self.size + radius)).all(axis=1)]
        if not len(points):
            return
        fine, reach = np.floor(points * _FINE).astype(np.intp), math.ceil(radius * _FINE)
        low = (fine.min(axis=0) - reach) // _FINE
        width, height = _FINE * ((fine.max(axis=0) + reach) // _FINE + 1 - low)
        centre = np.zeros((height, width), dtype=np.bool_)
        column, row = (fine - _FINE * low).T
        centre[row, column] = True
        places, ink = np.flatnonzero(centre), np.zeros(centre.size, dtype=np.bool_)
        dy, dx = np.mgrid[-reach : reach + 1, -reach : reach + 1]
        for offset in (dy * width + dx)[np.hypot(dx, dy) <= radius * _FINE].tolist():
            ink[places + offset] = True
        self._lay(ink.reshape(centre.shape), low, colour, opacity)

    def _lay(self, ink: Bools, place: _Place, colour: Colour, opacity: float) -> None:
        """Average fine ink to pixels and blend it in with its first pixel at a place."""
        rows = ink.view(np.uint8).reshape(len(ink) // _FINE, _FINE, -1).sum(axis=1, dtype=np.uint8)
        cover = np.sum([rows[:, k::_FINE] for k in range(_FINE)], axis=0)
        self._ink(np.divide(cover, _FINE * _FINE, dtype=np.float32), place, colour, opacity)

    def _ink(
        self, cover: Bools | NDArray[np.float32], place: NDArray[np.signedinteger], colour: Colour, opacity: float
    ) -> None:
        """Blend a colour in where cover (rows, columns) is not 0; what lies outside the picture is dropped."""
        left, top = np.maximum(-place, 0)
        right, bottom = np.maximum(self.size - place, 0)
        row, column = np.nonzero(cover[top:bottom, left:right])
        row, column = row + top, column + left
        weight, where = np.float32(opacity) * cover[row, column, None].astype(np.float32), (row + place[1], column + place[0])
        area = self.image[where]
        self.image[where] = np.rint(area + weight * (np.array(colour, dtype=np.float32) - area)).astype(np.uint8)


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
