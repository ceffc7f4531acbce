"""Graphs solved part by part: the same minimum as the whole, and little to send."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted_graphs import loop, plain_ranges, relative_edges

from uwblite import se2
from uwblite.graph.condensation import Condensed, _damped, _motion, solve_condensed
from uwblite.graph.graph import Calibration, Graph, PriorEdges, UnknownKey
from uwblite.graph.partition import split
from uwblite.graph.robust import Kernel
from uwblite.graph.solver import SolverConfig, optimize

CAREFUL = SolverConfig(relative_decrease=1e-15)


def gathered(graph, solution):
    """Return the whole graph with the estimates of its parts, and how far parts that share an unknown disagree."""
    poses, anchors = np.full_like(graph.poses, np.nan), np.full_like(graph.anchors, np.nan)
    calibration = np.full_like(graph.calibration.values, np.nan)
    for part in solution.parts:
        for into, own, name in (
            (poses, part.graph.poses, "poses"),
            (anchors, part.graph.anchors, "anchors"),
            (calibration, part.graph.calibration.values, "calibration"),
        ):
            k = part.members[name]
            known = np.isfinite(into[k])
            np.testing.assert_array_equal(into[k][known], own[known])
            into[k] = own
    return graph.updated(poses, anchors, calibration)


def city(seed, recordings=4, n=60, closures=3, steps=1):
    """Return recordings of one place: each its own poses and bias, ranges to common anchors and to one of its own, a common
    scale, closures between recordings, some ranges under a robust kernel; with the recording of each pose."""
    rng = np.random.default_rng(seed)
    anchors = np.concatenate([rng.uniform(-8, 8, (5, 2)), rng.uniform(-8, 8, (recordings, 2))])
    angle = np.arange(n) * 4.0 * np.pi / n
    circle = np.column_stack([4.0 * np.sin(angle), 4.0 - 4.0 * np.cos(angle), se2.wrap_angle(angle)])
    truth = np.concatenate([se2.compose(rng.uniform(-2, 2, 3), circle) for _ in range(recordings)])
    part = np.repeat(np.arange(recordings), n)
    each = np.flatnonzero(np.diff(part, append=-1) == 0)
    pose = np.repeat(np.arange(len(truth)), 6)
    measured = np.tile([0, 1, 2, 3, 4, 5], len(truth)) + np.where(np.arange(len(pose)) % 6 == 5, np.repeat(part, 6), 0)
    sigma, noise = 0.1, rng.normal(scale=0.1, size=len(pose))
    ranges = plain_ranges(pose, measured, np.hypot(*(truth[pose, :2] - anchors[measured]).T) + noise, sigma)
    index = np.full((len(pose), 6), -1)
    index[:, 0], index[:, 1] = 0, 1 + part[pose]
    ranges = replace(ranges, calibration=index, kernel=Kernel("huber", 2.0))
    i, j = (np.flatnonzero(part == p)[rng.integers(0, n, closures)] for p in (0, 1))
    keys = (UnknownKey("range_scale"), *(UnknownKey("bias", "A", p) for p in range(recordings)))
    c = np.arange(1 + recordings)
    edges = (
        relative_edges(truth, each, each + 1, [0.05, 0.02, 0.02], rng),
        relative_edges(truth, i, j, [0.03, 0.03, 0.01], rng),
        ranges,
        PriorEdges("calibration", c, np.zeros((len(c), 1)), np.full((len(c), 1, 1), 20.0)),
    )
    start = truth + rng.normal(size=truth.shape) * [0.1, 0.1, 0.05]
    return Graph(start, anchors + rng.normal(scale=0.2, size=anchors.shape), edges, Calibration(keys, 0.0 * c)), part


@pytest.mark.parametrize("seed", range(4))
def test_parts_end_in_the_minimum_of_the_whole(seed):
    graph, part = city(seed)
    whole, summary = optimize(graph, CAREFUL)
    solution = solve_condensed(*split(graph, part))
    found = gathered(graph, solution)
    assert 2 <= solution.rounds < 25
    assert solution.chi2 == pytest.approx(summary.chi2, rel=1e-9)
    assert np.abs(found.poses[:, :2] - whole.poses[:, :2]).max() < 1e-6
    assert np.abs(se2.wrap_angle(found.poses[:, 2] - whole.poses[:, 2])).max() < 1e-6
    assert np.abs(found.anchors - whole.anchors).max() < 1e-6
    np.testing.assert_allclose(found.calibration.values, whole.calibration.values, atol=1e-6)


def test_what_is_shared_is_what_several_parts_touch():
    graph, part = city(0)
    shared, parts = split(graph, part)
    assert len(shared.anchors) == 5
    assert len(shared.calibration.keys) == 1
    assert len(shared.poses) == 6
    assert sum(len(e) for p in parts for e in p.graph.edges) + sum(map(len, shared.edges)) == sum(map(len, graph.edges))
    assert shared.chi2() + sum(p.graph.chi2() for p in parts) == pytest.approx(graph.chi2())


def test_what_a_part_sends_does_not_grow_with_its_length():
    sent = []
    for n in (40, 160):
        graph, part = city(1, n=n)
        sent.append(solve_condensed(*split(graph, part)).sent)
    assert sent[0][2:] == sent[1][2:]
    assert max(sent[1]) < 5000


def test_a_part_sends_one_triangle_a_vector_a_diagonal_and_its_numbers():
    """Three scalars: 6 + 3 + 3 numbers of 8 bytes and 3 of 4."""
    assert Condensed(np.arange(3), np.eye(3), np.zeros(3), np.ones(3)).size == 108


def test_one_part_alone_shares_nothing():
    graph = loop(0)[0]
    solution = solve_condensed(*split(graph, np.zeros(len(graph.poses), dtype=int)))
    assert solution.sent == (0,)
    np.testing.assert_allclose(solution.parts[0].graph.poses, optimize(graph, CAREFUL)[0].poses, atol=1e-6)


def test_what_nothing_measures_is_damped_as_one():
    assert _damped(np.array([4.0, 0.5, 0.0]), 0.5).tolist() == [2.0, 0.25, 0.5]


def test_a_motion_is_the_largest_of_any_pose_or_anchor():
    """In metres or radians, angles the short way round; graphs without anchors or poses have none."""
    before = Graph(np.array([[0.0, 0.0, 3.1], [1.0, 1.0, 0.0]]), np.zeros((1, 2)))
    assert _motion(before, before) == 0.0
    assert _motion(before, replace(before, poses=before.poses - np.array([0.0, 0.2, 0.0]))) == pytest.approx(0.2)
    assert _motion(before, replace(before, poses=before.poses - np.array([0.0, 0.0, 0.1]))) == pytest.approx(0.1)
    turned = np.array([[0.0, 0.0, -3.1], [1.0, 1.0, 0.0]])
    assert _motion(before, replace(before, poses=turned)) == pytest.approx(2.0 * np.pi - 6.2)
    assert _motion(before, replace(before, anchors=np.array([[0.0, 0.3]]))) == pytest.approx(0.3)
    assert _motion(Graph(np.zeros((0, 3))), Graph(np.zeros((0, 3)))) == 0.0
