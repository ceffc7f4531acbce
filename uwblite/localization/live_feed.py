"""Live localisation from a log while it is written: mounting of the sensors, and reports of silent sensors."""

from collections.abc import Callable, Iterator

from ..errors import DataError
from ..io.carmen_live import LiveGyro, LiveOdometry, LiveRange, LiveReader, LiveScan, Measured
from ..sensor_log import SensorMounting
from .known_map import KnownMap
from .localizer import Localizer
from .records import LocalizerState, Scanner

_NO_LIDAR = 2.0
"""s after which a robot counts as one without lidar."""
_SILENCE = 5.0
"""s."""
_SENSORS = {
    "odometry": "the pose is held and becomes unsure",
    "lidar": "the pose rests on ranges and odometry",
    "uwb": "the pose rests on scans and odometry",
    "gyro": "directions are the wheels' own",
}
"""The consequence of each silent sensor; a gyro is reported only where one sent before."""


class LiveFeed:
    """From pieces of a log to states.

    Parameters
    ----------
    mounting : converts the mounting of the sensors in the log to the true one. note : receives each line for people.
    """

    def __init__(
        self, known: KnownMap, mounting: Callable[[SensorMounting], SensorMounting], note: Callable[[str], None]
    ) -> None:
        self._known, self._mounting, self._note = known, mounting, note
        self._reader = LiveReader()
        self._localizer: Localizer | None = None
        self._early: list[Measured] = []
        self._seen: dict[str, float] = {}
        self._silent: set[str] = set()
        self._wrong: set[str] = set()
        self._sees = False

    def take(self, data: bytes) -> Iterator[LocalizerState]:
        """Use a piece of the log; yield the state after each of its measurements."""
        for measured in self._reader.feed(data):
            self._watch(measured)
            if self._localizer is not None:
                yield from self._use(self._localizer, measured)
                continue
            self._early.append(measured)
            # The log contains the mounting before the first scan; or no scan comes for so long.
            if isinstance(measured, LiveScan) or measured.order - self._early[0].order > _NO_LIDAR:
                yield from self._begin()

    def end(self) -> Iterator[LocalizerState]:
        """Use the measurements that still wait, yield the states, and report what was left out."""
        yield from self._begin()
        if self._reader.broken:
            self._note(f"{self._reader.broken} broken lines were left out")
        if self._localizer is not None and (names := self._localizer.strangers):
            some = ", ".join(f"{name} ({count})" for name, count in sorted(names.items())[:10])
            more = f" and {len(names) - 10} more" if len(names) > 10 else ""
            self._note(f"ranges to anchors that are not in the map: {some}{more}")
        if self._localizer is not None and self._localizer.refused:
            self._note(f"{self._localizer.refused} measurements were left out, stamped seconds ahead of all others")

    def _begin(self) -> Iterator[LocalizerState]:
        early, self._early = self._early, []
        for measured in early:
            self._localizer = self._localizer or Localizer(self._known, self._mounting(self._reader.mounting))
            yield from self._use(self._localizer, measured)

    def _use(self, localizer: Localizer, measured: Measured) -> Iterator[LocalizerState]:
        """Use a measurement; one that does not fit the robot is left out, and the reason reported once."""
        try:
            yield from self._used(localizer, measured)
        except DataError as error:
            if str(error) not in self._wrong:
                self._wrong.add(str(error))
                self._note(f"left out: {error}")

    def _used(self, localizer: Localizer, measured: Measured) -> Iterator[LocalizerState]:
        if isinstance(measured, LiveOdometry):
            yield localizer.add_odometry(measured.stamp, *measured.pose.tolist())
        elif isinstance(measured, LiveGyro):
            localizer.add_gyro(measured.stamp, measured.heading)
        elif isinstance(measured, LiveRange):
            yield localizer.add_ranges(measured.stamp, [measured.anchor_id], [measured.range], measured.tag)
        else:
            if not self._sees and localizer.scanner is None and "lidar" in self._silent:
                # It comes late: only now the log has said where the laser sits.
                self._localizer = localizer = Localizer(self._known, self._mounting(self._reader.mounting))
            self._sees = True
            s = measured.scans
            scanner = Scanner(s.angle_min, s.angle_increment, s.time_increment, s.range_min, s.range_max)
            yield localizer.add_scan(measured.stamp, s.ranges[0], scanner)

    def _watch(self, measured: Measured) -> None:
        """Report once when a sensor that was there, or should be, becomes silent."""
        kind = {LiveOdometry: "odometry", LiveRange: "uwb", LiveGyro: "gyro"}.get(type(measured), "lidar")
        now = measured.order if self._localizer is None else self._localizer.on_time(measured.order)
        if not self._seen:
            self._seen = {name: now for name in _SENSORS if name != "gyro"}
        self._seen[kind] = max(self._seen.get(kind, now), now)
        if kind in self._silent:
            self._silent.discard(kind)
            self._note(f"{kind} is back")
        for other, last in self._seen.items():
            if now - last > _SILENCE and other not in self._silent:
                self._silent.add(other)
                self._note(f"warning: nothing from {other} for {_SILENCE:.0f} s; {_SENSORS[other]}")
