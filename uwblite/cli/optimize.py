"""`uwblite optimize`: the solver on a pose graph of any origin, no robot needed."""

import argparse
from typing import TYPE_CHECKING, Any

from .options import number, place

if TYPE_CHECKING:
    from ..graph.graph import Graph
    from ..graph.solver import SolverSummary
    from ..io.graph_file import GraphFile

HELP = "optimise a pose graph: g2o, TORO or PyFG in, optimised graph and trajectory out"
EPILOG = """\
examples:
  uwblite optimize graph.g2o --out optimised.g2o
  uwblite optimize graph.pyfg --out optimised.pyfg --trajectory path.tum --from-odometry
  uwblite optimize loops.g2o --out straight.g2o --kernel huber --kernel-scale 2
  uwblite optimize graph.g2o --json                chi2 and iterations only, nothing is written

exit code 3: the search did not converge
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument("graph", help=".g2o, TORO (.graph, .toro) or .pyfg file, plain or .gz; - reads standard input")
    parser.add_argument("--out", type=place, metavar="FILE", help="optimised graph; .g2o or .pyfg by its name, .gz compresses")
    parser.add_argument("--trajectory", type=place, metavar="FILE", help="poses as a TUM trajectory, as evo reads it")
    parser.add_argument("--from-odometry", action="store_true", help="forget the file's estimates, start from the odometry")
    parser.add_argument("--kernel", metavar="NAME", default="none", help="robust kernel on edges that close loops, and ranges")
    bend = "standard deviations where it bends (2)"
    parser.add_argument("--kernel-scale", metavar="K", type=number(above=0), default=2.0, help=bend)
    setting = "solver setting, e.g. max_iterations=200; repeatable"
    parser.add_argument("--set", metavar="NAME=VALUE", action="append", default=[], help=setting)
    parser.add_argument("--force", action="store_true", help="replace files that are already there")
    parser.add_argument("--json", action="store_true", help="print a summary as one JSON object instead of text")


def run(args: argparse.Namespace) -> int:
    """Carry out the verb."""
    import dataclasses

    from ..config import override
    from ..graph.solver import SolverConfig, optimize
    from ..radio.anchor_starts import place_anchors
    from ..radio.chain_starts import place_chains
    from . import console
    from .formats import graph_format, read_graph, refuse_existing, write_graph

    if args.out:
        graph_format(args.out)
    refuse_existing(args.force, args.out, args.trajectory)
    config = override(SolverConfig(), args.set)
    file = read_graph(args.graph, from_odometry=args.from_odometry)
    for warning in file.warnings:
        console.note(f"uwblite: {args.graph}: {warning}")
    starts = place_chains(_with_kernel(file.graph, args.kernel, args.kernel_scale), file.chains)
    progress = console.Progress()
    try:
        solutions = []
        for start in starts:
            graph, lost = place_anchors(start)
            solutions.append((*optimize(graph, config, lambda done, most: progress("optimising", done, most)), lost))
    finally:
        progress.close()
    solved, summary, lost = min(solutions, key=lambda solution: solution[1].chi2)
    solved_file = dataclasses.replace(file, graph=solved)
    if args.out:
        write_graph(args.out, solved_file)
    if args.trajectory:
        from ..io.tum import write_tum

        write_tum(args.trajectory, file.stamps, solved.poses)
    figures = _figures(solved_file, summary, [file.anchor_ids[k] for k in lost])
    if args.json:
        console.say_json(figures)
    else:
        for line in _lines(args, figures):
            console.say(line)
    return 0 if summary.converged else 3


def _with_kernel(graph: "Graph", name: str, scale: float) -> "Graph":
    """Return the graph with a robust kernel on every edge but those between successive poses."""
    import dataclasses

    import numpy as np

    from ..graph.pose_edges import RelativePoseEdges
    from ..graph.robust import Kernel

    kernel = Kernel(name, scale)
    edges: list[Any] = []
    for e in graph.edges:
        if not isinstance(e, RelativePoseEdges):
            edges.append(dataclasses.replace(e, kernel=kernel))  # type: ignore[type-var]
            continue
        loop = np.abs(e.j - e.i) != 1
        for chosen, used in ((~loop, e.kernel), (loop, kernel)):
            if chosen.any():
                parts = {n: getattr(e, n)[chosen] for n in ("i", "j", "T_i_j", "sqrt_information")}
                weights = None if e.weights is None else e.weights[chosen]
                edges.append(dataclasses.replace(e, **parts, weights=weights, kernel=used))
    return dataclasses.replace(graph, edges=tuple(edges))


def _figures(file: "GraphFile", summary: "SolverSummary", lost: list[str]) -> dict[str, Any]:
    edges: dict[str, int] = {}
    for kind in file.graph.edges:
        edges[type(kind).__name__] = edges.get(type(kind).__name__, 0) + len(kind)
    return {
        "poses": len(file.graph.poses),
        "anchors": len(file.graph.anchors),
        "edges": edges,
        "skipped": file.skipped,
        "chi2_initial": summary.chi2_initial,
        "chi2": summary.chi2,
        "dof": summary.dof,
        "chi2_per_dof": summary.chi2_per_dof,
        "iterations": summary.iterations,
        "converged": summary.converged,
        "reason": summary.reason,
        "chains": int(file.chains.max(initial=0)) + 1,
        "certificate": "none: the minimum is a local one",
        "unplaced_anchors": lost,
        "exit_code": 0 if summary.converged else 3,
    }


def _lines(args: argparse.Namespace, figures: dict[str, Any]) -> list[str]:
    edges = ", ".join(f"{count} {name}" for name, count in figures["edges"].items())
    lines = [f"{figures['poses']} poses, {figures['anchors']} anchors, {edges}"]
    lines.append(
        f"chi2 {figures['chi2_initial']:.6g} -> {figures['chi2']:.9g} ({figures['chi2_per_dof']:.3f} per degree of freedom)"
        f" in {figures['iterations']} iterations: {figures['reason']}"
    )
    if not figures["converged"]:
        lines.append("DOUBT: not converged; try --set max_iterations=1000, --from-odometry or a robust --kernel")
    lines.append("no certificate: whether a lower minimum exists is not known")
    if figures["chains"] > 1:
        lines[0] += f"; {figures['chains']} chains that nothing but ranges ties together"
    if figures["unplaced_anchors"]:
        lines.append(f"warning: no position for anchors {', '.join(figures['unplaced_anchors'])}: too few ranges")
    written = [name for name in (args.out, args.trajectory) if name]
    lines.append("files: " + " ".join(written) if written else "nothing written; --out and --trajectory name files")
    return lines
