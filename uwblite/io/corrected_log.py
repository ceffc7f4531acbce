"""A map's poses with the recording's scans: CARMEN logs with corrected laser poses, and the pose graph with its scans."""

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from .. import se2
from ..arrays import Floats
from ..errors import FormatError
from ..map_result import MapResult
from ..sensor_log import SensorLog
from .carmen_words import HEAD, places_behind, stamp_of
from .carmen_writer import scan_lines
from .files import replacing
from .log_parts import parts_of
from .source import open_source
from .stored_result import StoredResult

PosesAt = Callable[[Floats], tuple[Floats, Floats]]
"""Returns the poses of laser and robot (n, 3) in the map at stamps (n,) of scans, s; nan where there is none."""

_POSED, _RAW = (b"FLASER ", b"ROBOTLASER1 "), (b"RAWLASER1 ",)
_UNPOSED = [b"0"] * 11
"""Words of ROBOTLASER1 that RAWLASER1 lacks: poses of laser and robot, speeds, safety distances, turn axis."""
_KEPT = (b"PARAM", b"#")
_ODOM_WITHOUT_IPC = 9
"""Words of an ODOM line that leaves out ipc_timestamp."""


def write_corrected_log(path: str | os.PathLike[str], source: str, poses_at: PosesAt) -> tuple[int, int]:
    """Write the laser messages of a CARMEN log with corrected poses; PARAM lines and comments stay, all else is left out.

    FLASER gets the corrected pose of the laser and keeps the odometry's pose behind it; ROBOTLASER1 gets those of laser and
    robot, whose difference is the mounting. Readings and stamps stay as they are. RAWLASER1, which has no poses, becomes
    ROBOTLASER1 where the log has no other laser messages.

    Parameters
    ----------
    source : the log that was mapped, or one of its parts.

    Returns
    -------
    Scans written, and laser messages left out: broken ones, and those at times at which the map knows no pose.
    """
    for kinds in (_POSED, _RAW):
        written = left_out = 0
        with replacing(path) as stream:
            for part in parts_of(source)[0]:
                with open_source(part) as text:
                    for lines, missing in _corrected(text.blocks(), kinds, poses_at):
                        stream.write(b"".join(lines))
                        written += sum(line.startswith(_POSED) for line in lines)
                        left_out += missing
        if written or left_out:
            break
    return written, left_out


_OUTSIDE = 0.2
"""Scans so far outside the trajectory's time, s, beside the offset of the lidar's clock, have the pose of its end."""


def poses_of_scans(result: MapResult, log: SensorLog, stamps: Floats) -> tuple[Floats, Floats]:
    """Return the poses of laser and robot (n, 3) in the map in the middle of scans stamped `stamps` (n,), s.

    Parameters
    ----------
    result, log : the map of a single recording, and the recording. Scans outside its time have nan.
    """
    calibration, scans = result.graph.calibration, log.scans
    delay = calibration.get("laser_delay")
    half = 0.0 if scans is None else 0.5 * scans.duration
    robot = se2.interpolate_trajectory(result.stamps, result.trajectory, stamps + (delay + half)).reshape(-1, 3)
    slack = abs(delay) + half + _OUTSIDE
    robot[(stamps < result.stamps[0] - slack) | (stamps > result.stamps[-1] + slack)] = np.nan
    correction = np.array([calibration.get(name) for name in ("laser_x", "laser_y", "laser_theta")])
    return se2.compose(robot, se2.compose(correction, log.mounting.T_base_laser)), robot


def _corrected(blocks: Iterator[bytes], kinds: tuple[bytes, ...], poses_at: PosesAt) -> Iterator[tuple[list[bytes], int]]:
    """Yield the lines of each block as they are to be written, and how many laser messages of some kinds are left out."""
    ipc_left_out = False
    for block in blocks:
        kept: list[tuple[list[bytes], int]] = []  # words of a scan, and where its poses stand; or a line as it is, and 0
        stamps, left_out = [], 0
        for line in block.splitlines():
            if line.startswith(_KEPT):
                kept.append(([line], 0))
            elif line.startswith(b"ODOM "):
                ipc_left_out = len(line.split()) == _ODOM_WITHOUT_IPC
            elif line.startswith(kinds):
                try:
                    words = line.split()
                    place, stamp = _poses_in(words, ipc_left_out)
                except (ValueError, IndexError):
                    left_out += 1
                    continue
                if kinds == _RAW:
                    words = [b"ROBOTLASER1", *words[1:place], *_UNPOSED, *words[place:]]
                kept.append((words, place))
                stamps.append(stamp)
        poses, lines = iter(np.concatenate(poses_at(np.array(stamps)), axis=1).tolist()), []
        for words, place in kept:
            if place:
                corrected = next(poses)[: 3 if words[0] == b"FLASER" else 6]
                words[place : place + len(corrected)] = [b"%.6f" % value for value in corrected]
                if not np.isfinite(corrected).all():
                    left_out += 1
                    continue
            lines.append(b" ".join(words) + b"\n")
        yield lines, left_out


def _poses_in(words: list[bytes], ipc_left_out: bool) -> tuple[int, float]:
    """Return the word at which the poses of a laser message begin, and its stamp, s."""
    name = words[0]
    behind = HEAD[name] + int(words[HEAD[name] - 1])
    poses, stamp = places_behind(name, words[behind:], ipc_left_out)
    return behind + poses, stamp_of(words[behind + stamp])


_SAME_TIME = 0.5
"""s between a keyframe and the scan that is attached to it."""


def write_graph_with_scans(path: str | os.PathLike[str], result: StoredResult, logs: Sequence[SensorLog]) -> int:
    """Write graph.g2o of a result with the nearest scan of each keyframe behind its vertex, as g2o's ROBOTLASER1.

    Parameters
    ----------
    logs : its recordings, in their order; none: the graph alone.

    Returns
    -------
    Number of vertices with a scan.
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
    chosen = cKDTree(log.scans.stamps[:, None]).query(stamps[:, None])[1]
    near = np.abs(log.scans.stamps[chosen] - stamps) <= _SAME_TIME
    keyframes, chosen = keyframes[near], chosen[near]
    seen = log.scans.rows(chosen)
    yield from zip(keyframes.tolist(), scan_lines(replace(log, scans=seen)), strict=True)
