"""Every device against every kind of link: false readings, what is missing and what was said, stamps, CPU and memory.

    python tools/device_trials.py                     all devices and links, a table in Markdown
    python tools/device_trials.py scip tlv --link noise --seconds 60

Sessions talk to the emulators in simulated time, so that the machine's load does not matter. A reading is false when the
emulator never sent it; a stamp's error is against the emulator's own time. Missing counts what was sent after the first
reading and did not come; lost is what the session counts. Processor time is that of the session alone, memory what it
holds at the end. A scan of a spinning lidar is false where more than one ray in a hundred differs from the room by 6 cm.
"""

import argparse
import math
import random
import sys
import time
from bisect import bisect_left
from collections import deque
from itertools import pairwise
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parent), str(Path(__file__).resolve().parents[1])]

from emulators.dwm_device import DwmDevice
from emulators.faults import FaultyLine, parse_fault
from emulators.kobuki_device import Create2Device, GyroLineDevice, KobukiDevice, TickLineDevice
from emulators.scip_device import ScipDevice
from emulators.simulated_time import of_kind, simulate
from emulators.spinning_device import FAR, LIDARS
from emulators.uwb_boards import BOARDS, UwbBoard
from emulators.world import RoomWorld, WorldClock

from uwblite.drivers.devices import open_device
from uwblite.drivers.events import GyroHeading, LaserScan, Lost, Note, OdometryPose, RangeEpoch
from uwblite.drivers.session import Session

START = 1000.0
TICKS = "columns=t,left,right&tick=1e-4&wheel_base=0.3&time_unit=0.001"
LINES = "columns=t,id,range,quality&prefix=UWB&unit=0.001&time_unit=0.001"
BASES = {"kobuki": KobukiDevice, "line": TickLineDevice, "create2": Create2Device}
DEVICES = {
    "scip": ("lidar", "scip:port"), "tlv": ("uwb", "tlv:port"), "shell": ("uwb", "shell:port"),
    "kobuki": ("odometry", "kobuki:port"), "line": ("odometry", f"line:port?{TICKS}"),
    "create2": ("odometry", "create2:port"),
    "gyro": ("gyro", "line:port?columns=t,turn_rate&time_unit=0.001&angle_unit=0.017453292519943295"),
    **{name: ("lidar", f"{name}:port") for name in LIDARS}, "rplidar-standard": ("lidar", "rplidar:port?standard=1"),
    **{name: ("uwb", f"uwb-line:port?{LINES}" if name == "line" else f"{name}:port") for name in BOARDS if name != "line"},
    "uwb-line": ("uwb", f"uwb-line:port?{LINES}"),
}  # fmt: skip
PAUSES = {f"{kind}-{seconds:g}": (kind, seconds) for kind in ("stop", "pause", "mute") for seconds in (0.3, 0.6, 6.0)}
LINKS = ("whole", "bytes", "noise", "loss", "replug", "reset", "slow", *PAUSES)
"""As it comes; byte by byte; 1 byte in 2,000 changed; 1 in 2,000 lost; the cable pulled for 3 s; the device's clock or the
device reset; 40 ms round trip, 16 ms steps and up to 10 ms of jitter; the host stopped, the bytes held back, or what the
device sends lost, for so many s."""
HALFWAY = 0.5
STEP, PAUSE = 0.02, 0.25
"""m or rad by which a pose may leave the truth from one reading to the next; s, of a gyro."""
CORNER, FALSE_RAYS = 0.06, 0.01
"""m, share: rays between two readings on both sides of a corner differ by as much."""


class TimedSession(Session):
    """A session that knows its processor time."""

    cpu = 0.0

    def feed(self, data, now):
        """Take bytes."""
        began = time.process_time()
        actions = super().feed(data, now)
        self.cpu += time.process_time() - began
        return actions

    def tick(self, now):
        """Do what is due."""
        began = time.process_time()
        actions = super().tick(now)
        self.cpu += time.process_time() - began
        return actions


def emulator(name, seconds, *, reset):
    """Return an emulated device in the room and the list of (time, content) of what it sends."""
    world, clock, sent = RoomWorld(), WorldClock(), []
    clock.start(START)
    if name == "scip":
        device = ScipDevice(world.scans(), clock, on_scan=lambda t, values: sent.append((t, tuple(values))))
    elif name in ("tlv", "shell"):
        device = DwmDevice(world.epochs(), clock, on_fix=lambda t, rows: sent.append((t, readings(rows, name))))
    elif name in LIDARS:
        device = LIDARS[name](world, clock, on_turn=lambda t: sent.append((t, None)))
    elif sensor_of(name) == "uwb":
        write = BOARDS["line" if name == "uwb-line" else name]
        device = UwbBoard(world.epochs(), clock, write, lambda t, rows: sent.append((t, [mm / 1000 for _, mm, _ in rows])))
    else:
        kind = GyroLineDevice if name == "gyro" else BASES[name]
        plain = (lambda x, y, theta: (theta, 0.0)) if name == "gyro" else (lambda x, y, theta: (x, y))
        device = kind(world.poses(), clock, on_packet=lambda t, *pose: sent.append((t, plain(*pose))))
    if reset:
        advance, done = device.advance, []

        def scripted(now):
            if now > START + HALFWAY * seconds and not done:
                done.append(now)
                if name == "scip":
                    device._power = now
                elif name in ("tlv", "shell"):
                    device._reboot_at = now + 1.0
                elif hasattr(device, "_ms"):
                    device._ms -= 20_000
                else:
                    device.power_up(now)
            return advance(now)

        device.advance = scripted
    return device, sent


def sensor_of(name):
    """Return "lidar", "uwb", "gyro" or "odometry"."""
    return DEVICES[name][0]


def readings(rows, name):
    """Return the ranges of a round as the device prints them."""
    digits = 3 if name == "tlv" else 2
    return tuple((f"{a:04X}", f"{mm / 1000:.{digits}f}") for a, mm, _ in rows)


def measured(name, actions):
    """Return (stamp, content) of what a session measured."""
    if name == "scip":
        return [(scan.stamp, tuple(round(1000 * r) if math.isfinite(r) else 0 for r in scan.ranges))
                for scan in of_kind(actions, LaserScan)]  # fmt: skip
    if name in ("tlv", "shell"):
        digits = 3 if name == "tlv" else 2
        return [(epoch.stamp, tuple((r.anchor_id, f"{r.range:.{digits}f}") for r in epoch.readings))
                for epoch in of_kind(actions, RangeEpoch)]  # fmt: skip
    if name in LIDARS:
        return [(scan.stamp, scan) for scan in of_kind(actions, LaserScan)]
    if sensor_of(name) == "uwb":
        return [(epoch.stamp, [r.range for r in epoch.readings]) for epoch in of_kind(actions, RangeEpoch)]
    if name == "gyro":
        return [(g.stamp, (g.heading, 0.0)) for g in of_kind(actions, GyroHeading)]
    return [(pose.stamp, (pose.x, pose.y)) for pose in of_kind(actions, OdometryPose)]


def judge(name, got, sent):
    """Return the number of false readings and the stamp errors, s."""
    if name in ("tlv", "shell"):
        rounds = [(stamp, set(content)) for stamp, content in sent]
        times = [[stamp for stamp, content in rounds if content >= set(seen)] for _, seen in got]
        errors = [min(abs(stamp - t) for t in found) for (stamp, _), found in zip(got, times, strict=True) if found]
        return len(got) - len(errors), errors
    if name == "scip":
        times = {}
        for stamp, content in sent:
            times.setdefault(content, []).append(stamp)
        errors = [min(abs(stamp - t) for t in times[content]) for stamp, content in got if content in times]
        return len(got) - len(errors), errors
    if name in LIDARS:
        return judge_scans(name, got, [t for t, _ in sent])
    if sensor_of(name) == "uwb":
        return judge_ranges(got, sent)
    stamps, errors, false, shift, before = [t for t, _ in sent], [], 0, (0.0, 0.0), math.nan
    for stamp, pose in got:
        at = bisect_left(stamps, stamp)
        near = min(range(max(0, at - 1), min(len(sent), at + 1)), key=lambda k: abs(stamps[k] - stamp))
        errors.append(abs(stamps[near] - stamp))
        here = pose[0] - sent[near][1][0], pose[1] - sent[near][1][1]
        step = math.remainder(math.hypot(here[0] - shift[0], here[1] - shift[1]), 2 * math.pi if name == "gyro" else math.inf)
        # No damage may move the pose; a gyro's heading is held over a pause.
        false += bool(errors[1:]) and abs(step) > STEP and (name != "gyro" or stamp - before < PAUSE)
        shift, before = here, stamp
    return false, errors


def judge_scans(name, got, turns):
    """Return the number of false scans of a spinning lidar and the stamp errors, s; the truth is what the room looks like."""
    world, errors, false = RoomWorld(), [], 0
    duration = sorted(b - a for a, b in pairwise(turns))[len(turns) // 2]
    turns = [turns[0] - duration, *turns]  # the motor begins at zero
    ahead = -FAR * duration if name.startswith("ydlidar") else 0.0  # its motor's zero stands beside its readings' zero
    for stamp, scan in got:
        errors.append(min(abs(stamp - turn - ahead) for turn in turns))
        count, wrong = len(scan.ranges), 0
        chosen = [i for i in range(0, count, 5) if not math.isnan(scan.ranges[i])]
        for i in chosen:
            time = stamp + i * scan.time_increment - START
            truths = world.look([time] * 3, [(i + side) / count for side in (-1, 0, 1)])
            wrong += min(abs(scan.ranges[i] - mm / 1000) for mm in truths) > CORNER
        false += wrong > max(1, FALSE_RAYS * len(chosen))
    return false, errors


def judge_ranges(got, sent):
    """Return the number of false rounds of a board and the stamp errors, s; a range is right within the centimetre printed."""
    stamps, errors, false = [t for t, _ in sent], [], 0
    for stamp, ranges in got:
        at = bisect_left(stamps, stamp)
        near = range(max(0, at - 2), min(len(sent), at + 2))
        fits = [k for k in near if all(min(abs(r - true) for true in sent[k][1]) < 0.006 for r in ranges)]
        false += not fits
        errors += [min(abs(stamps[k] - stamp) for k in fits)] if fits else []
    return false, errors


def memory(value, seen):
    """Return the bytes that an object and what it holds take."""
    if id(value) in seen or isinstance(value, type) or callable(value):
        return 0
    seen.add(id(value))
    inner = []
    if isinstance(value, dict):
        inner = [*value.keys(), *value.values()]
    elif isinstance(value, list | tuple | set | deque):
        inner = list(value)
    inner += list(vars(value).values()) if hasattr(value, "__dict__") else []
    slots = getattr(type(value), "__slots__", ())
    inner += [getattr(value, name) for name in slots if hasattr(value, name)]
    return sys.getsizeof(value) + sum(memory(part, seen) for part in inner)


def trial(name, link, seconds, seed=0):
    """Run one device on one link and return its row."""
    sensor, spec = DEVICES[name]
    rng = random.Random(seed)
    device, sent = emulator(name, seconds, reset=link == "reset")
    session = TimedSession(open_device(sensor, spec)[0].driver)
    options = {
        "bytes": {"piece": 1}, "noise": {"line": FaultyLine([parse_fault("noise=0.0005@3")], seed)},
        "loss": {"line": FaultyLine([parse_fault("drop=0.0005@3")], seed)}, "replug": {"replug": (HALFWAY * seconds, 3.0)},
        "slow": {"latency": 0.040, "tick": 0.016},
        **{key: {kind: (HALFWAY * seconds, length)} for key, (kind, length) in PAUSES.items()},
    }.get(link, {})  # fmt: skip
    jitter = (lambda: rng.uniform(0, 0.010)) if link == "slow" else (lambda: rng.expovariate(1000.0))
    actions, _ = simulate(session, device, seconds, jitter=jitter, **options)
    got = measured(name, actions)
    false, errors = judge(name, got, sent)
    errors = sorted(errors) or [math.nan]
    ranges = sensor_of(name) == "uwb" and name not in ("tlv", "shell")  # some boards print a line for each range of a round
    weigh = (lambda content: len(content)) if ranges else (lambda content: 1)
    begun = [weigh(content) for t, content in sent if got and got[0][0] - 0.01 <= t <= got[-1][0] + 0.01]
    received = sum(weigh(content) for _, content in got)
    missing = sum(begun) - received
    lost = sum(action.count for action in of_kind(actions, Lost))
    return {
        "device": name, "link": link, "readings": received, "false": false, "missing": missing, "lost": lost,
        "median ms": 1000 * errors[len(errors) // 2], "95 % ms": 1000 * errors[int(0.95 * len(errors))],
        "worst ms": 1000 * errors[-1], "notes": " ".join(sorted({note.name for note in of_kind(actions, Note)})),
        "CPU %": 100 * session.cpu / seconds, "kB": memory(session.driver, set()) // 1000,
    }  # fmt: skip


HEADER = ("device", "link", "readings", "false", "missing", "lost", "median ms", "95 % ms", "worst ms", "CPU %", "kB", "notes")


def grid_row(name, rows):
    """Return one line of a device: for each link ``false, missing, lost, 95 % of the stamps' errors``, and what it costs."""
    cells = [f"{r['false']}, {r['missing']}, {r['lost']}, {r['95 % ms']:.1f}" for r in rows]
    cpu, memory = max(r["CPU %"] for r in rows), max(r["kB"] for r in rows)
    return f"| {name} | " + " | ".join(cells) + f" | {cpu:.1f} | {memory} |"


def main(argv=None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("devices", nargs="*", metavar="DEVICE", help=f"of {', '.join(DEVICES)} (all)")
    parser.add_argument("--link", action="append", choices=LINKS, help="repeatable (all)")
    parser.add_argument("--grid", action="store_true", help="one line a device: false, missing, lost, 95 %% of stamps (ms)")
    parser.add_argument("--seconds", type=float, default=60.0, help="simulated time of each (60)")
    args = parser.parse_args(argv)
    if args.grid:
        print("| device | " + " | ".join(args.link or LINKS) + " | CPU % | kB |\n|" + "---|" * (len(args.link or LINKS) + 3))
    else:
        print("| " + " | ".join(HEADER) + " |\n|" + "---|" * len(HEADER))
    for name in args.devices or DEVICES:
        rows = []
        for link in args.link or LINKS:
            rows.append(trial(name, link, args.seconds))
            if not args.grid:
                cells = [f"{rows[-1][key]:.2f}" if isinstance(rows[-1][key], float) else str(rows[-1][key]) for key in HEADER]
                print("| " + " | ".join(cells) + " |", flush=True)
        if args.grid:
            print(grid_row(name, rows), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
