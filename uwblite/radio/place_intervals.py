"""Search for where an anchor stood, and when: the explanation of one radio's ranges of greatest evidence (place_evidence.py).

A second place competes with one place and what else makes ranges differ from some time on: a line of sight that is blocked for
a stretch (its ranges have further delays), and an anchor high above the tag.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from ..arrays import Floats, Ints, best_run
from .place_evidence import Explanation, MovePolicy, PlaceModel, intervals_of, ways_of
from .trilateration import AnchorHypothesis


def explain(model: PlaceModel) -> Explanation:
    """Return the explanation of greatest evidence."""
    search = _Search(model)
    best = search.one_place(model.track.heights[0])
    for others in (search.divided, search.returned):
        while (better := others(best)) is not None:
            best = better
    return best


class _Search:
    """Explanations that are a change away from another one."""

    def __init__(self, model: PlaceModel) -> None:
        self.model, self.track, self.least = model, model.track, model.config.min_ranges

    def one_place(self, height: float) -> Explanation:
        """Return the explanation by one place at a height above the tag, m."""
        model, none = self.model, np.zeros(len(self.track.ranges), dtype=np.intp)
        return model.explanation(none, model.likeliest(height, [slice(None)]), height, model.alone)

    def divided(self, best: Explanation) -> Explanation | None:
        """Return the explanation with a place more, or another height, of greatest evidence; None where none is better."""
        starts = [best]
        if len(best.found) == 1 and self._misfits(best):
            starts += [self.one_place(height) for height in self.track.heights if height != best.height]
        top = max(starts, key=_evidence)
        parts = (self._divisions(start, top, own) for start in starts for own in intervals_of(best.place))
        stops = (self._stop(best, own) for own in ways_of(best.place) if len(own) >= self.least)
        better = [each for some in (*parts, *stops) for each in some]
        return max(better, key=_evidence) if better else top if top is not best else None

    def _misfits(self, best: Explanation) -> bool:
        """Return whether the ranges fit one place worse than usual errors would: then it may be higher, too."""
        density = self.model.usual.log_density(np.linspace(-self.model.width, self.model.width, MovePolicy.grid))
        likely = self.model.likely(self.track.level(best.height), best.found[0], slice(None))
        return float(np.average(likely, weights=self.model.alone)) < float(np.average(density, weights=np.exp(density)))

    def _stop(self, best: Explanation, own: Ints) -> list[Explanation]:
        """Return the explanation with a place at which the radio stood on the way (rows), where that is better."""
        place = best.place.copy()
        place[own] = len(best.found)
        return self._better(best, place, [*best.found, *self.model.likeliest(best.height, [own])], self.model.worth(place))

    def _divisions(self, best: Explanation, other: Explanation, own: Ints) -> Iterator[Explanation]:
        """Yield an interval (rows) divided between two places, where neither one place, at this or another height, is better,
        nor a blocked line of sight."""
        part = self._best_split(own, best)
        if part is None:
            return
        leaves, arrives, places = part
        place, here = best.place.copy(), int(best.place[own[0]])
        place[own[leaves:arrives]], place[own[arrives:]] = -1, len(best.found)
        found = [*best.found, places[1]]
        if np.array_equal(np.flatnonzero(best.place == here), own):
            found[here] = places[0]
        shares = self.model.worth(place)
        moved = self._numbered(place, found, best.height, shares)
        rivals = (self.model.with_places(each, shares).evidence for each in (best, other)[: 1 if other is best else 2])
        if moved.evidence > max(rivals) and moved.evidence > self._blocked(best, own, arrives, places, shares):
            yield moved

    def returned(self, best: Explanation) -> Explanation | None:
        """Return the explanation with a stretch of an interval at another known place; None where none is better."""
        better = []
        for own in intervals_of(best.place) if len(best.found) > 1 else ():
            here, level, shares = int(best.place[own[0]]), self.track.level(best.height), self.model.worth(best.place)[own]
            for k in sorted(set(range(len(best.found))) - {here}):
                stays, leaves = (shares * self.model.likely(level, best.found[n], own) for n in (here, k))
                start, end = best_run(leaves - stays)
                place = best.place.copy()
                place[own[start:end]] = k
                better += self._better(best, place, best.found, self.model.worth(place))
        return max(better, key=_evidence, default=None)

    def _better(self, best: Explanation, place: Ints, found: Sequence[AnchorHypothesis], shares: Floats) -> list[Explanation]:
        """Return an explanation by other times where it is better than the best one."""
        if np.array_equal(place, best.place):
            return []
        other = self._numbered(place, found, best.height, shares)
        return [other] if other.evidence > self.model.with_places(best, shares).evidence else []

    def _numbered(self, place: Ints, found: Sequence[AnchorHypothesis], height: float, shares: Floats) -> Explanation:
        """Return the explanation by places, numbered in the order in which they occur."""
        numbers, first = np.unique(place[place >= 0], return_index=True)
        order = numbers[np.argsort(first)]
        number = np.full(len(found) + 1, -1)
        number[order] = np.arange(len(order))
        return self.model.explanation(number[place], [found[k] for k in order.tolist()], height, shares)

    def _best_split(self, own: Ints, best: Explanation) -> tuple[int, int, list[AnchorHypothesis]] | None:
        """Return when the anchor leaves and arrives, as numbers of ranges in an interval (rows), and its two places, by which
        these are the likeliest: places and times in turn, from several times on."""
        least = self.least
        if len(own) < 2 * least:
            return None
        level, shares = self.track.level(best.height), self.model.worth(best.place)[own]
        alone = float(shares @ self.model.likely(level, best.found[int(best.place[own[0]])], own))
        new = np.flatnonzero(np.diff(self.track.recording[own])) + 1
        starts = np.union1d(np.linspace(least, len(own) - least, MovePolicy.splits).astype(np.intp), new)
        waiting = {(k, k) for k in starts.tolist() if least <= k <= len(own) - least}
        split: tuple[float, tuple[int, int], list[AnchorHypothesis]] = (alone, (0, 0), [])
        tried: set[tuple[int, int]] = set()
        for _ in range(MovePolicy.laps):
            pairs = sorted(waiting - tried)
            tried |= waiting
            parts = [part for leaves, arrives in pairs for part in (own[:leaves], own[arrives:])]
            found = self.model.likeliest(best.height, parts)
            splits = []
            for places in zip(found[::2], found[1::2], strict=True):
                one, other = (shares * self.model.likely(level, place, own) for place in places)
                likely, times = _times(one, other, -np.log(self.model.width) * shares, least)
                splits.append((likely + sum(map(self.model.bias_prior, places)), times, list(places)))
            splits.sort(key=lambda each: -each[0])
            split = max([split, *splits[:1]], key=lambda each: each[0])
            waiting = {at for _, at, _ in splits[: MovePolicy.likely]}
            if not split[2] or waiting <= tried:
                break
        return (*split[1], split[2]) if split[2] else None

    def _blocked(self, best: Explanation, own: Ints, split: int, places: Sequence[AnchorHypothesis], shares: Floats) -> float:
        """Return the evidence of one place instead of two in an interval (rows) with delays before or after a time."""
        here, level = int(best.place[own[0]]), self.track.level(best.height)
        tried = []
        for start in (best.found[here], *places):
            error = level[own] - np.hypot(*(start.position - self.track.path[own]).T)
            first, last = (self.model.usual.log_density(error - np.median(part)) for part in (error[:split], error[split:]))
            # The delay may begin at another time than the move that explains the same ranges.
            time = int(np.argmax(np.cumsum(shares[own] * (first - last)))) + 1
            for part in (own[:time], own[time:]):
                if 0 < len(part) < len(own):
                    apart = np.zeros(len(best.place), dtype=bool)
                    apart[part] = True
                    found = [*best.found[:here], start, *best.found[here + 1 :]]
                    tried.append(self.model.explanation(best.place, found, best.height, shares, apart).evidence)
        return max(tried, default=-np.inf) + float(np.log(MovePolicy.usual / self.model.count[own[0]]))


def _evidence(each: Explanation) -> float:
    return each.evidence


def _times(one: Floats, other: Floats, carried: Floats, least: int) -> tuple[float, tuple[int, int]]:
    """Return the greatest sum of logarithms of likelihoods (m,) at one place, on the way, and at the other place, and when the
    way begins and ends, a time more to say; at least so many ranges are of either place."""
    low, high = least, len(one) - least
    until, since = (np.append(0.0, np.cumsum(each - carried)) for each in (one, other))
    begun = until[low : high + 1]
    arrives = int(np.argmax(np.maximum.accumulate(begun) - since[low : high + 1]))
    leaves = int(np.argmax(begun[: arrives + 1]))
    rest = float(since[-1] + carried.sum())
    once = int(np.argmax(begun - since[low : high + 1]))
    slowly = float(begun[leaves] - since[low + arrives]) + rest - float(np.log(len(one)))
    at_once = float(begun[once] - since[low + once]) + rest
    return (slowly, (low + leaves, low + arrives)) if slowly > at_once else (at_once, (low + once, low + once))
