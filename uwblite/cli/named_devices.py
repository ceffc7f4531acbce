"""Devices and mounting as a command line names them, for `uwblite record` and the live pose."""

import argparse
import re
from typing import TYPE_CHECKING

from .console import note

if TYPE_CHECKING:
    from ..drivers.events import Note, Pose
    from ..drivers.link import Link

MOST = {"uwb": 9, "lidar": 5, "gyro": 1, "odometry": 1}
"""How many of a kind a log keeps apart."""


def device_links(args: argparse.Namespace, pose: "Pose" = (0.0, 0.0, 0.0)) -> list["Link"]:
    """Return the devices that the command line names; pose is where the odometry goes on."""
    from ..drivers.device_options import Setup
    from ..drivers.devices import SENSORS, open_device
    from ..drivers.link import Link
    from ..drivers.transport import check_pyserial, check_url
    from ..errors import ConfigError

    names = ("steps", "cluster", "skip", "narrow", "baud")
    lidar = {name: str(value) for name in names if (value := getattr(args, f"lidar_{name}", None)) is not None}
    links = []
    for sensor in reversed(SENSORS):
        specs = getattr(args, sensor) or []
        if len(specs) > MOST[sensor]:
            raise ConfigError(f"--{sensor} is given {len(specs)} times; a log keeps {MOST[sensor]} apart")
        for k, spec in enumerate(specs, start=1):
            session, url = open_device(sensor, spec, Setup(pose), lidar if sensor == "lidar" else None)
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


def use_lasting_names(links: list["Link"]) -> None:
    """Open ports by names that stay when they are unplugged and plugged in again."""
    from ..drivers.ports import stable_name

    for link in links:
        better = stable_name(link.url)
        if better:
            note(f"{link.name}: {link.url} may change its number; it is opened as {better}")
            link.url = better


def host_name() -> str:
    """Return this computer's name as one word of a log."""
    import socket

    return re.sub(r"\s+", "_", socket.gethostname()) or "host"


def show_note(seconds: float, message: "Note") -> None:
    """Print what a recorder notes, with the seconds since its begin."""
    note(f"[{seconds:8.1f} s] {message.level}: {message.text}")
