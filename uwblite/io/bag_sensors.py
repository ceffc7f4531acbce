"""Scans, headings and ranges in a bag.

The heading turns about the vertical: that of gravity, else of the transforms, else the sensor's z axis (REP-145).
"""

from array import array
from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..arrays import Floats
from ..sensor_log import Gyro, LaserScans, UwbRanges, fault_of_id
from .bag_motion import Frames
from .readings import MOST_TAGS, ScanGeometry, clean, ranges_of, reach_of, resampled, resampling_warning
from .uwb_mapping import Reading


class ScanReadings:
    """Collects the messages of one topic of type sensor_msgs/LaserScan; their header fields are validated."""

    def __init__(self) -> None:
        self._scans: dict[str, list[tuple[float, NDArray[np.float32]]]] = {}
        self._header: dict[str, tuple[ScanGeometry, float, float, float]] = {}
        """Geometry, time_increment, range_min and range_max of the first scan of each frame."""
        self.odd, self.resized = Counter[str](), Counter[str]()
        self._noted = dict[str, list[Any]]()
        """How often something was noted, and its words the first time."""

    def take(self, stamp: float, message: Any) -> None:
        """Take a message."""
        frame, readings = message.header.frame_id.lstrip("/"), np.array(message.ranges, dtype=np.float32)
        have = self._geometry(message, len(readings))
        if have is None:
            self.odd[frame] += 1
            return
        want, _, range_min, range_max = self._header.setdefault(frame, (have, *_limits(message)))
        clean(readings[None], range_min, range_max, zero_is_nothing=True)
        first, step = have.angle_min - want.angle_min, have.angle_increment - want.angle_increment
        if have.beams != want.beams or abs(first) > 1e-3 or abs(step) > 1e-6:
            if not want.is_of_one_lidar_with(have):
                self.odd[frame] += 1
                return
            self.resized[frame] += 1
            readings = resampled(readings[None], have, want)[0]
        self._scans.setdefault(frame, []).append((stamp, readings))

    @property
    def frame(self) -> str:
        """The frame of most scans; '' without any."""
        return max(self._scans, key=lambda name: (len(self._scans[name]), name), default="")

    def scans(self, offset: float, warnings: list[str]) -> LaserScans | None:
        """Return the scans of the commonest frame, moved in time by an offset, s; None without any."""
        warnings += [text.format(count=count) for count, text in self._noted.values()]
        if self.odd.total():
            warnings.append(f"{self.odd.total()} scans of another geometry, or without readings, were skipped")
        if not self._scans:
            return None
        frame = self.frame
        if others := {name: len(rows) for name, rows in self._scans.items() if name != frame}:
            counts = ", ".join(f"{count} of {name or 'a frame without name'}" for name, count in sorted(others.items()))
            warnings.append(
                f"the scans' topic bears scans of several frames, as of two lidars: those of {frame} are used, others left out"
                f" ({counts}); give each lidar a topic of its own"
            )
        (geometry, sweep, range_min, range_max), rows = self._header[frame], self._scans[frame]
        if self.resized[frame]:
            warnings.append(resampling_warning(self.resized[frame], len(rows), geometry.beams))
        stamps = np.array([stamp for stamp, _ in rows]) + offset
        order = np.argsort(stamps, kind="stable")
        readings = np.stack([rows[k][1] for k in order])
        if range_max == np.inf:
            range_max = reach_of(readings, warnings)
        return LaserScans(stamps[order], readings, geometry.angle_min, geometry.angle_increment, sweep, range_min, range_max)

    def _geometry(self, message: Any, beams: int) -> ScanGeometry | None:
        """Return where the beams of a message point; None where it has none, or its fields do not tell."""
        first, last, step = (float(getattr(message, f"angle_{name}", np.nan)) for name in ("min", "max", "increment"))
        if not beams or not np.isfinite(first):
            return None
        spanned = (last - first) / max(beams - 1, 1)
        if np.isfinite(step) and step != 0.0 and abs(step) * (beams - 1) < _TURN:
            if np.isfinite(spanned) and abs((last - first) - step * (beams - 1)) > 2.0 * abs(step):
                text = "angle_min, angle_max and angle_increment contradict each other in {count} scans (the increment"
                text += f" {np.degrees(step):.3g} degrees, by the ends {np.degrees(spanned):.3g}): the increment counts"
                self._note("contradiction", text)
            return ScanGeometry(first, step, beams)
        if not np.isfinite(spanned) or spanned == 0.0 or abs(last - first) > _TURN:
            return None
        self._note("increment", "angle_increment is no angle in {count} scans: angle_min and angle_max give it")
        return ScanGeometry(first, spanned, beams)

    def _note(self, what: str, text: str) -> None:
        self._noted.setdefault(what, [0, text])[0] += 1


_TURN = 2.1 * np.pi
"""rad; more than a turn."""


def _limits(message: Any) -> tuple[float, float, float]:
    """Return time_increment, range_min and range_max, of the last inf where none is stated."""
    sweep, least, most = (float(getattr(message, name)) for name in ("time_increment", "range_min", "range_max"))
    sweep, least = (value if np.isfinite(value) and value >= 0.0 else 0.0 for value in (sweep, least))
    return sweep, least, most if np.isfinite(most) and most > least else np.inf


GRAVITY, SLACK = (9.81, 1.0), 0.2
"""Usual acceleration of a resting or driving robot, m/s^2 or in units of it, and the share by which it may differ."""
TILT = np.radians(20.0)
"""rad between the measured vertical and that of the transforms from which on one of them is wrong."""
MOST_RATE = 2500.0
"""rad/s; the full scale of gyros is 2,000 degrees/s, and some drivers send degrees."""


class ImuReadings:
    """Collects the messages of one topic of type sensor_msgs/Imu."""

    def __init__(self) -> None:
        self._rows = array("d")
        self.frame = ""

    def take(self, stamp: float, message: Any) -> None:
        """Take a message; a field whose covariance begins with -1 is not there, as the message's definition has it."""
        self.frame = self.frame or message.header.frame_id
        self._rows.append(stamp)
        for name, axes in (("angular_velocity", "xyz"), ("linear_acceleration", "xyz"), ("orientation", "xyzw")):
            value, absent = getattr(message, name), getattr(message, f"{name}_covariance")[0] == -1.0
            self._rows.extend(np.nan if absent else getattr(value, axis) for axis in axes)

    @np.errstate(over="ignore", invalid="ignore")
    def gyro(self, frames: Frames, base: str, warnings: list[str]) -> Gyro | None:
        """Return the heading; None, and a warning, where the messages hold none.

        The angular velocity is integrated with the trapezoidal rule. Without it the orientation is taken: its changes are turns
        about the vertical however the sensor is mounted.
        """
        rows = np.array(self._rows).reshape(-1, 11)
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        stamps, rates, turns = rows[:, 0], rows[:, 1:4], rows[:, 7:11]
        turned = np.abs(rates).sum(axis=1)
        if (usable := turned < MOST_RATE).any() and turned[usable].any():
            if missing := len(usable) - np.count_nonzero(usable):
                warnings.append(f"{missing} messages of the IMU hold no angular velocity that a robot has; they are left out")
            rate = rates[usable] @ self._vertical(rows[:, 4:7], frames, base, warnings)
            steps = 0.5 * (rate[1:] + rate[:-1]) * np.diff(stamps[usable])
            return Gyro(stamps[usable], np.concatenate([[0.0], np.cumsum(steps)]))
        if (usable := np.abs(np.linalg.norm(turns, axis=1) - 1.0) < 0.1).any():
            matrices = Rotation.from_quat(turns[usable]).as_matrix()
            since = matrices @ matrices[0].T
            heading = np.arctan2(since[:, 1, 0] - since[:, 0, 1], since[:, 0, 0] + since[:, 1, 1])
            return Gyro(stamps[usable], np.unwrap(heading))
        warnings.append("the messages of the IMU hold neither angular velocities nor orientations; they are not used")
        return None

    def _vertical(self, acceleration: Floats, frames: Frames, base: str, warnings: list[str]) -> Floats:
        """Return which way is up, (3,) in the sensor's frame, length 1."""
        felt = acceleration[np.isfinite(acceleration).all(axis=1)]
        usual = np.median(felt, axis=0) if len(felt) else np.zeros(3)
        size = float(np.linalg.norm(usual))
        heavy = any(abs(size / one - 1.0) < SLACK for one in GRAVITY)
        pose = frames.pose(base, self.frame)
        if pose is None and not heavy:
            warnings.append(
                f"no transform from {base} to {self.frame or 'the IMU'}, and its accelerations show no gravity: its z axis is"
                " taken to point up; `topics.imu=none` maps without it"
            )
        stated = np.array([0.0, 0.0, 1.0]) if pose is None else pose[2, :3]
        if not heavy:
            return stated
        up = usual / size
        if pose is None:
            return up
        up = up if up @ stated >= 0.0 else -up  # some drivers send the acceleration of gravity, which points down
        if np.arccos(min(float(up @ stated), 1.0)) > TILT:
            warnings.append(
                f"by the transforms {self.frame} is tilted otherwise than by its accelerations, which are taken for its heading"
            )
        return up


_USUAL_FRAMES = ("uwb_tag", "uwb_link", "uwb", "tag")


class RangeReadings:
    """Collects the ranges of all topics."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, Reading, str]] = []
        self._frames: dict[str, Counter[str]] = {}

    def take(self, stamp: float, readings: list[Reading], message: Any, kind: str = "") -> None:
        """Take the readings of a message; ids are names of nodes within the messages of one kind."""
        self._rows += [(stamp, reading, kind) for reading in readings]
        if hasattr(message, "header"):
            for tag in {reading.tag for reading in readings}:
                self._frames.setdefault(tag, Counter())[message.header.frame_id] += 1

    def ranges(self, offset: float, warnings: list[str]) -> tuple[UwbRanges | None, tuple[str, ...]]:
        """Return the ranges, moved in time by an offset, s, and the tags that measured them, '' where none is named."""
        faults = {name: fault for name in {r.anchor for _, r, _ in self._rows} if (fault := fault_of_id(name))}
        if faults:
            count = sum(r.anchor in faults for _, r, _ in self._rows)
            warnings.append(f"{count} ranges were left out: the anchor's id {faults[min(faults)]}")
        sound = [row for row in self._rows if np.isfinite((row[0], row[1].range, row[1].quality)).all()]
        sound = [row for row in sound if row[1].anchor not in faults]
        rows = [row for kind in sorted({row[2] for row in sound}) for row in _of_the_robot(sound, kind, warnings)]
        if not rows:
            return None, ()
        tags = tuple(sorted({r.tag for _, r in rows}))
        if len(tags) > 1:
            named = ", ".join(tag or "without name" for tag in tags)
            warnings.append(f"{len(tags)} tags measured ({named}); the ranges of each are kept apart (UWB, UWB2 ...)")
        number = {name: k for k, name in enumerate(dict.fromkeys(r.anchor for _, r in rows))}
        stamps, metres, quality = np.array([(t + offset, r.range, r.quality) for t, r in rows]).T
        anchor, tag = np.array([(number[r.anchor], tags.index(r.tag)) for _, r in rows], dtype=np.intp).T
        return ranges_of(stamps, anchor, list(number), metres, quality, tag if len(tags) > 1 else None), tags

    def places(self, tags: tuple[str, ...], frames: Frames, base: str, warnings: list[str]) -> Floats:
        """Return where the tags sit on the robot (t, 3), m, by the frame of their messages or usual names; else its middle."""
        positions, unknown = np.zeros((len(tags), 3)), []
        for place, tag in zip(positions, tags, strict=True):
            named = [name for name, _ in self._frames.get(tag, Counter[str]()).most_common(1)]
            usual = [f"uwb_{tag}", f"tag_{tag}", tag] if len(tags) > 1 else list(_USUAL_FRAMES)
            poses = (frames.pose(base, name) for name in (*named, *usual) if name)
            pose = next((p for p in poses if p is not None), None)
            place[:] = 0.0 if pose is None else pose[:3, 3]
            unknown += [tag] if pose is None else []
        if unknown and len(tags) > 1:
            warnings.append(
                f"no transform to the tags {', '.join(unknown)}: they are taken to sit in the middle of the robot, on the"
                " floor; convert to a .log and write PARAM uwb_tag_offset_x, uwb2_tag_offset_x ... (docs/formats.md)"
            )
        elif unknown:
            warnings.append(
                "no transform to the UWB tag: it is taken to sit in the middle of the robot, on the floor;"
                " give `mounting.tag_position`"
            )
        return positions


def _of_the_robot(every: list[tuple[float, Reading, str]], kind: str, warnings: list[str]) -> list[tuple[float, Reading]]:
    """Return stamps and ranges of one kind of messages by tags to which nobody ranges as to an anchor, else the busiest one."""
    rows = [(t, r) for t, r, k in every if k == kind]
    by_tag, anchors = Counter(r.tag for _, r in rows), {r.anchor for _, r in rows}
    ranked = sorted(by_tag, key=lambda tag: (-by_tag[tag], tag))
    robot = ([tag for tag in ranked if tag not in anchors] or ranked[:1])[:MOST_TAGS]
    others = Counter(f"{r.tag} to {r.anchor}" for _, r in rows if r.tag not in robot)
    if others:
        shown = ", ".join(name for name, _ in others.most_common(3))
        warnings.append(
            f"{others.total()} ranges between other nodes ({shown}{' ...' if len(others) > 3 else ''}) were left out: the tag"
            f" on the robot is taken to be {', '.join(sorted(robot))}"
        )
    return [(t, r) for t, r in rows if r.tag in robot]
