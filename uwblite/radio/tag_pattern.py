"""Range errors as a function of the anchor's direction in the robot's frame.

The robot's own body shadows its tag (Otim et al., Electronics 8(11):1351, 2019), and an antenna's delay changes with the
direction by centimetres to decimetres (bitcraze/crazyflie-firmware, issue 680): equally for all anchors, and in every
range. Taken as noise, it shifts poses to one side wherever anchors are on one side. Once clouds determine the
trajectory, it is estimated with all other unknowns, as errors that ranges have in common (graph/marginals.py).
"""

from dataclasses import replace

import numpy as np

from .. import se2
from ..arrays import Floats
from ..graph.graph import Graph
from ..graph.marginals import CommonErrors, Marginals
from ..graph.range_edges import RangeEdges

HARMONICS = 3
"""Number of harmonics of an anchor's direction in the robot's frame, which model the pattern of antenna and body."""
PATTERN_SIGMA = 0.05
"""m; prior of each of the pattern's coefficients, 0.09 m together: 0.06 m of radiation patterns and 0.1 m behind a body."""
_TAG_X = 3
"""Column of the calibration that differs between the tags of each recording."""


def pattern_waves(angles: Floats) -> Floats:
    """Return the harmonics (m, 2 HARMONICS) of an anchor's direction (m,) in the robot's frame, rad."""
    times = angles[:, None] * np.arange(1, HARMONICS + 1)
    return np.concatenate([np.cos(times), np.sin(times)], axis=1)


def without_pattern(edges: RangeEdges, graph: Graph, around: Marginals) -> RangeEdges:
    """Return the ranges with the pattern of their tags as known delays; every recording has its own.

    Parameters
    ----------
    graph : contains the edges, and is solved. around : its marginals.
    """
    way = graph.anchors[edges.anchor] - edges.tag_positions(graph.poses)
    waves = pattern_waves(se2.bearing(way) - graph.poses[edges.pose, 2] - edges.turn)
    tags, tag = np.unique(edges.calibration[:, _TAG_X], return_inverse=True)
    each = waves.shape[1]
    edge, error = np.repeat(np.arange(len(edges)), each), each * tag.reshape(-1, 1) + np.arange(each)
    shift = PATTERN_SIGMA * waves / edges.sigma[:, None]
    kind = np.zeros(each * len(tags), dtype=np.intp)
    found = around.estimated(CommonErrors(edges, edge, error.ravel(), shift.reshape(-1, 1), kind))
    late = PATTERN_SIGMA * np.sum(waves * found[error], axis=1)
    # The residuals show the remaining pattern where a part was subtracted before.
    return replace(edges, late=late + edges.ranges - edges.corrected)
