"""Whether a start is certain: what must have been measured, and how much likelier it must be than every other place."""

from dataclasses import dataclass

import numpy as np

from ..arrays import Floats
from . import hypotheses
from .hypotheses import Hypotheses
from .range_likelihood import range_errors
from .scale import RANGE_LIMIT, SCAN_LIMIT, range_scale, scan_scale
from .walls import Rays, Walls
from .window import Ranges

CERTAIN = 6.0
"""Log-likelihood by which a place must be better than any other: 400 : 1."""
_CERTAIN_AGAIN = 4.6
"""The same in a map that is the right one: 100 : 1."""
SIGMA_FOUND = (0.25, 0.1)
"""m and rad; a pose that is less certain is not found yet."""
FIT_BESIDE_RANGES, FIT_ALONE = -0.5, -0.25
"""Mean log-likelihood of the rays from which a pose may count as found: in the right place it is -0.05 to -0.2, with people
close by -0.5; rooms that are alike in part reach -0.3, other buildings beside ranges -0.35 to -0.7."""
RANGES_FOUND, RANGES_ALONE = 0.6, 0.8
"""Share of the ranges that must agree with a start, beside scans and alone: in the right place 0.9 to 1 alone, with anchors of
another building 0.75 to 0.8."""
_RANGES_AGAIN = 0.5
"""The same beside scans in a map that is the right one: ranges that disagree there are NLOS."""
FEW_ENDS, FEW_BESIDE = 12, 4
"""Least number of rays' ends in known space for a scan to count; the second beside ranges to three anchors."""
ENOUGH_ENDS, ENOUGH_RANGES = 40, 6
"""Least number of rays' ends, or of ranges to two anchors, for a start."""
_FIT_CLEAR, _RANGES_CLEAR, _ANCHORS_CLEAR = -0.3, 0.8, 3
"""Fit of the rays, share of the ranges and number of anchors from which on they clearly support a place."""
_CONFIRM, _CONFIRM_BUSY, _CONFIRM_ALONE = 0.5, 1.0, 2.0
"""m driven between two searches that agree; the second where people are near, the third with scans or ranges alone."""
_UNIT_KNOWN = 0.04
"""Standard deviation of the map's unit from which another one would have been noticed; a start also needs the unit itself to be
within what data sheets allow."""
_UNIT_CLEAR = 0.01
"""The same by scans, from which on ranges do not reject a found pose: two of four anchors may have been moved."""


def doubt(
    bank: Hypotheses, best: int, complete: bool, fit: float, ends: float, fitting: "RangeFit", proven: bool = False
) -> str:
    """Return why the best hypothesis is not certain yet; "" = it is.

    Parameters
    ----------
    complete : the search left no place out. fit : mean log-likelihood of the rays at the best hypothesis.
    ends : rays' ends in known space. fitting : how the ranges agree there. proven : the map is the right one.
    """
    certain = _CERTAIN_AGAIN if proven and fitting.anchors >= 2 else CERTAIN
    sigma = np.sqrt(np.maximum(np.diag(bank.pose_covariances[best]), 0.0))
    rivals = bank.log_weight[hypotheses.apart(bank.poses[best], bank.poses)]
    if not complete:
        return "too many places are as likely; drive on"
    # Errors of rays and ranges are independent: half of what either needs is enough where there is half of the other as well.
    if share_of_needed(ends) + fitting.share_of_needed < 1.0:
        return "too little was measured yet; drive on"
    if why := nowhere(fit, ends, fitting, proven):
        return why
    if len(rivals) and rivals.max() > -certain:
        count = 1 + int((rivals > -certain).sum())
        return f"{count} places are as likely; drive on, around a corner or past another anchor"
    if max(sigma[0], sigma[1]) > SIGMA_FOUND[0] or sigma[2] > SIGMA_FOUND[1]:
        return "place or heading is not sure yet; drive on"
    return ""


def nowhere(fit: float, ends: float, fitting: "RangeFit", proven: bool = False) -> str:
    """Return the reason why even the best place is contradicted; "" = it is not.

    In a map that is the right one, with ranges to two anchors, scans need not exclude another building; half of the ranges may
    be NLOS where scans fit.
    """
    seen = share_of_needed(ends)
    beside = fitting.enough or (proven and fitting.anchors >= 2)
    if seen and fit < (FIT_BESIDE_RANGES if beside else FIT_ALONE):
        return "the scans fit the walls nowhere well; is this the right map?"
    needed = _RANGES_AGAIN if proven and seen and fitting.anchors >= 2 else RANGES_ALONE + seen * (RANGES_FOUND - RANGES_ALONE)
    if fitting.count >= ENOUGH_RANGES and fitting.share < needed:
        return f"the ranges fit the anchors nowhere (best place: {fitting.share:.0%} of them); is this the right map?"
    return ""


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
    if start and (sigma > _UNIT_KNOWN or error > limit):
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

    @property
    def share_of_needed(self) -> float:
        """Ranges to two anchors or more that agree, as a share of what a start needs."""
        return self.share * self.count / ENOUGH_RANGES if self.anchors >= 2 else 0.0

    @property
    def enough(self) -> bool:
        return self.share_of_needed >= 1.0


def confirming_way(fit: float, ends: float, fitting: RangeFit, proven: bool) -> float:
    """Return how far a robot must drive, m, between two searches that agree; below 0, a second one is not needed.

    Errors of scans and ranges are independent: where both clearly support a place, each confirms the other.

    Parameters
    ----------
    proven : the map is the right one, as a pose was tracked in it: what is left open is the place alone.
    """
    if proven and fitting.anchors >= 2:
        return -1.0
    if ends < FEW_ENDS or not fitting.enough:
        return _CONFIRM_ALONE
    clear = fitting.anchors >= _ANCHORS_CLEAR and fitting.share >= _RANGES_CLEAR
    if fit < _FIT_CLEAR:
        return _CONFIRM_BUSY if clear else _CONFIRM_ALONE
    if fitting.share < _RANGES_CLEAR:
        return _CONFIRM_ALONE
    return 0.0 if clear and share_of_needed(ends) + fitting.share_of_needed >= 2.0 else _CONFIRM


def share_of_needed(ends: float) -> float:
    """Return rays' ends in known space as a share of what a start needs."""
    return min(ends / ENOUGH_ENDS, 1.0) if ends >= FEW_ENDS else 0.0


def agreeing(pose: Floats, ranges: Ranges) -> RangeFit:
    if not len(ranges):
        return RangeFit(0, 0.0, 0)
    agree = np.abs(range_errors(pose[None], ranges)[0][0]) <= 3.0 * ranges.sigma
    anchors = len(np.unique(ranges.anchor[agree]))
    return RangeFit(len(ranges), float(agree.mean()), anchors)


def too_little(rays: Rays, ranges: Ranges) -> str:
    if not len(rays.hit) and not len(ranges):
        return "no range to an anchor of the map and no scan has come in"
    if not len(rays.hit) and len(np.unique(ranges.anchor)) < 2:
        return "only one of the map's anchors is in reach; two or more are needed, or a lidar"
    return "too many places are as likely; drive on"
