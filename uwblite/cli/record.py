"""``uwblite record``: read the tag, the lidar and the base, and write a log."""

import argparse
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .console import note, say, say_json
from .named_devices import MOST, device_links, host_name, mounting_params, show_note, use_lasting_names
from .options import number, numbers, place
from .serving import LOCAL, page_address

if TYPE_CHECKING:
    from ..drivers.recorder import Recorder

HELP = "record UWB tag, lidar, base and gyro into a log that `uwblite map` reads"
EPILOG = """
examples:
  uwblite devices                                     what is plugged in, and is it set up?
  uwblite record --uwb /dev/serial/by-id/usb-SEGGER... --lidar /dev/serial/by-id/usb-Hokuyo... \\
                 --odometry kobuki:/dev/kobuki --out run.log
  uwblite record --odometry "line:/dev/ttyUSB0?columns=t,left,right&tick=1.2e-4&wheel_base=0.3&time_unit=0.001" \\
                 --uwb shell:/dev/ttyACM0 --out run.log --duration 600
  uwblite record --lidar socket://robot.local:2001 --odometry kobuki:socket://robot.local:2002 --out run.log
  uwblite record ... --out run.log --append           go on after a crash
  uwblite record ... --out run.log --watch 0.0.0.0:8000  the map while it grows, on every phone in the network
  uwblite record --uwb tlv:/dev/ttyACM0 --tag 0.2,0,0.6 --uwb tlv:/dev/ttyACM1 --tag=-0.2,0,0.6 --odometry ...
                                                      a tag in front and one behind

devices (a path, a by-id path, socket://host:port or any other pyserial URL):
  each is written [NAME:]PORT[?option=value&...]; `uwblite devices --kinds` lists the names with their options

The log is CARMEN text. Each line is with the kernel as soon as it is written, so a crash loses at most the last one, and
with the disk after --sync seconds. Losses, reconnects and warnings stand in it as COMMENT lines. A recording ends with
--duration, Ctrl-C (exit code 130), SIGTERM or a closed terminal (0). Exit code 3: written, but a device was silent or
lost much.
PARAM lines written besides the mounting: laser_time_increment (s between rays), laser_range_min (m), laser_product,
laser_firmware, laser_serial, uwb_tag_id, uwb_pan_id, uwb_tag_firmware, host_monotonic_zero (log time minus the
computer's monotonic clock, s).
"""


_PAGE_NICENESS = 10
"""Of the page beside the recorder."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    devices = parser.add_argument_group("devices")
    devices.add_argument("--uwb", metavar="[NAME:]PORT", action="append", help="UWB tag (a DWM1001 without a name); repeatable")
    devices.add_argument("--lidar", metavar="[NAME:]PORT", action="append", help="lidar (a Hokuyo without a name); repeatable")
    devices.add_argument("--odometry", metavar="NAME:PORT", action="append", help="base: kobuki:PORT, line:PORT?columns=...")
    gyro = "its heading takes the place of the wheels': line:PORT?columns=t,turn_rate"
    devices.add_argument("--gyro", metavar="NAME:PORT", action="append", help=gyro)
    text = "begin although a port does not exist yet; a device that is lost in mid-run is waited for in any case"
    devices.add_argument("--wait", action="store_true", help=text)
    output = parser.add_argument_group("output")
    output.add_argument("--out", type=place, metavar="FILE", required=True, help="the log; must not exist unless --append")
    output.add_argument("--append", action="store_true", help="go on with a log that broke off")
    output.add_argument("--rotate", metavar="SIZE", type=_size, default=0, help="begin a new part at this size, e.g. 500M")
    output.add_argument("--duration", metavar="S", type=number(above=0), help="stop after so many seconds")
    pause = "s between syncs to the disk (1; 0 = each write)"
    output.add_argument("--sync", metavar="S", type=number(least=0), default=1.0, help=pause)
    output.add_argument("--json", action="store_true", help="summary as one JSON object on stdout")
    page = "show the map while it grows, as uwblite watch does, in a process of its own (127.0.0.1:8000)"
    output.add_argument("--watch", metavar="[ADDRESS:]PORT", type=page_address, nargs="?", const=LOCAL, help=page)
    laser = parser.add_argument_group("lidar")
    laser.add_argument("--lidar-steps", metavar="A:B", help="first and last step, e.g. 128:640 (all: 44:725)")
    merged, skipped = number(1, 99, whole=True), number(0, 9, whole=True)
    laser.add_argument("--lidar-cluster", metavar="N", type=merged, help="steps merged into one reading (1)")
    laser.add_argument("--lidar-skip", metavar="N", type=skipped, help="scans left out between two (0)")
    narrow = "2-character readings up to 4.095 m, for slow RS-232"
    laser.add_argument("--lidar-narrow", action="store_const", const=1, help=narrow)
    laser.add_argument("--lidar-baud", metavar="N", type=number(whole=True), help="bit/s to try first on RS-232 (115200)")
    mounting = parser.add_argument_group("mounting, for the log")
    pose = "laser on the base: m, m, rad; once for each --lidar, in their order"
    mounting.add_argument("--laser-pose", metavar="X,Y,THETA", type=numbers(3), action="append", help=pose)
    flipped, which = "the laser is mounted upside down; K: the K-th lidar", number(1, MOST["lidar"], whole=True)
    mounting.add_argument("--laser-flipped", metavar="K", nargs="?", const=1, type=which, action="append", help=flipped)
    tag = "UWB tag on the base, z above the floor: m; once for each --uwb, in their order"
    mounting.add_argument("--tag", metavar="X,Y,Z", type=numbers(3), action="append", help=tag)
    mounting.add_argument("--anchor-height", metavar="H", type=number(), help="height of the anchors above the floor, m")


def run(args: argparse.Namespace) -> int:
    """Record until the time is over or somebody stops it."""
    import signal
    import time

    from ..drivers.link import Mounting
    from ..drivers.log_file import LogFile, last_state
    from ..drivers.recorder import Recorder
    from ..drivers.transport import absent_port
    from ..errors import DeviceError

    if not any(getattr(args, sensor) for sensor in MOST):
        note("uwblite: error: name at least one of --uwb, --lidar, --gyro, --odometry; `uwblite devices` lists what is there")
        return 2
    path = Path(args.out)
    if path.suffix in (".gz", ".bz2", ".xz", ".zip"):
        note(f"uwblite: error: --out {path}: a log is plain text, so that a crash loses one line; compress it afterwards")
        return 2
    offset = time.time() - time.monotonic()
    pose, remark = (0.0, 0.0, 0.0), ""
    if args.append and path.exists():
        last, pose = last_state(_last_part(path))
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
    stopped: list[int] = []
    watching = _Watching(args) if args.watch else None
    recorder = Recorder(
        links, log, monotonic=time.monotonic, wall_offset=offset, host=host_name(), mounting=mounting,
        on_note=show_note, wall=time.time,
    )  # fmt: skip
    endings = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {ending: signal.signal(ending, lambda n, _f: stopped.append(n)) for ending in endings}
    try:
        recorder.begin(_head(args, remark))
        use_lasting_names(links)
        recorder.run(duration=args.duration, stopping=lambda: bool(stopped), on_status=_status_line(recorder, watching))
    finally:
        log.close()
        if watching is not None:
            watching.stop()
        for ending, handler in before.items():
            signal.signal(ending, handler)
    return _finish(recorder, args.json, bool(stopped) and stopped[0] == signal.SIGINT)


def _finish(recorder: "Recorder", as_json: bool, interrupted: bool) -> int:
    doubts = recorder.doubts()
    if as_json:
        say_json(_summary(recorder, doubts))
    else:
        for line in recorder.summary():
            say(line)
        if not doubts:
            say(f"next: uwblite check {recorder.log.first}")
    for doubt in doubts:
        note(f"uwblite: warning: {doubt}")
    return 130 if interrupted else 3 if doubts else 0


def _summary(recorder: "Recorder", doubts: list[str]) -> dict[str, Any]:
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


def _last_part(path: Path) -> Path:
    part = 2
    while (following := path.with_suffix(f".{part}{path.suffix}")).exists():
        path, part = following, part + 1
    return path


def _head(args: argparse.Namespace, remark: str) -> list[str]:
    from .. import __version__

    devices = ", ".join(f"{name} {spec}" for name in MOST for spec in getattr(args, name) or [])
    return [f"recorded by uwblite {__version__}: {devices}", *([remark] if remark else [])]


class _Watching:
    """`uwblite watch` beside the recorder, which goes on whatever becomes of it."""

    def __init__(self, args: argparse.Namespace) -> None:
        from .child import Child

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
        """Say once that the page has ended, where it has."""
        if self._child is not None and self._child.code() is not None:
            why = self._child.output().removeprefix("uwblite: error: ")
            note(f"uwblite: warning: the page has ended: {why}; the recording goes on")
            self._child = None

    def stop(self) -> None:
        """End the page."""
        if self._child is not None:
            self._child.stop()


def _status_line(recorder: "Recorder", watching: _Watching | None = None) -> Any:
    """Return what draws the status line, on a terminal only, and looks after the page."""
    from .console import Progress

    bar = Progress()

    def show() -> None:
        if watching is not None:
            watching.look()
        if bar.active:
            bar(status_text(recorder), 0, 0)

    return show


def status_text(recorder: "Recorder") -> str:
    """Return rates, anchors, damage and disk in one line."""
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


def _size(text: str) -> int:
    match = re.fullmatch(r"(\d+)([kMG]?)", text)
    if not match:
        raise argparse.ArgumentTypeError(f"{text!r} is not a size such as 500M")
    return int(match[1]) * {"": 1, "k": 1000, "M": 10**6, "G": 10**9}[match[2]]
