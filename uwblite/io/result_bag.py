"""A map as a ROS 2 bag: /map, corrected transforms, path, covariances and markers, to be played, or opened in Foxglove."""

import heapq
import os
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from .. import se2
from ..arrays import Floats
from ..errors import ConfigError
from ..report import palette
from ..report.palette import share
from ..sensor_log import SensorLog
from .ros_messages import BASE, MAP, ODOM, Messages
from .rosbag_writer import Stamped, recording_messages, write_messages
from .stored_result import StoredAnchor, StoredResult

_MOST_POSES = 10_000
"""Of a path; more are thinned out evenly."""
_LINES, _SPHERE, _CYLINDER, _TEXT = 5, 2, 3, 9
"""Types of visualization_msgs/Marker."""
_ANCHOR, _ACCEPTED, _REJECTED = share(palette.ANCHOR), share(palette.ACCEPTED), share(palette.REJECTED, 0.5)


def write_result_bag(
    path: str | os.PathLike[str], result: StoredResult, logs: Sequence[SensorLog] = (), *, storage: str = "mcap"
) -> None:
    """Write a map as a ROS 2 bag; see `write_bag` for path and storage.

    Topics: /map, /path (and /path_2 ... of further recordings), /anchors and /closures (markers), all latched; /pose with
    the covariance of every keyframe; /tf. With the recordings it holds their messages too, and map -> odom is what takes
    each reading of the wheels to its corrected place; without, odom lies on map and base_link moves in it.

    Parameters
    ----------
    path : file (.mcap) or folder to make.
    logs : its recordings in their order, or none; frames and topics of the second begin with ``recording_2/``.
    storage : 'mcap' or 'sqlite3'.

    Raises
    ------
    ConfigError : there are recordings, but not as many as the map was made of, or one of another time.
    """
    _check(result, logs)
    trajectories = tuple((_from_zero(stamps), poses) for stamps, poses in result.trajectories)
    result = replace(result, trajectories=trajectories, keyframe_stamps=_from_zero(result.keyframe_stamps))
    write_messages(path, lambda make: _messages(result, logs, make), storage=storage)


def _from_zero(stamps: Floats) -> Floats:
    """Return stamps (n,), s, with those less than a second before 0 put to 0: a late lidar clock moves keyframes there."""
    return np.where((stamps > -1.0) & (stamps < 0.0), 0.0, stamps)


def _check(result: StoredResult, logs: Sequence[SensorLog]) -> None:
    count = len(result.trajectories)
    if logs and len(logs) != count:
        raise ConfigError(f"the map was made of {count} recordings, not {len(logs)}; name them all, in their order")
    for log, (stamps, _) in zip(logs, result.trajectories, strict=False):
        (first, last), (begin, end) = log.odometry.stamps[[0, -1]].tolist(), stamps[[0, -1]].tolist()
        if last < begin or first > end:
            name = log.notes.source or "the recording"
            raise ConfigError(f"{name} lasts from {first:.1f} to {last:.1f} s, the map's recording {begin:.1f} to {end:.1f} s")


def _messages(result: StoredResult, logs: Sequence[SensorLog], make: Messages) -> Iterator[Stamped]:
    first = min(float(stamps[0]) for stamps, _ in result.trajectories)
    yield from _once(result, make, first)
    moving = [_poses(result, make)]
    for number, (stamps, poses) in enumerate(result.trajectories, 1):
        prefix = "" if number == 1 else f"recording_{number}/"
        if logs:
            log = logs[number - 1]
            moving += [recording_messages(log, make, prefix=prefix), _corrections(result, number, log, make, prefix)]
        else:
            yield first, "/tf_static", make.tf(first, MAP, prefix + ODOM, np.zeros(3))
            pairs = zip(stamps.tolist(), poses, strict=True)
            moving.append((t, "/tf", make.tf(t, prefix + ODOM, prefix + BASE, pose)) for t, pose in pairs)
    yield from heapq.merge(*moving, key=lambda message: message[0])


def _corrections(result: StoredResult, number: int, log: SensorLog, make: Messages, prefix: str) -> Iterator[Stamped]:
    """Yield T_map_odom = T_map_base T_odom_base^-1 at every reading of the wheels."""
    stamps = log.odometry.stamps
    T_map_odom = se2.compose(result.pose_at(number, stamps), se2.inverse(log.odometry.poses))
    for stamp, pose in zip(stamps.tolist(), T_map_odom, strict=True):
        yield stamp, "/tf", make.tf(stamp, MAP, prefix + ODOM, pose)


def _poses(result: StoredResult, make: Messages) -> Iterator[Stamped]:
    order = np.argsort(result.keyframe_stamps, kind="stable")
    for k in order.tolist():
        stamp, number = float(result.keyframe_stamps[k]), int(result.keyframe_recordings[k])
        pose = result.pose_at(number, np.array(stamp))
        topic = "/pose" if number == 1 else f"/recording_{number}/pose"
        yield stamp, topic, make.pose_with_covariance(stamp, pose, result.keyframe_covariances[k])


def _once(result: StoredResult, make: Messages, first: float) -> Iterator[Stamped]:
    """Yield what does not change: map, paths and markers."""
    if result.grid is not None:
        yield first, "/map", make.grid(first, result.grid)
    for number, (stamps, poses) in enumerate(result.trajectories, 1):
        step = -(-len(stamps) // _MOST_POSES)
        yield first, "/path" if number == 1 else f"/path_{number}", make.path(stamps[::step], poses[::step])
    if anchors := [marker for k, a in enumerate(result.anchors) for marker in _anchor_markers(a, k, first, make)]:
        yield first, "/anchors", make.make("visualization_msgs/MarkerArray", markers=anchors)
    if result.closures:
        yield first, "/closures", make.make("visualization_msgs/MarkerArray", markers=_closure_markers(result, first, make))


def _anchor_markers(anchor: StoredAnchor, number: int, stamp: float, make: Messages) -> list[object]:
    """Return an anchor's point, name and ellipse of two sigma; nothing where it has no place."""
    if not np.isfinite(anchor.position).all():
        return []
    x, y = anchor.position.tolist()
    pose = make.pose(np.array([x, y, 0.0]))
    above = make.make("geometry_msgs/Pose", position=make.point(x, y, 0.4), orientation=make.turn(0.0))
    markers = [
        make.marker(stamp, "anchors", number, _SPHERE, _ANCHOR, pose=pose, scale=make.vector(0.2, 0.2, 0.2)),
        make.marker(stamp, "names", number, _TEXT, _ANCHOR, pose=above, scale=make.vector(0.0, 0.0, 0.3), text=anchor.id),
    ]
    if np.isfinite(anchor.covariance).all():
        values, vectors = np.linalg.eigh(anchor.covariance)
        width, length = 4.0 * np.sqrt(np.maximum(values, 1e-6))
        turned = make.pose(np.array([x, y, np.arctan2(vectors[1, 1], vectors[0, 1])]))
        faint = (*_ANCHOR[:3], 0.3)
        markers.append(
            make.marker(stamp, "two sigma", number, _CYLINDER, faint, pose=turned, scale=make.vector(length, width, 0.02))
        )
    return markers


def _closure_markers(result: StoredResult, stamp: float, make: Messages) -> list[object]:
    """Return accepted and rejected closures as lines."""
    markers = []
    for number, (name, wanted, colour) in enumerate((("accepted", True, _ACCEPTED), ("rejected", False, _REJECTED))):
        ends = [make.point(*place) for c in result.closures if c.accepted == wanted for place in c.places.tolist()]
        if ends:
            width = make.vector(0.03, 0.0)
            markers.append(make.marker(stamp, name, number, _LINES, colour, scale=width, points=ends))
    return markers
