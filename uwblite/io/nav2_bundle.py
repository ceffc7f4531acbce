"""A map as nav2 takes it: grid, keep-out mask, parameters, initial pose and anchors in one folder (docs/formats.md)."""

import json
import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..arrays import Floats
from ..errors import ConfigError
from ..grid.occupancy_grid import UNKNOWN, OccupancyGrid
from .files import write_text
from .folders import refuse_foreign, replacing_folder, unmarked
from .map_server import write_map
from .stored_result import StoredResult

FILES = (
    "map.pgm", "map.yaml", "keepout_mask.pgm", "keepout_mask.yaml", "nav2_params.yaml", "initial_pose.yaml", "anchors.yaml",
)  # fmt: skip
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
