"""Pose graphs between files and the Graph type: what g2o, TORO and PyFG have in common."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from .. import se2
from ..arrays import Bools, Floats, Ints
from ..errors import FormatError
from ..graph.components import floating_components
from ..graph.distance_edges import AnchorDistanceEdges, PointDistanceEdges
from ..graph.graph import Graph, PriorEdges
from ..graph.point_edges import LandmarkEdges
from ..graph.pose_edges import OdometryEdges, RelativePoseEdges, ScanEdges
from ..graph.range_edges import RangeEdges
from .graph_chains import chained_poses
from .records import RecordFile, Records

_NONE = np.zeros(0, dtype=np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class GraphFile:
    """A graph as a file holds it."""

    graph: Graph
    pose_ids: tuple[str, ...]
    """Name of each pose in the file."""
    anchor_ids: tuple[str, ...]
    """Name of each landmark in the file; they are the graph's anchors."""
    stamps: Floats
    """(n,) s, time of each pose; its number where the file gives no time."""
    chains: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """(n,) chain of each pose: 0 stands where the file puts it or at the first pose; the others, which no edges but ranges
    tie to it, begin at the origin and want a place."""
    skipped: dict[str, int] = field(default_factory=dict)
    """Lines of kinds that are not used, by tag."""
    warnings: tuple[str, ...] = ()
    """Oddities, in words."""

    @staticmethod
    def checked(
        graph: Graph, pose_ids: tuple[str, ...], anchor_ids: tuple[str, ...], stamps: Floats, content: RecordFile
    ) -> "GraphFile":
        """Return the graph of a file that was read.

        Raises
        ------
        FormatError : a pose hangs on nothing.
        """
        poses, chains = with_origins(graph)
        lost = np.flatnonzero(~_tied(graph, chains)[chains])
        if len(lost):
            raise content.error(f"pose {pose_ids[lost[0]]} is not connected to the first one ({len(lost)} such poses)")
        graph = replace(graph, poses=poses)
        nowhere = [name for name, xy in zip(anchor_ids, graph.anchors, strict=True) if np.isnan(xy[0])]
        warnings: tuple[str, ...] = (
            (f"no position is given of {len(nowhere)} landmarks: {', '.join(nowhere[:10])}",) if nowhere else ()
        )
        floating = np.flatnonzero(floating_components(graph) > 0)
        if len(floating):
            named = f"pose {pose_ids[floating[0]]} is not connected to the first one ({len(floating)} such poses)"
            warnings += (f"{named}: they keep to their own edges, and where they stand says nothing",)
        return GraphFile(graph, pose_ids, anchor_ids, stamps, chains, dict(sorted(content.skipped.items())), warnings)


def with_origins(graph: Graph) -> tuple[Floats, Ints]:
    """Return poses (n, 3), each chain that nothing but ranges ties to the first begun at the origin, and their chains (n,)."""
    poses, chains = graph.poses, np.zeros(len(graph.poses), dtype=np.int64)
    relative = [e for e in graph.edges if isinstance(e, RelativePoseEdges)]
    while len(lost := np.flatnonzero(np.isnan(poses[:, 0]))):
        start = poses.copy()
        start[lost[0]] = 0.0
        ends = [np.concatenate([getattr(e, name) for e in relative]) for name in ("i", "j", "T_i_j")] if relative else None
        poses = start if ends is None else chained_poses(start, *ends)
        chains[np.isnan(graph.poses[:, 0]) & ~np.isnan(poses[:, 0]) & (chains == 0)] = chains.max() + 1
    return poses, chains


def _tied(graph: Graph, chains: Ints) -> Bools:
    """Return for each chain whether ranges tie it to the first one, directly, over others or over landmarks."""
    count, landmarks = int(chains.max()) + 1, len(graph.anchors)
    ends = [(np.zeros(0, dtype=np.int64),) * 2]
    for e in graph.edges:
        if isinstance(e, PointDistanceEdges):
            ends.append((chains[e.i], chains[e.j]))
        elif isinstance(e, RangeEdges):
            ends.append((chains[e.pose], count + e.anchor))
    one, other = (np.concatenate(column) for column in zip(*ends, strict=True))
    links = csr_matrix((np.ones(len(one)), (one, other)), shape=(count + landmarks,) * 2)
    label = connected_components(links, directed=False)[1]
    return np.asarray(label[:count] == label[0], dtype=np.bool_)


@dataclass(frozen=True, slots=True, eq=False)
class PlainEdges:
    """A graph's measurements as the text formats can say them: between poses and landmarks, nothing calibrated."""

    i: Ints
    j: Ints
    T_i_j: Floats
    """(e, 3) pose j in pose i."""
    information: Floats
    """(e, 3, 3)."""
    sightings: tuple[Ints, Ints, Floats, Floats]
    """pose (s,), landmark (s,), position (s, 2), information (s, 2, 2)."""
    ranges: tuple[Ints, Ints, Floats, Floats]
    """pose (r,), landmark (r,), range (r,) m, sigma (r,) m."""
    pose_priors: tuple[Ints, Floats, Floats]
    """pose (p,), value (p, 3), information (p, 3, 3) in the chart e = Z^-1 X."""
    landmark_priors: tuple[Ints, Floats, Floats]
    """landmark (p,), value (p, 2), information (p, 2, 2)."""
    pose_ranges: tuple[Ints, Ints, Floats, Floats]
    """pose (r,), pose (r,), range (r,) m, sigma (r,) m."""
    landmark_ranges: tuple[Ints, Ints, Floats, Floats]
    """landmark (r,), landmark (r,), range (r,) m, sigma (r,) m."""


def plain_edges(graph: Graph) -> PlainEdges:
    """Return a graph's measurements with calibration and lever arms worked in at the present estimate.

    Odometry and scan edges become measurements between the poses of the base. A range becomes the range from the pose
    itself that leaves the same residual at the present estimate. Weights scale the information; robust kernels and
    priors on calibration have no place in the formats and are left out. Where nothing is calibrated and lever arms are
    zero nothing changes, so that chi2 stays what it was. Ranges to anchors without a position are left out. Directions that
    an edge does not measure get an information too small to matter (see `definite`).
    """
    relative: list[tuple[Ints, Ints, Floats, Floats]] = []
    sightings: list[tuple[Ints, Ints, Floats, Floats]] = []
    ranges: list[tuple[Ints, Ints, Floats, Floats]] = []
    priors: dict[str, list[tuple[Ints, Floats, Floats]]] = {"poses": [], "anchors": []}
    between_poses: list[tuple[Ints, Ints, Floats, Floats]] = []
    between_landmarks: list[tuple[Ints, Ints, Floats, Floats]] = []
    for edges in graph.edges:
        weights = np.ones(len(edges)) if edges.weights is None else edges.weights
        on = weights > 0
        scale = np.sqrt(weights[on])
        if isinstance(edges, RangeEdges):
            on &= np.isfinite(graph.anchors[edges.anchor]).all(axis=1)
            scale = np.sqrt(weights[on])
            left = edges.residuals(graph)[on, 0] * edges.sigma[on]
            apart = np.hypot(*(graph.poses[edges.pose[on], :2] - graph.anchors[edges.anchor[on]]).T)
            ranges.append((edges.pose[on], edges.anchor[on], apart - left, edges.sigma[on] / scale))
        elif isinstance(edges, PointDistanceEdges):
            left = edges.residuals(graph)[on, 0] * edges.sigma[on]
            apart = np.hypot(*(graph.poses[edges.i[on], :2] - graph.poses[edges.j[on], :2]).T)
            between_poses.append((edges.i[on], edges.j[on], apart - left, edges.sigma[on] / scale))
        elif isinstance(edges, AnchorDistanceEdges):
            between_landmarks.append((edges.i[on], edges.j[on], edges.distance[on], edges.sigma[on] / scale))
        elif isinstance(edges, LandmarkEdges):
            L = edges.sqrt_information[on] * scale[:, None, None]
            sightings.append((edges.pose[on], edges.anchor[on], edges.position[on], _squared(L)))
        elif isinstance(edges, PriorEdges):
            if edges.block in priors:
                L = edges.sqrt_information[on] * scale[:, None, None]
                if edges.block == "poses":
                    L = L @ _turned(edges.value[on, 2])
                priors[edges.block].append((edges.index[on], edges.value[on], _squared(L)))
        elif isinstance(edges, RelativePoseEdges | OdometryEdges | ScanEdges):
            T, L = _between_bases(edges, graph)
            relative.append((edges.i[on], edges.j[on], T[on], _squared(L[on] * scale[:, None, None])))
    none, no_information = _NONE, np.zeros((0, 3, 3))
    i, j, T, information = _stacked(relative, (none, none, np.zeros((0, 3)), no_information))
    return PlainEdges(
        i,
        j,
        T,
        definite(information),
        _definite(_stacked(sightings, (none, none, np.zeros((0, 2)), np.zeros((0, 2, 2))))),
        _stacked(ranges, (none, none, np.zeros(0), np.zeros(0))),
        _definite(_stacked(priors["poses"], (none, np.zeros((0, 3)), no_information))),
        _definite(_stacked(priors["anchors"], (none, np.zeros((0, 2)), np.zeros((0, 2, 2))))),
        _stacked(between_poses, (none, none, np.zeros(0), np.zeros(0))),
        _stacked(between_landmarks, (none, none, np.zeros(0), np.zeros(0))),
    )


def _between_bases(edges: RelativePoseEdges | OdometryEdges | ScanEdges, graph: Graph) -> tuple[Floats, Floats]:
    """Return the measured pose of base j in base i (e, 3) and the square root of its information (e, 3, 3)."""
    if isinstance(edges, RelativePoseEdges):
        return edges.T_i_j, edges.sqrt_information
    if isinstance(edges, OdometryEdges):
        return edges.corrected(graph), edges.sqrt_information / edges.own_scale(graph)[:, None, :]
    # S = X o A, so Z' = A_i Z A_j^-1 and, to first order, e' = A_j e A_j^-1 = M e.
    calibration = np.append(graph.calibration.values, 0.0)
    correction, delay = calibration[edges.calibration[:3]], calibration[edges.calibration[3]]
    A_i, A_j = (se2.compose(se2.exp(twist * (delay - edges.made_with)), correction) for twist in (edges.twist_i, edges.twist_j))
    T = se2.compose(se2.compose(A_i, edges.T_i_j), se2.inverse(A_j))
    M = _turned(A_j[:, 2])
    M[:, 0, 2], M[:, 1, 2] = A_j[:, 1], -A_j[:, 0]
    return T, edges.sqrt_information @ np.linalg.inv(M)


def _turned(theta: Floats) -> Floats:
    """Return blockdiag(R(theta), 1), (e, 3, 3)."""
    turned = np.zeros((len(theta), 3, 3))
    turned[:, 0, 0] = turned[:, 1, 1] = np.cos(theta)
    turned[:, 1, 0] = np.sin(theta)
    turned[:, 0, 1] = -turned[:, 1, 0]
    turned[:, 2, 2] = 1.0
    return turned


def _squared(L: Floats) -> Floats:
    return np.swapaxes(L, 1, 2) @ L


def _stacked(parts: Sequence[tuple[Any, ...]], empty: tuple[Any, ...]) -> Any:
    """Return the columns of all parts, one behind the other; empty ones where there is no part."""
    return tuple(np.concatenate(column) for column in zip(empty, *parts, strict=True))


def _definite(columns: Any) -> Any:
    """Return columns whose last one is information matrices."""
    return (*columns[:-1], definite(columns[-1]))


def symmetric(upper: Floats, size: int) -> Floats:
    """Return symmetric matrices (e, size, size) from their upper triangles row by row (e, size (size + 1) / 2)."""
    row, col = np.triu_indices(size)
    matrices = np.empty((len(upper), size, size))
    matrices[:, row, col] = matrices[:, col, row] = upper
    return matrices


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
    values, vectors = np.linalg.eigh(information)
    least = np.maximum(_FLATTEST * values[:, -1:], np.finfo(np.float64).tiny)
    flat = values[:, 0] < least[:, 0]
    raised = (vectors * np.maximum(values, least)[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    return np.where(flat[:, None, None], raised, information)


def told_places(vertices: Records, index_of: Ints, count: int, content: RecordFile, forget: bool) -> Floats:
    """Return the places (count, numbers) that vertices give, nan where none does or all are to be forgotten.

    Raises
    ------
    FormatError : a vertex is given twice.
    """
    places = np.full((count, vertices.numbers.shape[1]), np.nan)
    index = index_of[vertices.names[:, 0]]
    _, first = np.unique(index, return_index=True)
    if len(first) < len(index):
        again = int(np.setdiff1d(np.arange(len(index)), first)[0])
        raise content.error("this vertex was given before", int(vertices.lines[again]))
    if not forget:
        places[index] = vertices.numbers
    return places


def read_matrices(upper: Floats, size: int, lines: Ints, path: str, what: str) -> Floats:
    """Return symmetric matrices (e, size, size) from upper triangles, none of them with a negative eigenvalue.

    Raises
    ------
    FormatError : a matrix has one; `what` names the kind of matrix.
    """
    matrices = symmetric(upper, size)
    if len(matrices):
        values = np.linalg.eigvalsh(matrices)
        bad = np.flatnonzero(values[:, 0] < -1e-9 * np.abs(values[:, -1]))
        if len(bad):
            raise FormatError(f"the {what} matrix is not positive semi-definite", path, int(lines[bad[0]]))
    return matrices


def root(information: Floats) -> Floats:
    """Return L (e, k, k) with information = L^T L; singular matrices are allowed."""
    try:
        return np.swapaxes(np.linalg.cholesky(information), 1, 2)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(information)
        return np.sqrt(np.maximum(values, 0.0))[:, :, None] * np.swapaxes(vectors, 1, 2)


def assembled(plain: PlainEdges, poses: Floats, anchors: Floats, fixed: Ints = _NONE, fixed_anchors: Ints = _NONE) -> Graph:
    """Return the graph of measurements, with a start for whatever the file gives no position of.

    Parameters
    ----------
    plain : measurements.
    poses : (n, 3) given poses, nan where the file gives none; these are reached from the others along edges.
    anchors : (a, 2) given landmarks; nan where none is given; these are placed by the first edge that sees them.
    fixed, fixed_anchors : indices of what is fixed. Nothing named and no prior on a pose: the first pose is fixed.

    Returns
    -------
    Graph; poses and anchors that nothing leads to stay nan.
    """
    poses = chained_poses(poses, plain.i, plain.j, plain.T_i_j)
    pose, anchor, position, seen = plain.sightings
    placed = np.full_like(anchors, np.nan)
    placed[anchor[::-1]] = se2.transform(poses[pose], position)[::-1]
    anchors = np.where(np.isnan(anchors), placed, anchors)
    prior, value, strength = plain.pose_priors
    edges = (
        RelativePoseEdges(plain.i, plain.j, plain.T_i_j, root(plain.information)),
        LandmarkEdges(pose, anchor, position, root(seen)),
        _ranges_from_poses(*plain.ranges),
        _ranges_between_poses(*plain.pose_ranges),
        AnchorDistanceEdges(*plain.landmark_ranges),
        PriorEdges("poses", prior, value, root(strength) @ _turned(-value[:, 2])),
        PriorEdges("anchors", plain.landmark_priors[0], plain.landmark_priors[1], root(plain.landmark_priors[2])),
    )
    fixed_pose = np.isin(np.arange(len(poses)), fixed)
    given = len(fixed) or len(prior) or len(fixed_anchors) > 1
    return Graph(
        poses,
        anchors,
        tuple(e for e in edges if len(e)),
        fixed_poses=fixed_pose if given else None,
        fixed_anchors=np.isin(np.arange(len(anchors)), fixed_anchors),
    )


def _ranges_from_poses(pose: Ints, anchor: Ints, ranges: Floats, sigma: Floats) -> RangeEdges:
    """Return range edges without lever arms and calibration."""
    n, flat = len(pose), np.zeros((len(pose), 2))
    none = np.full((n, 6), -1, dtype=np.int64)
    return RangeEdges(pose, anchor, ranges, sigma, flat, np.zeros(n), flat, np.zeros(2), np.zeros(n), none)


def _ranges_between_poses(i: Ints, j: Ints, ranges: Floats, sigma: Floats) -> PointDistanceEdges:
    none = np.zeros((len(i), 2))
    return PointDistanceEdges(i, j, none, none, ranges, sigma)
