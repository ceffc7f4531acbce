"""Straight pieces of single scans, and which pieces of many scans are one wall.

The rays of a scan are cut where neighbours are apart, and where two lines explain them better than one, until each piece is
straight (split and merge: T. Pavlidis and S. Horowitz, IEEE Transactions on Computers 23, 1974). So long walls and the jambs of
doors, of a few rays each, are found by one rule, which asks nothing but what the noise of the rays allows.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from .. import se2
from ..arrays import MAD_TO_SIGMA, Bools, Floats, Ints, Table, connected, dots, unique_rows
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


_PIECE = PieceConfig()


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


def straight_pieces(rays: ScanPoints, config: PieceConfig = _PIECE) -> tuple[Pieces, SurfaceRays]:
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


@dataclass(frozen=True, slots=True)
class WallConfig:
    """Which pieces are of one wall, by what maps err by after the joint refinement, and objects stand off walls."""

    every: float = 0.5
    """m between the places at which pieces are compared."""
    reach: float = 0.4
    """m, largest distance of places."""
    off: float = 0.06
    """m, largest distance of a place from the other's line."""
    lean: float = np.deg2rad(6.0)
    """rad, largest difference of directions, beside two standard deviations of it."""
    scatter: float = 0.05
    """m, rms scatter of places about a straight wall."""
    turned: float = 2.0
    """Largest rms difference of directions from the wall's, in their standard deviations: what looks flat from every side, as a
    stem or a corner does, turns with the view."""
    keyframes: int = 4
    """Least number that see it."""
    halvings: int = 6
    """Most times that a bent wall is halved."""


_WALL = WallConfig()


@dataclass(frozen=True, slots=True, eq=False)
class StraightWalls:
    """Straight walls (w) of a map."""

    of_piece: Ints
    """(s,) wall of each piece; -1 = of none."""
    centre: Floats
    """(w, 2) m, map frame."""
    normal: Floats
    """(w, 2) unit, towards the robot."""


def find_walls(pieces: Pieces, poses: Floats, some: Bools, config: WallConfig = _WALL) -> StraightWalls:
    """Join those of some pieces (s,) that lie on each other, at poses (k, 3) of the keyframes, to walls."""
    piece, at, normal = _places(pieces, poses, config.every)
    kept = np.flatnonzero(some[piece])
    piece, at, normal = piece[kept], at[kept], normal[kept]
    deviation, keyframe = pieces.deviation[piece], pieces.keyframe[piece]
    number = _joined(piece, at, normal, deviation, len(some), config)[piece]
    number = _halved(number, at, normal, deviation, keyframe, config)
    centre, facing = _lines(number, at, normal, deviation)
    seen = np.bincount(unique_rows(np.stack([number, keyframe], axis=1))[0][:, 0], minlength=len(centre))
    good = (seen >= config.keyframes) & (_scatter(number, at, centre, facing) < config.scatter)
    good &= _rms(number, _across(normal, facing[number]) / np.hypot(deviation, _TURNED), len(centre)) < config.turned
    of_piece = np.full(len(some), -1)
    of_piece[piece] = np.where(good, np.cumsum(good) - 1, -1)[number]
    return StraightWalls(of_piece, centre[good], facing[good])


def _places(pieces: Pieces, poses: Floats, every: float) -> tuple[Ints, Floats, Floats]:
    """Return places on pieces, two on each at least, evenly spread: the piece (m,), where it is in the map, and its normal."""
    many = np.maximum(np.ceil(pieces.length / every).astype(np.intp), 2)
    piece = np.repeat(np.arange(len(many)), many)
    rank = np.arange(len(piece)) - (np.cumsum(many) - many)[piece]
    along = ((rank + 0.5) / many[piece] - 0.5) * pieces.length[piece]
    normal = pieces.normal[piece]
    at = pieces.centre[piece] + along[:, None] * np.stack([normal[:, 1], -normal[:, 0]], axis=1)
    keyframe = pieces.keyframe[piece]
    return piece, se2.transform_each(poses, keyframe, at), se2.rotate_each(poses[:, 2], keyframe, normal)


def _joined(piece: Ints, at: Floats, normal: Floats, deviation: Floats, many: int, config: WallConfig) -> Ints:
    """Return the number (s,) of the set of each of many pieces: those are one whose places (m, 2), with normals (m, 2), lie on
    one line and face the same way."""
    one, other = [np.zeros(0, dtype=np.intp)], [np.zeros(0, dtype=np.intp)]
    for rows in _strips(at, config.reach):
        # Linking each place with its first neighbour joins the same sets as all of its links, of which there may be thousands.
        one.append(piece[rows])
        other.append(piece[rows][_together(at[rows], normal[rows], deviation[rows], config)])
    return connected(np.concatenate(one), np.concatenate(other), many)


def _strips(at: Floats, reach: float) -> Iterator[Ints]:
    """Yield rows of places (m, 2), a bounded number at a time: strips of the map that overlap by the reach."""
    order = np.argsort(at[:, 0], kind="stable")
    x = at[order, 0]
    for first in range(0, len(x), _AT_ONCE):
        last = min(first + _AT_ONCE, len(x))
        yield order[first : np.searchsorted(x, x[last - 1] + reach, "right")]


_AT_ONCE = 1 << 13
"""Places of a strip; bounds the memory."""


def _together(at: Floats, normal: Floats, deviation: Floats, config: WallConfig) -> Ints:
    """Return for each place (m, 2) with a normal (m, 2) the first one of its set; places that lie on one line and face the same
    way are of one set."""
    pairs = cKDTree(at).query_pairs(config.reach, output_type="ndarray")
    places = np.stack([*at.T, *normal.T, deviation])
    first = each = np.arange(len(at))
    # Some of the pairs link most of the places, and few others remain to be tested.
    for tested in (pairs[::_SOME], pairs):
        links = [np.stack([each, first])]
        for begin in range(0, len(tested), _PAIRS_AT_ONCE):
            one, other = tested[begin : begin + _PAIRS_AT_ONCE].T
            apart = np.flatnonzero(first.take(one) != first.take(other))
            one, other = one[apart], other[apart]
            links.append(np.stack([one, other])[:, _on_one_line(config, one, other, places)])
        one, other = np.concatenate(links, axis=1)
        own = connected(one, other, len(at))
        first = np.unique(own, return_index=True)[1][own]
    return first


_SOME = 16
"""One in so many pairs is tested first."""
_PAIRS_AT_ONCE = 1 << 15
"""Pairs that are processed together, so that they fit into the processor's cache."""


def _on_one_line(config: WallConfig, one: Ints, other: Ints, places: Floats) -> Bools:
    """Return which pairs (e,) of places do, given coordinates, normals and the deviations of these, (5, m)."""
    x, y, ahead, left, deviation = places
    across, along = x.take(other) - x.take(one), y.take(other) - y.take(one)
    (ax, ay), (bx, by) = ((ahead.take(side), left.take(side)) for side in (one, other))
    lean = config.lean + 2.0 * np.hypot(deviation.take(one), deviation.take(other))
    good = ax * bx + ay * by > np.cos(lean)
    for nx, ny in ((ax, ay), (bx, by)):
        good &= np.abs(nx * across + ny * along) < config.off
    return np.asarray(good)


def _halved(number: Ints, at: Floats, normal: Floats, deviation: Floats, keyframe: Ints, config: WallConfig) -> Ints:
    """Return the number (m,) of the set of each place, with bent sets halved along their length.

    Heading errors of some mrad over a long distance bend a long wall in the map, which looks straight from each pose. Its parts
    are straight. Sets bent in one scan stay whole, and short ones: what bends within a metre is no bend of the poses.
    """
    number = np.unique(number, return_inverse=True)[1]
    centre, facing = _lines(number, at, normal, deviation)
    bent = _scatter(number, at, centre, facing) > config.scatter
    bent &= ~_curved(number, at, keyframe, facing, config)
    bent &= _rms(number, _across(at - centre[number], facing[number]), len(centre)) > config.reach
    for _ in range(config.halvings):
        if not bent.any():
            break
        beyond = bent[number] & (_across(at - centre[number], facing[number]) < 0.0)
        halves, number = np.unique(2 * number + beyond, return_inverse=True)
        centre, facing = _lines(number, at, normal, deviation)
        bent = bent[halves // 2] & (_scatter(number, at, centre, facing) > config.scatter)
    return number


def _lines(number: Ints, at: Floats, normal: Floats, deviation: Floats) -> tuple[Floats, Floats]:
    """Return centre and normal (w, 2) of the line that fits each set of places (m, 2), numbered (m,): to where they are and, by
    their deviations, to how they are turned."""
    many = int(number.max(initial=-1)) + 1
    weight = 1.0 / (deviation**2 + _TURNED**2)
    centre, facing = _mean(number, at, np.ones(len(at)), many), _mean(number, normal, weight, many)
    facing /= np.maximum(np.hypot(*facing.T), 1e-9)[:, None]
    off, own = at - centre[number], facing[number]
    across, along = dots(off, own), _across(off, own)
    known = np.bincount(number, (along / _OFF) ** 2 + weight, many)
    turn = np.bincount(number, _across(normal, own) * weight - along * across / _OFF**2, many) / known
    return centre, se2.rotate(turn, facing)


_TURNED, _OFF = 0.02, 0.02
"""Standard deviations of pieces about the wall beside the noise of rays: by the poses, and because walls are not straight, rad
and m."""


def _scatter(number: Ints, at: Floats, centre: Floats, facing: Floats) -> Floats:
    """Return the rms distance (w,) of places (m, 2) from the lines of their sets, m."""
    return _rms(number, dots(at - centre[number], facing[number]), len(centre))


def _rms(number: Ints, values: Floats, many: int) -> Floats:
    """Return the rms (m,) of the values (s,) of each of many sets."""
    return np.asarray(np.sqrt(np.bincount(number, values**2, many) / np.bincount(number, minlength=many)))


def _across(vectors: Floats, unit: Floats) -> Floats:
    """Return by how much (m,) vectors (m, 2) point to the left of unit vectors (m, 2)."""
    return np.asarray(unit[:, 0] * vectors[:, 1] - unit[:, 1] * vectors[:, 0])


def _curved(number: Ints, at: Floats, keyframe: Ints, facing: Floats, config: WallConfig) -> Bools:
    """Return which sets of places (m, 2), numbered (m,), are not straight in most of the keyframes (m,) that see them."""
    seen, own = unique_rows(np.stack([number, keyframe], axis=1))
    ones = np.ones(len(at))
    centre, facing = _lines(own, at, facing[number], ones)
    off = _scatter(own, at, centre, facing) > config.scatter
    return np.asarray(np.bincount(seen[:, 0], np.where(off, 1.0, -1.0)) > 0.0)


def _mean(number: Ints, values: Floats, weight: Floats, many: int) -> Floats:
    """Return the weighted mean (m, 2) of values (s, 2) by their numbers (s,)."""
    total = np.bincount(number, weight, many)
    return np.stack([np.bincount(number, weight * v, many) / total for v in values.T], axis=1)
