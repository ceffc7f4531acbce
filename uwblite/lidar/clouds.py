"""Lidar clouds of all keyframes as one array: averaged in small cells, with normals that face the laser.

Single precision is a few micrometres at the reach of a lidar; hours of clouds fit into memory.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..arrays import Bools, Floats, Ints, concatenated, dots, numbered
from ..config import setting
from ..graph.work import Work
from ..odometry.attached import ScanPoints
from .point_cloud import Lines, cell_number, estimate_normals, mean_by_key, neighbour_pairs

_TURN = 8.0
"""rad; more than all bearings differ by."""
CLOUDS_AT_ONCE = 64
"""Clouds that are processed together; bounds the memory."""


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
        return np.asarray(self.offsets[1:] - self.offsets[:-1])

    @property
    def lines(self) -> Bools:
        """(p,) whether each point has a normal."""
        return np.asarray((self.normals[:, 0] != 0.0) | (self.normals[:, 1] != 0.0))

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
    """Average rays of k keyframes, numbered from 0, in cells, drop lone points, estimate normals and order each cloud by
    bearing."""
    rays = filled(rays)
    cell = cell_number(rays.keyframe, rays.points, config.voxel)
    one, mean = mean_by_key(cell, rays.points)
    # Points come by owner: to sort one number in runs takes a tenth of the time of two keys.
    order = np.argsort(_TURN * rays.keyframe[one] + se2.bearing(mean), kind="stable")
    one, points = one[order], mean.take(order, axis=0)
    owner, origins = rays.keyframe[one], rays.origins.take(one, axis=0)
    lines = _lines(owner, points, config)
    straight = (lines.linearity >= config.linearity)[:, None]
    kept = np.flatnonzero(lines.neighbours > config.min_neighbours)
    normals = np.where(straight, facing(lines.normals, origins - points), 0.0).take(kept, axis=0)
    centres, owner = np.where(straight, lines.centers, points).take(kept, axis=0), owner.take(kept)
    return Clouds(
        np.searchsorted(owner, np.arange(keyframes + 1)).astype(np.intp),
        centres.astype(np.float32, order="F"),
        normals.astype(np.float32, order="F"),
        owner.astype(np.int32),
        lines.normal_variance.take(kept).astype(np.float32),
    )


def facing(normals: Floats, way: Floats) -> Floats:
    """Return normals (n, 2) turned to the side to which ways (n, 2) lead."""
    return normals * np.where(dots(normals, way) < 0.0, -1.0, 1.0)[:, None]


def _lines(owner: Ints, points: Floats, config: CloudConfig) -> Lines:
    """Fit lines to all neighbourhoods, of a block of clouds at a time."""
    parts = []
    blocks = np.searchsorted(owner, np.arange(0, owner.max(initial=0) + 1 + CLOUDS_AT_ONCE, CLOUDS_AT_ONCE))
    for first, last in pairwise(blocks):
        block = points[first:last]
        pairs = neighbour_pairs(owner[first:last], block, config.normal_radius)
        parts.append(estimate_normals(block, *pairs, config.min_neighbours))
    return concatenated(parts)


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


class GapPolicy:
    """Surfaces between the beams of a coarse lidar: points on the chord of two beams that hit one straight surface.

    With beams a degree apart, hits on a wall are 0.1 m apart at 6 m already, too far for a line. Where three neighbouring beams
    hit one line, it is taken as the surface between them; elsewhere the space between two beams is unknown.
    """

    spacing: float = 0.1
    """Distance between points, m, that makes lines: a neighbourhood of 0.2 m holds four others."""
    coarse: float = 0.0075
    """Angle between two beams, rad (0.43 degrees), from which on they are coarse. Finer beams that hit far apart graze a
    surface, whose shape between them is not measured; where they do not graze it they are dense enough."""
    widest: float = 0.6
    """Wider gaps are not filled, m: they may contain niches and doors."""
    reach: float = 15.0
    """Gaps farther away are not filled, m: the memory of rasters grows with the square of a cloud's extent."""
    noise: float = 0.04
    """Largest distance of the next hit from the line through two others, m."""
    bend: float = 0.08
    """The same as a share of its distance along this line."""
    least_beside: float = 0.4
    """Least ratio of neighbouring gaps on one line, at any grazing angle."""


def filled(rays: ScanPoints) -> ScanPoints:
    """Return the points of scans with further ones in the gaps between beams that hit one straight surface."""
    first = _on_one_line(rays)
    if not len(first):
        return rays
    step = rays.points[first + 1] - rays.points[first]
    parts = np.ceil(np.hypot(step[:, 0], step[:, 1]) / GapPolicy.spacing).astype(np.intp)
    own, number = numbered(parts - 1)
    share = ((number + 1) / parts[own])[:, None]
    rows = np.concatenate([np.arange(len(rays.ray)), first[own]])
    order = np.argsort(rows, kind="stable")

    def column(values: Floats) -> Floats:
        between = values[first[own]] + share * (values[first[own] + 1] - values[first[own]])
        return np.concatenate([values, between])[order]

    rows = rows[order]
    return replace(rays.rows(rows), points=column(rays.points), origins=column(rays.origins))


def _on_one_line(rays: ScanPoints) -> Ints:
    """Return the hits behind which there is a gap to be filled: to the next beam's, on a line with the one before or behind."""
    beside = np.zeros(len(rays.ray), dtype=bool)
    beside[:-1] = (rays.scan[1:] == rays.scan[:-1]) & (rays.ray[1:] - rays.ray[:-1] == 1)
    if not beside.any():
        return np.zeros(0, dtype=np.intp)
    step = np.diff(rays.points, axis=0, append=np.nan)
    gap = np.hypot(step[:, 0], step[:, 1])
    short = beside & (gap < GapPolicy.widest)
    wide = np.flatnonzero(short & (gap > GapPolicy.spacing))
    beam = rays.points[wide] - rays.origins[wide]
    reach = np.hypot(beam[:, 0], beam[:, 1])
    coarse = np.abs(step[wide, 0] * beam[:, 1] - step[wide, 1] * beam[:, 0]) > GapPolicy.coarse * reach * reach
    wide = wide[coarse & (reach < GapPolicy.reach)]
    # There is no gap behind the last hit and none before the first: the last one stands for it.
    before, after = (short[wide + k] & _continues(step[wide], step[wide + k]) for k in (-1, 1))
    return np.asarray(wide[before | after])


def _continues(step: Floats, other: Floats) -> Bools:
    """Return which steps (p, 2) from hit to hit continue neighbouring ones (p, 2) in a straight line with similar lengths."""
    length = np.hypot(step[:, 0], step[:, 1])
    along = np.sum(step * other, axis=1) / length
    across = np.abs(step[:, 0] * other[:, 1] - step[:, 1] * other[:, 0]) / length
    return np.asarray((along > GapPolicy.least_beside * length) & (across < GapPolicy.noise + GapPolicy.bend * along))
