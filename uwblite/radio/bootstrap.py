"""Starting values from nothing: attempts with several errors of the heading, the first of which agrees with the ranges."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from ..arrays import runs_of
from ..graph.graph import Calibration, Graph
from ..odometry.slips import LASTS
from ..problem.alternatives import EvidencePolicy
from .bootstrap_attempt import Attempt, BootstrapPolicy, BootstrapResult, Measured
from .trilateration import TrilaterationConfig


def bootstrap_graph(graph: Graph, measured: Measured, search: TrilaterationConfig) -> BootstrapResult:
    """Estimate poses and anchor positions without any guess of the anchors.

    Where the ranges do not agree in the end, gross errors of the heading, and wheels that slip, are the other explanations.
    Slips are sought from several first stretches. The attempt of greatest evidence is taken.

    Parameters
    ----------
    graph : poses (k, 3) by dead reckoning, anchors (a, 2) of any value, calibration block; its edges (priors) stay.
    """
    first, *others = (
        Attempt(replace(graph, calibration=calibration), measured, search)
        for heading_scale in BootstrapPolicy.heading_scales
        if (calibration := _with_heading_scale(graph.calibration, heading_scale)) is not None
    )
    # Where it has a jump, it is completed only if nothing else agrees.
    first.run(torn=not others)
    if first.misfit() < BootstrapPolicy.agreement:
        return of_likeliest_slips(first).estimate()
    heading, slipping = _likeliest_heading(first, others), list[Attempt]()
    while len(slipping) < BootstrapPolicy.slipping_starts and (not slipping or slipping[-1].slips.any()):
        # The wheels may have slipped in the first stretch as well.
        slipping.append(Attempt(graph, measured, search, [each.first for each in slipping]))
        slipping[-1].run()
    agreeing = [attempt for attempt in slipping if attempt.misfit() < BootstrapPolicy.agreement]
    best = of_likeliest_slips(max([heading, *agreeing], key=Attempt.evidence))
    # Slips make up for turns of the wrong sign: the path may be the mirror image of the true one.
    image = _likeliest(best, [best.mirrored()])
    return (best if image is best else of_likeliest_slips(image)).estimate()


def of_likeliest_slips(attempt: Attempt) -> Attempt:
    """Return the attempt with the slips of greatest evidence.

    Slips are tried at either end of bursts of ranges that are off, or in a row of those; each that there is may as well not be,
    or be half its length earlier or later.
    """
    for _ in range(_SWEEPS):
        before, times = attempt, np.append(0.0, np.cumsum(attempt.odometry.duration))
        for first, last in attempt.bursts():
            low = int(np.searchsorted(times, times[first] - _AROUND))
            high = int(np.searchsorted(times, times[last] + _AROUND, "right"))
            found = (attempt.slipping(low, high, forward=forward) for forward in (True, False))
            attempt = _likeliest(attempt, (other.with_slips(other.slips) for other in found if other is not None))
        for slip in runs_of(attempt.slips > 0.0):
            attempt = _likeliest(attempt, _slipping_otherwise(attempt, *slip))
        if attempt is before:
            break
    return attempt


_SWEEPS, _AROUND = 3, 2.0 * LASTS
"""Most rounds over all slips, and time before and after a burst in which a slip is sought, s."""


def _likeliest(attempt: Attempt, others: Iterable[Attempt]) -> Attempt:
    """Return the likeliest of other attempts where there is positive evidence for it in place of the present one."""
    rival = max(others, key=Attempt.evidence, default=attempt)
    return rival if rival.evidence() - attempt.evidence() > EvidencePolicy.positive else attempt


def _slipping_otherwise(attempt: Attempt, first: int, last: int) -> Iterator[Attempt]:
    """Yield the attempt without the slip over the steps first <= k < last, and with it half its length earlier and later."""
    half = max((last - first) // 2, 1)
    for begin, end in (first, first), (first - half, last - half), (first + half, last + half):
        slips = attempt.slips.copy()
        slips[first:last] = 0.0
        slips[max(begin, 0) : end] = 1.0
        yield attempt.with_slips(slips)


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
