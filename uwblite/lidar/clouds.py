"""Lidar clouds of all keyframes as one array: averaged in small cells, with normals that face the laser.

One flat array with offsets instead of a list of clouds: every step below runs once over all keyframes. Single precision,
a few micrometres at the reach of a lidar, and coordinates in one piece each: hours of clouds fit into memory.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..arrays import Bools, Floats, Ints, concatenated
from ..config import setting
from ..graph.work import Work
from ..odometry.attached import ScanPoints
from . import beam_gaps
from .point_cloud import Lines, cell_number, estimate_normals, make_tree, mean_by_key

_TURN = 8.0
"""rad; more than all bearings differ by."""
_BLOCK = 32
"""Keyframes whose neighbourhoods are looked up at once; bounds the memory."""


@dataclass(frozen=True, slots=True)
class CloudConfig:
    """How rays become the cloud of a keyframe."""

    voxel: float = 0.05
    """Cell over which points are averaged, m."""
    normal_radius: float = setting(0.2, advanced=True)
    """Neighbourhood of a normal, m."""
    min_neighbours: int = setting(3, advanced=True)
    """Points with fewer neighbours are left out as noise."""
    linearity: float = setting(0.7, advanced=True)
    """Least share of a neighbourhood's spread that lies along the line for its normal to count, 0..1. A right angle has
    about 0.75: corners fix where along a corridor the robot is."""
    raster: ClassVar[float] = 0.1
    """Cell of the tables of nearest points, m; smaller takes memory with the square and gains nothing on lines."""
    range_max: float = 30.0
    """Longer readings do not enter clouds, m."""


@dataclass(frozen=True, slots=True, eq=False)
class Clouds:
    """Clouds of k keyframes; cloud c owns rows offsets[c]:offsets[c + 1]."""

    offsets: Ints
    """(k + 1,)."""
    points: NDArray[np.floating]
    """(p, 2) m, base frame of the keyframe, ordered by bearing within a cloud. Where there is a line, the mean of the
    neighbourhood: that takes out noise, and on curved surfaces every cloud has the same error."""
    normals: NDArray[np.floating]
    """(p, 2) unit, towards the laser; 0 where the neighbourhood is no line."""
    owner: NDArray[np.signedinteger]
    """(p,) keyframe."""
    normal_variance: NDArray[np.floating]
    """(p,) rad^2, variance of the normal's angle by scatter about its line."""
    work: Work = field(default_factory=Work, repr=False)
    """To which the operations on these clouds, and on all that are made from them, are added; see graph/work.py."""

    def __len__(self) -> int:
        return len(self.offsets) - 1

    @property
    def counts(self) -> Ints:
        """(k,) points of each cloud."""
        return np.diff(self.offsets)

    def cloud(self, k: int) -> tuple[Floats, Floats]:
        """Return points and normals of one cloud, in double precision."""
        rows = slice(self.offsets[k], self.offsets[k + 1])
        return self.points[rows].astype(np.float64), self.normals[rows].astype(np.float64)

    def chosen(self, which: Ints) -> "Clouds":
        """Return some clouds (s,), in this order."""
        runs = np.split(which, np.flatnonzero(np.diff(which) != 1) + 1) if len(which) else []
        parts = [self._run(int(run[0]), int(run[-1]) + 1) for run in runs]
        return replace(joined(parts, self.points.dtype.type), work=self.work)

    def _run(self, first: int, end: int) -> "Clouds":
        """Return the clouds from one to another, without copying their points."""
        rows = slice(self.offsets[first], self.offsets[end])
        offsets, owner = self.offsets[first : end + 1] - self.offsets[first], self.owner[rows] - first
        return Clouds(offsets, self.points[rows], self.normals[rows], owner, self.normal_variance[rows])

    def only(self, kept: Bools) -> "Clouds":
        """Return the clouds with some of their points (p,) alone."""
        counts = np.bincount(self.owner[kept], minlength=len(self))
        offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.intp)
        arrays = (self.points[kept], self.normals[kept], self.owner[kept], self.normal_variance[kept])
        return Clouds(offsets, *arrays, self.work)


def build(rays: ScanPoints, keyframes: int, config: CloudConfig) -> Clouds:
    """Average rays in cells, drop lone points, estimate normals and order each cloud by bearing.

    Parameters
    ----------
    rays : points of all keyframes of a block, numbered from 0.
    keyframes : k, number of keyframes.
    """
    owner, points, origins = _average_cells(beam_gaps.filled(rays), config.voxel)
    # Points come by owner: to sort one number in runs takes a tenth of the time of two keys.
    order = np.argsort(_TURN * owner + se2.bearing(points), kind="stable")
    owner, points, origins = owner[order], points[order], origins[order]
    lines, normals = _lines(owner, points, origins, config)
    straight = lines.linearity >= config.linearity
    kept = lines.neighbours > config.min_neighbours
    normals = np.where(straight[:, None], normals, 0.0)[kept]
    centres = np.where(straight[:, None], lines.centers, points)[kept]
    owner = owner[kept]
    offsets = np.searchsorted(owner, np.arange(keyframes + 1))
    return Clouds(
        offsets.astype(np.intp),
        centres.astype(np.float32, order="F"),
        normals.astype(np.float32, order="F"),
        owner.astype(np.int32),
        lines.normal_variance[kept].astype(np.float32),
    )


def joined(parts: Sequence[Clouds], kind: type[np.floating] = np.float32) -> Clouds:
    """Return the clouds of several parts, one after the other, as one, in single precision or another kind."""
    starts = np.cumsum([0] + [len(p) for p in parts])
    counts = np.concatenate([p.counts for p in parts] or [np.zeros(0, dtype=np.intp)])
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.intp)
    size = int(offsets[-1])
    points, normals = (np.empty((size, 2), dtype=kind, order="F") for _ in range(2))
    whole = Clouds(offsets, points, normals, np.empty(size, dtype=np.int32), np.empty(size, dtype=kind))
    for part, first in zip(parts, starts.tolist(), strict=False):
        rows = slice(int(offsets[first]), int(offsets[first]) + len(part.points))
        whole.points[rows], whole.normals[rows], whole.normal_variance[rows] = part.points, part.normals, part.normal_variance
        whole.owner[rows] = part.owner + first
    return whole


def make_cloud(
    points: Floats, viewpoints: Floats | None = None, normal_radius: float = 0.25, work: Work | None = None
) -> Clouds:
    """Return one cloud of single points: a line is fitted to the surroundings of each.

    Parameters
    ----------
    points : (n, 2), m; of an even density.
    viewpoints : (n, 2) or (2,), where the sensor stood when it saw each point, m, same frame, towards which normals are
        turned. None: not known; the side to which a normal points then means nothing.
    normal_radius : neighbourhood of the lines, m; a few times the distance between points.
    """
    points = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 2)
    lines = estimate_normals(points, make_tree(points), normal_radius)
    straight = lines.linearity >= _STRAIGHT
    normals = np.where(straight[:, None], lines.normals, 0.0)
    if viewpoints is not None:
        away = np.einsum("ni,ni->n", viewpoints - points, normals) < 0.0
        normals = np.where(away[:, None], -normals, normals)
    variance = np.where(straight, lines.normal_variance, 0.0)
    arrays = (lines.centers, normals, np.zeros(len(points), dtype=np.int32), variance)
    return Clouds(np.array([0, len(points)]), *arrays, Work() if work is None else work)


_STRAIGHT = 0.6
"""Least linearity of a line through single points."""


def _average_cells(rays: ScanPoints, size: float) -> tuple[Ints, Floats, Floats]:
    """Return owner, mean point and mean origin of each cell of each keyframe."""
    key = cell_number(rays.keyframe, rays.points, size)
    one, mean = mean_by_key(key, np.concatenate([rays.points, rays.origins], axis=1))
    return rays.keyframe[one], mean[:, :2], mean[:, 2:]


def _lines(owner: Ints, points: Floats, origins: Floats, config: CloudConfig) -> tuple[Lines, Floats]:
    """Fit lines to all neighbourhoods; return them and normals (p, 2) turned towards the laser.

    A block of clouds shares one tree, in which they lie side by side.
    """
    parts = []
    blocks = np.searchsorted(owner, np.arange(0, owner.max(initial=0) + 1 + _BLOCK, _BLOCK))
    width = points[:, 0].max(initial=0.0) - points[:, 0].min(initial=0.0)
    for first, last in pairwise(blocks):
        block = points[first:last]
        apart = block.copy()
        apart[:, 0] += owner[first:last] * (width + 2.0 * config.normal_radius)
        parts.append(estimate_normals(block, make_tree(apart), config.normal_radius, config.min_neighbours))
    lines = concatenated(parts)
    facing = np.einsum("pi,pi->p", lines.normals, origins - points)
    return lines, lines.normals * np.where(facing < 0, -1.0, 1.0)[:, None]
