"""The heading of a robot from the messages of an IMU in a bag: its rotation about the vertical.

The vertical is measured: an accelerometer feels gravity whatever way it is mounted. Where the messages hold no gravity,
the transforms say which way is up, and without these the sensor's z axis is taken, as REP-145 has it.
"""

from array import array
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..arrays import Floats
from ..sensor_log import Gyro
from .bag_frames import Frames

GRAVITY, SLACK = (9.81, 1.0), 0.2
"""Usual acceleration of a resting or driving robot, m/s^2 or in units of it, and the share by which it may differ."""
TILT = np.radians(20.0)
"""rad between the measured vertical and that of the transforms from which on one of them is wrong."""
MOST_RATE = 2500.0
"""rad/s; the full scale of gyros is 2,000 degrees/s, and some drivers send degrees."""
_FIELDS = ("angular_velocity", "linear_acceleration", "orientation")


class ImuReadings:
    """Collects the messages of one topic of type sensor_msgs/Imu."""

    def __init__(self) -> None:
        self._rows = array("d")
        self.frame = ""

    def take(self, stamp: float, message: Any) -> None:
        """Take a message; a field whose covariance begins with -1 is not there, as the message's definition has it."""
        self.frame = self.frame or message.header.frame_id
        self._rows.append(stamp)
        for name in _FIELDS:
            value, absent = getattr(message, name), getattr(message, f"{name}_covariance")[0] == -1.0
            axes = ("x", "y", "z", "w") if name == "orientation" else ("x", "y", "z")
            self._rows.extend(np.nan if absent else getattr(value, axis) for axis in axes)

    @np.errstate(over="ignore", invalid="ignore")
    def gyro(self, frames: Frames, base: str, warnings: list[str]) -> Gyro | None:
        """Return the heading; None, and a warning, where the messages hold none.

        The angular velocity is integrated with the trapezoidal rule. Without it the orientation is taken, of which only
        changes matter: they are turns about the vertical however the sensor is mounted.

        Parameters
        ----------
        frames, base : where the sensor sits on the robot, and the robot's frame.
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
            return Gyro(stamps[usable], _headings(turns[usable]))
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
                " taken to point up; --imu-topic none maps without it"
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


def _headings(turns: Floats) -> Floats:
    """Return the turn about the vertical since the first orientation (n,), rad, unwrapped; quaternions (n, 4) x y z w."""
    matrices = Rotation.from_quat(turns).as_matrix()
    since = matrices @ matrices[0].T
    return np.unwrap(np.arctan2(since[:, 1, 0] - since[:, 0, 1], since[:, 0, 0] + since[:, 1, 1]))
