"""Device clocks: counters that wrap or restart, and their time in seconds of the host."""

import math
from collections import deque
from dataclasses import dataclass
from statistics import median

from .clock_map import ClockMap

BACKWARD = 1.0
"""s; a scan may have begun before the last reading of the clock, more than that is another power-up."""
LEAP = 0.1
"""s by which a reading of the clock may differ from what its frames say; more is another power-up."""
TOGETHER = 5.0
"""s; readings of the clock that are further apart do not narrow each other down, since crystals drift."""
RATE_WINDOW = 1.0
"""s of arrivals whose smallest delay is compared with that of the window before."""
WRONG_RATE = 0.05
"""Relative error of a device clock that no crystal has: its unit of time is not the stated one."""
WITNESSES = 3
"""Windows in a row that must say so."""
GAP = 1.6
"""Periods between two frames from which on one is missing."""
_LONGEST_WAIT = 60.0
"""s by which the arrivals of two frames may differ from what the counter says, if it does not wrap in four times that."""
_STEPS, _FEWEST = 25, 5
"""Most and least steps between frames of which the median is their period."""


class Unwrapper:
    """Turn a wrapping counter into seconds that do not wrap.

    Parameters
    ----------
    modulus : the counter counts 0 .. modulus - 1; 0 = it does not wrap.
    tick : seconds per count.
    """

    def __init__(self, modulus: int, tick: float) -> None:
        self.modulus, self.tick = modulus, tick
        self._tolerance = min(_LONGEST_WAIT, modulus * tick / 4) if modulus else _LONGEST_WAIT
        self._total: float | None = None
        self._count, self._now = 0.0, 0.0

    def unwrap(self, count: float, now: float) -> tuple[float, bool]:
        """Return the unwrapped time of a count, and whether the counter was reset since the last one.

        Parameters
        ----------
        count : the device's counter.
        now : arrival at the host, s; shows how often the counter wrapped in a long silence.

        Returns
        -------
        seconds : s since counter value 0 of the first turn; restarts after a reset.
        reset : the counter went back or leapt: another power-up. The caller's clock map is void.
        """
        if self._total is None:
            self._total, reset = count, False
        else:
            elapsed = (now - self._now) / self.tick
            step = count - self._count
            if self.modulus:
                step %= self.modulus
                step += self.modulus * round((elapsed - step) / self.modulus)
            reset = step * self.tick < -BACKWARD or abs(step - elapsed) * self.tick > self._tolerance
            self._total = count if reset else self._total + step
        self._count, self._now = count, now
        return self._total * self.tick, reset


@dataclass(frozen=True, slots=True)
class Reading:
    """The clock's reading of one frame."""

    stamp: float
    """s, host clock."""
    elapsed: float | None
    """s since the frame before, by the device; None = the first frame, or the first after a reset."""
    missing: int
    """Frames that did not arrive in between."""
    reset: bool
    """The device counted from zero: it was powered up again."""
    spread: float
    """s by which the stamp may be wrong to either side."""


class DeviceClock:
    """The clock that a device stamps its frames with: its counter unwrapped, resets and missing frames, and host time.

    A reset costs the map between the clocks, but not the delay of a frame, a property of the device and its cable.

    Parameters
    ----------
    tick : s per count.
    modulus : the counter wraps at this number of counts; 0 = it does not wrap.
    period : s between frames; None = learned from them.
    latency : s from a frame's stamp to its first byte at the host, at least, as long as it was not measured (`tie`).
    spread : s by which that may be wrong.
    proven : the unit of time is a fact of the protocol. Otherwise frames are stamped with their arrival until the clock
        has kept pace with the host's.
    """

    def __init__(
        self,
        tick: float,
        modulus: int = 0,
        *,
        period: float | None = None,
        latency: float = 0.0,
        spread: float = 0.0,
        proven: bool = True,
    ) -> None:
        self.tick, self.latency, self.tied, self.period = tick, latency, spread, period
        """s; `tied` is by how much the delay may be wrong."""
        self.proven, self._expected = proven, proven
        self.rate: float | None = None
        """Device seconds per host second where these disagree: frames are then stamped with their arrival."""
        self._unwrapper, self._map = Unwrapper(modulus, tick), ClockMap()
        self._last: float | None = None
        self._arrival = 0.0
        self._steps: deque[float] = deque(maxlen=_STEPS)
        self._half = tick / 2
        self._tie: tuple[float, float] | None = None
        """s, between which host time minus device time lay."""
        self._tied_at = 0.0
        """s, device time of the last reading that shows it."""
        self._windows: list[tuple[float, float]] = []
        self._witnesses = 0

    def tie(self, count: float, sent: float, answered: float) -> None:
        """Take a reading of the clock that the host asked for at `sent` and got at `answered`, s.

        The reading was made in between, and several narrow that down. The delay of the frames that follow is measured
        with it.
        """
        device, reset = self._unwrapper.unwrap(count, answered)
        expected = self._map.host(device) - self.latency
        if reset or (self._last is not None and not sent - LEAP < expected < answered + LEAP):
            self._begin_again()
        low, high = self._tie if self._tie and device - self._tied_at < TOGETHER else (-math.inf, math.inf)
        # Counts are whole: the reading was made up to half a count before or after its value.
        self._tie = max(low, sent - device - self._half), min(high, answered - device + self._half)
        self.tied, self._tied_at = max(self._half, (self._tie[1] - self._tie[0]) / 2), device

    def read(self, count: float, arrival: float) -> Reading:
        """Take a frame.

        Parameters
        ----------
        count : the frame's stamp, counts.
        arrival : s, of its first byte at the host.

        Returns
        -------
        Reading : `elapsed` is 0 for a frame sent twice.
        """
        device, reset = self._unwrapper.unwrap(count, arrival)
        # No frame arrives earlier than the quickest before it: a clock that is further ahead is one of another power-up.
        ahead = self._last is not None and self._expected and arrival - self._map.host(device) < -LEAP
        reset = reset or ahead
        if reset:
            self._begin_again()
        elapsed = None if self._last is None else device - self._last
        missing = self._missing(elapsed, arrival)
        self._arrival, self._last = arrival, device
        self._map.add(device, arrival)
        if not self._expected:
            trusted = self.proven
            self._check_rate(device, arrival, reset=reset)
            if self.proven and not trusted:  # damaged times of a clock that was not known yet would stay in the map
                self._map = ClockMap()
                self._map.add(device, arrival)
        self._learn_latency()
        known = self.proven and self.rate is None
        stamp = self._map.host(device) - self.latency if known else arrival
        return Reading(stamp, elapsed, missing, reset, self.tied + self._half + 2 * self._map.excess)

    def lateness(self, count: float, arrival: float) -> float | None:
        """Return how much later than the quickest frame one comes, s; below 0 = earlier; None = it cannot be said.

        Only for clocks that do not wrap, once they have kept pace with the host's.
        """
        known = self.proven and self.rate is None and self._last is not None and not self._unwrapper.modulus
        return arrival - self._map.host(count * self._unwrapper.tick) if known else None

    def _begin_again(self) -> None:
        self._map, self._last, self._tie = ClockMap(), None, None
        self._windows.clear()

    def _missing(self, elapsed: float | None, arrival: float) -> int:
        if elapsed is not None and self.rate is None and self.period is None and elapsed > 0:
            self._steps.append(elapsed)
        period = self.period or (median(self._steps) if len(self._steps) >= _FEWEST else math.inf)
        gap = arrival - self._arrival if self._arrival and elapsed is None else elapsed or 0.0
        return round(gap / period) - 1 if gap > GAP * period else 0

    def _learn_latency(self) -> None:
        """Measure the delay of frames: by how much the envelope of their arrivals lies behind the tie, at the tie's time."""
        if self._tie is not None:
            self.latency = max(0.0, self._map.host(self._tied_at) - self._tied_at - sum(self._tie) / 2)
            if self._map.full:
                self._tie = None

    def _check_rate(self, device: float, arrival: float, *, reset: bool) -> None:
        """Compare the pace of both clocks: the smallest delay of a window must be that of the one before."""
        delay = arrival - device
        if reset:
            # The unit may be so far off that every frame looks like another power-up.
            self._judge(math.inf)
        if self._windows and arrival < self._windows[-1][0] + RATE_WINDOW:
            begin, least = self._windows[-1]
            self._windows[-1] = begin, min(delay, least)
            return
        if len(self._windows) > 1:
            (since, before), (begin, last) = self._windows[-2:]
            self._judge(1 - (last - before) / (begin - since))
            del self._windows[0]
        self._windows.append((arrival, delay))

    def _judge(self, rate: float) -> None:
        wrong = abs(rate - 1) > WRONG_RATE
        self._witnesses = self._witnesses + 1 if wrong else 0
        if self._witnesses >= WITNESSES:
            self.rate = rate
        elif not wrong:
            self.rate, self.proven = None, True
