"""A map coloured by an expected error: where a position is well known, and where not."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..arrays import Floats
from ..grid.occupancy_grid import FREE, OccupancyGrid
from .canvas import Canvas, rgb
from .picture import FLOOR, INK, Overlay, PictureAnchor, draw_map, shaded

_STEPS = (0.1, 0.2, 0.5, 1.0, 2.0)
"""m; bounds of the colours."""
_COLOURS = np.array([rgb(code) for code in ["2178b4", "56b4be", "bee1aa", "fadc78", "f09646", "c83c3c"]], dtype=np.uint8)
"""From better than the first bound to worse than the last; distinct in grey as well (dark, light, dark with a legend)."""


def draw_errors(
    grid: OccupancyGrid, points: Floats, errors: Floats, anchors: Sequence[PictureAnchor], title: str, *, size: int = 900
) -> NDArray[np.uint8]:
    """Draw a map whose free space is coloured by the expected error of a position.

    Parameters
    ----------
    points, errors : (m, 2) m, (m,) m: the error at places of the free space; a cell has that of the nearest.
    size : pixels of the longer side, about.

    Returns
    -------
    (height, width, 3) red, green, blue.
    """
    colours = shaded(grid)
    rows, cols = np.nonzero(grid.states() == FREE)
    nearest = cKDTree(points).query(grid.geometry.centre_of(rows, cols))[1]
    colours[rows, cols] = _COLOURS[np.searchsorted(_STEPS, errors[nearest])]
    image = draw_map(grid, np.zeros((0, 2)), Overlay(anchors), size=size, colours=colours)
    return np.concatenate([_strip(image.shape[1], title), image, _legend(image.shape[1])], axis=0)


def side_by_side(images: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Return pictures beside each other, the lower ones filled up below."""
    height = max(len(image) for image in images)
    fill = [((0, height - len(image)), (0, 0), (0, 0)) for image in images]
    return np.concatenate([np.pad(i, f, constant_values=FLOOR[0]) for i, f in zip(images, fill, strict=True)], axis=1)


def _strip(width: int, text: str) -> NDArray[np.uint8]:
    """Return a strip with a line of text; smaller where it is too long."""
    image = np.full((40, width, 3), FLOOR[0], dtype=np.uint8)
    scale = 2 if 12 * len(text) <= width - 24 else 1
    Canvas(image).text(12, 10 if scale == 2 else 14, text, INK, scale)
    return image


def _legend(width: int) -> NDArray[np.uint8]:
    """Return a strip with the colours, their bounds, and what they are bounds of."""
    image = _strip(width, "")
    canvas = Canvas(image)
    labels = ["m, up to", *(f"{bound:g}" for bound in _STEPS), "more"]
    each = max((width - 24) // len(labels), 1)
    for k, label in enumerate(labels):
        left = 12 + k * each
        if k:
            square = np.array([[left, 8], [left + 18, 8], [left + 18, 26], [left, 26]], dtype=float)
            canvas.polygon(square, tuple(_COLOURS[k - 1].tolist()))
        canvas.text(left + (24 if k else 0), 10, label, INK)
    return image
