"""Heights of anchors where none is given: slant ranges to high anchors look like a wrong unit of the odometry.

Two hypotheses, low or as high as in a large hall, are solved and compared by marginal likelihood at their optima.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from .. import se2
from ..arrays import rms_length
from ..errors import SolverError
from ..graph.calibration import HEIGHT, RADIO, optimize_with_heights, with_free
from ..graph.graph import Graph
from ..graph.optimizer import Optimizer
from ..graph.solver import SolverConfig
from ..problem.evidence import laplace_marginal_likelihood
from ..radio import prior_selection
from .estimate import Estimate, OtherHeights, Task
from .mapping_config import MappingConfig

_LIKELIER = float(np.log(3.0))
"""Difference of the logarithms of marginal likelihoods from which on the other hypothesis is taken (positive evidence)."""
_REFUTED = 20.0
"""The difference from which on a hypothesis is refuted: wrong assumptions about the noise can cause half of it."""
_COMPARED = 1e-5
"""Relative decrease of chi2 that ends the optimisations whose likelihoods are compared; the chosen one is then continued."""
_NOTICEABLE = 1.0
"""Height above the tag, m, from which on anchors can look like another unit; lower ones lengthen short ranges only."""
_ELSEWHERE = 0.4
"""rms distance of two trajectories, m, from which on it matters which of them is true."""


def with_likelier_heights(estimate: Estimate, config: MappingConfig) -> Estimate:
    """Return the estimate under the likelier of the two hypotheses, with the other one where it is not refuted.

    Recordings that were joined are tested alone first: only where they do not refute high anchors, all are solved together.
    """
    low = estimate.graph.with_edges(*estimate.odometry_and_ranges)
    heights = low.calibration.of_kinds(HEIGHT)
    if estimate.ranges is None or not heights.any() or _refuted(estimate.alone, config):
        return estimate
    optimizer = Optimizer()
    try:
        start, high, gain = _with_high_anchors(estimate, config, optimizer)
    except SolverError:
        return estimate
    height = float(np.sqrt(np.median(high.calibration.values[heights])))
    taken = gain > _LIKELIER
    if taken:
        high, _ = optimize_with_heights(high, config.solver, optimizer)
        graph = replace(start, fixed_calibration=high.fixed_calibration)
        estimate = replace(estimate, graph=graph.with_estimates_of(high))
    if abs(gain) > _REFUTED or height < _NOTICEABLE:
        return estimate
    return replace(estimate, other_heights=OtherHeights(height, taken, _apart(low, high)))


def _with_high_anchors(estimate: Estimate, config: MappingConfig, optimizer: Optimizer) -> tuple[Graph, Graph, float]:
    """Return where the search under the hypothesis of high anchors begins, without measurements, where it ends, with them, and
    by how much its logarithm of the marginal likelihood is greater than that of the estimate.

    Raises
    ------
    SolverError : the measurements do not determine one of them.
    """
    edges = estimate.odometry_and_ranges
    start = with_free(prior_selection.with_high_anchors(estimate.graph, config.calibration), *RADIO)
    high, _ = optimize_with_heights(start.with_edges(*edges), compared(config.solver), optimizer)
    # Heights that were put back to 0 count as known no better than the others.
    graphs = estimate.graph.with_edges(*edges), high
    likely = [laplace_marginal_likelihood(with_free(graph, HEIGHT)) for graph in graphs]
    return start, high, likely[1] - likely[0]


def _refuted(alone: Sequence[Estimate], config: MappingConfig) -> bool:
    """Return whether recordings (r,), each on its own, refute together that anchors are high.

    A recording whose anchors all occur in earlier ones is not tested; one that does not determine its anchors does not count.
    """
    gain, asked = 0.0, set[str]()
    for own in alone:
        if own.ranges is not None and own.graph.calibration.of_kinds(HEIGHT).any() and not asked.issuperset(own.anchor_ids):
            with suppress(SolverError):
                gain += _with_high_anchors(own, config, Optimizer())[2]
                asked.update(own.anchor_ids)
    return gain < -_REFUTED


def compared(solver: SolverConfig) -> SolverConfig:
    """Return the solver settings for an optimisation whose likelihood is compared with that of another one."""
    return replace(solver, relative_decrease=max(solver.relative_decrease, _COMPARED))


def _apart(one: Graph, other: Graph) -> float:
    """Return the rms distance of the poses of two graphs after alignment, m."""
    here, there = one.poses[:, :2], other.poses[:, :2]
    return rms_length(se2.transform(se2.align(there, here), there) - here)


def check_heights(estimate: Estimate, task: Task) -> None:
    """Note where the ranges do not decide how high the anchors are, and a map without lidar depends on it."""
    other = estimate.other_heights
    if other is None or task.recordings.have_scans or other.apart < _ELSEWHERE:
        return
    task.stages.note("anchor-heights", height=other.high, taken=other.taken, apart=other.apart)
