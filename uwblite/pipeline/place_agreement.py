"""Places of one anchor that turn out to be one place once the trajectory is known well.

A move is found along a given trajectory, as if that were exact. Where a first trajectory is bent, or the lidar sees too little
to hold the last one, ranges from two stretches of it seem to be from two places, of which one may be a mirror image. Here all
measurements are in one graph, and the trajectory is free. Where one place costs no more than chance explains, there is one:
a test by the ratio of likelihoods, which holds as well where a place is known along a curve only. Places that recordings have
of an anchor are found at fixed poses, too, and compared in the same way.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from ..graph.solver import SolverConfig
from ..problem.parts import at_given_poses
from ..sensor_log.anchor_names import first_place, name_and_number
from .estimate import Estimate, Task
from .lidar_stages import solved
from .radio_stages import with_range_noise

_FALSE_MOVES = 0.05
"""Share of maps with unmoved anchors in which two places are wrongly kept (significance level)."""
_PER_MOMENT = 8
"""Ranges per independent test: as many determine a place."""
_GIVEN = 10.0
"""Factor on the limit up to which the test is repeated with free poses where one place costs more at fixed ones."""


def merge_places_that_agree(estimate: Estimate, task: Task) -> Estimate:
    """Return the estimate with successive places of an anchor as one where one place explains their ranges as well."""
    ranges = estimate.ranges
    # Prior knowledge of the user refers to anchors by their present numbers.
    given = bool(task.given.anchors or task.given.distances)
    pairs = [] if ranges is None or given else _successive(estimate)
    if ranges is None or not pairs:
        return estimate
    same = _same(estimate, pairs, _most_cost(int(np.sum(ranges.alive))), task.config.solver)
    if not same:
        return estimate
    task.stages.end("places merged", anchors=len(same))
    merged = with_range_noise(_merged(estimate, same), task.config, steady=estimate.joint is not None)
    task.stages.withdraw("moved-anchor", "new_id", but=merged.anchor_ids)
    return solved(merged, task.config.solver)


def _same(estimate: Estimate, pairs: Sequence[tuple[int, int]], most: float, solver: SolverConfig) -> list[tuple[int, int]]:
    """Return the pairs of places that one place replaces at no more than this cost: at fixed poses, or with free ones."""
    here = solved(replace(estimate, graph=at_given_poses(estimate.graph)), solver)
    costs = {pair: _cost_of_one(here, pair, solver) for pair in pairs}
    near = [pair for pair, cost in costs.items() if most < cost <= _GIVEN * most]
    if near:
        apart = solved(estimate, solver)
        costs |= {pair: _cost_of_one(apart, pair, solver) for pair in near}
    return [pair for pair in pairs if costs[pair] <= most]


def _most_cost(count: int) -> float:
    """Return the quantile of chi-square, 2 degrees of freedom, for the number of tests among so many ranges.

    Bonferroni: each of them is tried at a level that makes _FALSE_MOVES of all together.
    """
    return -2.0 * float(np.log(_FALSE_MOVES / max(count / _PER_MOMENT, 1.0)))


_NEAR = 1.0
"""m; places of two recordings further apart are two: what noise and bent paths leave of one place is less."""


def _successive(estimate: Estimate) -> list[tuple[int, int]]:
    """Return pairs of placed anchors of which the second is another recording's place, or the next in a recording, of the
    first."""
    number = {name: k for k, name in enumerate(estimate.anchor_ids) if estimate.placed[k]}
    pairs = [
        (one, other) for one, other in combinations(number, 2) if first_place(one) == first_place(other)
        and np.hypot(*(estimate.graph.anchors[number[one]] - estimate.graph.anchors[number[other]])) < _NEAR
    ]  # fmt: skip
    for name in number:
        place = first_place(name)
        base, which = name_and_number(place)
        before = base if which == 2 else f"{base}@{which - 1}"
        of_before = [n for n in (before + name[len(place) :], before) if n in number]
        if which > 1 and of_before:
            pairs.append((of_before[0], name))
    return [(number[one], number[other]) for one, other in pairs]


def _cost_of_one(apart: Estimate, pair: tuple[int, int], solver: SolverConfig) -> float:
    """Return by how much chi2 grows where two places are joined, with either of them as the start."""
    one = _merged(apart, [pair])
    costs = []
    for start in pair:
        anchors = one.graph.anchors.copy()
        anchors[one.anchor_ids.index(apart.anchor_ids[pair[0]])] = apart.graph.anchors[start]
        costs.append(solved(replace(one, graph=replace(one.graph, anchors=anchors)), solver).problem.chi2())
    return min(costs) - apart.problem.chi2()


def _merged(estimate: Estimate, pairs: Sequence[tuple[int, int]]) -> Estimate:
    """Return the estimate with the second anchor of each pair as the first one, which may be the second of another pair.

    The constant error of each stretch stays its own.
    """
    ranges, found = estimate.ranges, estimate.bootstrap
    assert ranges is not None
    assert found is not None
    into = np.arange(len(estimate.anchor_ids))
    for first, second in sorted(pairs):
        into[into == second] = into[first]
    counts = np.bincount(ranges.anchor[ranges.alive], minlength=len(into)).astype(np.float64)
    anchors = estimate.graph.anchors.copy()
    for k in {into[first] for first, _ in pairs}:
        own = into == k
        anchors[k] = np.average(anchors[own], axis=0, weights=np.maximum(counts[own], 1.0))
    kept = np.unique(into)
    found = replace(
        found, placed=found.placed[kept], ambiguous=found.ambiguous[kept], hypotheses=tuple(found.hypotheses[k] for k in kept)
    )
    graph = replace(estimate.graph, anchors=anchors[kept], fixed_anchors=estimate.graph.fixed_anchors[kept])
    ranges = replace(ranges, anchor=np.searchsorted(kept, into[ranges.anchor]))
    names = tuple(estimate.anchor_ids[k] for k in kept)
    return replace(estimate, graph=graph, ranges=ranges, bootstrap=found, anchor_ids=names)
