"""An emulated DWM1001 tag with PANS R2: TLV and shell on one UART. Bytes in, bytes out, time brought by the caller."""

import math
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field

from .world import Epoch, Feed, WorldClock

REQUEST_GAP = 25 / 32768
"""s without a byte after which the firmware takes a TLV request as complete."""
BANNER = (
    "\r\n\r\n DWM1001 TWR Real Time Location System\r\n\r\n Copyright :  2016-2019 LEAPS and Decawave\r\n"
    " License   :  Please visit https://decawave.com/dwm1001_license\r\n Compiled  :  Mar 27 2019 03:35:59\r\n\r\n"
    " Help      :  ? or help\r\n\r\n"
)
HELP = """Usage: <command> [arg0] [arg1]
Build-in commands:
** Command group: Base **
?: this help
help: this help
quit: quit
** Command group: SYS **
f: show free memory on the heap
ps: show running threads
reset: reboot the system
si: system info
ut: show device uptime
frst: factory reset
** Command group: LE **
les: show distances to ranging anchors and the position
lec: show distances to ranging anchors and the position in CSV
lep: show position in CSV
** Command group: UWBMAC **
nmg: get node mode
nmt: set mode to tag
nmtl: set mode to tag, low power
nma: set mode to anchor
nmi: set mode to anchor initiator
nmo: set mode to passive offline
la: show anchor list
nis: set network id
** Command group: API **
tlv: send TLV frame
aurs: set update rates
aurg: get update rates
apg: get position
aps: set position
acts: configure node to tag with given options
acas: configure node to anchor with given options
"""


@dataclass
class DwmOptions:
    """How this module is set up."""

    short_id: int = 0x1512
    pan_id: int = 0xBACA
    shell: bool = False
    """Left in the shell by a dead host."""
    stream: str = ""
    """"les", "lec" or "lep": left running by a dead host."""
    stationary_detection: bool = False
    joined: bool = True
    anchor: bool = False
    """The module is an anchor, not a tag."""
    without_position: bool = False
    """Leave the position block out of loc_get."""
    status_bits: int = 0
    """Further bits of the status word, for example 16 for API_STATUS_FLAG_BH_INITIALIZED."""
    update: list[int] = field(default_factory=lambda: [1, 1])
    """Normal and stationary period in 0.1 s."""


class DwmDevice:
    """The module.

    Parameters
    ----------
    epochs : ranging rounds to play.
    clock : world time.
    options : set-up.
    on_fix : called with (host time, readings) for each fix.
    """

    def __init__(self, epochs: Iterator[Epoch], clock: WorldClock, options: DwmOptions | None = None, on_fix=None) -> None:
        self.options = options or DwmOptions()
        self._feed, self._clock = Feed(epochs), clock
        self._on_fix = on_fix or (lambda *_: None)
        self._position = [0, 0, 0, 0]
        self.silent = False
        self.asked = False
        """A host has asked for fixes since power-up."""
        self.power_up(0.0)

    def power_up(self, now: float) -> None:
        """Start again in generic mode, unless the options say otherwise."""
        self._power = now
        self._shell = self.options.shell or bool(self.options.stream)
        self._stream = self.options.stream
        self._line, self._repeat, self._after_return = "", "", False
        self._request, self._last_byte = bytearray(), now
        self._cr_at = -math.inf
        self._fix: Epoch | None = None
        self._ready = False
        self._reboot_at: float | None = None
        self.asked = bool(self._stream)

    # ---- time

    def next_time(self, now: float) -> float:
        """Return when `advance` has something to do, host s."""
        due = self._clock.host(self._feed.head.time) if self._feed.head is not None else math.inf
        if self._request:
            due = min(due, self._last_byte + REQUEST_GAP)
        return min(due, self._reboot_at) if self._reboot_at is not None else due

    def advance(self, now: float) -> bytes:
        """Return what the module sends by itself up to host time `now`."""
        out = b""
        if self._reboot_at is not None and now >= self._reboot_at:
            self.options.shell, self.options.stream = False, ""
            self.power_up(now)
        if self._request and now >= self._last_byte + REQUEST_GAP:
            out += self._close_request()
        while self._feed.head is not None and self._clock.host(self._feed.head.time) <= now:
            epoch = self._feed.pop()
            if not self.options.joined or self.options.anchor:
                continue
            self._fix, self._ready = epoch, True
            self._on_fix(self._clock.host(epoch.time), epoch.readings)
            if self._shell and self._stream:
                out += self._stream_line(self._stream).encode()
        return b"" if self.silent else out

    # ---- bytes

    def receive(self, data: bytes, now: float) -> bytes:
        """Take bytes from the host and return the answer."""
        if self.silent or self._reboot_at is not None:
            return b""
        out = b""
        for byte in data:
            out += self._shell_byte(byte, now) if self._shell else self._generic_byte(byte, now)
        return out

    def _generic_byte(self, byte: int, now: float) -> bytes:
        out = b""
        if self._request and now >= self._last_byte + REQUEST_GAP:
            out += self._close_request()
        self._last_byte = now
        if byte == 0x0D and bytes(self._request) in (b"", b"\r"):
            if now - self._cr_at < 1.0:
                self._cr_at = -math.inf
                self._request.clear()
                self._shell = True
                return out + (BANNER + "dwm> ").encode()
            self._cr_at = now
        self._request.append(byte)
        if len(self._request) >= 2 and len(self._request) == 2 + self._request[1]:
            request, self._request = bytes(self._request), bytearray()
            out += self._tlv(request[0], request[2:], now)
        return out

    def _close_request(self) -> bytes:
        """The gap closed a request that was not complete, such as a single CR."""
        self._request.clear()
        return b"\x40\x01\x01"

    # ---- TLV

    def _tlv(self, kind: int, value: bytes, now: float) -> bytes:
        body = self._tlv_body(kind, value, now)
        return bytes((0x40, 1, body)) if isinstance(body, int) else b"\x40\x01\x00" + body

    def _tlv_body(self, kind: int, value: bytes, now: float) -> int | bytes:
        """Return an error, or the blocks of a good answer."""
        options = self.options
        reads = {
            0x02: lambda: b"\x41\x0d" + struct.pack("<iiiB", *self._position),
            0x04: lambda: b"\x45\x04" + struct.pack("<HH", *options.update),
            0x08: lambda: b"\x46\x02" + self._config(),
            0x0C: self._loc_get,
            0x10: lambda: b"\x5f\x06" + bytes.fromhex("0a4e61aa8bfa"),
            0x12: lambda: b"\x4a\x01\x01",
            0x15: lambda: bytes.fromhex("5004 01000301 5104 00070100 5204 2a00cade"),
            0x2F: lambda: b"\x4d\x02" + struct.pack("<H", options.pan_id),
            0x30: lambda: b"\x4e\x08" + struct.pack("<Q", 0xDECADDF048950000 | options.short_id),
            0x32: self._status,
            0x35: lambda: b"\x47\x02\x00\x00",
        }  # fmt: skip
        if kind in reads:
            return 3 if value else reads[kind]()
        if kind == 0x01 and len(value) == 13:
            self._position = list(struct.unpack("<iiiB", value))
        elif kind == 0x03 and len(value) == 4:
            normal, stationary = struct.unpack("<HH", value)
            if not 1 <= normal <= stationary <= 1200 or normal > 600:
                return 3
            options.update = [normal, stationary]
        elif kind in (0x05, 0x07) and len(value) == 2:
            options.anchor = kind == 0x07
        elif kind == 0x0B and len(value) == 1:
            return 5 if not options.anchor else b"\x56\x01\x00"
        elif kind in (0x13, 0x14) and not value:
            self._reboot_at = now + 0.5
        elif kind == 0x2E and len(value) == 2:
            options.pan_id = struct.unpack("<H", value)[0]
        elif kind in (0x0A, 0x0F, 0x11, 0x34):
            return b""
        elif kind in (0x01, 0x03, 0x05, 0x07, 0x0B, 0x13, 0x14, 0x2E):
            return 3
        else:
            return 1
        return b""

    def _config(self) -> bytes:
        low = 0x40 | 0x10 | 0x08 | 0x02
        high = 0x20 if self.options.anchor else 0x04 if self.options.stationary_detection else 0
        return bytes((low, high))

    def _status(self) -> bytes:
        self.asked = True
        bits = int(self._ready) | (2 if self.options.joined else 0) | self.options.status_bits
        self._ready = False
        return b"\x5a\x02" + struct.pack("<H", bits)

    def _loc_get(self) -> bytes:
        self.asked = True
        position = b"" if self.options.without_position else b"\x41\x0d" + struct.pack("<iiiB", *self._position)
        readings = self._fix.readings if self._fix else []
        if self.options.anchor:
            rows = b"".join(struct.pack("<QIB", 0xDECA000000000000 | a, d, q) for a, d, q in readings)
            return position + bytes((0x48, 1 + len(rows), len(readings))) + rows
        rows = b"".join(struct.pack("<HIBiiiB", a, d, q, 0, 0, 0, 100) for a, d, q in readings)
        return position + bytes((0x49, 1 + len(rows), len(readings))) + rows

    # ---- shell

    def _shell_byte(self, byte: int, now: float) -> bytes:
        after_return, self._after_return = self._after_return, byte == 0x0D
        if byte == 0x0D or (byte == 0x0A and not after_return):
            line, self._line = self._line.strip() or self._repeat, ""
            self._repeat = line
            return b"\r\n" + self._run(line, now).encode()
        if byte == 0x0A:
            return b""  # the second half of CR LF
        if byte in (0x08, 0x7F):
            self._line = self._line[:-1]
            return b"\b \b"
        char = chr(byte)
        if len(self._line) < 120:
            self._line += char
        return bytes([byte])

    def _run(self, line: str, now: float) -> str:
        words = line.split()
        if not words:
            return "dwm> "
        if words[0] == "quit":
            self._shell, self._repeat = False, ""
            return ""
        if words[0] in ("reset", "frst", "nmt", "nmtl", "nma", "nmi", "nmp", "nmo"):
            self._reboot_at = now + 0.5
            if words[0].startswith("nm"):
                self.options.anchor = words[0] in ("nma", "nmi")
            return ""
        if words[0] in ("les", "lec", "lep"):
            self._stream = "" if self._stream == words[0] else words[0]
            self.asked = True
            return "dwm> "
        return self._text(words, now).replace("\n", "\r\n") + "dwm> "

    def _text(self, words: list[str], now: float) -> str:
        options = self.options
        up = now - self._power
        head = f"[{int(up):06d}.{int(up * 1000) % 1000 // 10 * 10:03d} INF] "
        mode = "an (act,-,-)" if options.anchor else "tn (act,twr,np,le)"
        name = words[0]
        if name in ("?", "help"):
            return HELP
        if name == "si":
            rows = [
                "sys: fw2 fw_ver=x01030001 cfg_ver=x00010700",
                f"uwb0: panid=x{options.pan_id:04X} addr=xDECADDF04895{options.short_id:04X}",
                f"mode: {mode}",
                f"uwbmac: {'connected' if options.joined else 'disconnected'}",
                "uwbmac: bh disconnected",
                f"cfg: sync=0 fwup=0 ble=1 leds=1 le=1 lp=0 stat_det={int(options.stationary_detection)}"
                f"{' (sens=1)' if options.stationary_detection else ''} mode=0 upd_rate_norm={options.update[0]}"
                f" upd_rate_stat={options.update[1]} label=DW{options.short_id:04X}",
                "enc: off",
                "ble: addr=FA:8B:AA:61:4E:0A",
            ]
            return "".join(f"{head}{row}\n" for row in rows)
        if name == "nmg":
            return f"mode: {mode}\n"
        if name == "ut":
            h, m, s = int(up // 3600), int(up // 60) % 60, up % 60
            return f"{head}uptime: {h:02d}:{m:02d}:{s:06.3f} {h // 24} days ({int(up * 1000)} ms)\n"
        if name == "la":
            return f"{head}AN: cnt=0 seq=x00\n"
        if name == "aurg":
            return f"err code: 0, upd rate: {options.update[0]}, {options.update[1]}(stat)\n"
        if name == "aurs" and len(words) == 3 and all(re.fullmatch(r"\d+", w) for w in words[1:]):
            options.update = [int(w) for w in words[1:]]
            return "err code: 0\n"
        if name == "apg":
            x, y, z, q = self._position
            return f"x:{x} y:{y} z:{z} qf:{q}\n"
        if name == "aps" and len(words) == 4 and all(re.fullmatch(r"-?\d+", w) for w in words[1:]):
            self._position = [*(int(w) for w in words[1:]), 100]
            return "err code: 0\n"
        if name == "scs":
            return "ok\n"
        if name == "scg":
            return "sensitivity=1\n"
        if name == "nis" and len(words) == 2:
            options.pan_id = int(words[1], 16) & 0xFFFF if words[1].startswith("0x") else 0
            return "ok\n"
        if name == "acts":
            if len(words) == 10:
                options.stationary_detection = words[2] == "1"
                return "err code: 0\n"
            return "usage: acts <meas_mode> <accel_en> <low_pwr> <loc_en> <enc> <leds> <ble> <uwb> <fw_upd>\n"
        if name == "tlv" and len(words) >= 3 and all(re.fullmatch(r"(0x)?[0-9a-fA-F]+", w) for w in words[1:]):
            numbers = [int(w, 0) & 0xFF if w.startswith("0x") or w.isdigit() else int(w, 16) & 0xFF for w in words[1:]]
            answer = self._tlv(numbers[0], bytes(numbers[2 : 2 + numbers[1]]), now)
            return f"OUTPUT FRAME:\n{' '.join(f'{b:02x}' for b in answer)}\n"
        return f"{name}: unknown command\n"

    def _stream_line(self, kind: str) -> str:
        assert self._fix is not None
        rows = [(f"{a:04X}", d / 1000, q) for a, d, q in self._fix.readings]
        x, y, z, quality = (*(v / 1000 for v in self._position[:3]), self._position[3])
        fixed = len(rows) >= 3
        if kind == "lep":
            return f"POS,{x:.2f},{y:.2f},{z:.2f},{quality}\r\n"
        if kind == "lec":
            text = f"DIST,{len(rows)}" + "".join(f",AN{i},{a},0.00,0.00,0.00,{d:.2f}" for i, (a, d, _) in enumerate(rows))
            return text + (f",POS,{x:.2f},{y:.2f},{z:.2f},{quality}" if fixed else "") + "\r\n"
        text = "".join(f"{a}[0.00,0.00,0.00]={d:.2f} " for a, d, _ in rows)
        return text + "le_us=3387 " + (f"est[{x:.2f},{y:.2f},{z:.2f},{quality}] " if fixed else "") + "\r\n"
