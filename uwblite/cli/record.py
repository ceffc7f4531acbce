"""``uwblite record``: read the tag, the lidar and the base, and write a log; and devices of the command line for others."""

import argparse
import os
import re
import signal
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .. import __version__
from ..drivers.devices import SENSORS, Setup, open_device
from ..drivers.events import Note, Pose
from ..drivers.link import Host, Link, Mounting
from ..drivers.log_file import LogFile, last_state
from ..drivers.recorder import Recorder
from ..drivers.transport import absent_port, check_url, is_socket, pyserial, stable_name
from ..errors import ConfigError, DeviceError
from ..io.folders import sole_writer
from .child import Child
from .console import Progress, note, report
from .interruption import stopped_by
from .verbs import MOST

_PAGE_NICENESS = 10
"""Of the page beside the recorder."""


def run(args: argparse.Namespace) -> int:
    if not any(getattr(args, sensor) for sensor in MOST):
        note("uwblite: error: name at least one of --uwb, --lidar, --gyro, --odometry; `uwblite devices` lists what is there")
        return 2
    path = Path(args.out)
    if path.suffix in (".gz", ".bz2", ".xz", ".zip"):
        note(f"uwblite: error: --out {path}: a log is plain text, so that a crash loses one line; compress it afterwards")
        return 2
    with sole_writer(path):
        return _record(args, path)


def _record(args: argparse.Namespace, path: Path) -> int:
    offset = time.time() - time.monotonic()
    pose, remark = (0.0, 0.0, 0.0), ""
    if args.append and path.exists():
        last, pose = last_state(path)
        remark = "goes on with a log that broke off; motion meanwhile is unknown, the odometry goes on from its last pose"
        if last is not None and last > time.monotonic() + offset:
            # A Raspberry Pi without a network wakes with an old clock.
            remark += f"; this computer's clock is {last - time.monotonic() - offset:.0f} s behind the log and was moved"
            offset = last + 1.0 - time.monotonic()
    links = device_links(args, pose)
    absent = next(filter(None, (absent_port(link.url) for link in links)), "")
    if absent and not args.wait:
        raise DeviceError(f"{absent}; --wait waits until it is there")
    log = LogFile(path, append=args.append, rotate=args.rotate, sync=args.sync)
    lasers = args.laser_pose or [(0.0, 0.0, 0.0)]
    mounting = Mounting(lasers[0], tuple(mounting_params(args, offset)), more_lasers=tuple(lasers[1:]))
    watching = _Watching(args) if args.watch else None
    recorder = Recorder(links, log, Host(host_name(), time.monotonic, offset, time.time), mounting, show_note)
    with stopped_by(signal.SIGINT, signal.SIGTERM, signal.SIGHUP) as stopped:
        try:
            recorder.begin(_head(args, remark))
            use_lasting_names(links)
            recorder.run(duration=args.duration, stopping=lambda: bool(stopped), on_status=_status_line(recorder, watching))
        finally:
            log.close()
            if watching is not None:
                watching.stop()
    return _finish(recorder, args.json, stopped[:1] == [signal.SIGINT])


def _finish(recorder: Recorder, as_json: bool, interrupted: bool) -> int:
    doubts = recorder.doubts()
    following = [] if doubts else [f"next: uwblite check {recorder.log.first}"]
    report(as_json, _summary(recorder, doubts), [*recorder.summary(), *following])
    for doubt in doubts:
        note(f"uwblite: warning: {doubt}")
    return 130 if interrupted else 3 if doubts else 0


def _summary(recorder: Recorder, doubts: list[str]) -> dict[str, Any]:
    return {
        "log": str(recorder.log.first),
        "parts": recorder.log.part,
        "seconds": recorder.end - recorder.start,
        "bytes": recorder.log.bytes,
        "doubts": doubts,
        "devices": {
            link.name: {
                "messages": link.counts.messages,
                "lost": link.counts.lost,
                "corrupt": dict(link.counts.corrupt),
                "connects": link.counts.connects,
                "silent_seconds": link.counts.silent_time,
                "anchors": dict(sorted(link.counts.anchors.items())),
            }
            for link in recorder.links
        },
    }


def _head(args: argparse.Namespace, remark: str) -> list[str]:
    devices = ", ".join(f"{name} {spec}" for name in MOST for spec in getattr(args, name) or [])
    return [f"recorded by uwblite {__version__}: {devices}", *([remark] if remark else [])]


class _Watching:
    """`uwblite watch` beside the recorder, which goes on whatever becomes of it."""

    def __init__(self, args: argparse.Namespace) -> None:
        host, port = args.watch
        words = ["watch", args.out, "--host", host, "--port", str(port)]
        self._child: Child | None = None
        try:
            self._child = Child(words, _PAGE_NICENESS)
        except OSError as error:
            note(f"uwblite: warning: no page: {error}; the recording goes on")
        else:
            note(f"the map while it grows: http://{host}:{port}/")

    def look(self) -> None:
        if self._child is not None and self._child.code() is not None:
            why = self._child.output().removeprefix("uwblite: error: ")
            note(f"uwblite: warning: the page has ended: {why}; the recording goes on")
            self._child = None

    def stop(self) -> None:
        if self._child is not None:
            self._child.stop()


def _status_line(recorder: Recorder, watching: _Watching | None) -> Any:
    """Return what draws the status line, on a terminal only, and looks after the page."""
    bar = Progress()

    def show() -> None:
        if watching is not None:
            watching.look()
        if bar.active:
            bar(status_text(recorder), 0, 0)

    return show


def status_text(recorder: Recorder) -> str:
    parts = []
    for link in recorder.links:
        counts = link.counts
        state = f"{link.rate:.1f}/s" if link.port is not None and not link.quiet else "SILENT"
        text = f"{link.name} {state}"
        if counts.anchors:
            text += f" ({len(counts.anchors)} anchors)"
        damage = sum(counts.corrupt.values())
        if counts.lost or damage:
            text += f" lost {counts.lost} corrupt {damage}"
        parts.append(text)
    free = recorder.log.free_bytes() / 1e9
    return f"{recorder.log.bytes / 1e6:.1f} MB | {' | '.join(parts)} | disk {free:.1f} GB left"


def device_links(args: argparse.Namespace, pose: Pose = (0.0, 0.0, 0.0)) -> list[Link]:
    """Return the devices that the command line names; pose is where the odometry goes on."""
    links = []
    for sensor in reversed(SENSORS):
        specs = getattr(args, sensor) or []
        if len(specs) > MOST[sensor]:
            raise ConfigError(f"--{sensor} is given {len(specs)} times; a log keeps {MOST[sensor]} apart")
        for k, spec in enumerate(specs, start=1):
            session, url = open_device(sensor, spec, Setup(pose))
            links.append(Link(sensor, url, session, k))
    ports: dict[str, str] = {}
    for link in links:
        check_url(link.url)
        # A server may have several clients, each for a sensor of its own.
        port = f"{link.name.removesuffix(str(link.number))} {link.url}" if is_socket(link.url) else os.path.realpath(link.url)
        if (other := ports.setdefault(port, link.name)) != link.name:
            raise ConfigError(f"{other} and {link.name} are given the same port, {link.url}: a port has one device")
        pyserial()
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
    return re.sub(r"\s+", "_", socket.gethostname()) or "host"


def show_note(seconds: float, message: Note) -> None:
    note(f"[{seconds:8.1f} s] {message.level}: {message.text}")


class LinesTo(LogFile):
    """A log that is written nowhere."""

    def __init__(self, take: Callable[[bytes], None]) -> None:
        self._take = take
        self.head, self.path, self.first, self.bytes, self.part = [], Path("-"), Path("-"), 0, 1

    def write(self, lines: list[str]) -> None:
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
    recorder = Recorder(links, LinesTo(take), Host(host_name(), time.monotonic, offset), on_note=show_note)
    recorder.begin([])
    recorder.run(duration=None, stopping=stopping, on_status=wait)
