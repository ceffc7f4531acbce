#!/usr/bin/env python3
"""Are the stated uncertainties true? Maps simulated recordings and compares errors with the covariances that uwblite states.

    python tools/consistency.py                              20 recordings of 7 min of each world; writes docs/lab/accuracy.md
    python tools/consistency.py --runs 4 --minutes 4 --only hall --print     a quick look
    python tools/consistency.py --of "corridor, no lidar" --of "lab, one anchor" --minutes 4 --print
    python tools/consistency.py --easy --print               rooms without errors that stay with places
    python tools/consistency.py --set refinement.correlation=8 --print
    python tools/consistency.py --minutes 4 --first 9000 --keep rows.pkl     as many as time allows; the next call goes on

The normalised estimation error squared (NEES) of an estimate with error e and covariance P is e^T P^-1 e; where P is
true, its expectation is the number of dimensions (3 for a pose, 2 for an anchor) and 95 % of the values lie below the
quantile of chi-square. Covariances are relative to the first pose, so the true frame is laid over the map's at the
first pose and not by a best fit: a fit would share the error out over the run and make all of it look better than it
is.
"""

import one_thread  # noqa: F401

import argparse
import os
import pickle
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2
from simulation.laser import NARROW, RIGHT_ANGLE, SPINNING, UNSTATED
from simulation.real_rooms import RealRooms
from simulation.recording import Settings
from trials import ROOT, Trial, made, spread_out, table, write_section

from uwblite import se2
from uwblite.config import override
from uwblite.map_result import MapResult
from uwblite.mapping import MappingConfig, build_map

Floats = NDArray[np.float64]

SENSORS: dict[str, dict[str, Any]] = {
    "one anchor": {"anchors": 1},
    "no lidar": {"without": ("laser",)},
    "no UWB": {"without": ("uwb",)},
}
"""What may be added to a world's name with --of."""
RECORDINGS = {
    "hall": Settings(world="hall"),
    "corridor": Settings(world="corridor"),
    "lab": Settings(world="lab"),
    "warehouse": Settings(world="warehouse", speed=0.4),
    "tunnel, anchors on a line": Settings(world="tunnel", speed=0.4),
    "arena, nearly empty": Settings(world="arena", speed=0.4),
    "hall, bad wheels": Settings(world="hall", odometry_scale=2.0),
    "hall, bad radio": Settings(world="hall", nlos="heavy", nlos_anchors=(3, 4), outliers=0.03),
    "rotunda": Settings(world="rotunda"),
    "orchard": Settings(world="orchard"),
    "supermarket": Settings(world="supermarket"),
    "shed": Settings(world="shed"),
    "hall, spinning lidar": Settings(world="hall", laser=SPINNING),
    "hall, time of rays not stated": Settings(world="hall", laser=UNSTATED),
    "lab, time of rays not stated": Settings(world="lab", laser=UNSTATED),
    "lab, 120 deg": Settings(world="lab", laser=NARROW),
    "lab, 90 deg": Settings(world="lab", laser=RIGHT_ANGLE),
    **{f"hall, {name}": Settings(world="hall", **changes) for name, changes in SENSORS.items()},
}
LONGER = {"warehouse": 3.0}
"""Worlds whose recordings are so many times as long. After 110 m in the warehouse, 60 x 40 m, some anchors are yet measured
from one aisle only, a straight line, and rightly have two places; after 220 m all are from places 2 m or more off a line."""
FIRST_SEED = 1000


@dataclass(frozen=True)
class Consistency:
    """Normalised errors of one recording."""

    name: str
    poses: Floats
    """(k,) NEES of the keyframes but the first; 3 expected."""
    position: Floats
    """(k,) of x and y alone; 2."""
    heading: Floats
    """(k,) of the heading alone; 1."""
    anchors: Floats
    """(a,) 2 expected."""
    error: float
    """m, rms of the positions in the frame of the first pose."""
    stated: float
    """m, rms that the covariances state."""
    unclear: int
    """Anchors that are ambiguous, distrusted or unplaced; their errors do not count."""
    doubted: bool
    """Whether the map is."""


@dataclass(frozen=True)
class Task:
    """A recording and the settings to map it with."""

    name: str
    settings: Settings
    changes: tuple[str, ...]


def nees(error: Floats, covariance: Floats) -> Floats:
    """Return e^T P^-1 e (n,) of errors (n, d) with covariances (n, d, d)."""
    return np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0])


def compare(name: str, result: MapResult, trial: Trial) -> Consistency:
    """Return the normalised errors of a map."""
    truth = se2.interpolate_trajectory(trial.stamps, trial.poses, result.keyframe_stamps)
    T_map_truth = se2.compose(result.graph.poses[0], se2.inverse(truth[0]))
    error = result.graph.poses - se2.compose(T_map_truth, truth)
    error[:, 2] = se2.wrap_angle(error[:, 2])
    error, covariance = error[1:], result.keyframe_covariances[1:]
    placed = [a for a in result.anchors if a.status == "ok"]
    # No anchor was moved: where a map gives one two places, both are compared with its own.
    true = [trial.anchors[a.id if a.id in trial.anchors else a.id.rpartition("@")[0]] for a in placed]
    off = np.array([a.position - se2.transform(T_map_truth, t) for a, t in zip(placed, true, strict=True)]).reshape(-1, 2)
    spread = np.array([a.covariance for a in placed]).reshape(-1, 2, 2)
    return Consistency(
        name,
        nees(error, covariance),
        nees(error[:, :2], covariance[:, :2, :2]),
        error[:, 2] ** 2 / covariance[:, 2, 2],
        nees(off, spread),
        float(np.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=1)))),
        float(np.sqrt(np.mean(covariance[:, 0, 0] + covariance[:, 1, 1]))),
        len(result.anchors) - len(placed),
        bool(result.doubts),
    )


def settings_of(name: str) -> Settings:
    """Return the settings of a row, or of a world with other sensors, as "lab, one anchor, no lidar".

    Raises
    ------
    KeyError : there is no such world, or no such sensors.
    """
    if name in RECORDINGS:
        return RECORDINGS[name]
    world, *sensors = name.split(", ")
    worlds = {row.partition(", ")[0]: settings for row, settings in reversed(RECORDINGS.items())}
    changes = {key: value for sensor in sensors for key, value in SENSORS[sensor].items()}
    return replace(worlds[world], **changes)


def work(task: Task) -> Consistency:
    """Simulate a recording, map it and compare; the grid does not matter and is drawn coarsely."""
    trial = made(task.settings)
    config = override(MappingConfig(), ("grid.resolution=0.5", *task.changes))
    return compare(task.name, build_map(trial.log, config), trial)


def kept(file: Path | None) -> dict[tuple[str, int], Consistency]:
    """Return what earlier calls found, by world and seed."""
    return pickle.loads(file.read_bytes()) if file is not None and file.exists() else {}


def keep(file: Path | None, found: dict[tuple[str, int], Consistency]) -> None:
    """Keep what was found for later calls."""
    if file is not None:
        beside = file.with_name(file.name + ".tmp")
        beside.write_bytes(pickle.dumps(found))
        os.replace(beside, file)


def row(name: str, some: Sequence[Consistency]) -> list[object]:
    """Return a row of the table: means over recordings, and shares of all values below the quantile of 95 %."""
    def inside(values: list[Floats], dimensions: int) -> str:
        if not sum(map(len, values)):
            return "-"
        return f"{100.0 * float(np.mean(np.concatenate(values) < chi2.ppf(0.95, dimensions))):.0f} %"

    anchors = np.concatenate([c.anchors for c in some])
    return [
        name, len(some),
        *(f"{np.mean([np.mean(getattr(c, part)) for c in some]):.1f}" for part in ("poses", "position", "heading")),
        f"{np.median(np.concatenate([c.poses for c in some])):.1f}",
        inside([c.poses for c in some], 3),
        float(np.sqrt(np.mean([c.error**2 for c in some]))), float(np.sqrt(np.mean([c.stated**2 for c in some]))),
        *(f"{f(anchors):.1f}" if len(anchors) else "-" for f in (np.mean, np.median)),
        inside([c.anchors for c in some], 2), sum(c.unclear for c in some), sum(c.doubted for c in some),
    ]


HEAD = (
    "recording", "runs", "pose (3)", "x, y (2)", "heading (1)", "pose, median (2.4)", "pose, inside 95 %", "error", "stated",
    "anchor (2)", "anchor, median (1.4)", "anchor, inside 95 %", "anchors not ok", "doubted",
)


def document(found: Sequence[Consistency], minutes: float, easy: bool) -> str:
    """Return the section of the page."""
    real = "rooms whose errors stay with places, walls and directions (tools/simulation/real_rooms.py)"
    rooms = "easy rooms" if easy else real
    names = list(dict.fromkeys(c.name for c in found))
    rows = [row(n, [c for c in found if c.name == n]) for n in names]
    rows.append(row("all", found))
    return (
        f"## Are the stated uncertainties true? {'Easy' if easy else 'Real'} rooms\n\n{len(found)} simulated recordings of "
        f"{minutes:g} min (warehouse: {minutes * LONGER['warehouse']:g}) in {rooms}. Normalised errors\n"
        "squared (in brackets what is expected of true\ncovariances), in the frame of the first pose, relative to which the "
        "covariances are; the share of them inside the\nquantile of 95 %; rms error and rms stated standard deviation of the "
        "positions, m; anchors that are not ok (not counted), and maps that are doubted.\n\n" + table(HEAD, rows)
    )


def main(argv: list[str] | None = None) -> int:
    """Run the command line."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--runs", type=int, default=20, metavar="N", help="recordings of each world (20)")
    p.add_argument("--only", action="append", default=[], metavar="WORD", help="worlds whose names contain it; repeatable")
    p.add_argument("--of", action="append", default=[], metavar="NAME", help='a world and its sensors instead of those worlds, '
                   'as "corridor, no lidar"; repeatable')
    p.add_argument("--easy", action="store_true", help="rooms without errors that stay with places, walls and floors")
    p.add_argument("--first", type=int, default=FIRST_SEED, metavar="SEED", help=f"seed of the first recordings ({FIRST_SEED})")
    p.add_argument("--minutes", type=float, default=7.0, metavar="N", help="length of each (7)")
    p.add_argument("--out", type=Path, default=ROOT / "docs" / "lab" / "accuracy.md", metavar="FILE", help="page to write into")
    p.add_argument("--print", action="store_true", help="print instead of writing")
    p.add_argument("--set", metavar="NAME=VALUE", action="append", default=[], help="change a setting; repeatable")
    p.add_argument("--keep", type=Path, metavar="FILE", help="add to the recordings kept in FILE, which must be of one state")
    p.add_argument("--jobs", type=int, default=2, metavar="N", help="processes (2)")
    args = p.parse_args(argv)
    for name in args.of:
        try:
            settings_of(name)
        except KeyError as error:
            worlds = sorted({row.partition(", ")[0] for row in RECORDINGS})
            p.error(f"--of {name!r}: there is no {error}; worlds are {worlds}, sensors {list(SENSORS)}")
    rooms = None if args.easy else RealRooms()
    chosen = args.of or [name for name in RECORDINGS if not args.only or any(word in name for word in args.only)]
    found = kept(args.keep)
    seeds = range(args.first, args.first + args.runs)
    changes = {"scan_rate": 5.0, "rooms": rooms}
    tasks = []
    for name, seed in ((name, seed) for seed in seeds for name in chosen if (name, seed) not in found):
        settings = replace(settings_of(name), seed=seed, minutes=args.minutes * LONGER.get(name, 1.0), **changes)
        tasks.append(Task(name, settings, tuple(args.set)))
    for task, c in zip(tasks, spread_out(work, tasks, args.jobs), strict=True):
        found[task.name, task.settings.seed] = c
        keep(args.keep, found)
        found_text = f"poses {c.poses.mean():.2f}, anchors {c.anchors.mean() if len(c.anchors) else float('nan'):.2f}"
        found_text += f", {c.error:.4f} m of {c.stated:.4f} m stated"
        print(f"{len(found)} recordings, {c.name}: {found_text}", file=sys.stderr, flush=True)
    order = list(dict.fromkeys([*RECORDINGS, *(name for name, _ in found)]))
    text = document([found[key] for key in sorted(found, key=lambda k: order.index(k[0]))], args.minutes, args.easy)
    if args.print:
        print(text)
    else:
        write_section(args.out, "consistency" if args.easy else "consistency in real rooms", text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
