"""Emulate a URG-04LX, a DWM1001 tag and a Kobuki base on pseudo-terminals or TCP ports.

    python tools/emulate.py --lidar ./lidar --uwb ./uwb --kobuki ./base
    python tools/emulate.py --lidar ./lidar --uwb ./uwb --kobuki ./base --play run.log --speed 2 --truth t.jsonl
    python tools/emulate.py --lidar tcp:10940
    python tools/emulate.py --lidar ./lidar --lidar-kind ld06 --uwb ./uwb --uwb-kind linktrack --kobuki ./b --base-kind create2
    python tools/emulate.py --lidar ./lidar --scip1 --fault lidar:noise=0.01@10+20 --fault lidar:unplug@40+3

Each device gets a path (a symbolic link to its pseudo-terminal) or ``tcp:[HOST:]PORT``. Without --play the robot drives a
circle in a room of 8 x 6 m. With --play a CARMEN log is played: its scans, ranges and odometry come out of the devices at
the log's pace times --speed, from the moment on which every device is being read (--no-wait: at once). --truth writes one
JSON line per scan, fix and packet with the true time in seconds of the computer's monotonic clock.
"""

import argparse
import json
import math
import random
import select
import signal
import sys
import time
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parent), str(Path(__file__).resolve().parents[1])]

from emulators import faults
from emulators.dwm_device import DwmDevice, DwmOptions
from emulators.faults import FaultyLine, parse_fault
from emulators.hokuyo import captured
from emulators.kobuki_device import Create2Device, KobukiDevice, TickLineDevice
from emulators.scip_device import ScipDevice, ScipOptions
from emulators.spinning_device import LIDARS
from emulators.uwb_boards import BOARDS, UwbBoard
from emulators.wires import PtyWire, TcpWire
from emulators.world import LogWorld, RoomWorld, WorldClock

DEVICES = ("lidar", "uwb", "kobuki")
BASES = {"kobuki": KobukiDevice, "create2": Create2Device, "line": TickLineDevice}


class Plug:
    """A device, its wire and its faults."""

    def __init__(self, name, device, wire, line) -> None:
        self.name, self.device, self.wire, self.line = name, device, wire, line
        self.plugged = False

    def follow_faults(self, now: float, began: float) -> None:
        """Plug in or out, hang and set statuses as the time says."""
        time_now = now - began
        away = self.line.is_active("unplug", time_now)
        if away and self.plugged:
            self.wire.unplug()
            self.plugged = False
        elif not away and not self.plugged:
            self.device.power_up(now)
            self.wire.plug_in()
            self.plugged = True
            for fault in self.line.faults:
                if fault.kind == "hang" and fault.start < time_now:
                    fault.seconds = 0.0  # the power cycle cured it
        if isinstance(self.device, ScipDevice):
            self.device.hung = self.line.is_active("hang", time_now)
            status = self.line.share("status", time_now)
            self.device.fault = int(status) if status else None
            self.device.options.wrong_sums = self.line.share("sums", time_now)
            self.device.options.duplicates = self.line.share("duplicate", time_now)
        elif isinstance(self.device, DwmDevice):
            self.device.silent = self.line.is_active("hang", time_now)

    def send(self, data: bytes, now: float, began: float) -> None:
        """Pass bytes to the host, damaged as the faults say."""
        if self.line.is_active("silent", now - began):
            return
        data = self.line.pass_on(data, now - began, duplicates=self.name != "lidar")
        if data:
            self.wire.write(data)

    def being_read(self) -> bool:
        """Return whether a host has begun to read measurements."""
        if isinstance(self.device, ScipDevice):
            return self.device.is_streaming
        if isinstance(self.device, DwmDevice):
            return self.device.asked
        return self.wire.connected() and getattr(self.device, "is_streaming", True)


def parse_arguments(argv=None):
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__ + "\nfaults, --fault DEVICE:FAULT\n" + (faults.__doc__ or ""),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    for name, what in (("lidar", "URG-04LX"), ("uwb", "DWM1001"), ("kobuki", "Kobuki")):
        parser.add_argument(f"--{name}", metavar="PATH|tcp:PORT", help=f"emulate a {what} here")
    parser.add_argument("--lidar-kind", choices=("scip", *LIDARS), default="scip", help="which lidar (scip)")
    parser.add_argument("--uwb-kind", choices=("dwm1001", *BOARDS), default="dwm1001", help="which tag (dwm1001)")
    parser.add_argument("--base-kind", choices=tuple(BASES), default="kobuki", help="which base (kobuki)")
    parser.add_argument("--play", metavar="LOG", type=Path, help="CARMEN log to play")
    parser.add_argument("--speed", type=float, default=1.0, help="world seconds per second (1)")
    parser.add_argument("--no-wait", action="store_true", help="start the world at once")
    parser.add_argument("--duration", type=float, default=math.inf, help="leave after so many seconds")
    parser.add_argument("--until-end", action="store_true", help="leave 2 s after the log is played")
    parser.add_argument("--truth", metavar="FILE", type=Path, help="write what was sent, JSON lines")
    parser.add_argument("--fault", metavar="DEVICE:FAULT", action="append", default=[], help="see below; repeatable")
    parser.add_argument("--seed", type=int, default=0, help="of the faults (0)")
    parser.add_argument("--scip1", action="store_true", help="lidar wakes in SCIP 1.1")
    parser.add_argument("--lidar-streaming", action="store_true", help="lidar was left streaming by a dead host")
    replay = "answer as the URG-04LX of this capture did (seconds, microseconds, length, bytes received; perhaps .gz)"
    parser.add_argument("--lidar-replay", metavar="FILE", type=Path, help=replay)
    parser.add_argument("--lidar-clock", type=int, default=0, help="ms on its clock at power-up (16777216 wraps)")
    parser.add_argument("--lidar-skew", type=float, default=0.0, help="relative error of its crystal, e.g. 1e-4")
    parser.add_argument("--uwb-shell", action="store_true", help="tag was left in the shell")
    parser.add_argument("--uwb-stream", choices=("les", "lec", "lep"), default="", help="tag was left streaming")
    parser.add_argument("--uwb-stationary", action="store_true", help="tag has stationary detection on")
    parser.add_argument("--uwb-not-joined", action="store_true", help="tag has no network")
    parser.add_argument("--uwb-anchor", action="store_true", help="the module is an anchor")
    parser.add_argument("--kobuki-clock", type=int, default=0, help="ms on its clock at start (65536 wraps)")
    parser.add_argument("--kobuki-skew", type=float, default=0.0, help="relative error of its crystal")
    args = parser.parse_args(argv)
    if not any(getattr(args, name) for name in DEVICES):
        parser.error("name at least one of --lidar, --uwb, --kobuki")
    return args


def make_wire(place: str):
    """Return what a device is plugged into: tcp:HOST:PORT, or a pseudo-terminal linked at a path."""
    if place.startswith("tcp:"):
        host, _, port = place[4:].rpartition(":")
        return TcpWire(host or "127.0.0.1", int(port))
    return PtyWire(Path(place))


def build(args, clock, world, truth) -> list[Plug]:
    """Return the devices asked for, each with its wire and its faults."""
    chosen: dict[str, list] = {name: [] for name in DEVICES}
    for text in args.fault:
        name, _, fault = text.partition(":")
        if name not in DEVICES:
            raise SystemExit(f"--fault {text}: begin with one of {', '.join(DEVICES)}")
        try:
            chosen[name].append(parse_fault(fault))
        except ValueError as error:
            raise SystemExit(str(error)) from None
    plugs = []
    for index, name in enumerate(DEVICES):
        place = getattr(args, name)
        if not place:
            continue
        if name == "lidar" and args.lidar_kind != "scip":
            device = LIDARS[args.lidar_kind](world, clock, on_turn=lambda t: truth("turn", t, 0))
        elif name == "lidar":
            options = ScipOptions(args.scip1, args.lidar_clock, args.lidar_skew, args.lidar_streaming)
            if args.lidar_replay:
                options.unit = captured(args.lidar_replay)
            options.random = random.Random(args.seed + 10)
            device = ScipDevice(world.scans(), clock, options, lambda t, v: truth("lidar", t, v))
        elif name == "uwb" and args.uwb_kind != "dwm1001":
            device = UwbBoard(world.epochs(), clock, BOARDS[args.uwb_kind], lambda t, r: truth("uwb", t, r))
        elif name == "uwb":
            settings = DwmOptions(
                shell=args.uwb_shell, stream=args.uwb_stream, stationary_detection=args.uwb_stationary,
                joined=not args.uwb_not_joined, anchor=args.uwb_anchor,
            )  # fmt: skip
            device = DwmDevice(world.epochs(), clock, settings, lambda t, r: truth("uwb", t, r))
        else:
            device = BASES[args.base_kind](
                world.poses(), clock, clock_start=args.kobuki_clock, clock_skew=args.kobuki_skew,
                on_packet=lambda t, *pose: truth("odometry", t, pose),
            )  # fmt: skip
        plugs.append(Plug(name, device, make_wire(place), FaultyLine(chosen[name], args.seed + index)))
    return plugs


def run(plugs: list[Plug], args, clock, stop_world: float, leaving) -> None:
    """Serve the devices until the world stops or somebody leaves."""
    began = time.monotonic()
    for plug in plugs:
        plug.follow_faults(began, began)
        print(f"{plug.name}: {getattr(plug.wire, 'link', None) or plug.wire.path}", flush=True)
    if args.no_wait:
        clock.start(began)
    events = sorted({t for plug in plugs for t in plug.line.times()})
    while not leaving():
        now = time.monotonic()
        if now - began > args.duration or clock.world(now) > stop_world + 2.0 * args.speed:
            break
        for plug in plugs:
            plug.follow_faults(now, began)
        if clock.origin is None and all(plug.being_read() for plug in plugs):
            clock.start(now + 0.2)
        due = min([now + 0.1, *(began + t for t in events if began + t > now), *(p.device.next_time(now) for p in plugs)])
        ends = {fd: plug for plug in plugs if plug.plugged and (fd := plug.wire.fileno()) is not None}
        for fd in select.select(list(ends), [], [], max(0.0, due - now))[0]:
            plug = ends[fd]
            data = plug.wire.read()
            if data:
                at = time.monotonic()
                plug.send(plug.device.receive(data, at), at, began)
        for plug in plugs:
            at = time.monotonic()
            plug.send(plug.device.advance(at), at, began)
    for plug in plugs:
        plug.wire.unplug()
        if plug.wire.overflow or plug.line.damaged:
            print(f"{plug.name}: {plug.line.damaged} bytes damaged, {plug.wire.overflow} not read by the host", flush=True)


def main(argv=None) -> int:
    """Emulate until interrupted, or until the played log ends."""
    args = parse_arguments(argv)
    world = LogWorld(args.play) if args.play else RoomWorld()
    stop_world = world.length() if args.play and args.until_end else math.inf
    clock = WorldClock(args.speed)
    file = args.truth.open("w", encoding="ascii") if args.truth else None

    def truth(name, at, value) -> None:
        if file and clock.origin is not None:
            file.write(json.dumps([name, round(at, 6), value], separators=(",", ":")) + "\n")

    stopped: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda n, _f: stopped.append(n))
    try:
        run(build(args, clock, world, truth), args, clock, stop_world, lambda: bool(stopped))
    finally:
        if file:
            file.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
