"""Live localisation from a log while it is written: mounting of the sensors, and reports of silent sensors."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from ..errors import DataError
from ..io.carmen_live import LiveReader, Measured
from ..sensor_log import SensorMounting
from .known_map import KnownMap
from .localizer import UNSEEN_SPEED, Localizer
from .pose_estimator import LocalizerState
from .sensing import Scanner

_NO_LIDAR = 2.0
"""s after which a robot counts as one without lidar."""
CONSEQUENCES = {
    "odometry": "the pose is held and becomes unsure",
    "lidar": "the pose rests on ranges and odometry",
    "uwb": "the pose rests on scans and odometry",
    "gyro": "directions are the wheels' own",
}
"""The consequence of each silent sensor; a gyro is reported only where one sent before."""
_PERIODS = 3.0
"""Missed periods of a sensor that show silence."""
_FIRST_PERIOD = 2.0
"""s, as long as a sensor's own is not known: that of a radio that measures at rest."""
_FORGETTING = 0.05
"""Share of the longest period that every message forgets."""
NO_ODOMETRY = "no odometry has come in: without it there is no pose"
_NAMED = 10
"""Most unknown anchors that are named."""


@dataclass(frozen=True, slots=True)
class Patience:
    """How long nothing may come."""

    late: float = 2.0
    """s, and three periods, after which a sensor, or the whole log, is said to be silent."""
    lost: float = 10.0
    """s without any data after which the pose counts as lost."""


@dataclass(slots=True)
class Silence:
    """Times of the last messages on the log's clock, which goes on while nothing comes.

    Sensors are expected from the beginning, or, optional ones, from their first message on.
    """

    late: float
    """s of silence, and _PERIODS periods of the sensor, from which on it is late."""
    expected: tuple[str, ...] = ()
    """Sensors that should be there."""
    last: dict[str, float] = field(default_factory=dict)
    """s, time of each sensor's last message."""
    longest: dict[str, float] = field(default_factory=dict)
    """s, its longest period of late."""
    now: float = -float("inf")
    """s, time of the last message of all."""

    def hear(self, name: str, stamp: float) -> None:
        """Take the time, s, of a message; one that is late or broken does not set time back."""
        if not self.last:
            self.last = dict.fromkeys(self.expected, stamp)
        last = self.last.setdefault(name, stamp)
        # A silence is no period: it counts as far as the next one is to be noticed soon.
        period = min(stamp - last, _PERIODS * self.late)
        self.longest[name] = max(period, (1.0 - _FORGETTING) * self.longest.get(name, _FIRST_PERIOD))
        self.last[name], self.now = max(last, stamp), max(self.now, stamp)

    def silent(self, quiet: float = 0.0) -> dict[str, float]:
        """Return the sensors that are late, with their silence in s, where nothing at all came for `quiet` s."""
        ages = {name: self.now - last + quiet for name, last in self.last.items()}
        return {name: age for name, age in ages.items() if age > self._limit(name)}

    def all_late(self, quiet: float) -> bool:
        """Return whether all sensors should have sent something within `quiet` s."""
        return quiet > min(map(self._limit, self.last), default=self.late)

    def _limit(self, name: str) -> float:
        return max(self.late, _PERIODS * self.longest.get(name, _FIRST_PERIOD))


class LiveFeed:
    """From pieces of a log to states.

    Parameters
    ----------
    mounting : converts the mounting of the sensors in the log to the true one. note : receives each line for people.
    """

    def __init__(
        self,
        known: KnownMap,
        mounting: Callable[[SensorMounting], SensorMounting],
        note: Callable[[str], None],
        patience: Patience | None = None,
    ) -> None:
        self._known, self._mounting, self._note, self._patience = known, mounting, note, patience or Patience()
        self._reader = LiveReader()
        self._localizer: Localizer | None = None
        self._early: list[Measured] = []
        self.silence = Silence(self._patience.late, tuple(name for name in CONSEQUENCES if name != "gyro"))
        self._reported: set[str] = set()
        self._stopped = False
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
            if measured.sensor == "lidar" or measured.order - self._early[0].order > _NO_LIDAR:
                yield from self._begin()

    def wait(self, quiet: float) -> Iterator[LocalizerState]:
        """Yield the state where nothing has come for so long, s, once that is too long."""
        if not self.silence.all_late(quiet):
            return
        yield from self._begin()
        if not self._stopped:
            self._stopped = True
            self._note(f"warning: no data for {quiet:.0f} s: the pose becomes old; is the recorder still running?")
        if self._localizer is not None:
            yield self._aged(self._localizer.state(), quiet)

    def end(self) -> Iterator[LocalizerState]:
        """Use the measurements that still wait, yield the states, and report what was left out."""
        yield from self._begin()
        if self._reader.broken:
            self._note(f"{self._reader.broken} broken lines were left out")
        if self._localizer is not None and (names := self._localizer.strangers):
            some = ", ".join(f"{name} ({count})" for name, count in sorted(names.items())[:_NAMED])
            more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
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
        if measured.sensor == "odometry":
            yield self._aged(localizer.add_odometry(measured.stamp, *measured.value.tolist()))
        elif measured.sensor == "gyro":
            localizer.add_gyro(measured.stamp, measured.value)
        elif measured.sensor == "uwb":
            yield self._aged(localizer.add_ranges(measured.stamp, [measured.anchor_id], [measured.value], measured.tag))
        else:
            if not self._sees and localizer.scanner is None and "lidar" in self._reported:
                # It comes late: only now the log has said where the laser sits.
                self._localizer = localizer = Localizer(self._known, self._mounting(self._reader.mounting))
            self._sees = True
            scans = measured.value
            yield self._aged(localizer.add_scan(measured.stamp, scans.ranges[0], Scanner.of(scans)))

    def _watch(self, measured: Measured) -> None:
        """Report once when a sensor that was there, or should be, becomes silent, and when it is back."""
        if self._stopped:
            self._stopped = False
            self._note("data come again")
        order = measured.order if self._localizer is None else self._localizer.on_time(measured.order)
        self.silence.hear(measured.sensor, order)
        silent = self.silence.silent()
        for name in sorted(self._reported - set(silent)):
            self._note(f"{name} is back")
        never = {} if "odometry" in self.silence.longest else {"odometry": "without it there is no pose"}
        for name in sorted(set(silent) - self._reported):
            self._note(f"warning: nothing from {name} for {silent[name]:.0f} s; {(CONSEQUENCES | never)[name]}")
        self._reported = set(silent)

    def _aged(self, state: LocalizerState, quiet: float = 0.0) -> LocalizerState:
        """Return a state with the silence of the sensors, where nothing at all has come for so long, s."""
        silent = self.silence.silent(quiet)
        if "odometry" in silent and not np.isfinite(state.stamp):
            state = replace(state, stamp=self.silence.now, reason=NO_ODOMETRY)
        if not quiet:
            return replace(state, silent=silent) if silent else state
        drift = np.diag(np.square(np.minimum(UNSEEN_SPEED * quiet, (np.inf, np.inf, np.pi))))
        state = replace(state, age=quiet, silent=silent, covariance=state.covariance + drift)
        if quiet <= self._patience.lost:
            return state
        return replace(state, lost=True, quality=0.0, reason=f"no data for {quiet:.0f} s")
