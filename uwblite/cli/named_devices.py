"""Devices and mounting as a command line names them, for `uwblite record` and for `uwblite localize --live`."""

import argparse
import re
import socket
import time
from collections.abc import Callable
from pathlib import Path

from ..drivers.devices import SENSORS, Setup, open_device
from ..drivers.events import Note, Pose
from ..drivers.link import Link
from ..drivers.log_file import LogFile
from ..drivers.recorder import Recorder
from ..drivers.transport import check_pyserial, check_url, stable_name
from ..errors import ConfigError
from .console import note
from .log_verbs import MOST


def device_links(args: argparse.Namespace, pose: Pose = (0.0, 0.0, 0.0)) -> list[Link]:
    """Return the devices that the command line names; pose is where the odometry goes on."""
    names = ("steps", "cluster", "skip", "narrow", "baud")
    lidar = {name: str(value) for name in names if (value := getattr(args, f"lidar_{name}", None)) is not None}
    links = []
    for sensor in reversed(SENSORS):
        specs = getattr(args, sensor) or []
        if len(specs) > MOST[sensor]:
            raise ConfigError(f"--{sensor} is given {len(specs)} times; a log keeps {MOST[sensor]} apart")
        for k, spec in enumerate(specs, start=1):
            session, url = open_device(sensor, spec, Setup(pose), lidar if sensor == "lidar" else {})
            links.append(Link(sensor, url, session, k))
    for link in links:
        check_url(link.url)
        check_pyserial(link.url)
    return links


def mounting_params(args: argparse.Namespace, offset: float) -> list[tuple[str, str]]:
    params = [("host_monotonic_zero", f"{offset:.6f}")]
    for k, position in enumerate(args.tag or [], start=1):
        names = (f"uwb{k if k > 1 else ''}_tag_{name}" for name in ("offset_x", "offset_y", "height"))
        params += [(name, f"{value:.6f}") for name, value in zip(names, position, strict=True)]
    if args.anchor_height is not None:
        params.append(("uwb_anchor_height", f"{args.anchor_height:.6f}"))
    params += [(f"laser{k if k > 1 else ''}_flipped", "on") for k in args.laser_flipped or ()]
    return params


def use_lasting_names(links: list[Link]) -> None:
    """Open ports by names that stay when they are unplugged and plugged in again."""
    for link in links:
        better = stable_name(link.url)
        if better:
            note(f"{link.name}: {link.url} may change its number; it is opened as {better}")
            link.url = better


def host_name() -> str:
    """Return this computer's name as one word of a log."""
    return re.sub(r"\s+", "_", socket.gethostname()) or "host"


def show_note(seconds: float, message: Note) -> None:
    """Print what a recorder notes, with the seconds since its begin."""
    note(f"[{seconds:8.1f} s] {message.level}: {message.text}")


class LinesTo(LogFile):
    """A log that is written nowhere."""

    def __init__(self, take: Callable[[bytes], None]) -> None:
        self._take = take
        self.head, self.path, self.first, self.bytes, self.part = [], Path("-"), Path("-"), 0, 1

    def write(self, lines: list[str]) -> None:
        """Hand lines on."""
        if lines:
            data = ("\n".join(lines) + "\n").encode("ascii", "replace")
            self.bytes += len(data)
            self._take(data)

    def restore(self) -> bool:
        """Return False: nothing can be deleted."""
        return False

    def close(self) -> None:
        """Nothing is open."""


def record_into(
    args: argparse.Namespace, take: Callable[[bytes], None], stopping: Callable[[], bool], wait: Callable[[], None]
) -> None:
    """Read devices until asked to stop, and hand on what `uwblite record` would write; wait is called meanwhile."""
    links = device_links(args)
    offset = time.time() - time.monotonic()
    recorder = Recorder(links, LinesTo(take), monotonic=time.monotonic, wall_offset=offset, host=host_name(), on_note=show_note)
    recorder.begin([])
    recorder.run(duration=None, stopping=stopping, on_status=wait)
