"""A map for ROS: as a bag to be played or opened in Foxglove, and as the folder that nav2 takes (docs/formats.md)."""

import heapq
import json
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from .. import se2
from ..arrays import Floats
from ..errors import ConfigError
from ..grid.occupancy_grid import UNKNOWN, OccupancyGrid
from ..report import canvas
from ..report.canvas import share
from ..sensor_log import SensorLog
from . import rosbag_writer as ros
from .files import write_text
from .folders import refuse_foreign, replacing_folder, unmarked
from .map_server import write_map
from .rosbag_writer import TF, Stamped, recording_messages, transforms, write_messages
from .stored_result import StoredAnchor, StoredResult

_MOST_POSES = 10_000
"""Of a path; more are thinned out evenly."""
_LINES, _SPHERE, _CYLINDER, _TEXT = 5, 2, 3, 9
"""Types of visualization_msgs/Marker."""
_ANCHOR, _ACCEPTED, _REJECTED = share(canvas.ANCHOR), share(canvas.ACCEPTED), share(canvas.REJECTED, 0.5)


def write_result_bag(
    path: str | os.PathLike[str], result: StoredResult, logs: Sequence[SensorLog] = (), *, storage: str = "mcap"
) -> None:
    """Write a map as a ROS 2 bag; see `write_bag` for path and storage.

    Topics: /map, /path (and /path_2 ... of further recordings), /anchors and /closures (markers), all latched; /pose with
    the covariance of every keyframe; /tf. With the recordings it holds their messages too, and map -> odom is what takes
    each reading of the wheels to its corrected place; without, odom lies on map and base_link moves in it.

    Parameters
    ----------
    logs : its recordings in their order, or none; frames and topics of the second begin with ``recording_2/``.

    Raises
    ------
    ConfigError : there are recordings, but not as many as the map was made of, or one of another time.
    """
    _check(result, logs)
    trajectories = tuple((_from_zero(stamps), poses) for stamps, poses in result.trajectories)
    result = replace(result, trajectories=trajectories, keyframe_stamps=_from_zero(result.keyframe_stamps))
    write_messages(path, _messages(result, logs), storage=storage)


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


def _messages(result: StoredResult, logs: Sequence[SensorLog]) -> Iterator[Stamped]:
    first = min(float(stamps[0]) for stamps, _ in result.trajectories)
    yield from _once(result, first)
    moving = [_poses(result)]
    for number, (stamps, poses) in enumerate(result.trajectories, 1):
        prefix = "" if number == 1 else f"recording_{number}/"
        if logs:
            log = logs[number - 1]
            # T_map_odom = T_map_base T_odom_base^-1 at every reading of the wheels.
            stamps = log.odometry.stamps
            poses = se2.compose(result.pose_at(number, stamps), se2.inverse(log.odometry.poses))
            moving += [recording_messages(log, prefix=prefix), transforms(ros.MAP, prefix + ros.ODOM, stamps, poses)]
        else:
            yield first, "/tf_static", TF, ros.tf(first, ros.MAP, prefix + ros.ODOM, np.zeros(3))
            moving.append(transforms(prefix + ros.ODOM, prefix + ros.BASE, stamps, poses))
    yield from heapq.merge(*moving, key=lambda message: message[0])


def _poses(result: StoredResult) -> Iterator[Stamped]:
    order = np.argsort(result.keyframe_stamps, kind="stable")
    for k in order.tolist():
        stamp, number = float(result.keyframe_stamps[k]), int(result.keyframe_recordings[k])
        pose = ros.pose_with_covariance(stamp, result.pose_at(number, np.array(stamp)), result.keyframe_covariances[k])
        topic = "/pose" if number == 1 else f"/recording_{number}/pose"
        yield stamp, topic, "geometry_msgs/msg/PoseWithCovarianceStamped", pose


def _once(result: StoredResult, first: float) -> Iterator[Stamped]:
    """Yield what does not change: map, paths and markers."""
    if result.grid is not None:
        yield first, "/map", "nav_msgs/msg/OccupancyGrid", ros.occupancy(first, result.grid)
    for number, (stamps, poses) in enumerate(result.trajectories, 1):
        step = -(-len(stamps) // _MOST_POSES)
        topic = "/path" if number == 1 else f"/path_{number}"
        yield first, topic, "nav_msgs/msg/Path", ros.path(stamps[::step], poses[::step])
    anchors = [marker for k, a in enumerate(result.anchors) for marker in _anchor_markers(a, k, first)]
    for topic, markers in (("/anchors", anchors), ("/closures", _closure_markers(result, first))):
        if markers:
            yield first, topic, "visualization_msgs/msg/MarkerArray", {"markers": markers}


def _anchor_markers(anchor: StoredAnchor, number: int, stamp: float) -> list[ros.Fields]:
    """Return an anchor's point, name and ellipse of two sigma; nothing where it has no place."""
    if not np.isfinite(anchor.position).all():
        return []
    x, y = anchor.position.tolist()
    above, size = {"position": ros.xyz(x, y, 0.4), "orientation": ros.turn(0.0)}, ros.xyz(0.0, 0.0, 0.3)
    markers = [
        ros.marker(
            stamp, "anchors", number, _SPHERE, _ANCHOR, pose=ros.pose(np.array([x, y, 0.0])), scale=ros.xyz(0.2, 0.2, 0.2)
        ),
        ros.marker(stamp, "names", number, _TEXT, _ANCHOR, pose=above, scale=size, text=anchor.id),
    ]
    if np.isfinite(anchor.covariance).all():
        values, vectors = np.linalg.eigh(anchor.covariance)
        width, length = 4.0 * np.sqrt(np.maximum(values, 1e-6))
        turned = ros.pose(np.array([x, y, np.arctan2(vectors[1, 1], vectors[0, 1])]))
        size, faint = ros.xyz(length, width, 0.02), (*_ANCHOR[:3], 0.3)
        markers.append(ros.marker(stamp, "two sigma", number, _CYLINDER, faint, pose=turned, scale=size))
    return markers


def _closure_markers(result: StoredResult, stamp: float) -> list[ros.Fields]:
    """Return accepted and rejected closures as lines."""
    markers = []
    for number, (name, wanted, colour) in enumerate((("accepted", True, _ACCEPTED), ("rejected", False, _REJECTED))):
        ends = [ros.xyz(*place) for c in result.closures if c.accepted == wanted for place in c.places.tolist()]
        if ends:
            markers.append(ros.marker(stamp, name, number, _LINES, colour, scale=ros.xyz(0.03, 0.0), points=ends))
    return markers


_GRIDS = tuple(f"{name}.{ending}" for name in ("map", "keepout_mask") for ending in ("pgm", "yaml"))
FILES = (*_GRIDS, "nav2_params.yaml", "initial_pose.yaml", "anchors.yaml")
_SURE = 4.0
"""Log-odds of a cell of the mask: beyond the thresholds of occupied and free space."""

_PARAMS = """\
# Written by uwblite convert: parts of nav2's parameters that a map decides. Merge them into those of your robot, and start
# nav2 in this folder or put its path before the names of the two yaml files. AMCL is not started: map -> odom comes from
# a localisation of its own. The servers of the mask need a lifecycle manager as in lifecycle_manager_map below. Topics of the
# mask begin with /, because costmaps have namespaces of their own; of several robots each needs its name before them. The
# global costmap inflates after the mask, so that no part of the robot gets into unknown space.
map_server:
  ros__parameters:
    yaml_filename: map.yaml
    topic_name: map
    frame_id: map
filter_mask_server:
  ros__parameters:
    yaml_filename: keepout_mask.yaml
    topic_name: /keepout_filter_mask
    frame_id: map
costmap_filter_info_server:
  ros__parameters:
    type: 0
    filter_info_topic: /costmap_filter_info
    mask_topic: /keepout_filter_mask
    base: 0.0
    multiplier: 1.0
lifecycle_manager_map:
  ros__parameters:
    autostart: true
    node_names: [map_server, filter_mask_server, costmap_filter_info_server]
global_costmap:
  global_costmap:
    ros__parameters:
      global_frame: map
      resolution: {resolution:.9g}
      track_unknown_space: true
      plugins: [static_layer]
      filters: [keepout_filter, inflation_layer]
      static_layer:
        plugin: nav2_costmap_2d::StaticLayer
        map_subscribe_transient_local: true
      inflation_layer:
        plugin: nav2_costmap_2d::InflationLayer
      keepout_filter:
        plugin: nav2_costmap_2d::KeepoutFilter
        enabled: true
        filter_info_topic: /costmap_filter_info
local_costmap:
  local_costmap:
    ros__parameters:
      filters: [keepout_filter]
      keepout_filter:
        plugin: nav2_costmap_2d::KeepoutFilter
        enabled: true
        filter_info_topic: /costmap_filter_info
"""


def write_nav2_bundle(folder: str | os.PathLike[str], result: StoredResult) -> tuple[str, ...]:
    """Write the bundle, all of it or nothing, and return the names of its files.

    Parameters
    ----------
    folder : made where it is missing; files of an earlier bundle are replaced, others stay.

    Raises
    ------
    ConfigError : the result has no grid, or the folder holds such files that uwblite has not written.
    OSError : the disk is full or may not be written; the folder is as it was.
    """
    if result.grid is None:
        raise ConfigError(f"{result.folder} has no map.yaml: nav2 needs a map")
    refuse_foreign(unmarked(Path(folder), FILES, "nav2_params.yaml", _PARAMS.split(":")[0]))
    with replacing_folder(folder, FILES.__contains__) as place:
        write_map(place, result.grid)
        write_map(place, keepout_mask(result.grid), name="keepout_mask")
        write_text(place / "nav2_params.yaml", _PARAMS.format(resolution=result.grid.geometry.resolution))
        write_text(place / "initial_pose.yaml", _initial_pose(result))
        write_text(place / "anchors.yaml", _anchors(result))
    return FILES


def keepout_mask(grid: OccupancyGrid) -> OccupancyGrid:
    """Return the mask: unknown cells are occupied, all others are free."""
    return replace(grid, log_odds=np.where(grid.states() == UNKNOWN, _SURE, -_SURE).astype(np.float32))


def _initial_pose(result: StoredResult) -> str:
    """Return the last pose of the last recording, and the covariance of its last keyframe."""
    x, y, theta = result.trajectories[-1][1][-1].tolist()
    covariance = np.zeros((6, 6))
    if len(result.keyframe_covariances):
        covariance[np.ix_((0, 1, 5), (0, 1, 5))] = result.keyframe_covariances[-1]
    return (
        '# ros2 topic pub --once /initialpose geometry_msgs/msg/PoseWithCovarianceStamped "$(cat initial_pose.yaml)"\n'
        "header:\n  frame_id: map\npose:\n  pose:\n"
        f"    position: {{x: {_number(x)}, y: {_number(y)}, z: 0.0}}\n"
        f"    orientation: {{x: 0.0, y: 0.0, z: {_number(math.sin(theta / 2))}, w: {_number(math.cos(theta / 2))}}}\n"
        f"  covariance: {_list(covariance.ravel())}\n"
    )


def _anchors(result: StoredResult) -> str:
    entries = [
        f"  - id: {json.dumps(a.id)}\n    status: {json.dumps(a.status)}\n"
        f"    position: {_list(a.position)}\n    covariance: {_list(a.covariance.ravel())}\n"
        for a in result.anchors
    ]
    return "frame_id: map\nanchors:" + ("\n" + "".join(entries) if entries else " []\n")


def _list(values: Floats) -> str:
    return "[" + ", ".join(map(_number, values.tolist())) + "]"


def _number(value: float) -> str:
    """Return a number that every reader of YAML takes for one with a decimal point."""
    return f"{value + 0.0:.9f}" if math.isfinite(value) else ".nan"
