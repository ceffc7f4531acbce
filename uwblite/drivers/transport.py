"""Ports by URL, and those of this computer; pyserial, which only this file knows, is imported when a port is first opened.

``/dev/ttyACM0`` or a path in ``/dev/serial/by-id`` opens a port, ``socket://host:port`` a bridge (ser2net, an emulator),
``loop://`` a port that receives what it sends. Reads never block.
"""

import contextlib
import os
import select
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import urlsplit

from ..errors import ConfigError, DeviceError

CHUNK = 8192
"""Bytes read at once: a device that floods its port holds up the others for milliseconds only."""
CONNECT_TIMEOUT = 5.0
"""s for a TCP connection to come about."""
WRITE_TIMEOUT = 1.0
"""s for which ports that are no files may hold up a write."""
BY_ID = Path("/dev/serial/by-id")


def check_url(url: str) -> None:
    """Refuse a port that will never open, plugged in or not; one that may come later passes.

    Raises
    ------
    ConfigError : an unknown kind of URL, a socket without host and port, or a path that is no device.
    """
    kind, separator, _ = url.partition("://")
    if not url or (separator and kind.lower() not in _KINDS):
        raise ConfigError(f"{url!r} is no port; say a path such as /dev/ttyACM0, or socket://host:port")
    if kind.lower() == "socket" and separator:
        try:
            place = urlsplit(url)
            complete = bool(place.hostname) and bool(place.port)
        except ValueError:
            complete = False
        if not complete:
            raise ConfigError(f"{url}: say socket://host:port, the port a number up to 65535")
    path = Path(url)
    if not separator and path.exists() and not path.is_char_device():
        raise ConfigError(f"{url} is not a serial port")


_KINDS = ("alt", "cp2110", "hwgrep", "loop", "rfc2217", "socket", "spy")
"""URLs that pyserial opens; sockets are opened here."""


def is_socket(url: str) -> bool:
    return url.lower().startswith("socket://")


def pyserial() -> Any:
    """Return the package that opens serial ports, or raise DeviceError where it is not installed."""
    try:
        import serial
    except ImportError:
        raise DeviceError("pyserial is missing: install python3-serial (apt) or pyserial (pip)") from None
    return serial


class Port(Protocol):
    """An open port; its methods never wait, and raise DeviceError when the device is gone."""

    def fileno(self) -> int | None:
        """Return the descriptor to select on, or None where the port has none."""

    def read(self) -> bytes:
        """Return what has arrived, b"" when nothing has."""

    def write(self, data: bytes) -> None:
        """Write all bytes in one write."""

    def set_baud(self, rate: int) -> None:
        """Set the speed, bit/s; ports without one, and speeds the port cannot do, are passed over."""

    def set_dtr(self, on: bool) -> None:
        """Set the DTR line; ports without one pass it over."""

    def close(self) -> None:
        """Close the port; never raises."""


def open_port(url: str, baud: int) -> Port:
    """Open a port, which may take seconds where it is behind a network.

    Raises
    ------
    DeviceError : cannot be opened; the message says how to fix it.
    """
    return SocketPort(url) if is_socket(url) else SerialPort(url, baud)


class SocketPort:
    """A TCP bridge such as ser2net or an emulator, ``socket://host:port``."""

    def __init__(self, url: str) -> None:
        self.url = url
        place = urlsplit(url)
        try:
            self._socket = socket.create_connection((place.hostname or "", place.port or 0), CONNECT_TIMEOUT)
        except OSError as error:
            raise DeviceError(f"{url}: cannot open ({error})") from None
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def fileno(self) -> int | None:
        return self._socket.fileno()

    def read(self) -> bytes:
        try:
            data = self._socket.recv(CHUNK)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise DeviceError(f"{self.url}: unplugged or gone ({error})") from None
        if not data:
            raise DeviceError(f"{self.url}: the other side closed the connection")
        return data

    def write(self, data: bytes) -> None:
        try:
            sent = self._socket.send(data)
        except OSError as error:
            raise DeviceError(f"{self.url}: cannot write ({error})") from None
        if sent < len(data):
            raise DeviceError(f"{self.url}: it takes no bytes")

    def set_baud(self, rate: int) -> None:
        """Do nothing: the bridge has the speed."""

    def set_dtr(self, on: bool) -> None:
        """Do nothing: a bridge has no DTR line."""

    def close(self) -> None:
        self._socket.close()


class SerialPort:
    """A port that pyserial opens: a path, or what `serial.serial_for_url` takes."""

    def __init__(self, url: str, baud: int) -> None:
        serial = pyserial()
        self.url = url
        self._errors = (OSError, serial.SerialException)
        self._local = "://" not in url
        try:
            options: dict[str, Any] = {"exclusive": True} if self._local else {}
            wait = 0.0 if self._local else WRITE_TIMEOUT
            self._serial = serial.serial_for_url(url, baudrate=baud, timeout=0, write_timeout=wait, **options)
        except (*self._errors, ValueError) as error:
            raise DeviceError(_explain(url, error)) from None
        if self._local:
            self._claim()

    def _claim(self) -> None:
        """Keep other programs out, also those that take no lock; have an FTDI adapter deliver at once, not in 16 ms steps."""
        import fcntl
        import termios

        with contextlib.suppress(OSError):
            fcntl.ioctl(self._serial.fileno(), termios.TIOCEXCL)
        with contextlib.suppress(OSError, ValueError, AttributeError, NotImplementedError):
            self._serial.set_low_latency_mode(True)

    def fileno(self) -> int | None:
        try:
            return int(self._serial.fileno())
        except (AttributeError, OSError, ValueError):
            return None

    def read(self) -> bytes:
        try:
            if not self._local:
                return bytes(self._serial.read(min(self._serial.in_waiting, CHUNK)))
            data = os.read(self._serial.fileno(), CHUNK)
        except BlockingIOError:
            return b""
        except (*self._errors, TypeError) as error:
            raise DeviceError(f"{self.url}: unplugged or gone ({error})") from None
        if not data and self._hung_up():
            raise DeviceError(f"{self.url}: unplugged or gone (hung up)")
        return data

    def _hung_up(self) -> bool:
        """Distinguish a terminal without data from one that is gone: both read as nothing."""
        poller = select.poll()
        poller.register(self._serial.fileno(), select.POLLIN)
        return any(flags & ~select.POLLIN for _, flags in poller.poll(0))

    def write(self, data: bytes) -> None:
        try:
            sent = self._serial.write(data)
        except self._errors as error:
            raise DeviceError(f"{self.url}: cannot write ({error})") from None
        if sent is not None and sent < len(data):
            raise DeviceError(f"{self.url}: it takes no bytes")

    def set_baud(self, rate: int) -> None:
        with contextlib.suppress(ValueError, *self._errors):
            self._serial.baudrate = rate

    def set_dtr(self, on: bool) -> None:
        with contextlib.suppress(ValueError, *self._errors):
            self._serial.dtr = on

    def close(self) -> None:
        with contextlib.suppress(*self._errors):
            self._serial.close()


def absent_port(url: str) -> str:
    """Say that a port does not exist on this computer and what does; "" where it exists, or is none of this computer."""
    if "://" in url or Path(url).exists():
        return ""
    seen = ", ".join(sorted(entry.name for entry in BY_ID.iterdir())) if BY_ID.is_dir() else ""
    return f"{url}: no such port" + (f"; in {BY_ID} there are: {seen}" if seen else "; nothing is plugged in")


def _explain(url: str, error: Exception) -> str:
    """Say how to mend a port that does not open."""
    path, text = Path(url), str(error)
    why = text.replace(url, "")
    if absent := absent_port(url):
        return absent
    if "://" in url:
        return f"{url}: cannot open ({text})"
    if "Permission" in why or getattr(error, "errno", None) == 13:
        return f"{url}: no permission; run `sudo usermod -aG dialout $USER`, log out and in again"
    if "lock" in why or getattr(error, "errno", None) in (11, 16):
        return f"{url}: another program has it open (ModemManager, a terminal, another recorder); stop that first"
    if path.is_char_device() and "configure port" in why:
        return f"{url}: not a serial port"
    return f"{url}: cannot open ({text})"


def stable_name(url: str) -> str | None:
    """Return the by-id path of a port that was named by a number that changes with the order of plugging."""
    if "://" in url or "/serial/by-" in url or not BY_ID.is_dir():
        return None
    target = os.path.realpath(url)
    return next((str(entry) for entry in sorted(BY_ID.iterdir()) if os.path.realpath(entry) == target), None)


@dataclass(frozen=True, slots=True)
class PluggedIn:
    """A serial port of this computer."""

    path: str
    """by-id path where there is one."""
    description: str
    usb_id: str
    """"vvvv:pppp" in lower-case hexadecimal, or ""."""


def plugged_in() -> list[PluggedIn]:
    """List the USB serial ports of this computer, and the UART of a Raspberry Pi's header."""
    pyserial()
    from serial.tools.list_ports import comports

    ports = []
    for port in sorted(comports()):
        usb = f"{port.vid:04x}:{port.pid:04x}" if port.vid is not None else ""
        if not usb and port.device not in ("/dev/ttyAMA0", "/dev/ttyS0", "/dev/serial0"):
            continue
        text = " ".join(str(part) for part in (port.manufacturer, port.product) if part) or str(port.description)
        ports.append(PluggedIn(stable_name(port.device) or port.device, text, usb))
    return ports
