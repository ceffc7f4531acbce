"""What the drivers of spinning lidars share: the time of each reading, turns into scans, silence."""

from collections.abc import Sequence
from typing import Any

from ..clocks.clock_map import rhythm_map
from ..clocks.device_clock import DeviceClock
from .events import Action, LaserScan, Lost, Reopen, SetDtr
from .framing import FrameReader
from .session import Driver, Identity, Script, Wait
from .sweep import Fan, Samples, SweepAssembler

SILENCE = 3.0
"""s without a reading after which the lidar is started again."""
LONG = 0.6
"""Turns without a reading after which, by the motor's place alone, it is unknown how many went by."""
PAUSE = 1.0
"""s without bytes after which the motor's place shows nothing, even where it seems to go on."""


class SpinningDriver(Driver):
    """A spinning lidar that streams; kinds derive from this, and say how it is started if it does not stream unasked.

    A lidar that stamps its packets has a `DeviceClock`. For others the readings themselves are the clock: they come at a
    constant rate, and how many are missing follows from where the motor stands.

    Parameters
    ----------
    protocol : bytes to Samples.
    fan : the rays of its scans.
    clock : of its packets; None = it has none.
    """

    title = "lidar"
    dtr: bool | None = None
    """State of the line DTR with which the motor turns; None = not used."""

    def __init__(self, protocol: FrameReader, fan: Fan, clock: DeviceClock | None = None) -> None:
        super().__init__(protocol, self.title)
        self.facts = dict[str, str]()
        self._clock, self._map = clock, rhythm_map()
        self._assembler = SweepAssembler(fan)
        self._received: Samples | None = None
        self._last: Samples | None = None
        self._time = 0.0

    def begin(self) -> None:
        """Forget half a packet and half a turn; the time of the last reading shows what is missing before the next."""
        super().begin()
        self._assembler.clear()

    def _forget(self) -> None:
        self._assembler.clear()
        self._last, self._time, self._map = None, 0.0, rhythm_map()

    def script(self) -> Script[None]:
        """Start the lidar and listen, again and again."""
        while True:
            if self.dtr is not None:
                yield SetDtr(self.dtr)
            if (yield from self.start_up()):
                yield from self._listen()
            else:
                yield Reopen("it does not answer")
                yield Wait(self.now + SILENCE)

    def spacing(self, event: Any) -> float | None:
        """Return how long after the last reading before it the last one of a frame was made, s, by how far the motor turned."""
        if not isinstance(event, Samples):
            return None
        before, self._received = self._received, event
        return 0.0 if before is None else _elapsed(before, event)[0]

    def start_up(self) -> Script[bool]:
        """Make the lidar stream; False = it does not answer."""
        return True
        yield

    def _listen(self) -> Script[None]:
        until = self.now + SILENCE
        while (event := (yield Wait(until))) is not None:
            if isinstance(event, Samples):
                until = self.now + SILENCE
                yield from self.take(event)

    def stop(self) -> list[Action]:
        """Return what stops the motor."""
        return [] if self.dtr is None else [SetDtr(not self.dtr)]

    def identity(self) -> Identity:
        """Say who answered."""
        return Identity(self.title, tuple(self.facts.items()))

    # ---- readings

    def take(self, event: Samples) -> list[Action]:
        """Turn readings into the scans that they complete."""
        self.ready = True
        last, lost = self._host_time(event) if self._clock is None else self._device_time(event, self._clock)
        count = len(event.ranges)
        times = [last - (count - 1 - i) * event.period for i in range(count)]
        scans: Sequence[LaserScan] = self._assembler.add(times, event)
        lost += self._assembler.lost
        self._assembler.lost = 0
        return [*([Lost(times[0], lost)] if lost else []), *scans]

    def _device_time(self, samples: Samples, clock: DeviceClock) -> tuple[float, int]:
        """Return the host time of the last reading, s, and the turns that are missing before it."""
        reading = clock.read(samples.clock or 0, samples.stamp)
        missing = reading.missing * len(samples.ranges) * samples.period / _turn(samples)
        if reading.reset or missing > LONG:
            self._assembler.clear()
            return reading.stamp, max(1, round(missing))
        return reading.stamp, 0

    def _host_time(self, samples: Samples) -> tuple[float, int]:
        """Return the host time of the last reading, s, and the turns that are missing before it."""
        before, lost = self._last, 0
        if before is not None:
            silence, turn = samples.stamp - before.stamp, _turn(samples)
            elapsed, follows = _elapsed(before, samples)
            if silence > PAUSE or (silence > LONG * turn and not follows):
                lost = max(1, round(silence / turn))
                self._forget()
            else:
                self._time += elapsed
        self._last = samples
        self._map.add(self._time, samples.stamp)
        return self._map.host(self._time), lost


def _span(samples: Samples) -> float:
    """Return how far the motor turns in as many readings, turns."""
    count = len(samples.turned)
    return (samples.turned[-1] - samples.turned[0]) % 1.0 * count / (count - 1) if count > 1 else 0.0


def _turn(samples: Samples) -> float:
    """Return the duration of a turn, s; a frame that states no time counts as the fastest turn."""
    return max(samples.period * len(samples.turned) / max(_span(samples), 1e-6), _SHORTEST_TURN)


_SHORTEST_TURN = 1e-3
"""No spinning lidar turns faster, s."""


def _elapsed(before: Samples, samples: Samples) -> tuple[float, bool]:
    """Return the time from the last reading of one frame to that of the next, s, by how far the motor turned.

    And whether the first reading follows the last one by about one spacing.
    """
    count = len(samples.turned)
    # A frame of one reading, as a YDLIDAR sends at the start of a turn, shows no spacing: that of the one before counts.
    spacing = _span(samples) / count or _span(before) / len(before.turned)
    if spacing <= 0.0:
        return count * samples.period, True
    spacings = (samples.turned[0] - before.turned[-1]) % 1.0 / spacing
    return (count - 1 + spacings) * samples.period, spacings < 2.0
