"""Sub-maps: the trajectory cut by travelled distance, each piece's clouds merged in the frame of its middle keyframe.

(Paper, section on sub-maps: scans gathered while the travelled distance stays below epsilon, then filtered.)
"""

import itertools
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from .. import se2
from ..arrays import OUTLIER, Floats, Ints, chunks, rms_length
from ..config import setting
from .clouds import Clouds, joined
from .point_cloud import cell_number, mean_by_key, radius_outlier_filter, statistical_outlier_filter

_CLOUDS = 1024
"""That are merged together; bounds the memory."""
_FACINGS = 4


@dataclass(frozen=True, slots=True)
class SubmapConfig:
    """Size and cleaning of sub-maps."""

    epsilon: float = 5.0
    """Travelled distance of one sub-map, m (the paper's epsilon; it uses 9)."""
    voxel: float = setting(0.08, advanced=True)
    """Cell over which points are averaged, m."""
    neighbours: ClassVar[int] = 8
    """Statistical filter: number of nearest neighbours."""
    std_ratio: float = setting(OUTLIER, advanced=True)
    """Statistical filter: a point is removed whose neighbours lie farther than the mean by so many standard deviations."""
    radius: ClassVar[float] = 0.25
    """Radius filter: m."""
    min_neighbours: int = setting(2, advanced=True)
    """Radius filter: a point with fewer neighbours within the radius is removed."""


@dataclass(frozen=True, slots=True, eq=False)
class Submaps:
    """All sub-maps of a graph."""

    first: Ints
    """(s,) first keyframe of each."""
    last: Ints
    """(s,) one past its last keyframe."""
    reference: Ints
    """(s,) keyframe in whose frame its points stand."""
    clouds: Clouds
    """s clouds, in the frames of the reference keyframes."""
    spacing: float
    """Distance between neighbouring points of a cloud, m."""

    def __len__(self) -> int:
        return len(self.first)

    def bent(self, before: Floats, after: Floats) -> float:
        """Return how far keyframes have moved in the frames of their sub-maps, rms, m; from all present poses (k, 3)."""
        of = np.repeat(self.reference, self.last - self.first)
        one, other = (se2.between(poses[of], poses[self.first[0] : self.last[-1]]) for poses in (before, after))
        return rms_length((one - other)[:, :2])


def cut(path: Floats, recording: Ints, epsilon: float) -> tuple[Ints, Ints, Ints]:
    """Cut keyframes with travelled distances path (k,), m, into pieces no longer than epsilon, m, each of one recording, and
    return the first (s,), one past the last (s,) and the reference keyframe (s,) of each: that in the middle."""
    piece = np.floor((path - path[0]) / epsilon).astype(np.intp) if epsilon > 0 else np.arange(len(path))
    change = np.concatenate([[True], (np.diff(piece) != 0) | (np.diff(recording) != 0)])
    first = np.flatnonzero(change)
    last = np.append(first[1:], len(path))
    return first, last, (first + last - 1) // 2


def build(clouds: Clouds, poses: Floats, path: Floats, recording: Ints, config: SubmapConfig) -> Submaps:
    """Merge the clouds of each piece of the trajectory, with poses (k, 3) T_map_base, and filter them; see cut."""
    return of_pieces(clouds, poses, *cut(path, recording, config.epsilon), config)


def of_pieces(clouds: Clouds, poses: Floats, first: Ints, last: Ints, reference: Ints, config: SubmapConfig) -> Submaps:
    """Merge the clouds of pieces that begin with the keyframes first (s,) and end before last (s,) in the frames of reference
    keyframes (s,), and filter them: voxel, statistical, radius."""
    # Long pieces have many clouds each.
    at_once = max(_CLOUDS * len(first) // max(int(np.sum(last - first)), 1), 1)
    parts = [
        _built(clouds, poses, first[some], last[some], reference[some], config) for some in chunks(len(first), at_once)
    ]
    return Submaps(first, last, reference, replace(joined(parts), work=clouds.work), config.voxel)


def _built(clouds: Clouds, poses: Floats, first: Ints, last: Ints, reference: Ints, config: SubmapConfig) -> Clouds:
    """Return the clouds of some sub-maps."""
    keyframes = np.concatenate([np.arange(a, b) for a, b in zip(first, last, strict=True)])
    piece = np.repeat(np.arange(len(first)), last - first)
    own = clouds.chosen(keyframes)
    relative = se2.between(poses[reference[piece]], poses[keyframes])
    points = se2.transform_each(relative, own.owner, own.points)
    normals = se2.rotate_each(relative[:, 2], own.owner, own.normals)
    # The two sides of a wall stay apart by facing: one of four, not two, because for no direction of the wall may noise turn a
    # normal from one side's facing into the other's.
    facing = np.floor(se2.bearing(normals) * (2.0 / np.pi) + 0.5).astype(np.intp) % _FACINGS
    key = cell_number(piece[own.owner], points, config.voxel) * _FACINGS + facing
    one, mean = mean_by_key(key, np.column_stack([points, normals, own.normal_variance]))
    points, normals, scatter = mean[:, :2], mean[:, 2:-1], mean[:, -1]
    length = np.hypot(*normals.T)
    clear = length > 0.5
    normals = np.where(clear[:, None], normals / np.where(clear, length, 1.0)[:, None], 0.0)
    number = piece[own.owner[one]]
    kept = np.ones(len(number), dtype=bool)
    offsets = np.searchsorted(number, np.arange(len(first) + 1)).astype(np.intp)
    for a, b in itertools.pairwise(offsets):
        if b > a:
            kept[a:b] = statistical_outlier_filter(points[a:b], config.neighbours, config.std_ratio)
            inner = np.flatnonzero(kept[a:b]) + a
            kept[inner] = radius_outlier_filter(points[inner], config.radius, config.min_neighbours)
    return Clouds(offsets, points, normals, number, scatter, clouds.work).only(kept)
