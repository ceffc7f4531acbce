"""Whether a start is certain: what must have been measured, and how much likelier it must be than every other place.

A map in another unit still looks like the place: near every wall the pose follows the wall. But from the right place all
distances are too long, or too short, by the same factor. So the pose is matched once more together with two scales, one of the
lidar's (or the radio's) distances and one of the motion between the measurements, which belongs to the wheels and absorbs their
error.
"""

from dataclasses import dataclass, replace

import numpy as np

from .. import se2
from ..arrays import Floats
from . import hypotheses
from .hypotheses import INDEPENDENT, WALL_SIGMA, WIDTHS, Hypotheses
from .range_model import BIAS_SIGMA, Ranges, cauchy, range_errors, series, shared_likelihood
from .walls import Rays, Walls

CERTAIN, LIKELY = (float(np.log(odds)) for odds in (400.0, 20.0))
"""Log-likelihoods of a certain place, and of a likely one."""
_FOUND = (0.25, 0.1)
"""m and rad; a pose that is less certain is not found yet."""
_VAGUE = (0.4, 0.25)
"""m and rad; a pose that has become less certain is within half a metre by less than 4 : 1, and counts as lost."""
RAY_ELSEWHERE, _RANGE_ELSEWHERE = -0.35, -1.35
"""Log-likelihoods of a ray, and of an independent range, at the best place of a building that is not the map's: rooms are alike
in part."""
_ALONE = 0.8
"""Least share of ranges that agree where they are alone: 0.9 to 1 in the right place, 0.75 to 0.8 with anchors of another
building."""
FEW_ENDS, FEW_BESIDE = 12, 4
"""Least number of rays' ends in known space for a scan to count; the second beside ranges to three anchors."""
_ENOUGH_RANGES = 6
"""Least number of ranges that decide alone, or about units."""
_LIMITS = {"lidar": 0.03, "radio": 0.05}
"""Relative errors of distances: data sheets of lidars allow 1 to 3 %; for radios, the delay by walls is added."""
SURE = 4.0
"""Standard deviations from which an error is certain, and a range disagrees."""
_KNOWN = 0.7
"""Standard deviation of the map's unit, as a share of that limit, from which another one would have been noticed; the unit
itself must be within the limit."""
_PRIOR = np.array([0.3, 0.3, 0.1, 0.1, 0.3])
"""Standard deviations of pose, motion and distances; m, m, rad, 1, 1."""
_NO_SCALE = 1e-6
"""That of distances in the unit of the map."""
_ITERATIONS = 6


def undecided(bank: Hypotheses, best: int, complete: bool) -> str:
    """Return why another place than the best one may be right; "" = none may."""
    rivals = bank.log_weight[hypotheses.apart(bank.poses[best], bank.poses)]
    count = 1 + int((rivals > -CERTAIN).sum())
    if not complete:
        return "too many places are as likely; drive on"
    return f"{count} places are as likely; drive on, around a corner or past another anchor" if count > 1 else ""


def imprecise(covariance: Floats) -> str:
    """Return why the only place is not found yet, by its covariance (3, 3), m and rad; "" = it is known well enough."""
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    known = sigma[:2].max() <= _FOUND[0] and sigma[2] <= _FOUND[1]
    return "" if known else "place or heading is not sure yet; drive on"


def vague(covariance: Floats) -> str:
    """Return why a pose that is tracked is not known, by its covariance (3, 3), m and rad; "" = it is known."""
    place, heading = float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])), float(np.sqrt(covariance[2, 2]))
    if place <= _VAGUE[0] and heading <= _VAGUE[1]:
        return ""
    return f"the pose is known to {place:.1f} m and {heading:.2f} rad only; drive on, past an anchor or a wall"


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
    enough: bool
    """There are ranges to two anchors that decide alone."""
    alone: bool
    """There are scans or ranges alone."""
    agreed: float
    """m driven over which all searches found it and no other place. In another building the best place leaps: each counts
    LIKELY, and by scans or ranges alone, with nothing independent beside them, it is all that counts."""

    @property
    def total(self) -> float:
        """Of all together."""
        measured = self.scans + self.ranges
        return LIKELY * self.agreed + (min(measured, 0.0) if self.alone else measured)

    @property
    def nowhere(self) -> str:
        """Why even this place is likelier to be in another building; "" = it is not.

        What scans or ranges say against it by themselves, 400 : 1, the others do not outweigh: aisles are alike.
        """
        blind = self.alone and self.enough and self.share < _ALONE
        against = self.total < 0.0 or min(self.scans, self.ranges) < -CERTAIN
        if blind or (against and self.ranges < self.scans):
            return f"the ranges fit the anchors nowhere (best place: {self.share:.0%} of them); is this the right map?"
        return "the scans fit the walls nowhere well; is this the right map?" if against else ""


def map_odds(fit: float, ends: float, rays: float, pose: Floats, ranges: Ranges, agreed: float) -> Odds:
    """Return the odds of a pose (3,), where searches have agreed over so many m.

    Parameters
    ----------
    fit : mean log-likelihood of the rays. ends : rays' ends in known space. rays : how many of them are independent.
    """
    agree = np.abs(range_errors(pose[None], ranges)[0][0]) <= SURE * ranges.sigma
    anchors, sees = len(np.unique(ranges.anchor[agree])), ends >= FEW_ENDS
    likelihood = float(shared_likelihood(pose[None], ranges)[0]) - _RANGE_ELSEWHERE * float(series(ranges).share.sum())
    scans, share = rays * (fit - RAY_ELSEWHERE) if sees else 0.0, float(agree.sum()) / max(len(ranges), 1)
    enough = anchors >= 2 and int(agree.sum()) >= _ENOUGH_RANGES
    return Odds(scans, likelihood, share, enough, not (sees and anchors >= 2), agreed)


@dataclass(frozen=True, slots=True)
class Scale:
    """Relative difference of the map's distances from those of a sensor."""

    sensor: str
    error: float
    """Relative, 1."""
    sigma: float
    """Its standard deviation, 1."""
    gain: float = np.inf
    """Log-likelihood by which it explains the measurements better than an error of 0 does."""

    @property
    def limit(self) -> float:
        """Relative error that a sound sensor may have."""
        return _LIMITS[self.sensor]

    @property
    def off(self) -> bool:
        """Whether map and sensor are in different units for certain."""
        return abs(self.error) > max(self.limit, SURE * self.sigma) and self.gain > 0.5 * SURE**2


def other_unit(walls: Walls | None, pose: Floats, rays: Rays, looks: int, ranges: Ranges) -> str:
    """Return how the distances of the map differ from the sensors' about a pose (3,); "" = they do not.

    The surer of lidar, by the rays of so many looks in the present frame of the base, and radio decides: of four anchors two
    may have been moved.
    """
    scales = []
    if walls is not None and int(rays.hit.sum()) >= FEW_ENDS:
        scales.append(scan_scale(walls, pose, rays, looks))
    if len(ranges) >= _ENOUGH_RANGES:
        scales.append(range_scale(pose, ranges))
    if not scales:
        return ""
    surer = min(scales, key=lambda scale: scale.sigma / scale.limit)
    if surer.off:
        return f"distances in the map are {1.0 + surer.error:.2f} times those of the {surer.sensor}; is this the right map?"
    if surer.sigma > _KNOWN * surer.limit or abs(surer.error) > surer.limit:
        return "whether the map has the sensors' unit is not known yet; drive on"
    return ""


def scan_scale(walls: Walls, pose: Floats, rays: Rays, looks: int) -> Scale:
    """Match the rays of several looks with pose (3,), motion scale and distance scale free.

    Along a single wall every scale fits, with a pose that is moved accordingly, and the standard deviation does not show that.
    So a scale that is off is compared with a match in the map's own unit.
    """
    error, sigma, whole = _matched(walls, pose, rays, looks, _PRIOR)
    found = Scale("lidar", error, sigma)
    if not found.off:
        return found
    return replace(found, gain=whole - _matched(walls, pose, rays, looks, np.append(_PRIOR[:-1], _NO_SCALE))[-1])


def _matched(walls: Walls, pose: Floats, rays: Rays, looks: int, prior: Floats) -> tuple[float, float, float]:
    """Return the scale of the distances, its standard deviation, and the log-likelihood, with the priors' part."""
    x, information = np.zeros_like(prior), np.diag(1.0 / np.square(prior))
    start, beam = np.append(pose, (0.0, 0.0)), rays.ends - rays.origins
    hessian, scaled = information, rays
    for width in WIDTHS:
        h, _, g, weight = walls.factors((start + x)[None, :-2], scaled, width, (rays.origins, beam))
        share = min(INDEPENDENT * looks / max(float(weight[0]), 1.0), 1.0) / WALL_SIGMA**2
        hessian = information + share * h[0]
        x = x - np.linalg.solve(hessian, share * g[0] + information @ x)
        origins = rays.origins * (1.0 + x[-2])
        scaled = Rays(origins + beam * (1.0 + x[-1]), origins, rays.hit)
    agreement = float(walls.agreement((start + x)[None, :-2], scaled).log_likelihood[0])
    value = min(len(rays.hit), INDEPENDENT * looks) * agreement - 0.5 * float(x @ information @ x)
    return float(x[-1]), float(np.sqrt(np.linalg.inv(hessian)[-1, -1])), value


def range_scale(pose: Floats, ranges: Ranges) -> Scale:
    """Fit pose, way, distances and one constant error per anchor to the ranges: Gauss-Newton with Cauchy kernels.

    An anchor that was moved by metres explains its own ranges, and looks like no other unit; errors that all share do.
    """
    names, anchor = np.unique(ranges.anchor, return_inverse=True)
    own, first = np.eye(len(names))[anchor], len(_PRIOR)
    prior = 1.0 / np.square(np.append(_PRIOR, np.full(len(names), BIAS_SIGMA)))
    x, hessian = np.zeros(len(prior)), np.diag(prior)
    for _ in range(_ITERATIONS):
        way, distance = 1.0 + x[first - 2 : first]
        now = replace(ranges, tags=ranges.tags * way, values=ranges.values * distance - own @ x[first:])
        moved = pose + x[: len(pose)]
        error, by_pose = (v[0] for v in range_errors(moved[None], now))
        lever = se2.rotate(moved[2], ranges.tags)
        along = (by_pose[:, :2] * lever).sum(axis=1)
        jacobian = np.column_stack([by_pose, along, -ranges.values, own])
        weight = cauchy(error, ranges.sigma) / ranges.sigma**2
        information = np.diag(prior * np.append(np.ones(first), cauchy(x[first:], BIAS_SIGMA)))
        hessian = information + (jacobian * weight[:, None]).T @ jacobian
        x = x - np.linalg.solve(hessian, information @ x - jacobian.T @ (weight * error))
    return Scale("radio", float(x[first - 1]), float(np.sqrt(np.linalg.inv(hessian)[first - 1, first - 1])))
