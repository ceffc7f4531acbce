#!/usr/bin/env python3
"""How accurate the defaults are, and what false measurements cost; writes docs/lab/accuracy.md.

    python tools/accuracy.py                                     everything, about an hour on two cores
    python tools/accuracy.py simulated --seeds 1 --only hall,lab a part of it
    python tools/accuracy.py simulated --quick --print           recordings of 6 min, nothing written

Parts: simulated (buildings x seeds against bars), oracle (against what the measurements allow, and the Cramer-Rao bound),
fusion (all sensors against some of them), real (recordings of others, where they are: UWBLITE_SHARED_DATA; with it benchmark:
two of them against relations and published figures; --perturb N: N perturbed runs of each that has a lidar as well),
registration (how often placements of clouds are right, by the probability that they state), injection (false closures and
ranges into a good graph). What each ingredient buys is measured by tools/ablation.py, and how true the
stated uncertainties are by tools/consistency.py; both write into the same page.
"""

import one_thread  # noqa: F401

import argparse
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np
import oracle
import registration_law
from simulation.laser import NARROW, SPINNING
from simulation.real_rooms import RealRooms
from simulation.recording import Settings, simulate
from trials import (
    MIRRORED,
    ROOT,
    SHARED,
    Figures,
    Trial,
    as_read,
    judged,
    made,
    real_error,
    spread_out,
    table,
    true_path,
    write_section,
)  # fmt: skip

from uwblite import se2
from uwblite.config import override
from uwblite.evaluation.relations import evaluate_relations
from uwblite.evaluation.trajectory import evaluate_trajectory
from uwblite.graph.gnc import optimize_gnc
from uwblite.graph.graph import Edges, Graph
from uwblite.graph.pose_edges import RelativePoseEdges
from uwblite.graph.range_edges import RangeEdges
from uwblite.graph.robust import SQUARED
from uwblite.graph.work import Work
from uwblite.io.carmen import read_log
from uwblite.io.tum import read_relations
from uwblite.mapping import MappingConfig, build_map
from uwblite.pipeline import keyframe_data
from uwblite.pipeline.recordings import gather
from uwblite.se2 import align
from uwblite.sensor_log import SensorLog

PARTS = ("simulated", "oracle", "fusion", "real", "benchmark", "registration", "injection")
WORST = 1.6
"""The worst seed may exceed the bar on the mean by this factor."""


@dataclass(frozen=True)
class Row:
    """One kind of recording and what is asked of it."""

    name: str
    settings: Settings
    column: float
    """m, bar on the mean column error."""
    ate: float
    """m, bar on the ATE."""
    changes: tuple[str, ...] = ()


ROWS = {
    "hall": Row("hall, 31 min", Settings(world="hall"), 0.03, 0.05),
    "corridor": Row("corridor", Settings(world="corridor"), 0.10, 0.12),
    "lab": Row("lab", Settings(world="lab"), 0.04, 0.07),
    "nlos": Row(
        "hall, heavy NLOS on two of four anchors", Settings(world="hall", nlos="heavy", nlos_anchors=(3, 4)), 0.04, 0.06
    ),
    "slips": Row("hall, wheels twice as bad, 3 slips", Settings(world="hall", odometry_scale=2.0, slips=3), 0.05, 0.08),
    "warehouse": Row("warehouse, equal racks, 60 min", Settings(world="warehouse"), 0.15, 0.20),
    "heights": Row(
        "hall, anchors at 2 m, tag at 0.3 m, not given", Settings(world="hall", anchor_height=2.0, tag_height=0.3), 0.04, 0.06
    ),
    "arena": Row("arena, 70 x 45 m, nearly empty, 0.4 m/s", Settings(world="arena", speed=0.4), 0.10, 0.10),
    "tunnel": Row("tunnel, 110 m, smooth, anchors on a line, 0.4 m/s", Settings(world="tunnel", speed=0.4), 0.20, 0.20),
    "spin": Row(
        "hall, 4 slips of seconds at 0.6 m/s, people, turning lidar",
        Settings(world="hall", slips=4, spin=0.6, people=4, laser=SPINNING), 0.05, 0.10,
    ),
    "narrow": Row(
        "lab, 4 slips of seconds at 0.6 m/s, lidar of 120 deg and 4 m",
        Settings(world="lab", slips=4, spin=0.6, laser=NARROW), 0.10, 0.20,
    ),
    "radio off": Row("hall, no UWB", Settings(world="hall"), 0.10, 0.15, ("use_uwb=false",)),
}

@dataclass(frozen=True)
class Task:
    """A recording, simulated and read once, and the settings to map it with."""

    name: str
    settings: Settings
    runs: tuple[tuple[str, tuple[str, ...]], ...]
    """Name and changes of each."""
    also: tuple[str, ...] = field(default=())
    """Changes common to all, from --set."""


def work(task: Task) -> list[tuple[str, str, Figures]]:
    """Make all maps of a recording and compare them with the truth."""
    trial = made(task.settings)
    done = []
    for name, changes in task.runs:
        config = override(MappingConfig(), (*task.also, *changes))
        done.append((task.name, name, judged(build_map(trial.log, config, clock=time.perf_counter), trial)))
    return done


def asked(args: argparse.Namespace, names: Sequence[str]) -> list[str]:
    """Return the names that --only leaves."""
    wanted = args.only.split(",") if args.only else list(names)
    return [n for n in names if n in wanted]


def simulated(args: argparse.Namespace) -> str:
    """Map buildings x seeds; return the table against the bars."""
    names = asked(args, list(ROWS))
    seeds = range(1, args.seeds + 1)
    shared = {"hall": [n for n in ("hall", "radio off") if n in names]}
    tasks = []
    for name in sorted(names, key=lambda n: n != "warehouse"):
        if name == "radio off" and "hall" in names:
            continue
        runs = tuple((n, ROWS[n].changes) for n in shared.get(name, [name]))
        for seed in seeds:
            settings = replace(ROWS[name].settings, seed=seed, minutes=6.0 if args.quick else None)
            tasks.append(Task(name, settings, runs, tuple(args.set)))
    done = [row for rows in follow(tasks, args) for row in rows]
    lines, missed = [], []
    for name in names:
        figures = [f for _, n, f in done if n == name]
        row = ROWS[name]
        columns, ates = [f.column for f in figures], [f.ate for f in figures]
        good = all(
            float(np.mean(v)) <= bar and max(v) <= WORST * bar for v, bar in ((columns, row.column), (ates, row.ate))
        ) and not any(f.missing for f in figures)
        if not good:
            missed.append(row.name)
        doubts = sum(bool(f.doubts) for f in figures)
        lines.append([
            row.name, float(np.mean(columns)), max(columns), f"{row.column:g}", float(np.mean(ates)), max(ates),
            f"{row.ate:g}", float(np.mean([f.anchors for f in figures])), doubts,
            "yes" if good else "**no**",
        ])
    head = ["recording", "columns", "worst", "bar", "ATE", "worst", "bar", "anchors", "doubted", "kept"]
    text = table(head, lines)
    verdict = "All bars are kept." if not missed else f"Missed: {'; '.join(missed)}."
    return (
        f"## Simulated buildings\n\nDefaults, {len(seeds)} seeds each; m. *Columns*: mean error of the distances between "
        "columns found in the map;\n*ATE*: of the trajectory; *anchors*: rms of their places; *doubted*: runs with exit "
        f"code 3. A bar is on the mean;\nthe worst seed may exceed it {WORST}-fold.\n\n{text}\n{verdict}"
    )


def follow(tasks: list[Task], args: argparse.Namespace) -> list[list[tuple[str, str, Figures]]]:
    """Carry the tasks out and say on stderr how far it is."""
    began, done = time.perf_counter(), []
    for rows in spread_out(work, tasks, args.jobs):
        done.append(rows)
        figures_text = ", ".join(f"{n}: {f.ate:.4f}/{f.column:.4f}" for _, n, f in rows)
        spent = time.perf_counter() - began
        print(f"{len(done)} of {len(tasks)}, {spent:.0f} s, {rows[0][0]}: {figures_text}", file=sys.stderr, flush=True)
    return done


ORACLE_ROWS = {
    "arena": (Settings(world="arena", speed=0.4, minutes=12.0), 1.3),
    "tunnel": (Settings(world="tunnel", speed=0.4, minutes=12.0), 1.5),
    "hall": (Settings(world="hall", minutes=6.0, rooms=RealRooms()), 1.3),
    "corridor": (Settings(world="corridor", minutes=6.0, rooms=RealRooms()), 1.3),
    "lab": (Settings(world="lab", minutes=6.0, rooms=RealRooms()), 1.3),
    "warehouse": (Settings(world="warehouse", minutes=10.0, rooms=RealRooms()), 1.3),
}
"""Recordings and bars on the ratio of the mean ATE to the oracle's; all but the large places have errors of real rooms."""


def oracles(args: argparse.Namespace) -> str:
    """Compare maps with what the measurements allow; return the table."""
    rows = []
    for name in asked(args, list(ORACLE_ROWS)):
        settings, bar = ORACLE_ROWS[name]
        each = []
        for seed in range(1, args.seeds + 1):
            recording = simulate(replace(settings, seed=seed))
            trial = as_read(recording)
            try:
                best, local = oracle.solve(recording, trial.log), oracle.solve(recording, trial.log, pieces=True)
            except np.linalg.LinAlgError:
                print(f"{name} {seed}: left out, an oracle's normal equations are singular", file=sys.stderr, flush=True)
                continue
            made = judged(build_map(trial.log, override(MappingConfig(), args.set)), trial)
            each.append((
                made.ate, best.ate, best.bound_ate, local.ate, local.bound_ate,
                made.anchors, best.anchors, best.bound_anchors,
            ))
            print(f"{name} {seed}: " + " ".join(f"{value:.4f}" for value in each[-1]), file=sys.stderr, flush=True)
        if not each:
            continue
        mean = np.mean(each, axis=0).tolist()
        ratio = mean[0] / mean[1]
        rows.append([name, len(each), *mean[:5], f"{ratio:.2f}", f"{bar:g}", *mean[5:], "yes" if ratio <= bar else "**no**"])
    head = [
        "recording", "seeds", "ATE", "oracle", "bound", "in pieces", "bound", "ratio", "bar",
        "anchors", "oracle", "bound", "kept",
    ]
    return (
        f"## What the measurements allow\n\nRooms with real errors, 6 min (warehouse 10), and arena and tunnel as simulated, "
        f"12 min; mean of seeds 1 to {args.seeds}, without those whose\noracle has normal equations that are singular to "
        "rounding; m. *Oracle*: least squares from the truth with known associations\n(which ray hit which wall or column, "
        "what blocked which range) and the true distribution of all errors, poses, anchors,\nwalls, columns and their radii, "
        "range offsets and calibration free, the unit of the radio within 0.1 %, as a map\ntakes it (tools/oracle.py); "
        "*bound*: "
        "Cramer-Rao bound of the recording, which is what the oracle's error is on average; *in pieces*: ATE\nand bound of an "
        "oracle that does not know which metres of wall are one straight line of one offset, nor that what is seen of "
        f"a\ncolumn from all sides is one circle.\n\n{table(head, rows)}"
    )


FUSION_WORLDS = {
    "hall": 0.2, "corridor": 0.2, "lab": 0.2, "room": 0.2, "shed": 0.2, "supermarket": 0.2, "orchard": 0.2, "rotunda": 0.4,
    "arena": 0.4, "tunnel": 0.4, "warehouse": 0.4,
}  # fmt: skip
"""World and speed, m/s, of recordings of which parts are compared, each with and without slips."""
FUSION_REAL = ("slips/barn_1", "slips/market_1", "slips/orchard_5", "slips/rotunda_3", "slips/slip_office", "fhw_cor")
"""Recordings of others with all sensors."""
WITHOUT: dict[str, tuple[str, ...]] = {"everything": (), "no lidar": ("use_lidar=false",), "no UWB": ("use_uwb=false",)}
"""What fusion must not be worse than, and how it is left out."""
WORSE, MUCH_WORSE = (1.05, 0.003), 1.5
"""Times the best part's error, or m more than it, that fusion may have in 19 of 20 rows; and what no row may exceed."""


def fusion_task(world: str, slips: int, seed: int, also: Sequence[str]) -> Task:
    """Return a recording whose parts are compared: 5 min, steady errors of real rooms."""
    settings = Settings(
        world=world, minutes=5.0, speed=FUSION_WORLDS[world], slips=slips, spin=0.6, scan_rate=5.0, rooms=RealRooms(), seed=seed
    )
    name = f"{world}, {slips} slips, {seed}" if slips else f"{world}, {seed}"
    return Task(name, settings, tuple(WITHOUT.items()), tuple(also))


def parts_of_real(name: str, also: Sequence[str]) -> list[tuple[str, str, float, tuple[str, ...]]]:
    """Return name, part, error, m, and doubts of the maps of a recording of others."""
    folder = SHARED / name
    log = read_log(folder / "run.log.gz")
    truth = true_path(folder, log)
    configs = {part: override(MappingConfig(), (*also, *changes)) for part, changes in WITHOUT.items()}
    errors = ((part, *_error(folder, log, config, truth)) for part, config in configs.items())
    return [(name, part, error, tuple(doubts)) for part, error, doubts in errors]


def fusion(args: argparse.Namespace) -> str:
    """Compare maps from all sensors with maps from parts of them; return the table."""
    names, seeds = asked(args, [*FUSION_WORLDS, *FUSION_REAL]), range(args.seed, args.seed + args.seeds)
    worlds = [name for name in names if name in FUSION_WORLDS]
    tasks = [fusion_task(world, slips, seed, args.set) for world in worlds for slips in (0, 4) for seed in seeds]
    done = [(name, part, f.ate, f.doubts) for rows in follow(tasks, args) for name, part, f in rows]
    for name in (name for name in names if name in FUSION_REAL and (SHARED / name).is_dir()):
        done += parts_of_real(name, args.set)
        print(*done[-len(WITHOUT) :], sep="\n", file=sys.stderr, flush=True)
    lines = [line_of_parts(name, {d[1]: d[2:] for d in done if d[0] == name}) for name in dict.fromkeys(d[0] for d in done)]
    over, far = (sum(line[-2] in words for line in lines) for words in (("no", "**no**"), ("**no**",)))
    text = table(["recording", *WITHOUT, "ratio", "kept", "doubts of all"], lines)
    return (
        "## All sensors against some of them\n\nATE, m; recordings of 5 min, rooms whose errors stay with places, *slips* of 2 "
        f"to 6 s at 0.6 m/s; and recordings of others.\n*Kept*: not above {WORSE[0]} times the best part and "
        f"{1000 * WORSE[1]:.0f} mm, which one row in twenty may exceed; none may be above {MUCH_WORSE} times it.\n"
        f"{over} of {len(lines)} rows exceed the first, {far} the second.\n\n{text}"
    )


def line_of_parts(name: str, each: dict[str, tuple[float, tuple[str, ...]]]) -> list[object]:
    """Return the cells of a recording: the error of each part, m, the ratio of the first to the best other one, and doubts."""
    errors = [each[part][0] for part in WITHOUT]
    best = min(errors[1:])
    kept = "yes" if errors[0] <= WORSE[0] * best + WORSE[1] else "no"
    if errors[0] > MUCH_WORSE * best + WORSE[1]:
        kept = "**no**"
    return [name, *errors, f"{errors[0] / best:.2f}", kept, ", ".join(each["everything"][1])]


REAL = {"plaza1": 0.30, "labyrinth": 0.20, "intel_raw": 0.11, "carmen/freiburg-101": 0.055, "carmen/belgioioso": 0.195}
"""m, bars on the ATE; the references of the last three are estimates of other SLAM programs."""
KASDORF = "kasdorf_2017-11-17-12-31-28"


def real(args: argparse.Namespace) -> str:
    """Map recordings of others; return the table."""
    if not SHARED.is_dir():
        return f"## Recordings of others\n\nAbsent where this was measured ({SHARED.name})."
    config = override(MappingConfig(), args.set)
    rows = []
    for name in asked(args, list(REAL)):
        folder = SHARED / name
        log = read_log(folder / "run.log.gz")
        truth = true_path(folder, log)
        wheels = evaluate_trajectory(log.odometry.stamps, log.odometry.poses, *truth, max_gap=30.0).ate.rmse
        seeds = range(1 + (args.perturb if log.scans is not None else 0))
        runs = [_error(folder, perturbed(log, seed), config, truth) for seed in seeds]
        for seed, (error, doubts) in enumerate(runs):
            print(f"{name}, perturbed {seed}: {error:.4f} {', '.join(doubts)}", file=sys.stderr, flush=True)
        bars = [REAL[name] * (PERTURBED if seed else 1.0) for seed in seeds]
        kept = [e <= bar and (name in MIRRORED or not doubts) for (e, doubts), bar in zip(runs, bars, strict=True)]
        rows.append([name, wheels, *row_of_runs(runs, f"{REAL[name]:g}", kept)])
    text = table(["recording", "odometry ATE", "ATE", "bar", "kept", *PERTURBED_HEAD, "doubts"], rows)
    more = "" if args.only else "\n" + halves(config)
    return f"## Recordings of others\n\nDefaults, from the raw logs; m. {PERTURBATION}\n\n{text}{more}"


def _error(
    folder: Path, log: SensorLog, config: MappingConfig, truth: tuple[np.ndarray, np.ndarray]
) -> tuple[float, list[str]]:
    """Return the error of the map of a recording against the truth, m, and the kinds of its doubts."""
    result = build_map(log, config)
    return real_error(folder, log, result, truth), [finding.kind for finding in result.doubts]


BENCHMARK = {
    "mit-csail": (0.049, 0.45, 0.106, 0.049, 0.004, 0.032), "fr079": (0.061, 0.65, 0.258, 0.061, 0.056, 0.045),
    "intel": (0.031, 0.6, float("nan"), 0.070, 0.031, 0.023),
}  # fmt: skip
"""Bars on the mean errors over relations, m and degrees; translations that others reached, m: scan matching, GMapping, graph
mapping (Kuemmerle et al. 2009) and Cartographer (Hess et al. 2016)."""
PERTURBED = 1.3
"""Perturbed recordings may exceed the bars by this factor."""
PERTURBATION = (
    "Perturbed: a tenth of the scans left out at random, steps of the odometry\nwrong by 2 %; "
    f"{PERTURBED} times the bar is allowed."
)


PERTURBED_HEAD = ("perturbed, kept", "perturbed, mean", "perturbed, worst")


def row_of_runs(runs: Sequence[tuple[float, Sequence[str]]], bar: str, kept: Sequence[bool]) -> list[object]:
    """Return the cells of a recording: error, bar, kept; of its perturbed runs how many are kept, mean and worst; doubts.

    Parameters
    ----------
    runs : error, m, and doubts of the recording as it is, then of each perturbed one.
    """
    errors = [error for error, _ in runs[1:]]
    spread = [f"{sum(kept[1:])} of {len(errors)}", float(np.mean(errors)), max(errors)] if errors else ["-"] * 3
    doubts = [", ".join(kinds) + f" (perturbed {k})" * bool(k) for k, (_, kinds) in enumerate(runs) if kinds]
    return [runs[0][0], bar, "yes" if kept[0] else "**no**", *spread, "; ".join(doubts)]


def perturbed(log: SensorLog, seed: int) -> SensorLog:
    """Return the recording with a tenth of its scans gone and steps of the odometry wrong by 2 %; seed 0 = as it is."""
    if seed == 0 or log.scans is None:
        return log
    rng = np.random.default_rng(seed)
    kept = rng.random(len(log.scans.stamps)) > 0.1
    scans = replace(log.scans, stamps=log.scans.stamps[kept], ranges=log.scans.ranges[kept])
    steps = se2.between(log.odometry.poses[:-1], log.odometry.poses[1:])
    poses = [log.odometry.poses[0]]
    for step in steps * (1.0 + 0.02 * rng.standard_normal(steps.shape)):
        poses.append(se2.compose(poses[-1], step))
    return replace(log, scans=scans, odometry=replace(log.odometry, poses=np.array(poses)))


def benchmark(args: argparse.Namespace) -> str:
    """Judge maps by the relations of Kuemmerle et al.; with --perturb N, of N perturbed recordings, too."""
    rows, config = [], override(MappingConfig(), args.set)
    for name in asked(args, list(BENCHMARK)):
        folder, (bar, turn, *others) = SHARED / "kummerle" / name, BENCHMARK[name]
        if not folder.is_dir():
            continue
        log, relations = read_log(folder / "run.log.gz"), read_relations(folder / "truth.relations.gz")
        runs, turns, kept = [], [], []
        for seed in range(args.perturb + 1):
            result = build_map(perturbed(log, seed), config)
            delay = result.graph.calibration.get("laser_delay")
            found = evaluate_relations(result.stamps, result.trajectory, relations, delay)
            shift, angle = found.translations.mean, math.degrees(found.rotations.mean)
            doubts, allowed = [notice.kind for notice in result.doubts], PERTURBED if seed else 1.0
            good = shift <= bar * allowed and angle <= turn * allowed
            runs.append((shift, doubts))
            turns.append(angle)
            kept.append(good and bool(found.answered.all()) and not doubts)
            print(f"{name}, perturbed {seed}: {shift:.4f} m, {angle:.3f} deg {', '.join(doubts)}", file=sys.stderr, flush=True)
        shifts = row_of_runs(runs, f"{bar:g}", kept)
        rows.append([name, *shifts[:2], f"{turns[0]:.2f}", f"{turn:g}", *shifts[2:], *others])
    head = ["recording", "translation", "bar", "rotation, deg", "bar", "kept", *PERTURBED_HEAD, "doubts"]
    text = table([*head, "scan matching", "GMapping", "graph mapping", "Cartographer"], rows)
    return (
        "## SLAM benchmark of Kuemmerle et al. 2009\n\nDefaults, from the raw logs: mean errors over all relations, each "
        f"counts once; m. The last columns are\ntranslations that others published. {PERTURBATION}\n\n{text}"
    )


def halves(config: MappingConfig) -> str:
    """Return how the anchors' biases of the two halves of a recording agree."""
    log = read_log(SHARED / KASDORF / "run.log.gz")
    middle = float(log.odometry.stamps[0] + log.odometry.stamps[-1]) / 2.0
    whole = build_map(log, config)
    parts = (log.crop(end=middle), log.crop(start=middle))
    alone = [{a.id: (a.bias, a.bias_sigma) for a in build_map(part, config).anchors} for part in parts]
    rows = []
    for k, anchor in enumerate(whole.anchors):
        ranges = whole.range_table
        own = (ranges["anchor"] == k) & (ranges["weight"] > 0)
        first, second = (
            anchor.bias + float(np.median(ranges["residual"][own & half]))
            for half in (ranges["stamp"] < middle, ranges["stamp"] >= middle)
        )
        figures_text = [f"{alone[n][anchor.id][0]:.2f} ± {alone[n][anchor.id][1]:.2f}" for n in (0, 1)]
        rows.append(
            [anchor.id, f"{anchor.bias:.2f} ± {anchor.bias_sigma:.2f}", first, second, abs(first - second), *figures_text]
        )
    return (
        "Kasdorf, no truth: the anchors' biases, m; bar 0.15 on the difference between the halves of the recording. In 4 m of\n"
        "driving neither half alone separates an anchor's bias from its place, as stated sigmas show, so they are compared\n"
        "at the anchors' places in the whole map; the last two columns are of maps of either half alone.\n\n"
        + table(["anchor", "whole", "first half", "second half", "difference", "first alone", "second alone"], rows)
    )


def registered(args: argparse.Namespace) -> str:
    """Register neighbouring clouds with priors about the truth; return how often placements of a probability are right."""
    config, rows = override(MappingConfig(), args.set), []
    for name in asked(args, [*LAW_WORLDS, *LAW_REAL]):
        if name in LAW_WORLDS:
            trial = made(fusion_task(name, 0, args.seed, ()).settings)
            log, stamps, poses, error = trial.log, trial.stamps, trial.poses, 0.002
        elif (SHARED / name).is_dir():
            log, error = read_log(SHARED / name / "run.log.gz"), LAW_REAL[name]
            stamps, poses = true_path(SHARED / name, log)
        else:
            continue
        recordings = gather([log], config.keyframes)
        inside = (recordings.stamps >= stamps[0]) & (recordings.stamps <= stamps[-1])
        clouds = keyframe_data.make(recordings, config, 0.0, Work()).clouds.chosen(np.flatnonzero(inside))
        truth = se2.interpolate_trajectory(stamps, poses, recordings.stamps[inside])
        rows.append((name, registration_law.placements(clouds, truth, 1, np.random.default_rng(args.seed), error)))
        print(f"{name}: log score {rows[-1][1].log_score:.3f}", file=sys.stderr, flush=True)
    return (
        "## Registration\n\nNeighbouring clouds, registered with priors about the truth: the noise of wheels, and slips of "
        f"half a metre and 0.4 rad\nin {registration_law.SLIPS:.0%} of the pairs. *Right*: within the stated covariance and "
        f"the error of the truth, chi2 below {registration_law.CHI2}.\n\n{registration_law.report(rows)}"
    )


LAW_WORLDS = ("hall", "corridor", "lab", "room", "orchard", "warehouse")
LAW_REAL = {"slips/barn_1": 0.02, "slips/market_1": 0.02, "slips/rotunda_3": 0.02, "slips/slip_office": 0.02}
"""Recordings of others, and the standard deviation of a step of their truth, m and rad."""


def injection(args: argparse.Namespace) -> str:
    """Put false closures and ranges into good graphs; return what they cost."""
    rows = []
    for seed in range(1, args.seeds + 1):
        trial = made(Settings(world="hall", seed=seed, minutes=8.0, scan_rate=5.0))
        result = build_map(trial.log, override(MappingConfig(), (*args.set, "refinement.rounds=0")))
        rng = np.random.default_rng(seed)
        clean, spoilt = (solved(g, trial, result.keyframe_stamps) for g in (plain(result.graph), wronged(result.graph, rng)))
        rows.append([seed, clean, spoilt, spoilt / clean])
    text = table(["seed", "clean", "with 30 % false", "ratio"], rows)
    return (
        "## False measurements\n\nHall, 8 min: 30 % false closures, anywhere and of the true ones' weight, and 30 % of the "
        f"ranges replaced\nby nonsense, then graduated non-convexity (`uwblite.graph.gnc`); ATE of the keyframes, m.\n\n{text}"
    )


def plain(graph: Graph) -> Graph:
    """Return the graph with squared errors; graduated non-convexity decides instead of kernels."""
    return replace(graph, edges=tuple(replace(e, kernel=SQUARED) for e in graph.edges))  # type: ignore[type-var]


def wronged(graph: Graph, rng: np.random.Generator) -> Graph:
    """Return the plain graph with false closures and ranges."""
    edges: list[Edges] = []
    for e in plain(graph).edges:
        if isinstance(e, RangeEdges):
            wrong = rng.random(len(e)) < 0.3
            e = replace(e, ranges=np.where(wrong, rng.uniform(0.0, 30.0, len(e)), e.ranges))
        if isinstance(e, RelativePoseEdges):
            count, n = round(0.3 * len(e)), len(graph.poses)
            i, j = rng.integers(n, size=(2, count))
            false = np.column_stack([rng.uniform(-3.0, 3.0, (count, 2)), rng.uniform(-np.pi, np.pi, count)])
            pick = rng.integers(len(e), size=count)
            both = ((e.i, i), (e.j, j), (e.T_i_j, false), (e.sqrt_information, e.sqrt_information[pick]))
            e = RelativePoseEdges(*(np.concatenate(p) for p in both))
        edges.append(e)
    return replace(graph, edges=tuple(edges))


def solved(graph: Graph, trial: Trial, stamps: np.ndarray) -> float:
    """Return the ATE of the graph's poses after graduated non-convexity on closures and ranges."""
    doubtful = {k: e for k, e in enumerate(graph.edges) if isinstance(e, RangeEdges | RelativePoseEdges)}
    limits = {k: 3.0 if isinstance(e, RangeEdges) else 4.0 for k, e in doubtful.items()}
    poses = optimize_gnc(graph, limits)[0].poses
    truth = se2.interpolate_trajectory(trial.stamps, trial.poses, stamps)[:, :2]
    laid = se2.transform(align(poses[:, :2], truth), poses[:, :2])
    return math.sqrt(float(np.mean(np.sum((laid - truth) ** 2, axis=1))))


NAMES = {
    "simulated": ROWS, "oracle": ORACLE_ROWS, "fusion": [*FUSION_WORLDS, *FUSION_REAL], "real": REAL, "benchmark": BENCHMARK,
    "registration": [*LAW_WORLDS, *LAW_REAL],
}  # fmt: skip
"""Recordings of each part."""

HEAD = "# Accuracy\n\nLengths in metres. The tables are written by tools; do not edit them.\n"


def main(argv: list[str] | None = None) -> int:
    """Run the command line."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("parts", nargs="*", choices=[*PARTS, []], metavar="PART", help=f"some of {', '.join(PARTS)} (all)")
    p.add_argument("--out", type=Path, default=ROOT / "docs" / "lab" / "accuracy.md", metavar="FILE", help="page to write into")
    p.add_argument("--print", action="store_true", help="print instead of writing")
    p.add_argument("--seeds", type=int, default=3, metavar="N", help="recordings per row (3)")
    p.add_argument("--seed", type=int, default=1, metavar="N", help="first seed of fusion (1)")
    p.add_argument("--only", default="", metavar="NAMES", help="recordings, separated by commas")
    p.add_argument("--set", metavar="NAME=VALUE", action="append", default=[], help="change a setting; repeatable")
    p.add_argument("--jobs", type=int, default=2, metavar="N", help="processes (2)")
    p.add_argument("--perturb", type=int, default=0, metavar="N", help="perturbed runs of each benchmark recording (0)")
    p.add_argument("--quick", action="store_true", help="recordings of 6 min")
    args = p.parse_args(argv)
    parts = (simulated, oracles, fusion, real, benchmark, registered, injection)
    made_by = dict(zip(PARTS, parts, strict=True))
    if not args.print and not args.out.exists():
        args.out.write_text(HEAD)
    wanted = set(args.parts or PARTS)
    wanted |= {"benchmark"} if "real" in wanted else set()
    if args.only and (strange := set(args.only.split(",")) - {name for part in wanted for name in NAMES.get(part, ())}):
        p.error(f"--only: no recording of these parts is called {', '.join(sorted(strange))}")
    for part in (p for p in PARTS if p in wanted):
        text = made_by[part](args)
        if args.print:
            print(text)
        else:
            write_section(args.out, part, text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
