"""Registration: where a cloud lies in another one, given a prior that may be wrong altogether.

The prior of a relative pose is a mixture of two Gaussians about one place: a narrow one, where the odometry holds, and a wide
one, where the wheels slipped (see ``Prior``). Matching descends from places throughout the prior, and both parts of the mixture
are compared by their evidence, the marginal likelihood of the source's surfaces in the target by Laplace:

    log E = log N(T; mean, C) + sum over objects log((1 - m) exp(g - chi2 / 2) + m) + 3/2 log 2 pi - 1/2 log |H + C^-1|,

where the sum is that of object_likelihood. Two clouds may also show nothing of each other's place; then neither part gains.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, Ints, Table, concatenated
from ..odometry.slips import FalseMotions
from . import correlative_matching
from .cloud_rasters import rasterize
from .object_likelihood import CloudPairs, ObjectLikelihood, ObjectPolicy
from .raster_search import Window, best_poses
from .scan_matching import PairFactors, nondegenerate_step, pair_points


@dataclass(frozen=True, slots=True)
class RegistrationConfig:
    """Descent and search."""

    first_gate: ClassVar[float] = 0.5
    """Farthest match at the beginning of the descent, m; the reach of the rasters."""
    useless: ClassVar[float] = 0.05
    """Probability that two clouds show nothing of each other's place: 'none of these'."""
    same: ClassVar[float] = 16.27
    """Squared Mahalanobis distance up to which two modes are one; one in a thousand exceeds it by chance."""
    worth: ClassVar[float] = 0.02
    """Posterior odds of a slip below which it is not searched for."""
    good_share: ClassVar[float] = 0.75
    """Share of matching points from which on matching begins at no further places."""
    least_share: ClassVar[float] = 0.5
    """The same of an exhaustive search."""
    places: ClassVar[int] = 4
    """Best places of an exhaustive search from which matching descends."""
    scored: ClassVar[int] = 120
    """Points that such a search looks up."""
    cell: ClassVar[float] = 0.1
    """Step of such a search in x and y, m."""
    wide: ClassVar[float] = 3.0
    """Half-width of a search from which on one correlation of all shifts takes less time, m."""
    linear: ClassVar[float] = 0.1
    """Distance from the matched pose, m or rad, up to which the matches there are those of the optimum."""
    iterations: ClassVar[int] = 20
    shrink: ClassVar[float] = 0.8
    """Gate of an iteration as a share of the one before."""
    cooling: ClassVar[float] = 0.6
    """Covariance of the prior that residuals may still have in an iteration, as a share of the one before."""
    cold: ClassVar[float] = 0.05
    """Share of the prior's covariance from which on descent may end."""
    farthest: ClassVar[tuple[float, float]] = (0.3, 0.15)
    """Longest step of one iteration, m and rad."""
    converged: ClassVar[float] = 1e-3
    """Steps below this end the descent, m or rad."""


@dataclass(frozen=True, slots=True, eq=False)
class Prior(Table):
    """What is known of e relative poses before their clouds are compared."""

    mean: Floats
    """(e, 3) T_i_j."""
    covariance: Floats
    """(e, 3, 3) of x, y, heading, where the odometry holds."""
    slipped: Floats
    """(e, 3, 3) where the wheels slipped."""


@dataclass(frozen=True, slots=True, eq=False)
class Gaussian(Table):
    """One part of such a prior."""

    mean: Floats
    """(e, 3) T_i_j."""
    covariance: Floats
    """(e, 3, 3)."""


@dataclass(frozen=True, slots=True, eq=False)
class Placed(Table):
    """Where descent ended, of e pairs."""

    pose: Floats
    """(e, 3) T_i_j."""
    factors: PairFactors
    """Of the matches there, objects that move left out."""
    covariance: Floats
    """(e, 3, 3) of the pose by matches and prior."""
    evidence: Floats
    """(e,) log marginal likelihood."""
    likelihood: Floats
    """(e,) log likelihood of the source there, by that in unknown space."""
    evidence_lost: Floats
    """(e,) by how much the log likelihood is below that of surfaces that all agree at the prior's mean."""

    @property
    def share(self) -> Floats:
        """(e,) share of the points looked up that match, 0..1."""
        return self.factors.matched / np.maximum(self.factors.asked, 1)

    def replaced(self, rows: Ints, others: "Placed", better: Bools) -> "Placed":
        """Return placements some rows (r,) of which are replaced by others (r,) where these are better (r,)."""
        which = np.arange(len(self.pose))
        which[rows[better]] = len(which) + np.flatnonzero(better)
        return concatenated([self, others]).rows(which)

    def measured(self, variance: float) -> tuple[Floats, Floats]:
        """Return what the matches alone measure, without the prior: T_i_j (e, 3), and the roots (e, 3, 3) of information.

        A direction whose own optimum lies beyond what holds for linear surfaces was not measured: the prior placed it.

        Parameters
        ----------
        variance : of a match, m^2.
        """
        step, root = nondegenerate_step(self.factors)
        along = np.einsum("eij,ej->ei", root, step)
        root = np.where((np.abs(along) <= RegistrationConfig.linear * np.linalg.norm(root, axis=2))[:, :, None], root, 0.0)
        z = self.pose + np.einsum("eij,ejk,ek->ei", np.linalg.pinv(root, rcond=1e-9), root, step)
        z[:, 2] = se2.wrap_angle(z[:, 2])
        return z, np.asarray(root @ se2.rotation(z[:, 2]) / np.sqrt(variance))


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """The modes of e pairs, one for each part of the prior; where a slip was not worth a search, both are the same."""

    sound: Placed
    """Where the odometry holds."""
    slipped: Placed
    """Where the wheels slipped."""
    bound: Floats
    """(e,) most that the log of the evidence for a slip by that against it can be, for pairs for which none was sought."""
    searched: Ints
    """Pairs (s,) for which a slip was sought."""

    def log_odds(self, more: Floats | float = 0.0) -> Floats:
        """Return the log of the evidence (e,) for a slip by that against it; 0 where the clouds say nothing.

        Parameters
        ----------
        more : (e,) what adds to the evidence of a slip over each.
        """
        none, rows, odds = np.log(RegistrationConfig.useless), self.searched, self.bound.copy()
        more = np.broadcast_to(more, odds.shape)[rows]
        slipped, sound = self.slipped.evidence[rows] + more, self.sound.evidence[rows]
        odds[rows] = np.logaddexp(slipped, none) - np.logaddexp(sound, none)
        return of_fallible(odds, RegistrationConfig.useless)

    def false_motions(self, prior: Prior, variance: float) -> FalseMotions:
        """Return what the matches show of the wheels' false motions; nothing of pairs that were not searched.

        Parameters
        ----------
        prior : with which they were placed. variance : of a match, m^2.
        """
        own, slipped = prior.rows(self.searched), self.slipped.rows(self.searched)
        motions = FalseMotions(np.zeros_like(prior.mean), np.zeros_like(prior.slipped))
        sigma = np.sqrt(np.einsum("eii->ei", own.slipped))
        hessian = slipped.factors.hessian / (variance * ObjectPolicy.correlation)
        # Matches and prior hold the pose in balance.
        pull = np.einsum("eij,ej->ei", hessian + np.linalg.inv(own.slipped), _difference(slipped.pose, own.mean))
        motions.vector[self.searched] = sigma * pull
        motions.matrix[self.searched] = sigma[:, :, None] * hessian * sigma[:, None, :]
        return motions

    def posterior(self, slips: float) -> Floats:
        """Return the probabilities (3, e) that pairs lie at the sound mode, at that of a slip if that is another place, and at
        none of these.

        Parameters
        ----------
        slips : probability of a slip beforehand.
        """
        useless = RegistrationConfig.useless
        parts = np.stack([
            np.log((1.0 - useless) * (1.0 - slips)) + self.sound.evidence,
            np.log((1.0 - useless) * slips) + self.slipped.evidence,
            np.full(len(self.bound), np.log(useless)),
        ])
        # Any of them may be favoured falsely, however much.
        likely = np.exp(parts - np.logaddexp.reduce(parts, axis=0))
        off = _difference(self.slipped.pose, self.sound.pose)
        both = self.sound.covariance + self.slipped.covariance
        same = np.einsum("ei,ei->e", off, np.linalg.solve(both, off[:, :, None])[:, :, 0]) < RegistrationConfig.same
        likely[:2] = np.where(same, np.stack([likely[:2].sum(axis=0), np.zeros(len(same))]), likely[:2])
        return np.asarray((1.0 - useless) * likely + useless * np.array([[0.0], [0.0], [1.0]]))

    def chosen(self, probability: Floats) -> Placed:
        """Return the likelier mode of each pair, slips having a probability (e,)."""
        return self.sound.replaced(np.arange(len(probability)), self.slipped, probability > 0.5)


Starts = Callable[[ObjectLikelihood, CloudPairs, Gaussian], list[Floats]]
"""Gives poses (e, 3) from which matching begins."""


def register(objects: ObjectLikelihood, pairs: CloudPairs, prior: Prior, other: Floats) -> Placement:
    """Place the sources of pairs (e,) in their targets.

    Parameters
    ----------
    other : (e, 3) further poses to start from.
    """
    c = RegistrationConfig
    sound = descend(objects, pairs, prior.mean, Gaussian(prior.mean, prior.covariance))
    log_odds = np.where(sound.factors.asked > 0, _most_odds(objects, sound, prior), 0.0)
    rows = np.flatnonzero((log_odds > np.log(c.worth)) & (sound.factors.asked > 0))
    some, wide = pairs.rows(rows), Gaussian(prior.mean[rows], prior.slipped[rows])
    slipped = descend(objects, some, other[rows], wide)
    for least, starts in ((c.good_share, _shares), (c.least_share, _searched)):
        poor = np.flatnonzero(np.maximum(slipped.share, sound.share[rows]) < least)
        found = _from_best(objects, some.rows(poor), wide.rows(poor), starts)
        slipped = slipped.replaced(poor, found, found.evidence > slipped.evidence[poor])
    slipped = sound.replaced(rows, slipped, np.ones(len(rows), dtype=bool))
    return Placement(sound, slipped, log_odds, rows)


def placed_again(
    objects: ObjectLikelihood, pairs: CloudPairs, found: Placement, prior: Prior, expected: FalseMotions
) -> Placement:
    """Return a placement whose slipped pairs are placed with what their neighbours show of the wheels' false motions.

    Parameters
    ----------
    pairs, prior : see register. found : of these. expected : see FalseMotions.by_neighbours.
    """
    rows = found.searched
    own, sigma = prior.rows(rows), np.sqrt(np.einsum("eii->ei", prior.slipped[rows]))
    spread = np.linalg.inv(expected.matrix[rows])
    mean = own.mean + sigma * np.einsum("eij,ej->ei", spread, expected.vector[rows])
    wide = Gaussian(mean, sigma[:, :, None] * spread * sigma[:, None, :] + own.covariance)
    one, other = (descend(objects, pairs.rows(rows), start, wide) for start in (found.slipped.pose[rows], mean))
    slipped = one.replaced(np.arange(len(rows)), other, other.evidence > one.evidence)
    return replace(found, slipped=found.slipped.replaced(rows, slipped, np.ones(len(rows), dtype=bool)))


def search(objects: ObjectLikelihood, pairs: CloudPairs, prior: Gaussian) -> Placed:
    """Place the sources of pairs (e,) in their targets, wherever the prior allows."""
    return _from_best(objects, pairs, prior, _searched)


def _from_best(objects: ObjectLikelihood, pairs: CloudPairs, prior: Gaussian, starts: Starts) -> Placed:
    """Place pairs (e,), each from the best of several starts."""
    placed = [descend(objects, pairs, start, prior) for start in starts(objects, pairs, prior)]
    best = np.argmax([each.evidence for each in placed], axis=0)
    return concatenated(placed).rows(best * len(pairs) + np.arange(len(pairs)))


def _shares(objects: ObjectLikelihood, pairs: CloudPairs, prior: Gaussian) -> list[Floats]:
    """Return the poses (e, 3) of robots that moved all, half or none of what their wheels counted."""
    return [share * prior.mean for share in (1.0, 0.5, 0.0)]


def _searched(objects: ObjectLikelihood, pairs: CloudPairs, prior: Gaussian) -> list[Floats]:
    """Return poses (e, 3) from which matching may begin: exhaustive search of two standard deviations within view.

    Where the wheels counted metres, the window is as large as the clouds: all its shifts are one correlation there.
    """
    c, clouds, within = RegistrationConfig, objects.clouds, 2.0 * np.sqrt(np.einsum("eii->ei", prior.covariance))
    starts = np.tile(prior.mean, (c.places, 1, 1))
    for row, (target, source) in enumerate(zip(pairs.i.tolist(), pairs.j.tolist(), strict=True)):
        own, other = (clouds.chosen(np.array([k])) for k in (target, source))
        view = sum(float(np.hypot(*cloud.points.T).max(initial=0.0)) for cloud in (own, other))
        low, high = (np.clip(prior.mean[row, :2] + side * within[row, :2], -view, view) for side in (-1.0, 1.0))
        middle, half = np.append(0.5 * (low + high), prior.mean[row, 2]), 0.5 * (high - low)
        turn = min(float(within[row, 2]), np.pi)
        if half[:2].max() > c.wide:
            found = correlative_matching.search(own, other, middle, (float(half[0]), float(half[1]), turn)).poses
        else:
            pair, raster = clouds.chosen(np.array([target, source])), rasterize(own, c.cell, c.first_gate)
            points = pair_points(pair, np.array([1]), c.scored).of(0)
            found = best_poses(pair, raster, points, middle, Window(float(half.max()), turn), c.places)
        starts[: len(found), row] = found[: c.places]
    return list(starts)


def _most_odds(objects: ObjectLikelihood, placed: Placed, prior: Prior) -> Floats:
    """Return the log of the odds (e,) of a slip after which everything agrees, with the information found here."""
    hessian = placed.factors.hessian / (objects.sigma**2 * ObjectPolicy.correlation)
    here, there = (np.linalg.slogdet(np.eye(3) + cov @ hessian)[1] for cov in (prior.covariance, prior.slipped))
    return np.asarray(placed.evidence_lost + 0.5 * (here - there))


def descend(objects: ObjectLikelihood, pairs: CloudPairs, start: Floats, prior: Gaussian) -> Placed:
    """Place the sources of pairs (e,) in their targets by matches and a prior, each from its start (e, 3)."""
    c, scale = RegistrationConfig, objects.sigma**2 * ObjectPolicy.correlation
    information = np.asarray(np.linalg.inv(prior.covariance), dtype=np.float64)
    pose, gate, temper, left = start.copy(), c.first_gate, 1.0, np.arange(len(pairs))
    for _ in range(c.iterations):
        factors, _ = objects.match(pairs.rows(left), pose[left], gate, prior.covariance[left] * temper)
        hessian = factors.hessian / scale + information[left]
        pull = np.einsum("eij,ej->ei", information[left], _difference(pose[left], prior.mean[left]))
        step = -np.linalg.solve(hessian, (factors.gradient / scale + pull)[..., None])[..., 0]
        reach = np.maximum(np.hypot(step[:, 0], step[:, 1]) / c.farthest[0], np.abs(step[:, 2]) / c.farthest[1])
        step /= np.maximum(reach, 1.0)[:, None]
        pose[left] += step
        if gate <= ObjectPolicy.gate and temper < c.cold:
            left = left[np.abs(step).max(axis=1) >= c.converged]
        gate, temper = max(gate * c.shrink, ObjectPolicy.gate), temper * c.cooling
    pose[:, 2] = se2.wrap_angle(pose[:, 2])
    factors, judged = objects.match(pairs, pose, ObjectPolicy.gate)
    likelihood, most = (np.concatenate([getattr(part, name) for part in judged]) for name in ("likelihood", "most"))
    hessian = factors.hessian / scale + information
    off = _difference(pose, prior.mean)
    distance = 0.5 * np.einsum("ei,eij,ej->e", off, information, off)
    volume = -0.5 * (np.linalg.slogdet(prior.covariance)[1] + np.linalg.slogdet(hessian)[1])
    covariance = np.asarray(np.linalg.inv(hessian), dtype=np.float64)
    return Placed(pose, factors, covariance, likelihood - distance + volume, likelihood, distance + most - likelihood)


def of_fallible(log_odds: Floats, wrong: float) -> Floats:
    """Return the log odds (e,) by evidence that is the other way round with a probability.

    Where people crowd about the robot, one pair of clouds can favour a false place by any factor: the model of the surfaces is
    wrong there, and only several pairs in a row tell.
    """
    favoured = 1.0 / (1.0 + np.exp(-np.clip(log_odds, -ObjectPolicy.largest, ObjectPolicy.largest)))
    right = (1.0 - wrong) * favoured + wrong * (1.0 - favoured)
    return np.asarray(np.log(right) - np.log1p(-right))


def _difference(pose: Floats, mean: Floats) -> Floats:
    off = pose - mean
    off[:, 2] = se2.wrap_angle(off[:, 2])
    return off
