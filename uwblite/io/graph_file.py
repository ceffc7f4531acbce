"""Pose graphs between files and the Graph type: what g2o, TORO and PyFG have in common."""

import re
from dataclasses import dataclass, field, replace

import numpy as np

from .. import se2
from ..arrays import Floats, Ints
from ..errors import FormatError
from ..graph.components import floating_components, tied_chains
from ..graph.distance_edges import AnchorDistanceEdges, PointDistanceEdges
from ..graph.graph import Graph, PriorEdges
from ..graph.point_edges import LandmarkEdges
from ..graph.pose_edges import RelativePoseEdges
from ..graph.range_edges import RangeEdges
from ..graph.unknowns import free_unknowns
from .graph_chains import along_edges
from .plain_edges import ENDS, WIDTHS, Measured, root
from .records import RecordFile, Records

_NONE = np.zeros(0, dtype=np.intp)


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
    chains: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    """(n,) chain of each pose: 0 stands in the map's frame; others begin at the origin and want a place (see `along_edges`)."""
    skipped: dict[str, int] = field(default_factory=dict)
    """Lines of kinds that are not used, by tag."""
    warnings: tuple[str, ...] = ()
    """Oddities, in words."""

    @staticmethod
    def checked(
        graph: Graph,
        pose_ids: tuple[str, ...],
        anchor_ids: tuple[str, ...],
        stamps: Floats,
        content: RecordFile,
        from_odometry: bool = False,
    ) -> "GraphFile":
        """Return the graph of a file that was read, with a start for whatever the file gives no position of.

        Parameters
        ----------
        from_odometry : forget the positions that it gives.

        Raises
        ------
        FormatError : a pose is connected with nothing.
        """
        started, chains = along_edges(graph)
        file = GraphFile(started, pose_ids, anchor_ids, stamps, chains, dict(sorted(content.skipped.items())))
        file = file.from_odometry() if from_odometry else file
        lost = np.flatnonzero(~tied_chains(file.graph, file.chains))
        if len(lost):
            raise content.error(f"pose {pose_ids[lost[0]]} is not connected to the first one ({len(lost)} such poses)")
        nowhere = [name for name, xy in zip(anchor_ids, file.graph.anchors, strict=True) if np.isnan(xy[0])]
        warnings: tuple[str, ...] = (
            (f"no position is given of {len(nowhere)} landmarks: {', '.join(nowhere[:10])}",) if nowhere else ()
        )
        floating = np.flatnonzero(floating_components(file.graph) > 0)
        if len(floating):
            named = f"pose {pose_ids[floating[0]]} is not connected to the first one ({len(floating)} such poses)"
            warnings += (f"{named}: they keep to their own edges, and where they stand says nothing",)
        return replace(file, warnings=warnings)

    def from_odometry(self) -> "GraphFile":
        """Return the graph as it starts where estimates are forgotten: what is fixed stays, all else follows the edges."""
        free = free_unknowns(self.graph)
        poses = np.where(free["poses"][:, None], np.nan, self.graph.poses)
        anchors = np.where(free["anchors"][:, None], np.nan, self.graph.anchors)
        graph, chains = along_edges(replace(self.graph, poses=poses, anchors=anchors))
        return replace(self, graph=graph, chains=chains)


def check_planar(content: RecordFile) -> None:
    """Raise FormatError where a file holds lines of a three-dimensional graph."""
    for tag in content.skipped:
        if _SPATIAL.search(tag):
            raise content.error(f"holds {tag}: the graph is three-dimensional; only planar graphs are read")


_SPATIAL = re.compile(r"S(E|IM)3|XYZ|(VERTEX|EDGE)3")


def symmetric(upper: Floats, size: int) -> Floats:
    """Return symmetric matrices (e, size, size) from their upper triangles row by row (e, size (size + 1) / 2)."""
    row, col = np.triu_indices(size)
    matrices = np.empty((len(upper), size, size))
    matrices[:, row, col] = matrices[:, col, row] = upper
    return matrices


def given_places(vertices: Records, index_of: Ints, count: int, content: RecordFile) -> Floats:
    """Return the places (count, numbers) that vertices give, nan where none does.

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
    """Return the graph of measurements.

    Parameters
    ----------
    poses : (n, 3) given poses, nan where the file gives none.
    anchors : (a, 2) given landmarks, nan where the file gives none.
    fixed, fixed_anchors : indices of what is fixed. Nothing named and no prior: the first pose is fixed.
    """
    (i, j), T_i_j, _ = plain["relative"]
    (pose, anchor), position, _ = plain["observation"]
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
    given = len(fixed) or len(prior) or len(fixed_anchors) or len(known)
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
    none = np.full((n, 6), -1, dtype=np.intp)
    return RangeEdges(pose, anchor, ranges, sigma, flat, np.zeros(n), flat, np.zeros(2), np.zeros(n), none)
