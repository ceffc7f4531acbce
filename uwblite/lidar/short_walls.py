"""Short walls: door jambs, piers and the fronts of cupboards, which clouds are too coarse to show as lines.

A point of a cloud is the mean of ten rays, and lines through few points are inaccurate. So the rays that end on no stretch of
their own cloud (lidar/stretches.py) are cut scan by scan where neighbours are apart, and where two lines explain them better
than one, until each piece is straight within the noise of its rays. Pieces that several keyframes show in one
place, facing the same way, are one wall.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .. import se2
from ..arrays import MAD_TO_SIGMA, Bools, Floats, Ints, Table, connected
from ..odometry.attached import ScanPoints
from .ray_noise import range_sigma
from .surface_rays import ROUGHNESS, SurfaceRays, as_rays
from .walls import Walls

_GAP, _SIGMAS, _MISSED = 0.35, 5.0, 2
"""Neighbouring rays are apart where their ends have this distance, m, or where their lengths differ by so many standard
deviations, or where more rays than this between them have no reading."""
_FEWEST = 6
"""Least number of rays of a piece."""
_HALF = 3
"""Least number of rays on either side of a place where two lines meet."""
_SPLITS = 7
"""Most rounds in which bent pieces are split."""
_EXCESS = 1.35
"""Scatter across a line, relative to the noise of rays, beyond which a piece is bent."""
_LEAST_NOISE = 0.1
"""Least noise of rays, as a share of that by data sheets."""
_INCIDENCE, _SHORTEST, _VAGUE = 0.3, 0.1, 0.2
"""Least cosine of incidence and length, m, of a piece, and largest standard deviation of its direction, rad."""
_REACH, _OFF, _LEAN, _MOST_LEAN = 0.2, 0.05, np.deg2rad(6.0), np.deg2rad(25.0)
"""Pieces are of one wall where their centres are nearer than this, m, each within this distance of the other's line, m, and
where their directions differ by less than this, rad, plus two standard deviations, and never by more than this, rad."""
_KEYFRAMES, _SCATTER = 4, 0.03
"""Least number of keyframes that show a wall, and largest scatter of its pieces across it, rms, m."""


@dataclass(frozen=True, slots=True, eq=False)
class Pieces(Table):
    """Straight pieces (s) of single scans."""

    keyframe: Ints
    centre: Floats
    """(s, 2) m, frame of the keyframe."""
    normal: Floats
    """(s, 2) unit, towards the laser, same frame."""
    deviation: Floats
    """(s,) rad, standard deviation of the normal's direction."""


class _Moments:
    """Sums over runs of points, by differences of cumulative sums."""

    def __init__(self, points: Floats, sigma: Floats) -> None:
        x, y = points.T
        columns = np.stack([np.ones(len(x)), x, y, x * x, x * y, y * y, sigma**2], axis=1)
        self._sums = np.concatenate([np.zeros((1, 7)), np.cumsum(columns, axis=0)])

    def _central(self, first: Ints, last: Ints) -> tuple[Floats, ...]:
        n, x, y, xx, xy, yy, _ = (self._sums[last] - self._sums[first]).T
        n = np.maximum(n, 1.0)
        x, y = x / n, y / n
        return n, x, y, xx / n - x * x, xy / n - x * y, yy / n - y * y

    def squares(self, first: Ints, last: Ints) -> Floats:
        """Return the sum of squared distances (k,) of the points from first to before last, (k,), from their line."""
        n, _, _, a, b, c = self._central(first, last)
        return np.asarray(n * np.maximum(0.5 * (a + c - np.hypot(a - c, 2.0 * b)), 0.0))

    def lines(self, first: Ints, last: Ints) -> tuple[Floats, Floats, Floats, Floats]:
        """Return centre (k, 2), normal (k, 2), length (k,) as of evenly spread points, and rms noise of the rays (k,), m."""
        n, x, y, a, b, c = self._central(first, last)
        angle = 0.5 * np.arctan2(2.0 * b, a - c)
        length = np.sqrt(6.0 * (a + c + np.hypot(a - c, 2.0 * b)))
        noise = np.sqrt((self._sums[last, 6] - self._sums[first, 6]) / n)
        return np.stack([x, y], axis=1), np.stack([-np.sin(angle), np.cos(angle)], axis=1), length, noise


def pieces_of(rays: ScanPoints, free: Bools) -> tuple[Pieces, SurfaceRays]:
    """Return the straight pieces that the free ones of rays (p,) show, and the rays on them, with pieces as surfaces."""
    rows = np.flatnonzero(free)
    points, way = rays.points[rows], rays.points[rows] - rays.origins[rows]
    reach = np.maximum(np.hypot(*way.T), 1e-9)
    ahead, sigma = way / reach[:, None], range_sigma(reach)
    apart = _apart(rays.scan[rows], rays.ray[rows], points, reach, sigma)
    sigma = sigma * _noise(reach, sigma, apart)
    moments = _Moments(points, sigma)
    first, last = _straight(moments, ahead, apart)
    centre, normal, length, noise = moments.lines(first, last)
    incidence = (normal * ahead[(first + last) // 2]).sum(axis=1)
    normal, incidence = normal * np.where(incidence > 0.0, -1.0, 1.0)[:, None], np.abs(incidence)
    deviation = noise * incidence * np.sqrt(12.0 / np.maximum(last - first, 1)) / np.maximum(length, 1e-9)
    good = (incidence > _INCIDENCE) & (deviation < _VAGUE) & (length > _SHORTEST)
    first, last = first[good], last[good]
    found = Pieces(rays.keyframe[rows[first]], centre[good], normal[good], deviation[good])
    # The outermost rays may hit two surfaces.
    inner = last - first - 2
    piece = np.repeat(np.arange(len(first)), inner)
    on = rows[np.arange(len(piece)) + (first + 1 - np.cumsum(inner) + inner)[piece]]
    return found, replace(as_rays(rays.rows(on)), surface=piece).bundled()


def _apart(scan: Ints, ray: Ints, points: Floats, reach: Floats, sigma: Floats) -> Bools:
    """Return which rays (m,) begin another run of neighbours."""
    apart = np.ones(len(scan), dtype=bool)
    apart[1:] = (np.diff(scan) != 0) | (np.diff(ray) > _MISSED) | (np.hypot(*np.diff(points, axis=0).T) > _GAP)
    apart[1:] |= np.abs(np.diff(reach)) > _SIGMAS * np.sqrt(2.0) * sigma[1:] + _MISSED * ROUGHNESS
    return apart


def _noise(reach: Floats, sigma: Floats, apart: Bools) -> float:
    """Return the noise of rays relative to that by data sheets, by second differences of the lengths of neighbours."""
    if len(reach) < 3:
        return 1.0
    bend = np.diff(reach, 2) / (np.sqrt(6.0) * sigma[1:-1])
    within = ~apart[1:-1] & ~apart[2:]
    if not within.any():
        return 1.0
    return float(np.clip(MAD_TO_SIGMA * np.median(np.abs(bend[within])), _LEAST_NOISE, 1.0))


def _straight(moments: _Moments, ahead: Floats, apart: Bools) -> tuple[Ints, Ints]:
    """Split runs until they are straight; return the first ray of each and the one after the last, ascending."""
    first = np.flatnonzero(apart)
    last = np.append(first[1:], len(apart))
    found = [np.zeros((2, 0), dtype=np.intp)]
    for _ in range(_SPLITS):
        many = last - first >= _FEWEST
        first, last = first[many], last[many]
        if not len(first):
            break
        normal, noise = moments.lines(first, last)[1::2]
        incidence = np.maximum(np.abs((normal * ahead[(first + last) // 2]).sum(axis=1)), 0.5 * _INCIDENCE)
        scatter = np.sqrt(moments.squares(first, last) / (last - first - 2))
        good = scatter < _EXCESS * np.hypot(noise * incidence, ROUGHNESS)
        found.append(np.stack([first[good], last[good]]))
        first, last = first[~good], last[~good]
        middle = _best_split(moments, first, last)
        first, last = np.concatenate([first, middle]), np.concatenate([middle, last])
    every = np.concatenate(found, axis=1)
    first, last = every[:, np.argsort(every[0], kind="stable")]
    return first, last


def _best_split(moments: _Moments, first: Ints, last: Ints) -> Ints:
    """Return where (k,) two lines fit runs of at least two halves best."""
    count = last - first
    run, begin = np.repeat(np.arange(len(count)), count), np.cumsum(count) - count
    at = first[run] + np.arange(len(run)) - begin[run]
    inner = (at >= first[run] + _HALF) & (at <= last[run] - _HALF)
    cost = np.where(inner, moments.squares(first[run], at) + moments.squares(at, last[run]), np.inf)
    order = np.lexsort((at, cost, run))
    return at[order[begin]]


def walls_of(pieces: Pieces, poses: Floats) -> Walls:
    """Join pieces that lie on each other, at poses (k, 3) of the keyframes, to walls."""
    at = se2.transform_each(poses, pieces.keyframe, pieces.centre)
    normal = se2.rotate_each(poses[:, 2], pieces.keyframe, pieces.normal)
    number = _together(at, normal, pieces.deviation)
    many = int(number.max(initial=-1)) + 1
    centre = _mean(number, at, np.ones(len(at)), many)
    facing = _mean(number, normal, 1.0 / np.maximum(pieces.deviation, 0.1 * _VAGUE) ** 2, many)
    facing /= np.maximum(np.hypot(*facing.T), 1e-9)[:, None]
    off = ((at - centre[number]) * facing[number]).sum(axis=1)
    scatter = np.sqrt(np.bincount(number, off**2, many) / np.bincount(number, minlength=many))
    pairs = np.unique(np.stack([number, pieces.keyframe]), axis=1)
    good = (np.bincount(pairs[0], minlength=many) >= _KEYFRAMES) & (scatter < _SCATTER)
    return Walls(np.where(good, np.cumsum(good) - 1, -1)[number], centre[good], facing[good])


def _together(at: Floats, normal: Floats, deviation: Floats) -> NDArray[np.intp]:
    """Return the number (s,) of the wall of each piece with a centre (s, 2) and a normal (s, 2)."""
    pairs = cKDTree(at).query_pairs(_REACH, output_type="ndarray") if len(at) else np.zeros((0, 2), dtype=np.intp)
    one, other = pairs.T
    step = at[other] - at[one]
    lean = np.arccos(np.clip((normal[one] * normal[other]).sum(axis=1), -1.0, 1.0))
    good = lean < np.minimum(_LEAN + 2.0 * np.hypot(deviation[one], deviation[other]), _MOST_LEAN)
    for side in (one, other):
        good &= np.abs((normal[side] * step).sum(axis=1)) < _OFF
    return connected(one[good], other[good], len(at))


def _mean(number: Ints, values: Floats, weight: Floats, many: int) -> Floats:
    """Return the weighted mean (m, 2) of values (s, 2) by their numbers (s,)."""
    total = np.bincount(number, weight, many)
    return np.stack([np.bincount(number, weight * v, many) / total for v in values.T], axis=1)
