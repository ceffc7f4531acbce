"""Symbolic elimination against elimination by brute force, and against SuperLU's own order."""

import numpy as np
import pytest
from scipy import sparse

from uwblite.graph.elimination import (
    _ALONE,
    adjacency,
    alike_columns,
    column_sizes,
    contiguous,
    elimination_tree,
    is_full,
    minimum_degree,
    narrow_order,
    order_of_columns,
    pairs_of,
    postorder,
    work,
    work_of,
)
from uwblite.graph.factorization import superlu


def by_brute_force(pairs, order, width):
    """Return parents and sizes of the columns of the filled pattern."""
    n, place = len(order), np.argsort(order)
    filled = np.eye(n, dtype=bool)
    filled[tuple(place[pairs].T)] = filled[tuple(place[pairs[:, ::-1]].T)] = True
    parent, sizes = np.full(n, n), np.zeros(n, dtype=int)
    for column in range(n):
        below = column + 1 + np.flatnonzero(filled[column + 1 :, column])
        filled[np.ix_(below, below)] = True
        parent[column] = below[0] if len(below) else n
        sizes[column] = width[order[column]] + width[order[below]].sum()
    return parent, sizes


@pytest.mark.parametrize("seed", range(40))
def test_tree_and_sizes_are_those_of_the_filled_pattern(seed):
    """Sparse and dense graphs, in parts and in one, with pairs told twice and either way, in good orders and any."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 50))
    pairs, width = rng.integers(0, n, (int(rng.integers(0, 3 * n)), 2)), rng.integers(1, 4, n)
    order = rng.permutation(n) if seed % 2 else minimum_degree(adjacency(pairs, n))
    parent, sizes = by_brute_force(pairs, order, width)
    np.testing.assert_array_equal(elimination_tree(pairs, order), parent)
    order, tree = contiguous(pairs, order)
    parent, sizes = by_brute_force(pairs, order, width)
    np.testing.assert_array_equal(tree, parent)
    np.testing.assert_array_equal(column_sizes(pairs, order, width, parent), sizes)
    above = np.append(sizes, 0)[parent]
    continued = [top == size - width[k] for k, top, size in zip(order, above, sizes, strict=True)]
    each = [width[k] * size**2 * (1 if more else _ALONE) for k, size, more in zip(order, sizes, continued, strict=True)]
    assert work(pairs, order, width, parent) == sum(each)


def test_a_tree_is_walked_in_postorder():
    """Children before parents, and every subtree in one piece: 0 and 3 are below 4, 1 below 2."""
    walk = postorder(np.array([4, 2, 5, 4, 5])).tolist()
    assert sorted(walk) == [0, 1, 2, 3, 4]
    assert walk.index(1) + 1 == walk.index(2)
    assert sorted(walk[walk.index(4) - 2 : walk.index(4)]) == [0, 3]


@pytest.mark.parametrize("seed", range(5))
def test_the_order_is_that_of_a_complete_factorisation(seed):
    rng = np.random.default_rng(seed)
    n = 300
    pairs = np.vstack([np.stack([np.arange(n - 1), np.arange(1, n)], axis=1), rng.integers(0, n, (100 * seed, 2))])
    factor = superlu(adjacency(pairs, n), "MMD_AT_PLUS_A")
    np.testing.assert_array_equal(minimum_degree(adjacency(pairs, n)), np.argsort(factor.perm_c))


def test_a_ring_of_hundreds_ties_its_ends():
    """A number gets smaller from node to node round the ring, and none is left of it; the pattern keeps it."""
    n = 400
    pairs = np.stack([np.arange(n), (np.arange(n) + 1) % n], axis=1)
    lower = superlu(adjacency(pairs, n), "NATURAL").L
    assert lower[n - 1, n // 2] == 0.0
    sizes = column_sizes(pairs, np.arange(n), np.ones(n, dtype=int), contiguous(pairs, np.arange(n))[1])
    np.testing.assert_array_equal(sizes[:-2], np.full(n - 2, 3))
    order = contiguous(pairs, minimum_degree(adjacency(pairs, n)))[0]
    assert sorted(order) == list(range(n))


@pytest.mark.parametrize("seed", range(10))
def test_rows_reach_to_the_first_of_their_pairs(seed):
    rng = np.random.default_rng(seed)
    pairs = rng.integers(0, 30, (20 * seed, 2))
    order, reach = narrow_order(adjacency(pairs, 30))
    place = np.argsort(order)[pairs]
    expected = [max([k - place[place.max(axis=1) == k].min(initial=k)]) for k in range(30)]
    np.testing.assert_array_equal(reach, expected)


def test_a_large_matrix_of_anything_tied_to_anything_is_full():
    """A grid has a narrow band; links at random make a wide one, and small matrices are no trouble."""
    n = 70 * 70
    grid = np.arange(n).reshape(70, 70)
    ways = ((grid[1:], grid[:-1]), (grid[:, 1:], grid[:, :-1]))
    streets = np.vstack([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in ways])
    links = np.random.default_rng(0).integers(0, n, (n, 2))
    assert not is_full(narrow_order(adjacency(streets, n))[1])
    assert is_full(narrow_order(adjacency(np.vstack([streets, links]), n))[1])
    assert not is_full(narrow_order(adjacency(links[(links < 2000).all(axis=1)], 2000))[1])
    assert work_of(sparse.csc_matrix(adjacency(np.vstack([streets, links]), n))) == np.inf


def test_a_matrix_is_counted_by_its_pattern():
    """Of an arrow with its head last: two entries in every column, which the last one continues."""
    arrow = np.eye(5)
    arrow[-1] = arrow[:, -1] = 1.0
    matrix = sparse.csc_matrix(arrow)
    assert sorted(map(tuple, pairs_of(matrix).tolist())) == [(0, 4), (1, 4), (2, 4), (3, 4)]
    assert work_of(matrix) == 4 * 2**2 + 1


@pytest.mark.parametrize("seed", range(5))
def test_columns_of_one_pattern_are_eliminated_together(seed):
    """Three columns for each node of a graph, and one more that half of the first columns touch."""
    rng = np.random.default_rng(seed)
    n = 40
    pairs = np.vstack([np.stack([np.arange(n - 1), np.arange(1, n)], axis=1), rng.integers(0, n, (10 * seed, 2))])
    nodes = adjacency(pairs, n)
    more = np.zeros((1, 3 * n))
    more[0, : 3 * (n // 2) : 3] = 1.0
    three = sparse.kron(nodes, np.ones((3, 3)))
    matrix = sparse.csc_matrix(sparse.bmat([[three + sparse.eye(3 * n), more.T], [more, np.array([[1e6]])]]))
    matrix.sort_indices()
    group, found = alike_columns(matrix)
    # The first columns of the first half stand alone, the others are one group of each node, and the last column is one.
    assert len(np.unique(group)) == 2 * (n // 2) + (n - n // 2) + 1
    first = np.unique(group, return_index=True)[1]
    linked = np.tril(matrix[first][:, first].toarray(), -1) != 0.0
    assert set(map(tuple, found.tolist())) == set(zip(*np.nonzero(linked.T), strict=True))
    order = order_of_columns(matrix)
    assert sorted(order) == list(range(3 * n + 1))
    place = np.argsort(order)
    assert np.all(np.diff(place)[np.diff(group) == 0] == 1)
    parent = elimination_tree(pairs_of(matrix), order)
    size = np.ones(len(parent), dtype=int)
    for column, above in enumerate(parent):
        if above < len(parent):
            size[above] += size[column]
    # In one piece: the last of a subtree before its root is a child of it.
    assert all(size[c] == 1 or parent[c - 1] == c for c in range(len(parent)))
    assert column_sizes(pairs_of(matrix), order, np.ones(3 * n + 1, dtype=int), parent).sum() <= 1.2 * filled_by_columns(matrix)


def filled_by_columns(matrix):
    """Return the entries of a factor by minimum degree of single columns."""
    pairs, n = pairs_of(matrix), matrix.shape[0]
    order, parent = contiguous(pairs, minimum_degree(adjacency(pairs, n)))
    return column_sizes(pairs, order, np.ones(n, dtype=int), parent).sum()
