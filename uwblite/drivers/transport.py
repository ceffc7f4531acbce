"""Serial ports by URL: the only file that knows pyserial, which is imported when a port is first opened.

``/dev/ttyACM0`` or a path in ``/dev/serial/by-id`` opens a port, ``socket://host:port`` a bridge (ser2net, an emulator),
``loop://`` a port that hears itself. Reads never block.
"""

import contextlib
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from ..errors import ConfigError, DeviceError

CHUNK = 65536
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
"""URLs that pyserial opens."""


class Port:
    """An open port; raises DeviceError when it is gone.

    Parameters
    ----------
    url : what `serial.serial_for_url` takes.
    baud : bit/s.

    Raises
    ------
    DeviceError : cannot be opened; the message says how to mend it.
    """

    def __init__(self, url: str, baud: int) -> None:
        try:
            import serial
        except ImportError:
            raise DeviceError("pyserial is missing: install python3-serial (apt) or pyserial (pip)") from None
        self.url = url
        self._errors = (OSError, serial.SerialException)
        local = "://" not in url
        try:
            options: dict[str, Any] = {"exclusive": True} if local else {}
            self._serial = serial.serial_for_url(url, baudrate=baud, timeout=0, write_timeout=1.0, **options)
        except (*self._errors, ValueError) as error:
            raise DeviceError(_explain(url, error)) from None
        if local:
            self._claim()

    def _claim(self) -> None:
        """Besides pyserial's flock, ask the kernel to refuse the port to programs that take no lock."""
        import fcntl
        import termios

        with contextlib.suppress(OSError):
            fcntl.ioctl(self._serial.fileno(), termios.TIOCEXCL)

    def fileno(self) -> int | None:
        """Return the descriptor to select on, or None where the port has none."""
        try:
            return int(self._serial.fileno())
        except (AttributeError, OSError, ValueError):
            return None

    def read(self) -> bytes:
        """Return what has arrived, b"" when nothing has.

        Raises
        ------
        DeviceError : the device is gone.
        """
        try:
            if self.url.lower().startswith("socket://"):
                return self._read_socket()
            if "://" in self.url:
                return bytes(self._serial.read(self._serial.in_waiting))
            data = os.read(self._serial.fileno(), CHUNK)
        except BlockingIOError:
            return b""
        except (*self._errors, TypeError) as error:
            raise DeviceError(f"{self.url}: unplugged or gone ({error})") from None
        if not data and self._hung_up():
            raise DeviceError(f"{self.url}: unplugged or gone (hung up)")
        return data

    def _hung_up(self) -> bool:
        """Tell a terminal that has nothing to say from one that is gone: both read as nothing."""
        import select

        poller = select.poll()
        poller.register(self._serial.fileno(), select.POLLIN)
        return any(flags & ~select.POLLIN for _, flags in poller.poll(0))

    def _read_socket(self) -> bytes:
        data: bytes = self._serial._socket.recv(CHUNK)
        if not data:
            raise DeviceError(f"{self.url}: the other side closed the connection")
        return data

    def write(self, data: bytes) -> None:
        """Write all bytes in one write.

        Raises
        ------
        DeviceError : the device is gone or takes no bytes.
        """
        try:
            self._serial.write(data)
        except self._errors as error:
            raise DeviceError(f"{self.url}: cannot write ({error})") from None

    def set_baud(self, rate: int) -> None:
        """Set the speed, bit/s; ports without one, and speeds the port cannot do, are passed over."""
        with contextlib.suppress(ValueError, *self._errors):
            self._serial.baudrate = rate

    def close(self) -> None:
        """Close the port; never raises."""
        with contextlib.suppress(*self._errors):
            self._serial.close()


def _explain(url: str, error: Exception) -> str:
    """Say how to mend a port that does not open."""
    path = Path(url)
    text = str(error)
    if "://" in url:
        return f"{url}: cannot open ({text})"
    if not path.exists():
        seen = ", ".join(sorted(entry.name for entry in BY_ID.iterdir())) if BY_ID.is_dir() else ""
        return f"{url}: no such port" + (f"; in {BY_ID} there are: {seen}" if seen else "; nothing is plugged in")
    if "Permission" in text or getattr(error, "errno", None) == 13:
        return f"{url}: no permission; run `sudo usermod -aG dialout $USER`, log out and in again"
    if "lock" in text or getattr(error, "errno", None) in (11, 16):
        return f"{url}: another program has it open (ModemManager, a terminal, another recorder); stop that first"
    if path.is_char_device() and "configure port" in text:
        return f"{url}: not a serial port"
    return f"{url}: cannot open ({text})"


def stable_name(url: str) -> str | None:
    """Return the by-id path of a port that was named by a number that changes with the order of plugging.

    Parameters
    ----------
    url : as the user gave it.

    Returns
    -------
    str, or None where there is none or the path is one already.
    """
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
    guess: str
    """"scip", "dwm1001", "kobuki" or ""."""


KNOWN_USB = {"15d1:0000": "scip", "1366:0105": "dwm1001", "1366:1015": "dwm1001"}
"""Hokuyo; SEGGER J-Link of the DWM1001-DEV board. A Kobuki has a stock FTDI chip and is known by its product name."""


def plugged_in() -> list[PluggedIn]:
    """List the USB serial ports of this computer, and the UART of a Raspberry Pi's header."""
    from serial.tools.list_ports import comports

    found = []
    for port in sorted(comports()):
        usb = f"{port.vid:04x}:{port.pid:04x}" if port.vid is not None else ""
        if not usb and port.device not in ("/dev/ttyAMA0", "/dev/ttyS0", "/dev/serial0"):
            continue
        text = " ".join(str(part) for part in (port.manufacturer, port.product) if part) or str(port.description)
        guess = KNOWN_USB.get(usb, "kobuki" if "kobuki" in text.lower() else "")
        found.append(PluggedIn(stable_name(port.device) or port.device, text, usb, guess))
    return found
