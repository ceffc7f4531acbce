"""Straight pieces of single scans, and which pieces of many scans are one wall.

The rays of a scan are cut where neighbours are apart, and where two lines explain them better than one, until each piece is
straight (split and merge: T. Pavlidis and S. Horowitz, IEEE Transactions on Computers 23, 1974). So long walls and the jambs of
doors, of a few rays each, are found by one rule, which asks nothing but what the noise of the rays allows.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .. import se2
from ..arrays import TINY, Bools, Floats, Ints, Table, bends, chunks, connected, dots, numbered, spread, unique_rows
from ..odometry.attached import ScanPoints
from .clouds import Clouds
from .columns import rim_distances
from .surface_rays import MeasuredSurfaces, ShapePolicy, SurfaceRays, as_rays, begins_run


class WallPolicy:
    """What a straight piece is, and which pieces are of one wall, by what maps err by and objects stand off walls."""

    fewest: int = 6
    """Least number of rays."""
    splits: int = 7
    """Most rounds in which bent pieces are split, and most times that a bent wall is halved."""
    incidence: float = 0.15
    """Least cosine of incidence: readings at a grazing angle are unreliable."""
    vague: float = 0.2
    """Largest standard deviation of the direction, rad."""
    every: float = 0.5
    """m between the places at which pieces are compared."""
    reach: float = 0.4
    """m, largest distance of places, and of the ends of neighbouring rays."""
    lean: float = 0.1
    """rad, largest difference of directions, beside two standard deviations of it."""
    turned: float = 2.0
    """Largest rms difference of directions from the wall's, in their standard deviations: what looks flat from every side, as a
    stem or a corner does, turns with the view."""
    views: int = 4
    """Least number of keyframes that see a wall."""


_SOME = 16
"""One in so many pairs is tested first."""


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

    def lines(self, first: Ints, last: Ints) -> tuple[Floats, Floats, Floats]:
        """Return centre (k, 2), normal (k, 2), and rms noise across it (k,), m."""
        x, y, a, b, c = self._central(first, last)
        angle = 0.5 * np.arctan2(2.0 * b, a - c)
        nx, ny = -np.sin(angle), np.cos(angle)
        uu, uv, vv = (self._noise.take(last, axis=1) - self._noise.take(first, axis=1)) / np.maximum(last - first, 1)
        noise = np.sqrt(np.maximum(nx * nx * uu + 2.0 * nx * ny * uv + ny * ny * vv, 0.0))
        return np.stack([x, y], axis=1), np.stack([nx, ny], axis=1), noise


def straight_pieces(rays: ScanPoints) -> tuple[Pieces, SurfaceRays]:
    """Return the straight pieces that rays (p,) show, and the rays on them with pieces as surfaces."""
    c, single = WallPolicy, as_rays(rays)
    ahead, sigma = single.directions, single.sigma.astype(np.float64)
    begins = begins_run(rays, np.hypot(*np.diff(rays.points, axis=0).T) > c.reach)
    noise = _noise(dots(rays.points - rays.origins, ahead), sigma, begins)
    moments = _Moments(rays.points, ahead.astype(np.float64), sigma * noise)
    first, last = _straight(moments, begins)
    centre, normal, across = moments.lines(first, last)
    incidence = dots(normal, ahead[(first + last) // 2])
    normal = normal * np.where(incidence > 0.0, -1.0, 1.0)[:, None]
    tangent = np.stack([normal[:, 1], -normal[:, 0]], axis=1)
    begin, end = (dots(rays.points[rows] - centre, tangent) for rows in (first, last - 1))
    middle, length = centre + 0.5 * (begin + end)[:, None] * tangent, np.abs(end - begin)
    # Of a line through evenly spread points.
    deviation = across * np.sqrt(12.0 / np.maximum(last - first, 1)) / np.maximum(length, TINY)
    good = (np.abs(incidence) > c.incidence) & (deviation < c.vague)
    first, last = first[good], last[good]
    found = Pieces(rays.keyframe[first], middle[good], normal[good], length[good], deviation[good])
    # The outermost rays may hit two surfaces.
    piece, inner = numbered(last - first - 2)
    on = first[piece] + 1 + inner
    oblique = -dots(ahead[on], found.normal[piece]) > c.incidence
    return found, replace(single.rows(on), surface=piece).rows(oblique).bundled()


def _noise(reach: Floats, sigma: Floats, begins: Bools) -> float:
    """Return the noise of rays relative to that by data sheets, by second differences of the lengths of neighbours."""
    inside = ~begins[1:-1] & ~begins[2:]
    if not inside.any():
        return 1.0
    return float(np.clip(spread((bends(reach) / sigma[1:-1])[inside]), ShapePolicy.quietest, 1.0))


def _straight(moments: _Moments, begins: Bools) -> tuple[Ints, Ints]:
    """Split runs until they are straight; return the first ray of each and the one after the last, ascending."""
    first = np.flatnonzero(begins)
    last = np.append(first[1:], len(begins))
    found = [np.zeros((2, 0), dtype=np.intp)]
    for _ in range(WallPolicy.splits):
        many = last - first >= WallPolicy.fewest
        first, last = first[many], last[many]
        if not len(first):
            break
        variance = moments.lines(first, last)[-1] ** 2 + ShapePolicy.roughness**2
        squares, (middle, of_two) = moments.squares(first, last), _best_split(moments, first, last, WallPolicy.fewest // 2)
        good = squares < ShapePolicy.scatter**2 * variance * (last - first - 2)
        good &= squares - of_two < ShapePolicy.bend * variance
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


@dataclass(frozen=True, slots=True, eq=False)
class StraightWalls:
    """Straight walls (w) of a map."""

    of_piece: Ints
    """(s,) wall of each piece; -1 = of none."""
    centre: Floats
    """(w, 2) m, map frame."""
    normal: Floats
    """(w, 2) unit, towards the robot."""


@dataclass(frozen=True, slots=True, eq=False)
class _Places(Table):
    """Places (m) on pieces, two on each at least, evenly spread."""

    piece: Ints
    keyframe: Ints
    at: Floats
    """(m, 2) m, map frame."""
    normal: Floats
    """(m, 2) unit."""
    deviation: Floats
    """(m,) rad."""

    @classmethod
    def on(cls, pieces: Pieces, poses: Floats) -> "_Places":
        many = np.maximum(np.ceil(pieces.length / WallPolicy.every).astype(np.intp), 2)
        piece, rank = numbered(many)
        along = ((rank + 0.5) / many[piece] - 0.5) * pieces.length[piece]
        normal, keyframe = pieces.normal[piece], pieces.keyframe[piece]
        at = pieces.centre[piece] + along[:, None] * np.stack([normal[:, 1], -normal[:, 0]], axis=1)
        at, normal = se2.transform_each(poses, keyframe, at), se2.rotate_each(poses[:, 2], keyframe, normal)
        return cls(piece, keyframe, at, normal, pieces.deviation[piece])


@dataclass(frozen=True, slots=True, eq=False)
class _Lines:
    """Lines that fit sets (w) of places (m)."""

    number: Ints
    """(m,) set of each place."""
    centre: Floats
    """(w, 2) m."""
    facing: Floats
    """(w, 2) unit, normals."""
    scatter: Floats
    """(w,) m, rms distance of the places."""

    @classmethod
    def fitted(cls, number: Ints, at: Floats, normal: Floats, deviation: Floats) -> "_Lines":
        """Return those that fit best where places are and, by their deviations, how they are turned."""
        many, off = int(number.max(initial=-1)) + 1, ShapePolicy.uneven
        weight = 1.0 / (deviation**2 + off**2)

        def mean(values: Floats, weight: Floats) -> Floats:
            return np.stack([np.bincount(number, weight * v, many) for v in values.T], axis=1) / total(weight)[:, None]

        def total(values: Floats) -> Floats:
            return np.asarray(np.bincount(number, values, many))

        centre, facing = mean(at, np.ones(len(at))), mean(normal, weight)
        facing /= np.maximum(np.hypot(*facing.T), TINY)[:, None]
        away, own = at - centre[number], facing[number]
        across, along = dots(away, own), _across(away, own)
        known = total((along / off) ** 2 + weight)
        facing = se2.rotate(total(_across(normal, own) * weight - along * across / off**2) / known, facing)
        return cls(number, centre, facing, _rms(number, dots(away, facing[number]), many))

    def along(self, at: Floats) -> Floats:
        """Return where (m,) places (m, 2) are along the lines of their sets, from the middle, m."""
        return _across(at - self.centre[self.number], self.facing[self.number])


def find_walls(pieces: Pieces, poses: Floats, some: Bools) -> StraightWalls:
    """Join those of some pieces (s,) that lie on each other, at poses (k, 3) of the keyframes, to walls."""
    places = _Places.on(pieces, poses)
    places = places.rows(np.flatnonzero(some[places.piece]))
    lines = _halved(np.unique(_joined(places, len(some)), return_inverse=True)[1], places)
    number, many = lines.number, len(lines.centre)
    seen = np.bincount(unique_rows(np.stack([number, places.keyframe], axis=1))[0][:, 0], minlength=many)
    turned = _across(places.normal, lines.facing[number]) / np.hypot(places.deviation, ShapePolicy.uneven)
    good = (seen >= WallPolicy.views) & (lines.scatter < ShapePolicy.on)
    good &= _rms(number, turned, many) < WallPolicy.turned
    of_piece = np.full(len(some), -1)
    of_piece[places.piece] = np.where(good, np.cumsum(good) - 1, -1)[number]
    return StraightWalls(of_piece, lines.centre[good], lines.facing[good])


def _joined(places: _Places, many: int) -> Ints:
    """Return the number (m,) of the set of each place: pieces are of one whose places lie on one line and face the same way."""
    one, other = [np.zeros(0, dtype=np.intp)], [np.zeros(0, dtype=np.intp)]
    for rows in _strips(places.at):
        # Linking each place with its first neighbour joins the same sets as all of its links, of which there may be thousands.
        one.append(places.piece[rows])
        other.append(places.piece[rows][_together(places.rows(rows))])
    return connected(np.concatenate(one), np.concatenate(other), many)[places.piece]


def _strips(at: Floats) -> Iterator[Ints]:
    """Yield rows of places (m, 2), a bounded number at a time: strips of the map that overlap by the reach."""
    order = np.argsort(at[:, 0], kind="stable")
    x = at[order, 0]
    for some in chunks(len(x)):
        yield order[some.start : np.searchsorted(x, x[some.stop - 1] + WallPolicy.reach, "right")]


def _together(places: _Places) -> Ints:
    """Return for each place (m,) the first one of its set; places that lie on one line and face the same way are of one set."""
    pairs = cKDTree(places.at).query_pairs(WallPolicy.reach, output_type="ndarray")
    columns = np.stack([*places.at.T, *places.normal.T, places.deviation])
    first = each = np.arange(len(places.at))
    # Some of the pairs link most of the places, and few others remain to be tested.
    for tested in (pairs[::_SOME], pairs):
        links = [np.stack([each, first])]
        for some in chunks(len(tested)):
            one, other = tested[some].T
            apart = np.flatnonzero(first.take(one) != first.take(other))
            one, other = one[apart], other[apart]
            links.append(np.stack([one, other])[:, _on_one_line(one, other, columns)])
        one, other = np.concatenate(links, axis=1)
        own = connected(one, other, len(first))
        first = np.unique(own, return_index=True)[1][own]
    return first


def _on_one_line(one: Ints, other: Ints, places: Floats) -> Bools:
    """Return which pairs (e,) of places do, given coordinates, normals and the deviations of these, (5, m)."""
    x, y, ahead, left, deviation = places
    across, along = x.take(other) - x.take(one), y.take(other) - y.take(one)
    (ax, ay), (bx, by) = ((ahead.take(side), left.take(side)) for side in (one, other))
    lean = WallPolicy.lean + 2.0 * np.hypot(deviation.take(one), deviation.take(other))
    good = ax * bx + ay * by > np.cos(lean)
    for nx, ny in ((ax, ay), (bx, by)):
        good &= np.abs(nx * across + ny * along) < ShapePolicy.on
    return np.asarray(good)


def _halved(number: Ints, places: _Places) -> _Lines:
    """Return the lines of sets of places, numbered (m,), with bent sets halved along their length.

    Heading errors of some mrad over a long distance bend a long wall in the map, which looks straight from each pose. Its parts
    are straight. Sets bent in one scan stay whole, and short ones: what bends within a metre is no bend of the poses.
    """
    c, shape = WallPolicy, (places.at, places.normal, places.deviation)
    lines = _Lines.fitted(number, *shape)
    bent = (lines.scatter > ShapePolicy.on) & (_rms(number, lines.along(places.at), len(lines.centre)) > c.reach)
    bent &= ~_curved(lines, places)
    for _ in range(c.splits):
        if not bent.any():
            break
        beyond = bent[lines.number] & (lines.along(places.at) < 0.0)
        halves, number = np.unique(2 * lines.number + beyond, return_inverse=True)
        lines = _Lines.fitted(number, *shape)
        bent = bent[halves // 2] & (lines.scatter > ShapePolicy.on)
    return lines


def _curved(lines: _Lines, places: _Places) -> Bools:
    """Return which sets of places (m,) are not straight in most of the keyframes that see them."""
    seen, own = unique_rows(np.stack([lines.number, places.keyframe], axis=1))
    alone = _Lines.fitted(own, places.at, lines.facing[lines.number], np.ones(len(own)))
    return np.asarray(np.bincount(seen[:, 0], np.where(alone.scatter > ShapePolicy.on, 1.0, -1.0)) > 0.0)


def _rms(number: Ints, values: Floats, many: int) -> Floats:
    """Return the rms (m,) of the values (s,) of each of many sets."""
    return np.asarray(np.sqrt(np.bincount(number, values**2, many) / np.bincount(number, minlength=many)))


def _across(vectors: Floats, unit: Floats) -> Floats:
    """Return by how much (m,) vectors (m, 2) point to the left of unit vectors (m, 2)."""
    return np.asarray(unit[:, 0] * vectors[:, 1] - unit[:, 1] * vectors[:, 0])


def points_on(clouds: Clouds, found: MeasuredSurfaces, sensors: Floats) -> NDArray[np.int8]:
    """Return the kind of each of the clouds' points (p,), whose frames are (k, 3) in the map: 0 on a wall where rays showed
    it, 1 on a column, -1 on neither."""
    surfaces, kind = found.surfaces, np.full(len(clouds.points), -1, dtype=np.int8)
    shown, on = _shown_walls(found, sensors), ShapePolicy.on
    columns = np.column_stack([surfaces.place, surfaces.radius])[surfaces.round]
    for part in chunks(len(kind)):
        at = se2.transform_each(sensors, clouds.owner[part], clouds.points[part].astype(np.float64))
        kind[part][np.isfinite(shown.query(at, distance_upper_bound=on)[0])] = 0
        kind[part][np.abs(rim_distances(columns, at, on)) < on] = 1
    return kind


def _shown_walls(found: MeasuredSurfaces, sensors: Floats) -> cKDTree:
    """Return the middles of the cells of walls in which rays end."""
    surfaces, rays, size = found.surfaces, found.rays.rows(~found.surfaces.round[found.rays.surface]), ShapePolicy.on
    way, wall = surfaces.tangent, rays.surface.astype(np.intp)
    along = dots(rays.in_map(sensors)[0] - surfaces.place.take(wall, axis=0), way.take(wall, axis=0))
    wall, cell = unique_rows(np.column_stack([wall, np.floor(along / size).astype(np.intp)]))[0].T
    return cKDTree(surfaces.place[wall] + ((cell + 0.5) * size)[:, None] * way[wall])
