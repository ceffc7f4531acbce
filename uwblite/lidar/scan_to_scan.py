"""Scan-to-scan matching: the step from every keyframe to the next, measured by their clouds.

Neighbouring clouds are aligned from the odometry's guess, all at once; that shows the calibration and the noise of the wheels.
A pair that then shares few points is searched for in the local sub-map of the keyframes before. Each step is also registered
with the possibility that the wheels slipped. A slip lasts: the evidence of all steps together decides (see slips). Where the
wheels slipped, their edges get the uncertainty of that, and the step is the one that the clouds show.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from scipy.special import logit

from .. import se2
from ..arrays import Bools, Floats, Ints
from ..graph.graph import Graph
from ..graph.pose_edges import OdometryEdges, RelativePoseEdges
from ..odometry.slips import covariance_of, posterior, slip_sigma, with_slips
from ..odometry.wheels import reestimate_wheel_noise, with_uncounted_ways
from .cloud_rasters import CloudRasters
from .clouds import Clouds
from .object_likelihood import ObjectLikelihood, matched_by_chance
from .pair_alignment import align_pairs
from .registration import Placed, Prior, Registration, RegistrationConfig, of_fallible
from .scan_matching import PairPoints, match, measured, pair_points
from .step_search import StepSearch
from .visibility import nearest_by_bearing


@dataclass(frozen=True, slots=True)
class TrackingConfig:
    """Matching of each cloud with its neighbours in time."""

    on: bool = True
    """Match each cloud with those before and after it; off = only wheels and radio shape the sub-maps (the paper)."""
    good_share: ClassVar[float] = 0.75
    """Neighbours that share at least this part of their points are certain of their step, wherever the odometry put it."""
    distance: float = 0.4
    """Half-width of the search beyond twice the motion by the odometry, m: wheels may count backwards as forwards."""
    angle: float = 0.45
    """Half-width of the search in heading beyond half the turn by the odometry, rad."""
    gate: ClassVar[float] = 0.15
    """Farthest match at the end, m."""
    points: ClassVar[int] = 150
    """Points looked up per step."""
    min_points: ClassVar[int] = 30
    """Clouds with fewer points with a normal measure nothing."""
    sigma: ClassVar[float] = 0.03
    """Standard deviation of a match, m."""
    correlation: ClassVar[float] = 8.0
    """Matches that together weigh as one."""
    laps: ClassVar[int] = 3
    """Times that steps with slips tell their neighbours."""


@dataclass(frozen=True, slots=True, eq=False)
class ScanOdometry:
    """Steps between neighbouring keyframes."""

    steps: RelativePoseEdges
    """Those that were measured, as wheels that do not slip allow."""
    with_slips: RelativePoseEdges
    """The same, with those over which the wheels slipped where their clouds lie."""
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

    def contradicted(self, config: TrackingConfig) -> Bools:
        """Return which steps (e,) the clouds contradict: few points match, or they fit at another pose."""
        off = se2.between(self.guess, self.pose)
        elsewhere = (np.hypot(off[:, 0], off[:, 1]) > _ELSEWHERE) | (np.abs(off[:, 2]) > _ELSEWHERE)
        return self.enough & ((self.share < config.good_share) | elsewhere)


_ELSEWHERE = 0.12
"""m or rad; an error that a step of faultless odometry never has."""


def descend(clouds: Clouds, raster: CloudRasters, i: Ints, guess: Floats, gate: float, config: TrackingConfig) -> Steps:
    """Measure the steps from keyframes i (e,) to the next by their clouds, each from its guess (e, 3).

    Parameters
    ----------
    clouds, raster : see clouds.build and cloud_rasters.rasterize. gate : reach of the raster, m.
    """
    points = pair_points(clouds, i + 1, config.points)
    aligned = align_pairs(clouds, raster, i, guess, points, gate, min(config.gate, gate))
    return Steps(i, guess, aligned.pose, aligned.share, aligned.factors.asked >= config.min_points)


def descended_edges(clouds: Clouds, raster: CloudRasters, steps: Steps, config: TrackingConfig) -> RelativePoseEdges:
    """Return the steps that descent measured, without a search, as edges."""
    shown = steps.enough & (steps.share >= _LEAST_SHARE)
    return _edges(clouds, raster, steps.i[shown], steps.pose[shown], config.gate, config)[0]


def follow(
    clouds: Clouds, raster: CloudRasters, wheels: OdometryEdges, graph: Graph, steps: Steps, config: TrackingConfig
) -> ScanOdometry:
    """Turn steps between neighbouring keyframes into edges: near what the wheels count, unless these slipped.

    Parameters
    ----------
    clouds, raster : see clouds.build and cloud_rasters.rasterize.
    wheels : edges between neighbouring keyframes; what is no scan and shows slips weighs as much as one pair of clouds.
    graph : holds their calibration. steps : the same steps after descent, see descend.
    """
    i, tight = wheels.i, config.gate
    good = steps.enough & (steps.share >= config.good_share)
    certain, sigma = _edges(clouds, raster, i[good], steps.pose[good], tight, config)
    noise = replace(reestimate_wheel_noise(wheels, certain, graph), slips=None)
    points, mean = pair_points(clouds, i + 1, config.points), noise.corrected(graph)
    chance = matched_by_chance(clouds, raster, i, points, mean)
    registration = Registration(clouds, raster, nearest_by_bearing(clouds), sigma, chance)
    registration.objects.learn_moves(i[steps.enough], PairPoints(points.row[steps.enough]), steps.pose[steps.enough])
    usual = covariance_of(noise, graph)
    prior = Prior(mean, usual, usual + slip_sigma(noise)[:, :, None] ** 2 * np.eye(3))
    found = registration.register(i, i + 1, points, prior, steps.pose)
    # Where ranges are few, the path follows the wheels: that no slip shows there is no evidence against one.
    prior_odds = 0.0 if wheels.slips is None else of_fallible(np.maximum(logit(wheels.slips), 0.0), RegistrationConfig.useless)
    log_odds, motions = found.log_odds(), found.false_motions(prior, sigma**2)
    chain = posterior(log_odds + prior_odds, wheels.duration)
    for _ in range(TrackingConfig.laps):
        expected = motions.by_neighbours(chain, wheels.duration)
        chain = posterior(found.log_odds(motions.log_marginal(expected)) + prior_odds, wheels.duration)
    slips = chain.probability
    found = registration.placed_again(i, points, found, prior, expected)
    placed = found.chosen(slips)
    edges, searched = _measured_near(clouds, raster, steps, certain, tight, config)
    # What the clouds show, a crowd or the ground before a robot that tilts, is likelier where the wheels count it.
    rejected = _contradicted(edges, noise, graph) & (log_odds < 0.0)
    edges = edges.rows(np.flatnonzero(~rejected[np.searchsorted(i, edges.i)]))
    learnt = with_uncounted_ways(noise, edges, graph)
    lasting = (slips > 0.5) & (placed.factors.matched >= _FEWEST)
    lasting &= placed.evidence > np.log(RegistrationConfig.useless)
    seen, others = np.flatnonzero(lasting), ~np.isin(edges.i, i[slips > 0.5])
    slid = RelativePoseEdges(i[seen], i[seen] + 1, *placed.rows(seen).measured(sigma**2 * config.correlation))
    both = edges.rows(np.flatnonzero(others)).followed_by(slid)
    miss, moving = _miss(clouds, noise), _moving(registration.objects, clouds, i, placed, config)
    return ScanOdometry(
        edges, both.rows(np.argsort(both.i)), learnt, with_slips(learnt, slips),
        float(np.median(miss)) if len(miss) else 0.0, searched, slips, moving, rejected,
    )


def _measured_near(
    clouds: Clouds, raster: CloudRasters, steps: Steps, certain: RelativePoseEdges, gate: float, config: TrackingConfig
) -> tuple[RelativePoseEdges, int]:
    """Return the steps as wheels that do not slip allow, and how many were searched.

    Neighbours that share few points are searched for in the local sub-map of the keyframes before; where that finds nothing, or
    two equally good places, the step is left to the odometry.
    """
    good = steps.enough & (steps.share >= config.good_share)
    pose, lost, searched = _searched(clouds, steps.i, steps, steps.enough & ~good, config)
    further = steps.enough & ~lost & ~good
    measured_steps = certain.followed_by(_edges(clouds, raster, steps.i[further], pose[further], gate, config)[0])
    measured_steps = measured_steps.rows(np.argsort(measured_steps.i))
    return measured_steps, searched


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
    usual = max(float(np.median(squared)) / _MEDIAN, 1.0) if len(squared) else 1.0
    contradicted = np.zeros(len(wheels), dtype=bool)
    contradicted[own[squared > usual * _CONTRADICTS]] = True
    return contradicted


_MEDIAN, _CONTRADICTS = 2.366, 16.266
"""Median of chi2 with three degrees of freedom, and what one step in a thousand exceeds by chance."""
_FEWEST = 6
"""Matches from which on a step is measured: twice its unknowns."""


def _moving(
    objects: ObjectLikelihood, clouds: Clouds, first: Ints, placed: Placed, config: TrackingConfig
) -> Bools:
    """Return which points (p,) belong to objects that moved since the keyframe before, or one some steps before.

    What moves slowly shows over several steps only; the uncertainty of a chain of steps grows with their number.
    """
    i, j, pose, covariance = first, first + 1, placed.pose, placed.covariance
    moves = np.zeros(len(clouds.points), dtype=bool)
    for _ in range(_STEPS_BACK):
        moves |= objects.moving(i, j, pair_points(clouds, j, config.points), pose, covariance)
        after = np.flatnonzero(np.isin(j, first))
        follows = np.searchsorted(first, j[after])
        turn = se2.rotation(pose[after, 2])
        covariance = covariance[after] + turn @ placed.covariance[follows] @ np.swapaxes(turn, 1, 2)
        i, j, pose = i[after], j[after] + 1, se2.compose(pose[after], placed.pose[follows])
    return moves


_STEPS_BACK = 4
"""Steps over which objects that move are sought: a second or two."""


def reattached(
    clouds: Clouds, raster: CloudRasters, poses: Floats, stamps: Floats, tied: Bools, gate: float, config: TrackingConfig
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
    lone = np.flatnonzero(~tied & (_lines_of(clouds) >= config.min_points))
    sound = np.flatnonzero(tied)
    place = np.searchsorted(sound, lone)
    inner = (place > 0) & (place < len(sound))
    lone, before, after = lone[inner], sound[place[inner] - 1], sound[place[inner]]
    near = after - before <= _LONGEST_RUN + 1
    lone, before, after = lone[near], before[near], after[near]
    share = (stamps[lone] - stamps[before]) / np.maximum(stamps[after] - stamps[before], 1e-9)
    guess = se2.between(poses[before], se2.interpolate(poses[before], poses[after], share))
    points, tight = pair_points(clouds, lone, config.points), min(config.gate, gate)
    aligned = align_pairs(clouds, raster, before, guess, points, gate, tight)
    fits = aligned.share >= config.good_share
    found, laid = poses.copy(), lone[fits]
    found[laid] = se2.compose(poses[before[fits]], aligned.pose[fits])
    return found, laid


_LONGEST_RUN = 3
"""Most consecutive keyframes that are placed between well matched ones."""


def _lines_of(clouds: Clouds) -> Ints:
    """Return the number (k,) of points with a normal of each cloud."""
    return np.bincount(clouds.owner[np.any(clouds.normals != 0.0, axis=1)], minlength=len(clouds))


def _searched(clouds: Clouds, i: Ints, steps: Steps, doubtful: Bools, config: TrackingConfig) -> tuple[Floats, Bools, int]:
    """Search for doubtful steps (e,), each against the sub-map of those before it.

    With noise of decimetres, foliage or few beams, every step has few matches. Where these are enough to measure the step, and
    no surface stands in free space, no search is needed.

    Returns
    -------
    Poses of all steps (e, 3), which were not found (e,), and how many were searched for.
    """
    pose, lost, searched = steps.pose.copy(), np.zeros(len(i), dtype=bool), 0
    searching = StepSearch(clouds, config.distance, config.angle)
    chain = np.zeros((len(clouds), 3))
    chain[i] = pose
    # Sub-maps begin after the last step that was not measured.
    blind = np.setdiff1d(np.arange(len(clouds)), i[steps.enough])
    first = 0
    for row in np.flatnonzero(doubtful).tolist():
        k, before = int(i[row]), blind[blind < i[row]]
        first = max(first, int(before[-1]) + 1 if len(before) else 0)
        guess, ended = steps.guess[row], steps.pose[row]
        if steps.share[row] >= _LEAST_SHARE and searching.through(k, ended[None])[0] <= _MOST_THROUGH:
            continue
        searched += 1
        found = searching.find(k, first, chain, np.stack([guess, ended, guess * [0.0, 0.0, 1.0]]))
        # Where no search is clear, descent near the odometry's guess still measures the directions that the surfaces determine.
        lost[row] = not found.clear and (found.contradicts or steps.share[row] < _LEAST_SHARE)
        if found.clear:
            chain[k] = pose[row] = found.pose
        elif lost[row]:
            first = k + 1
    return pose, lost, searched


_LEAST_SHARE = 0.4
"""Share of matching points from which on descent from the odometry's guess measures a step."""
_MOST_THROUGH = 0.04
"""Share of points in free space up to which it measures one; one point in twenty-five may be a foot or a leaf."""


def _miss(clouds: Clouds, wheels: OdometryEdges) -> Floats:
    """Return the error (e,) that the odometry may cause in points of the next cloud, 3 sigma, m."""
    sigma = 1.0 / np.einsum("eii->ei", wheels.sqrt_information)
    reach = np.hypot(clouds.points[:, 0], clouds.points[:, 1])
    arm = float(np.quantile(reach, 0.75)) if len(reach) else 0.0
    return 3.0 * (sigma[:, 0] + sigma[:, 2] * arm)


def _edges(
    clouds: Clouds, raster: CloudRasters, i: Ints, step: Floats, gate: float, config: TrackingConfig
) -> tuple[RelativePoseEdges, float]:
    """Return the steps (e, 3) from keyframes i to i + 1 as edges with the information of their matches, and the standard
    deviation of a match, m."""
    factors = match(clouds, raster, i, step, pair_points(clouds, i + 1, config.points), gate, gate / 2.0)
    sigma = float(np.sqrt(factors.squared.sum() / max(factors.weight.sum(), 1.0))) if len(i) else config.sigma
    sigma = max(sigma, _LEAST_SIGMA)
    z, sqrt_information = measured(factors, step, np.full(len(i), sigma**2 * config.correlation))
    return RelativePoseEdges(i, i + 1, z, sqrt_information), sigma


_LEAST_SIGMA = 0.02
"""Standard deviation of a match that clouds cannot fall below, m: walls are no straighter."""
