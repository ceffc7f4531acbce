"""Pose graphs between files and the Graph type: what g2o, TORO and PyFG have in common."""

from dataclasses import dataclass, field, replace

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
from ..graph.pose_edges import RelativePoseEdges
from ..graph.range_edges import RangeEdges
from .graph_chains import chained_poses
from .plain_edges import ENDS, WIDTHS, Measured, root
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


def symmetric(upper: Floats, size: int) -> Floats:
    """Return symmetric matrices (e, size, size) from their upper triangles row by row (e, size (size + 1) / 2)."""
    row, col = np.triu_indices(size)
    matrices = np.empty((len(upper), size, size))
    matrices[:, row, col] = matrices[:, col, row] = upper
    return matrices


def given_places(vertices: Records, index_of: Ints, count: int, content: RecordFile, forget: bool) -> Floats:
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


def measurements(of: Records, kind: str, index: dict[str, Ints], content: RecordFile, what: str) -> Measured:
    """Return the measurements of one kind that lines hold: names, values, and the upper triangle of a matrix.

    Parameters
    ----------
    index : place of each name of the file among poses, and among landmarks. what : the kind of matrix.
    """
    k = WIDTHS.get(kind, 1)
    ends = tuple(index[end][of.names[:, n]] for n, end in enumerate(ENDS[kind]))
    return Measured(ends, of.numbers[:, :k], read_matrices(of.numbers[:, k:], k, of.lines, content.path, what))


def assembled(
    plain: dict[str, Measured], poses: Floats, anchors: Floats, fixed: Ints = _NONE, fixed_anchors: Ints = _NONE
) -> Graph:
    """Return the graph of measurements, with a start for whatever the file gives no position of.

    Parameters
    ----------
    poses : (n, 3) given poses, nan where the file gives none; these are reached from the others along edges.
    anchors : (a, 2) given landmarks; nan where none is given; these are placed by the first edge that sees them.
    fixed, fixed_anchors : indices of what is fixed. Nothing named and no prior on a pose: the first pose is fixed.

    Returns
    -------
    Graph; poses and anchors that nothing leads to stay nan.
    """
    (i, j), T_i_j, _ = plain["relative"]
    poses = chained_poses(poses, i, j, T_i_j)
    (pose, anchor), position, _ = plain["observation"]
    placed = np.full_like(anchors, np.nan)
    placed[anchor[::-1]] = se2.transform(poses[pose], position)[::-1]
    anchors = np.where(np.isnan(anchors), placed, anchors)
    (seer, seen), (one, other), (first, second) = (plain[kind].ends for kind in _DISTANCES)
    L = {kind: root(m.information) for kind, m in plain.items()}
    ranges = {kind: (plain[kind].value[:, 0], 1.0 / L[kind][:, 0, 0]) for kind in _DISTANCES}
    (prior,), value, _ = plain["pose_prior"]
    (known,), place, _ = plain["landmark_prior"]
    nowhere = np.zeros((len(ranges["pose_range"][0]), 2))
    edges = (
        RelativePoseEdges(i, j, T_i_j, L["relative"]),
        LandmarkEdges(pose, anchor, position, L["observation"]),
        _ranges_from_poses(seer, seen, *ranges["range"]),
        PointDistanceEdges(one, other, nowhere, nowhere, *ranges["pose_range"]),
        AnchorDistanceEdges(first, second, *ranges["landmark_range"]),
        PriorEdges("poses", prior, value, L["pose_prior"] @ se2.rotation(-value[:, 2])),
        PriorEdges("anchors", known, place, L["landmark_prior"]),
    )
    given = len(fixed) or len(prior) or len(fixed_anchors) > 1
    return Graph(
        poses,
        anchors,
        tuple(e for e in edges if len(e)),
        fixed_poses=np.isin(np.arange(len(poses)), fixed if given else [0]),
        fixed_anchors=np.isin(np.arange(len(anchors)), fixed_anchors),
    )


_DISTANCES = ("range", "pose_range", "landmark_range")


def _ranges_from_poses(pose: Ints, anchor: Ints, ranges: Floats, sigma: Floats) -> RangeEdges:
    """Return range edges without lever arms and calibration."""
    n, flat = len(pose), np.zeros((len(pose), 2))
    none = np.full((n, 6), -1, dtype=np.int64)
    return RangeEdges(pose, anchor, ranges, sigma, flat, np.zeros(n), flat, np.zeros(2), np.zeros(n), none)
