"""Pose graphs in g2o's text format, planar part, and TORO's older form of it.

| line | fields |
|---|---|
| VERTEX_SE2 | id x y theta |
| VERTEX_XY | id x y |
| EDGE_SE2 | id_i id_j dx dy dtheta I11 I12 I13 I22 I23 I33 |
| EDGE_SE2_XY | id_pose id_landmark dx dy I11 I12 I22 |
| EDGE_PRIOR_SE2 | id x y theta I11 I12 I13 I22 I23 I33 |
| EDGE_PRIOR_XY | id x y I11 I12 I22 |
| FIX | id ... |
| EDGE_RANGE_SE2_XY | id_pose id_landmark range I11 (not part of g2o; seen in other projects) |
| EDGE_RANGE_SE2 | id_pose id_pose range I11 (not part of g2o: our own, for robots that range to each other) |
| VERTEX2 | id x y theta (TORO) |
| EDGE2 | id_i id_j dx dy dtheta I11 I12 I22 I33 I13 I23 (TORO: another order) |

I is the upper triangle of the information matrix in the chart e = Z^-1 (Xi^-1 Xj), the one of uwblite's edges.
"""

import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from ..arrays import WIDE, Ints, Wides, concatenated
from ..errors import FormatError
from ..graph.graph import Graph
from . import graph_file
from .files import replacing
from .records import Layout, RecordFile, Records, read_records
from .source import open_source

_LAYOUTS = {
    "VERTEX_SE2": Layout(1, 3, places=3),
    "VERTEX_XY": Layout(1, 2, places=2),
    "EDGE_SE2": Layout(2, 9, places=3),
    "EDGE_SE2_XY": Layout(2, 5, places=2),
    "EDGE_PRIOR_SE2": Layout(1, 9, places=3),
    "EDGE_PRIOR_XY": Layout(1, 5, places=2),
    "FIX": Layout(1, 0, listed=True),
    "EDGE_RANGE_SE2_XY": Layout(2, 2, places=1),
    "EDGE_RANGE_SE2": Layout(2, 2, places=1),
    "VERTEX2": Layout(1, 3, places=3),
    "EDGE2": Layout(2, 9, places=3),
}
_TAGS = {
    "relative": "EDGE_SE2",
    "observation": "EDGE_SE2_XY",
    "pose_prior": "EDGE_PRIOR_SE2",
    "landmark_prior": "EDGE_PRIOR_XY",
    "range": "EDGE_RANGE_SE2_XY",
    "pose_range": "EDGE_RANGE_SE2",
}
_FROM_TORO = [0, 1, 2, 3, 4, 7, 5, 8, 6]
"""Where dx dy dtheta I11 I12 I13 I22 I23 I33 stand among the numbers of an EDGE2."""


def read_g2o(path: str | os.PathLike[str], *, from_odometry: bool = False) -> graph_file.GraphFile:
    """Read a planar pose graph, g2o or TORO, plain or gzip; ``-`` = standard input.

    What has no VERTEX line is reached along edges, see graph_file.along_edges.

    Parameters
    ----------
    from_odometry : forget the vertices' places and start from the edges between successive poses.

    Raises
    ------
    FormatError : a line is wrong, the graph is not planar, or a pose cannot be reached.
    """
    with open_source(path) as source:
        content = read_records(source, _LAYOUTS)
    records = content.records
    graph_file.check_planar(content)
    toro = replace(records["EDGE2"], numbers=records["EDGE2"].numbers[:, _FROM_TORO])
    steps, vertices = _together(records["EDGE_SE2"], toro), _together(records["VERTEX_SE2"], records["VERTEX2"])
    lines = {kind: records[tag] for kind, tag in _TAGS.items()} | {"relative": steps}
    ids = _ids(content)
    used: dict[str, list[Ints]] = {"pose": [vertices.names], "landmark": [records["VERTEX_XY"].names]}
    for kind, of in lines.items():
        for place, end in enumerate(graph_file.ENDS[kind]):
            used[end].append(of.names[:, place : place + 1])
    (pose_ids, pose_of), (landmark_ids, landmark_of) = (_numbered(ids, names) for names in used.values())
    if len(pose_ids) == 0:
        raise content.error(_no_poses(content))
    if len(both := np.intersect1d(pose_ids, landmark_ids)):
        raise content.error(f"vertex {both[0]} is used as a pose and as a landmark")
    loops = ((of, pose_of[of.names[:, 0]] == pose_of[of.names[:, 1]], _LOOP) for of in (steps, lines["pose_range"]))
    ranged = (lines[kind] for kind in ("range", "pose_range"))
    positive = ((of, ~(of.numbers[:, 1] > 0), "the information of a range must be positive") for of in ranged)
    graph_file.check_lines(content, (*loops, *positive))

    fixed = records["FIX"].names[:, 0]
    poses, landmarks = (
        graph_file.Vertices(tuple(map(str, ids.tolist())), place, given, place[fixed][place[fixed] >= 0])
        for ids, place, given in ((pose_ids, pose_of, vertices), (landmark_ids, landmark_of, records["VERTEX_XY"]))
    )
    numbers = np.arange(len(pose_ids), dtype=np.float64)
    try:
        file = graph_file.GraphFile.of(content, lines, (poses, landmarks), numbers, "information", from_odometry)
    except FormatError as error:
        if error.line is None or error.line not in toro.lines:
            raise
        raise content.error(f"{error.problem} {_ROOTS}", error.line) from None
    return replace(file, warnings=(*_degrees(steps), *file.warnings))


_LOOP = "an edge leads from a pose to itself"
_ROOTS = (
    "in TORO's order (I11 I12 I22 I33 I13 I23). iSAM and gtsam write another EDGE2: the root R of the information row by row"
    " (R11 R12 R13 R22 R23 R33); write such a line as EDGE_SE2 with the upper triangle of R^T R"
)
"""Of EDGE2 lines that are not TORO's."""


def write_g2o(
    path: str | os.PathLike[str],
    graph: Graph,
    anchor_ids: Sequence[str] = (),
    *,
    pose_ids: Sequence[str] = (),
    ranges: bool = False,
    plain: dict[str, graph_file.Measured] | None = None,
) -> None:
    """Write a graph for g2o and similar programs: poses, anchors, edges between poses, and the fixed unknowns.

    gtsam stops reading edges at the first line whose tag it does not know, and SE-Sync knows poses and edges between
    them alone: these stand first, and the first pose, which readers hold of themselves, is named only where more is
    fixed or poses are known beforehand. Poses are vertices 0..n-1 and anchors follow; for what is written see plain_edges.

    Parameters
    ----------
    graph : the graph; anchors that are not finite are left out with their ranges.
    anchor_ids : (a,) names of the anchors; a comment gives which vertex is which.
    pose_ids : (n,) names of the poses; vertices bear these names and the anchors' where all of them are numbers, else the
        numbers of their order, and comments give the names.
    ranges : also write EDGE_RANGE_SE2_XY and EDGE_RANGE_SE2, which stock g2o does not know.
    plain : the graph's plain_edges, where they are known.
    """
    with replacing(path) as stream:
        names = [*(pose_ids or map(str, range(len(graph.poses)))), *anchor_ids]
        kept = bool(pose_ids) and len(set(names)) == len(names) == len(graph.poses) + len(graph.anchors)
        kept = kept and all(_ID.fullmatch(name.encode()) for name in names)
        number = np.array([int(name) for name in names]) if kept else np.arange(len(graph.poses) + len(graph.anchors))
        for lines in _lines(graph, plain or graph_file.plain_edges(graph), ranges, number):
            stream.write(lines.encode())
        if not kept:
            first = 0 if pose_ids else len(graph.poses)
            for vertex, name in enumerate(names[first:], first):
                stream.write(f"# vertex {vertex} is {'anchor ' if vertex >= len(graph.poses) else ''}{name}\n".encode())


def _lines(graph: Graph, plain: dict[str, graph_file.Measured], ranges: bool, number: Ints) -> Iterator[str]:
    """Yield the lines of each tag; `number` (poses + anchors,) is the id of each vertex."""
    n, placed = len(graph.poses), np.isfinite(graph.anchors).all(axis=1)
    yield graph_file.rows_of("VERTEX_SE2", " %d", [number[:n]], graph.poses)
    first = {"pose": 0, "landmark": n}
    for kind, tag in _TAGS.items():
        if kind == "observation":
            yield graph_file.rows_of("VERTEX_XY", " %d", [number[n:][placed]], graph.anchors[placed])
        if ranges or "range" not in kind:
            m = plain[kind]
            ends = [number[first[end] + index] for end, index in zip(graph_file.ENDS[kind], m.ends, strict=True)]
            yield graph_file.rows_of(tag, " %d" * len(ends), ends, m.value, graph_file.upper_triangle(m.information))
    fixed = np.flatnonzero(np.append(graph.fixed_poses, graph.fixed_anchors & placed))
    if fixed.tolist() != [0] or len(plain["pose_prior"].value):
        yield graph_file.rows_of("FIX", " %d", [number[fixed]], np.zeros((len(fixed), 0)))


def _together(a: Records, b: Records) -> Records:
    """Return the lines of both kinds in the order of the file."""
    both = concatenated([a, b])
    return both.rows(np.argsort(both.lines, kind="stable"))


def _ids(content: RecordFile) -> Wides:
    """Return the vertex id that each name of the file stands for."""
    wrong = next((name for name in content.names if not _ID.fullmatch(name) or abs(int(name)) >= 2**63), None)
    if wrong is not None:
        raise content.error(f"{wrong[:30].decode(errors='replace')!r} is not a vertex id, a whole number")
    return np.array([int(name) for name in content.names], dtype=WIDE)


_ID = re.compile(rb"-?\d{1,19}")
"""As many digits as 64 bits hold: gtsam puts a letter into the highest byte."""


def _numbered(ids: Wides, names: Sequence[Ints]) -> tuple[Wides, Ints]:
    """Return the ids (n,) among these names in order, and for every name of the file its place there, -1 = none."""
    used = np.unique(np.concatenate([n.reshape(-1) for n in names]))
    listed, place = np.unique(ids[used], return_inverse=True)
    index = np.full(len(ids), -1, dtype=np.intp)
    index[used] = place.reshape(-1)
    return listed, index


def _no_poses(content: RecordFile) -> str:
    """Return the words on a file without poses, with those that it has."""
    words = ", ".join(f"{count} {tag}" for tag, count in sorted(content.skipped.items(), key=lambda row: -row[1])[:5])
    text = f"holds no poses; its lines are {words}" if words else "holds no poses; is this a g2o file?"
    if _ISAM & set(content.skipped):
        text += (
            ". ODOMETRY and LANDMARK are iSAM's: write them as EDGE_SE2 and EDGE_SE2_XY, in the order of iSAM's numbers (dx dy"
            " dtheta, then the upper triangle of the information matrix row by row: R^T R of iSAM's root R)"
        )
    return text


_ISAM = {"ODOMETRY", "LANDMARK"}


def _degrees(steps: Records) -> tuple[str, ...]:
    """Return the words on edges that turn by more than a turn: angles in degrees look so."""
    beyond = np.abs(steps.numbers[:, 2]) > 2.0 * np.pi
    if not beyond.any():
        return ()
    first = int(np.argmax(beyond))
    return (
        f"{int(beyond.sum())} of {len(beyond)} edges turn by more than a turn (the first by {steps.numbers[first, 2]:.4g} in"
        f" line {steps.lines[first]}): are the angles degrees? They must be radians, in edges and vertices",
    )
