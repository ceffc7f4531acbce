"""Parts of a problem: what a stretch shows alone."""

import numpy as np
from helpers.planted_graphs import every_kind, loop

from uwblite.graph.calibration import LASER, ODOMETRY, OMNI, TURNING, CalibrationConfig, block, unknowns
from uwblite.graph.graph import Graph
from uwblite.graph.pose_edges import OdometryEdges, ScanEdges
from uwblite.problem.parts import stretch


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
