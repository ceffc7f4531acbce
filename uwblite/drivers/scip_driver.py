"""Scans of a Hokuyo: streaming, slow lines and recovery; `scip_unit` finds it.

Time of a scan. The device stamps the first step of its field of view (the specification leaves open whether it means
step 0, which would be 4.3 ms earlier). A scan arrives after its turn: the lower envelope of arrivals follows the device
clock up to that constant delay, and TM1 measures the constant, since the clock read in the time-adjust mode lies between
request and reply.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from ..clocks.device_clock import Reading
from .continuity import Continuity, device_time
from .events import Action, Corrupt, LaserScan, Lost, Note, Reopen, Send, SetBaud
from .scip import TIME_MODULUS, Distances, Reply
from .scip_commands import BAUD_RATES, ScanRequest, status_meaning, to_ranges
from .scip_unit import PATIENCE, SETTLE, TRUNCATION, ScipUnit
from .session import Identity, Script, Wait

SCAN_PATIENCE = 1.0
"""s without a scan, or ten periods, after which the laser is started again."""
FIRST_PATIENCE = 3.0
"""s for the first scan, which takes 1.1 s on a line of 19200 bit/s."""
NOISE_PATIENCE = 10.0
"""s of nothing but damaged scans after which the laser is started again all the same."""
PAUSE_PATIENCE = 10.0
"""s for which a unit may verify itself."""
FAULT_PAUSE = 2.0
"""s before a unit with a hardware fault is tried again."""
MAX_ROUNDS = 3
"""Starts without a scan before the port is opened again."""
FULL_LINE = 0.92
"""Share of a period that a scan may take on the line; above, the unit leaves scans out."""
FAST_RATES = (500000, 250000, 750000, 115200, 57600)
"""bit/s to raise an RS-232 line to, in the order tried."""
MAX_SKIP = 9
NARROW = 4095
"""mm, the largest reading of two characters."""


class ScipDriver(ScipUnit):
    """One lidar with SCIP 2.0; without `stream` it stops after VV, PP and II, for a look at what is plugged in.

    What does not fit the line is asked for less often; where nothing answers at `baud`, other rates are tried.
    """

    def __init__(self, request: ScanRequest | None = None, baud: int = BAUD_RATES[0], *, stream: bool = True) -> None:
        super().__init__(baud)
        self._scans, self._stream = request or ScanRequest(), stream
        self._rates_tried: set[int] = set()
        self._rounds = 0
        self._greeted = False
        """It is known how to read its scans, also those that come late, while it is started again."""
        self._series = Continuity(_follows, "scan whose time", summed=True)

    def stop(self) -> list[Action]:
        return [*self._series.unconfirmed(), Send(b"QT\n")]

    def script(self) -> Script[None]:
        """Find the unit, learn who it is, and read scans; begin again when none come."""
        self._rounds = 0
        while True:
            if not (yield from self._find()):
                continue
            yield from self._greet()
            self._scans.command(self.geometry)  # steps that the unit does not have are the user's mistake: say so now
            self.ready = self._greeted = True
            if not self._stream:
                return
            yield from self._tie_clock()
            why = yield from self._read_scans()
            self.ready = False
            self._rounds += 1
            if why:
                yield Note("warning", "lidar-restart", f"lidar: {why}; starting it again")
            if self._rounds > MAX_ROUNDS:
                self._rounds = 0
                yield Reopen("the laser does not start")

    # ---- scans

    @property
    def period(self) -> float:
        """Time between scans that are sent, s."""
        return self.geometry.period * (self._scans.skip + 1)

    def _read_scans(self) -> Script[str]:
        """Stream until something is wrong; return what, "" where it was reported already."""
        refusal = yield from self._begin_stream()
        if refusal:
            return refusal
        good, why = self.now, ""
        until = self.now + max(FIRST_PATIENCE, 20 * self.period)
        durations: list[float] = []  # s that each scan took on the line
        while (event := (yield Wait(until))) is not None:
            if isinstance(event, Corrupt):
                # Scans come, but damaged: starting the laser again would only lose more of them.
                until = max(until, min(self.now + SCAN_PATIENCE, good + NOISE_PATIENCE))
            elif isinstance(event, Distances) and event.command[0] == "M":
                good, why, self._rounds = self.now, "", 0
                durations.append(self.now - event.stamp)
                until = self.now + max(SCAN_PATIENCE, 10 * self.period, 3 * durations[-1])
                if len(durations) == 2 and (yield from self._fit_line(min(durations))):
                    return ""
            elif isinstance(event, Reply) and event.command[0] == "M":
                kind, text = status_meaning(event.command, event.status)
                until = self.now + (PAUSE_PATIENCE if kind == "paused" else 2 * SCAN_PATIENCE)
                if kind == "hardware-fault":
                    yield Note("error", "lidar-hardware-fault", f"lidar: {text}; trying again")
                    yield from self.sleep(FAULT_PAUSE)
                    self._rounds = -1
                    return ""
                if kind == "refused":
                    why = f"it broke the stream off, {text}"
                if kind in ("paused", "resumed"):
                    yield Note("warning" if kind == "paused" else "info", f"lidar-{kind}", f"lidar: {text}")
        return why or "no scan for too long"

    def _begin_stream(self) -> Script[str]:
        self._clock.period = self.period

        def answers(event: Any) -> bool:
            return isinstance(event, Reply) and event.command[:1] == "M"

        reply = yield from self.ask(self._scans.command(self.geometry), answers, 2 * PATIENCE, 2)
        if reply is None:
            return "no answer to MD"
        kind, text = status_meaning(reply.command, reply.status)
        return f"{reply.command[:2]} refused, {text}" if kind == "refused" else ""

    def _fit_line(self, seconds: float) -> Script[bool]:
        """Make scans fit the line, one of which took so long on it; True: the stream must begin again."""
        if seconds <= FULL_LINE * self.period:
            return False
        yield from self._request("QT")
        carried = 1 / seconds
        if (yield from self._raise_rate()):
            return True
        periods = seconds / FULL_LINE / self.geometry.period
        wide = self._scans.wide and periods <= MAX_SKIP + 1
        periods *= 1.0 if wide == self._scans.wide else 2 / 3
        self._scans = replace(self._scans, wide=wide, skip=min(MAX_SKIP, math.ceil(periods) - 1))
        text = (
            f"lidar: this line carries {carried:.1f} of {1 / self.geometry.period:.0f} scans a second; asking for one in"
            f" {self._scans.skip + 1}{'' if wide else ', up to 4.1 m'}. On RS-232 use USB or a faster port, or fewer `steps`"
        )
        yield from self.say_once(Note("warning", "lidar-slow-line", text))
        return True

    def _raise_rate(self) -> Script[bool]:
        """Let the unit and the port talk faster, where both can."""
        for rate in FAST_RATES:
            if rate <= self.baud or rate in self._rates_tried:
                continue
            self._rates_tried.add(rate)  # until it has proved itself
            command = f"SS{rate:06d}\n".encode()
            reply = yield from self.ask(command, lambda e: isinstance(e, Reply) and e.command[:2] == "SS", PATIENCE)
            if reply is None or status_meaning("SS", reply.status)[0] != "ok":
                continue
            yield SetBaud(rate)
            yield from self.sleep(SETTLE)
            if (yield from self._request("QT")) is None:
                yield SetBaud(self.baud)
                continue
            text = f"lidar: scans did not fit a line of {self.baud} bit/s; it now runs at {rate}"
            self.baud = rate
            self._rates_tried.discard(rate)
            yield Note("info", "lidar-faster-line", text)
            return True
        return False

    def take(self, event: Any) -> list[Action]:
        is_scan = isinstance(event, Distances) and event.command[0] == "M"
        return self._series.confirmed(event, 1, self._timed) if is_scan and self._greeted else []

    def _timed(self, scan: Distances) -> Iterator[Action]:
        """Log a scan. One whose time leaps, and the first, count only if the next one goes on from it."""
        reading = self._clock.read(scan.time + TRUNCATION, scan.stamp)
        if reading.reset:
            yield Note("warning", "lidar-clock-reset", "lidar: its clock was reset; time mapping starts again")
        if reading.elapsed is not None and reading.elapsed < 0.5 * self.period:
            yield Corrupt("scan sent twice")
            return
        if reading.missing:
            yield Lost(reading.missing)
        yield self._laser_scan(scan, reading)

    def _laser_scan(self, scan: Distances, reading: Reading) -> LaserScan:
        unit = self.geometry
        limit = None if scan.command[1] == "D" else NARROW
        merge = (scan.cluster - 1) / 2
        return LaserScan(
            reading.stamp + (scan.start - unit.first) * unit.step_time,
            to_ranges(scan.values, unit, limit),
            (scan.start + merge - unit.front) * unit.step_angle,
            unit.step_angle * scan.cluster,
            unit.step_time * scan.cluster,
            min(unit.distance_max, limit or unit.distance_max) / 1000,
            unit.distance_min / 1000,
            reading.spread,
        )

    # ---- for people

    def identity(self) -> Identity:
        unit, facts, findings = self.geometry, self.facts, []
        fields = (("firmware", "FIRM"), ("serial", "SERI"), ("laser", "LASR"), ("state", "STAT"))
        details = [(name, facts[key]) for name, key in fields if key in facts]
        details.append(("range", f"{unit.distance_min / 1000:.2f} to {unit.distance_max / 1000:.2f} m"))
        details.append(("steps", f"{unit.first} to {unit.last}, {unit.speed} rev/min"))
        if facts.get("LASR") == "OFF":
            text = "the laser is off, as it should be now; a recording switches it on"
            findings.append(Note("info", "laser-off", text))
        state = facts.get("STAT")
        if state is None:
            findings.append(Note("warning", "lidar-state", "it does not say how it is (no answer to II): try again"))
        elif "works well" not in state and "stable" not in state.lower():
            text = f"it reports {state!r}: power it down and up; if that stays, it needs service"
            findings.append(Note("error", "lidar-state", text))
        return Identity(f"{self.title} {facts.get('MODL', unit.model).partition('(')[0]}", tuple(details), tuple(findings))


def _follows(before: Distances, after: Distances) -> bool:
    """Return whether the clock can have gone on so; sums of six bits pass one in 64 damaged lines."""
    return device_time((after.time - before.time) * 1e-3, after.stamp - before.stamp, TIME_MODULUS * 1e-3) is not None
