"""Wheel odometry in a bag: nav_msgs/Odometry, or the transform from odom to the base where no such topic is there."""

from array import array
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ..arrays import Floats
from ..sensor_log import Odometry
from .bag_clock import BagClock

_LEAST_NORM, _MOST_NORM = 1e-6, 1e6
_UNIT = 0.01
"""Difference of a quaternion's length from 1 from which on it is reported."""
_LEAST_POSES = 2
"""Transforms of a frame that moves."""


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
        norm = float(np.sqrt(x * x + y * y + z * z + w * w))
        yaw = np.nan
        if _LEAST_NORM < norm < _MOST_NORM:
            self.stretched += abs(norm - 1.0) > _UNIT
            yaw = float(np.arctan2(2.0 * (w * z + x * y), norm * norm - 2.0 * (y * y + z * z)))
        else:
            self.without_heading += 1
        self._rows.extend((stamp, float(place.x), float(place.y), yaw))

    def table(self, warnings: list[str]) -> Floats:
        """Return stamp and pose (n, 4) of the finite readings in the order of time."""
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
        return rows[np.argsort(rows[:, 0], kind="stable")]


class MovingFrames:
    """Collects the transforms that may be odometry: of a base in a frame that is called odom."""

    def __init__(self) -> None:
        self.pairs: dict[tuple[str, str], OdometryReadings] = {}

    def take(self, clock: BagClock, recorded: float, transforms: Iterable[Any]) -> None:
        """Take the transforms of a message recorded at a time, s."""
        for t in transforms:
            pair = t.header.frame_id.lstrip("/"), t.child_frame_id.lstrip("/")
            if "odom" in pair[0].lower():
                readings = self.pairs.setdefault(pair, OdometryReadings())
                readings.take(clock.time("odometry", t.header.stamp, recorded), t.transform.translation, t.transform.rotation)

    def best(self, base: str = "") -> tuple[tuple[str, str], OdometryReadings] | None:
        """Return the frames and poses that come most often, of a base where one is given; None where none moves."""
        found = [(pair, r) for pair, r in self.pairs.items() if len(r) >= _LEAST_POSES and (not base or pair[1] == base)]
        return max(found, key=lambda row: (len(row[1]), row[0])) if found else None


def once_each(table: Floats) -> Odometry:
    """Return the odometry of rows (n, 4) in the order of time, of several with one stamp and pose the first."""
    again = np.zeros(len(table), dtype=bool)
    again[1:] = np.all(table[1:] == table[:-1], axis=1)
    return Odometry(table[~again, 0].copy(), table[~again, 1:].copy())


def no_odometry(topics: Sequence[tuple[str, str]], truths: Sequence[str], frames: Sequence[str]) -> str:
    """Return the words on a bag without odometry.

    Parameters
    ----------
    topics : name and type of what it holds. truths : topics that are named as the truth. frames : transforms that move.
    """
    text = "the bag has no odometry: neither nav_msgs/Odometry nor, in tf, a transform from odom to the base"
    if truths:
        text += f"; {', '.join(truths)} is the truth by its name, and --odometry-topic {truths[0]} takes it nevertheless"
    if frames:
        text += f"; tf moves {', '.join(frames[:4])}"
    held = [f"{name} ({kind})" for name, kind in topics]
    more = f" and {len(held) - _SHOWN} more" if len(held) > _SHOWN else ""
    return f"{text}; it holds: {', '.join(held[:_SHOWN]) or 'nothing'}{more}"


_SHOWN = 12
"""Topics named in an error."""
