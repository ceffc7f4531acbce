#!/usr/bin/env python3
"""How a live localisation starts, tracks and recovers in maps of other recordings; writes docs/navigation.md.

    python tools/localization.py                          hall, lab and warehouse: a quarter of an hour
    python tools/localization.py --only lab --starts 10   a part of it
    python tools/localization.py --print                  nothing written

A map is made of one simulated recording, a second recording of another drive by another robot, from another day, is played
against it. Starts: so many moments of the second recording, nothing known; a start that is found more than 0.5 m or 0.3 rad
off the truth is a wrong one. Errors are in the map's frame as it lies over the building: the map's own errors are in them.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from simulation.recording import Settings
from trials import ROOT, Trial, made, table, write_section

from uwblite import se2
from uwblite.evaluation.trajectory import evaluate_trajectory
from uwblite.io.result_text import RunRecord
from uwblite.io.results import write_result
from uwblite.io.stored_result import read_result
from uwblite.localization import Localizer, LocalizerState, Scanner
from uwblite.localization.known_map import KnownMap, from_result
from uwblite.mapping import build_map

WORLDS = {"hall": 20.0, "lab": 10.0, "warehouse": 40.0}
"""Minutes of the recording that the map is made of."""
MOST_WAY = 10.0
"""m of driving in which a start should be found."""
WRONG = (0.5, 0.3)
"""m and rad; a pose that counts as found and is farther off is a wrong one."""
AFTER = 3.0
"""s for which a start is watched after it was found."""


@dataclass(frozen=True)
class Bench:
    """A map and another recording in the same building."""

    world: str
    known: KnownMap
    T_truth_map: np.ndarray
    """(3,)."""
    trial: Trial

    def played(self, start: float, end: float, uwb: bool = True, lidar: bool = True) -> Iterator[tuple[float, int, int]]:
        """Yield (time of arrival, sensor, row) of the measurements between two times, s, as they would come in."""
        log = self.trial.log
        rows = [(log.odometry.stamps, 0, 0.0)]
        if uwb:
            rows.append((log.ranges.stamps, 1, 0.0))
        if lidar:
            rows.append((log.scans.stamps, 2, log.scans.time_increment * (log.scans.ranges.shape[1] - 1)))
        found = [(t + late, kind, k) for stamps, kind, late in rows for k, t in enumerate(stamps) if start <= t < end]
        return iter(sorted(found))

    def localizer(self) -> Localizer:
        """Return one that knows nothing but the map."""
        s = self.trial.log.scans
        scanner = Scanner(s.angle_min, s.angle_increment, s.time_increment, s.range_min, s.range_max)
        return Localizer(self.known, self.trial.log.mounting, scanner)

    def feed(self, localizer: Localizer, kind: int, k: int) -> LocalizerState:
        """Hand over one measurement."""
        log = self.trial.log
        if kind == 0:
            return localizer.add_odometry(log.odometry.stamps[k], *log.odometry.poses[k])
        if kind == 1:
            r = log.ranges
            return localizer.add_ranges(r.stamps[k], [r.anchor_ids[r.anchor[k]]], [r.ranges[k]])
        return localizer.add_scan(log.scans.stamps[k], log.scans.ranges[k])

    def truth(self, stamps: np.ndarray) -> np.ndarray:
        """Return the true poses (n, 3) in the map's frame."""
        poses = se2.interpolate_trajectory(self.trial.stamps, self.trial.poses, stamps)
        return se2.compose(se2.inverse(self.T_truth_map), poses)

    def errors(self, states: list[LocalizerState]) -> np.ndarray:
        """Return the errors (n, 2) of states, m and rad."""
        off = se2.between(self.truth(np.array([s.stamp for s in states])), np.array([s.pose for s in states]))
        return np.column_stack([np.hypot(off[:, 0], off[:, 1]), np.abs(off[:, 2])])


def bench(world: str, minutes: float, seed: int) -> Bench:
    """Make the map and the other recording."""
    base = Settings(world=world, building=7)
    first = made(replace(base, seed=seed, minutes=minutes, scan_rate=5.0))
    result = build_map(first.log)
    with tempfile.TemporaryDirectory(prefix="uwblite-") as folder:
        write_result(Path(folder) / "map", [first.log], result, RunRecord("tools/localization.py", ""))
        known = from_result(read_result(Path(folder) / "map"))
    path = evaluate_trajectory(result.stamps, result.trajectory, first.stamps, first.poses)
    return Bench(world, known, path.T_truth_map, made(replace(base, seed=seed + 1, minutes=10.0)))


@dataclass(frozen=True)
class Start:
    """What became of a start."""

    way: float
    """m driven until it was found; inf = not within MOST_WAY."""
    wrong: bool


def start(on: Bench, begin: float, uwb: bool = True, lidar: bool = True) -> Start:
    """Begin at a time of the recording, knowing nothing."""
    localizer, states, found = on.localizer(), [], np.inf
    true = on.trial.poses[:, :2]
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(true, axis=0).T))])
    zero = float(np.interp(begin, on.trial.stamps, way))
    for at, kind, k in on.played(begin, begin + 120.0, uwb, lidar):
        state = on.feed(localizer, kind, k)
        driven = float(np.interp(at, on.trial.stamps, way)) - zero
        if not state.lost:
            states.append(state)
            found = min(found, driven)
        if (driven > MOST_WAY and not states) or (states and state.stamp > states[0].stamp + AFTER):
            break
    wrong = bool(states) and bool((on.errors(states) > WRONG).any())
    return Start(found, wrong)


@dataclass(frozen=True)
class Track:
    """How a whole recording was tracked."""

    rms: float
    """m, while it was not lost."""
    worst: float
    """m."""
    lost: float
    """Share of the time after the start in which it was lost."""
    per_scan: float
    """ms of processor time."""


def track(on: Bench, seconds: float, uwb: bool = True, lidar: bool = True) -> Track:
    """Play a recording from its beginning."""
    localizer, states, begin = on.localizer(), [], float(on.trial.log.odometry.stamps[0])
    clock, scans = time.process_time(), 0
    for _, kind, k in on.played(begin, begin + seconds, uwb, lidar):
        state = on.feed(localizer, kind, k)
        scans += kind == 2
        if kind == 0:
            states.append(state)
    spent = time.process_time() - clock
    lost = np.array([s.lost for s in states])
    if lost.all():
        return Track(np.nan, np.nan, 1.0, np.nan)
    first = int(np.argmin(lost))
    error = on.errors([s for s in states if not s.lost])[:, 0]
    per_scan = 1e3 * spent / scans if scans else np.nan
    return Track(float(np.sqrt(np.mean(error**2))), float(error.max()), float(lost[first:].mean()), per_scan)


def carried(on: Bench, leave: float, arrive: float) -> tuple[float, bool]:
    """Lift the robot at one time of the recording and set it down where it was at another one.

    Returns
    -------
    Seconds until the pose is right again and not lost; whether it said that it was lost meanwhile.
    """
    localizer, log = on.localizer(), on.trial.log
    stamps, poses = log.odometry.stamps, log.odometry.poses
    for _, kind, k in on.played(leave - 60.0, leave):
        on.feed(localizer, kind, k)
    ends = se2.interpolate_trajectory(stamps, poses, np.array([leave, arrive]))
    moved = se2.compose(ends[0], se2.between(ends[1], poses))
    shift, stated = leave + 0.1 - arrive, False
    for _, kind, k in on.played(arrive, arrive + 60.0):
        if kind == 0:
            state = localizer.add_odometry(stamps[k] + shift, *moved[k])
        elif kind == 1:
            r = log.ranges
            state = localizer.add_ranges(r.stamps[k] + shift, [r.anchor_ids[r.anchor[k]]], [r.ranges[k]])
        else:
            state = localizer.add_scan(log.scans.stamps[k] + shift, log.scans.ranges[k])
        stated |= state.lost
        if stated and not state.lost:
            there = replace(state, stamp=state.stamp - shift)
            if (on.errors([there])[0] < WRONG).all():
                return there.stamp - arrive, stated
    return np.inf, stated


def with_moved_anchor(on: Bench) -> Bench:
    """Return the bench with one anchor of the map somewhere else than it stands."""
    places = on.known.anchors.positions.copy()
    places[0] += (2.0, 1.0)
    return replace(on, known=replace(on.known, anchors=replace(on.known.anchors, positions=places)))


KINDS = {"all sensors": (True, True), "without lidar": (True, False), "without UWB": (False, True)}


def start_row(on: Bench, name: str, count: int) -> list[object]:
    """Return the row of many starts."""
    begin, end = on.trial.log.odometry.stamps[[0, -1]].tolist()
    moments = np.linspace(begin + 3.0, end - 75.0, count)
    found = [start(on, float(t), *KINDS[name]) for t in moments]
    ways = np.array([s.way for s in found])
    within = np.isfinite(ways)
    typical, slow = (float(np.quantile(ways[within], q)) if within.any() else np.nan for q in (0.5, 0.95))
    shown = [f"{v:.1f}" if np.isfinite(v) else "-" for v in (typical, slow)]
    return [name, count, f"{within.mean():.0%}", *shown, sum(s.wrong for s in found)]


def track_rows(on: Bench, seconds: float) -> list[list[object]]:
    """Return the rows of tracking with all sensors, without some, and with an anchor moved."""
    rows = [(name, track(on, seconds, *used)) for name, used in KINDS.items()]
    rows.insert(1, ("one anchor moved by 2.2 m", track(with_moved_anchor(on), seconds)))
    spent = [f"{t.per_scan:.1f}" if np.isfinite(t.per_scan) else "-" for _, t in rows]
    return [[name, t.rms, t.worst, f"{t.lost:.1%}", cpu] for (name, t), cpu in zip(rows, spent, strict=True)]


def carried_row(on: Bench, count: int) -> list[object]:
    """Return the row of robots that were carried away."""
    begin, end = on.trial.log.odometry.stamps[[0, -1]].tolist()
    leave = np.linspace(begin + 65.0, 0.5 * (begin + end), count)
    times = [carried(on, float(t), float(t) + 0.4 * (end - begin)) for t in leave]
    after = np.array([t for t, _ in times])
    typical = f"{np.median(after):.1f}" if np.isfinite(np.median(after)) else "-"
    return [count, sum(stated for _, stated in times), f"{np.mean(after <= 10.0):.0%}", typical]


def main(argv: list[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default=",".join(WORLDS), help="worlds, separated by commas")
    parser.add_argument("--starts", type=int, default=100)
    parser.add_argument("--carried", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=480.0, help="of tracking")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--print", action="store_true", help="write nothing")
    args = parser.parse_args(argv)
    for world in args.only.split(","):
        text = report(bench(world, WORLDS[world], args.seed), args.starts, args.carried, args.seconds)
        print(text, flush=True)
        if not args.print:
            write_section(ROOT / "docs" / "navigation.md", f"localization {world}", text)
    return 0


def report(on: Bench, starts: int, lifted: int, seconds: float) -> str:
    """Return the tables of one world."""
    few = max(starts // 10, 2)
    rows = [start_row(on, name, starts if name == "all sensors" else few) for name in KINDS]
    head = (on.world, "starts", f"found within {MOST_WAY:.0f} m", "median, m driven", "95 %, m", "wrong")
    parts = [table(head, rows)]
    parts.append(table((f"{on.world}, tracking", "rms, m", "worst, m", "lost", "CPU per scan, ms"), track_rows(on, seconds)))
    head = (f"{on.world}, carried away", "said lost", "found again within 10 s", "median, s")
    parts.append(table(head, [carried_row(on, lifted)]))
    return "\n".join(parts)


if __name__ == "__main__":
    sys.exit(main())
