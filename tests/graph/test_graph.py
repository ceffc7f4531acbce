import itertools
from dataclasses import replace

import numpy as np
import pytest
from helpers.planted_graphs import every_kind, expected_ranges

from uwblite import se2
from uwblite.errors import DataError
from uwblite.graph.graph import Calibration, Graph, PriorEdges, UnknownKey, edge_cost
from uwblite.graph.pose_edges import OdometryEdges, RelativePoseEdges, ScanEdges
from uwblite.graph.range_edges import RangeEdges
from uwblite.graph.robust import Kernel

KINDS = sorted(every_kind(0)[1])


def values_of(graph):
    return {"poses": graph.poses, "anchors": graph.anchors, "calibration": graph.calibration.values[:, None]}


def moved(graph, block, unknown, scalar, step):
    values = {name: value.copy() for name, value in values_of(graph).items()}
    values[block][unknown, scalar] += step
    return graph.updated(values["poses"], values["anchors"], values["calibration"][:, 0])


def assert_jacobians_equal_differences(graph, edges):
    linear = edges.linearize(graph)
    np.testing.assert_allclose(linear.residuals, edges.residuals(graph), atol=1e-12)
    step = 1e-6
    for block, values in values_of(graph).items():
        analytic = np.zeros((*linear.residuals.shape, *values.shape))
        for name, index, jacobian in linear.blocks:
            if name == block:
                for e, unknown in enumerate(index):
                    analytic[e, :, unknown] += jacobian[e]
        for unknown, scalar in np.ndindex(values.shape):
            ahead, behind = (edges.residuals(moved(graph, block, unknown, scalar, s)) for s in (step, -step))
            # Second differences of residuals of size 10 over 1e-6 leave about 1e-8.
            np.testing.assert_allclose(analytic[:, :, unknown, scalar], (ahead - behind) / (2 * step), atol=1e-7)


@pytest.mark.parametrize("calibrated", [True, False])
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("kind", KINDS)
def test_jacobians_equal_differences(kind, seed, calibrated):
    graph, kinds = every_kind(seed, calibrated)
    assert_jacobians_equal_differences(graph, kinds[kind])


@pytest.mark.parametrize("kind", KINDS)
def test_rows_are_some_of_the_edges_of_the_same_kind(kind):
    graph, kinds = every_kind(11)
    whole = replace(kinds[kind], kernel=Kernel("cauchy", 2.0), weights=np.linspace(0.1, 1.0, 8))
    if not hasattr(whole, "rows"):
        pytest.skip("nobody picks edges of this kind")
    for which in (np.array([5, 2, 2]), np.array([], dtype=int), np.arange(8)):
        some = whole.rows(which)
        assert (type(some), some.kernel, len(some)) == (type(whole), whole.kernel, len(which))
        np.testing.assert_array_equal(some.residuals(graph), whole.residuals(graph)[which])
        np.testing.assert_array_equal(some.weights, whole.weights[which])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("first", [0, 3, 8])
@pytest.mark.parametrize("weighted", [(False, False), (True, False), (False, True), (True, True)])
def test_rows_followed_by_the_others_are_all_edges(kind, first, weighted):
    graph, kinds = every_kind(12)
    whole = kinds[kind]
    parts = [whole.rows(np.arange(first)), whole.rows(np.arange(first, 8))]
    parts = [replace(p, weights=0.5 * np.ones(len(p)) if w else None) for p, w in zip(parts, weighted, strict=True)]
    joined = parts[0].followed_by(parts[1])
    assert (type(joined), joined.kernel, len(joined)) == (type(whole), whole.kernel, 8)
    np.testing.assert_array_equal(joined.residuals(graph), whole.residuals(graph))
    np.testing.assert_array_equal(joined.own_weights, np.concatenate([p.own_weights for p in parts]))
    assert (joined.weights is None) == (not any(weighted))


@pytest.mark.parametrize("free", list(itertools.product([False, True], repeat=4)))
def test_scan_jacobians_equal_differences_whatever_of_mounting_and_delay_is_free(free):
    graph, kinds = every_kind(9)
    for first in (0, 4):
        edges = replace(kinds["scan"], calibration=np.where(free, first + np.arange(4), -1))
        assert_jacobians_equal_differences(graph, edges)
        named = [index[0] for block, index, _ in edges.linearize(graph).blocks if block == "calibration"]
        assert named == [first + k for k in range(4) if free[k]]


@pytest.mark.parametrize(("scale", "turn"), [(-0.95, 0.2), (-1.5, 0.2), (0.3, -0.97), (-0.99, -2.0), (-0.85, -0.85)])
def test_wheels_that_count_more_than_ten_times_what_they_do_divide_by_a_tenth(scale, turn):
    graph, kinds = every_kind(10)
    edges = replace(kinds["odometry"], calibration=np.tile([0, 1, 2, 3, -1, -1, -1, -1], (8, 1)))
    values = np.concatenate([[scale, turn], graph.calibration.values[2:]])
    graph = graph.updated(graph.poses, graph.anchors, values)
    assert_jacobians_equal_differences(graph, edges)
    off = se2.between(edges.corrected(graph), se2.between(graph.poses[edges.i], graph.poses[edges.j]))
    own = off / np.maximum([1.0 + scale, 1.0, 1.0 + turn], 0.1)
    np.testing.assert_allclose(edges.residuals(graph), np.einsum("eij,ej->ei", edges.end_sqrt_information, own), atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_every_unknown_of_an_edge_has_an_index_and_a_jacobian_of_its_width(kind):
    graph, kinds = every_kind(1)
    linear = kinds[kind].linearize(graph)
    width = {"poses": 3, "anchors": 2, "calibration": 1}
    for block, index, jacobian in linear.blocks:
        assert index.shape == (len(kinds[kind]),)
        assert jacobian.shape == (*linear.residuals.shape, width[block])
        assert index.min() >= 0
        assert index.max() < len(values_of(graph)[block])


def test_relative_pose_residual_is_the_chart_of_g2o():
    graph, kinds = every_kind(2)
    edges = kinds["relative pose"]
    for e, whitened in enumerate(edges.residuals(graph)):
        seen = se2.compose(se2.inverse(graph.poses[edges.i[e]]), graph.poses[edges.j[e]])
        error = se2.compose(se2.inverse(edges.T_i_j[e]), seen)
        np.testing.assert_allclose(whitened, edges.sqrt_information[e] @ error, atol=1e-12)


def test_calibrated_odometry_stretches_and_turns_the_motion():
    graph, kinds = every_kind(3)
    edges = kinds["odometry"]
    s, k, b, g, p, q, r, w = np.append(graph.calibration.values, 0.0)[edges.calibration[0]]
    turn = edges.motion[0, 2]
    extra = k * turn + b * edges.length[0] + g * edges.duration[0]
    ahead, left = se2.rotate(-turn / 2, edges.motion[0, :2])
    ahead, left = ahead + left * w, left + left * q + ahead * r
    straight = se2.rotate((turn + extra) / 2, np.array([ahead, left]) * (1 + s))
    straight += se2.rotate(turn + extra, np.array([p, 0.0])) - [p, 0.0]
    np.testing.assert_allclose(edges.corrected(graph)[0], [*straight, turn + extra], atol=1e-12)


def covariance_of_the_end(motion, sqrt_information):
    """Return the covariance (3, 3) of the last pose of a chain of steps straight on from the origin, none of which turns."""
    poses = [np.zeros(3)]
    for step in motion:
        poses.append(se2.compose(poses[-1], step))
    n = len(motion)
    edges = OdometryEdges(
        np.arange(n), np.arange(1, n + 1), motion, np.hypot(*motion[:, :2].T), np.ones(n), sqrt_information,
        np.full((n, 8), -1),
    )  # fmt: skip
    jacobian = np.zeros((3 * n, 3 * (n + 1)))
    for _, index, block in edges.linearize(Graph(np.array(poses))).blocks:
        for k in range(n):
            jacobian[3 * k : 3 * k + 3, 3 * index[k] : 3 * index[k] + 3] += block[k]
    return np.linalg.inv(jacobian[:, 3:].T @ jacobian[:, 3:])[-3:, -3:]


@pytest.mark.parametrize("way", [(0.6, 0.0), (0.5, -0.3), (-0.4, 0.2)])
def test_a_long_step_is_as_uncertain_as_the_short_ones_of_which_it_consists(way):
    """Straight on: along, in heading and in what ties place to heading; across, short steps know of a bend in between."""
    n, length, sigma = 8, np.hypot(*way), np.array([0.01, 0.01, 0.02])
    root = np.diag(1.0 / sigma)
    short = covariance_of_the_end(np.tile([*way, 0.0], (n, 1)) / n, np.tile(root * np.sqrt(n), (n, 1, 1)))
    long = covariance_of_the_end(np.array([[*way, 0.0]]), root[None])
    across = np.array([-way[1], way[0], 0.0]) / length
    # The sum of the squares of the ways from the short steps' middles to that of the whole.
    bend = sigma[2] ** 2 * length**2 / 12.0 * (1.0 - 1.0 / n**2)
    np.testing.assert_allclose(short - bend * np.outer(across, across), long, rtol=1e-9, atol=1e-15)
    assert across @ long[:, 2] == pytest.approx(0.5 * length * sigma[2] ** 2)


def test_the_end_of_a_step_is_displaced_by_half_the_way_times_the_heading_of_the_middle():
    rng = np.random.default_rng(3)
    motion, e = np.array([[0.7, -0.2, 1.1]]), 1e-6 * rng.standard_normal(3)
    half = np.append(se2.rotate(-motion[0, 2], 0.5 * motion[0, :2]), 0.0)
    root = rng.normal(size=(1, 3, 3))
    edges = OdometryEdges(
        np.zeros(1, dtype=int), np.ones(1, dtype=int), motion, np.ones(1), np.ones(1), root, np.full((1, 8), -1)
    )
    end = se2.compose(motion[0], se2.between(half, se2.compose(e, half)))
    np.testing.assert_allclose(edges.residuals(Graph(np.array([np.zeros(3), end])))[0], root[0] @ e, rtol=1e-4, atol=1e-11)


def test_scan_poses_follow_the_base_for_the_delay_and_carry_the_mounting():
    graph, kinds = every_kind(4)
    edges = kinds["scan"]
    x, y, theta, delay = graph.calibration.values[4:8]
    for e, seen in enumerate(edges.relative(graph)):
        sensor = [
            se2.compose(se2.compose(graph.poses[p], se2.exp(twist * (delay - edges.made_with))), [x, y, theta])
            for p, twist in ((edges.i[e], edges.twist_i[e]), (edges.j[e], edges.twist_j[e]))
        ]
        np.testing.assert_allclose(seen, se2.between(*sensor), atol=1e-12)


def test_clouds_are_taken_as_made_without_a_delay_unless_it_is_given():
    graph, kinds = every_kind(4, calibrated=False)
    seen = kinds["scan"]
    plain = ScanEdges(seen.i, seen.j, seen.T_i_j, seen.sqrt_information, seen.twist_i, seen.twist_j, seen.calibration)
    np.testing.assert_allclose(plain.relative(graph), se2.between(graph.poses[seen.i], graph.poses[seen.j]), atol=1e-12)


def test_ranges_are_slant_distances_of_the_moving_tag():
    graph, kinds = every_kind(5)
    edges = kinds["range"]
    padded = np.append(graph.calibration.values, 0.0)
    for e in range(len(edges)):
        scale, bias, q, tag_x, tag_y, delay = padded[edges.calibration[e]]
        tag = se2.rotate(edges.turn[e], edges.tag + np.array([tag_x, tag_y]))
        at = se2.transform(graph.poses[edges.pose[e]], edges.lever_arm[e] + tag + edges.velocity[e] * delay)
        away = at - graph.anchors[edges.anchor[e]]
        planar = away @ away + edges.height[e] ** 2
        distance = np.sqrt(planar + q) if q >= 0.0 else 2.0 * np.sqrt(planar) - np.sqrt(planar - q)
        expected = ((1 + scale) * distance + bias - edges.ranges[e]) / edges.sigma[e]
        assert edges.residuals(graph)[e, 0] == pytest.approx(expected)


@pytest.mark.parametrize("away", [0.05, 0.5, 5.0])
def test_a_squared_height_below_zero_takes_off_what_one_above_adds(away):
    edges, graph = one_range(away)

    def distance(q):
        return expected_ranges(edges, graph.updated(graph.poses, graph.anchors, np.array([q])))[0]

    for q in (1e-6, 0.01, 1.0):
        assert distance(q) + distance(-q) == pytest.approx(2.0 * away)
    steps = np.linspace(-1.0, 1.0, 41)
    assert np.all(np.diff([distance(q) for q in steps]) > 0.0)


@pytest.mark.parametrize("q", [-1.0, -0.26, -0.01, 0.01, 1.0])
def test_jacobians_near_an_anchor_equal_differences_whatever_the_squared_height(q):
    edges, graph = one_range(0.5)
    assert_jacobians_equal_differences(graph.updated(graph.poses, graph.anchors, np.array([q])), edges)


def one_range(away):
    """Return a range to an anchor that stands so far, m, in front of the robot, its squared height unknown; and the graph."""
    graph = Graph(np.zeros((1, 3)), np.array([[away, 0.0]]), (), Calibration((UnknownKey("height2", "A"),), np.zeros(1)))
    one, none = np.array([0]), np.zeros((1, 2))
    height = np.array([[-1, -1, 0, -1, -1, -1]])
    stated, sigma, zero = np.array([away]), np.array([0.1]), np.zeros(1)
    return RangeEdges(one, one, stated, sigma, none, zero, none, np.zeros(2), zero, height), graph


def test_a_tag_on_top_of_its_anchor_has_finite_derivatives():
    graph, kinds = every_kind(6, calibrated=False)
    edges = kinds["range"]
    tag = edges.lever_arm[0] + se2.rotate(edges.turn[0], edges.tag)
    anchors = graph.anchors.copy()
    anchors[edges.anchor[0]] = se2.transform(graph.poses[edges.pose[0]], tag)
    graph = graph.updated(graph.poses, anchors, graph.calibration.values)
    linear = edges.linearize(graph)
    assert all(np.isfinite(jacobian).all() for _, _, jacobian in linear.blocks)


def test_residuals_of_headings_are_wrapped():
    graph = Graph(np.array([[0.0, 0.0, np.pi - 0.01], [0.0, 0.0, -np.pi + 0.01]]))
    identity = np.eye(3)[None]
    relative = RelativePoseEdges(np.array([0]), np.array([1]), np.zeros((1, 3)), identity)
    assert relative.residuals(graph)[0, 2] == pytest.approx(0.02)
    prior = PriorEdges("poses", np.array([1]), np.array([[0.0, 0.0, np.pi]]), identity)
    assert prior.residuals(graph)[0, 2] == pytest.approx(0.01)


def test_chi2_sums_robust_weighted_costs():
    graph, kinds = every_kind(7)
    weights = np.linspace(0.0, 1.0, len(kinds["scan"]))
    kernel = Kernel("cauchy", 1.5)
    edges = type(kinds["relative pose"])(
        kinds["relative pose"].i,
        kinds["relative pose"].j,
        kinds["relative pose"].T_i_j,
        kinds["relative pose"].sqrt_information,
        kernel=kernel,
        weights=weights,
    )
    residuals = edges.residuals(graph)
    expected = sum(w * kernel.rho(np.array(r @ r)) for w, r in zip(weights, residuals, strict=True))
    assert edge_cost(edges, residuals) == pytest.approx(expected)
    both = graph.with_edges(edges, kinds["range"])
    assert both.chi2() == pytest.approx(expected + np.sum(kinds["range"].residuals(graph) ** 2))


def test_graphs_are_extended_not_changed():
    graph, kinds = every_kind(8)
    empty = RelativePoseEdges(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    assert len(graph.with_edges(kinds["range"], empty).edges) == 1
    assert graph.edges == ()


def test_calibration_by_name():
    calibration = Calibration((UnknownKey("a"), UnknownKey("b")), np.array([1.0, 2.0]))
    assert (calibration.index("b"), calibration.index("c")) == (1, -1)
    assert (calibration.get("b"), calibration.get("c"), calibration.get("c", 7.0)) == (2.0, 0.0, 7.0)


def test_the_label_of_an_unknown_counts_tags_and_recordings_from_one():
    labels = [UnknownKey("bias", "5C0B", recording, tag).label for recording in (None, 0, 1) for tag in (0, 1)]
    first, second = ["bias:5C0B", "bias:5C0B@tag2"], ["bias:5C0B#2", "bias:5C0B@tag2#2"]
    assert labels == [*first, *first, *second]
    assert UnknownKey("laser_x").label == "laser_x"


def test_a_prior_on_an_unknown_block_is_refused():
    with pytest.raises(DataError, match="anchor"):
        PriorEdges("anchor", np.array([0]), np.zeros((1, 2)), np.eye(2)[None])
