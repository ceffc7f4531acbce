"""Start-up, streaming and recovery of a URG-04LX, without a port: what to send next, given replies and time.

The order is that of drivers that survived the field: drain, QT (twice, a single one may be ignored), out of SCIP 1.1 or
the time-adjust mode where the answer says so, VV, PP, a few TM1 to tie the device clock to the host's, MD without end.
Only commands that every URG-04LX knows are sent; others can hang it until its power is cycled.

Time of a scan. The device stamps the first step of its field of view (the specification leaves open whether it means
step 0, which would be 4.3 ms earlier); a scan arrives after its sweep. The lower envelope of arrivals follows the
device clock up to that constant delay, and TM1 measures the constant: the clock read during the time-adjust mode lies
between request and reply.
"""

import math

from ..errors import ProtocolError
from .clock import ClockMap, Unwrapper
from .events import Action, Corrupt, LaserScan, Lost, Note, Param, Reopen, Send, SetBaud
from .scip import TIME_MODULUS, Distances, Reply, ScipProtocol
from .scip_codes import status_meaning
from .scip_commands import BAUD_RATES, Geometry, parse_geometry, scan_command, text_command, to_ranges

DRAIN = 0.25
"""s to wait for silence before the first word."""
PATIENCE = 0.4
"""s to wait for an answer."""
TIME_READS = 8
LATENCY_LEARNING = 3.0
"""s of streaming during which the delay of a scan is measured; device and host clocks drift less than 1 ms in it."""
NOISE_PATIENCE = 10.0
"""s of nothing but damaged scans after which the laser is started again all the same."""
MAX_ROUNDS = 3
"""Full start-ups without an answer before the port is opened anew."""


class ScipSession:
    """One URG-04LX; see `events.Session` for the methods.

    Parameters
    ----------
    start, end : first and last step; None = the unit's own limits.
    cluster, skip : as in `scip.scan_command`.
    wide : three characters a value; False: two, for slow RS-232.
    baud : bit/s to begin with; other rates are tried when nothing answers.
    stream : False: stop after VV, PP and II (for a look at what is plugged in).
    """

    def __init__(
        self, start: int | None = None, end: int | None = None, *, cluster: int = 1, skip: int = 0, wide: bool = True,
        baud: int = BAUD_RATES[0], stream: bool = True,
    ) -> None:  # fmt: skip
        self.baud = baud
        self.geometry = Geometry()
        self.identity: dict[str, str] = {}
        self.ready = False
        self._start, self._end, self._cluster, self._skip, self._wide = start, end, max(1, cluster), skip, wide
        self._stream = stream
        self._rates = [baud, *(rate for rate in BAUD_RATES if rate != baud)]
        self._told: set[str] = set()
        self._reset(0.0)

    def _reset(self, now: float) -> None:
        self._protocol = ScipProtocol()
        self._step, self._sent, self._tries, self._rounds = "drain", now, 0, 0
        self._due: float | None = now + DRAIN
        self._rate_index, self._good = 0, now
        self._tm_reads: list[tuple[float, float]] = []
        self._tm_count = 0
        self._new_clock()

    def _new_clock(self) -> None:
        self._clock, self._map = Unwrapper(TIME_MODULUS, 1e-3), ClockMap()
        self._tm_offset: float | None = None
        self._latency: float | None = None
        self._first_scan: float | None = None
        self._last_time: float | None = None

    # ---- the session interface

    def start(self, now: float) -> list[Action]:
        """Begin, or begin again after a reconnect, at time `now`, s."""
        self._reset(now)
        return []

    def deadline(self) -> float | None:
        """Return when `tick` is due, s."""
        return self._due

    def stop(self) -> list[Action]:
        """Return what switches the laser off and ends the stream."""
        return [Send(text_command("QT"))]

    def tick(self, now: float) -> list[Action]:
        """Do what is due: the first word after draining, or a repetition when no answer came."""
        if self._due is None or now < self._due:
            return []
        if self._step == "drain":
            return self._say("QT", now)
        if self._step == "stream":
            return self._restart(now, "no scan for too long")
        if self._step == "pause":
            return self._go("drain", now)
        self._tries += 1
        if self._step == "QT":
            return self._no_answer(now)
        if self._tries < 2:
            return self._repeat(now)
        if self._step in ("VV", "II"):
            return self._next(now)
        if self._step.startswith("TM"):
            return self._leave_time_mode(now)
        return self._restart(now, f"no answer to {self._step}")

    def feed(self, data: bytes, now: float) -> list[Action]:
        """Take bytes that arrived at time `now`, s."""
        actions: list[Action] = []
        for event in self._protocol.feed(data, now):
            if isinstance(event, Corrupt):
                actions.append(event)
                if self._step == "stream" and self._due is not None:
                    # Scans come, but damaged: starting the laser again would only lose more of them.
                    self._due = max(self._due, min(now + 1.0, self._good + NOISE_PATIENCE))
            elif isinstance(event, Distances):
                actions += self._scan(event)
            else:
                actions += self._reply(event, now)
        return actions

    # ---- steps

    def _say(self, command: str, now: float) -> list[Action]:
        self._step, self._due, self._sent, self._tries = command, now + PATIENCE, now, 0
        return [Send(text_command(command))]

    def _repeat(self, now: float) -> list[Action]:
        self._due, self._sent = now + PATIENCE, now
        return [Send(self._stream_request() if self._step == "MD" else text_command(self._step))]

    def _go(self, step: str, now: float, wait: float = DRAIN) -> list[Action]:
        self._step, self._due, self._tries = step, now + wait, 0
        return []

    def _restart(self, now: float, why: str) -> list[Action]:
        self._rounds += 1
        self.ready = False
        self._new_clock()
        note = Note("warning", "lidar-restart", f"lidar: {why}; starting it again")
        if self._rounds > MAX_ROUNDS:
            return [note, Reopen(why)]
        return [note, *self._go("drain", now)]

    def _no_answer(self, now: float) -> list[Action]:
        if self._tries < 2:
            return self._repeat(now)
        self._rate_index = (self._rate_index + 1) % len(self._rates)
        if self._rate_index == 0:
            self._rounds += 1
            text = (
                "lidar: no answer at any bit rate. Unplug it and plug it in again (about one power-up in ten needs that),"
                " check its 5 V supply, and that no other program has the port"
            )
            return [*self._tell("error", "lidar-silent", text), Reopen("no answer at any bit rate")]
        rate = self._rates[self._rate_index]
        self._step, self._due, self._sent, self._tries = "QT", now + PATIENCE, now, 0
        return [SetBaud(rate), Send(text_command("QT"))]

    def _tell(self, level: str, name: str, text: str) -> list[Action]:
        """Say a thing once."""
        if name in self._told:
            return []
        self._told.add(name)
        return [Note(level, name, text)]

    def _stream_request(self) -> bytes:
        unit = self.geometry
        first = unit.first if self._start is None else self._start
        last = unit.last if self._end is None else self._end
        return scan_command(first, last, cluster=self._cluster, skip=self._skip, wide=self._wide, geometry=unit)

    def _next(self, now: float) -> list[Action]:
        """Go on to the step after the present one."""
        if self._step == "QT":
            return self._say("VV", now)
        if self._step == "VV":
            return self._say("PP", now)
        if self._step == "PP":
            if not self._stream:
                return self._say("II", now)
            self._tm_reads, self._tm_count = [], 0
            return self._say("TM0", now)
        if self._step == "II":
            self.ready = True
            self._step, self._due = "done", None
            return []
        self._step, self._due, self._sent, self._tries = "MD", now + 2 * PATIENCE, now, 0
        return [Send(self._stream_request())]

    def _leave_time_mode(self, now: float) -> list[Action]:
        if self._step == "TM2":
            return self._next(now)
        return self._say("TM2", now)

    # ---- replies

    def _reply(self, reply: Reply, now: float) -> list[Action]:
        kind, text = status_meaning(reply.command, reply.status)
        if reply.command[:1] in "GM":
            return self._stream_status(reply, kind, text, now)
        if reply.command != self._step:
            return self._late_lines(reply)
        if kind == "scip1" and reply.command == "SCIP2.0":
            text = "lidar: it speaks SCIP 1.1 only; its firmware (before 3.0) needs the maker's update to SCIP 2.0"
            return [*self._tell("error", "lidar-scip1-only", text), Reopen("SCIP 1.1 only")]
        if kind == "scip1":
            note = self._tell("info", "lidar-scip1", "lidar: it woke in SCIP 1.1; switched to SCIP 2.0")
            return [*note, *self._say("SCIP2.0", now)]
        if reply.command == "SCIP2.0":
            return self._say("QT", now)  # 0E means that it spoke SCIP 2 already
        if reply.command == "QT":
            if reply.status == "0E":
                self._step = "TM0"
                return self._leave_time_mode(now)
            return self._next(now)
        if reply.command in ("VV", "PP", "II"):
            return self._identity(reply, kind, now)
        return self._time_reply(reply, kind, now)

    def _late_lines(self, reply: Reply) -> list[Action]:
        """VV of some units comes in two pieces."""
        self.identity.update(reply.fields())
        return []

    def _identity(self, reply: Reply, kind: str, now: float) -> list[Action]:
        actions: list[Action] = []
        if kind == "ok":
            self.identity.update(reply.fields())
        if reply.command == "VV":
            actions += [
                Param(f"laser_{name}", self.identity[key].replace(" ", "_"))
                for name, key in (("product", "PROD"), ("firmware", "FIRM"), ("serial", "SERI"))
                if key in self.identity
            ]
        if reply.command == "PP":
            try:
                self.geometry = parse_geometry(reply)
            except ProtocolError as error:
                if self._tries < 1:
                    self._tries = 1
                    return [*actions, *self._repeat(now)]
                self.geometry = Geometry()
                text = f"lidar: {error}; going on with the limits of a URG-04LX"
                actions += self._tell("warning", "lidar-parameters", text)
            self._stream_request()  # a range of steps that the unit does not have is the user's mistake: say so now
        return [*actions, *self._next(now)]

    def _time_reply(self, reply: Reply, kind: str, now: float) -> list[Action]:
        if reply.command == "TM1" and kind == "ok" and reply.lines:
            device, _ = self._clock.unwrap(int(reply.lines[0]), reply.stamp)
            self._tm_reads.append((reply.stamp - self._sent, (self._sent + reply.stamp) / 2 - device - 0.0005))
            self._tm_count += 1
            if self._tm_count < TIME_READS:
                return self._say("TM1", now)
        elif reply.command == "TM0" and kind == "ok":
            return self._say("TM1", now)
        elif reply.command == "TM2":
            if self._tm_reads:
                self._tm_offset = min(self._tm_reads)[1]
            return self._next(now)
        return self._leave_time_mode(now)

    def _stream_status(self, reply: Reply, kind: str, text: str, now: float) -> list[Action]:
        if kind == "paused":
            self._due = now + 10.0
            return [Note("warning", "lidar-paused", f"lidar: {text}")]
        if kind == "resumed":
            self._due = now + 2.0
            return [Note("info", "lidar-resumed", f"lidar: {text}")]
        if kind == "hardware-fault":
            self._go("pause", now, 2.0)
            self.ready = False
            return [Note("error", "lidar-hardware-fault", f"lidar: {text}; trying again")]
        if self._step != "MD":
            return []
        if kind == "ok":
            self._step, self._due = "stream", now + 2.0
            self.ready = True
            return []
        return self._restart(now, f"{reply.command[:2]} refused, {text}")

    # ---- scans

    def _scan(self, scan: Distances) -> list[Action]:
        if self._step not in ("stream", "MD") or scan.command[0] != "M":
            return []  # the stream of a dead host, still draining
        # Stamps are truncated to 1 ms: half a millisecond makes them unbiased.
        device, reset = self._clock.unwrap(scan.time, scan.stamp)
        device += 0.0005
        period = self.geometry.period * (self._skip + 1)
        self._good = scan.stamp
        self._step, self._due, self._rounds = "stream", scan.stamp + max(1.0, 5 * period), 0
        actions: list[Action] = []
        if reset:
            self._new_clock()
            device = self._clock.unwrap(scan.time, scan.stamp)[0] + 0.0005
            actions.append(Note("warning", "lidar-clock-reset", "lidar: its clock was reset; time mapping starts anew"))
        last, self._last_time = self._last_time, device
        if last is not None:
            if device - last < 0.5 * period:
                return [*actions, Corrupt(b"", "scan sent twice")]
            missing = round((device - last) / period) - 1
            if missing > 0:
                actions.append(Lost(self._stamp(device, scan), missing))
        actions.append(self._laser_scan(scan, self._stamp(device, scan)))
        return actions

    def _stamp(self, device: float, scan: Distances) -> float:
        """Return the host time of the scan's first ray."""
        if self._first_scan is None or self._latency is None:
            self._first_scan = device
            self._latency = math.inf if self._tm_offset is not None else self._nominal_latency(scan)
        if self._tm_offset is not None and device - self._first_scan < LATENCY_LEARNING:
            delay = scan.stamp - device - self._tm_offset
            self._latency = max(0.0, min(self._latency, delay))
        self._map.add(device, scan.stamp)
        return self._map.host(device) - self._latency + (scan.start - self.geometry.first) * self.geometry.step_time

    def _nominal_latency(self, scan: Distances) -> float:
        """Without TM1: a scan is sent when its last step is measured."""
        return (scan.end - self.geometry.first + 1) * self.geometry.step_time

    def _laser_scan(self, scan: Distances, stamp: float) -> LaserScan:
        unit = self.geometry
        limit = None if scan.command[1] == "D" else 4095
        merge = (scan.cluster - 1) / 2
        return LaserScan(
            stamp,
            to_ranges(scan.values, unit, limit),
            (scan.start + merge - unit.front) * unit.step_angle,
            unit.step_angle * scan.cluster,
            unit.step_time * scan.cluster,
            min(unit.distance_max, limit or unit.distance_max) / 1000,
            unit.distance_min / 1000,
        )
