"""Noise of wheels and errors that stay with the floor, as poses that a lidar determines show them; these as unknowns.

Carpet, cross slopes and smooth patches make all steps on them wrong by the same: the errors of sums of steps grow faster than
with the square root of the way. So the residuals of single steps show the noise of steps, and those of sums over ten (3 m) what
stays. Poses that rays on surfaces determine err themselves, and follow the wheels as far as these are trusted: of an error with
the variance w, assumed s, a measurement with the variance v leaves a residual with (s / (s + v))^2 (w + v).

A step sideways, in the frame in its middle, is slip: that of wheels that roll is far below what is assumed.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from ..arrays import Floats, spread
from ..graph.eliminated import Blocks, rows_of
from ..graph.graph import Graph, kernel_weights
from ..graph.pose_edges import OdometryEdges
from ..graph.unknowns import Unknowns
from .wheels import PATCH

_ENOUGH = 60
"""Residuals, measured better than assumed, that show a noise."""
_LEAST, _MOST = 0.25, 3.0
"""Smallest and largest noise relative to that assumed."""
_STRADDLED = 1.5
"""How much larger the variance of an error per patch is than sums show that begin anywhere and lie on two patches."""
_SMALL = 1e-6
"""Standard deviation of what is known not to be."""


@dataclass(frozen=True, slots=True, eq=False)
class Floor:
    """What patches of floor, of so many steps each, add to what the wheels count."""

    value: Floats
    """(p, 2) share of the way, and turn, rad/m."""
    sigma: Floats
    """(2,) prior standard deviations of these about 0."""

    def moved(self, step: Floats) -> "Floor":
        """Return the floor after a step (p, 4), of which two count."""
        return replace(self, value=self.value + step[:, :2])


def even(wheels: OdometryEdges) -> Floor:
    """Return a floor that adds nothing."""
    return Floor(np.zeros(((len(wheels) + PATCH - 1) // PATCH, 2)), np.zeros(2))


def learnt(wheels: OdometryEdges, graph: Graph, certainty: Floats) -> tuple[OdometryEdges, Floor]:
    """Return the wheels with the noise of their steps as the residuals show it, and what patches of floor may add.

    Parameters
    ----------
    wheels : edges between neighbouring poses, in the order of the poses.
    certainty : (n, 3, 3) information of each pose, x, y, theta in the map, by measurements other than the wheels.
    """
    noise, patch = np.ones(3), np.zeros(2)
    if len(wheels) > PATCH:
        root = np.einsum("eii->ei", wheels.sqrt_information) / wheels.own_scale(graph)
        variance, residuals = _pose_variance(graph, certainty), wheels.residuals(graph)
        for k in range(3):
            one = _shown(residuals[:, k], (variance[wheels.i, k] + variance[wheels.j, k]) * root[:, k] ** 2)
            ten = _shown(*_summed(wheels, residuals[:, k], variance[:, k], root[:, k]))
            if one is None or ten is None:
                continue
            if k == 1:
                one = max(one, ten)
            else:
                reach = np.median(np.abs(wheels.length) * root[:, k])
                patch[k // 2] = np.sqrt(max(ten - one, 0.0) * _STRADDLED / PATCH) / max(reach, _SMALL)
            noise[k] = np.sqrt(one)
    return replace(wheels, sqrt_information=wheels.sqrt_information / noise[:, None]), replace(even(wheels), sigma=patch)


def _pose_variance(graph: Graph, certainty: Floats) -> Floats:
    """Return the variance (n, 3) of each pose ahead, sideways and in heading."""
    covariance = np.linalg.inv(certainty + np.eye(3) * 1e-3)
    c, s = np.cos(graph.poses[:, 2]), np.sin(graph.poses[:, 2])
    axes = np.zeros((len(c), 2, 3))
    axes[:, 0, 0], axes[:, 0, 1], axes[:, 1, 0], axes[:, 1, 1] = c, s, -s, c
    return np.column_stack([np.einsum("nai,nij,naj->na", axes, covariance, axes), covariance[:, 2, 2]])


def _summed(wheels: OdometryEdges, residual: Floats, variance: Floats, root: Floats) -> tuple[Floats, Floats]:
    """Return sums over consecutive steps, divided by the root of their number, and the variance that poses add to these."""
    ends = np.concatenate([[0.0], np.cumsum(residual)])
    roots = np.concatenate([[0.0], np.cumsum(root)])
    first, last = wheels.i[: 1 - PATCH], wheels.j[PATCH - 1 :]
    whole = np.flatnonzero(last - first == PATCH)
    mean = (roots[whole + PATCH] - roots[whole]) / PATCH
    added = (variance[first[whole]] + variance[last[whole]]) * mean**2 / PATCH
    return (ends[whole + PATCH] - ends[whole]) / np.sqrt(PATCH), added


def _shown(residual: Floats, added: Floats) -> float | None:
    """Return the variance of errors relative to that assumed, by residuals to which poses add a variance; None = not shown."""
    good = added < 1.0
    if good.sum() < _ENOUGH:
        return None
    residual, added = residual[good], added[good]
    return float(np.clip(spread(residual * (1.0 + added)) ** 2 - np.median(added), _LEAST**2, _MOST**2))


def equations(wheels: OdometryEdges, floor: Floor, graph: Graph, unknowns: Unknowns) -> Blocks:
    """Return what the floor adds to the normal equations of a graph that has the wheels among its edges, as blocks of four
    unknowns, of which two count."""
    linearized = wheels.linearize(graph)
    weight = kernel_weights(wheels, linearized.residuals)
    patch, root = np.arange(len(wheels)) // PATCH, np.einsum("eii->ei", wheels.sqrt_information) / wheels.own_scale(graph)
    by_floor = wheels.length[:, None] * root[:, [0, 2]]
    added, weighted = by_floor * floor.value[patch], weight[:, None] * by_floor
    many, rows = len(floor.value), 3 * np.arange(len(wheels))[:, None] + [0, 2]
    by_graph = rows_of(linearized, unknowns)[rows.ravel()]
    places = (4 * patch[:, None] + [0, 1]).ravel(), np.arange(rows.size)
    across = sparse.csr_matrix((weighted.ravel(), places), shape=(4 * many, rows.size)) @ by_graph
    prior = np.array([*np.maximum(floor.sigma, _SMALL), 1.0, 1.0]) ** -2.0
    own, own_slope = np.tile(np.diag(prior), (many, 1, 1)), np.zeros((many, 4))
    for k in range(2):
        own[:, k, k] += np.bincount(patch, weighted[:, k] * by_floor[:, k], many)
        slopes = weighted[:, k] * (linearized.residuals[:, 2 * k] + added[:, k])
        own_slope[:, k] = np.bincount(patch, slopes, many) + floor.value[:, k] * prior[k]
    slope = by_graph.T @ (weight[:, None] * added).ravel()
    return Blocks(sparse.csr_matrix((unknowns.size, unknowns.size)), across, own, slope, own_slope)
