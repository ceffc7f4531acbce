"""What explains ranges that do not fit the path by the wheels: the wheels, the radio's clock, or the anchors' names.

The ranges to an anchor are distances from the path to one place. Each row of the table changes what they are taken to: the
times of the ranges, the names of the anchors, the path after a moment. Each has prior odds, and all are compared by one
likelihood with the recording as it stands and with one another: what fits best is the cause, and a row that explains the same
readings less well is none.

Of the readings of an anchor along a stretch of the way the likelihood is that of the best place (places and their common error
cost by Schwarz, 1978), with Cauchy errors; that of a drive of which only the way is known, where the path is wrong; or that of
any numbers, where they are no distances. An anchor may be moved by itself at any moment.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, Ints
from ..findings import Fact
from ..problem.alternatives import EvidencePolicy
from ..sensor_log import SHORTEST_RANGE, SensorLog, plausible
from .units import LENGTHS


class PathPolicy:
    """Priors of the explanations, and what is compared."""

    fault: float = 1e-3
    """Probability of a clock that is off by seconds, of names exchanged and of one anchor moved at a given moment."""
    wheels: float = 1e-2
    """Of wheels that are wrong from a given moment on."""
    most_late: float = 20.0
    """Largest offset of the clock, s; all up to it are equally probable, and compared in steps of a second.

    One of a second is no fault but calibrated with the map."""
    noise: Floats = np.array([0.1, 0.2, 0.4])
    """Scales of the errors of ranges, m, that of a path by wheels over a stretch included; each row has its best."""
    apart: float = 0.5
    """Way between two readings of an anchor that count, m: the errors of ranges last for so long."""
    stretch: float = 8.0
    """Way for which wheels alone give the shape of the path, m."""
    fewest: int = 6
    """Readings of an anchor in a stretch: three give its place and its error."""
    factors: Floats = np.geomspace(0.5, 2.0, 15)
    """Ways of the robot / ways by the wheels that are compared."""
    usual_motion: float = 0.3
    """Motion that sound wheels miss over twice such a way, m and rad: the map takes it up."""
    turn: float = 0.05
    """Between the turns that are compared, rad."""
    rounds: int = 5
    """Of reweighting of the readings of a place, by errors of the middle scale."""
    antenna_delay: float = 77.0
    """Error of ranges where one of the two devices has no antenna delay, m: half of 513.48 ns (Decawave APS014, 2014)."""
    ridge: float = 1e-6
    """Added to normal equations: a robot that stands shows a distance only."""


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """Readings of one anchor by one tag, apart by the way."""

    anchor: str
    stamps: Floats
    """(n,) s."""
    ranges: Floats
    """(n,) m."""
    way: Floats
    """(n,) travelled by the wheels, m."""
    places: Floats
    """(n, 2) of the base by the wheels, m."""

    def between(self, begin: float, end: float) -> "Trace":
        """Return the readings on a stretch of the way, m, its end included."""
        own = (self.way > begin) & (self.way <= end)
        return Trace(self.anchor, self.stamps[own], self.ranges[own], self.way[own], self.places[own])


@dataclass(frozen=True, slots=True)
class Explanation:
    """One row, and how probable it is."""

    log_odds: float
    """Logarithm of its posterior odds against the recording as it stands."""
    kind: str
    figures: dict[str, Any]
    begin: float = 0.0
    end: float = np.inf
    """Way, m, on which it changes something."""
    names: dict[str, str] = field(default_factory=dict)
    """What anchors are called before the moment by what they are called after it."""

    def meets(self, other: "Explanation") -> bool:
        """Return whether both change something on one stretch."""
        return self.begin < other.end and other.begin < self.end


def explained_by_ranges(log: SensorLog) -> tuple[SensorLog, list[Fact]]:
    """Return the recording with the radio's clock set right, where that explains its ranges best, and what explains them."""
    traces = _traces(log)
    if not traces:
        return log, []
    log, delays = _without_antenna_delays(log, traces)
    traces = _traces(log) if delays else traces
    late = _late(log, traces)
    is_late = late.log_odds > EvidencePolicy.very_strong
    moments = _at_moments(log, traces, to_compare=is_late)
    if is_late and log.ranges is not None:
        stamps, (first, last) = log.ranges.stamps, log.odometry.stamps[[0, -1]]
        grown = late.figures["late"] + late.figures["grows"] * (stamps - first) / (last - first)
        in_time = replace(log, ranges=replace(log.ranges, stamps=stamps - grown))
        left = _at_moments(in_time, _traces(in_time), to_compare=True)
        # A clock that is off contradicts the path at many moments; set right, at fewer.
        if _most(left) <= _most(moments):
            facts = _facts(_with_names_undone(in_time, left), in_time)
            return in_time, [*delays, Fact.of(late.kind, **late.figures), *facts]
    return log, [*delays, *_facts(_with_names_undone(log, moments), log)]


def _most(rows: Sequence[Explanation]) -> float:
    return max((row.log_odds for row in rows), default=-np.inf)


def _with_names_undone(log: SensorLog, rows: list[Explanation]) -> list[Explanation]:
    """Return the rows without those that the exchange of names explains: with the names exchanged back they are no more.

    An exchange contradicts the path, too, at moments somewhat before it and after it, where it is on one side: what holds there
    of two explanations of the same readings shows in what either leaves.
    """
    exchanges = [row for row in rows if row.names and row.log_odds > EvidencePolicy.very_strong]
    for row in sorted(exchanges, key=lambda row: -row.log_odds):
        ranges, near = log.ranges, [other for other in rows if other.meets(row)]
        assert ranges is not None
        at = np.interp(0.5 * (row.begin + row.end), log.odometry.travelled, log.odometry.stamps)
        others = np.array([ranges.anchor_ids.index(row.names.get(name, name)) for name in ranges.anchor_ids], dtype=np.intp)
        anchor = np.where(ranges.stamps > at, others[ranges.anchor], ranges.anchor)
        undone = replace(log, ranges=replace(ranges, anchor=anchor))
        left = _at_moments(undone, _traces(undone), row, to_compare=True)
        if row in rows and _most(left) < min(_most(near) - EvidencePolicy.very_strong, row.log_odds):
            rows, log = [row, *left, *(other for other in rows if other not in near)], undone
    return rows


def _facts(rows: Sequence[Explanation], log: SensorLog) -> list[Fact]:
    """Return the rows for which there is very strong evidence, of those on one stretch the likeliest."""
    stamps, way, taken, facts = log.odometry.stamps, log.odometry.travelled, list[Explanation](), list[Fact]()
    for row in sorted(rows, key=lambda row: -row.log_odds):
        apart = all(row.end < other.begin or row.begin > other.end for other in taken)
        if row.log_odds <= EvidencePolicy.very_strong or not apart:
            continue
        taken.append(row)
        points = np.array([row.begin, 0.5 * (row.begin + row.end), row.end])
        begin, at, end = (stamps[np.searchsorted(way, points, "right").clip(1) - 1] - stamps[0]).tolist()
        facts.append(Fact.of(row.kind, begin=begin, at=at, end=end, **row.figures))
    return facts


def _traces(log: SensorLog) -> list[Trace]:
    """Return the traces of all anchors while there is odometry."""
    ranges, odometry, found = log.ranges, log.odometry, []
    if ranges is None or len(odometry.stamps) < 2:
        return []
    usable = plausible(ranges.ranges) & (ranges.stamps >= odometry.stamps[0]) & (ranges.stamps <= odometry.stamps[-1])
    for anchor, own in ranges.by_pair(usable):
        way = odometry.travelled_at(ranges.stamps[own])
        first = np.unique(np.floor(way / PathPolicy.apart), return_index=True)[1]
        stamps, values = ranges.stamps[own[first]], ranges.ranges[own[first]]
        found.append(Trace(ranges.anchor_ids[anchor], stamps, values, way[first], odometry.at(stamps)[:, :2]))
    return found


def _without_antenna_delays(log: SensorLog, traces: Sequence[Trace]) -> tuple[SensorLog, list[Fact]]:
    """Return the recording without errors of ranges by antenna delays that were never set, of anchors, the tag or both.

    Along a stretch of the way ranges to a place far away change otherwise than those to one in the building; a rival is another
    unit of all ranges.
    """
    assert log.ranges is not None
    names, offsets = log.ranges.anchor_ids, PathPolicy.antenna_delay * np.array([0.0, 1.0, 2.0])
    units = np.append(np.ones_like(offsets), list(LENGTHS.values()))
    offsets = np.append(offsets, np.zeros(len(LENGTHS)))
    likely = np.zeros((len(names), len(PathPolicy.noise), len(offsets)))
    for own in _stretches(log, traces):
        for trace in own:
            ranges = units[:, None] * trace.ranges - offsets[:, None]
            paths = np.broadcast_to(trace.places, (*ranges.shape, 2))
            of_place = _best_place(paths, ranges, np.ones_like(ranges)) + len(trace.ranges) * np.log(units)
            likely[names.index(trace.anchor)] += np.where(np.median(ranges, axis=1) > 0.0, of_place, -np.inf)
    metres, others = np.split(likely.max(axis=1), [len(offsets) - len(LENGTHS)], axis=1)
    shown = metres.max(axis=1) > metres[:, 0] - np.log(PathPolicy.fault) + EvidencePolicy.very_strong
    delays = np.where(shown, offsets[metres.argmax(axis=1)], 0.0)
    if not delays.any() or others.sum(axis=0).max() > metres.max(axis=1).sum():
        return log, []
    facts = [
        Fact.of("antenna-delay", metres=delay, anchors=[names[a] for a in np.flatnonzero(delays == delay).tolist()])
        for delay in np.unique(delays[delays > 0.0]).tolist()
    ]
    # A reading of zero is that of a partner who was missed.
    missed = np.abs(log.ranges.ranges) <= SHORTEST_RANGE
    ranges = log.ranges.ranges - np.where(missed, 0.0, delays[log.ranges.anchor])
    return replace(log, ranges=replace(log.ranges, ranges=ranges)), facts


def _late(log: SensorLog, traces: Sequence[Trace]) -> Explanation:
    """Return a radio's clock that is off throughout, by a constant or by one that grows evenly; its rivals are wheels with
    another scale throughout or that slip on some stretches, and ranges that are any numbers."""
    offsets, factors, slight = np.arange(-PathPolicy.most_late, PathPolicy.most_late + 0.5), PathPolicy.factors, 1.5
    count, stretches, shares, counted = len(factors), list[Floats](), list[float](), 0
    longest, start = max(float(trace.ranges.max(initial=1.0)) for trace in traces), log.odometry.stamps[0]
    for own in _stretches(log, traces):
        stretches.append(_on_stretch(log, own, offsets, longest))
        stamps = np.concatenate([trace.stamps for trace in own])
        shares.append(float((stamps.mean() - start) / np.ptp(log.odometry.stamps)))
        counted += len(stamps)
    if not stretches:
        return Explanation(-np.inf, "late-ranges", {})
    each = np.stack(stretches, axis=1)
    first, last = (offset.ravel() for offset in np.meshgrid(offsets, offsets))
    late = np.zeros((len(each), len(first)))
    for k, share in enumerate(shares):
        late += each[:, k, count + np.rint(PathPolicy.most_late + first + (last - first) * share).astype(np.intp)]
    nothing = -counted * float(np.log(longest))
    steady, sound = first == last, np.maximum(np.abs(first), np.abs(last)) < slight
    null = float(max(each[:, :, :count].sum(axis=1).max(), late[:, sound].max(), nothing))
    rows = list[Explanation]()
    for some in (np.flatnonzero(steady & ~sound), np.flatnonzero(np.abs(last - first) > slight)):
        # Clocks that part were mostly set together, as when a recording begins.
        together = np.abs(first[some]) < slight
        prior = 1.0 + together * len(some) / max(together.sum(), 1)
        likely = late[np.argmax(late[:, some].max(axis=1)), some] + np.log(prior / prior.sum())
        odds = float(np.logaddexp.reduce(likely)) + np.log(PathPolicy.fault)
        weights = np.exp(likely - likely.max())
        by, grows = (float(np.average(values[some], weights=weights)) for values in (first, last - first))
        rows.append(Explanation(odds - null, "late-ranges", {"late": -by, "grows": -grows}))
    return max(rows, key=lambda row: row.log_odds)


def _stretches(log: SensorLog, traces: Sequence[Trace]) -> Iterator[list[Trace]]:
    """Yield the traces that have enough readings on each stretch of the way; none where no trace has."""
    length = PathPolicy.stretch
    edges = np.append(np.arange(0.0, max(log.odometry.travelled[-1] - length, 0.1), length), np.inf)
    for begin, end in zip(edges[:-1] - 1e-9, edges[1:], strict=True):
        parts = (trace.between(begin, end) for trace in traces)
        if own := [part for part in parts if len(part.ranges) >= PathPolicy.fewest]:
            yield own


def _on_stretch(log: SensorLog, traces: Sequence[Trace], offsets: Floats, longest: float) -> Floats:
    """Return log likelihoods (g, h) of traces on a stretch, for g scales of errors, if the way by the wheels has a factor, or
    the radio's clock one of some offsets, s; longest: of all ranges, m.

    Whatever the clock, on a stretch where the wheels slip only the way is known, or its path is any of these.
    """
    likely = np.zeros((len(PathPolicy.noise), len(PathPolicy.factors) + len(offsets)))
    lost = np.zeros((len(likely), 1))
    stamps, poses = log.odometry.stamps, log.odometry.poses
    for trace in traces:
        shifted = trace.stamps + offsets[:, None]
        places = np.stack([np.interp(shifted, stamps, poses[:, k]) for k in (0, 1)], axis=-1)
        paths = np.concatenate([PathPolicy.factors[:, None, None] * trace.places, places])
        likely += _best_place(paths, trace.ranges, np.ones(len(trace.ranges)))
        lost += _by_way(trace, longest)[:, None]
    of_any = np.logaddexp.reduce(likely, axis=1, keepdims=True) - np.log(likely.shape[1])
    return np.asarray(np.logaddexp(likely, np.log(PathPolicy.wheels) + np.logaddexp(lost, of_any)))


def _at_moments(
    log: SensorLog, traces: Sequence[Trace], near: Explanation | None = None, *, to_compare: bool
) -> list[Explanation]:
    """Return names that are exchanged, and paths that go on elsewhere, from a moment on.

    About each moment the readings of a stretch before and after it are compared, in the frame of the robot at that moment;
    where another explanation is given, at moments whose stretches meet its own. To compare recordings, other paths count which
    are hardly likely enough to be told.
    """
    odometry, half, rows = log.odometry, PathPolicy.stretch, list[Explanation]()
    way, sides = odometry.travelled, dict[float, Side]()
    longest = max(float(trace.ranges.max(initial=0.0)) for trace in traces)
    for at in np.arange(half, float(way[-1]) - half, 0.25 * half).tolist():
        if near is not None and (at + half <= near.begin or near.end <= at - half):
            continue
        # What is after one moment is before another.
        for begin in (at - half, at):
            if begin not in sides:
                sides[begin] = Side.of([trace.between(begin, begin + half) for trace in traces], longest)
        before, after = sides[at - half], sides[at]
        own = np.flatnonzero(np.minimum(before.counts, after.counts) >= PathPolicy.fewest)
        if len(own):
            origin = se2.inverse(odometry.at(np.array([np.interp(at, way, odometry.stamps)]))[0])
            moment = Moment(before.seen(origin, own), after.seen(origin, own), [traces[k].anchor for k in own.tolist()])
            rows += [replace(row, begin=at - half, end=at + half) for row in moment.rows(to_compare)]
    return rows


@dataclass(frozen=True, slots=True, eq=False)
class Side:
    """Readings of several anchors on one stretch, filled up to the most that one of them has."""

    traces: Sequence[Trace]
    """(a,) the readings of each."""
    places: Floats
    """(a, n, 2) of the base, m."""
    ranges: Floats
    """(a, n) m."""
    counted: Floats
    """(a, n) 1 for a reading, 0 for what fills up."""
    likely: Floats
    """(a, g) log likelihoods of the readings to one place each."""
    longest: float
    """Of all ranges, m."""

    @staticmethod
    def of(traces: Sequence[Trace], longest: float) -> "Side":
        """Fill up the readings of each anchor and fit a place to them."""
        counts = np.array([len(trace.ranges) for trace in traces])
        there = np.arange(max(counts.max(), 1)) < counts[:, None]
        places, ranges = np.zeros((*there.shape, 2)), np.ones(there.shape)
        places[there] = np.concatenate([trace.places for trace in traces])
        ranges[there] = np.concatenate([trace.ranges for trace in traces])
        counted, enough = there.astype(np.float64), counts >= PathPolicy.fewest
        likely = np.zeros((len(traces), len(PathPolicy.noise)))
        likely[enough] = _best_place(places[enough], ranges[enough], counted[enough]).T
        return Side(traces, places, ranges, counted, likely, longest)

    def seen(self, origin: Floats, own: Ints) -> "Side":
        """Return the readings of some anchors, places moved by a motion (3,)."""
        places, traces = se2.transform(origin, self.places[own]), [self.traces[k] for k in own]
        return Side(traces, places, self.ranges[own], self.counted[own], self.likely[own], self.longest)

    @property
    def counts(self) -> Floats:
        """(a,) readings of each anchor."""
        return np.asarray(self.counted.sum(axis=1))

    @property
    def driven(self) -> Floats:
        """(a, g) log likelihoods of the readings where only the way is known."""
        return np.array([_by_way(trace, self.longest) for trace in self.traces])

    @property
    def nothing(self) -> Floats:
        """(a,) the same where ranges may be any numbers up to the longest."""
        return np.asarray(-self.counts * float(np.log(self.longest)))


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """Readings of anchors before and after a moment."""

    before: Side
    after: Side
    names: list[str]
    """(a,) of the anchors."""

    def likely(self, motions: Floats, sign: float = 1.0, names: Ints | None = None) -> Floats:
        """Return log likelihoods (m,) of a path that goes on by motions (m, 3), mirrored or not, and of anchors that are others
        (a,) after the moment."""
        each = np.arange(len(self.names))
        return np.asarray(self.same(each, each if names is None else names, motions, sign).sum(axis=1).max(axis=0))

    def same(self, k: Ints, other: Ints, motions: Floats, sign: float = 1.0) -> Floats:
        """Return log likelihoods (g, p, m) of anchors k (p,) before the moment being others (p,) after it, moved or not."""
        one, two = self.before, self.after
        moved = se2.transform(motions[:, None], two.places[other][:, None] * np.array([1.0, sign]))
        still = np.broadcast_to(one.places[k][:, None], (len(k), len(motions), *one.places.shape[1:]))
        ranges = np.concatenate([one.ranges[k], two.ranges[other]], axis=1)[:, None]
        counted = np.concatenate([one.counted[k], two.counted[other]], axis=1)[:, None]
        likely = _best_place(np.concatenate([still, moved], axis=2), ranges, counted)
        apart = one.likely[k] + two.likely[other]
        return np.asarray(np.logaddexp(likely, np.log(PathPolicy.fault) + apart.T[:, :, None]))

    def refined(self, motions: Floats, size: float, sign: float = 1.0, names: Ints | None = None) -> float:
        """Return the log likelihood of the best motion about the best of some (m, 3), within a size, m, coarse to fine."""
        best, most = motions[np.argmax(self.likely(motions, sign, names))], -np.inf
        around = np.stack(np.meshgrid(*3 * [np.array([-0.5, 0.0, 0.5])]), axis=-1).reshape(-1, 3)
        for reach in size * 0.5 ** np.arange(np.log2(size / PathPolicy.usual_motion) + 3.0):
            likely = self.likely(best + around * reach, sign, names)
            best, most = best + around[np.argmax(likely)] * reach, float(likely.max())
        return most

    def exchanged(self, motions: Floats) -> tuple[Ints, float]:
        """Return which anchor each is after the moment (a,) if the path goes on by some motion (m, 3), and its log likelihood.

        They keep their names where others are likelier by less than the prior odds deny.
        """
        each = np.arange(len(self.names))
        k, other = np.indices((len(each), len(each))).reshape(2, -1)
        pairs = self.same(k, other, motions).max(axis=0).reshape(len(each), len(each), len(motions))
        names, best, bound = each, 0, np.minimum(pairs.max(axis=0).sum(axis=0), pairs.max(axis=1).sum(axis=0))
        kept = float(pairs[each, each].sum(axis=0).max())
        least = kept - float(np.log(PathPolicy.fault))
        for m in np.argsort(-bound).tolist():
            if bound[m] > least:
                order = _best_order(pairs[:, :, m])
                if (gain := float(pairs[each, order, m].sum())) > least:
                    least, names, best = gain, order, m
        if np.array_equal(names, each):
            return each, kept
        return names, self.refined(motions[best : best + 1], PathPolicy.usual_motion, names=names)

    def rows(self, to_compare: bool) -> Iterator[Explanation]:
        """Yield what explains a change; nothing where nothing could.

        Where the likelihood with all anchors at any place exceeds that of the path by no very strong evidence nothing needs an
        explanation, and where not by the prior odds of wrong wheels as well, hardly any other path does: none is tried, unless
        it is to be compared.
        """
        one, two, usual_motion = self.before, self.after, PathPolicy.usual_motion
        turns = np.arange(-np.pi, np.pi, PathPolicy.turn)
        motions, usual = turns[:, None] * np.array([0.0, 0.0, 1.0]), np.abs(turns) < usual_motion
        small = motions[usual]
        sound = float((one.likely + two.likely).sum(axis=0).max()) - EvidencePolicy.very_strong
        if float(self.likely(small).max()) > sound or (null := self.refined(small, usual_motion)) > sound:
            return
        ways = one.driven, two.driven
        lost = ways[0] + two.likely, one.likely + ways[1], ways[0] + ways[1]
        wheels = float(np.log(PathPolicy.wheels))
        unknown = max(float(side.sum(axis=0).max()) for side in lost)
        yield Explanation(unknown - null + wheels, _WHEELS, {"what": "turns", "value": 0.0})
        yield from self._names(small, null)
        if to_compare or null <= sound + wheels:
            yield from self._other_paths(motions, usual, null)

    def _other_paths(self, turns: Floats, usual: Bools, null: float) -> Iterator[Explanation]:
        """Yield paths that go on after a turn (m, 3), mirrored or elsewhere; usual (m,) are the turns of the path as it is."""
        usual_motion, small, any_turn = PathPolicy.usual_motion, turns[usual], turns[:: len(turns) // 12]
        large = self.likely(turns[~usual])
        turned = float(np.logaddexp.reduce(large)) - np.log(len(large))
        free = 1.5 * np.log((self.before.counts + self.after.counts).sum())
        for what, gain, value in (
            ("turned", turned, float(np.degrees(turns[~usual, 2][np.argmax(large)]))),
            ("mirrored", self.refined(small, usual_motion, -1.0), 0.0),
            ("elsewhere", self.refined(any_turn, PathPolicy.stretch) - free, 0.0),
            ("mirrored", self.refined(any_turn, PathPolicy.stretch, -1.0) - free, 0.0),
        ):
            prior = float(np.log(PathPolicy.fault if what == "mirrored" else PathPolicy.wheels))
            yield Explanation(gain - null + prior, _WHEELS, {"what": what, "value": value})

    def _names(self, small: Floats, null: float) -> Iterator[Explanation]:
        """Yield names that are exchanged, by motions (m, 3) of the path as it is, and ranges that are no distances."""
        one, two, count = self.before, self.after, len(self.names)
        to, gain = self.exchanged(small)
        names = {self.names[k]: name for k, name in zip(to, self.names, strict=True)}
        changed = [name for k, name in zip(to, self.names, strict=True) if self.names[k] != name]
        prior, kind = float(np.log(PathPolicy.fault)) - null, "exchanged-names"
        if changed:
            # The number of cycles of so many of the anchors.
            gain -= math.lgamma(count + 1.0) - math.lgamma(count - len(changed) + 1.0) - math.log(len(changed))
            yield Explanation(gain + prior, kind, {"exchanged": True, "anchors": changed}, names=names)
        unordered = (one.nothing + two.likely.T, one.likely.T + two.nothing)
        nowhere = max(float(side.sum(axis=1).max()) for side in unordered)
        yield Explanation(nowhere + prior, kind, {"exchanged": False, "anchors": changed})


_WHEELS = "wheels-against-ranges"
"""What is told of a path that goes on elsewhere."""


def _best_order(pairs: Floats) -> Ints:
    """Return the order (a,) with the largest sum of values (a, a), one of each row and column."""
    best = pairs.argmax(axis=1)
    if len(np.unique(best)) == len(best):
        return best
    from scipy.optimize import linear_sum_assignment  # a twentieth of a second, which few recordings need

    return np.asarray(linear_sum_assignment(-pairs)[1], dtype=np.intp)


def _best_place(paths: Floats, ranges: Floats, counted: Floats) -> Floats:
    """Return log likelihoods (g, ...) of ranges (..., n) along paths (..., n, 2) to one place each, for g scales of errors.

    Counted (..., n) are 1 for a reading, and 0 where there is none. Squares of ranges are linear in the place and the square of
    its distance from the middle of the path.
    """
    many = counted.sum(axis=-1)
    middle = (counted[..., None, :] @ paths)[..., 0, :] / many[..., None]
    x, y = (-2.0 * (paths[..., k] - middle[..., k, None]) for k in (0, 1))
    squares, twice = ranges**2 - 0.25 * (x**2 + y**2), 2.0 * ranges
    rows = np.stack([x, y, np.broadcast_to(1.0, x.shape), squares], axis=-2)
    unknown, sure = rows[..., :-1, :], counted / twice**2
    weights = np.broadcast_to(sure, squares.shape)
    for _ in range(PathPolicy.rounds):
        normal = (unknown * weights[..., None, :]) @ np.swapaxes(rows, -1, -2)
        found = np.linalg.solve(normal[..., :-1] + PathPolicy.ridge * np.eye(normal.shape[-2]), normal[..., -1:])
        errors = ((np.swapaxes(found, -1, -2) @ unknown)[..., 0, :] - squares) / twice
        weights = sure / (1.0 + (errors / PathPolicy.noise[1]) ** 2)
    scales = PathPolicy.noise.reshape(-1, *(1,) * (errors.ndim - 1))
    off = np.einsum("...n,...n", np.log(1.0 + (errors / scales[..., None]) ** 2), counted)
    return np.asarray(-off - many * np.log(np.pi * scales) - 1.5 * np.log(many))


def _by_way(trace: Trace, longest: float) -> Floats:
    """Return log likelihoods (g,) of the ranges of a trace if the robot drove its way, or twice that, in any direction."""
    # A way shorter than the errors of ranges is lost in them.
    change, way = np.diff(trace.ranges), np.maximum(np.diff(trace.way), PathPolicy.noise[0])
    scales = 2.0 * PathPolicy.noise[:, None]

    def within(most: Floats) -> Floats:
        spread = np.arctan((change + most) / scales) - np.arctan((change - most) / scales)
        return np.asarray(np.sum(np.log(spread / (2.0 * np.pi * most)), axis=1))

    return np.asarray(np.logaddexp(within(way), within(2.0 * way)) - np.log(2.0) - np.log(longest))
