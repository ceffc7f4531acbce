"""How likely the surfaces of a cloud are in another one, object by object: what moves by itself counts once.

The surfaces of a cloud are cut into objects, runs of neighbouring points. An object moves by itself with probability m, which
falls with its length: people, trolleys and animals are short, walls are not. It counts as one thing however many rays meet
it, and a cow that fills the view cannot outvote the walls behind it. A point agrees with the target on a surface, disagrees
beside one or in its free space, and says nothing where the target did not look.

    log L = sum over objects log((1 - m) exp(g - chi2 / 2) + m),

where g is what a match gains over one by chance, at most as much as an object that moves loses. That share is measured beside
the place.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..arrays import Bools, Floats, Ints, concatenated
from .cloud_rasters import CloudRasters
from .clouds import Clouds
from .free_space import free_space
from .scan_matching import Correspondences, PairFactors, PairPoints, condensed, correspondences
from .visibility import in_free_space


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
    sure: ClassVar[float] = 0.99
    """Probability of standing still from which on an object counts as one that does."""
    long: ClassVar[float] = 2.0
    """Length of the longest thing that moves by itself, m; a longer one would be several that move together."""
    fits: ClassVar[float] = 5.0 / 6.0
    """Share of the points in view that match in the true place."""
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


class ObjectLikelihood:
    """Clouds whose surfaces are compared with each other."""

    def __init__(self, clouds: Clouds, raster: CloudRasters, nearest: Floats, sigma: float, chance: Floats) -> None:
        """Take clouds and their rasters; for the others see Registration."""
        self._clouds, self._raster, self._sigma, self._chance = clouds, raster, sigma, chance
        self._free = free_space(np.zeros((len(nearest), 3)), nearest).ranges
        self._object, self._length = objects(clouds, ObjectPolicy.gap)
        self.moves = ObjectPolicy.moves

    def learn_moves(self, i: Ints, points: PairPoints, pose: Floats) -> None:
        """Estimate the probability that an object moves by the objects of pairs where matching ended, at poses (e, 3).

        An empty hall has few things that move and a museum many: what contradicts the place of a cloud counts accordingly.
        """
        moved, known, exact = 1.0, 1.0 / ObjectPolicy.moves, np.zeros((len(i), 3, 3))
        for found in correspondences(self._clouds, self._raster, i, pose, points, ObjectPolicy.gate):
            some = found.pairs
            static = self._judge(found, i[some], pose[some], exact[some]).static
            moved += float(np.sum(static < _UNLIKELY))
            known += float(np.sum((static < _UNLIKELY) | (static > ObjectPolicy.sure)))
        self.moves = moved / known

    def match(
        self, i: Ints, points: PairPoints, pose: Floats, gate: float, covariance: Floats
    ) -> tuple[PairFactors, list[Judged]]:
        """Return factors of the objects that do not move, and how each pair agrees, at poses (e, 3)."""
        parts, judged = [], []
        for found in correspondences(self._clouds, self._raster, i, pose, points, gate):
            some = found.pairs
            own = self._judge(found, i[some], pose[some], covariance[some])
            weight = np.take_along_axis(own.static, self._object[found.row], axis=1) * found.good
            parts.append(condensed(self._clouds, found, max(gate / 2.0, 3.0 * self._sigma), np.sqrt(weight)))
            judged.append(own)
        return concatenated(parts), judged

    def moving(self, i: Ints, j: Ints, points: PairPoints, pose: Floats, covariance: Floats) -> Bools:
        """Return which points (p,) of all clouds belong to objects of sources j (e,) that moved by themselves.

        Parameters
        ----------
        pose, covariance : (e, 3) T_i_j and (e, 3, 3). For the others see register.
        """
        moves = np.zeros(len(self._clouds.points), dtype=bool)
        for found in correspondences(self._clouds, self._raster, i, pose, points, ObjectPolicy.gate):
            some = found.pairs
            judged = self._judge(found, i[some], pose[some], covariance[some])
            for source, static in zip(j[some].tolist(), judged.static, strict=True):
                rows = slice(int(self._clouds.offsets[source]), int(self._clouds.offsets[source + 1]))
                number = np.minimum(self._object[rows], len(static) - 1)
                moves[rows] |= (static[number] < _UNLIKELY) & (self._object[rows] < len(static))
        return moves

    def _judge(self, found: Correspondences, i: Ints, pose: Floats, covariance: Floats) -> Judged:
        """Judge the objects of some pairs (e,) at poses (e, 3), whose covariance (e, 3, 3) is left out of the residuals."""
        c, usable = ObjectPolicy, found.row >= 0
        (nx, ny), (rx, ry) = found.normal, found.arm
        jacobian = np.stack([nx, ny, ny * rx - nx * ry])
        # What the prior leaves open shifts a surface without making it a thing that moves.
        variance = self._sigma**2 + np.einsum("aen,eab,ben->en", jacobian, covariance, jacobian, optimize=True)
        squared = np.square(found.distance) / variance
        cost = np.where(found.good, squared / (1.0 + squared / c.outlier), 0.0)
        through, in_view = in_free_space(self._free, i, rx + pose[:, :1], ry + pose[:, 1:2])
        through &= usable & ~found.good
        missed = usable & ~found.good & in_view & ~through
        chance = self._chance[i][:, None]
        cost += 2.0 * np.log(np.maximum((1.0 - chance) / (1.0 - c.fits), 1.0)) * missed
        cost[through] = c.outlier
        group = self._object[found.row]
        many = int(group.max(initial=0)) + 1
        key = (np.arange(len(i))[:, None] * many + group)[usable]
        chi2, matched, asked = (
            np.bincount(key, v[usable], len(i) * many).reshape(len(i), many) / c.correlation
            for v in (cost, found.good.astype(np.float64), usable.astype(np.float64))
        )
        # An object longer than any that moves by itself would be several that move together.
        most = np.full((len(i), many), -np.log(self.moves))
        most.reshape(-1)[key] *= np.maximum(self._length[found.row[usable]] / c.long, 1.0)
        gain = np.log(np.maximum(c.fits / chance, 1.0)) + np.log(2.0 * c.gate / (np.sqrt(2.0 * np.pi) * self._sigma))
        stays, fixed = np.minimum(gain * matched, most) - 0.5 * chi2, np.log1p(-np.exp(-most))
        return Judged(
            1.0 / (1.0 + np.exp(np.clip(-most - stays, -_HUGE, _HUGE))),
            np.logaddexp(fixed + stays, -most).sum(axis=1),
            np.logaddexp(fixed + np.minimum(gain * asked, most), -most).sum(axis=1),
        )


def matched_by_chance(clouds: Clouds, raster: CloudRasters, i: Ints, points: PairPoints, mean: Floats) -> Floats:
    """Return the share (k,) of points of sources that match each target cloud i (e,) where they do not belong: aside.

    Parameters
    ----------
    points : of the sources, see pair_points. mean : (e, 3) about where these belong, T_i_j.
    """
    matched = np.ones(len(i))
    for x in (-ObjectPolicy.aside, ObjectPolicy.aside):
        for y in (-ObjectPolicy.aside, ObjectPolicy.aside):
            aside = mean + np.array([x, y, 0.0])
            for found in correspondences(clouds, raster, i, aside, points, ObjectPolicy.gate):
                matched[found.pairs] += found.good.sum(axis=1)
    # One match of three beforehand (Laplace's rule of succession).
    chance = np.full(len(clouds), 1.0 / 3.0)
    chance[i] = matched / (4 * (points.row >= 0).sum(axis=1) + 3)
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


_UNLIKELY, _HUGE = 0.5, 50.0
"""Probability of standing still below which an object moves, and the largest exponent."""
