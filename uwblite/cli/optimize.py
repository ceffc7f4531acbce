"""`uwblite optimize`: the solver on a pose graph of any origin, no robot needed."""

import argparse
import dataclasses
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import closing
from itertools import chain
from typing import Any, NamedTuple

from ..config import override
from ..errors import ConfigError
from ..graph.gnc import misfit, optimize_gnc, outlier_thresholds, with_kernel
from ..graph.graph import Graph
from ..graph.robust import Kernel
from ..graph.solver import ALL_WORK_DONE, Progress, SolverConfig, SolverSummary, optimize
from ..io.formats import graph_format, read_graph, refuse_existing, write_graph
from ..io.graph_file import GraphFile
from ..io.tum import write_tum
from ..radio.graph_starts import Start, starts, starts_nearby, straightened
from . import console


def run(args: argparse.Namespace) -> int:
    if args.out:
        graph_format(args.out)
    refuse_existing(args.force, args.out, args.trajectory)
    config = override(SolverConfig(), args.set)
    file = read_graph(args.graph, from_odometry=args.from_odometry or args.incremental)
    if args.incremental and (count := len(set(file.chains.tolist()))) > 1:
        raise ConfigError(f"--incremental places the poses of one robot; {args.graph} has {count} chains of odometry")
    console.note_of(args.graph, file.warnings)
    graph = straightened(file.graph) if args.incremental else file.graph
    file = dataclasses.replace(file, graph=with_kernel(graph, Kernel(args.kernel, args.kernel_scale)))
    with closing(console.Progress()) as progress:
        search = _Search(args, config, lambda done, most: progress("optimising", done, most), _allowed(args, file.graph))
        best = _best(search, file, args)
    solved_file = dataclasses.replace(file, graph=best.start.placed(best.graph))
    if args.out:
        write_graph(args.out, solved_file)
    if args.trajectory:
        write_tum(args.trajectory, file.stamps, best.graph.poses)
    figures = _figures(solved_file, best.summary, [file.anchor_ids[k] for k in best.start.unplaced])
    figures["closures"] = _closures(best.graph, file.pose_ids)
    if args.robust:
        figures["outliers"] = best.outliers
    console.report(args.json, figures, _lines(args, figures))
    return 0 if best.summary.converged else 3


def _best(search: "_Search", file: GraphFile, args: argparse.Namespace) -> "_Solution":
    """Return the lowest minimum that is found."""
    solutions = search.solved(starts(file.graph, file.chains))
    best = min(solutions, key=lambda solution: (sum(solution.outliers.values()), solution.summary.chi2))
    if args.robust:
        return best
    further = starts_nearby(best.start, best.graph)
    if not args.from_odometry:
        forgotten = file.from_odometry()
        further = chain(further, starts(forgotten.graph, forgotten.chains, best.start.placed(best.graph).anchors))
    for rival in search.solved(further):
        as_many = len(rival.start.unplaced) <= len(best.start.unplaced)
        if as_many and rival.summary.chi2 < (1.0 - search.config.relative_decrease) * best.summary.chi2:
            best = rival
    return best


_WORK = 4e10
"""Multiplications of all factorisations; about ten seconds. Graphs of recordings take a tenth of that at most."""
_EDGES = 100_000
"""Up to so many; larger graphs have work by the square of their number."""


def _allowed(args: argparse.Namespace, graph: Graph) -> float:
    """Return the work that a search may take: counted, for the same file must end in the same bytes on any computer.

    Whoever sets the number of iterations gets as many.
    """
    if any(word.partition("=")[0].strip() == "max_iterations" for word in args.set):
        return float("inf")
    return _WORK * max(sum(map(len, graph.edges)) / _EDGES, 1.0) ** 2


class _Solution(NamedTuple):
    """An optimised graph."""

    graph: Graph
    summary: SolverSummary
    outliers: dict[str, int]
    """By kind of edge."""
    start: Start


class _Search:
    """Optimises a graph from one start after another, in the way that the options ask for, while there is work allowed."""

    def __init__(self, args: argparse.Namespace, config: SolverConfig, progress: Progress, allowed: float) -> None:
        self.args, self.config, self.progress, self.left = args, config, progress, allowed

    def solved(self, starts: Iterable[Start]) -> "Iterator[_Solution]":
        """Yield the solutions from starts."""
        starts = iter(starts)
        while self.left > 0.0 and (start := next(starts, None)) is not None:
            outliers = Counter[str]()
            if self.args.robust:
                limits = outlier_thresholds(start.graph)
                solved, summary, weights = optimize_gnc(start.graph, limits, self.config, self.progress, self.left)
                for k, weight in weights.items():
                    outliers[type(start.graph.edges[k]).__name__] += int((weight == 0.0).sum())
                # The file keeps every edge; which ones were left out is not a property of the measurements.
                graph = dataclasses.replace(solved, edges=start.graph.edges)
            else:
                graph, summary = optimize(start.graph, self.config, self.progress, self.left)
            self.left -= summary.work
            yield _Solution(graph, summary, outliers, start)


def _figures(file: GraphFile, summary: SolverSummary, lost: list[str]) -> dict[str, Any]:
    edges = Counter[str]()
    for kind in file.graph.edges:
        edges[type(kind).__name__] += len(kind)
    return {
        "poses": len(file.graph.poses),
        "anchors": len(file.graph.anchors),
        "edges": edges,
        "skipped": file.skipped,
        **{name: getattr(summary, name) for name in _OF_SUMMARY},
        "chains": len(set(file.chains.tolist())),
        "unplaced_anchors": lost,
        "exit_code": 0 if summary.converged else 3,
    }


_OF_SUMMARY = ("chi2_initial", "chi2", "dof", "chi2_per_dof", "iterations", "converged", "reason")


def _closures(graph: Graph, names: tuple[str, ...]) -> dict[str, Any]:
    """Return how many loop closures there are, how many are far off, and the poses of the worst."""
    closures = misfit(graph)
    worst = [names[k] for k in closures.worst] if closures.closures else None
    return {"count": closures.closures, "far_off": closures.off, "worst": worst, "contradict": closures.most}


_WITHIN = " within the work that is allowed for a graph of its size"
_TRY = "try --set max_iterations=1000, --from-odometry --incremental or --robust"


def _lines(args: argparse.Namespace, figures: dict[str, Any]) -> list[str]:
    edges = ", ".join(f"{count} {name}" for name, count in figures["edges"].items())
    lines = [f"{figures['poses']} poses, {figures['anchors']} anchors, {edges}"]
    per = f"{figures['chi2_per_dof']:.3f} per degree of freedom" if figures["dof"] > 0 else "nothing is measured twice"
    lines.append(
        f"chi2 {figures['chi2_initial']:.6g} -> {figures['chi2']:.9g} ({per}) in {figures['iterations']} iterations:"
        f" {figures['reason']}"
    )
    if not figures["converged"]:
        lines.append(f"DOUBT: not converged{_WITHIN if figures['reason'] == ALL_WORK_DONE else ''}; {_TRY}")
    closures = figures["closures"]
    if closures["contradict"]:
        lines.append(
            f"warning: {closures['far_off']} of {closures['count']} loop closures are more than 4 standard deviations off,"
            f" that of poses {' and '.join(closures['worst'])} most of all: they contradict each other, or state too much"
            " precision; check their poses, measurements and information"
        )
    if figures["chains"] > 1:
        lines[0] += f"; {figures['chains']} chains that nothing but ranges ties together"
    if "outliers" in figures:
        counted = ", ".join(f"{count} {name}" for name, count in figures["outliers"].items())
        lines.append(f"outliers left out: {counted or 'there is no edge that may be one'}")
    if figures["skipped"]:
        unused = ", ".join(f"{count} {tag}" for tag, count in figures["skipped"].items())
        lines.append(f"warning: lines of other kinds were not used: {unused}")
    if figures["unplaced_anchors"]:
        lines.append(f"warning: no position for anchors {', '.join(figures['unplaced_anchors'])}: too few ranges")
    written = [name for name in (args.out, args.trajectory) if name]
    lines.append("files: " + " ".join(written) if written else "nothing written; --out and --trajectory name files")
    return lines
