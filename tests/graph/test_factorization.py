"""Orders of elimination keep their promises; factors solve as dense matrices do; what is singular is said."""

import numpy as np
import pytest
from scipy import sparse

from uwblite.errors import SolverError
from uwblite.graph.elimination import choose_ordering
from uwblite.graph.factorization import BandedFactor, BandedLayout, Blocks, BorderedFactor, SparseLayout, superlu


def chain(n, reach=1):
    return np.array([(k, k + r) for r in range(1, reach + 1) for k in range(n - r)])


def anywhere(rng, n, count):
    return np.vstack([chain(n), rng.integers(0, n, (count, 2))])


def rooms(count, poses):
    """Return pairs of rooms full of poses that all see each other, each with a door to the next two of a tree of rooms."""
    i, j = np.triu_indices(poses, 1)
    each = poses * np.arange(count)
    doors = np.stack([each[1:], poses * ((np.arange(1, count) - 1) // 2) + 1], axis=1)
    return np.vstack([np.stack([(each[:, None] + i).ravel(), (each[:, None] + j).ravel()], axis=1), doors])


NOTHING = np.zeros(0, dtype=np.intp)


def chosen(pairs, poses, others, **kinds):
    """Choose for poses and other scalars."""
    return choose_ordering(pairs, poses, np.repeat([3, 1], [poses, others]), **kinds)


def positive(rng, n, half=None):
    """Return a random symmetric positive definite matrix, banded where half is given."""
    matrix = rng.normal(size=(n, n))
    matrix = matrix + matrix.T
    if half is not None:
        matrix[np.abs(np.subtract.outer(np.arange(n), np.arange(n))) > half] = 0.0
    return matrix + (1.0 + np.abs(np.linalg.eigvalsh(matrix)).max()) * np.eye(n)


@pytest.mark.parametrize("columns", [(), (1,), (4,)])
@pytest.mark.parametrize("half", [0, 2])
def test_a_band_and_its_border_solve_as_the_dense_matrix(half, columns):
    rng = np.random.default_rng(half)
    n, m = 12, 3
    whole = positive(rng, n + m)
    inside = positive(rng, n, half)
    whole[:n, :n] = inside
    whole += 10.0 * np.eye(n + m)
    band = np.zeros((n, half + 1))
    for j in range(n):
        for below in range(min(half + 1, n - j)):
            band[j, below] = whole[j + below, j]
    right = rng.normal(size=(n + m, *columns))
    assert np.allclose(BandedFactor(band.copy()).solve(right[:n]), np.linalg.solve(whole[:n, :n], right[:n]))
    lower = np.hstack([whole[n:, :n], np.tril(whole[n:, n:])])
    assert np.allclose(BorderedFactor(BandedFactor(band), lower).solve(right), np.linalg.solve(whole, right))


def test_what_is_not_positive_definite_is_said():
    good = BandedFactor(np.ones((3, 1)))
    singular = [
        lambda: BandedFactor(np.array([[1.0], [0.0], [1.0]])),
        lambda: BorderedFactor(good, np.array([[2.0, 0.0, 0.0, 1.0]])),
        lambda: superlu(sparse.csc_matrix(np.diag([1.0, 0.0])), "NATURAL"),
    ]
    for factorise in singular:
        with pytest.raises(SolverError, match="normal equations are singular; add a prior"):
            factorise()


@pytest.mark.parametrize(
    ("pairs", "poses", "others", "form"),
    [
        (chain(40), 40, 48, (True, True, False)),
        (np.vstack([chain(40), [[0, 39]]]), 40, 48, (True, True, False)),
        (chain(40), 40, 49, (False, False, False)),
        (chain(60, 16), 60, 10, (True, True, False)),
        (anywhere(np.random.default_rng(0), 200, 300), 200, 10, (True, False, False)),
        (chain(500, 6), 500, 10, (True, True, False)),
        (chain(500, 40), 500, 10, (True, False, False)),
        (rooms(60, 12), 720, 10, (True, False, False)),
        (rooms(30, 80), 2400, 10, (True, False, False)),
        (rooms(4, 600), 2400, 10, (False, False, True)),
        (anywhere(np.random.default_rng(1), 300, 2000), 300, 10, (True, False, False)),
        (anywhere(np.random.default_rng(1), 900, 2000), 900, 10, (False, False, True)),
        (anywhere(np.random.default_rng(2), 3000, 5000), 3000, 10, (False, False, True)),
        (anywhere(np.random.default_rng(2), 3000, 500), 3000, 10, (True, False, False)),
        (np.zeros((0, 2), dtype=int), 1, 10, (False, False, False)),
    ],
)
def test_the_form_follows_the_structure(pairs, poses, others, form):
    """Borders to 48 scalars, bands to 16 poses; iteration where a factor takes much work for each pose."""
    ordering = chosen(pairs, poses, others)
    assert (ordering.bordered, ordering.banded, ordering.iterative) == form
    assert sorted(ordering.order) == list(range(poses))
    if ordering.banded:
        position = np.argsort(ordering.order)
        assert np.abs(np.diff(position[pairs], axis=1)).max() <= 16


def test_anchors_of_any_poses_fill_the_matrix_as_well():
    """2,500 poses range to any of as many anchors, or to fifty as they pass them."""
    rng = np.random.default_rng(4)
    ranges = np.stack([rng.integers(0, 2500, 9000), 2500 + rng.integers(0, 2500, 9000)], axis=1)
    assert choose_ordering(np.vstack([chain(2500), ranges]), 2500, np.repeat([3, 2], 2500)).iterative
    near = np.stack([np.arange(2500), 2500 + np.arange(2500) // 50], axis=1)
    assert not choose_ordering(np.vstack([chain(2500), near]), 2500, np.repeat([3, 2], [2500, 50])).iterative


def test_the_selected_inverse_needs_a_factor():
    assert not chosen(chain(500, 40), 500, 10, last=NOTHING).iterative


@pytest.mark.parametrize(("n", "closures", "asked"), [(60, 25, True), (400, 1, True), (700, 700, False)])
def test_subtrees_of_the_elimination_are_contiguous(n, closures, asked):
    """By brute force: the pattern is eliminated column by column; the parent is the first row below that is filled.

    Round a ring of hundreds of poses the fill of a factor gets smaller than any number, and its pattern alone still has it.
    """
    rng = np.random.default_rng(3)
    pairs = anywhere(rng, n, closures) if closures > 1 else np.vstack([chain(n), [[0, n - 1]]])
    ordering = chosen(pairs, n, 10, last=NOTHING if asked else None)
    assert (ordering.bordered, ordering.banded) == (not asked, False)
    position = np.argsort(ordering.order)
    filled = np.eye(n, dtype=bool)
    filled[tuple(position[pairs].T)] = filled[tuple(position[pairs[:, ::-1]].T)] = True
    size, parent = np.ones(n, dtype=int), np.full(n, n)
    for column in range(n - 1):
        below = column + 1 + np.flatnonzero(filled[column + 1 :, column])
        filled[np.ix_(below, below)] = True
        parent[column] = below[0]
        size[below[0]] += size[column]
    child = np.arange(n - 1)
    assert np.all(child >= parent[child] - size[parent[child]] + 1)


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


@pytest.mark.parametrize("seed", range(2))
def test_entries_are_those_of_the_lower_triangle_each_once(seed):
    blocks, values, matrix = planted(seed)
    rows, columns, places = blocks.entries()
    assert len(set(zip(rows.tolist(), columns.tolist(), strict=True))) == len(rows)
    assert np.all(rows >= columns)
    found = np.zeros_like(matrix)
    found[rows, columns] = values[places]
    np.testing.assert_array_equal(found, np.tril(matrix))


@pytest.mark.parametrize("seed", range(2))
def test_compressed_columns_hold_both_triangles(seed):
    blocks, values, matrix = planted(seed)
    np.testing.assert_array_equal(SparseLayout(blocks).matrix(values).toarray(), matrix)


@pytest.mark.parametrize("seed", range(2))
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
