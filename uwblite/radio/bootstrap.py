"""Starting values from nothing: attempts with several errors of the heading, the first of which agrees with the ranges."""

from collections.abc import Sequence
from dataclasses import replace

from ..graph.graph import Calibration, Graph
from .bootstrap_attempt import Attempt, BootstrapConfig, BootstrapResult, Measured
from .trilateration import TrilaterationConfig


def bootstrap_graph(graph: Graph, measured: Measured, config: BootstrapConfig, search: TrilaterationConfig) -> BootstrapResult:
    """Estimate poses and anchor positions without any guess of the anchors.

    Where the ranges do not agree in the end, gross errors of the heading, and wheels that slip, are the other explanations.
    Slips are sought from several first stretches. The attempt of greatest evidence is taken.

    Parameters
    ----------
    graph : poses (k, 3) by dead reckoning, anchors (a, 2) of any value, calibration block; its edges (priors) stay.
    """
    first, *others = (
        Attempt(replace(graph, calibration=calibration), measured, config, search)
        for heading_scale in config.heading_scales
        if (calibration := _with_heading_scale(graph.calibration, heading_scale)) is not None
    )
    # Where it has a jump, it is completed only if nothing else agrees.
    first.run(torn=not others)
    if first.misfit() < config.agreement:
        return first.estimate()
    heading, slipping = _likeliest_heading(first, others), list[Attempt]()
    while len(slipping) < config.slipping_starts and (not slipping or slipping[-1].slips.any()):
        # The wheels may have slipped in the first stretch as well.
        slipping.append(Attempt(graph, measured, config, search, [each.first for each in slipping]))
        slipping[-1].run()
    agreeing = [attempt for attempt in slipping if attempt.misfit() < config.agreement]
    return max([heading, *agreeing], key=Attempt.evidence).estimate()


def _likeliest_heading(first: Attempt, others: Sequence[Attempt]) -> Attempt:
    """Return the first attempt, or another one with a gross error of the heading, complete: one whose ranges agree to the end,
    or else the likelier of the first and of that with the least misfit as far as it went."""
    for attempt in others:
        if attempt.agrees_to_the_end():
            return attempt
    complete = [first, *sorted(others, key=Attempt.misfit)[:1]]
    for attempt in complete:
        attempt.run()
    return max(complete, key=Attempt.evidence)


def _with_heading_scale(calibration: Calibration, value: float) -> Calibration | None:
    """Return the calibration with this heading scale; None where that is not an unknown and the value is not nominal."""
    index = calibration.index("heading_scale")
    if index < 0:
        return calibration if value == 0.0 else None
    values = calibration.values.copy()
    values[index] = value
    return replace(calibration, values=values)
