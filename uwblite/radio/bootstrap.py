"""Starting values from nothing: attempts with several errors of the heading, the first of which agrees with the ranges."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..graph.graph import Calibration, Graph
from .bootstrap_attempt import Attempt, BootstrapConfig, BootstrapResult, Measured
from .trilateration import TrilaterationConfig


def bootstrap_graph(graph: Graph, measured: Measured, config: BootstrapConfig, search: TrilaterationConfig) -> BootstrapResult:
    """Estimate poses and anchor positions without any guess of the anchors.

    Where the ranges do not agree in the end, other hypotheses of a gross heading error are tried over a part of the path. A
    hypothesis that begins like an earlier attempt would continue like it, and is dropped. Where the first began well, one that
    begins as well is continued at once, as long as the ranges agree, then the others in the order of their misfit; the first
    that reaches the end is taken. Where none does, the best of them is continued if it began clearly better than the
    uncorrected heading, and is taken if it also ends better. Wheels that slip are the other explanation: they are sought from
    several first stretches, and of the attempts that agree the one of greatest evidence is taken.

    Parameters
    ----------
    graph : poses (k, 3) by dead reckoning, anchors (a, 2) of any value, calibration block; its edges (priors) stay.
    """
    first, *others = (
        Attempt(replace(graph, calibration=calibration), measured, config, search)
        for heading_scale in config.heading_scales
        if (calibration := _with_heading_scale(graph.calibration, heading_scale)) is not None
    )
    first.run(config.enough)
    begun = first.misfit()
    # Where it has a jump, it is completed only if nothing else agrees.
    first.run(torn=not others)
    if first.misfit() < config.agreement:
        return first.estimate()
    tried, slipping = [_likeliest_heading(first, begun, others, config)] if others else [first], list[Attempt]()
    while len(slipping) <= _STARTS and (not slipping or slipping[-1].slips.any()):
        # The wheels may have slipped in the first stretch as well.
        slipping.append(Attempt(graph, measured, config, search, [each.first for each in slipping]))
        slipping[-1].run()
    agreeing = [attempt for attempt in slipping if attempt.misfit() < config.agreement]
    return max([*tried, *agreeing], key=Attempt.evidence).estimate()


_STARTS = 3
"""Further stretches that are tried as the first one where the wheels slip."""


def _likeliest_heading(first: Attempt, begun: float, others: Sequence[Attempt], config: BootstrapConfig) -> Attempt:
    """Return the first attempt, or another one with a gross error of the heading whose ranges agree better, complete.

    Parameters
    ----------
    begun : misfit with which the first one began.
    """
    tried, misfits = [first], [np.inf]
    for attempt in others:
        attempt.run(0.0)
        if any(attempt.began_like(other) for other in tried):
            continue
        attempt.run(config.enough, torn=False)
        tried.append(attempt)
        misfits.append(attempt.misfit())
        if misfits[-1] <= begun < config.agreement and attempt.agrees_to_the_end():
            return attempt
    order = np.argsort(misfits, kind="stable")[: len(tried) - 1].tolist()
    for number in order:
        if tried[number].agrees_to_the_end():
            return tried[number]
    hopeful = tried[order[0]] if order and misfits[order[0]] < 0.8 * begun else first
    first.run()
    hopeful.run()
    return hopeful if hopeful.misfit() < 0.8 * first.misfit() else first


def _with_heading_scale(calibration: Calibration, value: float) -> Calibration | None:
    """Return the calibration with this heading scale; None where that is not an unknown and the value is not nominal."""
    index = calibration.index("heading_scale")
    if index < 0:
        return calibration if value == 0.0 else None
    values = calibration.values.copy()
    values[index] = value
    return replace(calibration, values=values)
