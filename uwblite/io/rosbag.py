"""ROS bags to recordings, with the package `rosbags` (the extra ``uwblite[bag]``); no ROS is needed.

Odometry comes from nav_msgs/Odometry, scans from sensor_msgs/LaserScan, headings from sensor_msgs/Imu, ranges by a mapping (see
uwb_mapping), mountings from tf. Times are those of the headers.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from ..errors import FormatError
from ..sensor_log import LogNotes, Odometry, SensorLog, SensorMounting
from .bag_motion import BagClock, Frames, MovingFrames, OdometryReadings, no_odometry, planar
from .bag_reading import open_bag
from .bag_sensors import ImuReadings, RangeReadings, ScanReadings
from .bag_topics import GUESSED, ODOMETRY, BagTopic, BagTopics, TopicPlan, is_truth, plan_topics, unread_warning
from .files import sha256_of
from .uwb_mapping import UwbMapping, readings_of, short_type

_SAMPLES = 20
"""Messages of a topic that are examined to learn how they are made."""


def plan_bag(
    path: str | os.PathLike[str], topics: BagTopics = GUESSED, mappings: tuple[UwbMapping, ...] = ()
) -> tuple[tuple[BagTopic, ...], TopicPlan]:
    """Return the topics of a bag and what `read_bag` would read of them."""
    with open_bag(path) as bag:
        return bag.topics(), plan_topics(bag.topics(), partial(bag.samples, most=_SAMPLES), topics, mappings)


def read_bag(path: str | os.PathLike[str], topics: BagTopics = GUESSED, mappings: tuple[UwbMapping, ...] = ()) -> SensorLog:
    """Read a bag (see open_bag); of one whose recording was not closed, what is complete.

    Parameters
    ----------
    mappings : how ranges stand in messages; the known ones are tried after these.

    Raises
    ------
    FormatError : the bag cannot be read, or has no odometry.
    ConfigError : a topic or field that was asked for is not there.
    """
    with open_bag(path) as bag:
        held = bag.topics()
        plan = plan_topics(held, partial(bag.samples, most=_SAMPLES), topics, mappings)
        collector = Collector(plan, topics.base_frame)
        wanted = {plan.odometry, plan.scan, plan.imu, *plan.uwb, *plan.tf} - {""}
        for topic, recorded, message in bag.messages(wanted):
            collector.take(topic, recorded / 1e9, message)
        if topics.base_frame:
            collector.frames.check(topics.base_frame)
        return collector.log(os.fspath(path), sha256_of(path), held, bag.notes)


@dataclass(slots=True)
class Collector:
    """Gathers the messages of the chosen topics."""

    plan: TopicPlan
    base_frame: str = ""
    clock: BagClock = field(default_factory=BagClock)
    frames: Frames = field(default_factory=Frames)
    moving: MovingFrames = field(default_factory=MovingFrames)
    odometry: OdometryReadings = field(default_factory=OdometryReadings)
    ranges: RangeReadings = field(default_factory=RangeReadings)
    scans: ScanReadings = field(default_factory=ScanReadings)
    imu: ImuReadings = field(default_factory=ImuReadings)

    def take(self, topic: str, recorded: float, message: Any) -> None:
        """Take a message that was recorded at a time, s."""
        if topic in self.plan.tf:
            self.frames.add(message.transforms)
            if self._by_transforms:
                self.moving.take(self.clock, recorded, message.transforms)
        elif topic == self.plan.odometry:
            pose = message.pose.pose
            self.base_frame = self.base_frame or message.child_frame_id
            stamp = self.clock.time("odometry", message.header.stamp, recorded)
            self.odometry.take(stamp, pose.position, pose.orientation)
        elif topic == self.plan.scan:
            self.scans.take(self.clock.time("scans", message.header.stamp, recorded), message)
        elif topic == self.plan.imu:
            self.imu.take(self.clock.time("IMU", message.header.stamp, recorded), message)
        else:
            mappings = self.plan.uwb[topic]
            holder: Any = message if mappings[0].stamp else None
            for name in mappings[0].stamp.split(".") if mappings[0].stamp else ():
                holder = getattr(holder, name, None)
            stamp = recorded if holder is None else self.clock.time("ranges", holder, recorded)
            kind = f"{mappings[0].topic} {mappings[0].type}"
            self.ranges.take(stamp, readings_of(message, topic, mappings), message, kind)

    @property
    def _by_transforms(self) -> bool:
        return not self.plan.odometry or self.plan.odometry in self.plan.tf

    def log(self, path: str, sha256: str, held: tuple[BagTopic, ...] = (), notes: Sequence[str] = ()) -> SensorLog:
        """Return the collected messages as a recording; held : topics of the bag. notes : what is odd about the bag itself."""
        warnings = [*notes, *self._warnings()]
        odometry = self._odometry(path, held, warnings)
        mounting, laser, places = SensorMounting(), None, np.zeros((1, 3))
        scans = self.scans.scans(self.clock.offset("scans"), warnings)
        ranges, tags = self.ranges.ranges(self.clock.offset("ranges"), warnings)
        if scans is not None and (laser := self.frames.pose(self.base_frame, self.scans.frame)) is None:
            warnings.append(
                f"no transform from {self.base_frame} to {self.scans.frame}: the laser is taken to sit in the middle of"
                " the robot, looking ahead; give `mounting.T_base_laser` where it does not"
            )
        if ranges is not None:
            places = self.ranges.places(tags, self.frames, self.base_frame, warnings)
        pose, flipped = (mounting.T_base_laser, False) if laser is None else planar(laser)
        mounting = SensorMounting(pose, flipped, places[0], more_tags=places[1:])
        gyro = self.imu.gyro(self.frames, self.base_frame, warnings) if self.plan.imu else None
        if self.frames.invalid:
            names = ", ".join(sorted(self.frames.invalid)[:5])
            warnings.append(f"transforms without a rotation (a quaternion of zeros, or no number) were left out: {names}")
        warnings += self.clock.warnings()
        log_notes = LogNotes(source=path, sha256=sha256, warnings=tuple(warnings), unread=tuple(self.plan.unread))
        return SensorLog(odometry, ranges, scans, mounting, log_notes, gyro=gyro)

    def _odometry(self, path: str, held: tuple[BagTopic, ...], warnings: list[str]) -> Odometry:
        """Return the odometry; raise FormatError where there is none, or it has no headings."""
        where, cure = self.plan.odometry, "; where tf has a transform from odom to the base: `topics.odometry=/tf`"
        if self._by_transforms:
            best = self.moving.best(self.base_frame)
            if best is None:
                topics = [(t.name, short_type(t.type)) for t in held]
                truths = [t.name for t in held if t.type == ODOMETRY and is_truth(t.name)]
                raise FormatError(no_odometry(topics, truths, self.frames.steps), path)
            (parent, child), self.odometry = best
            self.base_frame, where, cure = self.base_frame or child, f"tf, {parent} -> {child}", ""
            reason = "no topic of nav_msgs/Odometry is there" if not self.plan.odometry else "as asked"
            others = [" -> ".join(pair) for pair in self.moving.pairs if pair != (parent, child)]
            more = f"; `topics.base_frame` takes another ({', '.join(others[:4])})" if others else ""
            warnings.append(f"the odometry is read from {where}: {reason}{more}")
        odometry = self.odometry.odometry(warnings)
        if odometry is None:
            why = warnings[-1] if len(self.odometry) else "there is no message"
            raise FormatError(f"no message on {where} can be used: {why}{cure}", path)
        return odometry

    def _warnings(self) -> list[str]:
        chosen = {name for text in self.plan.choices for name in self.plan.passed_over if name in text}
        rest = [name for name in self.plan.passed_over if name not in chosen]
        warnings = [*self.plan.choices, *([f"not used: {', '.join(rest)}"] if rest else [])]
        return [*warnings, *([unread_warning(self.plan)] if self.plan.unread else [])]
