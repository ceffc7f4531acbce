"""Straight pieces of single scans: rays that end, one beside the other, on one line within their noise.

The rays of a scan are cut where neighbours are apart, and where two lines explain them better than one, until each piece is
straight (split and merge: T. Pavlidis and S. Horowitz, IEEE Transactions on Computers 23, 1974). So long walls and the jambs of
doors, of a few rays each, are found by one rule, which asks nothing but what the noise of the rays allows.
"""

from dataclasses import dataclass, replace

import numpy as np

from ..arrays import MAD_TO_SIGMA, Bools, Floats, Ints, Table, dots
from ..odometry.attached import ScanPoints
from .ray_noise import range_sigma
from .surface_rays import ROUGHNESS, SurfaceRays, as_rays


@dataclass(frozen=True, slots=True)
class PieceConfig:
    """What a straight piece is."""

    gap: float = 0.35
    """m between the ends of neighbouring rays that cuts."""
    missing: int = 2
    """Rays without a reading that do not cut."""
    fewest: int = 6
    """Least number of rays."""
    splits: int = 7
    """Most rounds in which bent pieces are split."""
    scatter: float = 1.35
    """Scatter across the line, relative to the noise of the rays, beyond which a piece is bent."""
    bend: float = 20.0
    """Chi2 by which two lines fit a bent piece better than one."""
    incidence: float = 0.15
    """Least cosine of incidence: readings at a grazing angle are unreliable."""
    vague: float = 0.2
    """Largest standard deviation of the direction, rad."""


_CONFIG = PieceConfig()


@dataclass(frozen=True, slots=True, eq=False)
class Pieces(Table):
    """Straight pieces (s) of single scans."""

    keyframe: Ints
    centre: Floats
    """(s, 2) m, in the middle between its ends, frame of the keyframe."""
    normal: Floats
    """(s, 2) unit, towards the laser, same frame."""
    length: Floats
    """(s,) m."""
    deviation: Floats
    """(s,) rad, standard deviation of the normal's direction."""


class _Moments:
    """Sums over runs of points, and of the squares of their noise, by differences of cumulative sums."""

    def __init__(self, points: Floats, ahead: Floats, sigma: Floats) -> None:
        (x, y), (u, v) = points.T, (sigma[:, None] * ahead).T
        self._places, self._noise = (
            np.concatenate([np.zeros((len(rows), 1)), np.cumsum(np.stack(rows), axis=1)], axis=1)
            for rows in ((x, y, x * x, x * y, y * y), (u * u, u * v, v * v))
        )

    def _central(self, first: Ints, last: Ints) -> tuple[Floats, ...]:
        n = np.maximum(last - first, 1)
        x, y, xx, xy, yy = (self._places.take(last, axis=1) - self._places.take(first, axis=1)) / n
        return x, y, xx - x * x, xy - x * y, yy - y * y

    def squares(self, first: Ints, last: Ints) -> Floats:
        """Return the sum of squared distances (k,) of the points from first to before last, (k,), from their line."""
        _, _, a, b, c = self._central(first, last)
        return np.asarray((last - first) * np.maximum(0.5 * (a + c - np.hypot(a - c, 2.0 * b)), 0.0))

    def lines(self, first: Ints, last: Ints) -> tuple[Floats, Floats, Floats, Floats]:
        """Return centre (k, 2), normal (k, 2), length (k,) as of evenly spread points, and rms noise across it (k,), m."""
        x, y, a, b, c = self._central(first, last)
        angle = 0.5 * np.arctan2(2.0 * b, a - c)
        length = np.sqrt(6.0 * (a + c + np.hypot(a - c, 2.0 * b)))
        nx, ny = -np.sin(angle), np.cos(angle)
        uu, uv, vv = (self._noise.take(last, axis=1) - self._noise.take(first, axis=1)) / np.maximum(last - first, 1)
        noise = np.sqrt(np.maximum(nx * nx * uu + 2.0 * nx * ny * uv + ny * ny * vv, 0.0))
        return np.stack([x, y], axis=1), np.stack([nx, ny], axis=1), length, noise


def straight_pieces(rays: ScanPoints, config: PieceConfig = _CONFIG) -> tuple[Pieces, SurfaceRays]:
    """Return the straight pieces that rays (p,) show, and the rays on them with pieces as surfaces."""
    way = rays.points - rays.origins
    reach = np.maximum(np.hypot(*way.T), 1e-9)
    ahead, sigma = way / reach[:, None], range_sigma(reach)
    begins = _begins(rays, config)
    moments = _Moments(rays.points, ahead, sigma * _noise(reach, sigma, begins))
    first, last = _straight(moments, begins, config)
    centre, normal, length, noise = moments.lines(first, last)
    incidence = dots(normal, ahead[(first + last) // 2])
    normal = normal * np.where(incidence > 0.0, -1.0, 1.0)[:, None]
    deviation = noise * np.sqrt(12.0 / np.maximum(last - first, 1)) / np.maximum(length, 1e-9)
    tangent = np.stack([normal[:, 1], -normal[:, 0]], axis=1)
    begin, end = (dots(rays.points[rows] - centre, tangent) for rows in (first, last - 1))
    middle, length = centre + 0.5 * (begin + end)[:, None] * tangent, np.abs(end - begin)
    good = (np.abs(incidence) > config.incidence) & (deviation < config.vague)
    first, last = first[good], last[good]
    found = Pieces(rays.keyframe[first], middle[good], normal[good], length[good], deviation[good])
    # The outermost rays may hit two surfaces.
    inner = last - first - 2
    piece = np.repeat(np.arange(len(first)), inner)
    on = np.arange(len(piece)) + (first + 1 - np.cumsum(inner) + inner)[piece]
    oblique = -dots(ahead[on], found.normal[piece]) > config.incidence
    return found, replace(as_rays(rays.rows(on)), surface=piece).rows(oblique).bundled()


def _begins(rays: ScanPoints, config: PieceConfig) -> Bools:
    """Return which rays (m,) begin another run of neighbours."""
    begins = np.ones(len(rays.ray), dtype=bool)
    begins[1:] = (np.diff(rays.scan) != 0) | (np.diff(rays.ray) > config.missing)
    begins[1:] |= np.hypot(*np.diff(rays.points, axis=0).T) > config.gap
    return begins


def _noise(reach: Floats, sigma: Floats, begins: Bools) -> float:
    """Return the noise of rays relative to that by data sheets, by second differences of the lengths of neighbours."""
    bend = np.diff(reach, 2) / (np.sqrt(6.0) * sigma[1:-1]) if len(reach) > 2 else np.zeros(0)
    bend = bend[~begins[1:-1] & ~begins[2:]] if len(bend) else bend
    return float(np.clip(MAD_TO_SIGMA * np.median(np.abs(bend)), _LEAST_NOISE, 1.0)) if len(bend) else 1.0


_LEAST_NOISE = 0.1
"""Least noise of rays, as a share of that by data sheets."""


def _straight(moments: _Moments, begins: Bools, config: PieceConfig) -> tuple[Ints, Ints]:
    """Split runs until they are straight; return the first ray of each and the one after the last, ascending."""
    first = np.flatnonzero(begins)
    last = np.append(first[1:], len(begins))
    found = [np.zeros((2, 0), dtype=np.intp)]
    for _ in range(config.splits):
        many = last - first >= config.fewest
        first, last = first[many], last[many]
        if not len(first):
            break
        variance, squares = moments.lines(first, last)[3] ** 2 + ROUGHNESS**2, moments.squares(first, last)
        middle, of_two = _best_split(moments, first, last, config.fewest // 2)
        good = (squares < config.scatter**2 * variance * (last - first - 2)) & (squares - of_two < config.bend * variance)
        found.append(np.stack([first[good], last[good]]))
        first, middle, last = first[~good], middle[~good], last[~good]
        first, last = np.concatenate([first, middle]), np.concatenate([middle, last])
    every = np.concatenate(found, axis=1)
    first, last = every[:, np.argsort(every[0], kind="stable")]
    return first, last


def _best_split(moments: _Moments, first: Ints, last: Ints, half: int) -> tuple[Ints, Floats]:
    """Return where (k,) two lines fit runs of at least two halves best, and the sum of squares (k,) that they leave."""
    count = last - first + 1 - 2 * half
    begin = np.cumsum(count) - count
    at = np.arange(count.sum()) + np.repeat(first + half - begin, count)
    cost = moments.squares(np.repeat(first, count), at) + moments.squares(at, np.repeat(last, count))
    least = np.minimum.reduceat(cost, begin) if len(cost) else cost
    best = np.flatnonzero(cost == np.repeat(least, count))
    return at[best[np.searchsorted(best, begin)]], least
