"""Scan-to-scan matching: the step from every keyframe to the next, measured by their clouds.

Neighbouring clouds are aligned from the odometry's guess, all at once; that shows the calibration and the noise of the wheels.
Each step is registered with the possibility that the wheels slipped or a message of the odometry was lost. A slip lasts: the
evidence of all steps together decides (see slips).
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from scipy.special import chdtri, logit

from .. import se2
from ..arrays import OUTLIER, Bools, Floats, Ints
from ..graph.graph import Graph
from ..graph.pose_edges import OdometryEdges, RelativePoseEdges
from ..odometry.slips import covariance_of, lost_sigma, posterior, spin_sigma, with_slips
from ..odometry.wheels import by_stamps, reestimate_wheel_noise, stamp_jitter
from .cloud_rasters import CloudRasters
from .clouds import Clouds
from .object_likelihood import ObjectLikelihood
from .registration import (
    Gaussian,
    Placed,
    Placement,
    Prior,
    RegistrationConfig,
    descend,
    odds_by_views,
    of_fallible,
    register,
    search,
    with_neighbours,
)
from .scan_matching import SINGULAR, CloudPairs, PairPolicy, align_pairs, match, measured, pairs_of, squared_distance


@dataclass(frozen=True, slots=True)
class TrackingConfig:
    """Matching of each cloud with its neighbours in time."""

    on: bool = True
    """Match each cloud with those before and after it; off = only wheels and radio shape the sub-maps (the paper)."""
    sigma: ClassVar[float] = 0.02
    """Standard deviation of a match that clouds cannot fall below, m: walls are no straighter."""
    median: ClassVar[float] = float(chdtri(*se2.POSE, 0.5))
    """Of chi2 with three degrees of freedom."""
    laps: ClassVar[int] = 3
    """Times that steps with slips tell their neighbours."""
    lost: ClassVar[float] = 1e-3
    """Probability that a message of the odometry is lost over a step, or the robot carried."""
    views: ClassVar[int] = 6
    """Clouds before a doubtful step with which the one after it is compared: they still see the same."""


@dataclass(frozen=True, slots=True, eq=False)
class ScanOdometry:
    """Steps between neighbouring keyframes."""

    steps: RelativePoseEdges
    """Those that were measured."""
    wheels: OdometryEdges
    """With the noise learnt from the measured steps, as if they had not slipped."""
    slipped: OdometryEdges
    """The same with the uncertainty of slips."""
    miss: float
    """Typical error that the odometry causes in points of the next cloud, 3 sigma, m."""
    searched: int
    """Number of steps that were searched for."""
    slips: Floats
    """(e,) probability that the wheels slipped over each."""
    rejected: Bools
    """(e,) steps that contradict the wheels although the clouds are likelier as the wheels count; not among the measured."""


@dataclass(frozen=True, slots=True, eq=False)
class Steps:
    """Steps between neighbouring keyframes after descent from a guess."""

    i: Ints
    """(e,) keyframes at which they begin, increasing."""
    guess: Floats
    """(e, 3)."""
    pose: Floats
    """(e, 3) where descent ended."""
    share: Floats
    """(e,) share of the points looked up that match there."""
    enough: Bools
    """(e,) whether the clouds have enough points to measure a step."""

    def contradicted(self) -> Bools:
        """Return which steps (e,) the clouds contradict: few points match, or they fit at another pose."""
        off = se2.between(self.guess, self.pose)
        elsewhere = (np.hypot(off[:, 0], off[:, 1]) > PairPolicy.gate) | (np.abs(off[:, 2]) > PairPolicy.gate)
        return self.enough & ((self.share < PairPolicy.good_share) | elsewhere)

    def pairs(self, keyframes: slice, most: int) -> tuple[Ints, Ints, Floats]:
        """Return keyframes i, j (p,), 1, 2, 4, ... apart, up to `most`, between which all steps match, and T_i_j (p, 3)."""
        T_i_j, apart = np.full((keyframes.stop, *se2.POSE), np.nan), 1
        good = self.enough & (self.share >= PairPolicy.good_share) & (self.i >= keyframes.start) & (self.i < keyframes.stop)
        T_i_j[self.i[good]] = self.pose[good]
        found = []
        while apart <= most:
            known = np.flatnonzero(np.isfinite(T_i_j[:, 0]))
            found.append((known, known + apart, T_i_j[known]))
            T_i_j = se2.compose(T_i_j[:-apart], T_i_j[apart:])
            apart *= 2
        i, j, pose = (np.concatenate(of) for of in zip(*found, strict=True))
        order = np.argsort(i, kind="stable")
        return i[order], j[order], pose[order]


def match_plainly(raster: CloudRasters, i: Ints, guess: Floats, gate: float) -> Steps:
    """Measure the steps from keyframes i (e,) to the next by their clouds, each from its guess (e, 3), within a gate, m."""
    aligned = align_pairs(raster, pairs_of(raster.clouds, i, i + 1), guess, gate, min(PairPolicy.gate, gate))
    return Steps(i, guess, aligned.pose, aligned.share, aligned.factors.asked >= PairPolicy.fewest)


def descended_edges(raster: CloudRasters, steps: Steps) -> RelativePoseEdges:
    """Return the steps that descent measured, without a search, as edges."""
    shown = steps.enough & (steps.share >= RegistrationConfig.least_share)
    return _edges(raster, steps.i[shown], steps.pose[shown])[0]


def follow(raster: CloudRasters, wheels: OdometryEdges, graph: Graph, steps: Steps) -> ScanOdometry:
    """Turn steps between neighbouring keyframes into edges: near what the wheels count, unless these slipped.

    Parameters
    ----------
    wheels : edges between neighbouring keyframes; slips that ranges show, or longer steps that were cut into these, weigh as
        much as what one pair of clouds shows.
    graph : holds their calibration. steps : the same steps after descent, see match_plainly.
    """
    i, good = wheels.i, steps.enough & (steps.share >= PairPolicy.good_share)
    certain, sigma = _edges(raster, i[good], steps.pose[good])
    noise = replace(reestimate_wheel_noise(wheels, certain, graph), slips=None)
    pairs, mean = pairs_of(raster.clouds, i, i + 1), noise.corrected(graph)
    objects = ObjectLikelihood.of(raster, sigma, pairs, mean)
    objects = objects.learnt(pairs.rows(steps.enough), steps.pose[steps.enough])
    covariance = covariance_of(noise, graph) + by_stamps(noise, graph, stamp_jitter(wheels, certain, graph))
    prior = Prior.about(mean, covariance, spin_sigma(noise), lost_sigma(noise))
    found = register(objects, pairs, prior, steps.pose)
    # Where ranges are few, the path follows the wheels: that no slip shows there is no evidence against one.
    by_others = 0.0 if wheels.slips is None else of_fallible(np.maximum(logit(wheels.slips), 0.0), RegistrationConfig.useless)
    alone, motions = found.log_odds(), found.false_motions()
    # A long slip of a little per step is likelier than none only as a whole.
    chain = posterior(np.zeros(len(wheels)), wheels.duration)
    for _ in range(TrackingConfig.laps):
        expected = motions.by_neighbours(chain, wheels.duration)
        log_odds = found.log_odds(motions.log_marginal(expected))
        chain = posterior(log_odds + by_others, wheels.duration)
    found = with_neighbours(objects, pairs, found, expected)
    # Where neighbours share few points, or a slip is possible, clouds some steps before say where they lie.
    doubtful = steps.enough & (~good | (chain.probability > RegistrationConfig.doubtful))
    rest = np.clip(logit(np.clip(chain.probability, SINGULAR, 1.0 - SINGULAR)) - log_odds, -np.inf, 0.0)
    found, choice = _decided(objects, pairs, found, steps.pose, np.flatnonzero(doubtful), rest)
    alone[doubtful] = log_odds[doubtful] = choice.log_odds
    slips = posterior(log_odds + by_others, wheels.duration).probability
    slipped = with_slips(noise, slips)
    variance, sound, mode = sigma**2 * PairPolicy.correlation, found.likeliest(prior.sound)[0], choice.placed
    # What captures matching, a crowd or the ground before a robot that tilts, is less likely than where the wheels count it.
    tempting = found.candidates.rows(found.best(found.candidates.share))
    captured = np.flatnonzero(doubtful & ~choice.elsewhere & (tempting.share > sound.share))
    own = np.flatnonzero(~doubtful[np.searchsorted(i, certain.i)])
    matched = certain.rows(own).followed_by(_as_edges(i, tempting, captured, variance))
    rejected = _contradicted(matched, noise.i, prior.sound) & ~choice.elsewhere & (~good | (alone < 0.0))
    own = own[~rejected[np.searchsorted(i, certain.i[own])]]
    edges = certain.rows(own).followed_by(_as_edges(i, mode, np.flatnonzero(doubtful & mode.shown & ~rejected), variance))
    edges = edges.rows(np.argsort(edges.i))
    miss = _miss(raster.clouds, noise)
    return ScanOdometry(
        edges, noise, slipped, float(np.median(miss)) if len(miss) else 0.0, len(found.searched), slips, rejected,
    )


def _contradicted(edges: RelativePoseEdges, first: Ints, wheels: Gaussian) -> Bools:
    """Return over which steps (e,) of wheels, from keyframes first (e,), measured edges contradict them, in the directions that
    these measure."""
    own, turn = np.searchsorted(first, edges.i), se2.rotation(edges.T_i_j[:, 2])
    by_wheels = np.swapaxes(turn, 1, 2) @ wheels.covariance[own] @ turn
    squared = squared_distance(se2.between(edges.T_i_j, wheels.mean[own]), by_wheels, edges.sqrt_information)
    # Single steps also hold the errors that telescope, which the wheels' noise leaves out.
    usual = max(float(np.median(squared)) / TrackingConfig.median, 1.0) if len(squared) else 1.0
    contradicted = np.zeros(len(first), dtype=bool)
    contradicted[own[squared > usual * RegistrationConfig.contradicts]] = True
    return contradicted


def _as_edges(first: Ints, placed: Placed, rows: Ints, variance: float) -> RelativePoseEdges:
    """Return some steps (r,) from keyframes first (e,) as what their matches measure."""
    return RelativePoseEdges(first[rows], first[rows] + 1, *placed.rows(rows).measured(variance))


@dataclass(frozen=True, slots=True, eq=False)
class _Choice:
    """The likeliest places of e steps."""

    placed: Placed
    """(e)."""
    elsewhere: Bools
    """(e,) whether the wheels slipped or a message was lost."""
    log_odds: Floats
    """(r,) of slips over doubtful steps, by what their clouds show."""


def _decided(
    objects: ObjectLikelihood, pairs: CloudPairs, found: Placement, near: Floats, rows: Ints, slips: Floats
) -> tuple[Placement, _Choice]:
    """Return candidates, with those of doubtful steps (r,) completed, and the likeliest of all steps (e,)."""
    parts = found.prior.sound, found.prior.slipped, found.prior.lost
    found = found.followed_by(rows, descend(objects, pairs.rows(rows), near[rows], parts[-1].rows(rows)))
    chain, choice, log_odds = found.sound.pose.copy(), np.arange(len(near)), np.zeros(len(rows))
    moved, tied = np.zeros(len(near), dtype=bool), np.ones(len(near), dtype=bool)
    odds = np.stack([slips, np.full(len(near), np.log(TrackingConfig.lost))])
    for number, row in enumerate(rows.tolist()):
        own = np.flatnonzero(found.pair == row)
        seen = _seen(objects, pairs, chain, tied, row, found.candidates.pose[own])
        if found.candidates.share[own].max() < RegistrationConfig.least_share and np.median(seen[:, 0]) <= 0.0:
            one = np.array([row])
            found = found.followed_by(one, search(objects, pairs.rows(one), parts[-1].rows(one)))
            own = np.append(own, len(found.pair) - 1)
            seen = np.hstack([seen, _seen(objects, pairs, chain, tied, row, found.candidates.pose[own[-1:]])])
        some, same = found.candidates.rows(own), np.full(len(own), row)
        sound, *others = (seen + some.log_prior(each.rows(same)) for each in parts)
        score = np.stack([odds_by_views(sound.max(axis=1, keepdims=True), each) for each in others])
        log_odds[number] = score[0].max()
        score += odds[:, row, None]
        best = int(np.argmax(score.max(axis=0)))
        moved[row] = score[:, best].max() > 0.0
        best = best if moved[row] else int(np.argmax(sound[0]))
        choice[row], chain[row] = own[best], some.pose[best]
        tied[row] = found.candidates.rows(choice[row : row + 1]).shown[0]
    return found, _Choice(found.candidates.rows(choice), moved, log_odds)


def _seen(objects: ObjectLikelihood, pairs: CloudPairs, chain: Floats, tied: Bools, row: int, poses: Floats) -> Floats:
    """Return the log likelihood (v, n) of the cloud at the end of a step, which is one of poses (n, 3), in those before it."""
    at, placed = [], poses
    for back in range(min(TrackingConfig.views, row + 1)):
        if pairs.i[row - back] != pairs.i[row] - back or (back and not tied[row - back]):
            break
        placed = se2.compose(chain[row - back], placed) if back else placed
        at.append(placed)
    compared = pairs.rows(np.full(len(at) * len(poses), row))
    compared = replace(compared, i=pairs.i[row] - np.repeat(np.arange(len(at)), len(poses)))
    return objects.log_likelihood(compared, np.concatenate(at)).reshape(len(at), len(poses))


def _miss(clouds: Clouds, wheels: OdometryEdges) -> Floats:
    """Return the error (e,) that the odometry may cause in points of the next cloud, 3 sigma, m."""
    sigma = 1.0 / np.einsum("eii->ei", wheels.sqrt_information)
    reach = np.hypot(clouds.points[:, 0], clouds.points[:, 1])
    arm = float(np.quantile(reach, PairPolicy.good_share)) if len(reach) else 0.0
    return OUTLIER * (sigma[:, 0] + sigma[:, 2] * arm)


def _edges(raster: CloudRasters, i: Ints, step: Floats) -> tuple[RelativePoseEdges, float]:
    """Return the steps (e, 3) from keyframes i to i + 1 as edges with the information of their matches, and the standard
    deviation of a match, m."""
    factors = match(raster, pairs_of(raster.clouds, i, i + 1), step, PairPolicy.gate, PairPolicy.gate / 2.0)
    sigma = max(float(np.sqrt(factors.variance)), TrackingConfig.sigma)
    z, sqrt_information = measured(factors, step, np.full(len(i), sigma**2 * PairPolicy.correlation))
    return RelativePoseEdges(i, i + 1, z, sqrt_information), sigma
