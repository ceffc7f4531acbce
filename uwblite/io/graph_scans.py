"""The pose graph of a result with its scans, as g2o and the tools around it read them."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from ..arrays import Floats, Ints
from ..errors import FormatError
from ..sensor_log import SensorLog
from .carmen_writer import scan_lines
from .files import replacing
from .stored_result import StoredResult

_SAME_TIME = 0.5
"""s between a keyframe and the scan that is attached to it."""


def write_graph_with_scans(path: str | os.PathLike[str], result: StoredResult, logs: Sequence[SensorLog]) -> int:
    """Write graph.g2o of a result with the nearest scan of each keyframe behind its vertex, as g2o's ROBOTLASER1.

    Parameters
    ----------
    path : the file, compressed where its name ends in ``.gz``.
    logs : its recordings, in their order; none: the graph alone.

    Returns
    -------
    Number of vertices with a scan.

    Raises
    ------
    FormatError : the result has no graph.g2o.
    OSError : the file cannot be written.
    """
    source = result.folder / "graph.g2o"
    if not source.is_file():
        raise FormatError("has no graph.g2o", os.fspath(result.folder))
    scans = {number: line for k, log in enumerate(logs, 1) for number, line in _scans(result, k, log)}
    with replacing(path) as stream, open(source, "rb") as lines:
        for line in lines:
            stream.write(line)
            if line.startswith(b"VERTEX_SE2 "):
                stream.write(scans.get(int(line.split(None, 2)[1]), b""))
    return len(scans)


def _scans(result: StoredResult, recording: int, log: SensorLog) -> Iterator[tuple[int, bytes]]:
    """Yield number and ROBOTLASER1 line of each keyframe of a recording that has a scan."""
    keyframes = np.flatnonzero(result.keyframe_recordings == recording)
    if log.scans is None or len(log.scans.stamps) == 0:
        return
    stamps = result.keyframe_stamps[keyframes]
    chosen = _nearest(log.scans.stamps, stamps)
    near = np.abs(log.scans.stamps[chosen] - stamps) <= _SAME_TIME
    keyframes, chosen = keyframes[near], chosen[near]
    seen = log.scans.rows(chosen)
    yield from zip(keyframes.tolist(), scan_lines(replace(log, scans=seen)), strict=True)


def _nearest(sorted_stamps: Floats, query: Floats) -> Ints:
    """Return the index of the nearest stamp."""
    right = np.clip(np.searchsorted(sorted_stamps, query), 1, max(len(sorted_stamps) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(sorted_stamps) - 1)
    return np.where(query - sorted_stamps[left] <= sorted_stamps[right] - query, left, right).astype(np.intp)
