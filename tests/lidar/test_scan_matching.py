"""Matching of pairs: the condensed cost against numbers, known motions, blind directions."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.laser_walks import CORRIDOR, ROOM, scanned
from helpers.registration_worlds import scattered
from hypothesis import given, settings
from hypothesis import strategies as st

from uwblite import se2
from uwblite.graph.graph import Graph
from uwblite.graph.pose_edges import RelativePoseEdges
from uwblite.lidar.cloud_rasters import rasterize
from uwblite.lidar.scan_matching import PairFactors, match, measured, nondegenerate_step, pairs_of


def listed(pairs, pair):
    """Return the rows of the points of one pair."""
    return pairs.points[pair][pairs.points[pair] >= 0]


@settings(max_examples=20)
@given(st.integers(0, 1000), st.integers(1, 60))
def test_pair_points_are_spread_over_the_points_with_normals(seed, limit):
    rng = np.random.default_rng(seed)
    clouds = scattered(rng, [30, 0, 3, 100])
    j = np.array([3, 1, 0, 2, 3])
    pairs = pairs_of(clouds, j, j, limit)
    for pair, cloud in enumerate(j):
        rows = listed(pairs, pair)
        own = np.flatnonzero((clouds.owner == cloud) & np.any(clouds.normals != 0.0, axis=1))
        assert len(rows) == pairs.asked[pair].sum() == min(limit, len(own))
        assert np.isin(rows, own).all()
        assert len(np.unique(rows)) == len(rows)
        if len(rows):
            gaps = np.diff(np.searchsorted(own, rows), append=len(own))
            assert gaps.max() <= -(-len(own) // len(rows)) + 1


def by_hand(clouds, raster, i, pose, rows, gate, scale):
    """Return the matches of one pair by a loop: source points (m, 2), target points, normals, variances (m,)."""
    found = []
    for row in rows:
        at = se2.transform(pose, clouds.points[row])
        cx, cy = np.floor((at - raster.origin[i]) / raster.cell).astype(int)
        if not (0 <= cx < raster.shape[i, 0] and 0 <= cy < raster.shape[i, 1]):
            continue
        number = raster.cells(i)[cx, cy]
        target = clouds.offsets[i] + number
        if number < 0 or np.hypot(*(at - clouds.points[target])) > gate:
            continue
        if clouds.normals[target] @ se2.rotate(pose[2], clouds.normals[row]) > np.sqrt(0.5):
            scatter = clouds.normal_variance[row] + clouds.normal_variance[target]
            found.append((clouds.points[row], clouds.points[target], clouds.normals[target], scatter))
    return [np.array(part) for part in zip(*found, strict=True)]


@pytest.mark.parametrize("seed", range(4))
def test_factors_are_those_of_the_cost_with_fixed_matches(seed):
    rng = np.random.default_rng(seed)
    truth = np.array([[0.0, 0.0, 0.3], [0.5, -0.4, 0.9], [-0.6, 0.2, -2.0]])
    clouds = scanned(truth, ROOM, 0.01, seed)
    raster, gate, scale = rasterize(clouds, 0.05, 0.4), 0.3, 0.08
    i, j = np.array([0, 0, 2]), np.array([1, 2, 1])
    pose = se2.between(truth[i], truth[j]) + rng.normal(0, 0.03, (3, 3))
    pairs = pairs_of(clouds, i, j, 120)
    factors = match(raster, pairs, pose, gate, scale)
    for e in range(3):
        rows = listed(pairs, e)
        source, target, normal, scatter = by_hand(clouds, raster, i[e], pose[e], rows, gate, scale)
        assert factors.asked[e] == len(rows)
        assert factors.matched[e] == len(source)

        def residual(x, source=source, target=target, normal=normal):
            return np.einsum("pi,pi->p", normal, se2.transform(x, source) - target)

        r, step = residual(pose[e]), 1e-6
        jacobian = np.column_stack([(residual(pose[e] + d) - residual(pose[e] - d)) / (2 * step) for d in step * np.eye(3)])
        w = (1 + (r / scale) ** 2) ** -2
        np.testing.assert_allclose(factors.hessian[e], (jacobian * w[:, None]).T @ jacobian, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(factors.gradient[e], jacobian.T @ (w * r), rtol=1e-5, atol=1e-7)
        assert factors.squared[e] == pytest.approx(np.sum(w * r * r))
        assert factors.weight[e] == pytest.approx(np.sum(w))
        along = np.column_stack([-normal[:, 1], normal[:, 0]])
        slide = np.column_stack(
            [(residual(pose[e] + d, normal=along) - residual(pose[e] - d, normal=along)) / (2 * step) for d in step * np.eye(3)]
        )
        spurious = (slide * (w * scatter)[:, None]).T @ slide
        np.testing.assert_allclose(factors.spurious[e], spurious, rtol=1e-4, atol=1e-4 * np.abs(spurious).max())

        def cost(x, residual=residual):
            s = residual(x) ** 2
            return 0.5 * np.sum(s / (1 + s / scale**2))

        slope = [(cost(pose[e] + d) - cost(pose[e] - d)) / (2 * step) for d in step * np.eye(3)]
        np.testing.assert_allclose(factors.gradient[e], slope, rtol=1e-4, atol=1e-6)


def test_a_point_of_weight_two_counts_as_two_and_one_of_none_not_at_all():
    truth = np.array([[0.0, 0.0, 0.3], [0.5, -0.4, 0.9]])
    clouds = scanned(truth, ROOM, 0.01, 3)
    raster, i, j = rasterize(clouds, 0.05, 0.4), np.array([0]), np.array([1])
    pose, pairs = se2.between(truth[i], truth[j]) + 0.01, pairs_of(clouds, i, j, 120)
    rows, weight = listed(pairs, 0), np.ones(len(clouds.points))
    weight[rows[::2]], weight[rows[1::2]] = 2.0, 0.0
    whole = match(raster, pairs, pose, 0.3, 0.08, weight)
    half = match(raster, replace(pairs, points=rows[None, ::2]), pose, 0.3, 0.08)
    for name in ("hessian", "gradient", "spurious", "squared", "weight"):
        np.testing.assert_allclose(getattr(whole, name), 2.0 * getattr(half, name), rtol=1e-9, atol=1e-9)
    assert whole.asked[0] == len(rows)


def test_each_pair_may_have_its_own_gate_and_kernel():
    """More pairs than are looked up at once."""
    rng = np.random.default_rng(4)
    truth = np.array([[0.0, 0.0, 0.3], [0.5, -0.4, 0.9], [-0.6, 0.2, -2.0]])
    clouds = scanned(truth, ROOM, 0.01, 3)
    raster, i, j = rasterize(clouds, 0.05, 0.4), rng.integers(0, 3, 200), rng.integers(0, 3, 200)
    pose, pairs = se2.between(truth[i], truth[j]) + 0.02, pairs_of(clouds, i, j, 120)
    gate, scale = rng.choice([0.05, 0.1, 0.3], 200), rng.choice([0.02, 0.1], 200)
    together = match(raster, pairs, pose, gate, scale)
    for one, width in ((0.05, 0.02), (0.1, 0.1), (0.3, 0.02)):
        own = np.flatnonzero((gate == one) & (scale == width))
        alone = match(raster, pairs.rows(own), pose[own], one, width)
        for name in ("hessian", "spurious", "gradient", "matched", "squared", "weight"):
            np.testing.assert_allclose(getattr(together, name)[own], getattr(alone, name), rtol=1e-12, atol=1e-12)


def converged(clouds, raster, i, j, guess, gates=(0.4, 0.3, 0.2, 0.1, 0.1, 0.1, 0.1, 0.1)):
    """Return the poses after rounds of matching and stepping, and the last factors and measurement."""
    pairs, pose = pairs_of(clouds, i, j, 200), guess.copy()
    for gate in gates:
        factors = match(raster, pairs, pose, gate, gate / 2)
        before = pose
        pose, root = measured(factors, pose, np.ones(len(i)))
    return before, factors, pose, root


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_known_motions_are_recovered(noise):
    rng = np.random.default_rng(5)
    truth = np.column_stack([rng.uniform(-1.5, 0.5, 8), rng.uniform(-1.5, 1.5, 8), rng.uniform(-3, 3, 8)])
    clouds = scanned(truth, ROOM, noise, 6)
    i, j = np.triu_indices(8, 1)
    exact = se2.between(truth[i], truth[j])
    guess = exact + np.column_stack([rng.uniform(-0.15, 0.15, (len(i), 2)), rng.uniform(-0.08, 0.08, len(i))])
    _, factors, pose, root = converged(clouds, rasterize(clouds, 0.04, 0.4), i, j, guess)
    error = se2.between(exact, pose)
    # Noise-free: what is left comes from averaging in cells of 0.02 m on slanting walls and at corners.
    variance = np.linalg.inv(np.swapaxes(root, 1, 2) @ root)
    # Two clouds err, each point and the line it is matched with, which neighbouring matches share.
    sigma = np.sqrt(np.einsum("eii->ei", variance)) * noise * np.sqrt(2 * 4)
    assert np.all(np.abs(error) < 0.002 + 4 * sigma)
    assert np.all(factors.matched > 0.4 * factors.asked)


def test_a_corridor_constrains_across_and_not_along():
    truth = np.array([[0.0, 0.1, 0.3], [0.7, -0.2, 1.5]])
    clouds = scanned(truth, CORRIDOR)
    i, j = np.array([0]), np.array([1])
    exact = se2.between(truth[0], truth[1])
    along = se2.rotate(-truth[0, 2], np.array([1.0, 0.0]))
    guess = exact + np.array([*(0.1 * along), 0.0])
    _, _, pose, root = converged(clouds, rasterize(clouds, 0.04, 0.4), i, j, guess[None])
    information = root[0].T @ root[0]
    shift = se2.rotate(-pose[0, 2], along)
    assert np.array([*shift, 0.0]) @ information @ np.array([*shift, 0.0]) < 1e-9 * np.trace(information)
    assert np.linalg.matrix_rank(information, tol=1e-6 * np.trace(information)) == 2
    moved = se2.rotate(truth[0, 2], pose[0, :2] - exact[:2])
    assert moved[0] == pytest.approx(0.1, abs=0.01)
    assert abs(moved[1]) < 0.002
    assert abs(pose[0, 2] - exact[2]) < 0.002


def factors_of(hessian, gradient, spurious=None) -> PairFactors:
    """Return the factors of one pair with this quadratic form."""
    one = np.ones(1)
    spurious = np.zeros((3, 3)) if spurious is None else spurious
    return PairFactors(hessian[None], spurious[None], gradient[None], one.astype(int), one.astype(int), one, one)


def quadratic_form(rng, rank):
    """Return hessian and gradient of random residuals whose Jacobian has this rank."""
    jacobian = rng.normal(size=(40, rank)) @ rng.normal(size=(rank, 3)) * [1.0, 1.0, 2.0]
    return jacobian.T @ jacobian, jacobian.T @ rng.normal(0, 0.01, 40)


@settings(max_examples=25)
@given(st.integers(0, 10_000), st.integers(1, 3))
def test_a_measurement_has_the_cost_of_its_factors(seed, rank):
    """For any pose T near the one matched at, |L e(T)|^2 differs from the quadratic form by a constant."""
    rng = np.random.default_rng(seed)
    at, variance = rng.uniform(-3, 3, 3), 0.3
    hessian, gradient = quadratic_form(rng, rank)
    z, root = measured(factors_of(hessian, gradient), at[None], np.array([variance]))
    edge = RelativePoseEdges(np.array([0]), np.array([1]), z, root)
    steps = rng.normal(0, 0.02, (6, 3))
    quadratic = [(s @ hessian @ s + 2 * gradient @ s) / variance for s in steps]
    errors = [edge.residuals(Graph(np.array([np.zeros(3), at + s])))[0] for s in steps]
    got = [e @ e for e in errors]
    np.testing.assert_allclose(np.diff(got), np.diff(quadratic), rtol=1e-6, atol=1e-6 * np.abs(quadratic).max())
    assert np.linalg.matrix_rank(root[0], tol=1e-6 * np.abs(root[0]).max()) == rank


@settings(max_examples=25)
@given(st.integers(0, 10_000))
def test_what_scatter_adds_is_taken_off_and_never_more(seed):
    """0 <= information <= H, and a direction in which H is less than twice the spurious information is not moved."""
    rng = np.random.default_rng(seed)
    (hessian, gradient), (spurious, _) = quadratic_form(rng, 3), quadratic_form(rng, 3)
    spurious *= 10 ** rng.uniform(-3, 1)
    step, root = nondegenerate_step(hessian[None], spurious[None], gradient[None])
    information = root[0].T @ root[0]
    size = np.trace(hessian)
    assert np.linalg.eigvalsh(hessian - information).min() > -1e-6 * size
    lost = np.linalg.eigvals(np.linalg.solve(spurious, hessian)).real < 2.0
    assert np.linalg.matrix_rank(information, tol=1e-9 * size) == 3 - lost.sum()
    if not lost.any():
        np.testing.assert_allclose(step[0], -np.linalg.solve(hessian, gradient), rtol=1e-5, atol=1e-8)


def test_headings_are_wrapped():
    factors = factors_of(np.eye(3) * 100.0, np.array([0.0, 0.0, -10.0]))
    z, _ = measured(factors, np.array([[0.0, 0.0, np.pi - 0.05]]), np.ones(1))
    assert z[0, 2] == pytest.approx(-np.pi + 0.05)


def test_nothing_to_match_is_no_information():
    clouds = scattered(np.random.default_rng(0), [5, 0, 5])
    raster = rasterize(clouds, 0.1, 0.3)
    none = np.zeros(0, dtype=np.intp)
    empty = match(raster, pairs_of(clouds, none, none, 10), np.zeros((0, 3)), 0.3, 0.1)
    assert measured(empty, np.zeros((0, 3)), np.zeros(0))[1].shape == (0, 3, 3)
    i, j, far = np.array([0, 1, 0]), np.array([1, 0, 2]), np.full((3, 3), 50.0)
    factors = match(raster, pairs_of(clouds, i, j, 10), far, 0.3, 0.1)
    assert factors.matched.tolist() == [0, 0, 0]
    z, root = measured(factors, far, np.ones(3))
    assert np.all(root == 0.0)
    np.testing.assert_array_equal(z[:, :2], far[:, :2])
    assert np.isfinite(z).all()


def test_opposite_sides_of_a_thin_wall_do_not_match():
    """Two lasers on either side of a wall 2 cm thick see the same line; their normals distinguish the sides."""
    walls = np.array([[-3.0, 0.0, 3.0, 0.0], [-3.0, 0.02, 3.0, 0.02]])
    truth = np.array([[0.0, -1.5, 0.0], [0.0, 1.5, 0.0], [0.5, -1.5, 0.0]])
    clouds = scanned(truth, walls)
    i, j = np.array([0, 0]), np.array([1, 2])
    pairs = pairs_of(clouds, i, j, 100)
    factors = match(rasterize(clouds, 0.04, 0.3), pairs, se2.between(truth[i], truth[j]), 0.2, 0.1)
    assert factors.matched[0] == 0
    assert factors.matched[1] > 50
