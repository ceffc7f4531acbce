"""Two-level conjugate gradients against a factorisation, on chains tied together everywhere."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted_graphs import dense_system, relative_edges
from scipy import sparse

from uwblite import se2
from uwblite.errors import SolverError
from uwblite.graph.elimination import EliminationPolicy
from uwblite.graph.graph import Graph, linearize
from uwblite.graph.normal_equations import NormalEquations
from uwblite.graph.schwarz_cg import SchwarzPolicy, TwoLevelFactor, cut, iterated
from uwblite.graph.solver import optimize

_PIECE, _MOST_COARSE = SchwarzPolicy.piece, SchwarzPolicy.most_coarse


def tied(n, each=5, seed=0, is_fixed=()):
    """Return a graph of n poses wandering in a room, each tied to others near by, started 2 cm and 10 mrad off."""
    rng = np.random.default_rng(seed)
    truth = np.column_stack([4.0 * np.cos(0.37 * np.arange(n)), 4.0 * np.sin(0.23 * np.arange(n)), rng.uniform(-3, 3, n)])
    steps = relative_edges(truth, np.arange(n - 1), np.arange(1, n), [0.05, 0.05, 0.02], rng)
    i, j = rng.integers(0, n, (2, each * n))
    near = (i < j - 1) & (np.hypot(*(truth[i, :2] - truth[j, :2]).T) < 4.0)
    ties = relative_edges(truth, i[near], j[near], [0.02, 0.02, 0.01], rng)
    start = se2.compose(truth, rng.normal(0, 1, (n, 3)) * [0.02, 0.02, 0.01])
    start[0] = truth[0]
    fixed = np.isin(np.arange(n), [0, *is_fixed])
    return Graph(start, edges=(steps, ties), fixed_poses=fixed), truth


def system(graph):
    """Return normal equations filled at the graph's estimates."""
    linearized = linearize(graph)
    normal = NormalEquations(graph, linearized)
    normal.fill(linearized, [None] * len(linearized))
    return normal


@pytest.fixture(autouse=True)
def _always(monkeypatch):
    """Iterate however little a factorisation takes."""
    monkeypatch.setattr(EliminationPolicy, "little_work", 0.0)
    monkeypatch.setattr(EliminationPolicy, "per_pose", 0.0)


@pytest.mark.parametrize("is_fixed", [(), (5, 17, 40), (599,)])
def test_solutions_are_those_of_the_dense_matrix(is_fixed):
    graph, _ = tied(600, 20, is_fixed=is_fixed)
    normal = system(graph)
    factor = normal.factor(np.zeros(normal.unknowns.size))
    assert isinstance(factor, TwoLevelFactor)
    H, g, number = dense_system(graph)
    np.testing.assert_array_equal(number["poses"], normal.unknowns.number["poses"])
    exact = np.linalg.solve(H, -g)
    found = factor.solve(-np.asarray(normal.gradient))
    error = found - exact
    assert error @ H @ error < (3.0 * SchwarzPolicy.enough) ** 2 * (exact @ H @ exact)
    both = factor.solve(np.stack([-np.asarray(normal.gradient), np.ones(len(g))], axis=1))
    np.testing.assert_array_equal(both[:, 0], found)


def test_the_number_of_iterations_hardly_grows_with_the_length():
    counts = []
    for n in (600, 2400):
        normal = system(tied(n, 20)[0])
        factor = normal.factor(np.zeros(normal.unknowns.size))
        calls = []
        nearly = factor._nearly
        factor._nearly = lambda residual, nearly=nearly, calls=calls: (calls.append(1), nearly(residual))[1]
        factor.solve(-np.asarray(normal.gradient))
        counts.append(len(calls))
    assert counts[1] < 1.5 * counts[0]


def test_pieces_end_with_their_chains():
    """Two chains of a piece and a half and of half a piece: three pieces, none of which goes across."""
    first, count = _PIECE + _PIECE // 2, 2 * _PIECE
    places = np.arange(3 * count).reshape(count, 3)
    pieces = cut(places, np.zeros((count, 3)), 3 * count, np.arange(count - 1) != first - 1)
    owner = [np.unique(own[own < 3 * count] // 3) for own in pieces.number]
    assert [(own[0], own[-1] + 1) for own in owner] == [(0, _PIECE), (_PIECE, first), (first, count)]
    assert pieces.basis.shape == (3 * count, 9)


def test_the_minimum_is_that_of_the_factorisation(monkeypatch):
    graph, truth = tied(700, 20)
    found, summary = optimize(graph)
    monkeypatch.setattr(EliminationPolicy, "little_work", np.inf)
    expected, direct = optimize(graph)
    assert summary.converged
    assert summary.chi2 == pytest.approx(direct.chi2, rel=1e-6)
    np.testing.assert_allclose(found.poses, expected.poses, atol=1e-4)
    # A tie alone would know a pose to 0.02 m either way.
    assert np.sqrt(np.mean(np.sum((found.poses - truth)[:, :2] ** 2, axis=1))) < 0.02 * np.sqrt(2.0)


def test_an_indefinite_matrix_is_refused():
    graph, _ = tied(600, 20)
    normal = system(graph)
    with pytest.raises(SolverError, match="singular"):
        normal.factor(-2.0 * np.asarray(normal.diagonal))


def test_a_direction_that_costs_nothing_or_less_is_refused():
    """The pieces and the coarse level may be positive definite where the whole matrix is not."""
    normal = system(tied(600, 20)[0])
    factor = normal.factor(np.zeros(normal.unknowns.size))
    factor._matrix = -factor._matrix
    with pytest.raises(SolverError, match="singular"):
        factor.solve(np.ones(normal.unknowns.size))


def test_the_coarse_level_moves_pieces_as_rigid_bodies_and_all_else_on_its_own():
    """A small motion of a piece about its middle, in differences; an unknown that is no pose has a column of its own."""
    rng = np.random.default_rng(3)
    count, size = 2 * _PIECE, 6 * _PIECE + 4
    poses, places = rng.normal(size=(count, 3)), rng.permutation(size)
    number, others = places[: 3 * count].reshape(count, 3), np.sort(places[3 * count :])
    basis = cut(number, poses, size, np.ones(count - 1, dtype=bool)).basis.toarray()
    motion, step = rng.normal(size=(2, 3)), 1e-6
    moved = basis @ np.concatenate([motion.ravel(), rng.normal(size=4)])
    for k in range(2):
        own = np.arange(k * _PIECE, (k + 1) * _PIECE)
        middle = np.append(poses[own, :2].mean(axis=0), 0.0)
        about = se2.compose(se2.compose(middle + step * motion[k], se2.inverse(middle)), poses[own])
        np.testing.assert_allclose(moved[number[own]], (about - poses[own]) / step, atol=1e-4)
    np.testing.assert_array_equal(basis[others][:, 6:], np.eye(4))
    assert not basis[others][:, :6].any()
    assert not basis[number.ravel()][:, 6:].any()


def test_a_star_is_cut_all_the_same():
    """Its poses share no edge with one another; pieces of one pose each would make the coarse level as large as the matrix."""
    count = 2000
    pieces = cut(np.arange(3 * count).reshape(-1, 3), np.zeros((count, 3)), 3 * count, np.zeros(count - 1, dtype=bool))
    assert len(pieces.number) == -(-count // _PIECE)


@pytest.mark.parametrize("others", [_MOST_COARSE, _MOST_COARSE + 1])
def test_thousands_of_anchors_have_pieces_of_their_own(others):
    poses, size = _PIECE, 3 * _PIECE + others
    pieces = cut(np.arange(3 * poses).reshape(-1, 3), np.zeros((poses, 3)), size, np.ones(poses - 1, dtype=bool))
    held = np.sort(pieces.number[pieces.number < size])
    if others > _MOST_COARSE:
        np.testing.assert_array_equal(held, np.arange(size))
        assert pieces.basis.shape == (size, 3)
    else:
        np.testing.assert_array_equal(held, np.arange(3 * poses))
        assert pieces.basis.shape == (size, 3 + others)


def test_steps_told_backwards_make_chains_too():
    """Else every pose is a piece, and the coarse level as large as the matrix."""
    graph, _ = tied(600, 20)
    steps = graph.edges[0]
    back = replace(steps, i=steps.j, j=steps.i, T_i_j=se2.inverse(steps.T_i_j))
    backwards = replace(graph, edges=(back, graph.edges[1]))
    work = [system(g).work for g in (graph, backwards)]
    assert work[0] == work[1]


def test_iterations_are_counted():
    normal = system(tied(600, 20)[0])
    factor = normal.factor(np.zeros(normal.unknowns.size))
    assert iterated(factor) == 0.0
    factor.solve(-np.asarray(normal.gradient))
    once = iterated(factor)
    factor.solve(-np.asarray(normal.gradient))
    assert iterated(factor) == 2.0 * once > 0.0
    assert iterated(None) == 0.0


def test_a_piece_that_nothing_measures_is_refused():
    number = np.arange(180).reshape(60, 3)
    pieces = cut(number, np.zeros((60, 3)), 180, np.ones(59, dtype=bool))
    values = np.where(np.arange(180) < 30, 0.0, 1.0)
    with pytest.raises(SolverError, match="singular"):
        TwoLevelFactor(sparse.csc_matrix(sparse.diags(values)), pieces)
