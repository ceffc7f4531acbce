"""Parts of a problem: what a stretch of the trajectory shows alone."""

from dataclasses import replace

import numpy as np

from ..graph.calibration import LASER, ODOMETRY, OMNI, TURNING
from ..graph.graph import Edges, Graph
from ..graph.pose_edges import OdometryEdges, ScanEdges


def stretch(graph: Graph, first: int, last: int) -> Graph:
    """Return the problem of wheels and lidar alone on the poses first <= k < last, with priors of their calibration.

    Parameters
    ----------
    graph : its poses of the stretch hang together by odometry.
    """
    inside = []
    for edges in graph.edges:
        if isinstance(edges, (OdometryEdges, ScanEdges)):
            own = (np.minimum(edges.i, edges.j) >= first) & (np.maximum(edges.i, edges.j) < last)
            rows = edges.rows(own)
            inside.append(replace(rows, i=rows.i - first, j=rows.j - first))
    fixed = graph.fixed_calibration | ~graph.calibration.of_kinds(*LASER, *ODOMETRY, *OMNI, TURNING)
    kept: tuple[Edges, ...] = (*graph.calibration_priors, *(e for e in inside if len(e)))
    return Graph(graph.poses[first:last], edges=kept, calibration=graph.calibration, fixed_calibration=fixed)
