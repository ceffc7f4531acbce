"""Slips of the wheels as a hidden state of the odometry: sound or slipping, for a while.

A slip lasts for seconds, over many steps: the posterior of each step follows from the evidence of all by the forward-backward
algorithm of a two-state Markov chain (L. Rabiner, A tutorial on hidden Markov models, Proc. IEEE 1989).
"""

from dataclasses import dataclass, replace

import numpy as np

from .. import se2
from ..arrays import Bools, Floats
from ..graph.graph import Graph
from ..graph.pose_edges import OdometryEdges

EVERY, LASTS = 600.0, 2.0
"""Mean time between two slips and mean duration of one, s: a kerb, a carpet, wet leaves, a door sill."""
SPEED, TURN_RATE = 0.5, 0.5
"""Standard deviations of the motion that wheels do not count while they slip, m/s and rad/s: a robot is pushed as fast as
people walk. They count at most all of their motion too much."""
ASIDE = 0.1
"""Uncounted motion across wheels that spin, as a share of that along them: tyres hold the ground to the side."""
STEADY = 10.0
"""Time over which the false motion of a slip changes, s: while wheels spin, the robot's speed is as commanded."""
_SHARE = LASTS / (EVERY + LASTS)
"""Of time, during which wheels slip."""
_HARDLY = 1e-3
"""Probability of a slip below which a step tells nothing of its neighbours' slips."""


def slip_sigma(wheels: OdometryEdges) -> Floats:
    """Return the standard deviation (e, 3) of steps of the odometry over which the wheels slip, m, m, rad."""
    # A slip does not last as long as a pause.
    return _uncounted(wheels, -LASTS * np.expm1(-wheels.duration / LASTS))


def spin_sigma(wheels: OdometryEdges) -> Floats:
    """Return the same (e, 3) where wheels spin and nothing pushes the robot to the side."""
    sigma = slip_sigma(wheels)
    sigma[:, 1] = np.abs(wheels.motion[:, 1]) + ASIDE * sigma[:, 0]
    return sigma


def lost_sigma(wheels: OdometryEdges) -> Floats:
    """Return the standard deviation (e, 3) of steps over which messages are lost, as long as a slip, or a robot is carried."""
    return _uncounted(wheels, np.full(len(wheels), LASTS))


def _uncounted(wheels: OdometryEdges, lasts: Floats) -> Floats:
    """Return the standard deviation (e, 3) of steps whose wheels miss what happens in some time (e,), s, or count too much."""
    place = np.hypot(wheels.motion[:, 0], wheels.motion[:, 1]) + SPEED * lasts
    return np.stack([place, place, np.abs(wheels.motion[:, 2]) + TURN_RATE * lasts], axis=1)


def covariance_of(wheels: OdometryEdges, graph: Graph) -> Floats:
    """Return the covariance (e, 3, 3) of the corrected motions by x, y and heading in the frame of pose i."""
    root = wheels.end_sqrt_information / wheels.own_scale(graph)[:, None, :]
    inverse = np.linalg.inv(root)
    turn = se2.rotation(wheels.corrected(graph)[:, 2])
    return np.asarray(turn @ inverse @ np.swapaxes(inverse, 1, 2) @ np.swapaxes(turn, 1, 2))


@dataclass(frozen=True, slots=True, eq=False)
class SlipChain:
    """Probabilities of slips over e steps that follow each other."""

    probability: Floats
    """(e,) that the wheels slip over each."""
    before: Floats
    """(e,) that they slip over the step before each, if they do over this one."""
    after: Floats
    """(e,) the same of the step after it."""


def posterior(log_odds: Floats, duration: Floats) -> SlipChain:
    """Return the probabilities that the wheels slip in each of following steps.

    Parameters
    ----------
    log_odds : (e,) log of the likelihood of what was measured over each step if they slip, by that if they do not; 0 where
        nothing was. duration : (e,) s.
    """
    settled = -np.expm1(-duration * (1.0 / EVERY + 1.0 / LASTS))
    starts, ends = _SHARE * settled, (1.0 - _SHARE) * settled
    likelihood = np.exp(np.stack([np.minimum(-log_odds, 0.0), np.minimum(log_odds, 0.0)], axis=1))
    steps = np.stack([np.stack([1.0 - starts, starts], axis=1), np.stack([ends, 1.0 - ends], axis=1)], axis=1)
    stationary = np.array([1.0 - _SHARE, _SHARE])
    forward, backward = np.empty((len(log_odds), 2)), np.ones((len(log_odds), 2))
    before = stationary
    for k in range(len(log_odds)):
        before = likelihood[k] * (before @ steps[k])
        before /= before.sum()
        forward[k] = before
    for k in range(len(log_odds) - 2, -1, -1):
        after = steps[k + 1] @ (likelihood[k + 1] * backward[k + 1])
        backward[k] = after / after.sum()
    # From either state of the step before to a slip, and from a slip to either state of the step after.
    into = np.concatenate([stationary[None], forward])[:-1] * steps[:, :, 1]
    out = (steps[:, 1] * likelihood * backward)[1:]
    after = np.append(out[:, 1] / out.sum(axis=1), 1.0 - _SHARE)[: len(log_odds)]
    both = forward * backward
    return SlipChain(*(np.asarray(each) for each in (both[:, 1] / both.sum(axis=1), into[:, 1] / into.sum(axis=1), after)))


@dataclass(frozen=True, slots=True, eq=False)
class FalseMotions:
    """What was measured of the false motion of wheels over e steps, in standard deviations of a slip."""

    vector: Floats
    """(e, 3) information vector."""
    matrix: Floats
    """(e, 3, 3) information matrix."""

    @property
    def _prior(self) -> Floats:
        """(1, 3, 3) information matrix before anything was measured."""
        return np.eye(self.vector.shape[1])[None]

    def by_neighbours(self, chain: SlipChain, duration: Floats) -> "FalseMotions":
        """Return what the other steps of a slip tell of its motion over each of its steps (e,), s, the prior included.

        Wheels count the same false motion for as long as they slip, a stationary Gauss-Markov process: so a slip of ten steps
        pays for its unknown motion once.
        """
        near = np.maximum(chain.probability, np.append(chain.probability[1:], 0.0)) > _HARDLY
        vector, matrix = self._predicted(chain.before, duration, near)
        back = FalseMotions(self.vector[::-1], self.matrix[::-1])
        near = np.maximum(chain.probability, np.append(0.0, chain.probability[:-1])) > _HARDLY
        after, others = back._predicted(chain.after[::-1], duration[::-1], near[::-1])
        # Both sides hold the prior.
        return FalseMotions(vector + after[::-1], matrix + others[::-1] - self._prior)

    def _predicted(self, same: Floats, duration: Floats, near: Bools) -> tuple[Floats, Floats]:
        """Return the information vector (e, 3) and matrix (e, 3, 3) of the false motion over each step by the steps before it,
        which are of the same slip with a probability (e,); near : (e,) steps that may be in a slip."""
        vectors, prior = np.zeros_like(self.vector), self._prior[0]
        matrices = np.tile(prior, (len(vectors), 1, 1))
        keeps = same * np.exp(-0.5 * (duration + np.roll(duration, 1)) / STEADY)
        for k in np.flatnonzero(near[:-1]).tolist():
            covariance, kept = np.linalg.inv(matrices[k] + self.matrix[k]), keeps[k + 1]
            mean = covariance @ (vectors[k] + self.vector[k])
            matrices[k + 1] = np.linalg.inv(kept**2 * covariance + (1.0 - kept**2) * prior)
            vectors[k + 1] = matrices[k + 1] @ (kept * mean)
        return vectors, matrices

    def log_marginal(self, prior: "FalseMotions") -> Floats:
        """Return by how much the log evidence (e,) of a slip is greater under a prior than under that of a lone step."""
        alone = FalseMotions(np.zeros_like(self.vector), np.broadcast_to(self._prior, self.matrix.shape))
        return np.asarray(self._log_marginal(prior) - self._log_marginal(alone))

    def _log_marginal(self, prior: "FalseMotions") -> Floats:
        """Return the log marginal likelihood (e,) under a prior, but for what does not depend on it."""
        vector, matrix = self.vector + prior.vector, self.matrix + prior.matrix
        squared = _squared(vector, matrix) - _squared(prior.vector, prior.matrix)
        return np.asarray(0.5 * (squared + np.linalg.slogdet(prior.matrix)[1] - np.linalg.slogdet(matrix)[1]))


def _squared(vector: Floats, matrix: Floats) -> Floats:
    """Return v^T M^-1 v (e,) of vectors (e, 3) and matrices (e, 3, 3)."""
    return np.asarray(np.einsum("ei,ei->e", vector, np.linalg.solve(matrix, vector[..., None])[..., 0]))


def _diagonal(values: Floats) -> Floats:
    return values[:, :, None] * np.eye(values.shape[1])


def log_densities(wheels: OdometryEdges, graph: Graph) -> Floats:
    """Return the logarithm of the density (e,) of each step at a graph's poses, sound or slipping with their shares of time."""
    sound, slipping = _of_either(wheels, graph)
    return np.asarray(np.logaddexp(np.log(1.0 - _SHARE) + sound, np.log(_SHARE) + slipping))


def slipped(wheels: OdometryEdges, graph: Graph) -> Floats:
    """Return the probability (e,) that wheels, whose noise is that of sound ones, slip over each step at a graph's poses."""
    sound, slipping = _of_either(wheels, graph)
    return posterior(slipping - sound, wheels.duration).probability


def _of_either(wheels: OdometryEdges, graph: Graph) -> tuple[Floats, Floats]:
    """Return the logarithm of the density (e,) of each step, sound and slipping."""
    sound = covariance_of(wheels, graph)
    slipping = sound + _diagonal(slip_sigma(wheels) ** 2)
    off = se2.between(graph.poses[wheels.i], graph.poses[wheels.j]) - wheels.corrected(graph)
    off[:, 2] = se2.wrap_angle(off[:, 2])
    sound, slipping = (-0.5 * (_squared(off, c) + np.linalg.slogdet(2.0 * np.pi * c)[1]) for c in (sound, slipping))
    return sound, slipping


def with_slips(wheels: OdometryEdges, probability: Floats) -> OdometryEdges:
    """Return the odometry with the expected information of each step, which slips with a probability (e,)."""
    sound = np.einsum("eii->ei", wheels.sqrt_information) ** 2
    slips = 1.0 / (slip_sigma(wheels) ** 2 + 1.0 / sound)
    diagonal = np.sqrt((1.0 - probability[:, None]) * sound + probability[:, None] * slips)
    return replace(wheels, sqrt_information=_diagonal(diagonal), slips=None)


def expected(wheels: OdometryEdges) -> OdometryEdges:
    """Return the odometry with the slips that it is known to have in its information."""
    return wheels if wheels.slips is None else with_slips(wheels, wheels.slips)
