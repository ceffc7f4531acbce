"""Heights of anchors where none is given: slant ranges to high anchors look like a wrong unit of the odometry.

Two explanations compete: anchors are low, or as high as in a large hall and the wheels' unit is right.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ..graph.calibration import HEIGHT, RADIO, CalibrationConfig, with_free
from ..graph.graph import Graph
from ..graph.solver import Optimizer
from ..problem.alternatives import Alternative, EvidencePolicy, Explanation, apart, compared
from ..problem.evidence import laplace_marginal_likelihood, prior_sigma, with_prior_sigma
from ..problem.solution import comparable, solve
from .estimate import Estimate, OtherHeights, Task
from .line_sides import LinePolicy
from .mapping_config import MappingConfig


@dataclass(frozen=True, slots=True)
class HeightPolicy:
    """When anchors that hang high matter."""

    refuted: ClassVar[float] = EvidencePolicy.very_strong + 10.0
    """Logarithm of the odds; wrong assumptions about the noise of ranges can cause 10 of it."""
    noticeable: ClassVar[float] = 1.0
    """m above the tag from which on anchors can look like another unit; lower ones lengthen short ranges only."""
    high: ClassVar[float] = 6.0
    """m above the tag; anchors in a large hall."""


def choose_heights(estimate: Estimate, config: MappingConfig) -> Estimate:
    """Return the estimate under the likelier of the two explanations, with the other one where it is not refuted.

    Recordings that were joined are tested alone first: only where they do not refute high anchors, all are solved together.
    """
    heights = estimate.graph.calibration.of_kinds(HEIGHT)
    if estimate.ranges is None or not heights.any() or _refuted(estimate.alone, config):
        return estimate
    low, optimizer = estimate.problem, Optimizer()
    if (high := _high_anchors(estimate, config, optimizer)) is None:
        return estimate
    height = float(np.sqrt(np.median(high.graph.calibration.values[heights])))
    if taken := high.log_odds > EvidencePolicy.positive:
        graph = replace(high.graph, edges=high.graph.edges[: len(estimate.graph.edges)])
        estimate = replace(estimate, graph=graph).solved(config.solver, optimizer)[0]
    if abs(high.log_odds) > HeightPolicy.refuted or height < HeightPolicy.noticeable:
        return estimate
    return replace(estimate, other_heights=OtherHeights(height, taken, apart(low, high.graph)))


def _high_anchors(estimate: Estimate, config: MappingConfig, optimizer: Optimizer) -> Explanation | None:
    """Return the explanation by high anchors, None where the measurements do not determine it or the present one."""

    def solved(graph: Graph) -> Graph:
        return solve(graph, comparable(config.solver), optimizer)[0]

    def evidence(graph: Graph) -> float:
        # Heights that were put back to 0 count as known no better than the others.
        return laplace_marginal_likelihood(with_free(graph, HEIGHT))

    present = estimate.problem
    return compared(present, Alternative(raise_anchors(present, config.calibration)), solved, evidence)


def raise_anchors(graph: Graph, config: CalibrationConfig) -> Graph:
    """Return the graph with priors under which the wheels' unit is right and the anchors are as high as in a large hall.

    As the start, lengths scaled by a wrong unit are scaled back; heights that were fixed at 0 are free again.
    """
    scales, heights = graph.calibration.of_kinds("odometry_scale"), graph.calibration.of_kinds(HEIGHT)
    stretched = 1.0 + float(np.mean(graph.calibration.values[scales])) if scales.any() else 1.0
    poses = np.column_stack([graph.poses[:, :2] / stretched, graph.poses[:, 2]])
    graph = graph.updated(poses, graph.anchors / stretched, np.where(scales, 0.0, graph.calibration.values))
    sigma = prior_sigma(graph)
    sigma[scales], sigma[heights] = config.odometry_scale, HeightPolicy.high**2
    return with_prior_sigma(with_free(graph, *RADIO), sigma)


def _refuted(alone: Sequence[Estimate], config: MappingConfig) -> bool:
    """Return whether recordings (r,), each on its own, refute together that anchors are high.

    A recording whose anchors all occur in earlier ones is not tested; one that does not determine its anchors does not count.
    """
    log_odds, asked = 0.0, set[str]()
    for own in alone:
        if own.ranges is not None and own.graph.calibration.of_kinds(HEIGHT).any() and not asked.issuperset(own.anchor_ids):
            high = _high_anchors(own, config, Optimizer())
            if high is not None:
                log_odds += high.log_odds
                asked.update(own.anchor_ids)
    return log_odds < -HeightPolicy.refuted


def check_heights(estimate: Estimate, task: Task) -> None:
    """Note where the ranges do not decide how high the anchors are, and a map without lidar depends on it."""
    other = estimate.other_heights
    if other is None or task.recordings.have_scans or other.apart < LinePolicy.elsewhere:
        return
    task.stages.note("anchor-heights", height=other.high, taken=other.taken, apart=other.apart)
