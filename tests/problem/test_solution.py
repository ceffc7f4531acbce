"""Solution of a problem: its optimum with no anchor below the tag's height."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted_graphs import every_kind, loop

from uwblite.graph.calibration import (
    LASER,
    ODOMETRY,
    OMNI,
    TURNING,
    CalibrationConfig,
    block,
    prior_edges,
    range_indices,
    unknowns,
)
from uwblite.graph.graph import Graph
from uwblite.graph.pose_edges import OdometryEdges, ScanEdges
from uwblite.graph.range_edges import RangeEdges
from uwblite.graph.solver import SolverConfig
from uwblite.problem.solution import comparable, rough, solve, stretch, with_nonnegative_heights

IDS = ("1E05", "5C0B", "91A3")
GIVEN = np.array([False, True, False])


def test_heights_below_zero_are_fixed_there_and_nothing_else_changes():
    calibration = block(unknowns(CalibrationConfig(), IDS, GIVEN))
    low, high = calibration.index("height2", "1E05"), calibration.index("height2", "91A3")
    bias = calibration.index("bias", "1E05")
    values = np.zeros(len(calibration.values))
    values[[low, high, bias]] = -0.3, 0.4, -0.2
    before = np.arange(len(values)) == bias
    graph = Graph(np.zeros((1, 3)), np.zeros((3, 2)), (), calibration, fixed_calibration=before)
    graph = with_nonnegative_heights(graph.updated(graph.poses, graph.anchors, values))
    values[low] = 0.0
    np.testing.assert_array_equal(graph.calibration.values, values)
    assert np.flatnonzero(graph.fixed_calibration).tolist() == sorted([low, bias])


def ranges_shortened_near_the_anchors(rng):
    """Return a graph of fixed poses around three anchors as high as the tag; near them ranges are too short."""
    listed = [u for u in unknowns(CalibrationConfig(), IDS, np.zeros(3, dtype=bool)) if u.key.kind in ("bias", "height2")]
    calibration, anchors = block(tuple(listed)), np.array([[1.0, 1.0], [6.0, 2.0], [3.0, 5.0]])
    poses = np.column_stack([rng.uniform(-1.0, 8.0, (60, 2)), np.zeros(60)])
    pose, anchor = np.repeat(np.arange(60), 3), np.tile(np.arange(3), 60)
    way = np.hypot(*(poses[pose, :2] - anchors[anchor]).T)
    measured = way - np.array([0.8, 0.5, 0.0])[anchor] / way + rng.normal(0.0, 0.05, len(way))
    none, table = np.zeros(len(way)), range_indices(calibration, anchor, IDS)
    plane = np.zeros((len(way), 2))
    edges = RangeEdges(pose, anchor, measured, none + 0.05, plane, none, plane, np.zeros(2), none, table)
    graph = Graph(poses, anchors + 0.3, (prior_edges(tuple(listed)), edges), calibration)
    return replace(graph, fixed_poses=np.ones(60, dtype=bool), fixed_calibration=np.zeros(len(listed), dtype=bool))


@pytest.mark.parametrize("seed", range(3))
def test_heights_put_back_to_zero_leave_everything_else_at_the_optimum(seed):
    """The derivative of the cost along all that is free is 0, by differences; along heights at 0 the cost falls below only."""
    graph = ranges_shortened_near_the_anchors(np.random.default_rng(seed))
    graph, _ = solve(graph, SolverConfig(relative_decrease=1e-12))
    heights = np.flatnonzero(graph.calibration.of_kinds("height2"))
    assert graph.fixed_calibration[heights[:2]].all()
    assert (graph.calibration.values[heights] >= 0.0).all()

    def slope(x, value):
        """Return the derivative of the cost along a value, and the value's standard deviation where all else is fixed."""
        costs = []
        for step in (-1e-4, 0.0, 1e-4):
            x[value] += step
            costs.append(graph.updated(graph.poses, anchors, calibration).chi2())
            x[value] -= step
        return (costs[2] - costs[0]) / 2e-4, 1.0 / np.sqrt(0.5 * (costs[2] - 2.0 * costs[1] + costs[0]) / 1e-8)

    anchors, calibration = graph.anchors.copy(), graph.calibration.values.copy()
    for value in np.ndindex(anchors.shape):
        derivative, sigma = slope(anchors, value)
        assert abs(derivative) * sigma < 1e-2
    for value, fixed in enumerate(graph.fixed_calibration):
        derivative, sigma = slope(calibration, value)
        assert derivative > 0.0 if fixed else abs(derivative) * sigma < 1e-2


def test_a_rough_search_and_a_comparable_one_are_no_finer_than_the_settings():
    usual, coarse = SolverConfig(), SolverConfig(max_iterations=3, relative_decrease=1e-2)
    assert rough(usual).max_iterations < usual.max_iterations
    assert usual.relative_decrease < comparable(usual).relative_decrease < rough(usual).relative_decrease
    assert rough(coarse) == comparable(coarse) == coarse


def test_a_stretch_has_the_edges_within_it_and_their_residuals():
    graph, kinds = every_kind(3)
    graph = graph.with_edges(*kinds.values())
    part = stretch(graph, 2, 5)
    assert len(part.poses) == 3
    assert part.fixed_poses.tolist() == [True, False, False]
    whole = [e for e in graph.edges if isinstance(e, (OdometryEdges, ScanEdges))]
    for edges in whole:
        inside = np.flatnonzero((np.minimum(edges.i, edges.j) >= 2) & (np.maximum(edges.i, edges.j) < 5))
        own = [e for e in part.edges if type(e) is type(edges)]
        assert sum(map(len, own)) == len(inside)
        if len(inside):
            np.testing.assert_allclose(own[0].residuals(part), edges.residuals(graph)[inside])
    assert part.calibration_priors == graph.calibration_priors


def test_calibration_that_it_does_not_show_and_what_was_fixed_stay_fixed():
    calibration = block(unknowns(CalibrationConfig(), ("A",), np.zeros(1, dtype=bool)))
    kinds = [key.kind for key in calibration.keys]
    graph = Graph(np.zeros((5, 3)), calibration=calibration, fixed_calibration=np.array([k == "laser_y" for k in kinds]))
    part = stretch(graph, 1, 4)
    free = {kind for kind, fixed in zip(kinds, part.fixed_calibration, strict=True) if not fixed}
    assert free == {*LASER, *ODOMETRY, *OMNI, TURNING} - {"laser_y"}


def test_a_graph_without_wheels_and_lidar_has_empty_parts():
    part = stretch(loop()[0], 0, 9)
    assert (part.edges, len(part.anchors), len(part.poses)) == ((), 0, 9)
