"""Motion in a bag: the times of its messages, the frames of its transforms (tf), and the odometry."""

from array import array
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..arrays import Floats
from ..errors import ConfigError
from ..sensor_log import Odometry
from .bag_topics import did_you_mean

_OTHER_CLOCK = 5.0
"""s; messages are recorded sooner after they were made."""
_SIMULATED = 1e8
"""s; a clock that counts since 1970 passed it in 1973."""


class BagClock:
    """Times of headers, or of recording where these bear none."""

    def __init__(self) -> None:
        self.unstamped = 0
        self.late: dict[str, list[float]] = {}
        self._earliest = np.inf

    def time(self, sensor: str, stamp: Any, recorded: float) -> float:
        """Return the time, s, of a message of a sensor with the stamp of a header, recorded at a time, s."""
        seconds = float(stamp.sec) + 1e-9 * float(stamp.nanosec)
        if seconds <= 0.0:
            self.unstamped += recorded != seconds  # a simulated clock begins at 0
            return recorded
        self._earliest = min(self._earliest, seconds)
        self.late.setdefault(sensor, []).append(recorded - seconds)
        return seconds

    def offset(self, sensor: str) -> float:
        """Return what is to be added to a sensor's stamps, s, where they are of another clock than the odometry's; else 0."""
        if not self.late.get(sensor) or not self.late.get("odometry"):
            return 0.0
        off = float(np.median(self.late[sensor]) - np.median(self.late["odometry"]))
        return off if abs(off) > _OTHER_CLOCK else 0.0

    def warnings(self) -> list[str]:
        """Return what is odd about the times."""
        warnings = [f"{self.unstamped} messages carry no time; the time of recording is used"] if self.unstamped else []
        delay = float(np.median(np.concatenate(list(self.late.values())))) if self.late else 0.0
        moved = {sensor: off for sensor in self.late if (off := self.offset(sensor))}
        warnings += [
            f"the stamps of the {sensor} are of another clock than the odometry's, {abs(off):.1f} s"
            f" {'behind' if off > 0.0 else 'ahead'}: by the time of recording they were moved by {off:+.1f} s"
            for sensor, off in moved.items()
        ]
        if abs(delay) > _OTHER_CLOCK and not moved:
            why = "the sensors' computers have other clocks"
            if self._earliest < _SIMULATED < self._earliest + delay:
                why = "the stamps are of a simulation, or count since a computer was started"
            warnings.append(f"headers and recording differ by {delay:.1f} s: {why}")
        return warnings


class Frames:
    """A tree of frames, each known by its pose in its parent; the first transform of each frame counts."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Floats]] = {}
        self.invalid: set[str] = set()
        """Frames of which a transform was no rotation, as all zeros are none, and was left out."""

    def add(self, transforms: Iterable[Any]) -> None:
        """Take the transforms of a tf2_msgs/TFMessage."""
        for t in transforms:
            shift, turn, pose = t.transform.translation, t.transform.rotation, np.eye(4)
            quaternion, child = np.array([turn.x, turn.y, turn.z, turn.w]), t.child_frame_id.lstrip("/")
            pose[:3, 3] = shift.x, shift.y, shift.z
            if not (_LEAST_NORM < np.abs(quaternion).max() < _MOST_NORM and np.isfinite(pose).all()):
                self.invalid.add(child)
                continue
            pose[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
            self._parents.setdefault(child, (t.header.frame_id.lstrip("/"), pose))

    @property
    def steps(self) -> list[str]:
        """The transforms, each as parent -> child."""
        return [f"{parent} -> {child}" for child, (parent, _) in sorted(self._parents.items())]

    def check(self, frame: str) -> None:
        """Raise ConfigError where a frame is missing in the transforms; without any transform every frame is accepted."""
        names = sorted(set(self._parents) | {parent for parent, _ in self._parents.values()})
        if names and frame.lstrip("/") not in names:
            known = f"{did_you_mean(frame, names)}they know {', '.join(names)}"
            raise ConfigError(f"the transforms of the bag know no frame {frame}; {known}")

    def pose(self, base: str, frame: str) -> Floats | None:
        """Return T_base_frame (4, 4), None where the frames are not connected."""
        up, down = self._to_root(base), self._to_root(frame)
        common = next((name for name in down if name in up), None)
        return None if common is None else np.asarray(np.linalg.inv(up[common]) @ down[common], dtype=np.float64)

    def _to_root(self, frame: str) -> dict[str, Floats]:
        """Return the pose of the frame in itself and in each of its ancestors, nearest first."""
        name, pose = frame.lstrip("/"), np.eye(4)
        chain = {name: pose}
        while name in self._parents and self._parents[name][0] not in chain:
            name, step = self._parents[name]
            chain[name] = pose = step @ pose
        return chain


def planar(pose: Floats) -> tuple[Floats, bool]:
    """Return x, y, theta (3,) of a pose (4, 4), and whether its z axis points down (mounted upside down)."""
    return np.array([pose[0, 3], pose[1, 3], np.arctan2(pose[1, 0], pose[0, 0])]), bool(pose[2, 2] < 0)


_LEAST_NORM, _MOST_NORM = 1e-6, 1e6
_UNIT = 0.01
"""Difference of a quaternion's length from 1 from which on it is reported."""


class OdometryReadings:
    """Collects poses of a base."""

    def __init__(self) -> None:
        self._rows = array("d")
        self.without_heading = self.stretched = 0

    def __len__(self) -> int:
        return len(self._rows) // 4

    def take(self, stamp: float, place: Any, turn: Any) -> None:
        """Take a position and a quaternion."""
        x, y, z, w = (float(getattr(turn, axis)) for axis in "xyzw")
        norm, yaw = float(np.sqrt(x * x + y * y + z * z + w * w)), np.nan
        if _LEAST_NORM < norm < _MOST_NORM:
            self.stretched += abs(norm - 1.0) > _UNIT
            yaw = float(np.arctan2(2.0 * (w * z + x * y), norm * norm - 2.0 * (y * y + z * z)))
        else:
            self.without_heading += 1
        self._rows.extend((stamp, float(place.x), float(place.y), yaw))

    def odometry(self, warnings: list[str]) -> Odometry | None:
        """Return the finite readings in the order of time, of several with one stamp and pose the first; None of none."""
        rows = np.array(self._rows).reshape(-1, 4)
        if self.without_heading:
            warnings.append(
                f"{self.without_heading} of {len(rows)} odometry messages have an orientation without length (0 0 0 0): they"
                " state no heading and were left out"
            )
        if self.stretched:
            warnings.append(f"the orientations of {self.stretched} odometry messages are no unit quaternions; they were scaled")
        sound = np.isfinite(rows).all(axis=1)
        if (broken := len(rows) - int(sound.sum()) - self.without_heading) > 0:
            warnings.append(f"{broken} odometry messages are not finite and were skipped")
        rows = rows[sound]
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        rows = rows[np.append(True, np.any(rows[1:] != rows[:-1], axis=1))[: len(rows)]]
        return Odometry(rows[:, 0].copy(), rows[:, 1:].copy()) if len(rows) else None


class MovingFrames:
    """Collects the transforms that may be odometry: of a base in a frame that is called odom."""

    def __init__(self) -> None:
        self.pairs: dict[tuple[str, str], OdometryReadings] = {}

    def take(self, clock: BagClock, recorded: float, transforms: Iterable[Any]) -> None:
        """Take the transforms of a message recorded at a time, s."""
        for t in transforms:
            pair = t.header.frame_id.lstrip("/"), t.child_frame_id.lstrip("/")
            if "odom" in pair[0].lower():
                stamp = clock.time("odometry", t.header.stamp, recorded)
                self.pairs.setdefault(pair, OdometryReadings()).take(stamp, t.transform.translation, t.transform.rotation)

    def best(self, base: str = "") -> tuple[tuple[str, str], OdometryReadings] | None:
        """Return the frames and poses that come most often, of a base where one is given; None where none moves."""
        moving = [(pair, r) for pair, r in self.pairs.items() if len(r) > 1 and (not base or pair[1] == base)]
        return max(moving, key=lambda row: (len(row[1]), row[0])) if moving else None


def no_odometry(topics: Sequence[tuple[str, str]], truths: Sequence[str], frames: Sequence[str]) -> str:
    """Return the words on a bag with such topics and types, topics named as the truth, and transforms, but no odometry."""
    text = "the bag has no odometry: neither nav_msgs/Odometry nor, in tf, a transform from odom to the base"
    if truths:
        text += f"; {', '.join(truths)} is the truth by its name, and `topics.odometry={truths[0]}` takes it nevertheless"
    if frames:
        text += f"; tf moves {', '.join(frames[:4])}"
    shown, most = [f"{name} ({kind})" for name, kind in topics], 12
    more = f" and {len(shown) - most} more" if len(shown) > most else ""
    return f"{text}; it holds: {', '.join(shown[:most]) or 'nothing'}{more}"
