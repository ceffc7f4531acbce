"""Certificates: laws of the forms that bound the cost, brute force, and minima planted global and local."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted_graphs import every_kind, loop, plain_ranges, relative_edges
from scipy import sparse

from uwblite import se2
from uwblite.graph.certificate import TangentForm, _gap, _is_positive, certificate_matrix, certify
from uwblite.graph.graph import Graph, PriorEdges
from uwblite.graph.point_edges import AnchorDistanceEdges, LandmarkEdges, PointDistanceEdges
from uwblite.graph.pose_edges import RelativePoseEdges
from uwblite.graph.robust import Kernel
from uwblite.graph.solver import SolverConfig, optimize
from uwblite.io.g2o import read_g2o

CAREFUL = SolverConfig(relative_decrease=1e-15)


def near(seed):
    """Return a graph with every kind of edges that have a form, measured near its estimates, information of any shape."""
    rng = np.random.default_rng(seed)
    graph, _ = every_kind(seed)
    poses, anchors, e = graph.poses, graph.anchors, 8
    i = rng.integers(0, 6, e, dtype=np.intp)
    j, a = (i + rng.integers(1, 6, e, dtype=np.intp)) % 6, rng.integers(0, 3, e, dtype=np.intp)

    def noisy(values):
        return values + rng.normal(scale=0.2, size=values.shape)

    L3, L2 = np.eye(3) + rng.normal(scale=0.15, size=(e, 3, 3)), rng.normal(size=(e, 2, 2))
    apart, b = noisy(np.hypot(*(poses[i, :2] - anchors[a]).T)), (a + 1) % 3
    points, sigma = rng.normal(size=(2, e, 2)), rng.uniform(0.3, 1.0, e)
    length = np.hypot(*(se2.transform(poses[i], points[0]) - se2.transform(poses[j], points[1])).T)
    ranges = replace(plain_ranges(i, a, apart, 0.5), height=rng.uniform(size=e), lever_arm=points[0], tag=points[1, 0])
    edges = (
        RelativePoseEdges(i, j, noisy(se2.between(poses[i], poses[j])), L3, weights=rng.uniform(size=e)),
        ranges,
        AnchorDistanceEdges(a, b, noisy(np.hypot(*(anchors[a] - anchors[b]).T)), sigma),
        PointDistanceEdges(i, j, *points, noisy(length), sigma),
        LandmarkEdges(i, a, noisy(se2.transform(se2.inverse(poses[i]), anchors[a])), L2),
        PriorEdges("poses", i, noisy(poses[i]), L3),
        PriorEdges("anchors", a, noisy(anchors[a]), L2),
    )
    return replace(graph, edges=edges)


def numbers(form, graph, poses, anchors):
    """Return the complex numbers of other poses and anchors, about the origin of the form."""
    middle = graph.poses[:, :2].mean(axis=0)
    xy = np.concatenate([poses[:, :2], anchors]) - middle
    return np.concatenate([xy[:, 0] + 1j * xy[:, 1], np.exp(1j * poses[:, 2]), [1.0]])


@pytest.mark.parametrize("kind", range(7))
def test_forms_lie_below_the_cost_and_touch_it_at_the_estimate(kind):
    for seed in range(4):
        whole = near(seed)
        graph = replace(whole, edges=whole.edges[kind : kind + 1])
        form = TangentForm(graph)
        M = form.matrix()
        constant = graph.chi2() - np.real(form.x.conj() @ M @ form.x)

        def difference(poses, anchors, graph=graph, form=form, M=M, constant=constant):
            x = numbers(form, graph, poses, anchors)
            return replace(graph, poses=poses, anchors=anchors).chi2() - np.real(x.conj() @ M @ x) - constant

        rng = np.random.default_rng(seed)
        for size in (1e-4, 1.0, 30.0):
            for _ in range(15):
                poses = graph.poses + rng.normal(scale=size, size=graph.poses.shape)
                anchors = graph.anchors + rng.normal(scale=size, size=graph.anchors.shape)
                above = difference(poses, anchors)
                scale = graph.chi2() + size**2
                assert above >= -1e-9 * scale
                if size == 1e-4:  # the same gradient: what is left is of second order
                    assert above <= 1e4 * size**2


def test_the_estimate_is_in_the_null_space_of_the_matrix():
    graph = optimize(loop(2)[0], CAREFUL)[0]
    S, D = certificate_matrix(graph)
    x = np.concatenate([graph.poses[1:, 0] + 1j * graph.poses[1:, 1], graph.anchors @ [1, 1j], np.exp(1j * graph.poses[1:, 2])])
    middle = np.where(D[:-1] > 0, 0.0, graph.poses[:, :2].mean(axis=0) @ [1, 1j])
    # H's scale is 1e4.
    np.testing.assert_allclose(S @ np.append(x - middle, 1.0), 0.0, atol=1e-3)
    np.testing.assert_allclose((S - S.conj().T).toarray(), 0.0, atol=1e-9)


def ring(seed, n=20, noise=0.03):
    """Return a ring of poses with one closure, started at the truth, information not the same in x and y; and the truth."""
    rng = np.random.default_rng(seed)
    angle = np.arange(n) * 2.0 * np.pi / n
    truth = np.column_stack([5.0 * np.sin(angle), 5.0 - 5.0 * np.cos(angle), se2.wrap_angle(angle)])
    i = np.arange(n)
    edges = relative_edges(truth, i, (i + 1) % n, [noise, 0.7 * noise, noise], rng)
    return Graph(truth, edges=(edges,)), truth


@pytest.mark.parametrize("seed", range(2))
def test_a_ring_is_certified_and_one_wound_once_more_is_not(seed):
    graph, truth = ring(seed)
    assert certify(optimize(graph)[0]).is_global
    wound = truth.copy()
    wound[:, 2] = se2.wrap_angle(truth[:, 2] + np.arange(len(truth)) * 2.0 * np.pi / len(truth))
    local, summary = optimize(replace(graph, poses=wound))
    best = optimize(graph)[1].chi2
    assert summary.converged
    assert summary.chi2 > 10.0 * best + 100.0
    certified = certify(local)
    assert not certified.is_global
    assert certified.lower_bound <= best
    assert certified.reason


def brute_force(graph, cells=20):
    """Return the least chi2 of three poses, the first fixed, over all headings: places follow by linear least squares."""
    angle = (np.arange(cells) + 0.5) * 2.0 * np.pi / cells
    tried = []
    for one, other in np.ndindex(cells, cells):
        poses = np.array([[0, 0, 0], [0, 0, angle[one]], [0, 0, angle[other]]])
        lin = graph.edges[0].linearize(replace(graph, poses=poses))
        J = np.zeros((3 * len(graph.edges[0]), 6))
        for _, index, jacobian in lin.blocks:
            for e, p in enumerate(index):
                J[3 * e : 3 * e + 3, 2 * p : 2 * p + 2] += jacobian[e][:, :2]
        poses[1:, :2] = np.linalg.lstsq(J[:, 2:], -lin.residuals.ravel(), rcond=None)[0].reshape(2, 2)
        tried.append((replace(graph, poses=poses).chi2(), poses))
    tried.sort(key=lambda one: one[0])
    return min(optimize(replace(graph, poses=poses), CAREFUL)[1].chi2 for _, poses in tried[:10])


@pytest.mark.slow
def test_certificates_of_tiny_graphs_agree_with_brute_force():
    certified = 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        i, j = np.array([0, 1, 2, 0]), np.array([1, 2, 0, 2])
        L = np.eye(3) * rng.uniform(0.5, 3.0, (4, 3))[:, :, None]
        measured = np.column_stack([rng.normal(scale=2.0, size=(4, 2)), rng.uniform(-np.pi, np.pi, 4)])
        graph = Graph(np.zeros((3, 3)), edges=(RelativePoseEdges(i, j, measured, L),))
        least = brute_force(graph)
        for _ in range(4):
            poses = np.column_stack([rng.normal(size=(3, 2)), rng.uniform(-np.pi, np.pi, 3)]) * [[0], [1], [1]]
            found, summary = optimize(replace(graph, poses=poses), CAREFUL)
            of_this = certify(found)
            assert of_this.lower_bound <= least * (1.0 + 1e-6)
            if of_this.is_global:
                certified += 1
                assert summary.chi2 == pytest.approx(least, rel=2e-6, abs=2e-3)
    assert certified >= 6


def trilateration(poses, bias, seed=0):
    """Return one anchor and ranges to it from fixed poses."""
    n, anchor = len(poses), np.array([[1.0, 3.0]])
    noise = np.random.default_rng(seed).normal(scale=0.02, size=n)
    ranges = plain_ranges(np.arange(n), np.zeros(n, dtype=int), np.hypot(*(poses - anchor).T) + bias + noise, 0.1)
    return Graph(np.column_stack([poses, np.zeros(n)]), anchor, (ranges,), fixed_poses=np.ones(n, dtype=bool))


@pytest.mark.parametrize("seed", range(2))
def test_the_mirror_image_of_an_anchor_is_not_certified(seed):
    along = np.column_stack([np.linspace(-5, 5, 12), np.random.default_rng(seed).normal(scale=0.5, size=12)])
    graph = trilateration(along, 0.0, seed)
    best = optimize(graph)[1].chi2
    mirrored, other = optimize(replace(graph, anchors=graph.anchors * [1, -1]))
    assert other.chi2 > best + 1.0
    certified = certify(mirrored)
    assert not certified.is_global
    assert certified.lower_bound <= best


@pytest.mark.parametrize("seed", range(2))
def test_an_anchor_amid_poses_is_certified_unless_its_ranges_want_it_out_of_the_plane(seed):
    angle = np.arange(12) * np.pi / 6
    around = np.column_stack([1.0 + 4.0 * np.cos(angle), 3.0 + 4.0 * np.sin(angle)])
    assert certify(optimize(trilateration(around, -0.2, seed))[0]).is_global
    assert not certify(optimize(trilateration(around, 0.2, seed))[0]).is_global


@pytest.mark.parametrize("seed", range(2))
def test_where_the_map_lies_does_not_matter(seed):
    graph, truth = ring(seed)
    far = se2.compose([3e5, -4e6, 2.0], truth)
    assert certify(optimize(replace(graph, poses=far))[0]).is_global
    fixed = np.zeros(len(truth), dtype=bool)
    fixed[[0, 7]] = True
    assert certify(optimize(replace(graph, poses=far, fixed_poses=fixed))[0]).is_global
    free = replace(graph, fixed_poses=np.zeros(len(truth), dtype=bool))
    assert certify(optimize(free)[0]).is_global


def test_what_is_outside_the_relaxation_is_named():
    graph, _ = ring(0)
    robust = replace(graph, edges=(replace(graph.edges[0], kernel=Kernel("huber", 2.0)),))
    assert "huber" in certify(robust).reason
    assert "calibration" in certify(every_kind(0)[0].with_edges(every_kind(0)[1]["odometry"])).reason


@pytest.mark.parametrize("name", ["efpno_manhattanOlson3500", "sesync_intel", "sesync_CSAIL"])
def test_public_pose_graphs_are_certified(name, shared_data):
    graph = optimize(read_g2o(shared_data / "pose_graphs" / f"{name}.g2o.gz").graph)[0]
    certified = certify(graph)
    assert certified.is_global
    assert certified.lower_bound == pytest.approx(graph.chi2(), abs=2e-3)


def test_an_edge_that_measures_no_turn_is_as_good_as_any():
    graph, truth = ring(0)
    across = relative_edges(truth, np.array([0, 5]), np.array([10, 15]), [0.03, 0.03, 0.03])
    places = replace(across, sqrt_information=across.sqrt_information * [[1.0], [1.0], [0.0]])
    certified = certify(optimize(graph.with_edges(places))[0])
    assert certified.is_global, certified.reason


def test_a_landmark_that_nothing_measures_takes_no_certificate_away():
    graph, _ = ring(0)
    lonely = replace(graph, anchors=np.array([[3.0, 4.0]]), fixed_anchors=np.zeros(1, dtype=bool))
    certified = certify(optimize(lonely)[0])
    assert certified.is_global, certified.reason


@pytest.mark.parametrize("below", [0.0, 0.3, 4.0, 49.0, 51.0])
def test_the_gap_is_what_must_be_added_to_all_headings_together(below):
    """Five numbers of headings and one of a place; the eigenvalues of the headings begin at a given one."""
    headings = np.random.default_rng(1).normal(size=(5, 5))
    vectors = np.linalg.qr(headings)[0]
    S = np.zeros((6, 6))
    S[:5, :5], S[5, 5] = vectors @ np.diag([-below, 1.0, 2.0, 3.0, 4.0]) @ vectors.T, 7.0
    D = np.array([1.0] * 5 + [0.0])
    found = _gap(sparse.csc_matrix(S), D, 0.01, 250.0)
    expected = 0.01 if below == 0.0 else 5.0 * below if below < 50.0 else np.inf
    assert found == pytest.approx(expected, rel=0.02)
    assert expected <= found * (1.0 + 1e-9)
    # What is negligible already exceeds the whole cost: there is nothing between.
    assert _gap(sparse.csc_matrix(S), D, 1000.0, 250.0) == 1000.0
    assert _gap(sparse.csc_matrix(S - 300.0 * np.eye(6)), D, 1000.0, 250.0) == np.inf


@pytest.mark.parametrize(
    ("matrix", "positive"),
    [(np.eye(3), True), (-np.eye(3), False), (np.zeros((2, 2)), False), ([[0, 1], [1, 0]], False), ([[2, 1], [1, 2]], True)],
)
def test_a_matrix_is_positive_or_not(matrix, positive):
    assert _is_positive(sparse.csc_matrix(np.array(matrix, dtype=float)), np.zeros(len(matrix))) is positive
    assert _is_positive(sparse.csc_matrix(np.array(matrix, dtype=float)), np.full(len(matrix), 1.5)) is True


def test_a_matrix_that_would_fill_up_gives_no_certificate():
    graph = optimize(loop(3, n=200, anchors=0)[0])[0]
    assert certify(graph, 1e12).is_global
    refused = certify(graph, 1e4)
    assert not refused.is_global
    assert refused.lower_bound == 0.0
    assert refused.reason == "its edges tie so many poses to so many others that the matrix would fill up"
