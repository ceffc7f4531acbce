"""Test whether sensors and map have the same unit of length.

A map that was drawn, converted or measured in another unit still looks like the place: near every wall the pose follows the
wall. But from the right place all distances are too long, or too short, by the same factor. So the pose
is matched once more together with two scales, one of the lidar's (or the radio's) distances and one of the motion between the
measurements, which belongs to the wheels and absorbs their error.
"""

from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Floats
from .hypotheses import INDEPENDENT, SLOW_SIGMA, WALL_SIGMA
from .range_likelihood import range_errors
from .walls import Rays, Walls
from .window import Ranges

_PRIOR = (0.3, 0.3, 0.1, 0.1, 0.3)
"""m, m, rad, 1, 1; prior of pose, motion and distances."""
_NO_SCALE = 1e-6
"""Prior of distances in the unit of the map."""
_GATES = ((0.5, 0.3), (0.5, 0.3), (0.4, 0.2), (0.4, 0.15), (0.4, 0.15))
"""m; gate and kernel width of each iteration, wide: in a map 5 % too large the far wall of a room of 5 m is off by 0.25 m."""
_ITERATIONS = 6
SCAN_LIMIT, RANGE_LIMIT = 0.03, 0.05
"""Relative error of a lidar or a map: data sheets allow 1 to 3 %; for radios, the delay by walls is added."""
_SURE = 4.0
"""Standard deviations from which a scale error is certain."""


@dataclass(frozen=True, slots=True)
class Scale:
    """Relative difference of the map's distances from those of the sensor."""

    error: float
    """Relative, 1."""
    sigma: float
    """Its standard deviation, 1."""
    gain: float = np.inf
    """Log-likelihood by which it explains the measurements better than an error of 0 does."""

    def off(self, limit: float) -> bool:
        """Return whether map and sensor are in different units for certain."""
        return abs(self.error) > max(limit, _SURE * self.sigma) and self.gain > 0.5 * _SURE**2


def scan_scale(walls: Walls, pose: Floats, rays: Rays, looks: int) -> Scale:
    """Match the rays of several scans with pose, motion scale and distance scale free.

    Parameters
    ----------
    pose : (3,) about which they match. rays : in the present frame of the base. looks : scans they are of.

    Notes
    -----
    Along a single wall every scale fits, with a pose that is moved accordingly; the match then ends at an arbitrary scale, and
    its standard deviation does not show that. So a scale that is off is compared with a match in the map's own unit.
    """
    error, sigma, whole = _matched(walls, pose, rays, looks, _PRIOR[4])
    found = Scale(error, sigma)
    return Scale(error, sigma, whole - _matched(walls, pose, rays, looks, _NO_SCALE)[2]) if found.off(SCAN_LIMIT) else found


def _matched(walls: Walls, pose: Floats, rays: Rays, looks: int, prior: float) -> tuple[float, float, float]:
    """Return the scale of the distances, its standard deviation, and the log-likelihood, with the priors' part."""
    x, information = np.zeros(5), np.diag(1.0 / np.square((*_PRIOR[:4], prior)))
    start, beam = np.append(pose, (0.0, 0.0)), rays.ends - rays.origins
    hessian, scaled = information, rays
    for gate, width in _GATES:
        h, _, g, weight = walls.factors((start + x)[None, :3], scaled, gate, width, (rays.origins, beam))
        share = min(INDEPENDENT * looks / max(float(weight[0]), 1e-9), 1.0) / WALL_SIGMA**2
        hessian = information + share * h[0]
        x = x - np.linalg.solve(hessian, share * g[0] + information @ x)
        origins = rays.origins * (1.0 + x[3])
        scaled = Rays(origins + beam * (1.0 + x[4]), origins, rays.hit)
    agreement = float(walls.agreement((start + x)[None, :3], scaled).log_likelihood[0])
    value = min(len(rays.hit), INDEPENDENT * looks) * agreement - 0.5 * float(x @ information @ x)
    return float(x[4]), float(np.sqrt(np.linalg.inv(hessian)[4, 4])), value


def range_scale(pose: Floats, ranges: Ranges) -> Scale:
    """Fit pose, way, distances and one constant error per anchor to the ranges.

    Notes
    -----
    Gauss-Newton with Cauchy kernels, on the ranges and on the anchors' errors: an anchor that was moved by metres explains its
    own ranges, and does not look like another unit; errors that all anchors share do.
    """
    names, anchor = np.unique(ranges.anchor, return_inverse=True)
    own = np.eye(len(names))[anchor]
    prior = 1.0 / np.square(np.append(_PRIOR, np.full(len(names), SLOW_SIGMA)))
    x, hessian = np.zeros(5 + len(names)), np.diag(prior)
    for _ in range(_ITERATIONS):
        tags = ranges.tags * (1.0 + x[3])
        now = replace(ranges, tags=tags, values=ranges.values * (1.0 + x[4]) - own @ x[5:])
        error, offset, lever = (v[0] for v in range_errors((pose + x[:3])[None], now))
        unit = offset / np.maximum(np.hypot(*offset.T), 0.05)[:, None]
        turned = unit[:, 1] * lever[:, 0] - unit[:, 0] * lever[:, 1]
        along = (unit * lever).sum(axis=1) / (1.0 + x[3])
        jacobian = np.column_stack([unit, turned, along, -ranges.values, own])
        weight = _cauchy(error, ranges.sigma) / ranges.sigma**2
        information = np.diag(prior * np.append(np.ones(5), _cauchy(x[5:], SLOW_SIGMA)))
        hessian = information + (jacobian * weight[:, None]).T @ jacobian
        x = x - np.linalg.solve(hessian, information @ x - jacobian.T @ (weight * error))
    return Scale(float(x[4]), float(np.sqrt(np.linalg.inv(hessian)[4, 4])))


def _cauchy(error: Floats, sigma: Floats | float) -> Floats:
    """Return the weights of errors with a Cauchy kernel of two standard deviations."""
    return np.asarray(1.0 / (1.0 + np.square(error / (2.0 * sigma))))
