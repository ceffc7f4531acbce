"""Registration: where a cloud lies in another one, given a prior that may be wrong altogether.

The prior of a relative pose is a mixture of two Gaussians about one place: a narrow one, where the odometry holds, and one
that is wide along the wheels and in heading, where they slipped (see ``Prior``). Matching descends from places throughout the
prior, and both parts of the mixture are compared by their evidence, the marginal likelihood of the source's surfaces in the
target by Laplace:

    log E = log N(T; mean, C) + sum over objects log((1 - m) exp(g - chi2 / 2) + m) + 3/2 log 2 pi - 1/2 log |H + C^-1|,

where the sum is that of object_likelihood. Two clouds may also show nothing of each other's place; then neither part gains.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri, expit, logit

from .. import se2
from ..arrays import Bools, Floats, Ints, Table, concatenated
from ..odometry.slips import FalseMotions
from . import correlative_matching
from .correlative_matching import CorrelativeConfig
from .object_likelihood import ObjectLikelihood
from .scan_matching import SINGULAR, Aligned, CloudPairs, PairPolicy, limited, measured_part, nondegenerate_step


class RegistrationConfig:
    """Descent and search."""

    fewest: int = 6
    """Matches from which on a pose is measured: twice its unknowns."""
    useless: float = 0.05
    """Probability that two clouds show nothing of each other's place: 'none of these'."""
    contradicts: float = float(chdtri(*se2.POSE, 1e-3))
    """Squared Mahalanobis distance beyond which two poses are not the same; one in a thousand exceeds it by chance."""
    doubtful: float = 0.02
    """Probability of a slip from which on it is searched for."""
    least_share: float = 0.5
    """Share of matching points below which the search is exhaustive."""
    cooling: float = 0.6
    """Covariance of the prior that residuals may still have in an iteration, as a share of the one before."""
    cold: float = 0.05
    """Share of the prior's covariance from which on descent may end."""
    linear: float = 0.1
    """Distance from the matched pose, m or rad, up to which the matches there are those of the optimum."""


@dataclass(frozen=True, slots=True, eq=False)
class Gaussian(Table):
    """What is known of e relative poses before their clouds are compared, or one part of that."""

    mean: Floats
    """(e, 3) T_i_j."""
    covariance: Floats
    """(e, 3, 3) of x, y, heading."""


@dataclass(frozen=True, slots=True, eq=False)
class Prior(Table):
    """The parts of it."""

    sound: Gaussian
    """Where the odometry holds."""
    slipped: Gaussian
    """Where the wheels slipped."""
    lost: Gaussian
    """Where a message of the odometry was lost, or the robot was carried."""

    @classmethod
    def about(cls, mean: Floats, sound: Floats, slip: Floats, loss: Floats) -> "Prior":
        """Return that of wheels that count motions (e, 3) with covariances (e, 3, 3), and standard deviations (e, 3) of what
        they do not count while they slip, or messages are lost, m, m, rad."""
        each = np.eye(mean.shape[1])
        return cls(*(Gaussian(mean, sound + more[:, :, None] ** 2 * each) for more in (np.zeros_like(slip), slip, loss)))


@dataclass(frozen=True, slots=True, eq=False)
class Placed(Aligned):
    """Where descent ended, of e pairs; objects that move are left out of the factors."""

    information: Floats
    """(e, 3, 3) of the pose by the matches, without what the scatter of normals feigns."""
    likelihood: Floats
    """(e,) log likelihood of the source there, by that in unknown space."""
    most: Floats
    """(e,) the same where every point agreed."""

    @property
    def shown(self) -> Bools:
        """(e,) whether so many points match that a pose follows, and it is likelier than in space that nobody has seen."""
        return np.asarray((self.factors.matched >= RegistrationConfig.fewest) & (self.likelihood > 0.0))

    def log_prior(self, prior: Gaussian) -> Floats:
        """Return the log of a prior's density (e,), summed over the poses that the matches leave open."""
        off = _difference(self.pose, prior.mean)
        squared = np.einsum("ei,ei->e", off, _solved(prior.covariance, off))
        return np.asarray(-0.5 * (squared + _volume(prior, self.information)))

    def evidence(self, prior: Gaussian) -> Floats:
        """Return the log marginal likelihood (e,) of the sources under a prior, by Laplace."""
        return self.likelihood + self.log_prior(prior)

    def replaced(self, rows: Ints, others: "Placed", better: Bools) -> "Placed":
        """Return placements some rows (r,) of which are replaced by others (r,) where these are better (r,)."""
        which = np.arange(len(self.pose))
        which[rows[better]] = len(which) + np.flatnonzero(better)
        return concatenated([self, others]).rows(which)

    def measured(self, variance: float) -> tuple[Floats, Floats]:
        """Return what the matches alone, with a variance, m^2, measure: T_i_j (e, 3), and the roots (e, 3, 3) of information.

        A direction whose own optimum lies beyond what holds for linear surfaces was not measured: the prior placed it.
        """
        step, root = nondegenerate_step(*self.factors.quadratic)
        along = np.einsum("eij,ej->ei", root, step)
        root = np.where((np.abs(along) <= RegistrationConfig.linear * np.linalg.norm(root, axis=2))[:, :, None], root, 0.0)
        z = self.pose + np.einsum("eij,ejk,ek->ei", np.linalg.pinv(root, rcond=SINGULAR), root, step)
        z[:, 2] = se2.wrap_angle(z[:, 2])
        return z, np.asarray(root @ se2.rotation(z[:, 2]) / np.sqrt(variance))


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """Candidates for the places of e pairs."""

    prior: Prior
    """Of the pairs."""
    candidates: Placed
    """(n) places; the first of each pair, in their order, is that where the odometry holds."""
    pair: Ints
    """(n,) whose they are."""
    bound: Floats
    """(e,) most that the log of the evidence for a slip by that against it can be, for pairs for which none was sought."""
    searched: Ints
    """Pairs (s,) for which a slip was sought."""

    @property
    def sound(self) -> Placed:
        """(e) where the odometry holds."""
        return self.candidates.rows(slice(0, len(self.bound)))

    def followed_by(self, pair: Ints, candidates: Placed) -> "Placement":
        """Return the placement with further candidates (m) of some pairs (m,)."""
        return replace(
            self, candidates=concatenated([self.candidates, candidates]), pair=np.concatenate([self.pair, pair])
        )

    def best(self, score: Floats) -> Ints:
        """Return the candidate (e,) of each pair with the largest of some scores (n,)."""
        order = np.lexsort((np.arange(len(score)), -score, self.pair))
        return np.asarray(order[np.searchsorted(self.pair[order], np.arange(len(self.bound)))])

    def likeliest(self, part: Gaussian) -> tuple[Placed, Floats]:
        """Return the likeliest candidates (e) under a part of the prior, and the log of their evidence (e,)."""
        evidence = self.candidates.evidence(part.rows(self.pair))
        which = self.best(evidence)
        return self.candidates.rows(which), evidence[which]

    def log_odds(self, more: Floats | float = 0.0) -> Floats:
        """Return the log of the evidence (e,), with more (e,), for a slip by that against it; 0 where clouds say nothing."""
        sound, slipped = (self.likeliest(part)[1] for part in (self.prior.sound, self.prior.slipped))
        odds = of_fallible(self.bound, RegistrationConfig.useless)
        odds[self.searched] = odds_by_views(sound[None], (slipped + more)[None])[self.searched]
        return odds

    def false_motions(self) -> FalseMotions:
        """Return what the matches show of the wheels' false motions; nothing of pairs that were not searched."""
        rows, part = self.searched, self.prior.slipped.rows(self.searched)
        slipped = self.likeliest(self.prior.slipped)[0].rows(rows)
        motions = FalseMotions(np.zeros_like(self.prior.slipped.mean), np.zeros_like(self.prior.slipped.covariance))
        sigma = np.sqrt(np.einsum("eii->ei", part.covariance))
        # Matches and prior hold the pose in balance.
        hessian = slipped.information + np.linalg.inv(part.covariance)
        motions.vector[rows] = sigma * np.einsum("eij,ej->ei", hessian, _difference(slipped.pose, part.mean))
        motions.matrix[rows] = sigma[:, :, None] * slipped.information * sigma[:, None, :]
        return motions


def register(objects: ObjectLikelihood, pairs: CloudPairs, prior: Prior, other: Floats) -> Placement:
    """Place the sources of pairs (e,) in their targets, from the prior's mean and other poses (e, 3)."""
    c = RegistrationConfig
    sound = descend(objects, pairs, prior.sound.mean, prior.sound)
    bound = np.where(sound.factors.asked > 0, _most_odds(sound, prior), 0.0)
    rows = np.flatnonzero((bound > np.log(c.doubtful)) & (sound.factors.asked > 0))
    some, wide = pairs.rows(rows), prior.slipped.rows(rows)
    slipped = descend(objects, some, other[rows], wide)
    poor = np.flatnonzero(np.maximum(slipped.share, sound.share[rows]) < c.least_share)
    part = wide.rows(poor)
    found = search(objects, some.rows(poor), part)
    slipped = slipped.replaced(poor, found, found.evidence(part) > slipped.rows(poor).evidence(part))
    return Placement(prior, sound, np.arange(len(pairs)), bound, rows).followed_by(rows, slipped)


def with_neighbours(objects: ObjectLikelihood, pairs: CloudPairs, found: Placement, expected: FalseMotions) -> Placement:
    """Return a placement of pairs with what neighbours tell of false motions, see FalseMotions.by_neighbours, in the prior of
    slips, and places there."""
    rows, slipped = found.searched, found.prior.slipped
    sigma = np.sqrt(np.einsum("eii->ei", slipped.covariance[rows]))
    spread = np.linalg.inv(expected.matrix[rows])
    mean, covariance = slipped.mean.copy(), slipped.covariance.copy()
    mean[rows] += sigma * np.einsum("eij,ej->ei", spread, expected.vector[rows])
    covariance[rows] = sigma[:, :, None] * spread * sigma[:, None, :] + found.prior.sound.covariance[rows]
    near = found.likeliest(slipped)[0].pose
    found = replace(found, prior=replace(found.prior, slipped=Gaussian(mean, covariance)))
    for start in (near, mean):
        found = found.followed_by(rows, descend(objects, pairs.rows(rows), start[rows], found.prior.slipped.rows(rows)))
    return found


def search(objects: ObjectLikelihood, pairs: CloudPairs, prior: Gaussian) -> Placed:
    """Place the sources of pairs (e,) in their targets, wherever the prior allows."""
    row, start = _starts(objects, pairs, prior)
    placed = descend(objects, pairs.rows(row), start, prior.rows(row))
    order = np.lexsort((-placed.evidence(prior.rows(row)), row))
    return placed.rows(order[np.searchsorted(row, np.arange(len(pairs)))])


def _starts(objects: ObjectLikelihood, pairs: CloudPairs, prior: Gaussian) -> tuple[Ints, Floats]:
    """Return poses (s, 3) from which matching may begin, and whose they are (s,), in the order of the pairs: those of an
    exhaustive search of two standard deviations within view, and the prior's mean where these are few."""
    config, within = CorrelativeConfig(), 2.0 * np.sqrt(np.einsum("eii->ei", prior.covariance))
    starts = []
    for row, (mean, reach) in enumerate(zip(prior.mean, within, strict=True)):
        target, source = (objects.clouds.chosen(which[row : row + 1]) for which in (pairs.i, pairs.j))
        view = sum(float(np.hypot(*cloud.points.T).max(initial=0.0)) for cloud in (target, source))
        low, high = (np.clip(mean[:2] + side * reach[:2], -view, view) for side in (-1.0, 1.0))
        middle, (wide, tall) = np.append(0.5 * (low + high), mean[2]), 0.5 * (high - low)
        window = float(wide), float(tall), min(float(reach[2]), np.pi)
        found = correlative_matching.search(target, source, middle, window, config)
        starts.append(np.concatenate([found, mean[None]])[: config.candidates])
    counts = np.array([len(each) for each in starts], dtype=np.intp)
    return np.repeat(np.arange(len(pairs)), counts), np.concatenate([np.zeros((0, *se2.POSE)), *starts])


def _most_odds(placed: Placed, prior: Prior) -> Floats:
    """Return the log of the odds (e,) of a slip after which everything agrees, with the information found here."""
    off = _difference(placed.pose, prior.sound.mean)
    lost = placed.most - placed.likelihood + 0.5 * np.einsum("ei,ei->e", off, _solved(prior.sound.covariance, off))
    here, there = (_volume(part, placed.information) for part in (prior.sound, prior.slipped))
    return np.asarray(lost + 0.5 * (here - there))


def descend(objects: ObjectLikelihood, pairs: CloudPairs, start: Floats, prior: Gaussian) -> Placed:
    """Place the sources of pairs (e,) in their targets by matches and a prior, each from its start (e, 3)."""
    c, scale = PairPolicy, objects.sigma**2 * PairPolicy.correlation
    information = np.linalg.inv(prior.covariance)
    pose, gate, temper, left = start.copy(), c.reach, 1.0, np.arange(len(pairs))
    for _ in range(c.iterations):
        factors = objects.match(pairs.rows(left), pose[left], gate, prior.covariance[left] * temper)[0]
        matches, step = measured_part(*factors.quadratic)
        pull = np.einsum("eij,ej->ei", information[left], _difference(pose[left], prior.mean[left]))
        matches /= scale
        step = limited(_solved(matches + information[left], np.einsum("eij,ej->ei", matches, step) - pull))
        pose[left] += step
        if gate <= c.gate and temper < RegistrationConfig.cold:
            left = left[np.abs(step).max(axis=1) >= c.converged]
        if not len(left):
            break
        gate, temper = max(gate * c.shrink, c.gate), temper * RegistrationConfig.cooling
    pose[:, 2] = se2.wrap_angle(pose[:, 2])
    factors, likelihood, most = objects.match(pairs, pose, c.gate)
    return Placed(pose, factors, measured_part(*factors.quadratic)[0] / scale, likelihood, most)


def of_fallible(log_odds: Floats, wrong: float) -> Floats:
    """Return the log odds (e,) by evidence that is the other way round with a probability, as where people crowd about."""
    favoured = expit(log_odds)
    return np.asarray(logit((1.0 - wrong) * favoured + wrong * (1.0 - favoured)))


def odds_by_views(here: Floats, there: Floats) -> Floats:
    """Return the log odds (n,) for places against one, by the log of their evidence (v, n) and of its own (v, 1) in views, each
    of which may show nothing of either, and favour the false one."""
    none = np.log(RegistrationConfig.useless)
    each = np.logaddexp(there, none) - np.logaddexp(here, none)
    # They see the same surfaces: together they say no more of these than the one that sees most.
    most = np.abs(each).max(axis=0, initial=0.0)
    return np.asarray(np.clip(of_fallible(each, RegistrationConfig.useless).sum(axis=0), -most, most))


def _difference(pose: Floats, mean: Floats) -> Floats:
    off = pose - mean
    off[:, 2] = se2.wrap_angle(off[:, 2])
    return off


def _volume(prior: Gaussian, information: Floats) -> Floats:
    """Return the log (e,) of a prior's volume by that with further information (e, 3, 3)."""
    return np.asarray(np.linalg.slogdet(np.eye(information.shape[-1]) + prior.covariance @ information)[1])


def _solved(matrix: Floats, vector: Floats) -> Floats:
    """Return the solutions (e, 3) of symmetric systems (e, 3, 3)."""
    return np.asarray(np.linalg.solve(matrix, vector[..., None])[..., 0])
