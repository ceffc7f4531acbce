"""Whether a start is certain: what must have been measured, and how much likelier it must be than every other place.

A map in another unit still looks like the place: near every wall the pose follows the wall. But from the right place all
distances are too long, or too short, by the same factor. So what was measured is compared once more as if it were larger or
smaller by some factors: one beyond the sensors' own errors must be much less likely.
"""

from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Floats
from . import hypotheses
from .hypotheses import SAME, Hypotheses
from .range_model import Ranges, range_errors, range_likelihood, series, shared_likelihood
from .walls import Rays, Walls

CERTAIN, LIKELY = (float(np.log(odds)) for odds in (400.0, 20.0))
"""Log-likelihoods of a certain place, and of a likely one."""
_ALONE = float(np.log(1000.0))
"""Of a start against all other places: a wrong one is worse than one that is some decimetres later."""
_FOUND, _VAGUE = 2.0, 1.25
"""Standard deviations that a pose must be known to within one place (hypotheses.SAME) to be found, and not to be lost again: by
more than 20 : 1, and by 4 : 1."""
_RANGE_ELSEWHERE = -1.35
"""Log-likelihood of an independent range at the best place of a building that is not the map's."""
FEW_ENDS, FEW_BESIDE = 12, 4
"""Least number of rays' ends in known space for a scan to count; the second beside ranges to three anchors."""
_ENOUGH_RANGES = 6
"""Least number of ranges that decide alone, or about units."""
_UNIT = 0.03
"""Relative error of distances: data sheets of lidars allow 1 to 3 %."""
_FACTORS = 1.0 + _UNIT * np.arange(-6, 7)
SURE = 4.0
"""Standard deviations from which an error is certain, and a range disagrees."""


def odds_of_place(bank: Hypotheses) -> float:
    """Return the log-odds of the first place, the likeliest, against all others together."""
    return -float(np.logaddexp.reduce(bank.log_weight[hypotheses.apart(bank.poses[0], bank.poses)], initial=-np.inf))


def undecided(bank: Hypotheses, complete: bool) -> str:
    """Return why another place than the first, the likeliest, may be right; "" = none may. complete : no place was left out."""
    if not complete:
        return "too many places are as likely; drive on"
    if odds_of_place(bank) > _ALONE:
        return ""
    count = int((bank.log_weight[hypotheses.apart(bank.poses[0], bank.poses)] > -_ALONE).sum())
    return f"{1 + max(count, 1)} places are as likely; drive on, around a corner or past another anchor"


def imprecise(covariance: Floats) -> str:
    """Return why the only place is not found yet, by its covariance (3, 3), m and rad; "" = it is known well enough."""
    place, heading = _sigmas(covariance)
    return "" if _FOUND * place <= SAME[0] and _FOUND * heading <= SAME[1] else "place or heading is not sure yet; drive on"


def vague(covariance: Floats) -> str:
    """Return why a pose that is tracked is not known, by its covariance (3, 3), m and rad; "" = it is known."""
    place, heading = _sigmas(covariance)
    if _VAGUE * place <= SAME[0] and _VAGUE * heading <= SAME[1]:
        return ""
    return f"the pose is known to {place:.1f} m and {heading:.2f} rad only; drive on, past an anchor or a wall"


def _sigmas(covariance: Floats) -> tuple[float, float]:
    """Return the standard deviations of a pose with a covariance (3, 3): along the longest axis of its place, m, and rad."""
    return float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])), float(np.sqrt(covariance[2, 2]))


def too_little(rays: Rays, ranges: Ranges) -> str:
    """Return why no place is found at all."""
    if not len(rays.hit) and not len(ranges):
        return "no range to an anchor of the map and no scan has come in"
    if not len(rays.hit) and len(np.unique(ranges.anchor)) < 2:
        return "only one of the map's anchors is in reach; two or more are needed, or a lidar"
    return "too many places are as likely; drive on"


@dataclass(frozen=True, slots=True)
class Odds:
    """By how much likelier the measurements are at a place of the map than in another building, log-likelihoods."""

    scans: float
    ranges: float
    share: float
    """Of the ranges that agree, 0..1."""
    alone: bool
    """There are scans or ranges alone."""
    agreed: float
    """m driven over which all searches found it LIKELY against all others: in another building the best place leaps. Each
    counts as much; by scans or ranges alone, with nothing independent beside them, it is all that counts, up to twice what
    they say.
    """
    tracked: bool = False
    """A pose was tracked in this map before: that the robot is in another building now counts as LIKELY against it."""

    @property
    def total(self) -> float:
        """Of all together."""
        measured, stays = self.scans + self.ranges, LIKELY * (self.agreed + self.tracked)
        return min(stays, 2.0 * measured) if self.alone else stays + measured

    @property
    def nowhere(self) -> str:
        """Why even this place is likelier to be in another building; "" = it is not.

        What ranges say against it by themselves, 400 : 1, nothing outweighs: aisles are alike. What scans say, ranges alone
        outweigh: furniture was moved, and no other building has anchors of these names at these distances.
        """
        against = self.total < 0.0 or self.ranges < -CERTAIN or self.scans < -max(CERTAIN, self.ranges)
        if against and self.ranges < self.scans:
            return f"the ranges fit the anchors nowhere (best place: {self.share:.0%} of them); is this the right map?"
        return "the scans fit the walls nowhere well; is this the right map?" if against else ""


def map_odds(scans: float, ends: float, pose: Floats, ranges: Ranges, agreed: float, tracked: bool) -> Odds:
    """Return the odds of a pose (3,).

    Parameters
    ----------
    scans : odds by the rays, of so many ends in known space. agreed, tracked : see Odds.
    """
    agree = np.abs(range_errors(pose[None], ranges)[0][0]) <= SURE * ranges.sigma
    anchors, sees = len(np.unique(ranges.anchor[agree])), ends >= FEW_ENDS
    likelihood = float(shared_likelihood(pose[None], ranges)[0]) - _RANGE_ELSEWHERE * float(series(ranges).share.sum())
    share = float(agree.sum()) / max(len(ranges), 1)
    return Odds(scans if sees else 0.0, likelihood, share, not (sees and anchors >= 2), agreed, tracked)


def other_unit(walls: Walls | None, pose: Floats, rays: Rays, independent: float, ranges: Ranges) -> str:
    """Return how the distances of the map differ from the sensors' about a pose (3,); "" = they do not.

    The same map as many times smaller is compared at the pose that fits it best.

    Parameters
    ----------
    rays : of which so many are independent, in the present frame of the base.
    """
    seen = walls if int(rays.hit.sum()) >= FEW_ENDS else None
    if seen is None and len(ranges) < _ENOUGH_RANGES:
        return ""
    odds = np.zeros(len(_FACTORS))
    for k, factor in enumerate(_FACTORS):
        # Where distances are larger than in the map, the map is smaller: errors and detours keep their sizes.
        smaller, here = replace(ranges, places=ranges.places / factor), None if seen is None else seen.times(1.0 / factor)
        there = hypotheses.refined(pose[None] / [factor, factor, 1.0], smaller, here, rays)
        odds[k] = range_likelihood(there, smaller)[0]
        odds[k] += here.agreement(there, rays, independent).log_likelihood[0] if here is not None else 0.0
    sound = np.abs(_FACTORS - 1.0) < 1.5 * _UNIT
    gain = odds[~sound].max() - odds[sound].max()
    if gain > CERTAIN:
        return f"distances in the map are {_FACTORS[np.argmax(odds)]:.2f} times those of the sensors; is this the right map?"
    return "whether the map has the sensors' unit is not known yet; drive on" if gain > -0.5 * LIKELY else ""
