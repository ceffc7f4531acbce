"""An emulated URG-04LX: SCIP 1.1 until commanded otherwise, then SCIP 2.0. Bytes in, bytes out, time brought by the caller."""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache

from .hokuyo import NAMES, Unit
from .world import Feed, Scan, WorldClock

LAST_ACCEPTED = 768
"""Step up to which a URG-04LX measures when asked."""


def checksum(text: bytes) -> bytes:
    """Return the sum character of a line."""
    return bytes([(sum(text) & 0x3F) + 0x30])


@lru_cache(1 << 14)
def encode(value: int, width: int) -> bytes:
    """Code a number in characters of six bits."""
    return bytes(((value >> 6 * i) & 0x3F) + 0x30 for i in reversed(range(width)))


def text_lines(pairs: list[tuple[str, str]]) -> list[bytes]:
    """Return ``KEY:value;sum`` lines; the semicolon is not summed."""
    return [body + b";" + checksum(body) for body in (f"{key}:{value}".encode() for key, value in pairs)]


def data_lines(data: bytes) -> list[bytes]:
    """Cut into lines of 64 characters, each with its sum."""
    return [data[i : i + 64] + checksum(data[i : i + 64]) for i in range(0, len(data), 64)]


VERSION = [
    ("VEND", "Hokuyo Automatic Co.,Ltd."), ("PROD", "SOKUIKI Sensor URG-04LX"), ("FIRM", "3.3.00(16/Apr./2008)"),
    ("PROT", "SCIP 2.0"), ("SERI", "H0700000"),
]  # fmt: skip
@dataclass
class ScipOptions:
    """How this unit behaves."""

    scip1: bool = False
    """Wake in SCIP 1.1."""
    clock_start: int = 0
    """ms on the device's clock at power-up; 16770000 wraps soon."""
    clock_skew: float = 0.0
    """Relative error of its crystal."""
    streaming: bool = False
    """A dead host left MD running."""
    wrong_sums: float = 0.0
    """Share of scans with one wrong sum."""
    duplicates: float = 0.0
    """Share of scans sent twice."""
    random: object = None
    """random.Random for the two shares."""
    serial: bool = False
    """It hangs on RS-232: bytes take their time, scans that do not fit are left out, and the host's bit rate must fit."""
    rates: tuple[int, ...] = (19200, 57600, 115200, 250000, 500000, 750000)
    """bit/s that SS grants."""
    unit: Unit = field(default_factory=Unit)
    """Which model, or which real unit."""


@dataclass
class Stream:
    """A running MD or MS."""

    echo: bytes
    start: int
    end: int
    cluster: int
    skip: int
    remaining: int | None
    wide: bool
    tail: bytes
    skipped: int = field(default=0)


class ScipDevice:
    """The unit.

    Parameters
    ----------
    scans : what it measures.
    clock : world time.
    options : behaviour.
    on_scan : called with (host time of the first ray, values sent) for each scan sent.
    """

    def __init__(self, scans: Iterator[Scan], clock: WorldClock, options: ScipOptions | None = None, on_scan=None) -> None:
        self.options = options or ScipOptions()
        self.unit = self.options.unit
        self._feed, self._clock = Feed(scans), clock
        self._on_scan = on_scan or (lambda *_: None)
        self._latest: Scan | None = None
        self.fault: int | None = None
        """Hardware status 21..97 to report instead of scans."""
        self.hung = False
        """Answers nothing until power is cycled."""
        self.power_up(0.0)

    def power_up(self, now: float) -> None:
        """Forget everything, as after plugging in."""
        self._power, self._now, self._input = now, now, bytearray()
        self._scip1, self._laser, self._adjusting = self.options.scip1, False, False
        self._stream: Stream | None = None
        self._fault_sent, self._last_command = None, b""
        self._speed_set, self._sensitive, self._rate = "00", False, 19200
        self.host_rate = 19200 if self.options.serial else None
        """bit/s that the host has set; None = it does not matter (USB)."""
        self._busy_until = now
        self.hung = False
        if self.options.streaming:
            self._laser, self._scip1 = True, False
            self._stream = Stream(b"MD0044072501000", 44, 725, 1, 0, None, True, b"")

    @property
    def _most(self) -> int:
        return max(LAST_ACCEPTED, self.unit.last)

    @property
    def is_streaming(self) -> bool:
        """Return whether MD or MS runs."""
        return self._stream is not None

    def device_ms(self, now: float) -> int:
        """Return the counter at host time `now`."""
        seconds = (now - self._power) * (1 + self.options.clock_skew)
        return (self.options.clock_start + math.floor(seconds * 1000)) & 0xFFFFFF

    # ---- time

    def next_time(self, now: float) -> float:
        """Return when `advance` has something to do, host s."""
        if self._feed.head is None:
            return math.inf
        return self._clock.host(self._feed.head.time) + self.unit.turn + self.unit.latency

    @property
    def rate(self) -> int | None:
        """Return the speed of its line, bit/s; None = that of USB."""
        return self._rate if self.options.serial else None

    def advance(self, now: float) -> bytes:
        """Return what the unit sends by itself up to host time `now`."""
        out, self._now = b"", now
        while self._feed.head is not None and self.next_time(now) <= now:
            self._latest = self._feed.pop()
            if self._stream is not None and not self.hung:
                out += self._stream_scan(self._latest, now)
        return out if self._understood() else b""

    def _understood(self) -> bool:
        return not self.options.serial or self.host_rate == self._rate

    def _stream_scan(self, scan: Scan, now: float) -> bytes:
        stream = self._stream
        assert stream is not None
        if self.fault is not None:
            if self._fault_sent == self.fault:
                return b""
            self._fault_sent = self.fault
            if self.fault >= 50:
                self._stream, self._laser = None, False
            return self._block(stream.echo, f"{self.fault:02d}")
        if self._fault_sent is not None and self._fault_sent < 50:
            self._fault_sent = None
            return self._block(stream.echo, "98")
        if stream.skipped < stream.skip:
            stream.skipped += 1
            return b""
        stream.skipped = 0
        if now < self._busy_until:
            return b""  # the line is still busy with the scan before
        remaining = 0
        if stream.remaining is not None:
            stream.remaining -= 1
            remaining = stream.remaining
        echo = stream.echo[:13] + f"{remaining:02d}".encode() + stream.tail
        frame = self._scan_block(echo, "99", scan, stream.start, stream.end, stream.cluster, stream.wide)
        if stream.remaining == 0:
            self._stream, self._laser = None, False
        self._busy_until = now + 10 * len(frame) / self._rate if self.options.serial else now
        return frame

    def _scan_block(self, echo: bytes, status: str, scan: Scan, start: int, end: int, cluster: int, wide: bool) -> bytes:
        # GD before the world began: the turn just over.
        first_ray = min(self._clock.host(scan.time), self._now - self.unit.turn)
        values = self._values(scan, start, end, cluster)
        self._on_scan(first_ray + max(0, start - self.unit.first) * self.unit.step_time, values)
        width = 3 if wide else 2
        data = b"".join([encode(value if wide else min(value, 4095), width) for value in values])
        time = encode(self.device_ms(first_ray), 4)
        lines = [time + checksum(time), *data_lines(data)]
        random = self.options.random
        if random and random.random() < self.options.wrong_sums:
            index = random.randrange(1, len(lines))
            lines[index] = lines[index][:-1] + bytes([0x30 + (lines[index][-1] - 0x2F) % 64])
        frame = self._block(echo, status, lines)
        return frame * 2 if random and random.random() < self.options.duplicates else frame

    def _values(self, scan: Scan, start: int, end: int, cluster: int) -> list[int]:
        """Merge steps: the smallest of each cluster, error codes ignored where there is a distance."""
        values, first = self.unit.values or scan.values, self.unit.first
        steps = [values[s - first] if 0 <= s - first < len(values) else 19 for s in range(start, end + 1)]
        if cluster == 1:
            return steps
        groups = [steps[i : i + cluster] for i in range(0, len(steps) - len(steps) % cluster, cluster)]
        return [min([v for v in group if v >= 20], default=group[0]) for group in groups]

    # ---- commands

    def receive(self, data: bytes, now: float) -> bytes:
        """Take bytes from the host and return the answer."""
        self._now = now
        if self.hung or not self._understood():
            return b""
        out = b""
        self._last_command = b""
        for byte in data:
            if byte in b"\r\n":
                line = bytes(self._input)
                self._input.clear()
                if line:
                    out += self._command(line, now)
            elif len(self._input) < 128:
                self._input.append(byte)
        return out

    def _command(self, line: bytes, now: float) -> bytes:
        repeated, self._last_command = line == self._last_command, line
        if self._scip1:
            return self._scip1_command(line)
        if repeated:
            return self._block(line, "0B")
        if line == b"SCIP2.0":
            return self._block(line, "0E")
        body, semicolon, tail = line.partition(b";")
        if semicolon and len(tail) > 16:
            return self._block(line, "0G")
        if semicolon and not re.fullmatch(rb"[A-Za-z0-9 ._+@]*", tail):
            return self._block(line, "0H")
        name = body[:2].decode("ascii", "replace")
        if self._adjusting and name != "TM":
            return self._block(line, "0E")
        handler = getattr(self, f"_do_{name}", None) if re.fullmatch(r"[A-Z]{2}", name) else None
        if handler is None:
            return self._block(line, "0E")
        return handler(line, body[2:].decode("ascii", "replace"), now)

    def _scip1_command(self, line: bytes) -> bytes:
        if line == b"SCIP2.0":
            self._scip1, self._laser = False, False
            return b"SCIP2.0\n0\n\n"
        if line == b"V":
            pairs = [*VERSION[:3], ("PROT", "SCIP 1.1"), VERSION[4]]
            return b"V\n0\n" + b"".join(f"{key}:{value};\n".encode() for key, value in pairs) + b"\n"
        if line in (b"L0", b"L1"):
            self._laser = line == b"L1"
            return line + b"\n0\n\n"
        ranges = re.fullmatch(rb"G(\d{3})(\d{3})(\d{2})", line)
        if ranges and self._laser and self._latest:
            start, end, cluster = (int(part) for part in ranges.groups())
            if start <= end <= self._most:
                values = self._values(self._latest, start, end, max(1, cluster))
                data = b"".join([encode(min(value, 4095), 2) for value in values])
                body = b"".join(data[i : i + 64] + b"\n" for i in range(0, len(data), 64))
                return line + b"\n0\n" + body + b"\n"
        return line + b"\nE\n\n"

    @staticmethod
    def _block(echo: bytes, status: str, lines: list[bytes] | None = None) -> bytes:
        code = status.encode()
        return b"\n".join([echo, code + checksum(code), *(lines or []), b"", b""])

    def _plain(self, line: bytes, rest: str, reply: bytes) -> bytes:
        return reply if not rest else self._block(line, "0E")

    def _do_VV(self, line: bytes, rest: str, now: float) -> bytes:
        product = f"SOKUIKI Sensor {self.unit.model}"
        version = self.unit.version or [(key, product if key == "PROD" else value) for key, value in VERSION]
        return self._plain(line, rest, self._answer(line, list(version)))

    def _do_PP(self, line: bytes, rest: str, now: float) -> bytes:
        model = ("MODL", f"{self.unit.model}(Hokuyo Automatic Co.,Ltd.)")
        return self._plain(line, rest, self._answer(line, [model, *zip(NAMES, map(str, self.unit.numbers), strict=True)]))

    def _answer(self, line: bytes, pairs: list[tuple[str, str]]) -> bytes:
        """Return what the captured unit answered, or lines of text."""
        return dict(self.unit.answers).get(line.decode("ascii", "replace")) or self._block(line, "00", text_lines(pairs))

    def _do_II(self, line: bytes, rest: str, now: float) -> bytes:
        healthy = self.fault is None or self.fault < 50
        state = text_lines([
            ("MODL", f"{self.unit.model}(Hokuyo Automatic Co.,Ltd.)"), ("LASR", "ON" if self._laser else "OFF"),
            ("SCSP", "Initial(600[rpm])<-Default setting by user"), ("MESM", "MEASURE" if self._stream else "IDLE"),
            ("SBPS", f"{self._rate}[bps]<-Default setting by user"), ("TIME", f"{self.device_ms(now):06X}"),
            ("STAT", "Sensor works well." if healthy else f"Sensor fault {self.fault}."),
        ])  # fmt: skip
        return self._plain(line, rest, self._block(line, "00", state))

    def _do_BM(self, line: bytes, rest: str, now: float) -> bytes:
        if rest:
            return self._block(line, "0E")
        if self.fault is not None and self.fault >= 50:
            return self._block(line, "01")
        status, self._laser = "02" if self._laser else "00", True
        return self._block(line, status)

    def _do_QT(self, line: bytes, rest: str, now: float) -> bytes:
        if rest:
            return self._block(line, "0E")
        self._laser, self._stream = False, None
        return self._block(line, "00")

    def _do_RS(self, line: bytes, rest: str, now: float) -> bytes:
        if rest:
            return self._block(line, "0E")
        self._laser, self._stream, self._power = False, None, now
        self._speed_set = "00"
        return self._block(line, "00")

    def _do_TM(self, line: bytes, rest: str, now: float) -> bytes:
        if rest == "0":
            status, self._adjusting = "02" if self._adjusting else "00", True
            self._laser, self._stream = False, None
            return self._block(line, status)
        if rest == "1":
            if not self._adjusting:
                return self._block(line, "04")
            time = encode(self.device_ms(now), 4)
            return self._block(line, "00", [time + checksum(time)])
        if rest == "2":
            status, self._adjusting = "00" if self._adjusting else "03", False
            return self._block(line, status)
        return self._block(line, "01")

    def _do_SS(self, line: bytes, rest: str, now: float) -> bytes:
        if not re.fullmatch(r"\d{6}", rest):
            return self._block(line, "01" if len(rest) == 6 else "0C")
        rate = int(rest)
        if rate not in self.options.rates:
            return self._block(line, "02")
        status, self._rate = "03" if rate == self._rate else "00", rate
        return self._block(line, status)  # at the old rate: the line has passed it on before the new one counts

    def _do_CR(self, line: bytes, rest: str, now: float) -> bytes:
        if not re.fullmatch(r"\d\d", rest):
            return self._block(line, "01" if len(rest) == 2 else "0C")
        if int(rest) > 10 and rest != "99":
            return self._block(line, "02")
        speed = "00" if rest == "99" else rest
        status, self._speed_set = "03" if speed == self._speed_set else "00", speed
        return self._block(line, status)

    def _do_HS(self, line: bytes, rest: str, now: float) -> bytes:
        if rest not in ("0", "1"):
            return self._block(line, "01" if len(rest) == 1 else "0C")
        status, self._sensitive = "02" if self._sensitive == (rest == "1") else "00", rest == "1"
        return self._block(line, status)

    def _steps(self, rest: str, length: int) -> str | tuple[int, int, int]:
        """Return the status of a refusal, or start, end and cluster."""
        if len(rest) != length:
            return "0C" if len(rest) < length else "0D"
        for status, part in (("01", rest[:4]), ("02", rest[4:8]), ("03", rest[8:10])):
            if not part.isdigit():
                return status
        start, end, cluster = int(rest[:4]), int(rest[4:8]), int(rest[8:10])
        if end > self._most:
            return "04"
        return "05" if end < start else (start, end, max(1, cluster))

    def _do_GD(self, line: bytes, rest: str, now: float) -> bytes:
        steps = self._steps(rest, 10)
        if isinstance(steps, str):
            return self._block(line, steps)
        if not self._laser:
            return self._block(line, "10")
        self._latest = self._latest or self._feed.head
        if self._latest is None:
            return self._block(line, "0A")
        return self._scan_block(line, "00", self._latest, *steps, wide=line[1:2] == b"D")

    _do_GS = _do_GD

    def _do_MD(self, line: bytes, rest: str, now: float) -> bytes:
        steps = self._steps(rest, 13)
        if isinstance(steps, str):
            return self._block(line, steps)
        if not rest[10].isdigit():
            return self._block(line, "06")
        if not rest[11:13].isdigit():
            return self._block(line, "07")
        count = int(rest[11:13])
        self._laser, self._fault_sent = True, None
        body, semicolon, tail = line.partition(b";")
        self._stream = Stream(
            body, *steps, int(rest[10]), count or None, line[1:2] == b"D", semicolon + tail if semicolon else b""
        )
        return self._block(line, "00")

    _do_MS = _do_MD
