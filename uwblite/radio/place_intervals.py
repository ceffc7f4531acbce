"""Where an anchor stood, and when: one model of places and intervals, within a recording and between recordings.

Along a given path the ranges of one radio are explained by places, each of which holds during intervals; ranges made while it
is carried from one to the next are gross errors. Explanations are compared by their evidence, the logarithm of the marginal
likelihood (Laplace; D. MacKay, Bayesian interpolation, 1992):

    sum_i c_i log f(e_i) + log priors + sum_k log(|2 pi S_k|^1/2 / A)

f is the mixture of line of sight, NLOS delays and gross errors (nlos_mixture) of the errors e_i under that explanation, c_i
counts errors that neighbouring places have in common once, S_k is the covariance of place k, and A the area in reach, over
which a place is uniform beforehand. A second place competes with one place and what else makes ranges differ from some time
on: a line of sight that is blocked for a stretch (its ranges have further delays), and an anchor high above the tag.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ..arrays import Bools, Floats, Ints, runs_of
from .nlos_mixture import RangeMixture, fit
from .range_noise import RangeNoise, RangeNoiseConfig, effective_sigma
from .trilateration import AnchorHypothesis, TrilaterationConfig, trilaterate_each


@dataclass(frozen=True, slots=True)
class MovePolicy:
    """Prior probabilities of what happens to an anchor, and the effort of the search."""

    moved: ClassVar[float] = 0.01
    """That an anchor is moved while a recording is made."""
    moved_between: ClassVar[float] = 0.05
    """That it is moved between two recordings."""
    blocked: ClassVar[float] = 0.3
    """That its line of sight changes lastingly while a recording is made."""
    high: ClassVar[float] = 0.3
    """That an anchor whose height nobody gave is high above the tag."""
    heights: ClassVar[tuple[float, ...]] = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    """m; heights that are tried."""
    most_ranges: ClassVar[int] = 1000
    """Ranges of one radio that are compared, spread evenly; a place needs no more."""
    splits: ClassVar[int] = 3
    """Times tried first, spread evenly over the ranges of an interval."""
    laps: ClassVar[int] = 4
    """Rounds between places and times, and between places and errors; two or three are usual."""


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
        return np.sqrt(np.maximum(self.ranges**2 - height**2, _LEAST_LEVEL**2))


_LEAST_LEVEL = 0.1
"""m; a range shorter than the height keeps so much of a distance."""


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


def explain(track: Track, config: TrilaterationConfig, noise: RangeNoiseConfig) -> Explanation:
    """Return the explanation of greatest evidence."""
    model = PlaceModel(track, config, noise)
    best = model.one_place()
    for others in (model.divided, model.returned, model.united):
        while (better := others(best)) is not None:
            best = better
    return best


class PlaceModel:
    """Explanations of one track and their evidence."""

    def __init__(self, track: Track, config: TrilaterationConfig, noise: RangeNoiseConfig) -> None:
        self.track, self.config, self.noise = track, config, noise
        reach = float(np.max(track.ranges, initial=1.0))
        self.width = max(reach, 2.0)
        self.area = float(np.prod(np.ptp(track.path, axis=0) + 2.0 * reach))
        self.usual = RangeMixture(0.0, max(2.0 * track.sigma, 0.1), 0.2, 0.5, 0.05, self.width)
        self.count = np.bincount(track.recording)[track.recording]
        self.alone = self.worth(np.zeros(len(track.ranges), dtype=np.intp))

    def one_place(self) -> Explanation:
        """Return the explanation by one place, at the likeliest height."""
        none, height = np.zeros(len(self.track.ranges), dtype=np.intp), self.track.heights[0]
        return self.explanation(none, self.likeliest(height, [slice(None)]), height, self.worth(none))

    def worth(self, place: Ints) -> Floats:
        """Return what share (m,) of a range with errors of its own each range is worth.

        Ranges of one interval from neighbouring places have most of their errors in common. That ranges differ which were made
        at one place at different times is no error of that kind, so intervals count apart.
        """
        white, slow = np.sqrt(1.0 - self.noise.slow_share), np.sqrt(self.noise.slow_share)
        correlated, shares = RangeNoise(white, slow, self.noise.correlation_length), np.ones(len(place))
        for own in [*intervals_of(place), *_ways(place)]:
            shares[own] = effective_sigma(self.track.path[own], correlated) ** -2
        return shares

    def divided(self, best: Explanation) -> Explanation | None:
        """Return the explanation with a place more, or another height, of greatest evidence; None where none is better."""
        starts = [best]
        if len(best.found) == 1 and self._misfits(best):
            heights = (height for height in self.track.heights if height != best.height)
            shares = self.worth(best.place)
            starts += [self.explanation(best.place, self.likeliest(h, [slice(None)]), h, shares) for h in heights]
        top = max(starts, key=_evidence)
        parts = (self._divisions(start, top, own) for start in starts for own in intervals_of(best.place))
        stops = (self._stop(best, own) for own in _ways(best.place) if len(own) >= self.config.min_ranges)
        better = [each for some in (*parts, *stops) for each in some]
        return max(better, key=_evidence) if better else top if top is not best else None

    def _misfits(self, best: Explanation) -> bool:
        """Return whether the ranges fit one place worse than usual errors would: then it may be higher, too."""
        density = self.usual.log_density(np.linspace(-self.width, self.width, _GRID))
        likely = self._likely(self.track.level(best.height), best.found[0], slice(None))
        return float(np.average(likely, weights=self.alone)) < float(np.average(density, weights=np.exp(density)))

    def _stop(self, best: Explanation, own: Ints) -> list[Explanation]:
        """Return the explanation with a place at which the radio stood on the way (rows), where that is better."""
        place = best.place.copy()
        place[own] = len(best.found)
        return self._better(best, place, [*best.found, *self.likeliest(best.height, [own])], self.worth(place))

    def _divisions(self, best: Explanation, other: Explanation, own: Ints) -> Iterator[Explanation]:
        """Yield an interval (rows) divided between two places, where neither one place, at this or another height, is better,
        nor a blocked line of sight."""
        part = self._best_split(own, best)
        if part is None:
            return
        left, moment, places = part
        place, here = best.place.copy(), int(best.place[own[0]])
        place[own[left:moment]], place[own[moment:]] = -1, len(best.found)
        found = [*best.found, places[1]]
        if np.array_equal(np.flatnonzero(best.place == here), own):
            found[here] = places[0]
        shares = self.worth(place)
        moved = self._numbered(place, found, best.height, shares)
        rivals = (self.with_places(each, shares).evidence for each in (best, other)[: 1 if other is best else 2])
        if moved.evidence > max(rivals) and moved.evidence > self._blocked(best, own, moment, places, shares):
            yield moved

    def returned(self, best: Explanation) -> Explanation | None:
        """Return the explanation with a stretch of an interval at another known place; None where none is better."""
        better = []
        for own in intervals_of(best.place) if len(best.found) > 1 else ():
            here, level, shares = int(best.place[own[0]]), self.track.level(best.height), self.worth(best.place)[own]
            for k in sorted(set(range(len(best.found))) - {here}):
                stays, leaves = (shares * self._likely(level, best.found[n], own) for n in (here, k))
                start, end = _best_run(leaves - stays)
                place = best.place.copy()
                place[own[start:end]] = k
                better += self._better(best, place, best.found, self.worth(place))
        return max(better, key=_evidence, default=None)

    def united(self, best: Explanation) -> Explanation | None:
        """Return the explanation with two of the places as one; None where none is better."""
        better = []
        for k in range(len(best.found)):
            for other in range(k):
                place = np.where(best.place == k, other, best.place)
                rows = np.flatnonzero(place == other)
                found = [*best.found[:other], *self.likeliest(best.height, [rows]), *best.found[other + 1 :]]
                better += self._better(best, place, found, self.worth(best.place))
        return max(better, key=_evidence, default=None)

    def _better(
        self, best: Explanation, place: Ints, found: Sequence[AnchorHypothesis], shares: Floats
    ) -> list[Explanation]:
        """Return an explanation by other times where it is better than the best one."""
        if np.array_equal(place, best.place):
            return []
        other = self._numbered(place, found, best.height, shares)
        return [other] if other.evidence > self.with_places(best, shares).evidence else []

    def _numbered(self, place: Ints, found: Sequence[AnchorHypothesis], height: float, shares: Floats) -> Explanation:
        """Return the explanation by places, numbered in the order in which they occur."""
        numbers, first = np.unique(place[place >= 0], return_index=True)
        order = numbers[np.argsort(first)]
        number = np.full(len(found) + 1, -1)
        number[order] = np.arange(len(order))
        return self.explanation(number[place], [found[k] for k in order.tolist()], height, shares)

    def likeliest(self, height: float, parts: Sequence[slice | Bools | Ints]) -> list[AnchorHypothesis]:
        """Return the likeliest place by each of some parts of the ranges, at usual errors."""
        level = self.track.level(height)
        stretches = [(self.track.path[part], level[part]) for part in parts]
        each = zip(parts, trilaterate_each(stretches, self.config), strict=True)

        def likelihood(place: AnchorHypothesis, part: slice | Bools | Ints) -> float:
            return float(self.alone[part] @ self._likely(level, place, part)) + self._bias_prior(place)

        return [max(some[:_MOST], key=lambda place: likelihood(place, part), default=_NOWHERE) for part, some in each]

    def _bias_prior(self, place: AnchorHypothesis) -> float:
        """Return the logarithm of the prior of a place's constant error, but for a constant."""
        return -0.5 * (place.bias / self.config.bias_sigma) ** 2

    def _likely(self, level: Floats, place: AnchorHypothesis, rows: slice | Bools | Ints) -> Floats:
        """Return the logarithm of the likelihood of each range at a place, at usual errors."""
        return self.usual.log_density(level[rows] - np.hypot(*(place.position - self.track.path[rows]).T) - place.bias)

    def _best_split(self, own: Ints, best: Explanation) -> tuple[int, int, list[AnchorHypothesis]] | None:
        """Return the times and places that divide an interval (rows) best: places and times in turn, from several times on."""
        least = self.config.min_ranges
        if len(own) < 2 * least:
            return None
        level, shares = self.track.level(best.height), self.worth(best.place)[own]
        alone = float(shares @ self._likely(level, best.found[int(best.place[own[0]])], own))
        new = np.flatnonzero(np.diff(self.track.recording[own])) + 1
        starts = np.union1d(np.linspace(least, len(own) - least, MovePolicy.splits).astype(np.intp), new)
        waiting = {(k, k) for k in starts.tolist() if least <= k <= len(own) - least}
        split: tuple[float, tuple[int, int], list[AnchorHypothesis]] = (alone, (0, 0), [])
        tried: set[tuple[int, int]] = set()
        for _ in range(MovePolicy.laps):
            pairs = sorted(waiting - tried)
            tried |= waiting
            found = self.likeliest(best.height, [part for left, moment in pairs for part in (own[:left], own[moment:])])
            splits = []
            for places in zip(found[::2], found[1::2], strict=True):
                one, other = (shares * self._likely(level, place, own) for place in places)
                likely, times = _times(one, other, -np.log(self.width) * shares, least)
                splits.append((likely + sum(map(self._bias_prior, places)), times, list(places)))
            splits.sort(key=lambda each: -each[0])
            split = max([split, *splits[:1]], key=lambda each: each[0])
            waiting = {at for _, at, _ in splits[:_LIKELY]}
            if not split[2] or waiting <= tried:
                break
        return (*split[1], split[2]) if split[2] else None

    def _blocked(self, best: Explanation, own: Ints, split: int, places: Sequence[AnchorHypothesis], shares: Floats) -> float:
        """Return the evidence of one place instead of two in an interval (rows) with delays before or after a time."""
        here, level = int(best.place[own[0]]), self.track.level(best.height)
        tried = []
        for start in (best.found[here], *places):
            error = level[own] - np.hypot(*(start.position - self.track.path[own]).T)
            first, last = (self.usual.log_density(error - np.median(part)) for part in (error[:split], error[split:]))
            # The delay may begin at another time than the move that explains the same ranges.
            time = int(np.argmax(np.cumsum(shares[own] * (first - last)))) + 1
            for part in (own[:time], own[time:]):
                if 0 < len(part) < len(own):
                    apart = np.zeros(len(best.place), dtype=bool)
                    apart[part] = True
                    found = [*best.found[:here], start, *best.found[here + 1 :]]
                    tried.append(self.explanation(best.place, found, best.height, shares, apart).evidence)
        return max(tried, default=-np.inf) + float(np.log(MovePolicy.blocked / self.count[own[0]]))

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
            distance = np.maximum(np.hypot(*offset.T), _NEAREST)
            error[placed], direction = level[placed] - distance, offset / distance[:, None]
            likely, pulled, weight = self._errors(error, group, place >= 0, shares)
            information, gradient = np.tile(free, (len(at), 1, 1)), np.zeros((len(at), 2))
            np.add.at(information, of, weight[placed, None, None] * direction[:, :, None] * direction[:, None])
            np.add.at(gradient, of, (weight * pulled)[placed, None] * direction)
            now, determinants = at, np.linalg.slogdet(information)[1]
            step = np.linalg.solve(information, gradient[:, :, None])[:, :, 0]
            if np.abs(step).max() < _STILL:
                break
            at = at + step * np.minimum(1.0, _FARTHEST / np.maximum(np.hypot(*step.T), _NEAREST))[:, None]
        evidence = likely + self._log_prior(place, height)
        evidence += float(np.sum(np.log(2.0 * np.pi / self.area) - 0.5 * determinants))
        sigma = np.linalg.eigvalsh(information)[:, 0] ** -0.5
        each = zip(start, now, sigma.tolist(), strict=True)
        return Explanation(place, tuple(replace(h, position=p, position_sigma=s) for h, p, s in each), evidence, height)

    def _errors(self, error: Floats, group: Ints, placed: Bools, shares: Floats) -> tuple[float, Floats, Floats]:
        """Return the evidence of errors (m,), their difference (m,) from the likeliest error, m, and their weights (m,), 1/m^2.

        Parameters
        ----------
        group : (m,) each has a distribution; that of a number beyond the recordings' is behind an obstacle.
        """
        track, spread, clear = self.track, self.config.bias_sigma**2, (0.0, np.inf)
        pulled, weight = np.zeros(len(error)), np.zeros(len(error))
        evidence = -float(shares[~placed].sum()) * np.log(self.width)
        for number in np.unique(group[placed]).tolist():
            own, behind = np.flatnonzero((group == number) & placed), number > track.recording.max()
            # Obstacles make ranges longer, never shorter, and they do not make the radio noisier.
            most = clear[1] if behind else np.inf
            mixture = replace(fit(error[own], min(max(track.sigma, _LEAST_SIGMA), most), most), width=self.width)
            mode, relative = mixture.mode(), mixture.centre - (clear[0] if behind else 0.0)
            pulled[own] = error[own] - mode
            weight[own] = shares[own] * mixture.weights(error[own]) / mixture.sigma**2
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
        return moved + (float(np.log(policy.high / len(policy.heights))) if height != self.track.heights[0] else 0.0)


_NOWHERE = AnchorHypothesis(np.zeros(2), 0.0, 1.0, np.inf, np.inf)
"""In place of that of too few ranges."""
_LIKELY, _MOST = 2, 3
"""Divisions from which the search is continued, and places by a part of the ranges that are compared."""
_STILL, _FARTHEST, _NEAREST = 1e-3, 1.0, 1e-6
"""m; a step that ends the descent of a place, the longest one, and the least distance."""
_GRID = 4001
"""Errors at which a density is summed."""
_LEAST_SIGMA = 0.03
"""m; no radio measures more finely."""


def _evidence(each: Explanation) -> float:
    return each.evidence


def intervals_of(place: Ints) -> list[Ints]:
    """Return the rows of each interval at one place."""
    placed = np.flatnonzero(place >= 0)
    return np.split(placed, np.flatnonzero(np.diff(place[placed])) + 1)


def _ways(place: Ints) -> list[Ints]:
    """Return the rows of each run of ranges made on the way from place to place."""
    return [np.arange(*run) for run in runs_of(place < 0)]


def _times(one: Floats, other: Floats, carried: Floats, least: int) -> tuple[float, tuple[int, int]]:
    """Return the greatest sum of logarithms of likelihoods (m,) at one place, on the way, and at the other place, and when the
    way begins and ends; at least so many ranges are of either place.

    A few ranges of neither place are gross errors: that a radio is carried for a time takes a time more to say.
    """
    low, high = least, len(one) - least
    until, since = (np.append(0.0, np.cumsum(each - carried)) for each in (one, other))
    begun = until[low : high + 1]
    moment = int(np.argmax(np.maximum.accumulate(begun) - since[low : high + 1]))
    left = int(np.argmax(begun[: moment + 1]))
    rest = float(since[-1] + carried.sum())
    once = int(np.argmax(begun - since[low : high + 1]))
    slowly = float(begun[left] - since[low + moment]) + rest - float(np.log(len(one)))
    at_once = float(begun[once] - since[low + once]) + rest
    return (slowly, (low + left, low + moment)) if slowly > at_once else (at_once, (low + once, low + once))


def _best_run(gain: Floats) -> tuple[int, int]:
    """Return begin and end of the run of greatest sum (Kadane)."""
    sums = np.append(0.0, np.cumsum(gain))
    end = int(np.argmax(sums - np.minimum.accumulate(sums)))
    return int(np.argmin(sums[: end + 1])), end
