"""Events of drivers. They are frozen and compared by ``==``; noise is an event, misuse is an exception.

A *protocol* turns bytes into events (``feed(data, stamp)``). A *session* drives a protocol through the start-up and
recovery of one device: it turns bytes and time into *actions*, that is measurements to log and bytes to send.
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Corrupt:
    """Bytes that are no frame of the protocol."""

    why: str
    """One clause for the counters: what did not fit."""


@dataclass(frozen=True, slots=True)
class Send:
    """Write these bytes to the device, in one write."""

    data: bytes


@dataclass(frozen=True, slots=True)
class SetBaud:
    """Change the speed of the port, bit/s; ports without a speed ignore it."""

    rate: int


@dataclass(frozen=True, slots=True)
class SetDtr:
    """Set the DTR line of the port, which switches the motor of some lidars; ports without one ignore it."""

    on: bool


@dataclass(frozen=True, slots=True)
class Param:
    """A fact about the device for the head of the log."""

    name: str
    value: str


@dataclass(frozen=True, slots=True)
class Note:
    """A message for people; becomes a COMMENT in the log and a line on the terminal."""

    level: str
    """"info", "warning" or "error"."""
    name: str
    """Short stable name, for example ``stationary-detection``."""
    text: str
    """What, and how to mend it."""


@dataclass(frozen=True, slots=True)
class Reopen:
    """The device does not answer: close the port and open it again after a pause, unless what it sends may still come."""

    why: str


@dataclass(frozen=True, slots=True)
class RangeReading:
    """One distance from the tag to an anchor."""

    anchor_id: str
    """Four upper-case hexadecimal digits, the anchor's short address."""
    range: float
    """m."""
    quality: int
    """0..100; 100 where the device reports none."""


@dataclass(frozen=True, slots=True)
class RangeEpoch:
    """The distances of one ranging round."""

    stamp: float
    """s, host clock."""
    readings: tuple[RangeReading, ...]
    spread: float = 0.0
    """s; the stamp may be wrong by this much to either side; 0 = not known."""


@dataclass(frozen=True, slots=True)
class LaserScan:
    """One sweep; field names of sensor_msgs/LaserScan."""

    stamp: float
    """s, host clock, time of the first ray."""
    ranges: tuple[float, ...]
    """m; +inf = nothing seen, nan = invalid (REP-117)."""
    angle_min: float
    """rad, counter-clockwise, 0 = ahead."""
    angle_increment: float
    """rad."""
    time_increment: float
    """s between rays."""
    range_max: float
    range_min: float = 0.02
    """m."""
    spread: float = 0.0
    """s; the stamp may be wrong by this much to either side; 0 = not known."""


@dataclass(frozen=True, slots=True)
class OdometryPose:
    """Pose of the base in the drifting odom frame."""

    stamp: float
    """s, host clock."""
    x: float
    y: float
    """m."""
    theta: float
    """rad."""
    speed: float = 0.0
    """m/s, forward."""
    turn_rate: float = 0.0
    """rad/s."""


@dataclass(frozen=True, slots=True)
class GyroHeading:
    """Heading of a gyro from an arbitrary zero, with its bias."""

    stamp: float
    """s, host clock."""
    heading: float
    """rad, counter-clockwise, not wrapped."""
    turn_rate: float
    """rad/s."""


@dataclass(frozen=True, slots=True)
class Lost:
    """The device numbers or times its frames, and some are missing."""

    count: int
    """Frames missing."""


Pose = tuple[float, float, float]
"""x, y, theta of the base in the odom frame; m, m, rad."""

Measurement = RangeEpoch | LaserScan | OdometryPose | GyroHeading
Action = Corrupt | Send | SetBaud | SetDtr | Param | Note | Reopen | Measurement | Lost
