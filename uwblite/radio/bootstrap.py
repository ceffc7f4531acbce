"""Starting values from nothing: attempts with several errors of the heading, the first of which agrees with the ranges."""

from dataclasses import replace

import numpy as np

from ..arrays import Floats
from ..graph.graph import Calibration, Graph
from ..graph.pose_edges import OdometryEdges
from ..graph.range_edges import RangeEdges
from .bootstrap_attempt import Attempt, BootstrapConfig, BootstrapResult
from .trilateration import TrilaterationConfig


def bootstrap_graph(
    graph: Graph,
    odometry: OdometryEdges,
    ranges: RangeEdges,
    path: Floats,
    config: BootstrapConfig,
    search: TrilaterationConfig,
) -> BootstrapResult:
    """Estimate poses and anchor positions without any guess of the anchors.

    Where the ranges do not agree in the end, other hypotheses of a gross heading error are tried over a part of the path. A
    hypothesis that begins like an earlier attempt would continue like it, and is dropped. Where the first began well, one that
    begins as well is continued at once, as long as the ranges agree, then the others in the order of their misfit; the first
    that reaches the end is taken. Where none does, the best of them is continued if it began clearly better than the
    uncorrected heading, and is taken if it also ends better.

    Parameters
    ----------
    graph : poses (k, 3) by dead reckoning, anchors (a, 2) of any value, calibration block; its edges (priors) stay.
    odometry : k - 1 edges between consecutive poses.
    ranges : all ranges; those that cannot be distances must have weight 0.
    path : (k,) travelled distance at each pose, m.
    """
    first, *others = (
        Attempt(replace(graph, calibration=calibration), odometry, ranges, path, config, search)
        for heading_scale in config.heading_scales
        if (calibration := _with_heading_scale(graph.calibration, heading_scale)) is not None
    )
    first.run(config.enough)
    begun = first.misfit()
    # Where it has a jump, it is completed only if nothing else agrees.
    first.run(torn=not others)
    if first.misfit() < config.agreement or not others:
        return first.estimate()
    tried, misfits = [first], [np.inf]
    for attempt in others:
        attempt.run(0.0)
        if any(attempt.began_like(other) for other in tried):
            continue
        attempt.run(config.enough, torn=False)
        tried.append(attempt)
        misfits.append(attempt.misfit())
        if misfits[-1] <= begun < config.agreement and attempt.agrees_to_the_end():
            return attempt.estimate()
    order = np.argsort(misfits, kind="stable")[: len(tried) - 1].tolist()
    for number in order:
        if tried[number].agrees_to_the_end():
            return tried[number].estimate()
    hopeful = tried[order[0]] if order and misfits[order[0]] < 0.8 * begun else first
    first.run()
    hopeful.run()
    return (hopeful if hopeful.misfit() < 0.8 * first.misfit() else first).estimate()


def _with_heading_scale(calibration: Calibration, value: float) -> Calibration | None:
    """Return the calibration with this heading scale; None where that is not an unknown and the value is not nominal."""
    index = calibration.index("heading_scale")
    if index < 0:
        return calibration if value == 0.0 else None
    values = calibration.values.copy()
    values[index] = value
    return replace(calibration, values=values)
