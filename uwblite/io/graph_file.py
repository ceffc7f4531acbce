"""Pose graphs between files and the Graph type: what g2o, TORO and PyFG have in common."""

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from .. import se2
from ..arrays import Bools, Floats, Ints
from ..graph.graph import Edges, Graph, PriorEdges
from ..graph.point_edges import AnchorDistanceEdges, LandmarkEdges, PointDistanceEdges, seen_anchors
from ..graph.pose_edges import OdometryEdges, RelativePoseEdges, ScanEdges
from ..graph.problem_checks import floating_components, given_anchors, tied_chains
from ..graph.range_edges import RangeEdges
from ..graph.unknowns import free_unknowns
from .records import RecordFile, Records

_NONE = np.zeros(0, dtype=np.intp)


ENDS = {
    "relative": ("pose", "pose"),
    "observation": ("pose", "landmark"),
    "range": ("pose", "landmark"),
    "pose_range": ("pose", "pose"),
    "landmark_range": ("landmark", "landmark"),
    "pose_prior": ("pose",),
    "landmark_prior": ("landmark",),
}
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

    Odometry and scan edges become measurements between the poses of the base, a range that from the pose itself which leaves
    the same residual. Weights scale the information. Robust kernels, priors on calibration, and ranges to anchors without a
    position are left out. Directions that an edge does not measure get an information too small to matter (see `definite`).
    """
    kinds: dict[str, list[Measured]] = {kind: [] for kind in ENDS}
    for edges in graph.edges:
        if isinstance(edges, PriorEdges) and edges.block == "calibration":
            continue
        kind, ends, value, L = _plain(edges, graph)
        on = (edges.own_weights > 0) & np.isfinite(value).all(axis=1)
        root = L[on] * np.sqrt(edges.own_weights[on])[:, None, None]
        kinds[kind].append(Measured(tuple(end[on] for end in ends), value[on], np.swapaxes(root, 1, 2) @ root))
    joined = {kind: measured(kind, parts) for kind, parts in kinds.items()}
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
    size, definite = np.trace(information, axis1=1, axis2=2), information.copy()
    doubtful = np.flatnonzero(~(np.linalg.det(information) > 2.0 * _FLATTEST * size ** information.shape[1]))
    values, vectors = np.linalg.eigh(information[doubtful])
    least = np.maximum(_FLATTEST * values[:, -1:], np.finfo(np.float64).tiny)
    raised = (vectors * np.maximum(values, least)[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    flat = values[:, 0] < least[:, 0]
    definite[doubtful[flat]] = raised[flat]
    return definite


def root(information: Floats) -> Floats:
    """Return L (e, k, k) with information = L^T L; singular matrices are allowed."""
    try:
        return np.swapaxes(np.linalg.cholesky(information), 1, 2)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(information)
        return np.sqrt(np.maximum(values, 0.0))[:, :, None] * np.swapaxes(vectors, 1, 2)


@dataclass(frozen=True, slots=True, eq=False)
class GraphFile:
    """The content of a graph file."""

    graph: Graph
    pose_ids: tuple[str, ...]
    """Name of each pose in the file."""
    anchor_ids: tuple[str, ...]
    """Name of each landmark in the file; they are the graph's anchors."""
    stamps: Floats
    """(n,) s, time of each pose; its number where the file gives no time."""
    chains: Ints = field(default_factory=lambda: _NONE)
    """(n,) chain of each pose: 0 stands in the map's frame; others begin at the origin and want a place (see `along_edges`)."""
    skipped: dict[str, int] = field(default_factory=dict)
    """Lines of kinds that are not used, by tag."""
    warnings: tuple[str, ...] = ()
    """Oddities, in words."""

    @staticmethod
    def of(
        content: RecordFile,
        lines: dict[str, Records],
        of: tuple["Vertices", "Vertices"],
        stamps: Floats,
        matrix: str,
        odometry: bool,
    ) -> "GraphFile":
        """Return the graph of a file that was read, with a start for whatever the file gives no position of.

        Parameters
        ----------
        lines : by kind of measurement. of : poses and landmarks. stamps : (n,) s, of the poses.
        matrix : 'information' or 'covariance', on the lines. odometry : forget the positions that the file gives.

        Raises
        ------
        FormatError : a matrix is none of its kind, a pose is connected with nothing, or a vertex is given twice.
        """
        index = {"pose": of[0].place, "landmark": of[1].place}
        plain = {
            kind: measurements(lines[kind], kind, index, content, matrix) if kind in lines else measured(kind) for kind in ENDS
        }
        graph, (pose_ids, anchor_ids) = _assembled(content, plain, *of), (vertices.ids for vertices in of)
        started, chains = along_edges(graph)
        file = GraphFile(started, pose_ids, anchor_ids, stamps, chains, dict(sorted(content.skipped.items())))
        file = file.from_odometry() if odometry else file
        lost, floating = ~tied_chains(file.graph, file.chains), floating_components(file.graph) > 0
        words = "pose {} is not connected to the first one ({} such poses)"
        lost_words, floating_words = (words.format(pose_ids[int(np.argmax(p))], p.sum()) for p in (lost, floating))
        if lost.any():
            raise content.error(lost_words)
        nowhere = [name for name, xy in zip(anchor_ids, file.graph.anchors, strict=True) if np.isnan(xy[0])]
        warnings = [f"no position is given of {len(nowhere)} landmarks: {', '.join(nowhere[:10])}"] if nowhere else []
        if floating.any():
            warnings.append(f"{floating_words}: they keep to their own edges, and where they stand says nothing")
        return replace(file, warnings=tuple(warnings))

    def from_odometry(self) -> "GraphFile":
        """Return the graph as it starts where estimates are forgotten: what is fixed stays, all else follows the edges."""
        free = free_unknowns(self.graph)
        poses = np.where(free["poses"][:, None], np.nan, self.graph.poses)
        anchors = np.where(free["anchors"][:, None], np.nan, self.graph.anchors)
        graph, chains = along_edges(replace(self.graph, poses=poses, anchors=anchors))
        return replace(self, graph=graph, chains=chains)


def along_edges(graph: Graph) -> tuple[Graph, Ints]:
    """Return a graph with a start for its poses, and for the landmarks that edges see or priors place; and chains (n,).

    Chain 0 stands in the map's frame: what is given, has a prior, or is tied to these by edges, else the part of the first
    pose, which is the origin. Every other chain, which only ranges and landmarks may tie to it, begins at the origin.

    Parameters
    ----------
    graph : poses and anchors that are given, nan where none is.
    """
    poses, anchors = graph.poses, graph.anchors.copy()
    relative = [e for e in graph.edges if isinstance(e, RelativePoseEdges)]
    steps = [np.concatenate([getattr(e, name) for e in relative]) for name in ("i", "j", "T_i_j")] if relative else None
    priors: dict[str, dict[int, Floats]] = {"poses": {}, "anchors": {}}
    for e in graph.edges:
        if isinstance(e, PriorEdges):
            priors[e.block] |= dict(zip(e.index.tolist(), e.value, strict=True))
    for anchor, place in priors["anchors"].items():
        anchors[anchor] = place if np.isnan(anchors[anchor, 0]) else anchors[anchor]
    chains = np.zeros(len(poses), dtype=np.intp)
    anchored = bool(np.isfinite(poses[:, 0]).any() or given_anchors(graph).any())
    poses = chained_poses(poses, *steps) if steps and np.isfinite(poses[:, 0]).any() else poses
    while len(lost := np.flatnonzero(np.isnan(poses[:, 0]))):
        pinned = [k for k in lost.tolist() if k in priors["poses"]]
        start = poses.copy()
        start[pinned[0] if pinned else lost[0]] = priors["poses"][pinned[0]] if pinned else 0.0
        reached = chained_poses(start, *steps) if steps else start
        if not pinned and anchored:
            chains[np.isnan(poses[:, 0]) & ~np.isnan(reached[:, 0])] = chains.max() + 1
        poses, anchored = reached, True
    framed = replace(graph, anchors=anchors, poses=np.where((chains == 0)[:, None], poses, np.nan))
    return replace(graph, anchors=seen_anchors(framed), poses=poses), chains


def chained_poses(poses: Floats, i: Ints, j: Ints, T_i_j: Floats) -> Floats:
    """Return poses (n, 3) with the unknown ones (nan) reached from known ones along edges, steps i -> i + 1 preferred.

    Parameters
    ----------
    poses : (n, 3) given poses, nan where unknown; where all are, the first pose is the origin.
    i, j, T_i_j : (e,), (e,), (e, 3) measured poses of j in i.
    """
    n, known = len(poses), ~np.isnan(poses[:, 0])
    if known.all():
        return poses
    if not known.any():
        known[0], poses = True, np.zeros((n, 3))
    # One further node represents everything known; its links are the shortest.
    sources = np.flatnonzero(known)
    rows, cols = np.concatenate([i, np.full(len(sources), n)]), np.concatenate([j, sources])
    cost = np.concatenate([np.where(np.abs(j - i) == 1, 2.0, 3.0), np.ones(len(sources))])
    key, link = np.unique(np.minimum(rows, cols) * (n + 1) + np.maximum(rows, cols), return_index=True)
    links = csr_matrix((cost[link], (key // (n + 1), key % (n + 1))), shape=(n + 1, n + 1))
    order, parent = breadth_first_order(minimum_spanning_tree(links), n, directed=False)
    node = order[1:][~known[order[1:]]].astype(np.intp)
    parent = parent[node].astype(np.intp)
    edge = link[np.searchsorted(key, np.minimum(node, parent) * (n + 1) + np.maximum(node, parent))]
    step = np.where((j[edge] == node)[:, None], T_i_j[edge], se2.inverse(T_i_j[edge]))
    result = np.where(known[:, None], poses, np.nan)
    for k, p, (dx, dy, turn) in zip(node.tolist(), parent.tolist(), step.tolist(), strict=True):
        x, y, theta = result[p].tolist()
        c, sn = math.cos(theta), math.sin(theta)
        result[k] = x + c * dx - sn * dy, y + sn * dx + c * dy, math.remainder(theta + turn, 2.0 * math.pi)
    return result


def check_planar(content: RecordFile) -> None:
    """Raise FormatError where a file holds lines of a three-dimensional graph."""
    for tag in content.skipped:
        if re.search(r"S(E|IM)3|XYZ|(VERTEX|EDGE)3", tag):
            raise content.error(f"holds {tag}: the graph is three-dimensional; only planar graphs are read")


def check_lines(content: RecordFile, checks: Iterable[tuple[Records, Bools, str]]) -> None:
    """Raise FormatError for the first line of some records (n,) that is flagged (n,) as wrong, with the words on it."""
    for of, wrong, problem in checks:
        if wrong.any():
            raise content.error(problem, int(of.lines[int(np.argmax(wrong))]))


def measurements(of: Records, kind: str, index: dict[str, Ints], content: RecordFile, what: str) -> Measured:
    """Return the measurements of one kind that lines hold: names, values, and the upper triangle of a matrix.

    Parameters
    ----------
    index : place of each name of the file among poses, and among landmarks. what : 'information' or 'covariance'.

    Raises
    ------
    FormatError : a matrix has a negative eigenvalue, or is a singular covariance.
    """
    k = WIDTHS.get(kind, 1)
    ends = tuple(index[end][of.names[:, n]] for n, end in enumerate(ENDS[kind]))
    (row, col), matrices = np.triu_indices(k), np.empty((len(of), k, k))
    matrices[:, row, col] = matrices[:, col, row] = of.numbers[:, k:]
    values = np.linalg.eigvalsh(matrices) if len(of) else np.zeros((0, k))
    negative = values[:, 0] < -1e-9 * np.abs(values[:, -1])
    check_lines(content, [(of, negative, f"the {what} matrix is not positive semi-definite")])
    if what == "covariance":
        matrices, least = inverted(matrices)
        check_lines(content, [(of, ~(least > 0.0), "the covariance matrix is singular")])
    return Measured(ends, of.numbers[:, :k], matrices)


def inverted(matrices: Floats) -> tuple[Floats, Floats]:
    """Return the inverses (e, k, k) of symmetric matrices, and their least eigenvalues (e,)."""
    if len(matrices) == 0:
        return matrices, np.zeros(0)
    values, vectors = np.linalg.eigh(matrices)
    with np.errstate(divide="ignore", invalid="ignore"):
        return (vectors / values[:, None, :]) @ np.swapaxes(vectors, 1, 2), values[:, 0]


class Vertices(NamedTuple):
    """Poses, or landmarks, of a file."""

    ids: tuple[str, ...]
    place: Ints
    """Place of each name of the file among them, -1 = none."""
    given: Records
    """Lines that give their positions."""
    fixed: Ints = _NONE
    """Of them, places of those that are fixed."""

    def positions(self, content: RecordFile) -> Floats:
        """Return those that the file gives (n, numbers), nan where it gives none."""
        positions, index = np.full((len(self.ids), self.given.numbers.shape[1]), np.nan), self.place[self.given.names[:, 0]]
        again = np.ones(len(index), dtype=bool)
        again[np.unique(index, return_index=True)[1]] = False
        check_lines(content, [(self.given, again, "this vertex was given before")])
        positions[index] = self.given.numbers
        return positions


def _assembled(content: RecordFile, plain: dict[str, Measured], poses: Vertices, landmarks: Vertices) -> Graph:
    """Return the graph of measurements; where nothing is fixed and there is no prior, the first pose is fixed."""
    L = {kind: root(m.information) for kind, m in plain.items()}
    ((i, j), T_i_j, _), ((pose, anchor), position, _) = plain["relative"], plain["observation"]
    ((prior,), value, _), ((known,), place, _) = plain["pose_prior"], plain["landmark_prior"]
    (seer, seen), (one, other), (first, second) = (plain[kind].ends for kind in _DISTANCES)
    metres = {kind: plain[kind].value[:, 0] for kind in _DISTANCES}
    sigma = {kind: 1.0 / L[kind][:, 0, 0] for kind in _DISTANCES}
    flat, nowhere, bias = np.zeros((len(seer), 2)), np.zeros((len(one), 2)), np.zeros(len(seer))
    uncalibrated = flat, bias, flat, np.zeros(2), bias, np.full((len(seer), 6), -1, dtype=np.intp)
    edges = (
        RelativePoseEdges(i, j, T_i_j, L["relative"]),
        LandmarkEdges(pose, anchor, position, L["observation"]),
        RangeEdges(seer, seen, metres["range"], sigma["range"], *uncalibrated),
        PointDistanceEdges(one, other, nowhere, nowhere, metres["pose_range"], sigma["pose_range"]),
        AnchorDistanceEdges(first, second, metres["landmark_range"], sigma["landmark_range"]),
        PriorEdges("poses", prior, value, L["pose_prior"] @ se2.rotation(-value[:, 2])),
        PriorEdges("anchors", known, place, L["landmark_prior"]),
    )
    gauge_fixed = len(poses.fixed) or len(prior) or len(landmarks.fixed) or len(known)
    return Graph(
        poses.positions(content),
        landmarks.positions(content),
        tuple(e for e in edges if len(e)),
        fixed_poses=np.isin(np.arange(len(poses.ids)), poses.fixed if gauge_fixed else [0]),
        fixed_anchors=np.isin(np.arange(len(landmarks.ids)), landmarks.fixed),
    )


_DISTANCES = ("range", "pose_range", "landmark_range")


def rows_of(tag: str, form: str, columns: Sequence[Any], *tables: Floats) -> str:
    """Return the lines of one tag: columns in the form of one line, then numbers that read back as they were."""
    numbers = np.concatenate(tables, axis=1) + 0.0
    line = f"{tag}{form}{' %r' * numbers.shape[1]}\n"
    return "".join(map(line.__mod__, zip(*(column.tolist() for column in (*columns, *numbers.T)), strict=True)))
