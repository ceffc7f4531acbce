"""Parts of a problem: what a stretch of the trajectory shows alone, and what ranges show at given poses."""

from dataclasses import replace

import numpy as np

from ..graph.calibration import BIAS, HEIGHT, LASER, ODOMETRY, OMNI, RANGE_SCALE, TURNING
from ..graph.graph import Edges, Graph
from ..graph.pose_edges import OdometryEdges, ScanEdges


def stretch(graph: Graph, first: int, last: int) -> Graph:
    """Return the problem of wheels and lidar alone on the poses first <= k < last, with priors of their calibration.

    Parameters
    ----------
    graph : its poses of the stretch hang together by odometry.
    """
    inside = list[Edges]()
    for edges in graph.edges:
        if isinstance(edges, (OdometryEdges, ScanEdges)):
            own = (np.minimum(edges.i, edges.j) >= first) & (np.maximum(edges.i, edges.j) < last)
            rows = edges.rows(own)
            inside.append(replace(rows, i=rows.i - first, j=rows.j - first))
    fixed = graph.fixed_calibration | ~graph.calibration.of_kinds(*LASER, *ODOMETRY, *OMNI, TURNING)
    priors = graph.calibration_priors
    alone = Graph(
        graph.poses[first:last], edges=priors, calibration=graph.calibration, fixed_calibration=fixed, work=graph.work
    )
    return alone.with_edges(*inside)


def at_given_poses(graph: Graph) -> Graph:
    """Return the graph with only anchors and the systematic errors of their ranges free, as far as they were free before."""
    fixed = graph.fixed_calibration | ~graph.calibration.of_kinds(BIAS, HEIGHT, RANGE_SCALE)
    return replace(graph, fixed_poses=np.ones(len(graph.poses), dtype=bool), fixed_calibration=fixed)
