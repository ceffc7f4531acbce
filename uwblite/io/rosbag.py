"""ROS bags to recordings and back, with the package `rosbags` (the extra ``uwblite[bag]``); no ROS is needed.

Reads ROS 1 bags and ROS 2 bags in sqlite3 or MCAP. Wheel odometry comes from nav_msgs/Odometry, scans from
sensor_msgs/LaserScan, headings from sensor_msgs/Imu, ranges by a mapping (see uwb_mapping), mountings from tf. Times are
those of the headers.
"""

import os
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError, UwbliteError
from ..sensor_log import LaserScans, LogNotes, Odometry, SensorLog, SensorMounting, UwbRanges, fault_of_id
from .bag_frames import Frames, planar
from .bag_imu import ImuReadings
from .bag_topics import GUESSED, ODOMETRY, BagTopic, BagTopics, TopicPlan, plan_topics, unread_warning
from .files import sha256_of
from .optional_packages import missing_package
from .scan_geometry import ScanGeometry, resampled, resampling_warning
from .uwb_mapping import UwbMapping, readings_of, short_type

_SAMPLES = 20
"""Messages of a topic that are examined to learn how they are made."""


def plan_bag(
    path: str | os.PathLike[str], topics: BagTopics = GUESSED, mappings: tuple[UwbMapping, ...] = ()
) -> tuple[tuple[BagTopic, ...], TopicPlan]:
    """Return the topics of a bag and what `read_bag` would read of them."""
    with _opened(path) as reader:
        return _topics(reader), plan_topics(_topics(reader), partial(_samples, reader), topics, mappings)


def _samples(reader: Any, name: str) -> list[Any]:
    """Return the first messages of a topic; none where their definition is missing."""
    chosen = [c for c in reader.connections if c.topic == name and c.msgtype in reader.typestore.fielddefs]
    first = islice(reader.messages(connections=chosen), _SAMPLES) if chosen else ()
    return [reader.deserialize(raw, connection.msgtype) for connection, _, raw in first]


def _topics(reader: Any) -> tuple[BagTopic, ...]:
    return tuple(BagTopic(name, info.msgtype or "?", info.msgcount) for name, info in sorted(reader.topics.items()))


def read_bag(path: str | os.PathLike[str], topics: BagTopics = GUESSED, mappings: tuple[UwbMapping, ...] = ()) -> SensorLog:
    """Read a bag.

    Parameters
    ----------
    path : a ``.bag`` file, a ROS 2 bag's folder, or a single ``.mcap`` or ``.db3`` file.
    mappings : how ranges stand in messages; the known ones are tried after these.

    Returns
    -------
    SensorLog in time order; stamps are seconds since the epoch, as in the headers.

    Raises
    ------
    FormatError : the bag cannot be read, or has no odometry.
    ConfigError : a topic or field that was asked for is not there.
    """
    with _opened(path) as reader:
        plan = plan_topics(_topics(reader), partial(_samples, reader), topics, mappings)
        found = _Collector(plan, topics.base_frame)
        wanted = {found.plan.odometry, found.plan.scan, found.plan.imu, *found.plan.uwb, *found.plan.tf}
        for connection, recorded, raw in reader.messages(connections=[c for c in reader.connections if c.topic in wanted]):
            found.take(connection.topic, recorded / 1e9, reader.deserialize(raw, connection.msgtype))
        if topics.base_frame:
            found.frames.check(topics.base_frame)
        return found.log(os.fspath(path), sha256_of(path))


@contextmanager
def _opened(path: str | os.PathLike[str]) -> Iterator[Any]:
    name = os.fspath(path)
    if not os.path.exists(name):
        raise FormatError("cannot be opened: no such file or folder", name)
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise missing_package("rosbags", "reading bags") from None
    try:
        # The store serves bags that do not carry the definitions of their messages.
        with AnyReader([Path(name)], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            yield reader
    except UwbliteError:
        raise
    except Exception as error:
        # rosbags, sqlite and the decompressors each have errors of their own for a damaged file, and a damaged length
        # asks for more memory than there is.
        detail = " ".join(str(error).split())[:200]
        raise FormatError(f"cannot be read as a ROS bag: {type(error).__name__}: {detail}", name) from None


@dataclass(slots=True)
class _Collector:
    """Gathers the messages of the chosen topics."""

    plan: TopicPlan
    base_frame: str = ""
    frames: Frames = field(default_factory=Frames)
    odometry: list[tuple[float, float, float, float]] = field(default_factory=list)
    ranges: list[tuple[float, str, float, float]] = field(default_factory=list)
    scans: list[tuple[float, NDArray[np.float32]]] = field(default_factory=list)
    imu: ImuReadings = field(default_factory=ImuReadings)
    layout: tuple[float, ...] = ()
    """angle_min, angle_increment, time_increment, range_min, range_max, beams of the first scan."""
    laser_frame: str = ""
    tag_frames: Counter[str] = field(default_factory=Counter)
    odd_scans: int = 0
    resized: int = 0
    """Scans that were resampled to the geometry of the first."""
    unstamped: int = 0
    late: list[float] = field(default_factory=list)

    def take(self, topic: str, recorded: float, message: Any) -> None:
        """Take a message that was recorded at a time, s."""
        if topic in self.plan.tf:
            self.frames.add(message.transforms)
        elif topic == self.plan.odometry:
            pose, turn = message.pose.pose, message.pose.pose.orientation
            yaw = np.arctan2(2 * (turn.w * turn.z + turn.x * turn.y), 1 - 2 * (turn.y**2 + turn.z**2))
            self.base_frame = self.base_frame or message.child_frame_id
            self.odometry.append((self._time(message.header.stamp, recorded), pose.position.x, pose.position.y, float(yaw)))
        elif topic == self.plan.scan:
            self._take_scan(recorded, message)
        elif topic == self.plan.imu:
            self.imu.take(self._time(message.header.stamp, recorded), message)
        else:
            mappings = self.plan.uwb[topic]
            stamp = recorded
            if mappings[0].stamp:
                holder: Any = message
                for name in mappings[0].stamp.split("."):
                    holder = getattr(holder, name, None)
                stamp = recorded if holder is None else self._time(holder, recorded)
            if hasattr(message, "header"):
                self.tag_frames[message.header.frame_id] += 1
            self.ranges += [(stamp, *reading) for reading in readings_of(message, topic, mappings)]

    def _time(self, stamp: Any, recorded: float) -> float:
        seconds = float(stamp.sec) + 1e-9 * float(stamp.nanosec)
        if seconds <= 0.0:
            self.unstamped += recorded != seconds  # a simulated clock begins at 0
            return recorded
        self.late.append(recorded - seconds)
        return seconds

    def _take_scan(self, recorded: float, message: Any) -> None:
        layout = (message.angle_min, message.angle_increment, message.time_increment, message.range_min, message.range_max)
        readings = _cleaned(np.array(message.ranges, dtype=np.float32), *layout[3:])
        if not len(readings):
            self.odd_scans += 1
            return
        if not self.layout:
            self.layout, self.laser_frame = (*layout, float(len(readings))), message.header.frame_id
        have = ScanGeometry(layout[0], layout[1], len(readings))
        want = ScanGeometry(self.layout[0], self.layout[1], int(self.layout[5]))
        turned = abs(layout[0] - want.angle_min) > 1e-3 or abs(layout[1] - want.angle_increment) > 1e-6
        if len(readings) != want.beams or turned:
            if not want.is_of_one_lidar_with(have):
                self.odd_scans += 1
                return
            self.resized += 1
            readings = resampled(readings[None], have, want)[0]
        self.scans.append((self._time(message.header.stamp, recorded), readings))

    def log(self, path: str, sha256: str) -> SensorLog:
        """Return the collected messages as a recording."""
        if not self.odometry:
            raise FormatError(f"the bag has no odometry ({short_type(ODOMETRY)}); name its topic with --odometry-topic", path)
        table = np.array(self.odometry)
        table = table[np.isfinite(table).all(axis=1)]
        table = table[np.argsort(table[:, 0], kind="stable")]
        warnings = list(self._warnings(len(self.odometry) - len(table)))
        mounting = self._mounting(warnings)
        gyro = self.imu.gyro(self.frames, self.base_frame, warnings) if self.plan.imu else None
        notes = LogNotes(source=path, sha256=sha256, warnings=tuple(warnings), unread=tuple(self.plan.unread))
        odometry = Odometry(table[:, 0].copy(), table[:, 1:].copy())
        return SensorLog(odometry, self._ranges(), self._scans(), mounting, notes, gyro=gyro)

    def _ranges(self) -> UwbRanges | None:
        faults = self._faults_of_ids()
        rows = [r for r in self.ranges if np.isfinite(r[0]) and np.isfinite(r[2]) and np.isfinite(r[3]) and r[1] not in faults]
        if not rows:
            return None
        ids = tuple(sorted({row[1] for row in rows}))
        place = {name: k for k, name in enumerate(ids)}
        stamps = np.array([row[0] for row in rows])
        order = np.argsort(stamps, kind="stable")
        anchor = np.array([place[row[1]] for row in rows], dtype=np.intp)
        ranges, quality = (np.array([row[k] for row in rows]) for k in (2, 3))
        return UwbRanges(stamps[order], anchor[order], ranges[order], quality[order], ids)

    def _faults_of_ids(self) -> dict[str, str]:
        """Return what is wrong with anchors' ids, of those with which something is."""
        return {name: fault for name in {row[1] for row in self.ranges} if (fault := fault_of_id(name))}

    def _scans(self) -> LaserScans | None:
        if not self.scans:
            return None
        angle_min, increment, time_increment, range_min, range_max, _ = map(float, self.layout)
        stamps = np.array([stamp for stamp, _ in self.scans])
        order = np.argsort(stamps, kind="stable")
        readings = np.stack([self.scans[k][1] for k in order])
        return LaserScans(stamps[order], readings, angle_min, increment, time_increment, range_min, range_max)

    def _mounting(self, warnings: list[str]) -> SensorMounting:
        T_base_laser, flipped, tag = np.zeros(3), False, np.zeros(3)
        if self.scans:
            pose = self.frames.pose(self.base_frame, self.laser_frame)
            if pose is None:
                warnings.append(
                    f"no transform from {self.base_frame} to {self.laser_frame}: the laser is taken to sit in the middle of"
                    " the robot, looking ahead; give --laser-pose X,Y,THETA where it does not"
                )
            else:
                T_base_laser, flipped = planar(pose)
        if self.ranges:
            # Messages name the tag's frame, or the anchor's; then the usual names are tried.
            names = [*(name for name, _ in self.tag_frames.most_common(1)), "uwb_tag", "uwb_link", "uwb", "tag"]
            known = (self.frames.pose(self.base_frame, name) for name in names if name)
            pose = next((p for p in known if p is not None), None)
            if pose is None:
                warnings.append(
                    "no transform to the UWB tag: it is taken to sit in the middle of the robot, on the floor; give --tag X,Y,Z"
                )
            else:
                tag = pose[:3, 3].copy()
        return SensorMounting(T_base_laser, flipped, tag)

    def _warnings(self, broken: int) -> Iterator[str]:
        if self.plan.passed_over:
            yield f"not used: {', '.join(self.plan.passed_over)}"
        if self.plan.unread:
            yield unread_warning(self.plan)
        if broken:
            yield f"{broken} odometry messages are not finite and were skipped"
        if faults := self._faults_of_ids():
            count = sum(row[1] in faults for row in self.ranges)
            yield f"{count} ranges were left out: the anchor's id {faults[min(faults)]}"
        if self.odd_scans:
            yield f"{self.odd_scans} scans of another geometry were skipped"
        if self.resized:
            yield resampling_warning(self.resized, len(self.scans), int(self.layout[5]))
        if self.unstamped:
            yield f"{self.unstamped} messages carry no time; the time of recording is used"
        if self.late and abs(delay := float(np.median(self.late))) > 5.0:
            yield f"headers and recording differ by {delay:.1f} s: the sensors' computers have other clocks"


def _cleaned(readings: NDArray[np.float32], range_min: float, range_max: float) -> NDArray[np.float32]:
    """Return readings with +inf for nothing seen and nan for too near and error, in the memory given.

    REP-117 distinguishes these; drivers older than it write 0 for no echo.
    """
    with np.errstate(invalid="ignore"):
        nothing = (readings == 0.0) | (readings >= range_max)
        readings[~(readings >= range_min)] = np.nan
    readings[nothing] = np.inf
    return readings
