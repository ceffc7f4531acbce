"""Odometry without a port: a Kobuki base or a text line, both of which talk unasked."""

from .clock import ClockMap
from .events import Action, Corrupt, Lost, Note, OdometryPose
from .kobuki import BAUD, KobukiOdometer, KobukiProtocol
from .odometry_line import LineFormat, LineOdometer, OdometryLineProtocol

Pose = tuple[float, float, float]


class _Listener:
    """What sessions share that only listen."""

    def deadline(self) -> float | None:
        """Nothing is ever due."""
        return None

    def tick(self, now: float) -> list[Action]:
        """Nothing is ever due."""
        return []

    def stop(self) -> list[Action]:
        """Nothing to stop."""
        return []


class KobukiSession(_Listener):
    """A Kobuki base; see `events.Session` for the methods. Read-only: nothing is ever sent.

    Parameters
    ----------
    start : pose of the base at the first packet; m, m, rad.
    """

    def __init__(self, start: Pose = (0.0, 0.0, 0.0)) -> None:
        self.baud = BAUD
        self.packets = 0
        self.battery = 0.0
        self._protocol = KobukiProtocol()
        self._odometer = KobukiOdometer(start)
        self._wheel_drop = 0

    def start(self, now: float) -> list[Action]:
        """Begin, or begin again after a reconnect: the base stayed on, its clock and encoders counted on."""
        self._protocol = KobukiProtocol()
        return []

    def feed(self, data: bytes, now: float) -> list[Action]:
        """Take bytes that arrived at time `now`, s."""
        actions: list[Action] = []
        for event in self._protocol.feed(data, now):
            if isinstance(event, Corrupt):
                actions.append(event)
                continue
            self.packets += 1
            self.battery = event.battery
            pose, missing, remark = self._odometer.update(event)
            if remark:
                actions.append(Note("warning", "odometry-gap", f"odometry: {remark}"))
            if pose is None:
                actions.append(Corrupt(b"", "packet sent twice"))
                continue
            if missing:
                actions.append(Lost(pose.stamp, missing))
            if event.wheel_drop and not self._wheel_drop:
                actions.append(Note("warning", "wheel-drop", "odometry: a wheel hangs in the air; travel is not to be trusted"))
            self._wheel_drop = event.wheel_drop
            actions.append(pose)
        return actions


class LineSession(_Listener):
    """A base that prints text lines; see `events.Session` for the methods.

    Parameters
    ----------
    line_format : columns and units.
    baud : bit/s.
    start : pose at the first line, where the lines hold ticks; m, m, rad.
    """

    def __init__(self, line_format: LineFormat, baud: int = 115200, start: Pose = (0.0, 0.0, 0.0)) -> None:
        self.baud = baud
        self._format = line_format
        self._protocol = OdometryLineProtocol(line_format)
        self._odometer = LineOdometer(line_format, start)
        self._map = ClockMap()
        self._last: float | None = None

    def start(self, now: float) -> list[Action]:
        """Begin, or begin again after a reconnect."""
        self._protocol = OdometryLineProtocol(self._format)
        self._map, self._last = ClockMap(), None
        return []

    def feed(self, data: bytes, now: float) -> list[Action]:
        """Take bytes that arrived at time `now`, s."""
        actions: list[Action] = []
        for event in self._protocol.feed(data, now):
            if isinstance(event, Corrupt):
                actions.append(event)
                continue
            pose = self._odometer.update(event)
            time = self._odometer.device_time(event)
            if time is not None:
                if self._last is not None and not 0 < time - self._last < 60.0:
                    if time == self._last:
                        actions.append(Corrupt(b"", "line sent twice"))
                        continue
                    self._map = ClockMap()
                    actions.append(Note("warning", "odometry-clock", "odometry: its clock leapt; time mapping starts anew"))
                self._last = time
                self._map.add(time, event.stamp)
                pose = OdometryPose(self._map.host(time), pose.x, pose.y, pose.theta, pose.speed, pose.turn_rate)
            actions.append(pose)
        return actions
