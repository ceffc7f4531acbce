"""A graph's measurements in the form of text formats: between poses and landmarks, without calibration."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .. import se2
from ..arrays import Floats, Ints
from ..graph.distance_edges import AnchorDistanceEdges, PointDistanceEdges
from ..graph.graph import Edges, Graph, PriorEdges
from ..graph.point_edges import LandmarkEdges
from ..graph.pose_edges import OdometryEdges, RelativePoseEdges, ScanEdges
from ..graph.range_edges import RangeEdges

_NONE = np.zeros(0, dtype=np.intp)
ENDS = {
    "relative": ("pose", "pose"), "observation": ("pose", "landmark"), "range": ("pose", "landmark"),
    "pose_range": ("pose", "pose"), "landmark_range": ("landmark", "landmark"), "pose_prior": ("pose",),
    "landmark_prior": ("landmark",),
}  # fmt: skip
"""What the text formats can say, and between what: the pose of one in the other, a landmark's position in a pose, distances,
and where a pose or a landmark is."""
WIDTHS = {"relative": 3, "pose_prior": 3, "observation": 2, "landmark_prior": 2}
"""Numbers of a measurement; 1 of a distance."""


class Measured(NamedTuple):
    """Measurements of one of these kinds; nothing is calibrated."""

    ends: tuple[Ints, ...]
    """(e,) each."""
    value: Floats
    """(e, k) m, m, rad."""
    information: Floats
    """(e, k, k) in the chart e = Z^-1 X where they are poses."""


def measured(kind: str, parts: Sequence[Measured] = ()) -> Measured:
    """Return measurements of one kind, those of all parts one behind the other."""
    k = WIDTHS.get(kind, 1)
    every = (Measured((_NONE,) * len(ENDS[kind]), np.zeros((0, k)), np.zeros((0, k, k))), *parts)
    ends = tuple(np.concatenate(column) for column in zip(*(part.ends for part in every), strict=True))
    return Measured(ends, np.concatenate([p.value for p in every]), np.concatenate([p.information for p in every]))


def plain_edges(graph: Graph) -> dict[str, Measured]:
    """Return a graph's measurements by kind with calibration and lever arms worked in at the present estimate.

    Odometry and scan edges become measurements between the poses of the base. A range becomes the range from the pose
    itself that leaves the same residual at the present estimate. Weights scale the information; robust kernels and
    priors on calibration have no place in the formats and are left out. Where nothing is calibrated and lever arms are
    zero nothing changes, so that chi2 stays what it was. Ranges to anchors without a position are left out. Directions that
    an edge does not measure get an information too small to matter (see `definite`).
    """
    found: dict[str, list[Measured]] = {kind: [] for kind in ENDS}
    for edges in graph.edges:
        if isinstance(edges, PriorEdges) and edges.block == "calibration":
            continue
        kind, ends, value, L = _plain(edges, graph)
        on = (edges.own_weights > 0) & np.isfinite(value).all(axis=1)
        root = L[on] * np.sqrt(edges.own_weights[on])[:, None, None]
        found[kind].append(Measured(tuple(end[on] for end in ends), value[on], np.swapaxes(root, 1, 2) @ root))
    joined = {kind: measured(kind, parts) for kind, parts in found.items()}
    return {kind: m._replace(information=definite(m.information)) for kind, m in joined.items()}


def _plain(edges: Edges, graph: Graph) -> tuple[str, tuple[Ints, ...], Floats, Floats]:
    """Return kind, ends, values (e, k) and square roots of information (e, k, k) of edges; nan where a place is unknown."""
    if isinstance(edges, RangeEdges):
        apart = graph.poses[edges.pose, :2] - graph.anchors[edges.anchor]
        return "range", (edges.pose, edges.anchor), _left(edges, graph, apart), (1.0 / edges.sigma)[:, None, None]
    if isinstance(edges, PointDistanceEdges):
        apart = graph.poses[edges.i, :2] - graph.poses[edges.j, :2]
        return "pose_range", (edges.i, edges.j), _left(edges, graph, apart), (1.0 / edges.sigma)[:, None, None]
    if isinstance(edges, AnchorDistanceEdges):
        return "landmark_range", (edges.i, edges.j), edges.distance[:, None], (1.0 / edges.sigma)[:, None, None]
    if isinstance(edges, LandmarkEdges):
        return "observation", (edges.pose, edges.anchor), edges.position, edges.sqrt_information
    if isinstance(edges, PriorEdges):
        if edges.block == "anchors":
            return "landmark_prior", (edges.index,), edges.value, edges.sqrt_information
        return "pose_prior", (edges.index,), edges.value, edges.sqrt_information @ se2.rotation(edges.value[:, 2])
    assert isinstance(edges, RelativePoseEdges | OdometryEdges | ScanEdges)
    return "relative", (edges.i, edges.j), *_between_bases(edges, graph)


def _left(edges: RangeEdges | PointDistanceEdges, graph: Graph, apart: Floats) -> Floats:
    """Return the distances (e, 1) that leave the edges' residuals to ends that are apart by vectors (e, 2)."""
    return (np.hypot(apart[:, 0], apart[:, 1]) - edges.residuals(graph)[:, 0] * edges.sigma)[:, None]


def _between_bases(edges: RelativePoseEdges | OdometryEdges | ScanEdges, graph: Graph) -> tuple[Floats, Floats]:
    """Return the measured pose of base j in base i (e, 3) and the square root of its information (e, 3, 3)."""
    if isinstance(edges, RelativePoseEdges):
        return edges.T_i_j, edges.sqrt_information
    if isinstance(edges, OdometryEdges):
        return edges.corrected(graph), edges.end_sqrt_information / edges.own_scale(graph)[:, None, :]
    # S = X o A, so Z' = A_i Z A_j^-1 and, to first order, e' = A_j e A_j^-1 = M e.
    calibration = np.append(graph.calibration.values, 0.0)
    correction, delay = calibration[edges.calibration[:3]], calibration[edges.calibration[3]]
    A_i, A_j = (se2.compose(se2.exp(twist * (delay - edges.made_with)), correction) for twist in (edges.twist_i, edges.twist_j))
    T = se2.compose(se2.compose(A_i, edges.T_i_j), se2.inverse(A_j))
    M = se2.rotation(A_j[:, 2])
    M[:, 0, 2], M[:, 1, 2] = A_j[:, 1], -A_j[:, 0]
    return T, edges.sqrt_information @ np.linalg.inv(M)


def upper_triangle(matrices: Floats) -> Floats:
    """Return the upper triangles row by row (e, size (size + 1) / 2) of matrices (e, size, size)."""
    row, col = np.triu_indices(matrices.shape[1])
    return matrices[:, row, col]


_FLATTEST = 1e-8
"""Least eigenvalue of an information matrix in a file, relative to its largest. A direction that was not measured has none,
but readers invert the matrix or take its Cholesky factor, which breaks down without an error (gtsam)."""


def definite(information: Floats) -> Floats:
    """Return information matrices (e, k, k), those that are singular to working precision made positive definite."""
    if len(information) == 0:
        return information
    # The trace is at least the largest eigenvalue, so that the determinant is at most the least one times its powers.
    size, found = np.trace(information, axis1=1, axis2=2), information.copy()
    doubtful = np.flatnonzero(~(np.linalg.det(information) > 2.0 * _FLATTEST * size**information.shape[1]))
    values, vectors = np.linalg.eigh(information[doubtful])
    least = np.maximum(_FLATTEST * values[:, -1:], np.finfo(np.float64).tiny)
    raised = (vectors * np.maximum(values, least)[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    flat = values[:, 0] < least[:, 0]
    found[doubtful[flat]] = raised[flat]
    return found


def root(information: Floats) -> Floats:
    """Return L (e, k, k) with information = L^T L; singular matrices are allowed."""
    try:
        return np.swapaxes(np.linalg.cholesky(information), 1, 2)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(information)
        return np.sqrt(np.maximum(values, 0.0))[:, :, None] * np.swapaxes(vectors, 1, 2)
