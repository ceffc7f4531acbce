"""Geometry of the cells of a map: the only module that converts metres to cells and back."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..arrays import Bools, Floats, Ints, chunks
from ..config import documented
from ..errors import ConfigError

BYTES_PER_CELL = 12
"""Memory of a map while it is made: two counts and the log-odds."""
MEGA = 1e6
"""Bytes in a megabyte."""
STRIP = 64
"""Rows of a map that are processed at a time, so that they stay in a processor's cache."""
_OUTER = 0.01
"""Share of the points left out on each side of a box without outliers."""
_LEAST_MARGIN = 10.0
"""m; least size of that box: the path of a robot that stands has none."""
_MARGIN = 2
"""Cells added on every side of the area that a map must contain."""
_COARSER = 0.25
"""Of the edge of a cell, by which it grows where there would be too many."""


@documented
@dataclass(frozen=True, slots=True, eq=False)
class GridGeometry:
    """A regular grid of square cells; row 0 has the smallest y, column 0 the smallest x."""

    resolution: float
    """Edge of a cell, m."""
    origin: Floats
    """(2,) lower left corner of cell (0, 0), m, map frame."""
    rows: int
    cols: int

    @property
    def cells(self) -> int:
        """Number of cells."""
        return self.rows * self.cols

    @property
    def megabytes(self) -> float:
        """Memory of a map of this size while it is made, MB."""
        return self.cells * BYTES_PER_CELL / MEGA

    @property
    def corner(self) -> Floats:
        """(2,) upper right corner of the last cell, m."""
        return self.origin + self.resolution * np.array([self.cols, self.rows])

    def cell_of(self, points: Floats) -> tuple[Ints, Ints]:
        """Return row and column (...) of the cells that contain points (..., 2), m; the numbering continues outside the
        grid."""
        cell = np.floor((points - self.origin) / self.resolution).astype(np.intp)
        return cell[..., 1], cell[..., 0]

    def centre_of(self, row: Ints, col: Ints) -> Floats:
        """Return the centres (..., 2) of cells, m."""
        return self.origin + self.resolution * (np.stack([col, row], axis=-1) + 0.5)

    def inside(self, row: Ints, col: Ints) -> Bools:
        """Return which cells belong to the grid."""
        return (row >= 0) & (row < self.rows) & (col >= 0) & (col < self.cols)

    def strips(self) -> Iterator[slice]:
        """Return the rows in strips, for computations that take many bytes per cell."""
        return chunks(self.rows, STRIP)

    def window(self, row: int, col: int, rows: int, cols: int) -> "GridGeometry":
        """Return the part of the grid whose first cell is (row, col)."""
        return GridGeometry(self.resolution, self.origin + self.resolution * np.array([col, row]), rows, cols)

    @staticmethod
    def around(low: Floats, high: Floats, resolution: float, max_cells: int) -> "GridGeometry":
        """Return the grid that holds a box, with cell edges at multiples of the resolution.

        Parameters
        ----------
        low, high : (2,) corners of the box, m.
        resolution : edge of a cell, m; larger by quarters of it where there would be too many cells.
        max_cells : most cells allowed.

        Raises
        ------
        ConfigError : the box has no finite size, or max_cells is too few for any grid.
        """
        finest, extent = resolution, high - low
        while True:
            first = np.floor(low / resolution) - _MARGIN
            last = np.floor(high / resolution) + 1 + _MARGIN
            width, height = (last - first).tolist()
            if width * height <= max_cells:
                break
            if not np.isfinite(extent).all() or max_cells < (2 * _MARGIN + 2) ** 2:
                raise ConfigError(
                    f"no map of {extent[0]:g} x {extent[1]:g} m fits into {max_cells} cells; raise grid.max_cells, or set a "
                    "smaller grid.max_range"
                )
            times = resolution / finest * np.sqrt(width * height / max_cells)
            resolution = finest * max(np.ceil(times / _COARSER) * _COARSER, resolution / finest + _COARSER)
        return GridGeometry(resolution, first * resolution, int(height), int(width))


def central_box(points: Floats) -> tuple[Floats, Floats]:
    """Return the corners (2,) of a box around the points (n, 2) without outliers, such as poses that a wrong reading displaced.

    The box around the central 98 % of each coordinate, wider by its longer side in every direction, where there are points.
    """
    low, high = np.quantile(points, _OUTER, axis=0, method="higher"), np.quantile(points, 1.0 - _OUTER, axis=0, method="lower")
    margin = max(float((high - low).max()), _LEAST_MARGIN)
    return np.maximum(low - margin, points.min(axis=0)), np.minimum(high + margin, points.max(axis=0))
