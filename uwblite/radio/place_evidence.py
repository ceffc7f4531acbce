"""Evidence of where an anchor stood, and when, within a recording and between recordings.

Along a given path the ranges of one radio are explained by places, each of which holds during intervals; ranges made while it
is carried are gross errors. Explanations are compared by the logarithm of the marginal likelihood (Laplace; D. MacKay, Bayesian
interpolation, 1992):

    sum_i c_i log f(e_i) + log priors + sum_k log(|2 pi S_k|^1/2 / A)

with the mixture f of line of sight, NLOS delays and gross errors (nlos_mixture), c_i that counts errors of neighbours once, the
covariance S_k of place k, and the area A in reach, over which a place is uniform beforehand.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import TINY, Bools, Floats, Ints, runs_of
from .nlos_mixture import RangeMixture, fit
from .range_noise import RangeNoiseConfig, independent_shares
from .trilateration import AnchorHypothesis, TrilaterationConfig, trilaterate_each


class MovePolicy:
    """Prior probabilities of what happens to an anchor, and the effort of the search."""

    moved: float = 0.01
    """That an anchor is moved while a recording is made."""
    moved_between: float = 0.05
    """That it is moved between two recordings."""
    usual: float = 0.3
    """That its line of sight changes lastingly while a recording is made; that one whose height nobody gave is high."""
    heights: tuple[float, ...] = tuple(np.arange(1.0, 7.0).tolist())
    """m; heights above the tag that are tried."""
    splits: int = 3
    likely: int = 2
    """Times tried first, spread evenly over an interval's ranges, and divisions from which the search for times goes on."""
    laps: int = 4
    """Rounds between places and times, and between places and errors; two or three are usual."""
    compared: int = 3
    """Places by a part of the ranges that are compared."""
    grid: int = 4001
    """Errors at which a density is summed."""
    farthest: float = 1.0
    """m; the longest step of a descent."""
    nearest: float = 0.1
    """m; a range shorter than the height keeps so much of a distance."""


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Ranges of one radio along a path, in the order of recordings and of time."""

    path: Floats
    """(m, 2) tag, m."""
    ranges: Floats
    """(m,) m; level where the anchor's height is given."""
    recording: Ints
    """(m,)."""
    sigma: float
    """Short-term standard deviation, m."""
    heights: tuple[float, ...] = (0.0,)
    """m above the tag, the likeliest first; several where none is given."""

    def level(self, height: float) -> Floats:
        """Return the distances (m,) in the plane to an anchor at a height, m."""
        return np.sqrt(np.maximum(self.ranges**2 - height**2, MovePolicy.nearest**2))


@dataclass(frozen=True, slots=True, eq=False)
class Explanation:
    """Places of one radio and when each holds."""

    place: Ints
    """(m,) number of the place of each range, in the order of time; -1: made while the radio was carried."""
    found: tuple[AnchorHypothesis, ...]
    """(p,) places."""
    evidence: float
    """Logarithm of the marginal likelihood."""
    height: float = 0.0
    """m above the tag."""

    @property
    def places(self) -> Floats:
        """(p, 2) m."""
        return np.array([each.position for each in self.found])


class PlaceModel:
    """Evidence of explanations of one track."""

    def __init__(self, track: Track, config: TrilaterationConfig, noise: RangeNoiseConfig) -> None:
        self.track, self.config, self.noise = track, config, noise
        reach = float(np.max(track.ranges, initial=1.0))
        self.width = max(reach, 2.0)
        self.area = float(np.prod(np.ptp(track.path, axis=0) + 2.0 * reach))
        self.usual = RangeMixture.usual(max(2.0 * track.sigma, MovePolicy.nearest), self.width)
        self.count = np.bincount(track.recording)[track.recording]
        self.alone = self.worth(np.zeros(len(track.ranges), dtype=np.intp))

    def along(self, path: Floats) -> "PlaceModel":
        """Return the model of the same ranges along another path, tag (m, 2), m."""
        return PlaceModel(replace(self.track, path=path), self.config, self.noise)

    def worth(self, place: Ints) -> Floats:
        """Return what share (m,) of a range with errors of its own each range is worth: neighbours within one interval have
        most of their errors in common."""
        return independent_shares(self.track.path, [*intervals_of(place), *ways_of(place)], self.noise)

    def likeliest(self, height: float, parts: Sequence[slice | Bools | Ints]) -> list[AnchorHypothesis]:
        """Return the likeliest place by each of some parts of the ranges, at usual errors."""
        level = self.track.level(height)
        stretches = [(self.track.path[part], level[part]) for part in parts]
        each = zip(parts, trilaterate_each(stretches, self.config), strict=True)

        def likelihood(place: AnchorHypothesis, part: slice | Bools | Ints) -> float:
            return float(self.alone[part] @ self.likely(level, place, part)) + self.bias_prior(place)

        most = MovePolicy.compared
        return [max(some[:most], key=lambda place: likelihood(place, part), default=_NOWHERE) for part, some in each]

    def bias_prior(self, place: AnchorHypothesis) -> float:
        """Return the logarithm of the prior of a place's constant error, but for a constant."""
        return -0.5 * (place.bias / self.config.bias_sigma) ** 2

    def likely(self, level: Floats, place: AnchorHypothesis, rows: slice | Bools | Ints) -> Floats:
        """Return the logarithm of the likelihood of each range at a place, at usual errors."""
        return self.usual.log_density(level[rows] - np.hypot(*(place.position - self.track.path[rows]).T) - place.bias)

    def with_places(self, each: Explanation, shares: Floats) -> Explanation:
        """Return an explanation with its places at their likeliest."""
        return self.explanation(each.place, each.found, each.height, shares)

    def explanation(
        self, place: Ints, start: Sequence[AnchorHypothesis], height: float, shares: Floats, apart: Bools | None = None
    ) -> Explanation:
        """Return the explanation by places and times, the places at their likeliest from a start.

        Parameters
        ----------
        shares : (m,) see worth. apart : (m,) ranges whose errors have a distribution of their own; None = none.
        """
        track, level = self.track, self.track.level(height)
        group = track.recording if apart is None else np.where(apart, track.recording.max() + 1, track.recording)
        at, placed = np.array([each.position for each in start]), np.flatnonzero(place >= 0)
        of, path, free = place[placed], track.path[placed], 2.0 * np.pi / self.area * np.eye(2)
        error = np.zeros(len(place))
        for _ in range(MovePolicy.laps):
            offset = at[of] - path
            distance = np.maximum(np.hypot(*offset.T), TINY)
            error[placed], direction = level[placed] - distance, offset / distance[:, None]
            likely, pulled, weight = self._errors(error, group, place >= 0, shares)
            information, gradient = np.tile(free, (len(at), 1, 1)), np.zeros((len(at), 2))
            np.add.at(information, of, weight[placed, None, None] * direction[:, :, None] * direction[:, None])
            np.add.at(gradient, of, (weight * pulled)[placed, None] * direction)
            now, determinants = at, np.linalg.slogdet(information)[1]
            step = np.linalg.solve(information, gradient[:, :, None])[:, :, 0]
            if np.abs(step).max() < self.config.still:
                break
            at = at + step * np.minimum(1.0, MovePolicy.farthest / np.maximum(np.hypot(*step.T), TINY))[:, None]
        evidence = likely + self._log_prior(place, height)
        evidence += float(np.sum(np.log(2.0 * np.pi / self.area) - 0.5 * determinants))
        sigma = np.linalg.eigvalsh(information)[:, 0] ** -0.5
        each = zip(start, now, sigma.tolist(), strict=True)
        return Explanation(place, tuple(replace(h, position=p, position_sigma=s) for h, p, s in each), evidence, height)

    def _errors(self, error: Floats, group: Ints, placed: Bools, shares: Floats) -> tuple[float, Floats, Floats]:
        """Return the evidence of errors (m,), their difference (m,) from the likeliest error, m, and their weights (m,), 1/m^2.

        Each group (m,) has a distribution; that of a number beyond the recordings' is behind an obstacle.
        """
        track, spread, clear = self.track, self.config.bias_sigma**2, (0.0, np.inf)
        pulled, weight = np.zeros(len(error)), np.zeros(len(error))
        evidence = -float(shares[~placed].sum()) * np.log(self.width)
        for number in np.unique(group[placed]).tolist():
            own, behind = np.flatnonzero((group == number) & placed), number > track.recording.max()
            # Obstacles make ranges longer, never shorter, and they do not make the radio noisier.
            most = clear[1] if behind else np.inf
            mixture = replace(fit(error[own], min(max(track.sigma, self.noise.min_sigma), most), most), width=self.width)
            mode, relative = mixture.mode(), mixture.centre - (clear[0] if behind else 0.0)
            pulled[own] = error[own] - mode
            weight[own] = shares[own] * mixture.weights(error[own], mode) / mixture.sigma**2
            # Of the other four parameters only the number of ranges counts (G. Schwarz 1978), of the constant error its prior.
            count = max(float(shares[own].sum()), 1.0)
            evidence += float(shares[own] @ mixture.log_density(error[own])) - 2.0 * np.log(count)
            evidence += 0.5 * np.log(mixture.sigma**2 / (count * spread)) - 0.5 * relative**2 / spread
            if behind:
                evidence += np.log(2.0) if relative > -mixture.sigma else -np.inf
            elif mixture.sigma < clear[1]:
                clear = mixture.centre, mixture.sigma
        return float(evidence), pulled, weight

    def _log_prior(self, place: Ints, height: float) -> float:
        """Return the logarithm of the prior probability of changes of place at these times, and of a height."""
        placed, policy = np.flatnonzero(place >= 0), MovePolicy
        change = np.flatnonzero(np.diff(place[placed]))
        before, after = placed[change], placed[change + 1]
        between = self.track.recording[before] != self.track.recording[after]
        times = np.log(self.count[before]) * np.where(after - before > 1, 2.0, 1.0)
        moved = float(np.sum(np.where(between, np.log(policy.moved_between), np.log(policy.moved) - times)))
        return moved + (float(np.log(policy.usual / len(policy.heights))) if height != self.track.heights[0] else 0.0)


_NOWHERE = AnchorHypothesis(np.zeros(2), 0.0, 1.0, np.inf, np.inf)
"""In place of that of too few ranges."""


def intervals_of(place: Ints) -> list[Ints]:
    """Return the rows of each interval at one place."""
    placed = np.flatnonzero(place >= 0)
    return np.split(placed, np.flatnonzero(np.diff(place[placed])) + 1)


def ways_of(place: Ints) -> list[Ints]:
    """Return the rows of each run of ranges made on the way from place to place."""
    return [np.arange(*run) for run in runs_of(place < 0)]
