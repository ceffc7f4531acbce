"""Recordings as ROS 2 bags, with the package `rosbags` (the extra ``uwblite[bag]``): for RViz, Foxglove, slam_toolbox."""

import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np

from ..arrays import Floats
from ..errors import ConfigError, FormatError, UwbliteError
from ..sensor_log import SensorLog
from . import ros_messages as ros
from .files import shortened
from .optional_packages import missing_package

_FORMAT: Final = 8
"""Version of rosbag2's metadata. From 9 on QoS policies are words, which ROS 2 Humble refuses ("bad conversion"); later
releases read all earlier versions (ros2/rosbag2#1895)."""

_LAST_STAMP: Final = 2.0**31
"""s; ROS 2 counts them in 32 bits."""

Stamped = tuple[float, str, str, ros.Fields]
"""Time of recording, s; topic; type, such as nav_msgs/msg/Path; fields of the message."""

LATCHED = ("/tf_static", "/map", "/anchors", "/closures", "/path")
"""Topics whose last message a late subscriber gets too (transient local), and those that begin so, as /path_2."""


def write_bag(path: str | os.PathLike[str], log: SensorLog, *, storage: str = "mcap") -> None:
    """Write a recording as a ROS 2 bag: a folder, or one file where the name ends in ``.mcap``.

    Topics: /odom (nav_msgs/Odometry), /imu (sensor_msgs/Imu: a gyro's heading), /tf with odom -> base_link, /scan
    (sensor_msgs/LaserScan), /uwb/anchor_ID/range (sensor_msgs/Range with the anchor's id as frame_id) and /tf_static with
    the mounting of laser and tag. The QoS profiles under which `ros2 bag play` offers them are in it: reliable, and
    transient local for what is sent once.

    Parameters
    ----------
    path : file or folder to make; a folder must not exist.
    storage : 'mcap' or 'sqlite3'.

    Raises
    ------
    ConfigError : the package rosbags is not installed, or the folder exists.
    """
    write_messages(path, recording_messages(log), storage=storage)


def write_messages(path: str | os.PathLike[str], messages: Iterable[Stamped], *, storage: str = "mcap") -> None:
    """Write messages as a ROS 2 bag, whole or not at all; see `write_bag`.

    Parameters
    ----------
    storage : 'mcap' or 'sqlite3'.
    """
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
                writer.write(
                    connections[topic], ros.nanoseconds(stamp), store.serialize_cdr(ros.made(store, kind, fields), kind)
                )
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
    yield first, "/tf_static", TF, ros.mounting(first, log.mounting, prefix)
    stamps, poses = log.odometry.stamps, log.odometry.poses

    def tf(k: int) -> ros.Fields:
        return ros.tf(float(stamps[k]), prefix + ros.ODOM, prefix + ros.BASE, poses[k])

    def topic(name: str) -> Callable[[int], str]:
        return lambda _: f"/{prefix}{name}"

    sources: list[tuple[Floats, Callable[[int], str], str, Callable[[int], ros.Fields]]] = [
        (stamps, topic("odom"), "nav_msgs/msg/Odometry", lambda k: ros.odometry(log, k, prefix)),
        (stamps, lambda _: "/tf", TF, tf),
    ]
    if log.gyro is not None:
        sources.append((log.gyro.stamps, topic("imu"), "sensor_msgs/msg/Imu", lambda k: ros.gyro(log, k, prefix)))
    if (ranges := log.ranges) is not None:
        ranges.require_one_tag("a bag")
        names = _topic_names(ranges.anchor_ids, f"/{prefix}")
        row = (lambda k: names[ranges.anchor[k]]), "sensor_msgs/msg/Range", lambda k: ros.range_to_anchor(log, k)
        sources.append((ranges.stamps, *row))
    if log.scans is not None:
        sources.append((log.scans.stamps, topic("scan"), "sensor_msgs/msg/LaserScan", lambda k: ros.scan(log, k, prefix)))
    times = np.concatenate([s for s, *_ in sources])
    which = np.repeat(np.arange(len(sources)), [len(s) for s, *_ in sources])
    index = np.concatenate([np.arange(len(s)) for s, *_ in sources])
    for n in np.argsort(times, kind="stable").tolist():
        (_, named, kind, fields), k = sources[which[n]], int(index[n])
        yield float(times[n]), named(k), kind, fields(k)


TF = "tf2_msgs/msg/TFMessage"


def _topic_names(ids: tuple[str, ...], prefix: str) -> list[str]:
    """Return a valid, distinct topic for each anchor."""
    names = [f"{prefix}uwb/anchor_{re.sub('[^A-Za-z0-9_]', '_', name)}/range" for name in ids]
    return [n if names.count(n) == 1 else n.replace("/range", f"_{k}/range") for k, n in enumerate(names)]
