"""Whether a start is certain: what must have been measured, and how much likelier it must be than every other place."""

from dataclasses import dataclass

import numpy as np

from ..arrays import Floats
from . import hypotheses
from .hypotheses import Hypotheses
from .range_likelihood import range_errors, series, shared_likelihood
from .scale import RANGE_LIMIT, SCAN_LIMIT, range_scale, scan_scale
from .walls import Rays, Walls
from .window import Ranges

CERTAIN = 6.0
"""Log-likelihood by which a place must be better than any other: 400 : 1."""
_CERTAIN_AGAIN = 4.6
"""The same in a map that is the right one, as a pose was tracked in it: 100 : 1."""
SIGMA_FOUND = (0.25, 0.1)
"""m and rad; a pose that is less certain is not found yet."""
_VAGUE = (0.4, 0.25)
"""m and rad; a pose that has become less certain is within half a metre by less than 4 : 1, and counts as lost."""
ELSEWHERE = (-0.35, -1.2)
"""Log-likelihood of a ray, and of an independent range, at the best place of a building that is not the map's. In 770 searches
in three of them the odds against that were never 400 : 1; in the right building they are after 0.7 to 1.4 m (median)."""
_ELSEWHERE_ALONE = -0.25
"""Of a ray where no ranges confine the places: rooms that are alike in part reach -0.3."""
RANGES_FOUND, RANGES_ALONE = 0.6, 0.8
"""Share of the ranges that agree in the right place; and least share where they are alone: 0.9 to 1 in the right place, with
anchors of another building 0.75 to 0.8."""
FEW_ENDS, FEW_BESIDE = 12, 4
"""Least number of rays' ends in known space for a scan to count; the second beside ranges to three anchors."""
ENOUGH_ENDS, ENOUGH_RANGES = 40, 6
"""Least number of rays' ends, or of ranges, for a comparison of units."""
_AGREED = 3.0
"""Log-likelihood, 20 : 1, of a metre of driving over which all searches found the same place: in another building the best
place leaps. By scans or ranges alone, with nothing independent beside them, it is all that counts: two metres."""
_UNIT_KNOWN = 0.7
"""Standard deviation of the map's unit, as a share of what data sheets allow, from which another one would have been noticed; a
start also needs the unit itself to be within that."""
_UNIT_CLEAR = 0.01
"""The same by scans, from which on ranges do not reject a found pose: two of four anchors may have been moved."""


def undecided(bank: Hypotheses, best: int, complete: bool, certain: float) -> str:
    """Return why another place than the best one may be right; "" = none may.

    Parameters
    ----------
    complete : the search left no place out. certain : log-likelihood by which it must be better than any other.
    """
    rivals = bank.log_weight[hypotheses.apart(bank.poses[best], bank.poses)]
    if not complete:
        return "too many places are as likely; drive on"
    if rivals.max(initial=-np.inf) > -certain:
        count = 1 + int((rivals > -certain).sum())
        return f"{count} places are as likely; drive on, around a corner or past another anchor"
    return ""


def imprecise(covariance: Floats) -> str:
    """Return why the only place is not found yet, by its covariance (3, 3), m and rad; "" = it is known well enough."""
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    if max(sigma[0], sigma[1]) <= SIGMA_FOUND[0] and sigma[2] <= SIGMA_FOUND[1]:
        return ""
    return "place or heading is not sure yet; drive on"


def needed(fitting: "RangeFit", proven: bool) -> float:
    """Return the log-likelihood of certainty; proven : the map is the right one, as a pose was tracked in it."""
    return _CERTAIN_AGAIN if proven and fitting.anchors >= 2 else CERTAIN


def vague(covariance: Floats) -> str:
    """Return why a pose that is tracked is not known, by its covariance (3, 3), m and rad; "" = it is known."""
    place, heading = float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])), float(np.sqrt(covariance[2, 2]))
    if place <= _VAGUE[0] and heading <= _VAGUE[1]:
        return ""
    return f"the pose is known to {place:.1f} m and {heading:.2f} rad only; drive on, past an anchor or a wall"


@dataclass(frozen=True, slots=True)
class MapOdds:
    """By how much likelier the measurements are at a place of the map than in another building, log-likelihoods."""

    scans: float
    ranges: float
    agreed: float
    """m driven over which all searches found it and no other place."""
    alone: bool
    """There are scans or ranges alone."""

    @property
    def total(self) -> float:
        measured = self.scans + self.ranges
        return _AGREED * self.agreed + (min(measured, 0.0) if self.alone else measured)


def map_odds(fit: float, ends: float, rays: float, fitting: "RangeFit", agreed: float) -> MapOdds:
    """Return the odds of a place.

    Parameters
    ----------
    fit : mean log-likelihood of the rays. ends : rays' ends in known space. rays : how many of them are independent.
    fitting : how the ranges agree. agreed : m driven over which searches agree.
    """
    ranges = fitting.likelihood - fitting.independent * ELSEWHERE[1]
    sees, ranged = ends >= FEW_ENDS, fitting.anchors >= 2
    scans = rays * (fit - (ELSEWHERE[0] if ranged else _ELSEWHERE_ALONE)) if sees else 0.0
    return MapOdds(scans, ranges, agreed, not (sees and ranged))


def nowhere(odds: MapOdds, fitting: "RangeFit") -> str:
    """Return the reason why even the best place is likelier to be in another building; "" = it is not.

    What scans or ranges say against it by themselves, 400 : 1, the others do not outweigh: aisles are alike, and a robot may be
    where the walls are not mapped.
    """
    blind = odds.alone and fitting.enough and fitting.share < RANGES_ALONE
    against = odds.total < 0.0 or min(odds.scans, odds.ranges) < -CERTAIN
    if blind or (against and odds.ranges < odds.scans):
        return f"the ranges fit the anchors nowhere (best place: {fitting.share:.0%} of them); is this the right map?"
    return "the scans fit the walls nowhere well; is this the right map?" if against else ""


def other_unit(walls: Walls | None, pose: Floats, rays: Rays, looks: int, ranges: Ranges, start: bool) -> str:
    """Return how the distances of the map differ from the sensors' about a pose (3,); "" = they do not.

    Parameters
    ----------
    rays : of the last metres, in the present frame of the base. looks : scans that they are of.
    start : the place is not known yet.
    """
    compared = []
    if walls is not None and int(rays.hit.sum()) >= ENOUGH_ENDS:
        compared.append(("lidar", scan_scale(walls, pose, rays, looks), SCAN_LIMIT))
    if len(ranges) >= ENOUGH_RANGES:
        compared.append(("radio", range_scale(pose, ranges), RANGE_LIMIT))
    for name, scale, limit in compared:
        if scale.off(limit):
            return f"distances in the map are {1.0 + scale.error:.2f} times those of the {name}; is this the right map?"
        if not start and scale.sigma < _UNIT_CLEAR:
            break
    sigma, error, limit = min(((s.sigma, abs(s.error), limit) for _, s, limit in compared), default=(0.0, 0.0, 0.0))
    if start and (sigma > _UNIT_KNOWN * limit or error > limit):
        return "whether the map has the sensors' unit is not known yet; drive on"
    return ""


@dataclass(frozen=True, slots=True)
class RangeFit:
    """How the window's ranges agree with a pose."""

    count: int
    share: float
    """Share of the ranges that agree, 0..1."""
    anchors: int
    """Anchors whose ranges agree."""
    independent: float
    """Independent ranges whose information they all have."""
    likelihood: float
    """Their log-likelihood, as of so many; 0 = all as expected."""

    @property
    def enough(self) -> bool:
        """Whether those that agree, to two anchors or more, are as many as ranges alone need."""
        return self.anchors >= 2 and self.share * self.count >= ENOUGH_RANGES


def agreeing(pose: Floats, ranges: Ranges) -> RangeFit:
    if not len(ranges):
        return RangeFit(0, 0.0, 0, 0.0, 0.0)
    agree = np.abs(range_errors(pose[None], ranges)[0][0]) <= 3.0 * ranges.sigma
    anchors = len(np.unique(ranges.anchor[agree]))
    independent, likelihood = float(series(ranges).share.sum()), float(shared_likelihood(pose[None], ranges)[0])
    return RangeFit(len(ranges), float(agree.mean()), anchors, independent, likelihood)


def too_little(rays: Rays, ranges: Ranges) -> str:
    if not len(rays.hit) and not len(ranges):
        return "no range to an anchor of the map and no scan has come in"
    if not len(rays.hit) and len(np.unique(ranges.anchor)) < 2:
        return "only one of the map's anchors is in reach; two or more are needed, or a lidar"
    return "too many places are as likely; drive on"
