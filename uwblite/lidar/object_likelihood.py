"""How likely the surfaces of a cloud are in another one, object by object: what moves by itself counts once.

The surfaces of a cloud are cut into objects, runs of neighbouring points. An object moves by itself with probability m, which
falls with its length: people, trolleys and animals are short, walls are not. It counts as one thing however many rays meet
it, and a cow that fills the view cannot outvote the walls behind it. A point agrees with the target on a surface, disagrees
beside one or in its free space, and says nothing where the target did not look.

    log L = sum over objects log((1 - m) exp(g - chi2 / 2) + m),

where g is what a match gains over one by chance, at most as much as an object that moves loses. That share is measured beside
the place.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ..arrays import Bools, Floats, Ints, Table, concatenated
from .cloud_rasters import CloudRasters
from .clouds import Clouds
from .free_space import free_space
from .scan_matching import Correspondences, PairFactors, PairPoints, condensed, correspondences, pair_points
from .visibility import in_free_space, nearest_by_bearing


@dataclass(frozen=True, slots=True)
class ObjectPolicy:
    """Likelihood of surfaces."""

    gate: ClassVar[float] = 0.15
    """Farthest match, m."""
    correlation: ClassVar[float] = 8.0
    """Matches that together weigh as one: errors of neighbouring rays are correlated."""
    outlier: ClassVar[float] = 9.0
    """Squared residual, in variances, that no point exceeds: the Geman-McClure kernel's limit."""
    gap: ClassVar[float] = 0.4
    """Distance between neighbouring points that ends an object, m."""
    moves: ClassVar[float] = 0.03
    """Probability that an object moves by itself, before any was seen: one in a room of thirty things."""
    unlikely: ClassVar[float] = 0.5
    """Probability of standing still below which an object moves."""
    sure: ClassVar[float] = 0.99
    """Probability of standing still from which on an object counts as one that does."""
    long: ClassVar[float] = 2.0
    """Length of the longest thing that moves by itself, m; a longer one would be several that move together."""
    fits: ClassVar[float] = 5.0 / 6.0
    """Share of the points in view that match in the true place."""
    points: ClassVar[int] = 150
    """Points looked up per pair."""
    largest: ClassVar[float] = 50.0
    """Largest exponent; beyond it a probability is one or none to rounding."""
    aside: ClassVar[float] = 0.4
    """Distance along both axes at which no point is where it belongs, m; along a wall, points match all the same."""


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """How the objects of some pairs (e,) agree with their targets."""

    static: Floats
    """(e, o) probability that each object does not move."""
    likelihood: Floats
    """(e,) log likelihood of the source, by that in unknown space."""
    most: Floats
    """(e,) the same where every point agreed."""


@dataclass(frozen=True, slots=True, eq=False)
class CloudPairs(Table):
    """Pairs (e) of clouds of which one is placed in the other."""

    i: Ints
    """(e,) targets."""
    j: Ints
    """(e,) sources."""
    points: PairPoints
    """Of the sources."""

    def __len__(self) -> int:
        return len(self.i)


def pairs_of(clouds: Clouds, i: Ints, j: Ints) -> CloudPairs:
    """Return pairs of targets i (e,) and sources j (e,)."""
    return CloudPairs(i, j, pair_points(clouds, j, ObjectPolicy.points))


@dataclass(frozen=True, slots=True, eq=False)
class ObjectLikelihood:
    """Clouds whose surfaces are compared with each other."""

    clouds: Clouds
    raster: CloudRasters
    sigma: float
    """Standard deviation of a match, m."""
    chance: Floats
    """(k,) share of points that match each cloud by chance, see matched_by_chance."""
    free: Floats
    """(k, bearings) m, free space around each cloud by bearing, see FreeSpace.ranges."""
    number: Ints
    """(p,) object of each point within its cloud."""
    length: Floats
    """(p,) m, of that object."""
    moves: float = ObjectPolicy.moves
    """Probability that an object moves by itself."""

    @classmethod
    def of(cls, clouds: Clouds, raster: CloudRasters, sigma: float, pairs: CloudPairs, poses: Floats) -> "ObjectLikelihood":
        """Return that of clouds with their raster, what matches by chance learnt from pairs that lie about at poses (e, 3)."""
        chance = matched_by_chance(clouds, raster, pairs, poses)
        nearest = nearest_by_bearing(clouds)
        free = free_space(np.zeros((len(nearest), 3)), nearest).ranges
        return cls(clouds, raster, sigma, chance, free, *objects(clouds, ObjectPolicy.gap))

    def learnt(self, pairs: CloudPairs, poses: Floats) -> "ObjectLikelihood":
        """Return the likelihood with the probability that an object moves as pairs where matching ended, at poses (e, 3), show.

        An empty hall has few things that move and a museum many: what contradicts the place of a cloud counts accordingly.
        """
        moved = stood = 0.0
        for _, judged in self._judged(pairs, poses, ObjectPolicy.gate):
            moved += float(np.sum(judged.static < ObjectPolicy.unlikely))
            stood += float(np.sum(judged.static > ObjectPolicy.sure))
        return replace(self, moves=(1.0 + moved) / (1.0 / ObjectPolicy.moves + moved + stood))

    def log_likelihood(self, pairs: CloudPairs, poses: Floats) -> Floats:
        """Return the log likelihood (e,) of sources at poses (e, 3) by that in unknown space."""
        return np.concatenate([judged.likelihood for _, judged in self._judged(pairs, poses, ObjectPolicy.gate)])

    def match(
        self, pairs: CloudPairs, poses: Floats, gate: float, covariance: Floats | None = None
    ) -> tuple[PairFactors, list[Judged]]:
        """Return factors of the objects that do not move, and how each pair agrees, at poses (e, 3)."""
        parts, agreement = [], []
        for found, judged in self._judged(pairs, poses, gate, covariance):
            weight = np.take_along_axis(judged.static, self.number[found.row], axis=1) * found.good
            parts.append(condensed(self.clouds, found, max(gate / 2.0, 3.0 * self.sigma), np.sqrt(weight)))
            agreement.append(judged)
        return concatenated(parts), agreement

    def moving(self, pairs: CloudPairs, poses: Floats, covariance: Floats) -> Bools:
        """Return which points (p,) of all clouds belong to objects of sources that moved by themselves.

        Parameters
        ----------
        poses, covariance : (e, 3) T_i_j and (e, 3, 3).
        """
        moves = np.zeros(len(self.clouds.points), dtype=bool)
        for found, judged in self._judged(pairs, poses, ObjectPolicy.gate, covariance):
            for source, static in zip(pairs.j[found.pairs].tolist(), judged.static, strict=True):
                rows = slice(int(self.clouds.offsets[source]), int(self.clouds.offsets[source + 1]))
                own = self.number[rows]
                moves[rows] |= (static[np.minimum(own, len(static) - 1)] < ObjectPolicy.unlikely) & (own < len(static))
        return moves

    def _judged(
        self, pairs: CloudPairs, poses: Floats, gate: float, covariance: Floats | None = None
    ) -> Iterator[tuple[Correspondences, Judged]]:
        """Yield some pairs at a time, what their points match, and how their objects agree."""
        covariance = np.zeros((len(pairs), 3, 3)) if covariance is None else covariance
        for found in correspondences(self.clouds, self.raster, pairs.i, poses, pairs.points, gate):
            some = found.pairs
            yield found, self._judge(found, pairs.i[some], poses[some], covariance[some])

    def _judge(self, found: Correspondences, i: Ints, pose: Floats, covariance: Floats) -> Judged:
        """Judge the objects of some pairs (e,) at poses (e, 3), whose covariance (e, 3, 3) is left out of the residuals."""
        c, usable = ObjectPolicy, found.row >= 0
        (nx, ny), (rx, ry) = found.normal, found.arm
        jacobian = np.stack([nx, ny, ny * rx - nx * ry])
        # What the prior leaves open shifts a surface without making it a thing that moves.
        variance = self.sigma**2 + np.einsum("aen,eab,ben->en", jacobian, covariance, jacobian, optimize=True)
        squared = np.square(found.distance) / variance
        cost = np.where(found.good, squared / (1.0 + squared / c.outlier), 0.0)
        through, in_view = in_free_space(self.free, i, rx + pose[:, :1], ry + pose[:, 1:2])
        through &= usable & ~found.good
        missed = usable & ~found.good & in_view & ~through
        chance = self.chance[i][:, None]
        cost += 2.0 * np.log(np.maximum((1.0 - chance) / (1.0 - c.fits), 1.0)) * missed
        cost[through] = c.outlier
        group = self.number[found.row]
        many = int(group.max(initial=0)) + 1
        key = (np.arange(len(i))[:, None] * many + group)[usable]
        chi2, matched, asked = (
            np.bincount(key, v[usable], len(i) * many).reshape(len(i), many) / c.correlation
            for v in (cost, found.good.astype(np.float64), usable.astype(np.float64))
        )
        # An object longer than any that moves by itself would be several that move together.
        most = np.full((len(i), many), -np.log(self.moves))
        most.reshape(-1)[key] *= np.maximum(self.length[found.row[usable]] / c.long, 1.0)
        gain = np.log(np.maximum(c.fits / chance, 1.0)) + np.log(2.0 * c.gate / (np.sqrt(2.0 * np.pi) * self.sigma))
        stays, fixed = np.minimum(gain * matched, most) - 0.5 * chi2, np.log1p(-np.exp(-most))
        return Judged(
            1.0 / (1.0 + np.exp(np.clip(-most - stays, -ObjectPolicy.largest, ObjectPolicy.largest))),
            np.logaddexp(fixed + stays, -most).sum(axis=1),
            np.logaddexp(fixed + np.minimum(gain * asked, most), -most).sum(axis=1),
        )


def matched_by_chance(clouds: Clouds, raster: CloudRasters, pairs: CloudPairs, mean: Floats) -> Floats:
    """Return the share (k,) of points of sources that match each target cloud where they do not belong: aside.

    Parameters
    ----------
    mean : (e, 3) about where these belong, T_i_j.
    """
    matched = np.ones(len(pairs))
    for x in (-ObjectPolicy.aside, ObjectPolicy.aside):
        for y in (-ObjectPolicy.aside, ObjectPolicy.aside):
            aside = mean + np.array([x, y, 0.0])
            for found in correspondences(clouds, raster, pairs.i, aside, pairs.points, ObjectPolicy.gate):
                matched[found.pairs] += found.good.sum(axis=1)
    # One match of three beforehand (Laplace's rule of succession).
    chance = np.full(len(clouds), 1.0 / 3.0)
    chance[pairs.i] = matched / (4 * (pairs.points.row >= 0).sum(axis=1) + 3)
    return chance


def objects(clouds: Clouds, gap: float) -> tuple[Ints, Floats]:
    """Return the number (p,) of the object of each point within its cloud, from 0 on, and the length (p,) of it, m."""
    points, owner = clouds.points.astype(np.float64), clouds.owner
    away = np.hypot(*np.diff(points, axis=0).T) if len(points) else np.zeros(0)
    new = np.concatenate([[True], (away > gap) | (np.diff(owner) != 0)])[: len(points)]
    number = np.cumsum(new) - 1
    length = np.bincount(number, np.concatenate([[0.0], away])[: len(points)] * ~new)
    first = number[np.minimum(clouds.offsets[:-1], max(len(points) - 1, 0))] if len(points) else number
    return number - first[owner], length[number]
