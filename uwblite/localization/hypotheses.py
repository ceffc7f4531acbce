"""Gaussian-sum filter: one extended Kalman filter for every place where the robot may be.

Each hypothesis carries the pose, the calibration of the wheels and one slowly varying error per anchor (multipath, antenna
patterns, an anchor's place that is off by decimetres), which fades with the distance driven. Measurements move each
hypothesis and change its weight by their likelihood; mirror images are kept side by side until one of them has become
unlikely (D. Alspach, H. Sorenson, Nonlinear Bayesian estimation using Gaussian sum approximations, 1972). All arrays hold
all hypotheses: no step below loops over them.
"""

from dataclasses import dataclass, replace

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, Table
from ..lidar.scan_matching import measured_part
from ..odometry.wheels import OdometryNoiseConfig
from ..radio.range_errors import HARMONICS, PATTERN_SIGMA, pattern_waves
from .range_model import ANYWHERE, POOR, SLOW_SIGMA, KnownAnchors, Ranges, mixture, range_factors
from .walls import REACH, Rays, Walls

WHEEL_SIGMA = (0.02, 0.03, 0.01)
"""Prior standard deviations of the wheels' calibration; 1, 1, rad/m."""
LASER_SIGMA = 0.02
"""rad, of the laser's heading: screws some centimetres apart, each within a millimetre. A map may be another robot's."""
SLOW_LENGTH = 5.0
"""m; correlation length of the slow error: fields of a room's size last longer than the 1.5 m of single reflections."""
_WHEELS = OdometryNoiseConfig(heading_per_metre=0.02)
"""Random errors of the wheels; the heading per metre, which a recording learns, is what it begins with."""
_STANDING = 2e-4
"""m and rad, of every step."""
WALL_SIGMA = 0.03
"""m; standard deviation of a point about its wall: half a cell of 0.05 m and the lidar's noise at 3 m."""
INDEPENDENT = 20.0
"""Points of a scan whose errors are independent: those of one wall share the cells' rounding."""
MATCHES = 4
"""Iterations of a match."""
WIDTHS = np.geomspace(0.3, 0.1, MATCHES)
"""m; kernel width of each."""
SAME = (0.5, 0.3)
"""m and rad; hypotheses that are closer are one."""
PER_MOVE, PER_UPDATE = 4, 8
"""Operations on elements of a covariance in a step of the odometry, for each unknown, and in a correction by a range."""

POSE = slice(0, len(POOR))
"""Of the state: x, y, theta."""
WHEELS = slice(POSE.stop, POSE.stop + len(WHEEL_SIGMA))
"""Relative error of distance, of turned angle, and heading per metre, rad/m."""
PATTERN = slice(WHEELS.stop, WHEELS.stop + 2 * HARMONICS)
"""m, range error as a function of the anchor's direction in the robot's frame (range_errors.pattern_waves): the tag's
radiation pattern and the shadow of the robot's own body, the same for all anchors."""
LASER = PATTERN.stop
"""rad, heading of the laser on the base against the mounting that the map's robot showed."""
FIRST_ANCHOR = LASER + 1
"""m, of each anchor the range error that fades, and behind all of these, the one that stays."""


@dataclass(frozen=True, slots=True, eq=False)
class Hypotheses(Table):
    """Places where the robot may be."""

    mean: Floats
    """(h, n), n = FIRST_ANCHOR + 2 a."""
    covariance: Floats
    """(h, n, n)."""
    log_weight: Floats
    """(h,) the largest is 0."""

    def __len__(self) -> int:
        return len(self.mean)

    @property
    def poses(self) -> Floats:
        """(h, 3) T_map_base."""
        return self.mean[:, POSE]

    @property
    def pose_covariances(self) -> Floats:
        """(h, 3, 3) m, m, rad; map frame."""
        return self.covariance[:, POSE, POSE]


def none(anchors: int) -> Hypotheses:
    """Return no hypothesis."""
    n = FIRST_ANCHOR + 2 * anchors
    return Hypotheses(np.zeros((0, n)), np.zeros((0, n, n)), np.zeros(0))


def started(poses: Floats, covariances: Floats, biases: Floats) -> Hypotheses:
    """Return hypotheses at poses (h, 3) with covariances (h, 3, 3) and prior values of the other unknowns.

    Parameters
    ----------
    biases : (a,) standard deviations of each anchor's range error that stays, m.
    """
    n = FIRST_ANCHOR + 2 * len(biases)
    mean, whole = np.zeros((len(poses), n)), np.zeros((len(poses), n, n))
    mean[:, POSE], whole[:, POSE, POSE] = poses, covariances
    prior = [*WHEEL_SIGMA, *np.full(2 * HARMONICS, PATTERN_SIGMA), LASER_SIGMA, *np.full(len(biases), SLOW_SIGMA), *biases]
    rest = np.arange(WHEELS.start, n)
    whole[:, rest, rest] = np.square(prior)
    return Hypotheses(mean, whole, np.zeros(len(poses)))


def moved(bank: Hypotheses, step: Floats, slack: float = 0.0) -> Hypotheses:
    """Drive every hypothesis by one step (3,) of the odometry.

    ``d' = (1 + s) d``, ``theta' = (1 + g) theta + m |d|``; the slow errors are a Gauss-Markov process in the distance. Slack, m
    and rad, is the standard deviation of motion that the wheels did not measure.
    """
    d, turn = step[:2], float(step[2])
    way = float(np.hypot(*d))
    mean = bank.mean.copy()
    s, g, m = bank.mean[:, WHEELS].T
    along = se2.rotate(mean[:, 2] + 0.5 * (g * turn + m * way), np.broadcast_to(d, (len(mean), 2)))
    shift = (1.0 + s)[:, None] * along
    n = mean.shape[1]
    f = np.broadcast_to(np.eye(n), (len(mean), n, n)).copy()
    across = np.stack([-shift[:, 1], shift[:, 0]], axis=1)
    f[:, :2, 2] = across
    f[:, :2, WHEELS] = np.stack([along, 0.5 * turn * across, 0.5 * way * across], axis=-1)
    f[:, 2, WHEELS] = 0.0, turn, way
    fade = float(np.exp(-way / SLOW_LENGTH))
    slow = np.arange(FIRST_ANCHOR, (FIRST_ANCHOR + n) // 2)
    f[:, slow, slow] = fade
    mean[:, :2] += shift
    mean[:, 2] = se2.wrap_angle(mean[:, 2] + (1.0 + g) * turn + m * way)
    mean[:, slow] *= fade
    noise = np.zeros(n)
    noise[:2] = _WHEELS.distance**2 * way
    noise[2] = _WHEELS.heading_per_metre**2 * way + _WHEELS.heading_per_turn**2 * abs(turn)
    noise[POSE] += _STANDING**2 + slack**2
    noise[slow] = SLOW_SIGMA**2 * (1.0 - fade**2)
    covariance = f @ bank.covariance @ f.transpose(0, 2, 1)
    covariance[:, np.arange(n), np.arange(n)] += noise
    return Hypotheses(mean, symmetric(covariance), bank.log_weight)


def scan_factors(walls: Walls, poses: Floats, rays: Rays, width: float) -> tuple[Floats, Floats]:
    """Return the information (h, 3, 3) and gradient (h, 3) of a scan at poses (h, 3), of what it measures alone.

    Along an aisle H is the scatter of the walls' normals, which is left out (lidar.degeneracy).
    """
    hessian, spurious, gradient, weight = walls.factors(poses, rays, width)
    share = np.minimum(INDEPENDENT / np.maximum(weight, 1.0), 1.0) / WALL_SIGMA**2
    information, step = measured_part(hessian, spurious, gradient)
    information *= share[:, None, None]
    return information, -np.einsum("hij,hj->hi", information, step)


def refined(poses: Floats, ranges: Ranges, walls: Walls | None = None, rays: Rays | None = None) -> Floats:
    """Return poses (c, 3) moved to where ranges, and scans where there are walls, together agree best nearby.

    Along a wall the ranges alone say where the robot is: all poses along it become one place.
    """
    poses = poses.copy()
    for width in WIDTHS:
        information, gradient = range_factors(poses, ranges)
        if walls is not None and rays is not None:
            seen, slope = scan_factors(walls, poses, rays, width)
            information, gradient = information + seen, gradient + slope
        step = np.linalg.solve(information + POOR, gradient[:, :, None])[:, :, 0]
        poses -= step / np.maximum(np.abs(step).max(axis=1, keepdims=True) / REACH, 1.0)
    poses[:, 2] = se2.wrap_angle(poses[:, 2])
    return poses


def matched(bank: Hypotheses, walls: Walls, rays: Rays, fresh: float) -> Hypotheses:
    """Correct every hypothesis by a scan, in the present frame of the base: an iterated Kalman update with robust weights.

    The scan measures the pose, turned by the error of the laser's mounting, so that the update is made for that, with prior
    information I and the scan's H and gradient, and transferred to the state by its covariance with it. Fresh, 0..1, is how far
    its error is independent of the one before: walls are seen with the same cells' rounding until the robot has moved.
    """
    if not len(bank):
        return bank
    cross = bank.covariance[:, :, POSE].copy()
    cross[:, :, 2] += bank.covariance[:, :, LASER]
    prior = cross[:, POSE].copy()
    prior[:, 2] += cross[:, LASER]
    information = np.linalg.inv(prior)
    start = bank.poses + np.multiply.outer(bank.mean[:, LASER], (0.0, 0.0, 1.0))
    away, hessian = np.zeros_like(start), np.zeros_like(prior)
    for width in WIDTHS:
        hessian, gradient = (fresh * part for part in scan_factors(walls, start + away, rays, width))
        gradient += np.einsum("hij,hj->hi", information, away)
        away -= np.linalg.solve(information + hessian, gradient[:, :, None])[:, :, 0]
    posterior = np.linalg.inv(information + hessian)
    gain = cross @ information
    mean = bank.mean + np.einsum("hij,hj->hi", gain, away)
    mean[:, 2] = se2.wrap_angle(mean[:, 2])
    covariance = bank.covariance + gain @ (posterior - prior) @ gain.transpose(0, 2, 1)
    return Hypotheses(mean, symmetric(covariance), bank.log_weight)


def ranged(
    bank: Hypotheses, anchors: KnownAnchors, k: int, metres: float, tag: Floats, share: float = 1.0
) -> tuple[Hypotheses, Floats, Floats, Floats]:
    """Correct every hypothesis by a range to anchor k, m, with its errors by anchor (slow), by place and by direction.

    Parameters
    ----------
    tag : (2,) place of the tag at the range's time in the present frame of the base, m. share : of an independent range's
        information that it has, 0..1; the likelihood is that of the whole.

    Returns
    -------
    The hypotheses, and for each the weight (h,), 0..1, that the range got, its log-likelihood (h,), 0 = the likeliest, and
    that of a range from anywhere (h,).
    """
    theta, place, noise = bank.mean[:, 2], anchors.positions[k], float(anchors.sigma[k])
    lever = se2.rotate(theta, np.broadcast_to(tag, (len(bank), 2)))
    offset = bank.mean[:, :2] + lever - place
    distance = np.sqrt(np.maximum(np.sum(offset**2, axis=1) + anchors.rise[k], WALL_SIGMA**2))
    columns = k + np.array([FIRST_ANCHOR, (FIRST_ANCHOR + bank.mean.shape[1]) // 2])
    waves = pattern_waves(np.arctan2(-offset[:, 1], -offset[:, 0]) - theta)
    shift = np.einsum("hk,hk->h", waves, bank.mean[:, PATTERN]) + bank.mean[:, columns].sum(axis=1) + anchors.bias[k]
    if anchors.errors:
        shift += anchors.errors[k].at(offset + place)
    error = metres - (1.0 + anchors.scale) * distance - shift
    jacobian = np.zeros(bank.mean.shape)
    jacobian[:, PATTERN] = waves
    unit = (1.0 + anchors.scale) * offset / distance[:, None]
    jacobian[:, :2] = unit
    jacobian[:, 2] = -unit[:, 0] * lever[:, 1] + unit[:, 1] * lever[:, 0]
    jacobian[:, columns] = 1.0
    spread = np.einsum("hij,hj->hi", bank.covariance, jacobian)
    own = np.einsum("hi,hi->h", jacobian, spread)
    sigma = np.sqrt(own + noise**2)
    core, density = mixture(error, sigma)
    weight = core / density
    gain = spread * (share * weight / (share * weight * own + noise**2))[:, None]
    mean = bank.mean + gain * error[:, None]
    mean[:, 2] = se2.wrap_angle(mean[:, 2])
    covariance = symmetric(bank.covariance - gain[:, :, None] * spread[:, None, :])
    anywhere = np.log(sigma * np.sqrt(2.0 * np.pi) / ANYWHERE)
    return Hypotheses(mean, covariance, bank.log_weight), weight, np.log(density), anywhere


def reweighted(bank: Hypotheses, log_likelihood: Floats) -> Hypotheses:
    """Return the hypotheses with weights changed by a log-likelihood (h,), the best one's being 0 again."""
    weight = bank.log_weight + log_likelihood
    return replace(bank, log_weight=weight - weight.max(initial=-np.inf) if len(weight) else weight)


def mixed(bank: Hypotheses, which: int) -> tuple[Floats, Floats]:
    """Return the probability (h,) of each hypothesis and the covariance (3, 3) of all poses about one of them."""
    share = np.exp(bank.log_weight)
    share /= share.sum()
    off = bank.poses - bank.poses[which]
    off[:, 2] = se2.wrap_angle(off[:, 2])
    return share, np.einsum("h,hij->ij", share, bank.pose_covariances + off[:, :, None] * off[:, None, :])


def apart(one: Floats, others: Floats) -> Bools:
    """Return which poses (..., 3) are another place than poses (..., 3): half a metre or 0.3 rad away."""
    off = np.abs(others - one)
    return (np.hypot(off[..., 0], off[..., 1]) > SAME[0]) | (np.abs(se2.wrap_angle(off[..., 2])) > SAME[1])


def pruned(bank: Hypotheses, most: int, least: float) -> Hypotheses:
    """Return the best hypotheses, at most so many, none near a better one and none below a log-weight."""
    order = np.argsort(-bank.log_weight, kind="stable")
    order = order[bank.log_weight[order] >= least]
    other, kept = apart(bank.poses[order, None], bank.poses[order]), np.zeros(len(order), bool)
    for k in range(len(order)):
        kept[k] = other[k, kept].all() and kept.sum() < most
    return bank.rows(order[kept])


def symmetric(matrices: Floats) -> Floats:
    """Return matrices (h, n, n) made symmetric again after rounding."""
    return 0.5 * (matrices + matrices.transpose(0, 2, 1))
