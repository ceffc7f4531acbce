"""Range-aided pose graphs in PyFactorGraph's text format, as CORA reads it; planar part.

| line | fields |
|---|---|
| VERTEX_SE2 | stamp A0 x y theta |
| VERTEX_XY | L0 x y |
| VERTEX_SE2:PRIOR | stamp A0 x y theta c11 c12 c13 c22 c23 c33 |
| VERTEX_XY:PRIOR | stamp L0 x y c11 c12 c22 |
| EDGE_SE2 | stamp A0 A1 dx dy dtheta c11 c12 c13 c22 c23 c33 |
| EDGE_SE2_XY | stamp A2 L0 dx dy c11 c12 c22 |
| EDGE_RANGE | stamp A2 L0 range variance |

A name is a letter and a number; L is a landmark. c is the upper triangle of a covariance matrix. Others' files often hold
the true poses as vertices: see `from_odometry`.
"""

import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..arrays import Floats, Ints
from ..graph.graph import Graph
from . import graph_file
from .files import replacing
from .records import Layout, RecordFile, Records, read_records
from .source import open_source

_LAYOUTS = {
    "VERTEX_SE2": Layout(1, 3, stamped=True, places=3),
    "VERTEX_XY": Layout(1, 2, places=2),
    "VERTEX_SE2:PRIOR": Layout(1, 9, stamped=True, places=3),
    "VERTEX_XY:PRIOR": Layout(1, 5, stamped=True, places=2),
    "EDGE_SE2": Layout(2, 9, stamped=True, places=3),
    "EDGE_SE2_XY": Layout(2, 5, stamped=True, places=2),
    "EDGE_RANGE": Layout(2, 2, stamped=True, places=1),
}
_TAGS = {
    "pose_prior": "VERTEX_SE2:PRIOR",
    "landmark_prior": "VERTEX_XY:PRIOR",
    "relative": "EDGE_SE2",
    "observation": "EDGE_SE2_XY",
    "range": "EDGE_RANGE",
    "pose_range": "EDGE_RANGE",
    "landmark_range": "EDGE_RANGE",
}
"""In the order of the file."""
_NAME = re.compile(rb"([A-Za-z])(\d{1,15})")


def read_pyfg(path: str | os.PathLike[str], *, from_odometry: bool = False) -> graph_file.GraphFile:
    """Read a planar PyFG graph, plain or gzip; ``-`` = standard input.

    Parameters
    ----------
    from_odometry : forget where the vertices are and start from the edges between successive poses.

    Raises
    ------
    FormatError : a line is wrong, the graph is not planar, or a pose cannot be reached.
    """
    with open_source(path) as source:
        content = read_records(source, _LAYOUTS)
    graph_file.check_planar(content)
    pose_ids, pose_of, landmark_ids, landmark_of = _numbered(content)
    if not pose_ids:
        raise content.error("holds no poses; is this a PyFG file?")
    records = content.records
    steps, seen = records["EDGE_SE2"], records["EDGE_SE2_XY"]
    pinned, surveyed = records["VERTEX_SE2:PRIOR"], records["VERTEX_XY:PRIOR"]
    ranged, meetings, surveys = _kinds_of_ranges(records["EDGE_RANGE"], pose_of, landmark_of)
    ends, both = pose_of[steps.names], (meetings, surveys)
    seen_both = (pose_of[seen.names[:, 0]] >= 0) & (landmark_of[seen.names[:, 1]] >= 0)
    vertices, landmarks = records["VERTEX_SE2"], records["VERTEX_XY"]
    checks = (
        (steps, (ends < 0).any(axis=1), "an edge between poses names a landmark"),
        (steps, ends[:, 0] == ends[:, 1], "an edge leads from a pose to itself"),
        (seen, ~seen_both, "needs a pose and a landmark"),
        *((of, ~(of.numbers[:, 1] > 0), "the variance of a range must be positive") for of in (ranged, *both)),
        *((of, of.names[:, 0] == of.names[:, 1], "a range leads from a vertex to itself") for of in both),
        (pinned, pose_of[pinned.names[:, 0]] < 0, "a prior on a pose names a landmark"),
        (surveyed, landmark_of[surveyed.names[:, 0]] < 0, "a prior on a landmark names a pose"),
        (vertices, pose_of[vertices.names[:, 0]] < 0, "a pose is named like a landmark"),
        (landmarks, landmark_of[landmarks.names[:, 0]] < 0, "a landmark is named like a pose"),
    )
    graph_file.check_lines(content, checks)

    lines = {"relative": steps, "observation": seen, "pose_prior": pinned, "landmark_prior": surveyed, "range": ranged}
    lines |= {"pose_range": meetings, "landmark_range": surveys}
    stamps = np.arange(len(pose_ids), dtype=np.float64)
    stamps[ends[:, 1]] = steps.stamps
    stamps[pose_of[vertices.names[:, 0]]] = vertices.stamps
    named = graph_file.Vertices(pose_ids, pose_of, vertices), graph_file.Vertices(landmark_ids, landmark_of, landmarks)
    return graph_file.GraphFile.of(content, lines, named, stamps, "covariance", from_odometry)


def write_pyfg(
    path: str | os.PathLike[str],
    graph: Graph,
    anchor_ids: Sequence[str] = (),
    stamps: Floats | None = None,
    *,
    pose_ids: Sequence[str] = (),
    plain: dict[str, graph_file.Measured] | None = None,
) -> None:
    """Write a graph with its ranges; poses are A0, A1, ... and anchors L0, L1, ... in the order of the graph.

    For what is written see plain_edges. The vertices hold the estimate.

    Parameters
    ----------
    graph : the graph; anchors that are not finite are left out with their ranges.
    anchor_ids : (a,) names of the anchors, kept where all of them are such as the format knows: L and a number.
    stamps : (n,) s, time of each pose; None = its number.
    pose_ids : (n,) names of the poses, kept where all are such as the format knows: another letter and a number. Plain
        numbers get the letter A.
    plain : the graph's plain_edges, where they are known.
    """
    stamps = np.arange(len(graph.poses), dtype=np.float64) if stamps is None else stamps
    with replacing(path) as stream:
        poses = _names("A", pose_ids, len(graph.poses), b"[A-KM-Za-z]")
        anchors = _names("L", anchor_ids, len(graph.anchors), b"L")
        for lines in _lines(graph, plain or graph_file.plain_edges(graph), stamps, poses, anchors):
            stream.write(lines.encode())


def _names(letter: str, names: Sequence[str], count: int, letters: bytes) -> NDArray[np.str_]:
    """Return the names of vertices as the format has them."""
    named = [letter + name if name.isdigit() else name for name in names]
    fit = re.compile(letters + rb"\d{1,15}")
    if len(named) == count == len(set(named)) and all(fit.fullmatch(name.encode(errors="replace")) for name in named):
        return np.array(named, dtype=np.str_)
    return np.array([f"{letter}{number}" for number in range(count)], dtype=np.str_)


def _lines(
    graph: Graph, plain: dict[str, graph_file.Measured], stamps: Floats, poses: NDArray[np.str_], anchors: NDArray[np.str_]
) -> Iterator[str]:
    """Yield the lines of the vertices, then those of each kind of edges."""
    first = int(np.argmax(graph.fixed_poses)) if len(graph.poses) else 0
    placed = np.isfinite(graph.anchors).all(axis=1)
    yield graph_file.rows_of("VERTEX_SE2", " %.6f %s", [stamps, poses], graph.poses)
    yield graph_file.rows_of("VERTEX_XY", " %s", [anchors[placed]], graph.anchors[placed])
    names = {"pose": poses, "landmark": anchors}
    for kind, tag in _TAGS.items():
        m = plain[kind]
        ends = [names[end][index] for end, index in zip(graph_file.ENDS[kind], m.ends, strict=True)]
        # A step is of the time of its end, a range of that of its first pose, what has none of that of the pose that is fixed.
        indices = [index for end, index in zip(graph_file.ENDS[kind], m.ends, strict=True) if end == "pose"]
        when = stamps[indices[-1 if kind == "relative" else 0]] if indices else np.full(len(m.value), stamps[first])
        covariances = graph_file.upper_triangle(graph_file.inverted(m.information)[0])
        yield graph_file.rows_of(tag, " %.6f" + " %s" * len(ends), [when, *ends], m.value, covariances)


def _numbered(content: RecordFile) -> tuple[tuple[str, ...], Ints, tuple[str, ...], Ints]:
    """Return names of poses, place of every name among them (-1 = none), and the same of landmarks."""
    parsed = [_NAME.fullmatch(name) for name in content.names]
    index = [np.full(len(parsed), -1, dtype=np.intp) for _ in range(2)]
    listed: list[list[tuple[bytes, int, int]]] = [[], []]
    for place, (name, match) in enumerate(zip(content.names, parsed, strict=True)):
        if match is None:
            shown = name[:30].decode(errors="replace")
            raise content.error(f"{shown!r} is not a name: a letter and a number, L for landmarks")
        listed[match[1] == b"L"].append((match[1], int(match[2]), place))
    names = []
    for kind, numbers in zip(index, listed, strict=True):
        numbers.sort()
        kind[[place for _, _, place in numbers]] = np.arange(len(numbers))
        names.append(tuple(content.names[place].decode() for _, _, place in numbers))
    return names[0], index[0], names[1], index[1]


def _kinds_of_ranges(ranged: Records, pose_of: Ints, landmark_of: Ints) -> tuple[Records, Records, Records]:
    """Return the ranges between a pose and a landmark, in this order, between two poses, and between two landmarks."""
    names = ranged.names.copy()
    swapped = (landmark_of[names[:, 0]] >= 0) & (pose_of[names[:, 1]] >= 0)
    names[swapped] = names[swapped, ::-1]
    first, second = pose_of[names[:, 0]] >= 0, pose_of[names[:, 1]] >= 0
    kinds = (first & ~second, first & second, ~first)
    mixed, meetings, surveys = (replace(ranged, names=names).rows(kind) for kind in kinds)
    return mixed, meetings, surveys
