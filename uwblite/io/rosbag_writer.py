"""Recordings as ROS 2 bags, with the package `rosbags` (the extra ``uwblite[bag]``): for RViz, Foxglove, slam_toolbox.

Messages are nested dicts of their fields; those that are not given are zero or empty.
"""

import heapq
import os
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np

from ..arrays import Floats
from ..errors import ConfigError, FormatError, UwbliteError
from ..grid.occupancy_grid import OccupancyGrid
from ..sensor_log import Gyro, LaserScans, Odometry, SensorLog, SensorMounting, UwbRanges
from .files import shortened
from .optional_packages import missing_package

_FORMAT: Final = 8
"""Version of rosbag2's metadata. From 9 on QoS policies are words, which ROS 2 Humble refuses ("bad conversion"); later
releases read all earlier versions (ros2/rosbag2#1895)."""

_LAST_STAMP: Final = 2.0**31
"""s; ROS 2 counts them in 32 bits."""

Fields = dict[str, Any]
Stamped = tuple[float, str, str, Fields]
"""Time of recording, s; topic; type, such as nav_msgs/msg/Path; fields of the message."""
BASE, ODOM, MAP, LASER, TAG = "base_link", "odom", "map", "laser", "uwb_tag"
"""Frames, as REP-105 names them."""
TF = "tf2_msgs/msg/TFMessage"

LATCHED = ("/tf_static", "/map", "/anchors", "/closures", "/path")
"""Topics whose last message a late subscriber gets too (transient local), and those that begin so, as /path_2."""


def write_bag(path: str | os.PathLike[str], log: SensorLog, *, storage: str = "mcap") -> None:
    """Write a recording as a ROS 2 bag: a folder, which must not exist, or one file where the name ends in ``.mcap``.

    Topics: /odom, /imu (a gyro's heading), /tf with odom -> base_link, /scan, /uwb/anchor_ID/range (sensor_msgs/Range with the
    anchor's id as frame_id) and /tf_static with the mounting of laser and tag. The QoS profiles under which `ros2 bag play`
    offers them are in it: reliable, and transient local for what is sent once.

    Parameters
    ----------
    storage : 'mcap' or 'sqlite3'.

    Raises
    ------
    ConfigError : the package rosbags is not installed, or the folder exists.
    """
    write_messages(path, recording_messages(log), storage=storage)


def write_messages(path: str | os.PathLike[str], messages: Iterable[Stamped], *, storage: str) -> None:
    """Write messages as a ROS 2 bag, whole or not at all; see `write_bag`."""
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise missing_package("rosbags", "writing bags") from None
    target = Path(path)
    single = storage == "mcap" and target.suffix == ".mcap"
    if target.is_dir() or (target.exists() and not single):
        raise ConfigError(f"{target} exists; choose another name or remove it")
    store = get_typestore(Stores.ROS2_HUMBLE)
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    try:
        waiting = Path(tempfile.mkdtemp(prefix=f".{shortened(target.name)}.partial-", dir=target.absolute().parent))
    except OSError as error:
        error.filename = os.fspath(target)  # nobody asked for the folder that waits
        raise
    try:
        with _errors_of_ours(target), Writer(waiting / "bag", version=_FORMAT, storage_plugin=plugin) as writer:
            connections: dict[str, Any] = {}
            for stamp, topic, kind, fields in messages:
                if not 0.0 <= stamp < _LAST_STAMP:
                    problem = f"a stamp of {stamp:.0f} s has no place in a ROS message, which counts seconds from 0 to 2^31"
                    raise FormatError(f"{problem}; in which unit, and since when, does the recording count?", str(target))
                if topic not in connections:
                    offered = [_profile(topic)]
                    connections[topic] = writer.add_connection(topic, kind, typestore=store, offered_qos_profiles=offered)
                content = store.serialize_cdr(_made(store, kind, fields), kind)
                writer.write(connections[topic], _nanoseconds(stamp), content)
        os.replace(next((waiting / "bag").glob("*.mcap")) if single else waiting / "bag", target)
    finally:
        shutil.rmtree(waiting, ignore_errors=True)


@contextmanager
def _errors_of_ours(target: Path) -> Iterator[None]:
    """Turn what rosbags and its databases say of a full disk or of numbers too large into one line."""
    try:
        yield
    except (UwbliteError, OSError):
        raise
    except Exception as error:
        detail = " ".join(str(error).split())[:200]
        raise FormatError(f"could not be written as a ROS bag: {type(error).__name__}: {detail}", str(target)) from None


def _profile(topic: str) -> Any:
    """Return the QoS under which a topic is offered again."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    latched = re.sub(r"_\d+$", "", topic) in LATCHED
    forever = QosTime(0, 0)
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=1 if latched else 10,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        deadline=forever,
        lifespan=forever,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=forever,
        avoid_ros_namespace_conventions=False,
    )


def recording_messages(log: SensorLog, *, prefix: str = "") -> Iterator[Stamped]:
    """Yield a recording's messages in time order; the static transforms come first.

    Parameters
    ----------
    prefix : of frames and topics, such as ``recording_2/``, where several recordings share a bag.
    """
    sensors = (log.odometry, log.gyro, log.ranges, log.scans)
    first = min(float(s.stamps[0]) for s in sensors if s is not None and len(s.stamps))
    yield first, "/tf_static", TF, _mounting(first, log.mounting, prefix)
    parts = [_odometry(log.odometry, prefix), transforms(prefix + ODOM, prefix + BASE, log.odometry.stamps, log.odometry.poses)]
    parts += [_headings(log.gyro, prefix)] if log.gyro is not None else []
    parts += [_ranges(log.ranges, prefix)] if log.ranges is not None else []
    parts += [_scans(log.scans, prefix)] if log.scans is not None else []
    yield from heapq.merge(*parts, key=lambda message: message[0])


def _odometry(odometry: Odometry, prefix: str) -> Iterator[Stamped]:
    """Yield the readings of the wheels; covariances are zero, that is not known."""
    for stamp, place in zip(odometry.stamps.tolist(), odometry.poses, strict=True):
        fields = {"header": header(stamp, prefix + ODOM), "child_frame_id": prefix + BASE, "pose": {"pose": pose(place)}}
        yield stamp, f"/{prefix}odom", "nav_msgs/msg/Odometry", fields


def _headings(gyro: Gyro, prefix: str) -> Iterator[Stamped]:
    """Yield the headings of a gyro; rate and acceleration are marked as not there (-1)."""
    marks = {f"{name}_covariance": np.array([-1.0, *[0.0] * 8]) for name in ("angular_velocity", "linear_acceleration")}
    for stamp, heading in zip(gyro.stamps.tolist(), gyro.heading.tolist(), strict=True):
        fields = {"header": header(stamp, prefix + BASE), "orientation": turn(heading)} | marks
        yield stamp, f"/{prefix}imu", "sensor_msgs/msg/Imu", fields


def _ranges(ranges: UwbRanges, prefix: str) -> Iterator[Stamped]:
    """Yield ranges with the anchor's id as their frame, each anchor's on a topic of its own."""
    ranges.require_one_tag("a bag")
    names = [f"/{prefix}uwb/anchor_{re.sub('[^A-Za-z0-9_]', '_', name)}/range" for name in ranges.anchor_ids]
    names = [n if names.count(n) == 1 else n.replace("/range", f"_{k}/range") for k, n in enumerate(names)]
    for stamp, anchor, metres in zip(ranges.stamps.tolist(), ranges.anchor.tolist(), ranges.ranges.tolist(), strict=True):
        head = header(stamp, ranges.anchor_ids[anchor])
        fields = {"header": head, "field_of_view": 6.2832, "max_range": 200.0, "range": metres}
        yield stamp, names[anchor], "sensor_msgs/msg/Range", fields


def _scans(scans: LaserScans, prefix: str) -> Iterator[Stamped]:
    same = ("angle_min", "angle_increment", "time_increment", "range_min", "range_max")
    last = scans.angle_min + scans.angle_increment * (scans.ranges.shape[1] - 1)
    geometry = {"angle_max": last} | {name: getattr(scans, name) for name in same}
    for stamp, readings in zip(scans.stamps.tolist(), scans.ranges, strict=True):
        fields = {"header": header(stamp, prefix + LASER)} | geometry | {"ranges": readings.astype(np.float32)}
        yield stamp, f"/{prefix}scan", "sensor_msgs/msg/LaserScan", fields


def transforms(parent: str, child: str, stamps: Floats, poses: Floats) -> Iterator[Stamped]:
    """Yield planar transforms T_parent_child (n, 3) at stamps (n,), s."""
    for stamp, place in zip(stamps.tolist(), poses, strict=True):
        yield stamp, "/tf", TF, tf(stamp, parent, child, place)


def _made(store: Any, kind: str, values: Mapping[str, Any]) -> Any:
    """Return a message of a type store; ``kind`` is such as ``nav_msgs/msg/Path``."""
    fields = store.fielddefs[kind][1]
    return store.types[kind](**{name: _value(store, how, values.get(name)) for name, how in fields})


def _value(store: Any, how: Any, value: Any) -> Any:
    node, detail = how
    if node.name == "BASE":
        return value if value is not None else "" if detail[0] == "string" else False if detail[0] == "bool" else 0
    if node.name == "NAME":
        return _made(store, detail, value or {})
    (inner, name), length = detail
    if inner.name == "NAME":
        return [_made(store, name, each) for each in value or ()]
    return value if value is not None else [] if name[0] == "string" else np.zeros(length, dtype=name[0])


def _nanoseconds(stamp: float) -> int:
    """Return a time as ROS counts it."""
    return round(stamp * 1e9)


def header(stamp: float, frame: str) -> Fields:
    """Return a std_msgs/Header."""
    seconds, rest = divmod(_nanoseconds(stamp), 1_000_000_000)
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


def _transform(stamp: float, parent: str, child: str, place: Sequence[float], rotation: Fields) -> Fields:
    """Return a geometry_msgs/TransformStamped."""
    moved = {"translation": xyz(*place), "rotation": rotation}
    return {"header": header(stamp, parent), "child_frame_id": child, "transform": moved}


def tf(stamp: float, parent: str, child: str, planar: Floats) -> Fields:
    """Return a tf2_msgs/TFMessage with one planar transform T_parent_child."""
    x, y, theta = planar.tolist()
    return {"transforms": [_transform(stamp, parent, child, (x, y, 0.0), turn(theta))]}


def _mounting(stamp: float, of: SensorMounting, prefix: str = "") -> Fields:
    """Return the mounting of laser and tag on the base, as a tf2_msgs/TFMessage."""
    x, y, theta = of.T_base_laser.tolist()
    laser = _transform(stamp, prefix + BASE, prefix + LASER, (x, y, 0.0), turn(theta, of.laser_flipped))
    return {"transforms": [laser, _transform(stamp, prefix + BASE, prefix + TAG, of.tag_position.tolist(), turn(0.0))]}


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
