"""Scan-to-scan matching: the step from every keyframe to the next, measured by their clouds.

Neighbouring clouds are aligned from the odometry's guess, all at once; that shows the calibration and the noise of the wheels.
Each step is registered with the possibility that the wheels slipped, and where few points match, that a message of the odometry
was lost. A slip lasts: the evidence of all steps together decides (see slips). A lost message shows in clouds before it, too.
Where the wheels slipped, their edges get the uncertainty of that, and the step is the one that the clouds show.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from scipy.special import logit

from .. import se2
from ..arrays import Bools, Floats, Ints
from ..graph.graph import Graph
from ..graph.pose_edges import OdometryEdges, RelativePoseEdges
from ..odometry.slips import covariance_of, lost_sigma, posterior, slip_sigma, with_slips
from ..odometry.wheels import reestimate_wheel_noise
from .cloud_rasters import CloudRasters
from .clouds import Clouds
from .object_likelihood import CloudPairs, ObjectLikelihood, ObjectPolicy, pairs_of
from .pair_alignment import align_pairs
from .registration import (
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
from .scan_matching import match, measured, pair_points


@dataclass(frozen=True, slots=True)
class TrackingConfig:
    """Matching of each cloud with its neighbours in time."""

    on: bool = True
    """Match each cloud with those before and after it; off = only wheels and radio shape the sub-maps (the paper)."""
    min_points: ClassVar[int] = 30
    """Clouds with fewer points with a normal measure nothing."""
    sigma: ClassVar[float] = 0.03
    """Standard deviation of a match where no step shows it, m."""
    least_sigma: ClassVar[float] = 0.02
    """Standard deviation of a match that clouds cannot fall below, m: walls are no straighter."""
    median: ClassVar[float] = 2.366
    """Of chi2 with three degrees of freedom."""
    contradicts: ClassVar[float] = 16.266
    """What one step in a thousand exceeds by chance, of such a chi2."""
    elsewhere: ClassVar[float] = 0.12
    """m or rad; an error that a step of faultless odometry never has."""
    laps: ClassVar[int] = 3
    """Times that steps with slips tell their neighbours."""
    lost: ClassVar[float] = 1e-3
    """Probability that a message of the odometry is lost over a step, or the robot carried."""
    views: ClassVar[int] = 6
    """Clouds before a doubtful step with which the one after it is compared: they still see the same."""
    doubtful: ClassVar[float] = 0.02
    """Probability of a slip from which on a step is doubtful."""
    steps_back: ClassVar[int] = 4
    """Steps over which objects that move are sought: a second or two."""
    longest_run: ClassVar[int] = 3
    """Most consecutive keyframes that are placed between well matched ones."""


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
    moving: Bools
    """(p,) points of the clouds that belong to objects that moved by themselves."""
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
        elsewhere = (np.hypot(off[:, 0], off[:, 1]) > TrackingConfig.elsewhere) | (np.abs(off[:, 2]) > TrackingConfig.elsewhere)
        return self.enough & ((self.share < RegistrationConfig.good_share) | elsewhere)


def match_plainly(clouds: Clouds, raster: CloudRasters, i: Ints, guess: Floats, gate: float) -> Steps:
    """Measure the steps from keyframes i (e,) to the next by their clouds, each from its guess (e, 3).

    Parameters
    ----------
    clouds, raster : see clouds.build and cloud_rasters.rasterize. gate : reach of the raster, m.
    """
    points = pair_points(clouds, i + 1, ObjectPolicy.points)
    aligned = align_pairs(clouds, raster, i, guess, points, gate, min(ObjectPolicy.gate, gate))
    return Steps(i, guess, aligned.pose, aligned.share, aligned.factors.asked >= TrackingConfig.min_points)


def descended_edges(clouds: Clouds, raster: CloudRasters, steps: Steps) -> RelativePoseEdges:
    """Return the steps that descent measured, without a search, as edges."""
    shown = steps.enough & (steps.share >= RegistrationConfig.least_share)
    return _edges(clouds, raster, steps.i[shown], steps.pose[shown], ObjectPolicy.gate)[0]


def follow(
    clouds: Clouds, raster: CloudRasters, wheels: OdometryEdges, graph: Graph, steps: Steps
) -> ScanOdometry:
    """Turn steps between neighbouring keyframes into edges: near what the wheels count, unless these slipped.

    Parameters
    ----------
    clouds, raster : see clouds.build and cloud_rasters.rasterize.
    wheels : edges between neighbouring keyframes; what is no scan and shows slips weighs as much as one pair of clouds.
    graph : holds their calibration. steps : the same steps after descent, see descend.
    """
    i, good = wheels.i, steps.enough & (steps.share >= RegistrationConfig.good_share)
    certain, sigma = _edges(clouds, raster, i[good], steps.pose[good], ObjectPolicy.gate)
    noise = replace(reestimate_wheel_noise(wheels, certain, graph), slips=None)
    pairs, mean = pairs_of(clouds, i, i + 1), noise.corrected(graph)
    objects = ObjectLikelihood.of(clouds, raster, sigma, pairs, mean)
    objects = objects.learnt(pairs.rows(steps.enough), steps.pose[steps.enough])
    prior = Prior.about(mean, covariance_of(noise, graph), slip_sigma(noise), lost_sigma(noise))
    found = register(objects, pairs, prior, steps.pose)
    # Where ranges are few, the path follows the wheels: that no slip shows there is no evidence against one.
    by_ranges = 0.0 if wheels.slips is None else of_fallible(np.maximum(logit(wheels.slips), 0.0), RegistrationConfig.useless)
    log_odds, motions = found.log_odds(), found.false_motions()
    chain = posterior(log_odds + by_ranges, wheels.duration)
    for _ in range(TrackingConfig.laps):
        expected = motions.by_neighbours(chain, wheels.duration)
        log_odds = found.log_odds(motions.log_marginal(expected))
        chain = posterior(log_odds + by_ranges, wheels.duration)
    found = with_neighbours(objects, pairs, found, expected)
    # Where neighbours share few points, or a slip is possible, clouds some steps before say where they lie.
    doubtful = steps.enough & (~good | (chain.probability > TrackingConfig.doubtful))
    rest = np.clip(logit(np.clip(chain.probability, 1e-9, 1.0 - 1e-9)) - log_odds, -np.inf, 0.0)
    found, choice = _decided(objects, pairs, found, steps.pose, np.flatnonzero(doubtful), rest)
    log_odds[doubtful] = choice.log_odds
    slips = posterior(log_odds + by_ranges, wheels.duration).probability
    variance, sound, mode = sigma**2 * ObjectPolicy.correlation, found.sound, choice.placed
    # What captures matching, a crowd or the ground before a robot that tilts, is less likely than where the wheels count it.
    tempting = found.candidates.rows(found.best(found.candidates.share))
    captured = np.flatnonzero(doubtful & ~choice.elsewhere & (tempting.share > sound.share))
    own = np.flatnonzero(~doubtful[np.searchsorted(i, certain.i)])
    matched = certain.rows(own).followed_by(_as_edges(i, tempting, captured, variance))
    rejected = _contradicted(matched, noise, graph) & ~choice.elsewhere & (~good | (log_odds < 0.0))
    own = own[~rejected[np.searchsorted(i, certain.i[own])]]
    edges = certain.rows(own).followed_by(_as_edges(i, mode, np.flatnonzero(doubtful & _shown(mode) & ~rejected), variance))
    edges = edges.rows(np.argsort(edges.i))
    miss = _miss(clouds, noise)
    return ScanOdometry(
        edges, noise, with_slips(noise, slips), float(np.median(miss)) if len(miss) else 0.0, len(found.searched), slips,
        _moving(objects, i, mode, choice.covariance), rejected,
    )


def _contradicted(edges: RelativePoseEdges, wheels: OdometryEdges, graph: Graph) -> Bools:
    """Return over which steps (e,) of the odometry measured edges contradict it, in the directions that these measure."""
    own = np.searchsorted(wheels.i, edges.i)
    information = np.swapaxes(edges.sqrt_information, 1, 2) @ edges.sqrt_information
    covariance = np.linalg.pinv(information, rcond=1e-9, hermitian=True)
    onto, turn = covariance @ information, se2.rotation(edges.T_i_j[:, 2])
    off = np.einsum("eij,ej->ei", onto, se2.between(edges.T_i_j, wheels.corrected(graph)[own]))
    by_wheels = np.swapaxes(turn, 1, 2) @ covariance_of(wheels, graph)[own] @ turn
    joint = onto @ by_wheels @ np.swapaxes(onto, 1, 2) + covariance
    squared = np.einsum("ei,eij,ej->e", off, np.linalg.pinv(joint, rcond=1e-9, hermitian=True), off)
    # Single steps also hold the errors that telescope, which the wheels' noise leaves out.
    usual = max(float(np.median(squared)) / TrackingConfig.median, 1.0) if len(squared) else 1.0
    contradicted = np.zeros(len(wheels), dtype=bool)
    contradicted[own[squared > usual * TrackingConfig.contradicts]] = True
    return contradicted


def _as_edges(first: Ints, placed: Placed, rows: Ints, variance: float) -> RelativePoseEdges:
    """Return some steps (r,) from keyframes first (e,) as what their matches measure."""
    return RelativePoseEdges(first[rows], first[rows] + 1, *placed.rows(rows).measured(variance))


def _shown(placed: Placed) -> Bools:
    """Return which clouds (e,) are likelier to lie there than in space that nobody has seen."""
    return np.asarray(placed.shown & (placed.likelihood > 0.0))


@dataclass(frozen=True, slots=True, eq=False)
class _Choice:
    """The likeliest places of e steps."""

    placed: Placed
    """(e)."""
    elsewhere: Bools
    """(e,) whether the wheels slipped or a message was lost."""
    covariance: Floats
    """(e, 3, 3) of the poses by matches and prior."""
    log_odds: Floats
    """(r,) of slips over doubtful steps, by what their clouds show."""


def _decided(
    objects: ObjectLikelihood, pairs: CloudPairs, found: Placement, near: Floats, rows: Ints, slips: Floats
) -> tuple[Placement, _Choice]:
    """Return candidates, with those of doubtful steps (r,) completed, and the likeliest of all steps (e,).

    One pair of clouds does not tell. The best of many places fits some surface by chance, and then in all pairs: so each pair
    must outweigh the prior by itself, and counts as far as one can be trusted.

    Parameters
    ----------
    near : (e, 3) where plain matching ended. slips : (e,) log odds of slips without the clouds of a step.
    """
    parts = found.prior.sound, found.prior.slipped, found.prior.lost
    found = found.followed_by(rows, descend(objects, pairs.rows(rows), near[rows], parts[-1].rows(rows)))
    chain, choice, log_odds = found.sound.pose.copy(), np.arange(len(near)), np.zeros(len(rows))
    part, tied = np.zeros(len(near), dtype=np.intp), np.ones(len(near), dtype=bool)
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
        which, best = np.unravel_index(np.argmax(score), score.shape)
        if score[which, best] > 0.0:
            part[row], choice[row] = 1 + which, own[best]
            chain[row] = some.pose[best]
        tied[row] = _shown(found.candidates.rows(choice[row : row + 1]))[0]
    placed = found.candidates.rows(choice)
    covariances = np.stack([placed.covariance(each) for each in parts])
    return found, _Choice(placed, part > 0, covariances[part, np.arange(len(part))], log_odds)


def _seen(objects: ObjectLikelihood, pairs: CloudPairs, chain: Floats, tied: Bools, row: int, poses: Floats) -> Floats:
    """Return the log likelihood (v, n) of the cloud at the end of a step, which is one of poses (n, 3), in those before it.

    Parameters
    ----------
    chain, tied : (e, 3), (e,) the steps, and whether the place of each is known.
    """
    at, placed = [], poses
    for back in range(min(TrackingConfig.views, row + 1)):
        if pairs.i[row - back] != pairs.i[row] - back or (back and not tied[row - back]):
            break
        placed = se2.compose(chain[row - back], placed) if back else placed
        at.append(placed)
    compared = pairs.rows(np.full(len(at) * len(poses), row))
    compared = replace(compared, i=pairs.i[row] - np.repeat(np.arange(len(at)), len(poses)))
    return objects.log_likelihood(compared, np.concatenate(at)).reshape(len(at), len(poses))


def _moving(objects: ObjectLikelihood, first: Ints, placed: Placed, spread: Floats) -> Bools:
    """Return which points (p,) belong to objects that moved since the keyframe before, or one some steps before.

    What moves slowly shows over several steps only; the uncertainty of a chain grows with their number, by (e, 3, 3) each.
    """
    i, j, pose, covariance = first, first + 1, placed.pose, spread
    moves = np.zeros(len(objects.clouds.points), dtype=bool)
    for _ in range(TrackingConfig.steps_back):
        moves |= objects.moving(pairs_of(objects.clouds, i, j), pose, covariance)
        after = np.flatnonzero(np.isin(j, first))
        follows = np.searchsorted(first, j[after])
        turn = se2.rotation(pose[after, 2])
        covariance = covariance[after] + turn @ spread[follows] @ np.swapaxes(turn, 1, 2)
        i, j, pose = i[after], j[after] + 1, se2.compose(pose[after], placed.pose[follows])
    return moves


def reattached(
    clouds: Clouds, raster: CloudRasters, poses: Floats, stamps: Floats, tied: Bools, gate: float
) -> tuple[Floats, Ints]:
    """Place keyframes that match none of their neighbours between these, where their clouds fit there.

    A step may be wrong although its two clouds match; the keyframe after it then fits the one before it, and a single
    keyframe that matches neither is misplaced.

    Parameters
    ----------
    poses, stamps : (k, 3) and (k,) s. tied : (k,) keyframes that match a neighbour. gate : reach of the raster, m.

    Returns
    -------
    Poses (k, 3), and the keyframes (r,) that were placed again.
    """
    lone = np.flatnonzero(~tied & (_lines_of(clouds) >= TrackingConfig.min_points))
    sound = np.flatnonzero(tied)
    place = np.searchsorted(sound, lone)
    inner = (place > 0) & (place < len(sound))
    lone, before, after = lone[inner], sound[place[inner] - 1], sound[place[inner]]
    near = after - before <= TrackingConfig.longest_run + 1
    lone, before, after = lone[near], before[near], after[near]
    share = (stamps[lone] - stamps[before]) / np.maximum(stamps[after] - stamps[before], 1e-9)
    guess = se2.between(poses[before], se2.interpolate(poses[before], poses[after], share))
    points, tight = pair_points(clouds, lone, ObjectPolicy.points), min(ObjectPolicy.gate, gate)
    aligned = align_pairs(clouds, raster, before, guess, points, gate, tight)
    fits = aligned.share >= RegistrationConfig.good_share
    found, laid = poses.copy(), lone[fits]
    found[laid] = se2.compose(poses[before[fits]], aligned.pose[fits])
    return found, laid


def _lines_of(clouds: Clouds) -> Ints:
    """Return the number (k,) of points with a normal of each cloud."""
    return np.bincount(clouds.owner[np.any(clouds.normals != 0.0, axis=1)], minlength=len(clouds))


def _miss(clouds: Clouds, wheels: OdometryEdges) -> Floats:
    """Return the error (e,) that the odometry may cause in points of the next cloud, 3 sigma, m."""
    sigma = 1.0 / np.einsum("eii->ei", wheels.sqrt_information)
    reach = np.hypot(clouds.points[:, 0], clouds.points[:, 1])
    arm = float(np.quantile(reach, 0.75)) if len(reach) else 0.0
    return 3.0 * (sigma[:, 0] + sigma[:, 2] * arm)


def _edges(
    clouds: Clouds, raster: CloudRasters, i: Ints, step: Floats, gate: float
) -> tuple[RelativePoseEdges, float]:
    """Return the steps (e, 3) from keyframes i to i + 1 as edges with the information of their matches, and the standard
    deviation of a match, m."""
    factors = match(clouds, raster, i, step, pair_points(clouds, i + 1, ObjectPolicy.points), gate, gate / 2.0)
    sigma = float(np.sqrt(factors.squared.sum() / max(factors.weight.sum(), 1.0))) if len(i) else TrackingConfig.sigma
    sigma = max(sigma, TrackingConfig.least_sigma)
    z, sqrt_information = measured(factors, step, np.full(len(i), sigma**2 * ObjectPolicy.correlation))
    return RelativePoseEdges(i, i + 1, z, sqrt_information), sigma
