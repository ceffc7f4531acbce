#!/usr/bin/env python3
"""Measure stages and whole runs, beside other libraries where they are installed; prints medians, ratios, peak RSS.

    python tools/bench.py                                   everything that takes seconds and needs no recording
    python tools/bench.py graphs --repeats 21               pose graphs, against GTSAM (pip install gtsam)
    python tools/bench.py icp                               registration, against small_gicp and Open3D
    python tools/bench.py map --log hall=recordings/hall/run.log  whole runs of `uwblite map`; --log may be repeated
    python tools/bench.py map --log hall=run.log --tree ../before --tree .    the same by two versions, alternately
    python tools/bench.py start                             import and --help above bare python

Processor time on one core and one BLAS thread; runs of a library and of its peers alternate, so that a busy machine
slows both. Start is wall time, whole runs are both. Recordings are made by tools/simulate.py (hall, 31 min: --minutes 31;
ten-fold: --minutes 310).
"""

import one_thread  # noqa: F401

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

PARTS = ("graphs", "large", "marginals", "gnc", "icp", "start", "map")
SHARED = Path(os.environ.get("UWBLITE_SHARED_DATA", ROOT.parent / "shared" / "data"))


def measured(
    repeats: int, *functions: Callable[[], Any] | None, clock: Callable[[], float] = time.process_time
) -> list[tuple[float, Any]]:
    """Return for each function the median time, ms, and its last result; calls alternate after one that does not count.

    On one core the processor time of this process is the wall time that an idle machine would show.
    """
    times: list[list[float]] = [[] for _ in functions]
    results: list[Any] = [None for _ in functions]
    for repeat in range(repeats + 1):
        for k, function in enumerate(functions):
            if function is not None:
                began = clock()
                results[k] = function()
                if repeat:
                    times[k].append(1e3 * (clock() - began))
    middle = [sorted(t)[len(t) // 2] if t else float("nan") for t in times]
    return list(zip(middle, results, strict=True))


def show(*cells: object) -> None:
    """Print a row of the table."""
    print("| " + " | ".join(f"{c:.4g}" if isinstance(c, float) else str(c) for c in cells) + " |", flush=True)


def head(title: str, *columns: str) -> None:
    """Print a table's title and head."""
    print(f"\n### {title}\n")
    show(*columns)
    show(*["---"] * len(columns))


def graphs_to_optimise(large: bool) -> dict[str, Any]:
    """Return pose graphs by name; those of public files only where they are."""
    from bench_graphs import g2o_graph, paper_graph, pyfg_graph

    if large:
        return {"ten times the paper": paper_graph(10)[0], "forty times, from the truth": paper_graph(40, guess="truth")[0]}
    found = {"paper": paper_graph()[0]}
    files = {"intel": "sesync_intel", "manhattan": "efpno_manhattanOlson3500", "M3500": "efpno_input_M3500_original"}
    if SHARED.is_dir():
        found["plaza1"] = pyfg_graph(SHARED / "plaza1" / "plaza1.pyfg.gz")
        found |= {name: g2o_graph(SHARED / "pose_graphs" / f"{file}.g2o.gz") for name, file in files.items()}
    return found


def bench_graphs(repeats: int, large: bool = False) -> None:
    """Optimise pose graphs by uwblite and by GTSAM."""
    from bench_peers import gtsam_optimizer

    from uwblite.graph.solver import optimize

    head("Optimisation, ms", "graph", "poses", "edges", "uwblite", "iterations", "chi2", "GTSAM", "its chi2", "ratio")
    for name, graph in graphs_to_optimise(large).items():
        ours, theirs = measured(repeats, lambda g=graph: optimize(g)[1], gtsam_optimizer(graph))
        edges = sum(len(e) for e in graph.edges)
        chi2 = f"{ours[1].chi2:.4f}", "" if theirs[1] is None else f"{theirs[1]:.4f}"
        show(name, len(graph.poses), edges, ours[0], ours[1].iterations, chi2[0], theirs[0], chi2[1], ours[0] / theirs[0])


def bench_stages(repeats: int) -> None:
    """Time the stages of one iteration."""
    import numpy as np

    from uwblite.graph.graph import linearize
    from uwblite.graph.normal_equations import NormalEquations

    head("Stages of the optimiser, ms", "graph", "analyse (once)", "linearise", "fill", "factorise", "solve")
    for name, graph in (graphs_to_optimise(False) | graphs_to_optimise(True)).items():
        linearized = linearize(graph)
        normal = NormalEquations(graph, linearized)
        normal.fill(linearized, [None] * len(linearized))
        damping = 1e-10 * normal.diagonal
        factor = normal.factor(damping)
        stages = (
            lambda g=graph, lin=linearized: NormalEquations(g, lin),
            lambda g=graph: linearize(g),
            lambda n=normal, lin=linearized: n.fill(lin, [None] * len(lin)),
            lambda n=normal, d=damping: n.factor(d),
            lambda f=factor, n=normal: f.solve(np.asarray(n.gradient)),
        )
        show(name, *(t for t, _ in measured(repeats, *stages)))


def bench_marginals(repeats: int) -> None:
    """Compute every pose's covariance, and the joint one of 100 poses with the relative covariance of 300 pairs of them."""
    import numpy as np

    from uwblite.graph.marginals import JointCovariance, marginals
    from uwblite.graph.solver import optimize

    head("Marginal covariances, ms", "graph", "poses", "all blocks", "300 relative ones of 100 poses")
    for name, graph in (graphs_to_optimise(False) | graphs_to_optimise(True)).items():
        best = optimize(graph)[0]
        rng = np.random.default_rng(0)
        some = np.unique(rng.integers(0, len(best.poses), 100))
        i, j = rng.choice(some, (2, 300))
        ((all_blocks, _),) = measured(repeats, lambda g=best: marginals(g).covariances)
        ((pairs, _),) = measured(repeats, lambda g=best, some=some, i=i, j=j: JointCovariance(g, some).relative(i, j))
        show(name, len(best.poses), all_blocks, pairs)


def bench_gnc(repeats: int) -> None:
    """Sort out 30 % false closures and 30 % outlier ranges."""
    from bench_graphs import ate, paper_graph, spoilt

    from uwblite.graph.gnc import optimize_gnc
    from uwblite.graph.solver import optimize

    head("30 % false closures, 30 % outlier ranges", "seed", "ms", "ATE clean", "ATE plain", "ATE GNC", "ratio to clean")
    for seed in range(3):
        clean, truth = paper_graph(seed=seed)
        bad = spoilt(clean, 0.3, seed)
        ((spent, found),) = measured(repeats, lambda g=bad: optimize_gnc(g, {1: 4.0, 2: 3.0})[0])
        errors = [ate(g.poses, truth) for g in (optimize(clean)[0], optimize(bad)[0], found)]
        show(seed, spent, *errors, errors[2] / errors[0])


def bench_icp(repeats: int) -> None:
    """Align two noisy views of a hall, everything from the bare points included."""
    import numpy as np
    from bench_graphs import two_views
    from bench_peers import open3d_align, small_gicp_align

    from uwblite import se2
    from uwblite.lidar.cloud_rasters import rasterize
    from uwblite.lidar.clouds import CloudConfig, build
    from uwblite.lidar.scan_matching import align_pairs, pairs_of
    from uwblite.odometry.attached import ScanPoints

    first, second = np.array([0]), np.array([1])
    config = CloudConfig()

    def prepare(target, source, truth):
        """Return what align_pairs asks for; both views look from the middle of the hall."""
        scan = np.repeat(np.arange(2), (len(target), len(source)))
        middles = np.stack([np.zeros(2), se2.inverse(truth)[:2]])[scan]
        points = np.concatenate([target, source])
        both = build(ScanPoints(scan, points, middles, np.zeros_like(scan), scan), 2, config)
        return rasterize(both, config.raster, 0.5, first), pairs_of(both, first, second)

    def align(prepared, guess):
        return align_pairs(*prepared, guess[None], 0.5, 0.15).pose[0]

    columns = ("uwblite", "small_gicp ICP", "Open3D point to line")
    head("Registration, ms (error, mm), 24 pairs", "points", *columns, "ratio to small_gicp", "prepared")
    for points in (1000, 2000, 3000):
        times, errors = [], []
        for seed in range(24):
            target, source, truth, guess = two_views(points, seed)
            prepared = prepare(target, source, truth)
            runs = (
                lambda a=target, b=source, t=truth, g=guess: align(prepare(a, b, t), g),
                small_gicp_align(target, source, guess, 0.5),
                open3d_align(target, source, guess, 0.5),
                lambda p=prepared, g=guess: align(p, g),
            )
            done = measured(repeats, *runs)
            times.append([t for t, _ in done])
            errors.append([np.nan if r is None else np.hypot(*se2.between(truth, r)[:2]) for _, r in done])
        ms, mm = np.median(times, axis=0), 1e3 * np.median(errors, axis=0)
        cells = [f"{t:.2f} ({e:.1f})" for t, e in zip(ms[:3], mm[:3], strict=True)]
        show(points, *cells, float(ms[0] / ms[1]), float(ms[3]))


def bench_start(repeats: int) -> None:
    """Time a bare interpreter, the import and --help."""
    head("Start, ms", "what", "ms", "above bare python")
    commands = {
        "python -c pass": ["-c", "pass"],
        "import uwblite": ["-c", "import uwblite"],
        "uwblite --help": ["-m", "uwblite", "--help"],
    }
    done = measured(
        repeats,
        *(lambda c=c: subprocess.run([sys.executable, *c], capture_output=True, check=True) for c in commands.values()),
        clock=time.perf_counter,
    )
    for name, (spent, _) in zip(commands, done, strict=True):
        show(name, spent, spent - done[0][0])


def bench_map(logs: list[str], repeats: int, options: list[str], trees: list[str]) -> None:
    """Run `uwblite map` on recordings, alternately by each tree of the sources: time and peak memory."""
    columns = ("recording", "sources", "recorded, s", "wall, s", "processor, s", "real-time factor", "peak RSS, MB")
    head("Whole runs of `uwblite map`", *columns)
    for entry in logs:
        name, _, path = entry.rpartition("=")
        runs = {tree: [one_map(path, tree, options)] for tree in trees}
        for _ in range(repeats - 1):
            for tree, done in runs.items():
                done.append(one_map(path, tree, options))
        for tree, done in runs.items():
            recorded, wall, processor, peak = (sorted(column)[len(done) // 2] for column in zip(*done, strict=True))
            show(name or Path(path).name, Path(tree).name, recorded, wall, processor, recorded / processor, peak)


def one_map(path: str, tree: str, options: list[str]) -> tuple[float, float, float, float]:
    """Return how long was recorded, the wall and the processor time of its map, s, and the peak RSS, MB."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-P", "-m", "uwblite", "map", path, "--out", f"{folder}/map", "-q", *options]
        began = time.perf_counter()
        quiet = [(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)]
        child = os.posix_spawn(sys.executable, command, {**os.environ, "PYTHONPATH": tree}, file_actions=quiet)
        _, status, used = os.wait4(child, 0)
        wall = time.perf_counter() - began
        if os.waitstatus_to_exitcode(status) not in (0, 3):
            raise SystemExit(f"uwblite map failed on {path}")
        stamps = [float(line.split()[0]) for line in (Path(folder) / "map" / "trajectory.tum").open() if line[0] != "#"]
    return stamps[-1] - stamps[0], wall, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024.0


def main() -> int:
    """Run the parts asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="part", help=", ".join(PARTS), default=[])
    parser.add_argument("--repeats", type=int, default=9, help="timed calls of each function (9)")
    parser.add_argument("--log", action="append", default=[], metavar="NAME=FILE", help="recording for the part map")
    parser.add_argument("--tree", action="append", default=[], help="sources to map with, alternately; may be repeated (these)")
    parser.add_argument("--map-option", action="append", default=[], help="passed on to uwblite map")
    parser.add_argument("--cores", type=int, default=1, help="cores the process may use (1)")
    args = parser.parse_args()
    unknown = set(args.parts) - set(PARTS)
    if unknown:
        parser.error(f"unknown part {', '.join(sorted(unknown))}; choose from {', '.join(PARTS)}")
    parts = args.parts or [p for p in PARTS if p != "map" or args.log]
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: args.cores])
    runs = {
        "graphs": lambda: (bench_graphs(args.repeats), bench_stages(args.repeats)),
        "large": lambda: bench_graphs(max(1, args.repeats // 3), large=True),
        "marginals": lambda: bench_marginals(max(1, args.repeats // 3)),
        "gnc": lambda: bench_gnc(max(1, args.repeats // 3)),
        "icp": lambda: bench_icp(args.repeats),
        "start": lambda: bench_start(args.repeats),
        "map": lambda: bench_map(args.log, max(1, args.repeats // 3), args.map_option, args.tree or [str(ROOT)]),
    }
    for part in parts:
        runs[part]()
        print(f"\npeak RSS so far: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
