"""How one recording lies in the frame of others: by the anchors that both have placed, as far as these agree.

Places that a recording's ranges give are Gaussian together. Far from its first pose all of them err by metres, because the
heading does, but alike: a rigid motion takes that out, and what is left shows an anchor that was moved. So places are compared
under their joint covariances, with the motion of one recording into the frame of the other free.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from .. import se2
from ..arrays import Floats, Ints
from ..graph.joint_covariance import anchor_covariance
from .estimate import Estimate

_SYSTEMATIC = 0.25
"""Standard deviation of what NLOS and biases, not yet known well, add to the distance between two first places, m."""
_LARGEST = 5.0
"""m; an anchor whose first place is less sure, or open, still has to lie within some metres to join in."""
_MOVED = 20.0
"""Decrease of chi2 without an anchor (2 degrees of freedom) from which on it was moved: 5e-5 by chance, the rest for errors
that the covariances leave out."""
_FREE = 1e3
"""m; standard deviation of a rigid motion of which nothing is known."""
_STEPS = 3
"""Gauss-Newton steps to the best motion, from the best one without covariances."""

Pairs = list[tuple[int, int]]
"""Number of an anchor in one set of places, and in the other."""


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Where some anchors are."""

    names: tuple[str, ...]
    at: Floats
    """(a, 2) m."""
    covariance: Floats
    """(2a, 2a) m^2."""

    def moved(self, motion: Floats) -> "Places":
        """Return them in another frame, given T_new_old (3,)."""
        return Places(self.names, se2.transform(motion, self.at), _turned(self.covariance, motion[2]))


def places_of(estimate: Estimate) -> Places:
    """Return the places of the unambiguous anchors of a recording; of all placed if these are few."""
    if estimate.bootstrap is None:
        return Places((), np.zeros((0, 2)), np.zeros((0, 0)))
    placed = np.flatnonzero(estimate.placed & ~estimate.bootstrap.ambiguous)
    if len(placed) < 2:
        placed = np.flatnonzero(estimate.placed)
    values, vectors = np.linalg.eigh(anchor_covariance(estimate.graph.with_edges(*estimate.odometry_and_ranges), placed))
    bounded = np.asarray((vectors / (1.0 / np.maximum(values, 1e-12) + _LARGEST**-2)) @ vectors.T)
    return Places(tuple(estimate.anchor_ids[k] for k in placed), estimate.graph.anchors[placed], bounded)


def agreement(found: Places, placed: Places) -> tuple[Floats, Pairs]:
    """Return the motion (3,) of places into the frame of others, and which anchors agree: two or more of the same name.

    Anchors leave one by one, each the one without which the others fit best, until that no longer shows.
    """
    pairs = [(k, placed.names.index(name)) for k, name in enumerate(found.names) if name in placed.names]
    motion, chi2 = fitted(found, placed, pairs)
    while len(pairs) > 2:
        less = [fitted(found, placed, pairs[:k] + pairs[k + 1 :]) for k in range(len(pairs))]
        k = int(np.argmin([left for _, left in less]))
        if chi2 - less[k][1] < _MOVED:
            break
        motion, chi2 = less[k]
        del pairs[k]
    return motion, pairs if chi2 < _MOVED or len(pairs) > 2 else []


def together(placed: Places, found: Places, names: Sequence[str]) -> Places:
    """Return places with those of a further recording, in the same frame, of which these are the names in common.

    Nothing is known of the rigid motion of the further recording but what its anchors in common show (Gaussian fusion).
    """
    union = (*placed.names, *(name for name in names if name not in placed.names))
    rows = _scalars(np.array([union.index(name) for name in names]))
    tangent = _tangent(found.at)
    free = found.covariance + _FREE**2 * tangent @ tangent.T + 0.5 * _SYSTEMATIC**2 * np.eye(len(rows))
    known = 2 * len(placed.names)
    information, vector = np.zeros((2 * len(union), 2 * len(union))), np.zeros(2 * len(union))
    information[:known, :known] = np.linalg.inv(placed.covariance + 1e-9 * np.eye(known))
    vector[:known] = information[:known, :known] @ placed.at.ravel()
    own = np.linalg.inv(free)
    information[np.ix_(rows, rows)] += own
    vector[rows] += own @ found.at.ravel()
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return Places(union, (covariance @ vector).reshape(-1, 2), covariance)


def fitted(found: Places, placed: Places, pairs: Pairs) -> tuple[Floats, float]:
    """Return the motion (3,) of places into the frame of others that fits pairs of them best, and chi2 there."""
    mine, theirs = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
    here, there = found.at[mine], placed.at[theirs]
    own, others = (p.covariance[np.ix_(_scalars(k), _scalars(k))] for p, k in ((found, mine), (placed, theirs)))
    others = others + _SYSTEMATIC**2 * np.eye(len(others))
    motion = se2.align(here, there)
    for _ in range(_STEPS):
        at = se2.transform(motion, here)
        factor = cho_factor(_turned(own, motion[2]) + others)
        tangent, off = _tangent(at), (at - there).ravel()
        weighted = cho_solve(factor, tangent)
        step = -np.linalg.solve(tangent.T @ weighted, weighted.T @ off)
        left = off + tangent @ step
        turn_step = step[2] / _extent(at)
        shift = at.mean(axis=0)
        motion = se2.compose(np.append(shift + step[:2] - se2.rotate(turn_step, shift), turn_step), motion)
    return motion, float(left @ cho_solve(factor, left))


def _tangent(at: Floats) -> Floats:
    """Return how (2a, 3) places move with a rigid motion: x and y, and a turn about their mean by which they move as far."""
    turned = se2.rotate(0.5 * np.pi, at - at.mean(axis=0)) / _extent(at)
    return np.column_stack([np.tile(np.eye(2), (len(at), 1)), turned.ravel()])


def _turned(covariance: Floats, angle: float) -> Floats:
    """Return the covariance (2a, 2a) of places in a frame turned by an angle."""
    turn = np.kron(np.eye(len(covariance) // 2), se2.rotation(angle)[:2, :2])
    return np.asarray(turn @ covariance @ turn.T)


def _extent(at: Floats) -> float:
    """Return the rms distance of places from their mean, m."""
    return max(float(np.sqrt(np.mean(np.sum((at - at.mean(axis=0)) ** 2, axis=1)))), 1e-9)


def _scalars(numbers: Ints) -> Ints:
    """Return the numbers (2a,) of the coordinates of anchors (a,)."""
    return (2 * numbers[:, None] + np.arange(2)).ravel()
