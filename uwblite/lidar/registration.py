"""Registration: where a cloud lies in another one, given a prior that may be wrong altogether.

The prior of a relative pose is a mixture of two Gaussians about one place: a narrow one, where the odometry holds, and a wide
one, where the wheels slipped (see ``Prior``). Matching descends from places throughout the prior, and both parts of the mixture
are compared by their evidence, the marginal likelihood of the source's surfaces in the target by Laplace:

    log E = log N(T; mean, C) + sum over objects log((1 - m) exp(g - chi2 / 2) + m) + 3/2 log 2 pi - 1/2 log |H + C^-1|,

where the sum is that of object_likelihood. Two clouds may also show nothing of each other's place; then neither part gains.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, Ints, Table, concatenated
from ..odometry.slips import FalseMotions
from .cloud_rasters import CloudRasters, rasterize
from .clouds import Clouds
from .correlative_matching import search
from .object_likelihood import ObjectLikelihood, ObjectPolicy
from .raster_search import Window, best_poses
from .scan_matching import (
    PairFactors,
    PairPoints,
    nondegenerate_step,
    pair_points,
)


@dataclass(frozen=True, slots=True)
class RegistrationConfig:
    """Descent and search."""

    first_gate: ClassVar[float] = 0.5
    """Farthest match at the beginning of the descent, m; the reach of the rasters."""
    useless: ClassVar[float] = 0.05
    """Probability that two clouds show nothing of each other's place: 'none of these'."""
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
    wide: ClassVar[float] = 1.2
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
    evidence_lost: Floats
    """(e,) by how much the log likelihood is below that of surfaces that all agree at the prior's mean."""

    @property
    def share(self) -> Floats:
        """(e,) share of the points looked up that match, 0..1."""
        return self.factors.matched / np.maximum(self.factors.asked, 1)

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
    """The modes of e pairs."""

    sound: Placed
    """Where the odometry holds."""
    searched: Ints
    """(s,) pairs that may lie elsewhere."""
    slipped: Placed
    """Of these, where the wheels slipped."""
    bound: Floats
    """(e,) most that the log of the evidence for a slip by that against it can be, for the others."""

    def log_odds(self, more: Floats | float = 0.0) -> Floats:
        """Return the log of the evidence (e,) for a slip by that against it; 0 where the clouds say nothing.

        Parameters
        ----------
        more : (e,) what adds to the evidence of a slip over each.
        """
        none, rows, odds = np.log(RegistrationConfig.useless), self.searched, self.bound.copy()
        more = np.broadcast_to(more, odds.shape)[rows]
        odds[rows] = np.logaddexp(self.slipped.evidence + more, none) - np.logaddexp(self.sound.evidence[rows], none)
        return of_fallible(odds, RegistrationConfig.useless)

    def false_motions(self, prior: Prior, variance: float) -> FalseMotions:
        """Return what the matches show of the wheels' false motions; nothing of pairs that were not searched.

        Parameters
        ----------
        prior : with which they were placed. variance : of a match, m^2.
        """
        own, motions = prior.rows(self.searched), FalseMotions(np.zeros_like(prior.mean), np.zeros_like(prior.slipped))
        sigma = np.sqrt(np.einsum("eii->ei", own.slipped))
        hessian = self.slipped.factors.hessian / (variance * ObjectPolicy.correlation)
        # Matches and prior hold the pose in balance.
        pull = np.einsum("eij,ej->ei", hessian + np.linalg.inv(own.slipped), _difference(self.slipped.pose, own.mean))
        motions.vector[self.searched] = sigma * pull
        motions.matrix[self.searched] = sigma[:, :, None] * hessian * sigma[:, None, :]
        return motions

    def chosen(self, probability: Floats) -> Placed:
        """Return the likelier mode of each pair, slips having a probability (e,)."""
        return _replaced(self.sound, self.searched, self.slipped, probability[self.searched] > 0.5)


def _replaced(placed: Placed, rows: Ints, others: Placed, better: Bools) -> Placed:
    """Return pairs of which some rows (r,) are replaced by others where these are better (r,)."""
    which = np.arange(len(placed.pose))
    which[rows[better]] = len(which) + np.flatnonzero(better)
    return concatenated([placed, others]).rows(which)


def _best(placed: Sequence[Placed]) -> Placed:
    """Return of several placements of the same pairs those with the largest evidence."""
    best = np.argmax([p.evidence for p in placed], axis=0)
    return concatenated(list(placed)).rows(best * len(best) + np.arange(len(best)))


class Registration:
    """Clouds ready for registration with each other."""

    def __init__(self, clouds: Clouds, raster: CloudRasters, nearest: Floats, sigma: float, chance: Floats) -> None:
        """Take clouds and their rasters.

        Parameters
        ----------
        nearest : surface by bearing, see visibility. sigma : standard deviation of a match, m. chance : see matched_by_chance.
        """
        self._clouds, self._raster, self.sigma = clouds, raster, sigma
        self.objects = ObjectLikelihood(clouds, raster, nearest, sigma, chance)

    def register(self, i: Ints, j: Ints, points: PairPoints, prior: Prior, other: Floats) -> Placement:
        """Place sources j (e,) in targets i (e,).

        Parameters
        ----------
        points : of the sources, see pair_points. other : (e, 3) further poses to start from.
        """
        c = RegistrationConfig
        sound = self._descend(i, points, prior.mean, prior.mean, prior.covariance)
        log_odds = np.where(sound.factors.asked > 0, self._most_odds(sound, prior), 0.0)
        rows = np.flatnonzero((log_odds > np.log(c.worth)) & (sound.factors.asked > 0))
        slipped = self._from_best(i, points, prior, rows, [other[rows]])
        for least, further in ((c.good_share, self._shares), (c.least_share, self._searched)):
            poor = np.flatnonzero(np.maximum(slipped.share, sound.share[rows]) < least)
            lost = rows[poor]
            found = self._from_best(i, points, prior, lost, further(i[lost], j[lost], prior.rows(lost)))
            slipped = _replaced(slipped, poor, found, found.evidence > slipped.evidence[poor])
        return Placement(sound, rows, slipped, log_odds)

    def placed_again(self, i: Ints, points: PairPoints, found: Placement, prior: Prior, expected: FalseMotions) -> Placement:
        """Return a placement whose slipped pairs are placed with what their neighbours show of the wheels' false motions.

        Parameters
        ----------
        i, points, prior : see register. found : of these. expected : see FalseMotions.by_neighbours.
        """
        rows = found.searched
        own, sigma = prior.rows(rows), np.sqrt(np.einsum("eii->ei", prior.slipped[rows]))
        spread = np.linalg.inv(expected.matrix[rows])
        mean = own.mean + sigma * np.einsum("eij,ej->ei", spread, expected.vector[rows])
        covariance = sigma[:, :, None] * spread * sigma[:, None, :] + own.covariance
        some = PairPoints(points.row[rows])
        slipped = _best([self._descend(i[rows], some, start, mean, covariance) for start in (found.slipped.pose, mean)])
        return replace(found, slipped=slipped)

    def _from_best(self, i: Ints, points: PairPoints, prior: Prior, rows: Ints, starts: Sequence[Floats]) -> Placed:
        """Place some pairs (r,) whose wheels slipped, from the best of several starts (r, 3)."""
        some, own = PairPoints(points.row[rows]), prior.rows(rows)
        return _best([self._descend(i[rows], some, start, own.mean, own.slipped) for start in starts])

    def _descend(self, i: Ints, points: PairPoints, start: Floats, mean: Floats, covariance: Floats) -> Placed:
        """Place sources in targets i (e,) under Gaussian priors, each from its start (e, 3).

        Parameters
        ----------
        mean, covariance : (e, 3) and (e, 3, 3) of x, y, heading of T_i_j. points : of the sources, see pair_points.
        """
        c = RegistrationConfig
        information = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
        pose, variance = start.copy(), self.sigma**2
        gate, temper, left = c.first_gate, 1.0, np.arange(len(i))
        for _ in range(c.iterations):
            factors, _ = self.objects.match(i[left], PairPoints(points.row[left]), pose[left], gate, covariance[left] * temper)
            step = self._step(factors, information[left], pose[left], mean[left])
            pose[left] += step
            if gate <= ObjectPolicy.gate and temper < c.cold:
                left = left[np.abs(step).max(axis=1) >= c.converged]
            gate, temper = max(gate * c.shrink, ObjectPolicy.gate), temper * c.cooling
        pose[:, 2] = se2.wrap_angle(pose[:, 2])
        factors, judged = self.objects.match(i, points, pose, ObjectPolicy.gate, np.zeros_like(covariance))
        likelihood, most = (np.concatenate([getattr(part, name) for part in judged]) for name in ("likelihood", "most"))
        hessian = factors.hessian / (variance * ObjectPolicy.correlation)
        off = _difference(pose, mean)
        distance = 0.5 * np.einsum("ei,eij,ej->e", off, information, off)
        prior = -distance - 0.5 * np.linalg.slogdet(covariance)[1]
        volume = -0.5 * np.linalg.slogdet(hessian + information)[1]
        evidence, lost = likelihood + prior + volume, distance + most - likelihood
        after = np.asarray(np.linalg.inv(hessian + information), dtype=np.float64)
        return Placed(pose, factors, after, evidence, lost)

    @staticmethod
    def _shares(i: Ints, j: Ints, prior: Prior) -> list[Floats]:
        """Return the poses (e, 3) of robots that moved all, half or none of what their wheels counted."""
        return [share * prior.mean for share in (1.0, 0.5, 0.0)]

    def _searched(self, i: Ints, j: Ints, prior: Prior) -> list[Floats]:
        """Return poses (e, 3) from which matching may begin: exhaustive search of two standard deviations within view.

        Where the wheels counted metres, the window is as large as the clouds: all its shifts are one correlation there.
        """
        c, within = RegistrationConfig, 2.0 * np.sqrt(np.einsum("eii->ei", prior.slipped))
        starts = np.tile(prior.mean, (c.places, 1, 1))
        for row, (target, source) in enumerate(zip(i.tolist(), j.tolist(), strict=True)):
            own, other = (self._clouds.chosen(np.array([k])) for k in (target, source))
            view = sum(float(np.hypot(*cloud.points.T).max(initial=0.0)) for cloud in (own, other))
            low, high = (np.clip(prior.mean[row, :2] + side * within[row, :2], -view, view) for side in (-1.0, 1.0))
            middle, half = np.append(0.5 * (low + high), prior.mean[row, 2]), 0.5 * (high - low)
            turn = min(float(within[row, 2]), np.pi)
            if half[:2].max() > c.wide:
                found = search(own, other, middle, (float(half[0]), float(half[1]), turn)).poses
            else:
                pair, raster = self._clouds.chosen(np.array([target, source])), rasterize(own, c.cell, c.first_gate)
                points = pair_points(pair, np.array([1]), c.scored).of(0)
                found = best_poses(pair, raster, points, middle, Window(float(half.max()), turn), c.places)
            starts[: len(found), row] = found[: c.places]
        return list(starts)

    def _most_odds(self, placed: Placed, prior: Prior) -> Floats:
        """Return the log of the odds (e,) of a slip after which everything agrees, with the information found here."""
        hessian = placed.factors.hessian / (self.sigma**2 * ObjectPolicy.correlation)
        here, there = (np.linalg.slogdet(np.eye(3) + cov @ hessian)[1] for cov in (prior.covariance, prior.slipped))
        return np.asarray(placed.evidence_lost + 0.5 * (here - there))

    def _step(self, factors: PairFactors, information: Floats, pose: Floats, mean: Floats) -> Floats:
        """Return a damped Gauss-Newton step (e, 3) of matches and prior."""
        scale = self.sigma**2 * ObjectPolicy.correlation
        hessian = factors.hessian / scale + information
        gradient = factors.gradient / scale + np.einsum("eij,ej->ei", information, _difference(pose, mean))
        step = -np.linalg.solve(hessian, gradient[..., None])[..., 0]
        far, wide = RegistrationConfig.farthest
        reach = np.maximum(np.hypot(step[:, 0], step[:, 1]) / far, np.abs(step[:, 2]) / wide)
        return np.asarray(step / np.maximum(reach, 1.0)[:, None])

    def log_likelihood(self, i: Ints, points: PairPoints, pose: Floats) -> Floats:
        """Return the log likelihood (e,) of sources in targets i (e,) at poses (e, 3), by that in unknown space."""
        if not len(i):
            return np.zeros(0)
        _, judged = self.objects.match(i, points, pose, ObjectPolicy.gate, np.zeros((len(i), 3, 3)))
        return np.concatenate([part.likelihood for part in judged])


def of_fallible(log_odds: Floats, wrong: float) -> Floats:
    """Return the log odds (e,) by evidence that is the other way round with a probability.

    Where people crowd about the robot, one pair of clouds can favour a false place by any factor: the model of the surfaces is
    wrong there, and only several pairs in a row tell.
    """
    favoured = 1.0 / (1.0 + np.exp(-np.clip(log_odds, -_HUGE, _HUGE)))
    right = (1.0 - wrong) * favoured + wrong * (1.0 - favoured)
    return np.asarray(np.log(right) - np.log1p(-right))


_UNLIKELY, _HUGE = 0.5, 50.0
"""Probability of standing still below which an object moves, and the largest exponent."""


def _difference(pose: Floats, mean: Floats) -> Floats:
    off = pose - mean
    off[:, 2] = se2.wrap_angle(off[:, 2])
    return off
