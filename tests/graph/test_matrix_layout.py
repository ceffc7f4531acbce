"""Places of the values of a symmetric matrix: every one in the lower triangle, and the same matrix in every layout."""

import numpy as np
import pytest

from uwblite.graph.matrix_layout import BandedLayout, Blocks, SparseLayout


def planted(seed):
    """Return blocks of 3, 2 and 1 rows, their values, and the matrix they stand for."""
    rng = np.random.default_rng(seed)
    heights = np.append(rng.permutation([3, 3, 3, 2, 2]), [1, 1])
    first = np.concatenate([[0], np.cumsum(heights)])
    pairs = [(a, b) for a in range(7) for b in range(a + 1) if a == b or rng.random() < 0.5]
    shapes = np.array([(heights[a], heights[b]) for a, b in pairs])
    start = np.concatenate([[0], np.cumsum(shapes.prod(axis=1))])
    row, column = (np.array([first[p[k]] for p in pairs]) for k in (0, 1))
    blocks = Blocks(row, column, *shapes.T, start[:-1], int(first[-1]))
    values = rng.normal(size=start[-1])
    whole = np.zeros((blocks.size, blocks.size))
    for k, (r, c) in enumerate(zip(row, column, strict=True)):
        h, w = shapes[k]
        whole[r : r + h, c : c + w] = values[start[k] : start[k + 1]].reshape(h, w)
    lower = np.tril(whole)
    return blocks, values, lower + np.tril(lower, -1).T


@pytest.mark.parametrize("seed", range(4))
def test_entries_are_those_of_the_lower_triangle_each_once(seed):
    blocks, values, matrix = planted(seed)
    rows, columns, places = blocks.entries()
    assert len(set(zip(rows.tolist(), columns.tolist(), strict=True))) == len(rows)
    assert np.all(rows >= columns)
    found = np.zeros_like(matrix)
    found[rows, columns] = values[places]
    np.testing.assert_array_equal(found, np.tril(matrix))


@pytest.mark.parametrize("seed", range(4))
def test_compressed_columns_hold_both_triangles(seed):
    blocks, values, matrix = planted(seed)
    np.testing.assert_array_equal(SparseLayout(blocks).matrix(values).toarray(), matrix)


@pytest.mark.parametrize("seed", range(4))
def test_a_band_solves_the_matrix_inside(seed):
    blocks, values, matrix = planted(seed)
    inner = blocks.size - 2
    inside = blocks.inside(inner)
    # Stronger on the diagonal, so that the matrix is positive definite.
    strong = values.copy()
    rows, columns, places = inside.entries()
    strong[places[rows == columns]] += 20.0
    right = np.arange(inner) + 1.0
    found = BandedLayout(inside).factor(strong).solve(right)
    np.testing.assert_allclose((matrix[:inner, :inner] + 20.0 * np.eye(inner)) @ found, right, atol=1e-9)
