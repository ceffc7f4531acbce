#!/usr/bin/env python3
"""What each ingredient buys: every one left out in turn, over hard simulated worlds and recordings of others.

    python tools/ablation.py                                        everything; writes docs/lab/accuracy.md
    python tools/ablation.py --only lab,intel --of surfaces,columns --print    a part of it
    python tools/ablation.py --seeds 3 --jobs 2 --keep rows.pkl     as many as time allows; the next call goes on

An ingredient is left out by settings, or by a function in place of its own. Errors are the ATE or the mean over relations; a
ratio above 1 is what leaving it out costs. An ingredient pays where the worst tenth of the recordings, or the truth of the
stated uncertainties (normalised errors of the poses, 1 expected per degree of freedom), is worse without it.
"""

import one_thread  # noqa: F401

import argparse
import importlib
import os
import pickle
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from consistency import compare
from numpy.typing import NDArray
from simulation.laser import NARROW, SPINNING
from simulation.radio import RadioModel
from simulation.real_rooms import RealRooms
from simulation.recording import Settings
from trials import ROOT, SHARED, judged, made, real_error, spread_out, table, write_section

from uwblite.config import override
from uwblite.io.carmen import read_log
from uwblite.mapping import MappingConfig, build_map
from uwblite.pipeline.estimate import Estimate
from uwblite.pipeline.estimate import Task as Pipeline
from uwblite.sensor_log import SensorLog

Floats = NDArray[np.float64]
Patch = tuple[str, Callable[..., Any]]


@dataclass(frozen=True)
class LeftOut:
    """How an ingredient is left out."""

    settings: tuple[str, ...] = ()
    patches: tuple[Patch, ...] = ()
    """Functions of the package, as "module.function", and what stands in for each."""
    log: Callable[[SensorLog], SensorLog] | None = None
    """What is done to the recording."""


def flat(log: SensorLog) -> SensorLog:
    """Return the recording as if all rays of a sweep had been taken at its middle."""
    scans = log.scans
    if scans is None:
        return log
    middle = scans.stamps + 0.5 * scans.time_increment * (scans.ranges.shape[1] - 1)
    return replace(log, scans=replace(scans, stamps=middle, time_increment=0.0))


def _fixed(*names: str) -> LeftOut:
    return LeftOut(tuple(f"calibration.{name}=0" for name in names))


def _stage(name: str) -> LeftOut:
    """Leave out a stage of the pipeline."""
    return LeftOut(patches=((f"pipeline.{name}", lambda estimate, task: estimate),))


def _repair(name: str) -> LeftOut:
    """Leave out a repair of the screening."""
    return LeftOut(patches=((f"screening.{name}", lambda log, *pairs: (log, [])),))


def _no_steps(edges: object, first: NDArray[np.intp], wheels: object) -> NDArray[np.bool_]:
    """Return that no step of the odometry is one of those sought."""
    return np.zeros(len(first), dtype=bool)


def _pairs_alone(estimate: Estimate, task: Pipeline) -> Estimate:
    return estimate.solved(task.config.solver)[0]


INGREDIENTS: dict[str, LeftOut] = {
    "nothing (the defaults)": LeftOut(),
    "surfaces": LeftOut(patches=(("pipeline.surface_adjustment.adjust_surfaces", _pairs_alone),)),
    "columns": LeftOut(patches=(
        ("pipeline.surface_adjustment.join_circles", lambda circles, poses, config=None: np.zeros((0, 3))),
    )),
    "columns fitted to all rays": LeftOut(patches=(
        ("pipeline.surface_adjustment.fitted_columns", lambda rays, poses, columns: columns),
    )),
    "walls that poses bend": LeftOut(patches=(
        ("lidar.walls._curved", lambda lines, places: np.ones(len(lines.centre), dtype=bool)),
    )),
    "pairs measured again": LeftOut(patches=(("pipeline.surface_adjustment.measured_again", lambda joint, *given: joint),)),
    "noise of wheels by rays": LeftOut(patches=(("pipeline.surface_adjustment.noise_at", lambda graph, wheels, sure: wheels),)),
    "points between beams": LeftOut(patches=(("lidar.clouds.filled", lambda rays: rays),)),
    "sigmas between keyframe and scan": LeftOut(patches=(
        ("pipeline.final_stages._between_scan_and_keyframe", lambda graph, task: np.zeros((len(graph.poses), 3, 3))),
    )),
    "scan-to-scan matching": LeftOut(("scan_to_scan.on=false",)),
    "loop closures of sub-maps": LeftOut(("loop_closure.rounds=0",)),
    "free space of closures": LeftOut(("loop_closure.through=1",)),
    "long stretches": LeftOut(patches=(("loop_closure.candidates.any_uncertain", lambda *given: False),)),
    "joint refinement": LeftOut(("refinement.rounds=0",)),
    "second scan per keyframe": LeftOut(("keyframes.scans=1",)),
    "scans between keyframes": _stage("lidar_stages.place_scans_between"),
    "corners": LeftOut(("clouds.linearity=0.85",)),
    "deskewing": LeftOut(log=flat),
    "steps that matches contradict": LeftOut(patches=(("lidar.scan_to_scan._contradicted", _no_steps),)),
    "stamps that err": LeftOut(patches=(
        ("lidar.scan_to_scan.by_stamps", lambda wheels, graph, jitter: np.zeros((len(wheels), 3, 3))),
    )),
    "slips of neighbouring steps": LeftOut(patches=(
        ("lidar.scan_to_scan.with_neighbours", lambda objects, pairs, found, expected: found),
    )),
    "broken stretches": _stage("broken_stretches.replace_broken_stretches"),
    "slips in turns": _stage("calibration_checks.with_slip_in_turns"),
    "moved anchors": _stage("anchor_places.decide_places"),
    "new and absent anchors": _stage("anchor_places.name_new_and_absent_anchors"),
    "mirror images": _stage("range_alternatives.find_mirror_images"),
    "sides of a line of anchors": _stage("range_alternatives.choose_side"),
    "high anchors": LeftOut(patches=(
        ("pipeline.range_alternatives.choose_heights", lambda estimate, config: estimate),
    )),
    "heights alike": LeftOut(patches=(("pipeline.final_stages.with_alike_heights", lambda graph: graph),)),
    "anchors by other weights": _stage("final_stages._anchors_alone"),
    "ranges through mapped walls": LeftOut(patches=(
        ("pipeline.radio_stages.blocked", lambda tags, *others: np.zeros(len(tags), dtype=bool)),
    )),
    "common errors decided by evidence": LeftOut(patches=(
        ("pipeline.lidar_stages.evidence_against", lambda one, other, config: np.inf),
    )),
    "covariances of correlated ranges": LeftOut(patches=(
        ("pipeline.final_stages._add_correlated_ranges", lambda result, *others: result.covariances),
    )),
    "ranges re-estimated on matches": _stage("radio_stages.reestimate_ranges"),
    "other headings in the bootstrap": LeftOut(patches=(
        ("radio.bootstrap._with_heading_scale", lambda calibration, value: None if value else calibration),
    )),
    "priors of units and ranges selected": _stage("radio_stages.reestimate_noise_and_priors"),
    "tag pattern": _stage("lidar_stages._without_pattern"),
    "marginal likelihood of the radio's priors": LeftOut(
        ("calibration.range_scale_sound=0.15", "calibration.range_bias_sound=0.8")
    ),
    "errors steady by direction": LeftOut(("ranges.steady=0",)),
    "noise of ranges learnt": LeftOut(("ranges.learn=false",)),
    "correlation of ranges": LeftOut(("ranges.learn=false", "ranges.slow_share=0")),
    "robust kernels of wheels and ranges": LeftOut(("odometry.kernel.name=none", "ranges.kernel.name=none")),
    "odometry_scale": _fixed("odometry_scale"),
    "heading_scale": _fixed("heading_scale"),
    "heading_per_metre": _fixed("heading_per_metre"),
    "heading_rate": _fixed("heading_rate"),
    "range_bias": _fixed("range_bias"),
    "range_scale": _fixed("range_scale"),
    "anchor_height": _fixed("anchor_height"),
    "laser_offset": _fixed("laser_offset"),
    "laser_angle": _fixed("laser_angle"),
    "laser_delay": _fixed("laser_delay"),
    "scan_duration": _fixed("scan_duration"),
    "range_delay": _fixed("range_delay"),
    "tag_offset": _fixed("tag_offset"),
    **{
        f"repair: {name.partition('.')[2].replace('_', ' ')}": _repair(name)
        for name in (
            "repeats.without_repeated_scans", "repeats.without_lidar_marks", "repeats.without_own_body",
            "repeats.without_marks", "repeats.without_repeated_ranges",
            "directions.heading_with_the_path", "directions.laser_upright", "clocks.with_late_scans_placed",
            "screen.heading_from_gyro",
        )
    },
}  # fmt: skip
"""What is left out, and how."""

ELSEWHERE = {
    "points between beams": "a hall of 300 x 200 m by 181 beams: 14.5 m without, 0.88 with (2026-11-22)",
    "loop closures of sub-maps": "fr-clinic: 1.4 km without ranges (tools/accuracy.py benchmark)",
    "walls that poses bend": "warehouses of 12 min, 0.243 and 0.372 m without, 0.059 and 0.082 with (2026-11-26)",
    "sigmas between keyframe and scan": "barn_1: normalised errors of 3 dimensions 3.75 without, 1.92 with",
    "scans between keyframes": "intel 0.0195 m, 0.558 deg without, 0.0164, 0.341 with; csail 0.460, 0.425 deg (2026-11-27)",
    "stamps that err": "belgioioso with a tenth of its scans gone: 0.115, 0.130 m without, 0.096, 0.097 with (2026-11-28)",
    "broken stretches": "a planted tear of 3 m (tests/pipeline/test_broken_stretches.py)",
    "slips in turns": "a skid-steered robot in a hold: normalised errors 55 per dof without, 1.2 with (2026-11-24)",
    "moved anchors": "faults of anchors that are moved (tools/faults.py)",
    "mirror images": "which places are stated, not errors (tests/pipeline/test_mirror_images.py)",
    "sides of a line of anchors": "corridors of 34 m: 0.60 to 0.89 m without, 0.02 to 0.09 with (2026-11-25)",
    "heights alike": "anchors of corridors: 0.57, 0.20, 0.83 m without, 0.44, 0.13, 0.35 with (2026-11-25)",
    "other headings in the bootstrap": "wheels with half or twice the track width (tests/radio/test_bootstrap.py)",
}
"""What pays for ingredients for which no recording here needs to."""

_REAL_ROOMS: dict[str, Any] = {"rooms": RealRooms(), "scan_rate": 5.0, "minutes": 4.0}
_NO_LIDAR: dict[str, Any] = _REAL_ROOMS | {"without": ("laser",)}
SIMULATED = {
    "lab": Settings(world="lab", **_REAL_ROOMS),
    "corridor": Settings(world="corridor", **_REAL_ROOMS),
    "hall": Settings(world="hall", **_REAL_ROOMS),
    "warehouse": Settings(world="warehouse", speed=0.4, **(_REAL_ROOMS | {"minutes": 8.0})),
    "arena": Settings(world="arena", speed=0.4, **_REAL_ROOMS),
    "tunnel": Settings(world="tunnel", speed=0.4, **_REAL_ROOMS),
    "nlos": Settings(world="hall", nlos="heavy", nlos_anchors=(3, 4), **_REAL_ROOMS),
    "slips": Settings(world="hall", odometry_scale=2.0, slips=3, **_REAL_ROOMS),
    "spin": Settings(world="hall", slips=4, spin=0.6, people=4, laser=SPINNING, **_REAL_ROOMS),
    "narrow": Settings(world="lab", slips=4, spin=0.6, laser=NARROW, **_REAL_ROOMS),
    "heights": Settings(world="hall", anchor_height=2.0, tag_height=0.3, **_REAL_ROOMS),
    "mounting": Settings(world="lab", laser_error=(0.03, -0.02, 0.03), laser_delay=0.03, uwb_delay=0.08, **_REAL_ROOMS),
    "poor radio": Settings(world="hall", radio=RadioModel(bias_sd=0.8, scale=1.05), **_REAL_ROOMS),
    "no radio": Settings(world="hall", without=("uwb",), **_REAL_ROOMS),
    "no lidar": Settings(world="corridor", **_NO_LIDAR),
    "hall without lidar": Settings(world="hall", **_NO_LIDAR),
    "lab without lidar": Settings(world="lab", **_NO_LIDAR),
    "tunnel without lidar": Settings(world="tunnel", **_NO_LIDAR),
    "poor radio without lidar": Settings(world="hall", radio=RadioModel(bias_sd=0.8, scale=1.05), **_NO_LIDAR),
    "short ranges without lidar": Settings(world="lab", radio=RadioModel(bias_sd=0.5, scale=0.95), **_NO_LIDAR),
    "heights without lidar": Settings(world="hall", anchor_height=2.0, tag_height=0.3, **_NO_LIDAR),
    "hall 5 m high without lidar": Settings(world="hall", anchor_height=5.0, **_NO_LIDAR),
    "lab 5 m high without lidar": Settings(world="lab", anchor_height=5.0, **_NO_LIDAR),
    "slips without lidar": Settings(world="hall", odometry_scale=2.0, slips=3, **_NO_LIDAR),
}
"""Four minutes (warehouse 8) in rooms whose errors stay with places. mounting: a laser mounted 3 cm and 1.7 degrees off, and
clocks 30 and 80 ms off. poor radio: anchors wrong by 0.8 m each, ranges 5 % long; short ranges: by 0.5 m, 5 % short."""
OTHERS = {
    Path(name).name: name for name in (
        "kummerle/intel", "kummerle/mit-csail", "carmen/freiburg-101", "carmen/belgioioso", "plaza1", "mrclam7_r2",
        "slips/market_1", "slips/rotunda_3", "slips/barn_1", "slips/orchard_5", "slips/slip_office",
        "lias_mid", "fhw_cor", "edmonton_cor",
    )
}  # fmt: skip
"""Recordings of others, and where in the shared folder they are."""


@dataclass(frozen=True)
class Outcome:
    """A map without an ingredient; plain numbers, so that they travel between processes."""

    error: float
    """m."""
    anchors: float
    """m, rms; nan where there are none or no truth."""
    nees: float
    """Of the poses, per degree of freedom; nan where the truth is not known in all of them."""
    doubts: tuple[str, ...]


@contextmanager
def left_out(name: str) -> Iterator[None]:
    """Put stand-ins in place of the functions of an ingredient."""
    before = []
    for where, stand_in in INGREDIENTS[name].patches:
        module_name, _, function = where.rpartition(".")
        module = importlib.import_module(f"uwblite.{module_name}")
        before.append((module, function, getattr(module, function)))
        setattr(module, function, stand_in)
    try:
        yield
    finally:
        for module, function, own in before:
            setattr(module, function, own)


Key = tuple[str, int, str]
"""Recording, seed and ingredient."""


@dataclass(frozen=True)
class Task:
    """A recording and what is left out of its maps in turn."""

    name: str
    seed: int
    without: tuple[str, ...]


def work(task: Task) -> dict[Key, Outcome]:
    """Make all maps of a recording and compare them with the truth."""
    trial = made(replace(SIMULATED[task.name], seed=task.seed)) if task.name in SIMULATED else None
    folder = SHARED / OTHERS.get(task.name, "")
    log, found = read_log(folder / "run.log.gz") if trial is None else trial.log, {}
    for without in task.without:
        how = INGREDIENTS[without]
        config = override(MappingConfig(), ("grid.resolution=0.2", *how.settings))
        with left_out(without):
            result = build_map(log if how.log is None else how.log(log), config)
        nan, doubts = float("nan"), tuple(finding.kind for finding in result.doubts)
        if trial is None:
            outcome = Outcome(real_error(folder, log, result), nan, nan, doubts)
        else:
            figures, nees = judged(result, trial), compare(task.name, result, trial).poses
            outcome = Outcome(figures.ate, figures.anchors, float(np.mean(nees)) / 3.0, doubts)
        found[task.name, task.seed, without] = outcome
        print(f"{task.name} {task.seed}, without {without}: {outcome}", file=sys.stderr, flush=True)
    return found


def document(found: dict[Key, Outcome]) -> str:
    """Return the section of the page."""
    base = next(iter(INGREDIENTS))
    drives = [(name, seed) for name, seed, without in found if without == base]
    rows = []
    for without in INGREDIENTS:
        own = [(d, found[*d, base], found[*d, without]) for d in drives if (*d, without) in found]
        if without == base or not own:
            continue
        ratios = np.array([after.error / max(before.error, 1e-6) for _, before, after in own])
        anchors = np.array([after.anchors / before.anchors for _, before, after in own])
        nees = [(before.nees, after.nees) for _, before, after in own if np.isfinite(before.nees)]
        worst = np.argsort(-ratios)[: max(1, len(ratios) // 10)]
        falsely = sum(bool(after.doubts) and not before.doubts for _, before, after in own)
        rows.append([
            without, len(own), f"{np.exp(np.mean(np.log(ratios))):.2f}", f"{ratios[worst].mean():.2f}",
            ", ".join(f"{own[k][0][0]} {own[k][1].error:.3f} -> {own[k][2].error:.3f}" for k in worst[:2]),
            f"{np.nanmax(anchors):.2f}" if np.isfinite(anchors).any() else "-",
            "-" if not nees else " -> ".join(f"{np.median(side):.2f}" for side in zip(*nees, strict=True)), falsely,
        ])
    defaults = [
        [name, seed, o.error, o.anchors, o.nees, ", ".join(o.doubts)]
        for name, seed in drives for o in [found[name, seed, base]]
    ]
    states = table(["defaults", "seed", "error, m", "anchors, m", "NEES / dof", "doubts"], defaults)
    paid = "".join(f"- *{name}*: {what}\n" for name, what in ELSEWHERE.items() if any(row[0] == name for row in rows))
    head = ["left out", "maps", "mean ratio", "worst tenth", "there", "anchors, worst ratio", "NEES / dof", "newly doubted"]
    return (
        "## What each ingredient buys\n\nRatio of the error without it to that with it: geometric mean, and mean of the worst "
        "tenth of the recordings (m there); worst ratio of\nthe anchors' errors; median of the normalised errors of poses per "
        "degree of freedom (simulated recordings alone), before and after; maps that are\ndoubted only without it. Simulated "
        "recordings of 4 min in rooms with errors of real ones, and recordings of others.\n\n"
        + "\n".join([table(head, rows), paid, states])
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--only", default="", metavar="NAMES", help=f"recordings, of {', '.join((*SIMULATED, *OTHERS))}")
    p.add_argument("--of", default="", metavar="NAMES", help=f"ingredients, of {'; '.join(list(INGREDIENTS)[1:])}")
    p.add_argument("--seeds", type=int, default=1, metavar="N", help="simulated recordings of each kind (1)")
    p.add_argument("--seed", type=int, default=1, metavar="N", help="seed of the first (1)")
    p.add_argument("--jobs", type=int, default=2, metavar="N", help="processes (2)")
    p.add_argument("--keep", type=Path, metavar="FILE", help="add to the maps kept in FILE, which must be of one state")
    p.add_argument("--out", type=Path, default=ROOT / "docs" / "lab" / "accuracy.md", metavar="FILE", help="page to write into")
    p.add_argument("--print", action="store_true", help="print instead of writing")
    args = p.parse_args(argv)
    names = args.only.split(",") if args.only else [*SIMULATED, *OTHERS]
    without = [next(iter(INGREDIENTS)), *(args.of.split(",") if args.of else list(INGREDIENTS)[1:])]
    if strange := {*names, *without} - {*SIMULATED, *OTHERS, *INGREDIENTS}:
        p.error(f"there is no recording or ingredient {', '.join(sorted(strange))}")
    found: dict[Key, Outcome] = pickle.loads(args.keep.read_bytes()) if args.keep is not None and args.keep.exists() else {}
    tasks = []
    for name in names:
        if name in OTHERS and not (SHARED / OTHERS[name]).is_dir():
            continue
        for seed in range(args.seed, args.seed + args.seeds) if name in SIMULATED else [0]:
            left = tuple(w for w in without if (name, seed, w) not in found)
            tasks += [Task(name, seed, left)] if left else []
    for some in spread_out(work, tasks, args.jobs):
        found |= some
        if args.keep is not None:
            beside = args.keep.with_name(args.keep.name + ".tmp")
            beside.write_bytes(pickle.dumps(found))
            os.replace(beside, args.keep)
    text = document(found)
    if args.print:
        print(text)
    else:
        write_section(args.out, "ablation", text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
