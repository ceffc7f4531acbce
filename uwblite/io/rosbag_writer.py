"""Recordings as ROS 2 bags, with the package `rosbags` (the extra ``uwblite[bag]``): for RViz, Foxglove, slam_toolbox."""

import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ConfigError
from ..sensor_log import SensorLog, SensorMounting
from .optional_packages import missing_package


def write_bag(path: str | os.PathLike[str], log: SensorLog, *, storage: str = "mcap") -> None:
    """Write a recording as a ROS 2 bag (a folder).

    Topics: /odom (nav_msgs/Odometry), /scan (sensor_msgs/LaserScan), /uwb/anchor_ID/range (sensor_msgs/Range with the
    anchor's id as frame_id) and /tf_static with the mounting of laser and tag.

    Parameters
    ----------
    path : folder to make; it must not exist.
    log : the recording.
    storage : 'mcap' or 'sqlite3'.

    Raises
    ------
    ConfigError : the package rosbags is not installed, or the folder exists.
    """
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise missing_package("rosbags", "writing bags") from None
    target = Path(path)
    if target.exists():
        raise ConfigError(f"{target} exists; choose another name or remove it")
    store = get_typestore(Stores.ROS2_HUMBLE)
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    waiting = Path(tempfile.mkdtemp(prefix=f".{target.name}.partial-", dir=target.absolute().parent))
    try:
        with Writer(waiting / "bag", version=9, storage_plugin=plugin) as writer:
            connections: dict[str, Any] = {}
            for stamp, topic, message in _messages(log, store):
                kind = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=store)
                writer.write(connections[topic], _nanoseconds(stamp), store.serialize_cdr(message, kind))
        os.replace(waiting / "bag", target)
    finally:
        shutil.rmtree(waiting, ignore_errors=True)


def _nanoseconds(stamp: float) -> int:
    return round(stamp * 1e9)


def _messages(log: SensorLog, store: Any) -> Iterator[tuple[float, str, Any]]:
    """Yield (stamp, topic, message) in time order; the static transforms come first."""
    make = _Maker(store)
    first = float(log.odometry.stamps[0])
    yield first, "/tf_static", make.transforms(first, log.mounting)
    sources: list[tuple[Any, Callable[[int], tuple[str, Any]]]] = [
        (log.odometry.stamps, lambda k: ("/odom", make.odometry(log, k)))
    ]
    if log.ranges is not None:
        ranges = log.ranges
        names = _topic_names(ranges.anchor_ids)
        sources.append((ranges.stamps, lambda k: (names[ranges.anchor[k]], make.range(log, k))))
    if log.scans is not None:
        sources.append((log.scans.stamps, lambda k: ("/scan", make.scan(log, k))))
    stamps = np.concatenate([s for s, _ in sources])
    kind = np.repeat(np.arange(len(sources)), [len(s) for s, _ in sources])
    index = np.concatenate([np.arange(len(s)) for s, _ in sources])
    for k in np.argsort(stamps, kind="stable").tolist():
        topic, message = sources[kind[k]][1](int(index[k]))
        yield float(stamps[k]), topic, message


def _topic_names(ids: tuple[str, ...]) -> list[str]:
    """Return a valid, distinct topic for each anchor."""
    names = [f"/uwb/anchor_{re.sub('[^A-Za-z0-9_]', '_', name)}/range" for name in ids]
    return [n if names.count(n) == 1 else n.replace("/range", f"_{k}/range") for k, n in enumerate(names)]


class _Maker:
    """Makes ROS messages of one type store."""

    def __init__(self, store: Any) -> None:
        self.t = store.types

    def header(self, stamp: float, frame: str) -> Any:
        """Return a std_msgs/Header."""
        seconds, rest = divmod(_nanoseconds(stamp), 1_000_000_000)
        return self.t["std_msgs/msg/Header"](self.t["builtin_interfaces/msg/Time"](seconds, rest), frame)

    def turn(self, theta: float, flipped: bool = False) -> Any:
        """Return the quaternion of a turn about z, after half a turn about x where the sensor is upside down."""
        c, s = float(np.cos(theta / 2)), float(np.sin(theta / 2))
        return self.t["geometry_msgs/msg/Quaternion"](*((c, s, 0.0, 0.0) if flipped else (0.0, 0.0, s, c)))

    def transforms(self, stamp: float, mounting: SensorMounting) -> Any:
        """Return the mounting of laser and tag as a tf2_msgs/TFMessage."""
        x, y, theta = mounting.T_base_laser.tolist()
        poses = (
            ("laser", (x, y, 0.0), self.turn(theta, mounting.laser_flipped)),
            ("uwb_tag", tuple(mounting.tag_position.tolist()), self.turn(0.0)),
        )
        vector, transform = self.t["geometry_msgs/msg/Vector3"], self.t["geometry_msgs/msg/Transform"]
        stamped = self.t["geometry_msgs/msg/TransformStamped"]
        made = [stamped(self.header(stamp, "base_link"), name, transform(vector(*xyz), q)) for name, xyz, q in poses]
        return self.t["tf2_msgs/msg/TFMessage"](made)

    def odometry(self, log: SensorLog, k: int) -> Any:
        """Return a nav_msgs/Odometry."""
        t, (x, y, theta) = self.t, log.odometry.poses[k].tolist()
        pose = t["geometry_msgs/msg/Pose"](t["geometry_msgs/msg/Point"](x, y, 0.0), self.turn(theta))
        nothing = t["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
        return t["nav_msgs/msg/Odometry"](
            self.header(float(log.odometry.stamps[k]), "odom"),
            "base_link",
            t["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36)),
            t["geometry_msgs/msg/TwistWithCovariance"](t["geometry_msgs/msg/Twist"](nothing, nothing), np.zeros(36)),
        )

    def range(self, log: SensorLog, k: int) -> Any:
        """Return a sensor_msgs/Range."""
        assert log.ranges is not None
        anchor = log.ranges.anchor_ids[log.ranges.anchor[k]]
        header = self.header(float(log.ranges.stamps[k]), anchor)
        return self.t["sensor_msgs/msg/Range"](header, 0, 6.2832, 0.0, 200.0, float(log.ranges.ranges[k]))

    def scan(self, log: SensorLog, k: int) -> Any:
        """Return a sensor_msgs/LaserScan."""
        scans = log.scans
        assert scans is not None
        beams = scans.ranges.shape[1]
        return self.t["sensor_msgs/msg/LaserScan"](
            self.header(float(scans.stamps[k]), "laser"),
            scans.angle_min,
            scans.angle_min + scans.angle_increment * (beams - 1),
            scans.angle_increment,
            scans.time_increment,
            0.0,
            scans.range_min,
            scans.range_max,
            scans.ranges[k].astype(np.float32),
            np.zeros(0, dtype=np.float32),
        )
