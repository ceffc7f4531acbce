"""Symbolic elimination against elimination by brute force, and against SuperLU's own order."""

import numpy as np
import pytest
from scipy import sparse

from uwblite.graph.elimination import (
    EliminationPolicy,
    _pairs_of,
    adjacency,
    choose_ordering,
    column_sizes,
    count_multiplications,
    elimination_tree,
    fills_in_any_order,
    minimum_degree,
    multiplications_of,
    narrow_order,
    order_of_columns,
    postorder,
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
    order, tree = postorder(pairs, order)
    parent, sizes = by_brute_force(pairs, order, width)
    np.testing.assert_array_equal(tree, parent)
    np.testing.assert_array_equal(column_sizes(pairs, order, width, parent), sizes)
    above = np.append(sizes, 0)[parent]
    continued = [top == size - width[k] for k, top, size in zip(order, above, sizes, strict=True)]
    alone = EliminationPolicy.alone
    each = [width[k] * size**2 * (1 if more else alone) for k, size, more in zip(order, sizes, continued, strict=True)]
    assert count_multiplications(pairs, order, width, parent) == sum(each)


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
    sizes = column_sizes(pairs, np.arange(n), np.ones(n, dtype=int), postorder(pairs, np.arange(n))[1])
    np.testing.assert_array_equal(sizes[:-2], np.full(n - 2, 3))
    order = postorder(pairs, minimum_degree(adjacency(pairs, n)))[0]
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
    assert not fills_in_any_order(narrow_order(adjacency(streets, n))[1])
    assert fills_in_any_order(narrow_order(adjacency(np.vstack([streets, links]), n))[1])
    assert not fills_in_any_order(narrow_order(adjacency(links[(links < 2000).all(axis=1)], 2000))[1])
    assert multiplications_of(sparse.csc_matrix(adjacency(np.vstack([streets, links]), n))) == np.inf


def test_a_matrix_is_counted_by_its_pattern():
    """Of an arrow with its head last: two entries in every column, which the last one continues."""
    arrow = np.eye(5)
    arrow[-1] = arrow[:, -1] = 1.0
    matrix = sparse.csc_matrix(arrow)
    assert sorted(map(tuple, _pairs_of(matrix).tolist())) == [(0, 4), (1, 4), (2, 4), (3, 4)]
    assert multiplications_of(matrix) == EliminationPolicy.per_complex * (4 * 2**2 + 1)


@pytest.mark.parametrize("seed", range(5))
def test_subtrees_of_columns_are_contiguous(seed):
    """Three columns for each node of a graph, and one more that half of the first columns touch."""
    rng = np.random.default_rng(seed)
    n = 40
    pairs = np.vstack([np.stack([np.arange(n - 1), np.arange(1, n)], axis=1), rng.integers(0, n, (10 * seed, 2))])
    more = np.zeros((1, 3 * n))
    more[0, : 3 * (n // 2) : 3] = 1.0
    three = sparse.kron(adjacency(pairs, n), np.ones((3, 3)))
    matrix = sparse.csc_matrix(sparse.bmat([[three + sparse.eye(3 * n), more.T], [more, np.array([[1e6]])]]))
    order = order_of_columns(matrix)
    assert sorted(order) == list(range(3 * n + 1))
    parent = elimination_tree(_pairs_of(matrix), order)
    size = np.ones(len(parent), dtype=int)
    for column, above in enumerate(parent):
        if above < len(parent):
            size[above] += size[column]
    # In one piece: the last of a subtree before its root is a child of it.
    assert all(size[c] == 1 or parent[c - 1] == c for c in range(len(parent)))


def test_poses_tied_to_any_others_are_left_to_iteration_before_work_is_counted():
    """Those along a chain alone are a band."""
    n = 4000
    chain, width = np.stack([np.arange(n - 1), np.arange(1, n)], axis=1), np.full(n, 3)
    links = np.random.default_rng(0).integers(0, n, (n, 2))
    ordering = choose_ordering(np.vstack([chain, links]), n, width)
    assert (ordering.iterative, ordering.work) == (True, 0.0)
    np.testing.assert_array_equal(ordering.order, np.arange(n))
    banded = choose_ordering(chain, n, width)
    assert (banded.iterative, banded.banded) == (False, True)
