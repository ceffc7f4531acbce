"""The time that a scan takes, from how clouds fit that were seen at other headings and velocities.

A log may give all rays of a scan one stamp, or a wrong time between them. Then a ray at the share f of the scan, from -1/2 to
1/2, was cast from f d v further along the base's motion v than the cloud says, where d is the missing duration. No motion of
the whole cloud takes that up, and between clouds of other headings or velocities it does not cancel: d is an unknown that all
pairs of clouds have in common, beside the relative pose of each.
"""

import numpy as np

from .. import se2
from ..arrays import ENOUGH, Floats, Ints
from ..sensor_log import LaserScans, SensorMounting
from .cloud_rasters import CloudRasters
from .scan_matching import SINGULAR, CloudPairs, PairPolicy, correspondences

PARTS = 8
"""Parts of a recording whose estimates are compared."""


class MovedRays:
    """Where the points of clouds would be if a scan took 1 s longer."""

    def __init__(self, raster: CloudRasters, twist: Floats, scans: LaserScans, mounting: SensorMounting) -> None:
        """Take clouds made from scans, and the velocity (k, 3) of the base at the keyframes, m/s, m/s, rad/s."""
        self._clouds, self._twist, self._laser = raster.clouds, twist, mounting.T_base_laser
        spanned, sign = scans.angle_increment * (scans.ranges.shape[1] - 1), -1.0 if mounting.laser_flipped else 1.0
        self._spanned, self._middle = sign * spanned, self._laser[2] + sign * (scans.angle_min + 0.5 * spanned)

    def per_second(self, rows: Ints) -> tuple[Floats, Floats]:
        """Return the motion (...), (...) of points in x and y of their cloud, m/s, by rows (...) in the clouds' arrays."""
        points = self._clouds.points[rows].astype(np.float64)
        bearing = se2.bearing(points - self._laser[:2]) - self._middle
        share = se2.wrap_angle(bearing) / self._spanned
        vx, vy, turn = np.moveaxis(self._twist[self._clouds.owner[rows]], -1, 0)
        return share * (vx - turn * points[..., 1]), share * (vy + turn * points[..., 0])


def missing_duration(raster: CloudRasters, pairs: CloudPairs, T_i_j: Floats, rays: MovedRays) -> tuple[Floats, Floats]:
    """Return the missing duration of a scan in parts of a recording (p,) that show one, and its standard deviation (p,), s.

    Parameters
    ----------
    pairs : (e,) in the order of time. T_i_j : (e, 3) their relative poses, which stay unknowns.
    """
    gate = PairPolicy.gate
    found, squared, weight = [], 0.0, 0.0
    for some in correspondences(raster, pairs, T_i_j, gate):
        (nx, ny), (rx, ry), theta = some.normal, some.arm, T_i_j[some.pairs, 2][:, None]
        (ix, iy), (jx, jy) = rays.per_second(some.target), rays.per_second(some.row)
        c, s = se2.cos_sin(theta)
        moved = nx * (c * jx - s * jy - ix) + ny * (s * jx + c * jy - iy)
        root = some.good / (1.0 + np.square(2.0 * some.distance / gate))
        columns = np.stack([nx, ny, ny * rx - nx * ry, moved, some.distance], axis=1) * root[:, None]
        found.append(columns @ columns.transpose(0, 2, 1))
        squared, weight = squared + float(found[-1][:, -1, -1].sum()), weight + float(np.square(root).sum())
    normal, (dof,) = np.concatenate(found), se2.POSE
    kept = np.flatnonzero(normal[:, 0, 0] + normal[:, 1, 1] > 0.0)
    normal = normal[kept]
    of_pose, across = normal[:, :dof, :dof], normal[:, :dof, dof:]
    floor = SINGULAR * np.trace(of_pose, axis1=1, axis2=2)[:, None, None] * np.eye(dof)
    left = normal[:, dof:, dof:] - across.transpose(0, 2, 1) @ np.linalg.solve(of_pose + floor, across)
    variance = PairPolicy.correlation * squared / max(weight, 1.0)
    part = kept * min(PARTS, max(len(pairs) // ENOUGH, 1)) // max(len(pairs), 1)
    information, gradient = (np.bincount(part, left[:, 0, k]) for k in (0, 1))
    shown = information > 0.0
    return -gradient[shown] / information[shown], np.sqrt(variance / information[shown])
