"""The likelihood field against brute force: distances to walls, and maxima over squares of cells."""

import numpy as np
import pytest
from helpers.localization_room import ODD, grid_of

from uwblite.localization.likelihood_field import FARTHEST, LEVELS, field_of
from uwblite.localization.walls import walls_of


@pytest.fixture(scope="module")
def walls():
    return walls_of(grid_of(ODD))


@pytest.fixture(scope="module")
def field(walls):
    return field_of(walls)


def test_a_cell_holds_the_likelihood_of_its_distance_to_the_nearest_wall(walls, field):
    rng = np.random.default_rng(1)
    rows, cols = (rng.integers(field.margin - 10, n - field.margin + 10, 400) for n in field.free.shape)
    centres = field.origin + (np.stack([cols, rows], axis=1) + 0.5) * field.cell
    apart = np.hypot(*(centres[:, None] - walls.points[None]).transpose(2, 0, 1)).min(axis=1)
    expected = 255.0 * np.exp(-0.5 * (apart / 0.15) ** 2)
    found = field.levels[0][rows, cols].astype(float)
    # The table of nearest walls has cells of 0.05 m: the distance is known to half a diagonal of one.
    slope = 255.0 * np.exp(-0.5) / 0.15
    assert np.abs(found - expected).max() < slope * 0.5 * np.sqrt(2.0) * walls.cell + 1.0
    assert (found[apart > 0.8] == 0).all()


@pytest.mark.parametrize("level", range(1, LEVELS + 1))
def test_a_level_holds_the_maxima_over_squares_of_cells(field, level):
    base, size = field.levels[0], 2**level
    rng = np.random.default_rng(level)
    rows, cols = (rng.integers(0, n, 300) for n in base.shape)
    for row, col in zip(rows, cols, strict=True):
        assert field.levels[level][row, col] == base[row : row + size, col : col + size].max()


def test_every_point_of_a_scan_finds_a_cell(walls, field):
    """A robot stands in a free cell; what it sees is at most FARTHEST away."""
    rows, cols = np.nonzero(field.free)
    reach = FARTHEST / field.cell + 2**LEVELS
    assert rows.min() >= reach
    assert cols.min() >= reach
    assert rows.max() + reach < field.free.shape[0]
    assert cols.max() + reach < field.free.shape[1]
    inside = field.origin + (np.stack([cols, rows], axis=1) + 0.5) * field.cell
    assert (walls.state_at(*inside.T) == 0).all()
    assert len(rows) == pytest.approx(48.0 / field.cell**2, rel=0.05)


def test_a_large_map_gets_coarser_cells():
    wide = grid_of((), size=(160.0, 160.0), cell=0.5)
    field = field_of(walls_of(wide))
    assert field.cell > 0.1
    # Three million, and a rim for the coarsest level on every side.
    assert field.levels[0].size < (np.sqrt(3e6) + 2 * 2 ** (LEVELS + 1) + 2) ** 2
    assert not field.levels[0].any()
