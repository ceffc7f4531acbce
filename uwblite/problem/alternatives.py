"""Alternatives: other explanations of the same measurements, compared by their evidence.

An alternative is a problem that was changed: its priors, what is fixed in it, or where its search begins. It is solved from
there, and stands against all others by the odds of their evidence (evidence.py). One for which there is positive evidence is
taken; one that very strong evidence does not refute stays open, for the findings.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from .. import se2
from ..arrays import rms_length
from ..errors import SolverError
from ..graph.graph import Graph


class EvidencePolicy:
    """Degrees of evidence (R. Kass, A. Raftery, Bayes factors, 1995), as logarithms of odds, and the effort of a search."""

    positive: float = float(np.log(3.0))
    """From here on an explanation is taken in place of the present one."""
    very_strong: float = float(np.log(150.0))
    """From here on an explanation is refuted."""
    hopeless: float = 20.0
    """From here on, against the likeliest, an explanation leads to no others: a further change would have to undo as much."""
    searched: int = 4
    """Explanations from which the search for others is continued, the likeliest first."""
    same_path: float = 0.1
    same_anchor: float = 0.5
    """m rms between the paths of two optima of one problem that are one, and between the places of an anchor."""


@dataclass(frozen=True, slots=True, eq=False)
class Explanation:
    """A solved problem and how probable it is."""

    graph: Graph
    log_odds: float
    """Logarithm of its odds against the problem as it stood."""

    @property
    def open(self) -> bool:
        """Whether there is no very strong evidence for the problem as it stood in place of this."""
        return self.log_odds > -EvidencePolicy.very_strong


def explanations(
    present: Graph,
    propose: Callable[[Graph], Iterable[Graph]],
    solve: Callable[[Graph], Graph],
    evidence: Callable[[Graph], float],
) -> list[Explanation]:
    """Return the explanations of measurements, the likeliest first; the present one, among them, has odds of 1.

    Parameters
    ----------
    present : the problem at its optimum.
    propose : returns alternatives to an explanation, each with the estimates where its search begins; it is asked again for
        explanations that are not hopeless.
    solve : returns a problem at its optimum. evidence : of an optimum, its logarithm.

    Raises
    ------
    SolverError : the measurements do not determine the present problem. Alternatives that they do not determine are dropped.
    """
    usual, found = evidence(present), [Explanation(present, 0.0)]
    waiting = [found[0]]
    for _ in range(EvidencePolicy.searched):
        waiting = [each for each in waiting if found[0].log_odds - each.log_odds < EvidencePolicy.hopeless]
        if not waiting:
            break
        for alternative in propose(waiting.pop(0).graph):
            try:
                graph = solve(alternative)
                odds = evidence(graph) - usual
            except SolverError:
                continue
            if not any(_same(graph, other.graph) for other in found):
                waiting.append(Explanation(graph, odds))
                found.append(waiting[-1])
        for each in (found, waiting):
            each.sort(key=lambda explanation: -explanation.log_odds)
    return found


def compared(
    present: Graph, alternative: Graph, solve: Callable[[Graph], Graph], evidence: Callable[[Graph], float]
) -> Explanation | None:
    """Return the explanation by one alternative; None where it is the present one, or they are not determined."""
    try:
        found = explanations(present, lambda graph: [alternative] if graph is present else [], solve, evidence)
    except SolverError:
        return None
    return next((each for each in found if each.graph is not present), None)


def _same(one: Graph, other: Graph) -> bool:
    """Return whether two graphs are one optimum of one problem."""
    if one.edges != other.edges or apart(one, other) > EvidencePolicy.same_path:
        return False
    motion = se2.align(other.poses[:, :2], one.poses[:, :2])
    between = (se2.transform(motion, other.anchors) - one.anchors)[~one.fixed_anchors]
    return bool(np.hypot(*between.T).max(initial=0.0) < EvidencePolicy.same_anchor)


def apart(one: Graph, other: Graph) -> float:
    """Return the rms distance of the poses of two graphs after alignment, m."""
    here, there = one.poses[:, :2], other.poses[:, :2]
    return rms_length(se2.transform(se2.align(there, here), there) - here)
