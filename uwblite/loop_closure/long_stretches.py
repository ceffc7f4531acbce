"""Loop closure where the pose after a loop is uncertain by many metres: long stretches of the path are matched.

Where any pair is as uncertain, all that need a search are compared so: one closed loop may make the others more certain than
they are. A search narrower than the uncertainty may miss the true place, and a search over all of it finds many places at
which one sub-map of a corridor fits. Stretches of tens of metres fit at one place only, where doors and pillars match as well
as walls do (net_overlap). The likeliest pairs come first: each closed loop reduces the uncertainty of the others.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ..arrays import Floats, Ints
from ..graph.graph import Graph
from ..graph.marginals import JointCovariance
from ..lidar import submaps
from ..lidar.submaps import Submaps
from .candidates import Candidates, overlap_probability, propose, uncertain
from .closures import LoopClosureConfig


@dataclass(frozen=True, slots=True)
class StretchPolicy:
    """Stretches of the path that are compared where sub-maps are too uncertain."""

    length: ClassVar[float] = 30.0
    """Travelled distance of a stretch, m: it contains several doors or pillars, and the drift of a chain of scans stays
    within the gate of the final matching. Each begins in the middle of the one before."""
    wider: ClassVar[float] = 2.0
    """Factor on the standard deviations of a chain of steps: a bias that following steps share, a robot that tilts, floors
    that give way, adds up along the way, and the covariance contains none (twice the stated heading in a hospital)."""
    never: ClassVar[float] = 1e-4
    """Probability of an overlap up to which pairs are not tried; the covariance may be too small, but not by so much."""
    at_once: ClassVar[int] = 40
    """Pairs tried before the graph is solved again."""
    part: ClassVar[int] = 8
    """Stretches for each of them where that is more."""


def cut(path: Floats, recording: Ints) -> tuple[Ints, Ints, Ints]:
    """Return first keyframe (s,), one past the last (s,) and reference (s,) of stretches, each overlapping the next by half.

    Parameters
    ----------
    path : (k,) travelled distance, m. recording : (k,).
    """
    first, last = submaps.cut(path, recording, StretchPolicy.length / 2.0)
    goes_on = recording[first[1:]] == recording[first[:-1]]
    last[:-1] = np.where(goes_on, last[1:], last[:-1])
    return first, last, (first + last - 1) // 2


def any_uncertain(
    graph: Graph, covariance: JointCovariance, reference: Ints, recording: Ints, config: LoopClosureConfig
) -> bool:
    """Return whether any stretches are too uncertain for a search of sub-maps; see uncertain_pairs, which lists them.

    Parameters
    ----------
    reference : (s,) keyframes in the middle of stretches or of sub-maps.
    """
    return uncertain(graph, covariance, reference, recording, _wide(config), config.search_limit)


def _wide(config: LoopClosureConfig) -> LoopClosureConfig:
    return replace(config, reach=StretchPolicy.length / 2.0, search_limit=np.inf)


def uncertain_pairs(
    graph: Graph, covariance: JointCovariance, pieces: Submaps, recording: Ints, tried: set[tuple[int, int, bool]],
    constrained: bool, config: LoopClosureConfig, beyond: float,
) -> Candidates:
    """Return pairs of stretches that may overlap and are less certain than to a limit (3 sigma), m, the likeliest first.

    For the parameters see candidates.propose.
    """
    wide = _wide(config)
    found = propose(graph, covariance, pieces, recording, tried, set(), constrained, wide, beyond)
    found = replace(found, long=True)
    chance = overlap_probability(found.guess, found.covariance, wide.reach)
    order = np.argsort(-chance, kind="stable")
    return found.rows(order[chance[order] > StretchPolicy.never])


def first_of(candidates: Candidates, pieces: Submaps) -> Candidates:
    """Return the candidates that are tried before the graph is solved again, as uncertain as a chain of steps may be."""
    first = candidates.rows(slice(0, max(StretchPolicy.at_once, len(pieces) // StretchPolicy.part)))
    wider = 1.0 if candidates.constrained else StretchPolicy.wider
    return replace(first, covariance=wider**2 * first.covariance, spread=wider * first.spread)


def likely(candidates: Candidates) -> Candidates:
    """Return the candidates whose stretches overlap within one standard deviation."""
    distance = np.hypot(candidates.guess[:, 0], candidates.guess[:, 1])
    return candidates.rows(np.flatnonzero(distance < StretchPolicy.length / 2.0 + candidates.spread / 3.0))
