"""ROS 2 messages as nested dicts of their fields, common to a bag of a recording and a bag of a map."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..arrays import Floats
from ..grid.occupancy_grid import OccupancyGrid
from ..sensor_log import SensorLog, SensorMounting

BASE, ODOM, MAP, LASER, TAG = "base_link", "odom", "map", "laser", "uwb_tag"
"""Frames, as REP-105 names them."""
Fields = dict[str, Any]
"""Fields of a message by name; those that are not given are zero or empty."""


def made(store: Any, kind: str, values: Mapping[str, Any]) -> Any:
    """Return a message of a type store; ``kind`` is such as ``nav_msgs/msg/Path``."""
    fields = store.fielddefs[kind][1]
    return store.types[kind](**{name: _value(store, how, values.get(name)) for name, how in fields})


def _value(store: Any, how: Any, value: Any) -> Any:
    node, detail = how
    if node.name == "BASE":
        return value if value is not None else "" if detail[0] == "string" else False if detail[0] == "bool" else 0
    if node.name == "NAME":
        return made(store, detail, value or {})
    (inner, name), length = detail
    if inner.name == "NAME":
        return [made(store, name, each) for each in value or ()]
    return value if value is not None else [] if name[0] == "string" else np.zeros(length, dtype=name[0])


def nanoseconds(stamp: float) -> int:
    """Return a time as ROS counts it."""
    return round(stamp * 1e9)


def header(stamp: float, frame: str) -> Fields:
    """Return a std_msgs/Header."""
    seconds, rest = divmod(nanoseconds(stamp), 1_000_000_000)
    return {"stamp": {"sec": seconds, "nanosec": rest}, "frame_id": frame}


def xyz(x: float, y: float, z: float = 0.0) -> Fields:
    """Return a geometry_msgs/Point or Vector3."""
    return {"x": float(x), "y": float(y), "z": float(z)}


def turn(theta: float, flipped: bool = False) -> Fields:
    """Return the quaternion of a turn about z, after half a turn about x where the sensor is upside down."""
    c, s = float(np.cos(theta / 2)), float(np.sin(theta / 2))
    return xyz(c, s) | {"w": 0.0} if flipped else xyz(0.0, 0.0, s) | {"w": c}


def pose(planar: Floats) -> Fields:
    """Return a geometry_msgs/Pose of x, y, theta."""
    x, y, theta = planar.tolist()
    return {"position": xyz(x, y), "orientation": turn(theta)}


def transform(stamp: float, parent: str, child: str, place: Sequence[float], rotation: Fields) -> Fields:
    """Return a geometry_msgs/TransformStamped."""
    moved = {"translation": xyz(*place), "rotation": rotation}
    return {"header": header(stamp, parent), "child_frame_id": child, "transform": moved}


def tf(stamp: float, parent: str, child: str, planar: Floats) -> Fields:
    """Return a tf2_msgs/TFMessage with one planar transform T_parent_child."""
    x, y, theta = planar.tolist()
    return {"transforms": [transform(stamp, parent, child, (x, y, 0.0), turn(theta))]}


def mounting(stamp: float, of: SensorMounting, prefix: str = "") -> Fields:
    """Return the mounting of laser and tag on the base, as a tf2_msgs/TFMessage."""
    x, y, theta = of.T_base_laser.tolist()
    laser = transform(stamp, prefix + BASE, prefix + LASER, (x, y, 0.0), turn(theta, of.laser_flipped))
    return {"transforms": [laser, transform(stamp, prefix + BASE, prefix + TAG, of.tag_position.tolist(), turn(0.0))]}


def odometry(log: SensorLog, k: int, prefix: str = "") -> Fields:
    """Return reading k of the wheels as nav_msgs/Odometry; covariances are zero, that is not known."""
    head = header(float(log.odometry.stamps[k]), prefix + ODOM)
    return {"header": head, "child_frame_id": prefix + BASE, "pose": {"pose": pose(log.odometry.poses[k])}}


def gyro(log: SensorLog, k: int, prefix: str = "") -> Fields:
    """Return heading k of the gyro as sensor_msgs/Imu; rate and acceleration are marked as not there (-1)."""
    assert log.gyro is not None
    absent, head = np.array([-1.0, *[0.0] * 8]), header(float(log.gyro.stamps[k]), prefix + BASE)
    marks = {f"{name}_covariance": absent for name in ("angular_velocity", "linear_acceleration")}
    return {"header": head, "orientation": turn(float(log.gyro.heading[k]))} | marks


def range_to_anchor(log: SensorLog, k: int) -> Fields:
    """Return range k as sensor_msgs/Range, with the anchor's id as its frame."""
    assert log.ranges is not None
    head = header(float(log.ranges.stamps[k]), log.ranges.anchor_ids[log.ranges.anchor[k]])
    return {"header": head, "field_of_view": 6.2832, "max_range": 200.0, "range": float(log.ranges.ranges[k])}


def scan(log: SensorLog, k: int, prefix: str = "") -> Fields:
    """Return scan k as sensor_msgs/LaserScan."""
    scans = log.scans
    assert scans is not None
    same = ("angle_min", "angle_increment", "time_increment", "range_min", "range_max")
    last = scans.angle_min + scans.angle_increment * (scans.ranges.shape[1] - 1)
    fields = {"header": header(float(scans.stamps[k]), prefix + LASER), "angle_max": last}
    return fields | {name: getattr(scans, name) for name in same} | {"ranges": scans.ranges[k].astype(np.float32)}


def path(stamps: Floats, poses: Floats) -> Fields:
    """Return a nav_msgs/Path in the map frame."""
    steps = [{"header": header(t, MAP), "pose": pose(each)} for t, each in zip(stamps.tolist(), poses, strict=True)]
    return {"header": header(float(stamps[0]), MAP), "poses": steps}


def occupancy(stamp: float, grid: OccupancyGrid) -> Fields:
    """Return a nav_msgs/OccupancyGrid."""
    g = grid.geometry
    info = {"resolution": g.resolution, "width": g.cols, "height": g.rows, "origin": pose(np.array([*g.origin, 0.0]))}
    return {"header": header(stamp, MAP), "info": info, "data": grid.states().astype(np.int8).reshape(-1)}


def pose_with_covariance(stamp: float, planar: Floats, covariance: Floats) -> Fields:
    """Return a geometry_msgs/PoseWithCovarianceStamped of a planar pose and its covariance (3, 3)."""
    full = np.zeros((6, 6))
    full[np.ix_((0, 1, 5), (0, 1, 5))] = covariance
    return {"header": header(stamp, MAP), "pose": {"pose": pose(planar), "covariance": full.reshape(-1)}}


def marker(stamp: float, group: str, number: int, kind: int, colour: Sequence[float], **values: Any) -> Fields:
    """Return a visualization_msgs/Marker in the map frame; colour is red, green, blue, alpha, 0..1."""
    named = dict(zip("rgba", map(float, colour), strict=True))
    fields = {"header": header(stamp, MAP), "ns": group, "id": number, "type": kind, "color": named}
    return fields | {"pose": pose(np.zeros(3))} | values
