#!/usr/bin/env python3
"""Are moved anchors found, and only these? Moves anchors of simulated recordings, and leaves all where they are in others.

    python tools/moved_anchors.py                       writes into docs/lab/accuracy.md
    python tools/moved_anchors.py --worlds hall,lab --runs 2 --first 500 --print     a quick look

The ranges keep their errors: each is longer or shorter by what the true distance changes. Rooms are those of
tools/consistency.py, whose errors stay with places. An anchor is moved once, in any direction, between 15 and 85 % of the time.
"""

import one_thread  # noqa: F401

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from consistency import LONGER, settings_of
from faulting.case import Case, Floats
from faulting.radio import elsewhere
from simulation.real_rooms import RealRooms
from simulation.recording import Settings
from trials import ROOT, Trial, made, spread_out, table, write_section

from uwblite.config import override
from uwblite.evaluation.trajectory import evaluate_trajectory
from uwblite.mapping import MappingConfig, build_map
from uwblite.se2 import transform
from uwblite.sensor_log import SensorLog

WORLDS = "hall,lab,corridor,warehouse,arena,tunnel,hall/bad radio"
DISTANCES = (0.0, 1.0, 2.0, 3.0, 6.0)
"""m; 0: all anchors stay."""
EACH_SIDE = 9
"""Ranges before and after a move from which on it counts as one that can be found."""


@dataclass(frozen=True)
class Outcome:
    """What a map says of moved anchors."""

    distance: float
    heard: bool
    """Whether there are enough ranges from both places."""
    found: bool
    error: float
    """Of the second place, m; nan where it was not found."""
    sure: bool
    """Whether the second place is called ok."""
    false: int
    """Other places that no anchor had."""
    doubted: bool


def work(settings: Settings) -> list[Outcome]:
    """Simulate a recording and map it with anchors moved by each distance."""
    trial = made(settings)
    return [tried(trial, settings.seed, distance) for distance in DISTANCES]


def tried(trial: Trial, seed: int, distance: float) -> Outcome:
    """Move an anchor by a distance, m, and map the recording; the grid does not matter and is drawn coarsely."""
    name, log, after, heard = "", trial.log, np.zeros(2), False
    if distance and log.ranges is not None:
        rng = np.random.default_rng([seed, int(distance)])
        name, share = str(rng.choice(sorted(log.ranges.anchor_ids))), float(rng.uniform(0.15, 0.85))
        angle = rng.uniform(0.0, 2.0 * np.pi)
        by = distance * np.array([np.cos(angle), np.sin(angle)])
        log, after, heard = moved(trial, name, by, share), trial.anchors[name] + by, enough(trial, name, share)
    result = build_map(log, override(MappingConfig(), ("grid.resolution=0.5",)))
    path = evaluate_trajectory(result.stamps, result.trajectory, trial.stamps, trial.poses, max_gap=1.0)
    second = [a for a in result.anchors if a.id == f"{name}@2"]
    error = float(np.hypot(*(transform(path.T_truth_map, second[0].position) - after))) if second else float("nan")
    false = sum("@" in a.id for a in result.anchors) - len(second)
    sure = bool(second) and second[0].status == "ok"
    return Outcome(distance, heard, bool(second), error, sure, false, bool(result.doubts))


def moved(trial: Trial, name: str, by: Floats, share: float) -> SensorLog:
    """Return the log with an anchor moved by so much (2,), m, at a share of its time."""
    stamps = trial.log.odometry.stamps
    poses = np.column_stack([trial.poses[:, :2], np.unwrap(trial.poses[:, 2])])
    truth = np.column_stack([np.interp(stamps, trial.stamps, column) for column in poses.T])
    return elsewhere(Case(trial.log, truth, {n: [p] for n, p in trial.anchors.items()}), {name: by}, share).log


def enough(trial: Trial, name: str, share: float) -> bool:
    """Return whether there are ranges enough to an anchor before and after a share of the time."""
    ranges, (first, last) = trial.log.ranges, trial.log.odometry.stamps[[0, -1]]
    assert ranges is not None
    own = ranges.stamps[(ranges.anchor == ranges.anchor_ids.index(name)) & (ranges.ranges > 0.0)]
    before = int(np.sum(own < first + share * (last - first)))
    return min(before, len(own) - before) >= EACH_SIDE


def document(found: Sequence[Outcome], minutes: float, first: int) -> str:
    """Return the section of the page."""
    rows = []
    for distance in DISTANCES:
        own = [o for o in found if o.distance == distance]
        errors = [o.error for o in own if o.found and o.sure]
        rows.append([
            f"{distance:g} m" if distance else "none", len(own), sum(o.heard for o in own), sum(o.found for o in own),
            float(np.median(errors)) if errors else float("nan"), max(errors, default=float("nan")), len(errors),
            sum(o.false > 0 for o in own), sum(o.doubted for o in own),
        ])  # fmt: skip
    head = (
        "moved by", "recordings", f"with {EACH_SIDE} ranges from both places", "found", "error of second places that are ok",
        "worst", "ok", "maps with a false move", "doubted",
    )
    return (
        f"## Moved anchors\n\nOne anchor is moved once in {minutes:g} min (warehouse: {minutes * LONGER['warehouse']:g})\n"
        f"of rooms whose errors stay with places, seeds from {first} on (tools/moved_anchors.py). Errors in m.\n\n"
        + table(head, rows)
    )


def main(argv: list[str] | None = None) -> int:
    """Run the command line."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--worlds", default=WORLDS, help=f"separated by commas ({WORLDS}); / in place of a comma in a name")
    p.add_argument("--runs", type=int, default=3, metavar="N", help="recordings of each world (3)")
    p.add_argument("--minutes", type=float, default=4.0, metavar="N", help="length of each (4)")
    p.add_argument("--first", type=int, default=91000, metavar="SEED", help="seed of the first recordings (91000)")
    p.add_argument("--print", action="store_true", help="print instead of writing docs/lab/accuracy.md")
    p.add_argument("--jobs", type=int, default=1, metavar="N", help="processes (1)")
    args = p.parse_args(argv)
    tasks: list[Settings] = []
    for seed in range(args.first, args.first + args.runs):
        for name in args.worlds.split(","):
            room = settings_of(name.replace("/", ", "))
            minutes = args.minutes * LONGER.get(name, 1.0)
            settings = replace(room, seed=seed, minutes=minutes, scan_rate=5.0, rooms=RealRooms())
            tasks.append(settings)
    found: list[Outcome] = []
    for settings, outcomes in zip(tasks, spread_out(work, tasks, args.jobs), strict=True):
        found += outcomes
        print(f"{settings.world} {settings.seed}:", *outcomes, sep="\n  ", file=sys.stderr, flush=True)
    text = document(found, args.minutes, args.first)
    if args.print:
        print(text)
    else:
        write_section(ROOT / "docs" / "lab" / "accuracy.md", "moved anchors", text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
