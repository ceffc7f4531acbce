"""Noise of wheels, and errors common to patches of floor as unknowns, learnt at poses that a lidar determines.

Carpet, cross slopes and smooth patches cause the same error in all steps on them: the errors of sums of steps grow faster than
with the square root of the distance. So the residuals of single steps show the noise of steps, and those of sums over ten (3 m)
the common errors. Poses that rays on surfaces determine have errors too, and follow the wheels by their weight: an error with
variance w, assumed as s, and a measurement with variance v leave a residual with variance (s / (s + v))^2 (w + v).

A step sideways, in the frame in its middle, is slip: for rolling wheels it is far below the assumed noise.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from ..arrays import Floats, spread
from ..graph.eliminated import Blocks, rows_of
from ..graph.graph import Graph, kernel_weights
from ..graph.pose_edges import OdometryEdges
from ..graph.unknowns import Unknowns

PATCH = 10
"""Steps over which errors of the floor are correlated: 3 m."""
_ENOUGH = 60
"""Least number of residuals, measured better than the assumed noise, from which a noise is learnt."""
_LEAST, _MOST = 0.25, 3.0
"""Smallest and largest noise relative to that assumed."""
_STRADDLED = 1.5
"""Ratio of the variance of an error per patch to that from sums that begin anywhere and lie on two patches."""
_SMALL = 1e-6
"""Standard deviation of an error that is known to be absent."""


@dataclass(frozen=True, slots=True, eq=False)
class Floor:
    """Errors that patches of floor, of so many steps each, add to the odometry."""

    value: Floats
    """(p, 2) relative error of distance, and turn, rad/m."""
    sigma: Floats
    """(2,) prior standard deviations of these about 0."""

    def moved(self, step: Floats) -> "Floor":
        """Return the floor after a step (p, 4), of which two columns are used."""
        return replace(self, value=self.value + step[:, :2])


def even(wheels: OdometryEdges) -> Floor:
    """Return a floor that adds nothing."""
    return Floor(np.zeros(((len(wheels) + PATCH - 1) // PATCH, 2)), np.zeros(2))


def learnt(wheels: OdometryEdges, graph: Graph, certainty: Floats) -> tuple[OdometryEdges, Floor]:
    """Return the wheels with the noise of their steps as learnt from the residuals, and priors of errors of patches of floor.

    Parameters
    ----------
    wheels : edges between neighbouring poses, in the order of the poses.
    certainty : (n, 3, 3) information of each pose, x, y, theta in the map, by measurements other than the wheels.
    """
    noise, patch = np.ones(3), np.zeros(2)
    if len(wheels) > PATCH:
        shown = _steps_and_sums(wheels, graph, certainty)
        root = np.einsum("eii->ei", wheels.sqrt_information) / wheels.own_scale(graph)
        for k, ((one, of_one), (ten, of_ten)) in enumerate(shown):
            if min(of_one, of_ten) < _ENOUGH:
                continue
            if k == 1:
                one = max(one, ten)
            else:
                reach = np.median(np.abs(wheels.length) * root[:, k])
                patch[k // 2] = np.sqrt(max(ten - one, 0.0) * _STRADDLED / PATCH) / max(reach, _SMALL)
            noise[k] = np.sqrt(one)
    return replace(wheels, sqrt_information=wheels.sqrt_information / noise[:, None]), replace(even(wheels), sigma=patch)


_Shown = tuple[float, int]
"""Variance relative to that assumed, and how many residuals show it."""


def _steps_and_sums(wheels: OdometryEdges, graph: Graph, certainty: Floats) -> Iterator[tuple[_Shown, _Shown]]:
    """Yield ahead, sideways and in heading the variance of the errors of steps (e,), and that per step of their sums over ten
    consecutive ones, which lie on one or two patches of floor; see `learnt`."""
    root = np.einsum("eii->ei", wheels.sqrt_information) / wheels.own_scale(graph)
    pose, residuals = _pose_variance(graph, certainty), wheels.residuals(graph)
    ends, roots = (np.concatenate([np.zeros((1, 3)), np.cumsum(v, axis=0)]) for v in (residuals, root))
    # Windows that cross the boundary of two recordings are excluded.
    ten = np.flatnonzero(wheels.j[PATCH - 1 :] - wheels.i[: 1 - PATCH] == PATCH)
    of_one = (pose[wheels.i] + pose[wheels.j]) * root**2
    mean = (roots[ten + PATCH] - roots[ten]) / PATCH
    of_ten = (pose[wheels.i[ten]] + pose[wheels.j[ten + PATCH - 1]]) * mean**2 / PATCH
    summed = (ends[ten + PATCH] - ends[ten]) / np.sqrt(PATCH)
    for k in range(3):
        yield _shown(residuals[:, k], of_one[:, k]), _shown(summed[:, k], of_ten[:, k])


def _pose_variance(graph: Graph, certainty: Floats) -> Floats:
    """Return the variance (n, 3) of each pose ahead, sideways and in heading."""
    covariance = np.linalg.inv(certainty + np.eye(3) * 1e-3)
    c, s = np.cos(graph.poses[:, 2]), np.sin(graph.poses[:, 2])
    axes = np.zeros((len(c), 2, 3))
    axes[:, 0, 0], axes[:, 0, 1], axes[:, 1, 0], axes[:, 1, 1] = c, s, -s, c
    return np.column_stack([np.einsum("nai,nij,naj->na", axes, covariance, axes), covariance[:, 2, 2]])


def _shown(residual: Floats, added: Floats) -> _Shown:
    """Return the variance of errors by residuals to which poses add a variance; only those that poses check well are used."""
    good = added < 1.0
    if not good.any():
        return 1.0, 0
    residual, added = residual[good], added[good]
    variance = spread(residual * (1.0 + added)) ** 2 - np.median(added)
    return float(np.clip(variance, _LEAST**2, _MOST**2)), int(good.sum())


def equations(wheels: OdometryEdges, floor: Floor, graph: Graph, unknowns: Unknowns) -> Blocks:
    """Return the terms that the floor adds to the normal equations of a graph with the wheels among its edges, as blocks of
    four unknowns, of which two are used."""
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
