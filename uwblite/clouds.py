"""Lidar clouds of all keyframes as one array: averaged in small cells, with normals that face the laser.

One flat array with offsets instead of a list of clouds: every step below runs once over all keyframes.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from . import se2
from .keyframes import ScanPoints

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class CloudConfig:
    """How rays become the cloud of a keyframe."""

    voxel: float = 0.05
    """Cell over which points are averaged, m."""
    normal_radius: float = 0.2
    """Neighbourhood of a normal, m."""
    min_neighbours: int = 3
    """Points with fewer neighbours are left out as noise."""
    linearity: float = 0.85
    """Least share of a neighbourhood's spread that lies along the line for its normal to count, 0..1."""
    range_max: float = 30.0
    """Longer readings do not enter clouds, m."""


@dataclass(frozen=True, slots=True, eq=False)
class Clouds:
    """Clouds of k keyframes; cloud c owns rows offsets[c]:offsets[c + 1]."""

    offsets: Ints
    """(k + 1,)."""
    points: Floats
    """(p, 2) m, base frame of the keyframe, ordered by bearing within a cloud."""
    normals: Floats
    """(p, 2) unit, towards the laser; 0 where the neighbourhood is no line."""
    owner: Ints
    """(p,) keyframe."""

    def __len__(self) -> int:
        return len(self.offsets) - 1

    @property
    def counts(self) -> Ints:
        """(k,) points of each cloud."""
        return np.diff(self.offsets)

    def cloud(self, k: int) -> tuple[Floats, Floats]:
        """Return points and normals of one cloud."""
        rows = slice(self.offsets[k], self.offsets[k + 1])
        return self.points[rows], self.normals[rows]


def build(rays: ScanPoints, keyframes: int, config: CloudConfig) -> Clouds:
    """Average rays in cells, drop lone points, estimate normals and order each cloud by bearing.

    Parameters
    ----------
    rays : points of all keyframes.
    keyframes : k, number of keyframes.
    """
    owner, points, origins = _average_cells(rays, config.voxel)
    bearing = np.arctan2(points[:, 1], points[:, 0])
    order = np.lexsort((bearing, owner))
    owner, points, origins = owner[order], points[order], origins[order]
    normals, neighbours = _normals(owner, points, origins, config)
    kept = neighbours >= config.min_neighbours
    owner, points, normals = owner[kept], points[kept], normals[kept]
    offsets = np.searchsorted(owner, np.arange(keyframes + 1))
    return Clouds(offsets.astype(np.int64), points, normals, owner)


def _average_cells(rays: ScanPoints, size: float) -> tuple[Ints, Floats, Floats]:
    """Return owner, mean point and mean origin of each cell of each keyframe."""
    cell = np.floor(rays.points / size).astype(np.int64)
    cell -= cell.min(axis=0, initial=0)
    wide, high = cell.max(axis=0, initial=0) + 1
    key = (rays.keyframe * wide + cell[:, 0]) * high + cell[:, 1]
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.concatenate([[True], np.diff(key[order]) > 0])) if len(key) else np.zeros(0, dtype=np.int64)
    count = np.diff(np.append(first, len(key)))[:, None]
    both = np.concatenate([rays.points, rays.origins], axis=1)[order]
    mean = np.add.reduceat(both, first, axis=0) / count if len(key) else both
    return rays.keyframe[order][first], mean[:, :2], mean[:, 2:]


def _normals(owner: Ints, points: Floats, origins: Floats, config: CloudConfig) -> tuple[Floats, Ints]:
    """Return normals (p, 2) and the number of neighbours (p,) within the radius, by principal axes.

    All clouds share one tree: a third coordinate keeps them apart.
    """
    if not len(points):
        return np.zeros((0, 2)), np.zeros(0, dtype=np.int64)
    apart = np.column_stack([points, owner * (4.0 * config.normal_radius)])
    tree = cKDTree(apart, balanced_tree=False, compact_nodes=False)
    near = 8
    distance, index = tree.query(apart, k=near + 1, distance_upper_bound=config.normal_radius)
    found = np.isfinite(distance)
    count = found.sum(axis=1)
    padded = np.concatenate([points, np.zeros((1, 2))])
    members = padded[np.where(found, index, len(points))]
    mean = members.sum(axis=1) / count[:, None]
    centred = np.where(found[:, :, None], members - mean[:, None, :], 0.0)
    xx, yy = np.einsum("pk,pk->p", centred[:, :, 0], centred[:, :, 0]), np.einsum("pk,pk->p", centred[:, :, 1], centred[:, :, 1])
    xy = np.einsum("pk,pk->p", centred[:, :, 0], centred[:, :, 1])
    half, spread = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
    along = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    normals = np.stack([-np.sin(along), np.cos(along)], axis=1)
    facing = np.einsum("pi,pi->p", normals, origins - points)
    normals *= np.where(facing < 0, -1.0, 1.0)[:, None]
    linear = half + spread > 0
    linearity = np.where(linear, 1.0 - (half - spread) / np.where(linear, half + spread, 1.0), 0.0)
    good = (count >= 4) & (linearity >= config.linearity)
    return np.where(good[:, None], normals, 0.0), (count - 1).astype(np.int64)


def in_map(clouds: Clouds, poses: Floats) -> tuple[Floats, Floats]:
    """Return all points and normals (p, 2) in the map frame, given keyframe poses (k, 3)."""
    own = poses[clouds.owner]
    return se2.transform(own, clouds.points), se2.rotate(own[:, 2], clouds.normals)
