"""Spinning lidars on the bench: each kind with its emulator, its frames, and what its scans should say."""

import math
from itertools import pairwise

from emulators.spinning_device import LIDARS
from emulators.world import RoomWorld, WorldClock
from helpers.driver_harness import of_kind, simulate

from uwblite.drivers.devices import open_device
from uwblite.drivers.events import LaserScan

SPECS = {name: f"{name}:port" for name in LIDARS} | {"rplidar-standard": "rplidar:port?standard=1"}


def emulator(name, **options):
    """Return an emulated lidar in the room, and the list that the host times of its turns go to."""
    turns, clock = [], WorldClock()
    clock.start(1000.0)
    return LIDARS[name](RoomWorld(), clock, on_turn=turns.append, **options), turns


def run(name, seconds, *, device=None, session=None, **options):
    """Run a lidar's session against its emulator; return the actions and the host times of the turns."""
    device, turns = device or emulator(name)
    session = session or open_device("lidar", SPECS[name])[0]
    actions, reopens = simulate(session, device, seconds, **options)
    return actions, turns, reopens


def frames(name, count):
    """Return what the lidar sends when it is started: the answers, then so many groups of readings, each as bytes."""
    device, _ = emulator(name)
    device.power_up(1000.0)
    answers = [device.receive(bytes(request), 1000.0) for request in starts(name)]
    groups, now = [], 1000.0
    while len(groups) < count:
        now = device.next_time(now)
        groups.append(device.advance(now))
    return [answer for answer in answers if answer], groups


def starts(name):
    """Return the requests after which a lidar streams."""
    return {"lds01": [b"b"], "rplidar": [bytes.fromhex("a582050000000000 22".replace(" ", ""))],
            "rplidar-standard": [b"\xa5\x20"], "ydlidar-x4": [b"\xa5\x60"]}.get(name, [])  # fmt: skip


def stamp_errors(scans, turns, ahead=0.0):
    """Return stamp minus true time of ray 0 of each scan, s; the motor passes zero `ahead` turns too early for it."""
    duration = sorted(b - a for a, b in pairwise(turns))[len(turns) // 2]
    return [min((scan.stamp - turn - ahead * duration for turn in turns), key=abs) for scan in scans]


def range_errors(scans, world=None, every=1):
    """Return |reading - truth|, m, of the readings, each at its own time, and the share of rays without one.

    A reading beside an edge may belong to either side of it: the nearest of the truths within a ray's spacing counts.
    """
    world, errors, unknown, rays = world or RoomWorld(), [], 0, 0
    for scan in scans:
        count = len(scan.ranges)
        looked = range(0, count, every)
        known = [i for i in looked if not math.isnan(scan.ranges[i])]
        rays, unknown = rays + len(looked), unknown + len(looked) - len(known)
        times = [scan.stamp + i * scan.time_increment - 1000.0 for i in known]
        beside = [world.look(times, [(i + side) / count for i in known]) for side in (-1, 0, 1)]
        errors += [min(abs(scan.ranges[i] - mm / 1000) for mm in truths) for i, *truths in zip(known, *beside, strict=True)]
    return errors, unknown / max(rays, 1)


__all__ = ["LIDARS", "SPECS", "LaserScan", "emulator", "frames", "of_kind", "range_errors", "run", "stamp_errors"]
