"""What the drivers of spinning lidars share: turns become scans of one geometry, the time of each reading, silence.

A low-cost lidar measures at a fixed rate while its motor turns a little faster or slower, so that every turn has other
bearings and another number of samples. Here the samples of a turn are brought onto a fixed fan of rays: between two
neighbours on one surface 1/range is linear in the bearing (on a flat wall 1/r = cos(phi - alpha) / d, so that half a
degree of spacing costs 1e-5 of the range); where the range leaps, the nearer sample in bearing counts alone, so that no
point appears in the empty air between two surfaces. Rays run in the order of time: clockwise, as these lidars turn, with
ray i measured at stamp + i * time_increment.
"""

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ..clocks.clock_map import rhythm_map
from ..clocks.device_clock import DeviceClock
from .backlog import LEAST_PAUSE
from .events import Action, LaserScan, Lost, Reopen, SetDtr
from .framing import FrameReader
from .session import Driver, Identity, Script, Wait

GRAZING = math.tan(math.radians(10.0))
"""A surface seen more obliquely than this is taken for an edge between two surfaces, as shadow filters do."""
NOISE = 0.05
"""m; two ranges that differ less are of one surface: three sigma of a triangulating lidar at 2 m."""
GAP = 3.0
"""Spacings of the rays; between samples further apart than that nothing is known (frames were lost)."""
UNEVEN = 0.15
"""Turns; a motor that is further from where an even speed has it stood still on the way, and the rays' times are unknown."""
LEAST_RAYS = 0.5
"""Share of the rays that must lie between samples; a turn with fewer is lost."""
BACKLASH = 0.02
"""Turns; bearings jitter, but a step back of more than 7 degrees is the next turn."""
STEADY = 0.01
"""Relative change of the turn's duration below which the time increment stays: 0.5 % of a turn at its ends."""


@dataclass(frozen=True, slots=True)
class Samples:
    """Some readings in the order in which they were made."""

    stamp: float
    """s, arrival of the frame's first byte; the last reading was made just before."""
    clock: int | None
    """Device clock at the last reading, its own ticks; None where the device sends no time."""
    period: float
    """s between readings."""
    turned: tuple[float, ...]
    """Turns, 0..1, clockwise: where the motor stood at each reading."""
    bearings: tuple[float, ...]
    """Turns, clockwise: where the reading points; differs from `turned` in lidars that triangulate."""
    ranges: tuple[float, ...]
    """m; nan where nothing was measured."""


@dataclass(frozen=True, slots=True)
class Fan:
    """The rays that every scan has."""

    rays: int
    """About as many as readings in a turn at the motor's usual speed."""
    range_min: float
    range_max: float
    """m."""


class SweepAssembler:
    """Collect readings with their times, give a scan for each whole turn."""

    def __init__(self, fan: Fan) -> None:
        self.fan = fan
        self.lost = 0
        """Turns too few of whose rays were seen, or with unknown times; the owner takes and clears it."""
        self._duration = 0.0
        self.clear()

    def clear(self) -> None:
        self._turn: list[tuple[float, float, float, float]] = []
        """Time, place of the motor, bearing and range of each reading of this turn."""
        self._begin: float | None = None
        self._before: tuple[float, float] | None = None
        """Bearing and range of the last reading before it."""

    def add(self, times: list[float], samples: Samples) -> list[LaserScan]:
        """Take readings made at times, s, host clock; return the scans of the turns that ended."""
        scans = []
        for reading in zip(times, samples.turned, samples.bearings, samples.ranges, strict=True):
            time, turned, bearing, reach = reading
            if self._turn and turned < self._turn[-1][1] - BACKLASH:
                seam = self._seam(time, turned)
                if (scan := self._close(seam, (bearing + 1.0, reach))) is not None:
                    scans.append(scan)
                self._before = (self._turn[-1][2] - 1.0, self._turn[-1][3])
                self._turn, self._begin = [], seam
            self._turn.append(reading)
        return scans

    def _seam(self, time: float, turned: float) -> float:
        """Return when the motor passed zero between the last reading and this one, s."""
        before, angle = self._turn[-1][:2]
        return before + (time - before) * (1.0 - angle) / (1.0 - angle + turned) if turned + 1.0 > angle else time

    def _close(self, end: float, after: tuple[float, float]) -> LaserScan | None:
        begin = self._begin
        if begin is None or len(self._turn) < 2 or end <= begin:
            return None
        fan, spacing, duration = self.fan, 1.0 / self.fan.rays, end - begin
        rays = sorted((bearing, reach) for _, _, bearing, reach in self._turn)
        rays = [*([self._before] if self._before else []), *rays, after]
        ranges, known = _resample(rays, fan.rays, spacing)
        uneven = max(abs(time - begin - turned * duration) for time, turned, _, _ in self._turn)
        if known < LEAST_RAYS * fan.rays or uneven > UNEVEN * duration:
            self.lost += 1
            return None
        # The reading that points at ray 0 is made a little before or after the motor passes zero.
        ahead = sum(turned - bearing for _, turned, bearing, _ in self._turn) / len(self._turn)
        if abs(duration - self._duration) > STEADY * duration:
            self._duration = duration
        middle = 0.5 * (begin + end) + ahead * duration
        stamp, increments = middle - 0.5 * self._duration, (-2.0 * math.pi * spacing, self._duration * spacing)
        return LaserScan(stamp, tuple(ranges), 0.0, *increments, fan.range_max, fan.range_min)


def _resample(samples: list[tuple[float, float]], rays: int, spacing: float) -> tuple[list[float], int]:
    """Return the ranges, m, at the bearings 0, 1/rays ... turns, and how many rays lie between samples.

    Samples are (bearing, range), turns and m, sorted by bearing.
    """
    bearings = [bearing for bearing, _ in samples]
    ranges, known = [math.nan] * rays, 0
    for index in range(rays):
        direction = index * spacing
        right = bisect_right(bearings, direction)
        if right == 0 or right == len(samples):
            continue
        (b0, r0), (b1, r1) = samples[right - 1], samples[right]
        width = b1 - b0
        if width > GAP * spacing:
            continue
        known += 1
        share = (direction - b0) / width if width > 0.0 else 0.0
        if abs(r1 - r0) <= max(NOISE, 2.0 * math.pi * width * min(r0, r1) / GRAZING):
            ranges[index] = 1.0 / ((1.0 - share) / r0 + share / r1)
        else:
            ranges[index] = r0 if share < 0.5 else r1
    return ranges, known


SILENCE = 3.0
"""s without a reading after which the lidar is started again."""
LONG = 0.6
"""Turns without a reading after which, by the motor's place alone, it is unknown how many went by; where it seems to go on,
in pauses that `Backlog` fills."""


class SpinningDriver(Driver):
    """A spinning lidar that streams; kinds derive from this, and say how it is started if it does not stream unasked.

    A lidar that stamps its packets has a `DeviceClock`. For others the readings themselves are the clock: they come at a
    constant rate, and how many are missing follows from where the motor stands.
    """

    title = "lidar"
    dtr: bool | None = None
    """State of the line DTR with which the motor turns; None = not used."""

    def __init__(self, protocol: FrameReader, fan: Fan, clock: DeviceClock | None = None) -> None:
        super().__init__(protocol, self.title)
        self.facts = dict[str, str]()
        self._clock, self._map = clock, rhythm_map()
        self._assembler = SweepAssembler(fan)
        self.is_new_stream = False
        """It was asked for a stream; readings that come next do not go on from those before."""
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
        while True:
            if self.dtr is not None:
                yield SetDtr(self.dtr)
            if (yield from self.start_up()):
                yield from self.listen(Samples, SILENCE)
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

    def stop(self) -> list[Action]:
        return [] if self.dtr is None else [SetDtr(not self.dtr)]

    def identity(self) -> Identity:
        return Identity(self.title, tuple(self.facts.items()))

    # ---- readings

    def take(self, event: Any) -> list[Action]:
        if not isinstance(event, Samples):
            return []
        self.ready = True
        last, lost = self._host_time(event) if self._clock is None else self._device_time(event, self._clock)
        count = len(event.ranges)
        times = [last - (count - 1 - i) * event.period for i in range(count)]
        scans: Sequence[LaserScan] = self._assembler.add(times, event)
        lost += self._assembler.lost
        self._assembler.lost = 0
        return [*([Lost(lost)] if lost else []), *scans]

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
            if self.is_new_stream or (silence > LONG * turn and not (follows and silence < LEAST_PAUSE)):
                lost = round(silence / turn)
                self._forget()
            else:
                self._time += elapsed
        self._last, self.is_new_stream = samples, False
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
