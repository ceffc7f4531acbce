"""The serial ports of this computer, and the names by which they stay the same."""

import os
from dataclasses import dataclass

from .transport import BY_ID, pyserial


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


def plugged_in() -> list[PluggedIn]:
    """List the USB serial ports of this computer, and the UART of a Raspberry Pi's header."""
    pyserial()
    from serial.tools.list_ports import comports

    found = []
    for port in sorted(comports()):
        usb = f"{port.vid:04x}:{port.pid:04x}" if port.vid is not None else ""
        if not usb and port.device not in ("/dev/ttyAMA0", "/dev/ttyS0", "/dev/serial0"):
            continue
        text = " ".join(str(part) for part in (port.manufacturer, port.product) if part) or str(port.description)
        found.append(PluggedIn(stable_name(port.device) or port.device, text, usb))
    return found
