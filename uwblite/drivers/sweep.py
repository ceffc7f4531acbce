"""Turns of a spinning lidar become scans of one geometry.

A low-cost lidar measures at a fixed rate while its motor turns a little faster or slower, so that every turn has other
bearings and another number of samples. Here the samples of a turn are brought onto a fixed fan of rays: between two
neighbours on one surface 1/range is linear in the bearing (on a flat wall 1/r = cos(phi - alpha) / d, so that half a
degree of spacing costs 1e-5 of the range); where the range leaps, the nearer sample in bearing counts alone, so that no
point appears in the empty air between two surfaces. Rays run in the order of time: clockwise, as these lidars turn, with
ray i measured at stamp + i * time_increment.
"""

import math
from bisect import bisect_right
from dataclasses import dataclass

from .events import LaserScan

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
    """Collect readings with their times, give a scan for each whole turn.

    Parameters
    ----------
    fan : the rays of the scans.
    """

    def __init__(self, fan: Fan) -> None:
        self.fan = fan
        self.lost = 0
        """Turns too few of whose rays were seen, or with unknown times; the owner takes and clears it."""
        self._duration = 0.0
        self.clear()

    def clear(self) -> None:
        """Forget the turn at hand."""
        self._last: tuple[float, float] | None = None
        self._turned: list[float] = []
        self._times: list[float] = []
        self._bearings: list[float] = []
        self._ranges: list[float] = []
        self._begin: float | None = None
        self._before: tuple[float, float] | None = None

    def add(self, times: list[float], samples: Samples) -> list[LaserScan]:
        """Take readings made at times, s, host clock; return the scans of the turns that ended."""
        scans = []
        for time, turned, bearing, reach in zip(times, samples.turned, samples.bearings, samples.ranges, strict=True):
            if self._last is not None and turned < self._last[1] - BACKLASH:
                seam = self._seam(time, turned)
                scan = self._close(seam, (bearing + 1.0, reach))
                if scan is not None:
                    scans.append(scan)
                self._before = (self._bearings[-1] - 1.0, self._ranges[-1]) if self._bearings else None
                self._turned, self._times, self._bearings, self._ranges = [], [], [], []
                self._begin = seam
            self._last = (time, turned)
            self._turned.append(turned)
            self._times.append(time)
            self._bearings.append(bearing)
            self._ranges.append(reach)
        return scans

    def _seam(self, time: float, turned: float) -> float:
        """Return when the motor passed zero between the last reading and this one, s."""
        assert self._last is not None
        before, at = self._last
        return before + (time - before) * (1.0 - at) / (1.0 - at + turned) if turned + 1.0 > at else time

    def _close(self, end: float, after: tuple[float, float]) -> LaserScan | None:
        begin = self._begin
        if begin is None or len(self._turned) < 2 or end <= begin:
            return None
        fan, spacing = self.fan, 1.0 / self.fan.rays
        rays = sorted(zip(self._bearings, self._ranges, strict=True))
        rays = [*([self._before] if self._before else []), *rays, after]
        ranges, known = _resample(rays, fan.rays, spacing)
        uneven = max(abs(time - begin - turned * (end - begin)) for time, turned in zip(self._times, self._turned, strict=True))
        if known < LEAST_RAYS * fan.rays or uneven > UNEVEN * (end - begin):
            self.lost += 1
            return None
        # The reading that points at ray 0 is made a little before or after the motor passes zero.
        ahead = sum(t - b for t, b in zip(self._turned, self._bearings, strict=True)) / len(self._turned)
        duration = end - begin
        if abs(duration - self._duration) > STEADY * duration:
            self._duration = duration
        middle = 0.5 * (begin + end) + ahead * duration
        stamp, increments = middle - 0.5 * self._duration, (-2.0 * math.pi * spacing, self._duration * spacing)
        return LaserScan(stamp, tuple(ranges), 0.0, *increments, fan.range_max, fan.range_min)


def _resample(samples: list[tuple[float, float]], rays: int, spacing: float) -> tuple[list[float], int]:
    """Return the ranges, m, at the bearings 0, 1/rays ... turns, and how many rays lie between samples.

    Parameters
    ----------
    samples : (bearing, range), turns and m, sorted by bearing.
    rays : how many.
    spacing : of the rays, turns.
    """
    bearings = [bearing for bearing, _ in samples]
    ranges, known = [math.nan] * rays, 0
    for index in range(rays):
        at = index * spacing
        right = bisect_right(bearings, at)
        if right == 0 or right == len(samples):
            continue
        (b0, r0), (b1, r1) = samples[right - 1], samples[right]
        width = b1 - b0
        if width > GAP * spacing:
            continue
        known += 1
        share = (at - b0) / width if width > 0.0 else 0.0
        if abs(r1 - r0) <= max(NOISE, 2.0 * math.pi * width * min(r0, r1) / GRAZING):
            ranges[index] = 1.0 / ((1.0 - share) / r0 + share / r1)
        else:
            ranges[index] = r0 if share < 0.5 else r1
    return ranges, known
