"""Pieces of wall that are one wall: on one line, with one range offset, and nothing was seen through the gap between them.

Clouds show a wall in pieces, since objects in front of it hide parts. One wall of many metres constrains headings better than
its pieces do; but the wall on the other side of a door may have another colour and another plane. So pieces are joined where
their places, directions and range offsets agree, where the gap is short, and where no ray has passed through it.
"""

from dataclasses import dataclass, replace

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, Ints, Table, concatenated, connected, dots
from .stretches import extent
from .surface_rays import MeasuredSurfaces, SurfaceRays, Surfaces

_LEAN, _OFF = 0.15, 0.05
"""Largest difference of directions, rad, and of places across, m, with which pieces are compared at all."""
_GAP, _CLOSE = 2.0, 0.1
"""Longest gap, m, and longest gap that is joined without a test for rays through it, m."""
_CHI2 = 11.3
"""Largest chi2 of three between pieces: its 99 % quantile."""
_BENT = np.array([0.002, 0.003, 0.0])
"""Differences of pieces of one wall in direction, rad, place, m, and offset, m, beside the noise of their rays (1 sigma)."""
_FRONT, _BEHIND = 0.05, 0.12
"""A ray has passed through a gap that begins in front of the wall and ends behind it by so much, m."""
_THROUGH = 3
"""Least number of rays through a gap that show it to be open."""
_SAMPLE = 1 << 17
"""Most rays that are tested for passing through a gap."""


@dataclass(frozen=True, slots=True, eq=False)
class _Gaps(Table):
    """Pairs (e) of pieces that may be one wall."""

    one: Ints
    other: Ints
    first: Floats
    """(e,) m, where the gap begins, along the line of the one piece from its own place; overlaps begin after they end."""
    last: Floats
    """(e,) m, where it ends."""


def with_joined_walls(found: MeasuredSurfaces, information: Floats, sensors: Floats) -> tuple[MeasuredSurfaces, Ints]:
    """Return the surfaces with pieces of one wall as one, and the number (s,) of each surface among them.

    Parameters
    ----------
    information : (s, 4, 4) of each surface from its rays, by the step of Surfaces.moved. sensors : (k, 3) frames of the
        keyframes' rays in the map.
    """
    surfaces, rays = found.surfaces, found.rays
    gaps = _agreeing(surfaces, _gaps(surfaces, rays, sensors), information)
    closed = gaps.last - gaps.first < _CLOSE
    number = connected(gaps.one[closed], gaps.other[closed], len(surfaces.facing))
    asked = np.flatnonzero(number[gaps.one] != number[gaps.other])
    closed[asked] = ~_seen_through(surfaces, rays, sensors, gaps.rows(asked))
    number = connected(gaps.one[closed], gaps.other[closed], len(surfaces.facing))
    # Each joined wall takes the values of its piece with most rays.
    by_rays = np.lexsort((np.bincount(rays.surface, minlength=len(number)), number))
    largest = by_rays[np.flatnonzero(np.diff(number[by_rays], append=-1))]
    kept, of = np.unique(largest[number], return_inverse=True)
    joined = surfaces.rows(kept)
    return replace(found, surfaces=joined, rays=replace(rays, surface=of[rays.surface]).by_keyframe(joined)), of


def _gaps(surfaces: Surfaces, rays: SurfaceRays, sensors: Floats) -> _Gaps:
    """Return the pairs of walls that lie and face about alike and are not far apart."""
    normal, way = surfaces.normal, surfaces.tangent
    ended = se2.transform_each(sensors, rays.keyframe, rays.points)
    along = dots(ended - surfaces.place.take(rays.surface, axis=0), way.take(rays.surface, axis=0))
    first, last = extent(rays.surface, along, len(normal))
    walls = np.flatnonzero(~surfaces.round & (last > first))
    found = [_Gaps(walls[:0], walls[:0], np.zeros(0), np.zeros(0))]
    for k, one in enumerate(walls.tolist()):
        other = walls[k + 1 :]
        step = surfaces.place[other] - surfaces.place[one]
        at, lean = step @ way[one], np.abs(se2.wrap_angle(surfaces.facing[other] - surfaces.facing[one]))
        begin, end = at + first[other], at + last[other]
        after = begin > first[one] + 0.5 * (last[one] - first[one]) - 0.5 * (end - begin)
        gap_first, gap_last = np.where(after, last[one], end), np.where(after, begin, first[one])
        middle = surfaces.place[one] + 0.5 * (gap_first + gap_last)[:, None] * way[one]
        off = np.abs(dots(middle - surfaces.place[other], normal[other]))
        near = np.flatnonzero((lean < _LEAN) & (gap_last - gap_first < _GAP) & (off < _OFF))
        found.append(_Gaps(np.full(len(near), one), other[near], gap_first[near], gap_last[near]))
    return concatenated(found)


def _agreeing(surfaces: Surfaces, gaps: _Gaps, information: Floats) -> _Gaps:
    """Return the pairs whose lines agree at the gap, and their offsets."""
    covariance = np.linalg.inv(information[:, :3, :3])
    normal, way = surfaces.normal, surfaces.tangent
    middle = surfaces.place[gaps.one] + (0.5 * (gaps.first + gaps.last))[:, None] * way[gaps.one]
    total, lines = np.tile(np.diag(_BENT**2), (len(gaps.one), 1, 1)), []
    for side in (gaps.one, gaps.other):
        away = middle - surfaces.place[side]
        turn = np.tile(np.eye(3), (len(side), 1, 1))
        turn[:, 1, 0] = -dots(away, way[side])
        total += turn @ covariance[side] @ turn.transpose(0, 2, 1)
        lines.append(dots(away, normal[side]))
    turned = se2.wrap_angle(surfaces.facing[gaps.one] - surfaces.facing[gaps.other])
    apart = np.column_stack([turned, lines[1] - lines[0], surfaces.offset[gaps.one] - surfaces.offset[gaps.other]])
    chi2 = np.einsum("ea,ea->e", apart, np.linalg.solve(total, apart[:, :, None])[:, :, 0])
    return gaps.rows(np.flatnonzero(chi2 < _CHI2))


def _seen_through(surfaces: Surfaces, rays: SurfaceRays, sensors: Floats, gaps: _Gaps) -> Bools:
    """Return through which gaps (e,) rays have passed."""
    some, open_ = rays.rows(slice(None, None, 1 + len(rays.keyframe) // _SAMPLE)), np.zeros(len(gaps.one), dtype=bool)
    ended = se2.transform_each(sensors, some.keyframe, some.points)
    normal, way = surfaces.normal, surfaces.tangent
    reach = np.hypot(*some.points.T).max(initial=0.0) + 0.5 * _GAP
    for gap, wall in enumerate(gaps.one.tolist()):
        ahead = (sensors[:, :2] - surfaces.place[wall]) @ normal[wall]
        middle = surfaces.place[wall] + 0.5 * (gaps.first[gap] + gaps.last[gap]) * way[wall]
        # No ray is longer than the reach.
        near = np.hypot(*(sensors[:, :2] - middle).T) < reach
        rows = np.flatnonzero(((ahead > _FRONT) & near)[some.keyframe])
        behind = (ended[rows] - surfaces.place[wall]) @ normal[wall]
        rows, behind = rows[behind < -_BEHIND], behind[behind < -_BEHIND]
        begin = sensors[some.keyframe[rows], :2]
        share = ahead[some.keyframe[rows]] / (ahead[some.keyframe[rows]] - behind)
        at = (begin + share[:, None] * (ended[rows] - begin) - surfaces.place[wall]) @ way[wall]
        inner = (at > gaps.first[gap] + 0.5 * _CLOSE) & (at < gaps.last[gap] - 0.5 * _CLOSE)
        open_[gap] = np.count_nonzero(inner) >= _THROUGH
    return open_
