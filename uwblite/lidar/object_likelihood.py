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

import numpy as np
from scipy.special import expit

from .. import se2
from ..arrays import OUTLIER, Floats, Ints, concatenated
from .cloud_rasters import CloudRasters
from .clouds import Clouds
from .scan_matching import CloudPairs, Correspondences, PairFactors, PairPolicy, condensed, correspondences
from .visibility import free_space, in_free_space, nearest_by_bearing


class ObjectPolicy:
    """Likelihood of surfaces."""

    outlier: float = OUTLIER**2
    """Squared residual, in variances, that no point exceeds: the Geman-McClure kernel's limit."""
    gap: float = 0.4
    """Distance between neighbouring points that ends an object, m, and along both axes to where none belongs."""
    moves: float = 0.03
    """Probability that an object moves by itself, before any was seen: one in a room of thirty things."""
    unlikely: float = 0.5
    """Probability of standing still below which an object moves."""
    sure: float = 0.99
    """Probability of standing still from which on an object counts as one that does."""
    long: float = 2.0
    """Length of the longest thing that moves by itself, m; a longer one would be several that move together."""
    fits: float = 5.0 / 6.0
    """Share of the points in view that match in the true place."""
    chance: tuple[float, float] = (1.0, 3.0)
    """Matches by chance and points beforehand (Laplace's rule of succession)."""


@dataclass(frozen=True, slots=True, eq=False)
class _Judged:
    """How the objects of some pairs (e,) agree with their targets."""

    static: Floats
    """(e, o) probability that each object does not move."""
    likelihood: Floats
    """(e,) log likelihood of the source, by that in unknown space."""
    most: Floats
    """(e,) the same where every point agreed."""


@dataclass(frozen=True, slots=True, eq=False)
class ObjectLikelihood:
    """Clouds whose surfaces are compared with each other."""

    raster: CloudRasters
    """Of the clouds."""
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
    def of(cls, raster: CloudRasters, sigma: float, pairs: CloudPairs, poses: Floats) -> "ObjectLikelihood":
        """Return that of a raster's clouds, what matches by chance learnt from pairs that lie about at poses (e, 3)."""
        nearest = nearest_by_bearing(raster.clouds)
        free = free_space(np.zeros((len(nearest), *se2.POSE)), nearest).ranges
        return cls(raster, sigma, matched_by_chance(raster, pairs, poses), free, *objects(raster.clouds, ObjectPolicy.gap))

    @property
    def clouds(self) -> Clouds:
        """Those that are compared."""
        return self.raster.clouds

    def learnt(self, pairs: CloudPairs, poses: Floats) -> "ObjectLikelihood":
        """Return the likelihood with the probability that an object moves as pairs where matching ended, at poses (e, 3), show:
        an empty hall has few things that move and a museum many."""
        moved = stood = 0.0
        for _, judged in self._judged(pairs, poses, PairPolicy.gate):
            moved += float(np.sum(judged.static < ObjectPolicy.unlikely))
            stood += float(np.sum(judged.static > ObjectPolicy.sure))
        return replace(self, moves=(1.0 + moved) / (1.0 / ObjectPolicy.moves + moved + stood))

    def log_likelihood(self, pairs: CloudPairs, poses: Floats) -> Floats:
        """Return the log likelihood (e,) of sources at poses (e, 3) by that in unknown space."""
        return np.concatenate([judged.likelihood for _, judged in self._judged(pairs, poses, PairPolicy.gate)])

    def match(
        self, pairs: CloudPairs, poses: Floats, gate: float, covariance: Floats | None = None
    ) -> tuple[PairFactors, Floats, Floats]:
        """Return factors of the objects that do not move at poses (e, 3), the log likelihood (e,), and the most it can be."""
        parts, agreement = [], []
        for found, judged in self._judged(pairs, poses, gate, covariance):
            weight = np.take_along_axis(judged.static, self.number[found.row], axis=1) * found.good
            scale = max(gate / 2.0, np.sqrt(ObjectPolicy.outlier) * self.sigma)
            parts.append(condensed(self.clouds, found, scale, np.sqrt(weight)))
            agreement.append([judged.likelihood, judged.most])
        likelihood, most = np.hstack(agreement)
        return concatenated(parts), likelihood, most

    def _judged(
        self, pairs: CloudPairs, poses: Floats, gate: float, covariance: Floats | None = None
    ) -> Iterator[tuple[Correspondences, _Judged]]:
        """Yield some pairs at a time, what their points match, and how their objects agree."""
        for found in correspondences(self.raster, pairs, poses, gate):
            some = found.pairs
            yield found, self._judge(found, pairs.i[some], poses[some], None if covariance is None else covariance[some])

    def _judge(self, found: Correspondences, i: Ints, pose: Floats, covariance: Floats | None) -> _Judged:
        """Judge the objects of some pairs (e,) at poses (e, 3), whose covariance (e, 3, 3) is left out of the residuals."""
        c, usable, variance = ObjectPolicy, found.row >= 0, np.full(found.row.shape, self.sigma**2)
        (nx, ny), (rx, ry) = found.normal, found.arm
        if covariance is not None:
            # What the prior leaves open shifts a surface without making it a thing that moves.
            jacobian = np.stack([nx, ny, ny * rx - nx * ry], axis=1)
            variance += np.einsum("ean,ean->en", jacobian, covariance @ jacobian)
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
            np.bincount(key, v[usable], len(i) * many).reshape(len(i), many) / PairPolicy.correlation
            for v in (cost, found.good.astype(np.float64), usable.astype(np.float64))
        )
        # An object longer than any that moves by itself would be several that move together.
        most = np.full((len(i), many), -np.log(self.moves))
        most.reshape(-1)[key] *= np.maximum(self.length[found.row[usable]] / c.long, 1.0)
        gain = np.log(np.maximum(c.fits / chance, 1.0)) + np.log(2.0 * PairPolicy.gate / (np.sqrt(2.0 * np.pi) * self.sigma))
        stays, fixed = np.minimum(gain * matched, most) - 0.5 * chi2, np.log1p(-np.exp(-most))
        likelihood, largest = (
            np.logaddexp(fixed + agree, -most).sum(axis=1) for agree in (stays, np.minimum(gain * asked, most))
        )
        return _Judged(expit(most + stays), likelihood, largest)


def matched_by_chance(raster: CloudRasters, pairs: CloudPairs, mean: Floats) -> Floats:
    """Return the share (k,) of points of sources that match each target aside of where they about belong, T_i_j (e, 3)."""
    beforehand, points = ObjectPolicy.chance
    sides = ObjectPolicy.gap * np.array([[-1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0]])
    matched = np.full(len(pairs), beforehand)
    for aside in sides:
        for found in correspondences(raster, pairs, mean + aside, PairPolicy.gate):
            matched[found.pairs] += found.good.sum(axis=1)
    chance = np.full(len(raster.clouds), beforehand / points)
    chance[pairs.i] = matched / (len(sides) * pairs.asked.sum(axis=1) + points)
    return chance


def objects(clouds: Clouds, gap: float) -> tuple[Ints, Floats]:
    """Return of the object of each point the number (p,) within its cloud, from 0 on, and the length (p,) along its points, m.

    An object is a run of points no two neighbours of which are farther apart than a gap, m.
    """
    points, owner = clouds.points.astype(np.float64), clouds.owner
    away = np.hypot(*np.diff(points, axis=0).T) if len(points) else np.zeros(0)
    new = np.concatenate([[True], (away > gap) | (np.diff(owner) != 0)])[: len(points)]
    number = np.cumsum(new) - 1
    length = np.bincount(number, np.concatenate([[0.0], away])[: len(points)] * ~new)
    first = number[np.minimum(clouds.offsets[:-1], max(len(points) - 1, 0))] if len(points) else number
    return number - first[owner], length[number]
