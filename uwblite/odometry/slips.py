"""Slips of the wheels as a hidden state of the odometry: sound or slipping, for a while.

A slip lasts for seconds, over many steps, in every direction at once. So the evidence of one step, for or against a slip,
tells of its neighbours, too: the posterior of each step follows from that of all by the forward-backward algorithm of a
two-state Markov chain (L. Rabiner, A tutorial on hidden Markov models, Proc. IEEE 1989).
"""

from dataclasses import replace

import numpy as np

from .. import se2
from ..arrays import Floats
from ..graph.graph import Graph
from ..graph.pose_edges import OdometryEdges

EVERY, LASTS = 600.0, 2.0
"""Mean time between two slips and mean duration of one, s: a kerb, a carpet, wet leaves, a door sill."""
SPEED, TURN_RATE = 0.5, 0.5
"""Standard deviations of the motion that wheels do not count while they slip, m/s and rad/s: a robot is pushed as fast as
people walk. They count at most all of their motion too much."""


def slip_sigma(wheels: OdometryEdges) -> Floats:
    """Return the standard deviation (e, 3) of steps of the odometry over which the wheels slip, m, m, rad."""
    way, turned = np.hypot(wheels.motion[:, 0], wheels.motion[:, 1]), np.abs(wheels.motion[:, 2])
    # A slip does not last as long as a pause.
    lasts = -LASTS * np.expm1(-wheels.duration / LASTS)
    place = way + SPEED * lasts
    return np.stack([place, place, turned + TURN_RATE * lasts], axis=1)


def covariance_of(wheels: OdometryEdges, graph: Graph) -> Floats:
    """Return the covariance (e, 3, 3) of the corrected motions by x, y and heading in the frame of pose i."""
    root = wheels.end_sqrt_information / wheels.own_scale(graph)[:, None, :]
    inverse = np.linalg.inv(root)
    turn = se2.rotation(wheels.corrected(graph)[:, 2])
    return np.asarray(turn @ inverse @ np.swapaxes(inverse, 1, 2) @ np.swapaxes(turn, 1, 2))


def posterior(log_odds: Floats, duration: Floats) -> Floats:
    """Return the probability (e,) that the wheels slip in each of following steps.

    Parameters
    ----------
    log_odds : (e,) log of the likelihood of what was measured over each step if they slip, by that if they do not; 0 where
        nothing was. duration : (e,) s.
    """
    share = LASTS / (EVERY + LASTS)
    settled = -np.expm1(-duration * (1.0 / EVERY + 1.0 / LASTS))
    starts, ends = share * settled, (1.0 - share) * settled
    likelihood = np.exp(np.stack([np.minimum(-log_odds, 0.0), np.minimum(log_odds, 0.0)], axis=1))
    steps = np.stack([np.stack([1.0 - starts, starts], axis=1), np.stack([ends, 1.0 - ends], axis=1)], axis=1)
    before = np.array([1.0 - share, share])
    forward, backward = np.empty((len(log_odds), 2)), np.ones((len(log_odds), 2))
    for k in range(len(log_odds)):
        before = likelihood[k] * (before @ steps[k])
        before /= before.sum()
        forward[k] = before
    for k in range(len(log_odds) - 2, -1, -1):
        after = steps[k + 1] @ (likelihood[k + 1] * backward[k + 1])
        backward[k] = after / after.sum()
    both = forward * backward
    return np.asarray(both[:, 1] / both.sum(axis=1))


def log_densities(wheels: OdometryEdges, graph: Graph) -> Floats:
    """Return the logarithm of the density (e,) of each step at a graph's poses, sound or slipping with their shares of time."""
    share = LASTS / (EVERY + LASTS)
    sound, slipping = _of_either(wheels, graph)
    return np.asarray(np.logaddexp(np.log(1.0 - share) + sound, np.log(share) + slipping))


def slipped(wheels: OdometryEdges, graph: Graph) -> Floats:
    """Return the probability (e,) that wheels, whose noise is that of sound ones, slip over each step at a graph's poses."""
    sound, slipping = _of_either(wheels, graph)
    return posterior(slipping - sound, wheels.duration)


def _of_either(wheels: OdometryEdges, graph: Graph) -> tuple[Floats, Floats]:
    """Return the logarithm of the density (e,) of each step, sound and slipping."""
    sound = covariance_of(wheels, graph)
    slipping = sound + slip_sigma(wheels)[:, :, None] ** 2 * np.eye(3)
    off = se2.between(graph.poses[wheels.i], graph.poses[wheels.j]) - wheels.corrected(graph)
    off[:, 2] = se2.wrap_angle(off[:, 2])
    return _log_normal(off, sound), _log_normal(off, slipping)


def _log_normal(off: Floats, covariance: Floats) -> Floats:
    """Return the logarithm of the normal density (e,) of errors (e, 3) with covariances (e, 3, 3)."""
    squared = np.einsum("ei,ei->e", off, np.linalg.solve(covariance, off[..., None])[..., 0])
    return np.asarray(-0.5 * (squared + np.linalg.slogdet(2.0 * np.pi * covariance)[1]))


def with_slips(wheels: OdometryEdges, probability: Floats) -> OdometryEdges:
    """Return the odometry with the expected information of each step, which slips with a probability (e,)."""
    sound = np.einsum("eii->ei", wheels.sqrt_information) ** 2
    slips = 1.0 / (slip_sigma(wheels) ** 2 + 1.0 / sound)
    diagonal = np.sqrt((1.0 - probability[:, None]) * sound + probability[:, None] * slips)
    return replace(wheels, sqrt_information=diagonal[:, :, None] * np.eye(3), slips=None)


def expected(wheels: OdometryEdges) -> OdometryEdges:
    """Return the odometry with the slips that it is known to have in its information."""
    return wheels if wheels.slips is None else with_slips(wheels, wheels.slips)
