#!/usr/bin/env python3
"""Does a wrong result say that it is wrong? Puts faults of sensors and users into recordings and maps them.

    python tools/faults.py                               3 min of a lab; writes into docs/lab/accuracy.md
    python tools/faults.py --only frozen                 cases whose names contain a word; the page stays
    python tools/faults.py --worlds hall,kasdorf --minutes 5 --sensors all,no-lidar --print
    python tools/faults.py --sound                       sound recordings of every world and robot: false alarms alone

A map is wrong when its trajectory is off by more than 0.5 m (rms), or an anchor that is called ok by more than 1 m and
three standard deviations. The truth of a real recording is its map without a fault, whose own standard deviations count as
well. Without lidar and without given anchors nothing but the odometry distinguishes a map from its mirror image: there the
result is judged up to reflection.
"""

import one_thread  # noqa: F401

import argparse
import signal
import sys
import time
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np
from faulting.case import Case, Fault, Floats, Ints
from faulting.causes import causes_of
from faulting.every import FAULTS
from faulting.logs import two_buildings, two_robots
from faulting.outcome import ANCHOR_BAR, CRASHED, VERDICTS, Outcome, by_kind, counted, summary
from simulation.laser import NARROW, SPINNING, UNSTATED
from simulation.plans import PLANS
from simulation.real_rooms import RealRooms
from simulation.recording import Settings
from trials import ROOT, SHARED, made, table, write_section

from uwblite import se2
from uwblite.assessment.recording import diagnose
from uwblite.errors import UwbliteError
from uwblite.findings import DOUBT, folded
from uwblite.io.carmen import read_log
from uwblite.io.carmen_stamps import time_order
from uwblite.map_result import AnchorEstimate, MapResult
from uwblite.mapping import build_map
from uwblite.sensor_log import Odometry, SensorLog, UwbRanges

TIME_BAR = 60.0
"""s."""
SLIPS: dict[str, Any] = {"slips": 3, "spin": 0.6, "speed": 0.4, "scan_rate": 5.0}
ROBOTS: dict[str, dict[str, Any]] = {
    "": {},
    ", spinning lidar and slips": SLIPS | {"laser": SPINNING},
    ", narrow lidar and slips": SLIPS | {"laser": NARROW},
    ", real rooms and people": {"rooms": RealRooms(), "people": 2, "laser": UNSTATED, "speed": 0.4, "scan_rate": 5.0},
}
"""Settings of robots without faults, by what is added to the name of their world; wheels slip at 0.6 m/s for seconds."""


def sorted_log(case: Case) -> tuple[SensorLog, Floats]:
    """Return the recording as a reader gives it, sorted by time, and the truth in that order."""
    log, warnings, set_back = case.log, list[str](), dict[str, float]()

    def ordered(sensor: str, stamps: Floats) -> tuple[Floats, Ints]:
        stated = stamps + case.clocks.get(sensor, 0.0)
        order = time_order(stated, sensor, warnings, set_back)
        return stated[order], order

    stamps, order = ordered("odometry", log.odometry.stamps)
    truth = case.truth[order]
    log = replace(log, odometry=Odometry(stamps, log.odometry.poses[order]))
    if log.ranges is not None:
        r = log.ranges
        stamps, order = ordered("radio", r.stamps)
        log = replace(log, ranges=UwbRanges(stamps, r.anchor[order], r.ranges[order], r.quality[order], r.anchor_ids))
    if log.scans is not None:
        stamps, order = ordered("lidar", log.scans.stamps)
        log = replace(log, scans=replace(log.scans, stamps=stamps, ranges=log.scans.ranges[order]))
    return replace(log, notes=replace(log.notes, warnings=tuple(warnings), set_back=set_back)), truth


def _stopped(signum: int, frame: object) -> None:
    raise TimeoutError(f"stopped after {TIME_BAR:.0f} s")


def judged(
    result: MapResult, truth_stamps: Floats, truth: Floats, case: Case, reflect: bool
) -> tuple[float, float, float]:
    """Return the ATE, the worst error of an anchor called ok, and by how much it exceeds its bar, m."""
    rows_ = np.clip(np.searchsorted(truth_stamps, result.stamps), 0, len(truth_stamps) - 1)
    true = truth[rows_, :2]
    best: tuple[float, float, float] | None = None
    for mirror in (False, True) if reflect else (False,):
        sign = np.array([1.0, -1.0 if mirror else 1.0])
        move = _fit(result.trajectory[:, :2] * sign, true)
        ate = float(np.sqrt(np.mean(np.sum((se2.transform(move, result.trajectory[:, :2] * sign) - true) ** 2, axis=1))))
        worst, beyond = float("nan"), -np.inf
        for anchor, until in zip(result.anchors, _ends(result.anchors), strict=True):
            name = anchor.id.partition("@")[0]
            if anchor.status != "ok" or not case.anchors.get(name):
                continue
            # One that is said to have moved at another time than it did, or not at all, is judged by where it stood longest.
            place = case.place(name, anchor.since if np.isfinite(anchor.since) else -np.inf, until)
            off = float(np.hypot(*(se2.transform(move, anchor.position * sign) - place)))
            sigma = float(np.hypot(_largest_sigma(anchor.covariance), case.known.get(name, 0.0)))
            worst, beyond = np.fmax(worst, off), max(beyond, off - ANCHOR_BAR - 3.0 * sigma)
        if best is None or ate < best[0]:
            best = (ate, float(worst), float(beyond))
    assert best is not None
    return best


def _ends(anchors: Sequence[AnchorEstimate]) -> list[float]:
    """Return until when each row of the anchors holds, s; inf where no later row is of the same anchor."""
    names = [a.id.partition("@")[0] for a in anchors]
    later = ((b.since for other, b in zip(names, anchors, strict=True) if other == name and b.since > a.since)
             for name, a in zip(names, anchors, strict=True))  # fmt: skip
    return [min(times, default=float("inf")) for times in later]


def _largest_sigma(covariance: Floats) -> float:
    """Return the standard deviation in the direction in which it is largest."""
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))


def _fit(points: Floats, onto: Floats) -> Floats:
    """Return the motion (3,) that lays points (n, 2) onto others best (least squares)."""
    a, b = points - points.mean(axis=0), onto - onto.mean(axis=0)
    angle = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b))
    at = onto.mean(axis=0) - se2.rotate(np.array(angle), points.mean(axis=0))
    return np.array([*at, angle])


def tried(task: tuple[str, str, str, Case, Fault]) -> Outcome:
    """Put a fault into a case and map it."""
    world, name, sensors, case, fault = task
    case = replace(case, log=case.log.without(lidar=sensors == "no-lidar", uwb=sensors == "no-uwb"))
    case = fault(case, np.random.default_rng(7))
    figures = (float("nan"), float("nan"), -np.inf)
    stated: tuple[str, ...] = ()
    kinds: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    check, seconds = -1, 0.0
    log, truth = sorted_log(case)
    began = time.process_time()
    signal.signal(signal.SIGPROF, _stopped)
    signal.setitimer(signal.ITIMER_PROF, TIME_BAR)
    try:
        result = build_map(log)
        figures = judged(result, log.odometry.stamps, truth, case, sensors == "no-lidar")
        stated, warnings = tuple(map(str, result.doubts)), tuple(map(str, result.warnings))
        kinds = tuple(cause.kind for cause, rest in folded(result.findings) if any(f.severity == DOUBT for f in (cause, *rest)))
        code, seconds = 3 if result.doubts else 0, time.process_time() - began
        signal.setitimer(signal.ITIMER_PROF, TIME_BAR)
        check = checked(log, result=result)
    except TimeoutError as error:
        stated, code = (str(error),), CRASHED
    except UwbliteError as error:
        stated, code = (str(error),), 1
        check = checked(log, refused=str(error))
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        stated, code = (f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno})",), CRASHED
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
    seconds = seconds or time.process_time() - began
    return Outcome(world, name, sensors, *figures, code, stated, kinds, check, seconds, warnings, causes_of(name))


WITH_ANOTHER = {"two robots in one log": two_robots, "two buildings in one log": two_buildings}
"""Faults that need a second recording."""
Task = tuple[str, str, str, Case, Fault]
_tasks: list[Task] = []
"""What forked processes find in their memory: faults are functions and do not travel."""


def _numbered(number: int) -> Outcome:
    return tried(_tasks[number])


def outcomes(tasks: Sequence[Task], jobs: int) -> Iterator[Outcome]:
    """Try all tasks, in order, in so many processes."""
    _tasks[:] = tasks
    if jobs == 1:
        yield from map(_numbered, range(len(tasks)))
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("fork")) as pool:
        yield from pool.map(_numbered, range(len(tasks)))


def checked(log: SensorLog, **map_says: Any) -> int:
    """Return the exit code of `uwblite check`, which makes the same map: 3 where it doubts the recording."""
    return 3 if diagnose(log, **map_says).doubts else 0


def clean_cases(worlds: Sequence[str], minutes: float, seed: int, robots: Sequence[str] = ("",)) -> dict[str, Case]:
    """Return the recordings that faults are put into, by world and robot."""
    cases = {}
    for world, robot in product(worlds, robots):
        if world == "kasdorf":
            cases[world] = real_case(SHARED / "kasdorf_2017-11-17-12-31-28" / "run.log.gz")
            continue
        trial = made(Settings(world=world, minutes=minutes, seed=seed, **ROBOTS[robot]))
        truth = np.column_stack([np.interp(trial.log.odometry.stamps, trial.stamps, c) for c in _unwrapped(trial.poses).T])
        cases[world + robot] = Case(trial.log, truth, {name: [place] for name, place in trial.anchors.items()})
    return cases


def another_place(world: str) -> str:
    """Return the world that follows in the table of all, of another plan."""
    worlds = list(PLANS)
    return worlds[(worlds.index(world) + 1) % len(worlds)]


def _unwrapped(poses: Floats) -> Floats:
    return np.column_stack([poses[:, :2], np.unwrap(poses[:, 2])])


def real_case(path: Path) -> Case:
    """Return a real recording; what is true of it is what its map says without any fault."""
    log = read_log(path)
    result = build_map(log)
    placed = [a for a in result.anchors if a.status == "ok"]
    known = {a.id: _largest_sigma(a.covariance) for a in placed}
    return Case(log, result.trajectory, {a.id: [a.position] for a in placed}, known)


def line(outcome: Outcome) -> str:
    """Return what became of a case in one line of text."""
    anchor = f"anchor {outcome.anchor:.3f}, exit code {outcome.exit_code}, check {outcome.check}, {outcome.seconds:.0f} s"
    case = f"{outcome.world} | {outcome.name} | {outcome.sensors}"
    kinds = "" if outcome.named is not False else f"[told first: {outcome.kinds[0] if outcome.kinds else outcome.stated[0]}] "
    return f"{case} | {outcome.verdict} | ATE {outcome.ate:.3f}, {anchor} | {kinds}{'; '.join(outcome.stated)}"


def write_page(page: Path, done: Sequence[Outcome], minutes: float) -> None:
    """Write the tables of all outcomes, and the line that sums them up, between their marks in the page."""
    words = "\n".join(f"- *{verdict}*: {meaning}" for verdict, meaning in VERDICTS.items())
    meaning = (__doc__ or "").split("\n\n")[-1].strip()
    text = (
        f"## Faults\n\nFaults of sensors and of users, put into {minutes:g} min of a simulated recording or into a real one.\n"
        f"{meaning}\n\n{words}\n\n{summary(done)}.\n\n{table(*counted(done))}\n"
        "### Every kind of fault\n\nThe number is the error of the trajectory (ATE), m. The last column has the kinds of all "
        "doubts of the row, the most\nfrequent first; [findings.md](../findings.md) explains them.\n\n"
        f"{table(*by_kind(done))}"
    )
    write_section(page, "faults", text)
    write_section(page, "faults in short", f"{summary(done)}.")


def main(argv: list[str] | None = None) -> int:
    """Run the command line."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--worlds", help="simulated ones, and kasdorf; lab, with --sound all that are simulated")
    p.add_argument("--minutes", type=float, default=3.0)
    p.add_argument("--seed", type=int, default=1)
    only = "faults whose names contain it; repeatable; the page stays"
    p.add_argument("--only", action="append", default=[], metavar="WORD", help=only)
    p.add_argument("--sensors", default="all,no-lidar,no-uwb")
    p.add_argument("--jobs", type=int, default=1, metavar="N", help="processes (1)")
    p.add_argument("--sound", action="store_true", help="no fault at all, in every world unless --worlds names some")
    p.add_argument("--print", action="store_true", help="do not write docs/lab/accuracy.md")
    p.add_argument("--verbose", action="store_true", help="show warnings too")
    args = p.parse_args(argv)
    worlds, tasks = (args.worlds or (",".join(PLANS) if args.sound else "lab")).split(","), []
    cases = clean_cases(worlds, args.minutes, args.seed, list(ROBOTS) if args.sound else [""])
    for world, case in cases.items():
        for name, (fault, kinds) in FAULTS.items():
            if (args.sound and name != "none") or (args.only and not any(word in name for word in args.only)):
                continue
            if name in WITH_ANOTHER:
                if world == "kasdorf":
                    continue
                there = another_place(world) if name == "two buildings in one log" else world
                fault = WITH_ANOTHER[name](clean_cases([there], args.minutes, args.seed + 1)[there])
            tasks += [(world, name, s, case, fault) for s in kinds if s in args.sensors.split(",")]
    done = []
    for outcome in outcomes(tasks, args.jobs):
        done.append(outcome)
        print(line(outcome), flush=True)
        if args.verbose:
            print(*(f"      warning: {w}" for w in outcome.warnings), sep="\n", flush=True)
    print(summary(done))
    if not args.print and not args.only and not args.sound:
        write_page(ROOT / "docs" / "lab" / "accuracy.md", done, args.minutes)
    return 1 if any(o.verdict.isupper() for o in done) else 0


if __name__ == "__main__":
    sys.exit(main())
