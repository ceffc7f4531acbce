"""Whether a start is certain: what must have been measured, and how much likelier it must be than every other place."""

from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Floats
from . import hypotheses
from .hypotheses import INDEPENDENT, SLOW_SIGMA, WALL_SIGMA, Hypotheses
from .range_model import Ranges, range_errors, series, shared_likelihood
from .walls import Rays, Walls

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


_PRIOR = (0.3, 0.3, 0.1, 0.1, 0.3)
"""m, m, rad, 1, 1; prior of pose, motion and distances."""
_NO_SCALE = 1e-6
"""Prior of distances in the unit of the map."""
_GATES = ((0.5, 0.3), (0.5, 0.3), (0.4, 0.2), (0.4, 0.15), (0.4, 0.15))
"""m; gate and kernel width of each iteration, wide: in a map 5 % too large the far wall of a room of 5 m is off by 0.25 m."""
_ITERATIONS = 6
SCAN_LIMIT, RANGE_LIMIT = 0.03, 0.05
"""Relative error of a lidar or a map: data sheets allow 1 to 3 %; for radios, the delay by walls is added."""
_SURE = 4.0
"""Standard deviations from which a scale error is certain."""


@dataclass(frozen=True, slots=True)
class Scale:
    """Relative difference of the map's distances from those of the sensor."""

    error: float
    """Relative, 1."""
    sigma: float
    """Its standard deviation, 1."""
    gain: float = np.inf
    """Log-likelihood by which it explains the measurements better than an error of 0 does."""

    def off(self, limit: float) -> bool:
        """Return whether map and sensor are in different units for certain."""
        return abs(self.error) > max(limit, _SURE * self.sigma) and self.gain > 0.5 * _SURE**2


def scan_scale(walls: Walls, pose: Floats, rays: Rays, looks: int) -> Scale:
    """Match the rays of several scans with pose, motion scale and distance scale free.

    Parameters
    ----------
    pose : (3,) about which they match. rays : in the present frame of the base. looks : scans they are of.

    Notes
    -----
    Along a single wall every scale fits, with a pose that is moved accordingly; the match then ends at an arbitrary scale, and
    its standard deviation does not show that. So a scale that is off is compared with a match in the map's own unit.
    """
    error, sigma, whole = _matched(walls, pose, rays, looks, _PRIOR[4])
    found = Scale(error, sigma)
    return Scale(error, sigma, whole - _matched(walls, pose, rays, looks, _NO_SCALE)[2]) if found.off(SCAN_LIMIT) else found


def _matched(walls: Walls, pose: Floats, rays: Rays, looks: int, prior: float) -> tuple[float, float, float]:
    """Return the scale of the distances, its standard deviation, and the log-likelihood, with the priors' part."""
    x, information = np.zeros(5), np.diag(1.0 / np.square((*_PRIOR[:4], prior)))
    start, beam = np.append(pose, (0.0, 0.0)), rays.ends - rays.origins
    hessian, scaled = information, rays
    for gate, width in _GATES:
        h, _, g, weight = walls.factors((start + x)[None, :3], scaled, gate, width, (rays.origins, beam))
        share = min(INDEPENDENT * looks / max(float(weight[0]), 1e-9), 1.0) / WALL_SIGMA**2
        hessian = information + share * h[0]
        x = x - np.linalg.solve(hessian, share * g[0] + information @ x)
        origins = rays.origins * (1.0 + x[3])
        scaled = Rays(origins + beam * (1.0 + x[4]), origins, rays.hit)
    agreement = float(walls.agreement((start + x)[None, :3], scaled).log_likelihood[0])
    value = min(len(rays.hit), INDEPENDENT * looks) * agreement - 0.5 * float(x @ information @ x)
    return float(x[4]), float(np.sqrt(np.linalg.inv(hessian)[4, 4])), value


def range_scale(pose: Floats, ranges: Ranges) -> Scale:
    """Fit pose, way, distances and one constant error per anchor to the ranges.

    Notes
    -----
    Gauss-Newton with Cauchy kernels, on the ranges and on the anchors' errors: an anchor that was moved by metres explains its
    own ranges, and does not look like another unit; errors that all anchors share do.
    """
    names, anchor = np.unique(ranges.anchor, return_inverse=True)
    own = np.eye(len(names))[anchor]
    prior = 1.0 / np.square(np.append(_PRIOR, np.full(len(names), SLOW_SIGMA)))
    x, hessian = np.zeros(5 + len(names)), np.diag(prior)
    for _ in range(_ITERATIONS):
        tags = ranges.tags * (1.0 + x[3])
        now = replace(ranges, tags=tags, values=ranges.values * (1.0 + x[4]) - own @ x[5:])
        error, offset, lever = (v[0] for v in range_errors((pose + x[:3])[None], now))
        unit = offset / np.maximum(np.hypot(*offset.T), 0.05)[:, None]
        turned = unit[:, 1] * lever[:, 0] - unit[:, 0] * lever[:, 1]
        along = (unit * lever).sum(axis=1) / (1.0 + x[3])
        jacobian = np.column_stack([unit, turned, along, -ranges.values, own])
        weight = _cauchy(error, ranges.sigma) / ranges.sigma**2
        information = np.diag(prior * np.append(np.ones(5), _cauchy(x[5:], SLOW_SIGMA)))
        hessian = information + (jacobian * weight[:, None]).T @ jacobian
        x = x - np.linalg.solve(hessian, information @ x - jacobian.T @ (weight * error))
    return Scale(float(x[4]), float(np.sqrt(np.linalg.inv(hessian)[4, 4])))


def _cauchy(error: Floats, sigma: Floats | float) -> Floats:
    """Return the weights of errors with a Cauchy kernel of two standard deviations."""
    return np.asarray(1.0 / (1.0 + np.square(error / (2.0 * sigma))))
