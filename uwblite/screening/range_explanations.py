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
from ..arrays import CHUNK, Bools, Floats, Ints, Table, chunks
from ..findings import Fact
from ..problem.alternatives import EvidencePolicy
from ..sensor_log import SHORTEST_RANGE, SensorLog, plausible
from . import wheel_motion
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
            log, moments, delays = in_time, left, [*delays, Fact.of(late.kind, **late.figures)]
    return log, [*delays, *_facts(_without_consequences(log, moments), log)]


def _most(rows: Sequence[Explanation]) -> float:
    return max((row.log_odds for row in rows), default=-np.inf)


def _without_consequences(log: SensorLog, rows: list[Explanation]) -> list[Explanation]:
    """Return the rows without those that an exchange of names explains: with the names exchanged back they are no more.

    An exchange contradicts the path, too, at moments somewhat before it and after it, where it is on one side: what holds there
    of two explanations of the same readings shows in what either leaves.
    """
    # Wheels that turn a robot among anchors that stand around it look like an exchange of names; a lidar tells the two apart.
    if any(row.names for row in _likeliest(rows)) and (pairs := wheel_motion.compare(log)) is not None:
        rows = [row for row in rows if not (row.names and pairs.wheels_fail(*_times(log, row)))]
    for row in sorted((row for row in _likeliest(rows) if row.names), key=lambda row: -row.log_odds):
        ranges, near = log.ranges, [other for other in rows if other.meets(row)]
        assert ranges is not None
        others = np.array([ranges.anchor_ids.index(row.names.get(name, name)) for name in ranges.anchor_ids], dtype=np.intp)
        after = ranges.stamps > np.mean(_times(log, row))
        undone = replace(log, ranges=replace(ranges, anchor=np.where(after, others[ranges.anchor], ranges.anchor)))
        left = _at_moments(undone, _traces(undone), row, to_compare=True)
        gains = row in rows and _most(left) < min(_most(near) - EvidencePolicy.very_strong, row.log_odds)
        # Wheels that slip several times look like one exchange, which leaves the other slips.
        if gains and all(other.names for other in _likeliest(left)):
            rows, log = [row, *left, *(other for other in rows if other not in near)], undone
    return rows


def _times(log: SensorLog, row: Explanation) -> list[float]:
    """Return the first and the last time of the stretch of a row, s."""
    return np.interp([row.begin, row.end], log.odometry.travelled, log.odometry.stamps).tolist()


def _likeliest(rows: Sequence[Explanation]) -> list[Explanation]:
    """Return the likeliest row of each moment, where there is very strong evidence for it."""
    best = dict[float, Explanation]()
    for row in rows:
        best[row.begin] = max(best.get(row.begin, row), row, key=lambda row: row.log_odds)
    return [row for row in best.values() if row.log_odds > EvidencePolicy.very_strong]


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
    likely, every = np.zeros((len(names), len(PathPolicy.noise), len(offsets))), Stretches.of(traces, *_along(log))
    for stretches in every.chunks(len(offsets)):
        ranges = units[:, None] * stretches.ranges[:, None] - offsets[:, None]
        counted = np.broadcast_to(stretches.counted[:, None], ranges.shape)
        of_place = _best_place(np.broadcast_to(stretches.places[:, None], (*ranges.shape, 2)), ranges, counted)
        of_place += stretches.counts[:, None] * np.log(units)
        distances = np.einsum("...n,...n", ranges > 0.0, counted) > 0.5 * stretches.counts[:, None]
        anchor = np.array([names.index(traces[k].anchor) for k in stretches.trace.tolist()])
        np.add.at(likely, anchor, np.where(distances, of_place, -np.inf).swapaxes(0, 1))
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
    longest, start = max(float(trace.ranges.max(initial=1.0)) for trace in traces), log.odometry.stamps[0]
    every, count = Stretches.of(traces, *_along(log)), len(factors)
    if not len(every.trace):
        return Explanation(-np.inf, "late-ranges", {})
    every = replace(every, number=np.unique(every.number, return_inverse=True)[1])
    each, counts = _on_stretches(log, every, offsets, longest), np.bincount(every.number, every.counts)
    middles = np.bincount(every.number, (every.stamps * every.counted).sum(axis=1)) / counts
    first, last = (offset.ravel() for offset in np.meshgrid(offsets, offsets))
    late = np.zeros((len(each), len(first)))
    for k, share in enumerate(((middles - start) / np.ptp(log.odometry.stamps)).tolist()):
        late += each[:, k, count + np.rint(PathPolicy.most_late + first + (last - first) * share).astype(np.intp)]
    nothing = -counts.sum() * float(np.log(longest))
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


def _along(log: SensorLog) -> tuple[Floats, Floats]:
    """Return where the stretches that divide the way begin (s,) and end (s,), m."""
    length = PathPolicy.stretch
    edges = np.append(np.arange(0.0, max(log.odometry.travelled[-1] - length, 0.1), length), np.inf)
    return edges[:-1] - 1e-9, edges[1:]


@dataclass(frozen=True, slots=True, eq=False)
class Stretches(Table):
    """Readings of single anchors on stretches of the way, filled up to the most that one of them has."""

    trace: Ints
    """(p,) which trace they are of."""
    number: Ints
    """(p,) of the stretch."""
    stamps: Floats
    """(p, n) s."""
    ranges: Floats
    """(p, n) m."""
    way: Floats
    """(p, n) travelled by the wheels, m."""
    places: Floats
    """(p, n, 2) of the base, m."""
    counted: Floats
    """(p, n) 1 for a reading, 0 for what fills up."""
    likely: Floats
    """(p, g) log likelihoods of the readings to one place each."""

    @staticmethod
    def of(traces: Sequence[Trace], begins: Floats, ends: Floats) -> "Stretches":
        """Fit a place to the readings of each trace on stretches (s,) to (s,), m, ends included, where there are enough."""
        edges = np.stack([np.searchsorted(trace.way, [begins, ends], "right") for trace in traces], axis=1)
        counts = edges[1] - edges[0]
        trace, number = np.nonzero(counts >= PathPolicy.fewest)
        many, starts = counts[trace, number][:, None], np.cumsum([0] + [len(trace.way) for trace in traces])
        place = np.arange(many.max(initial=1))
        counted = (place < many).astype(np.float64)
        rows = (starts[trace] + edges[0, trace, number])[:, None] + np.minimum(place, many - 1)
        stamps, ranges, way, places = (
            np.concatenate([getattr(trace, name) for trace in traces])[rows] for name in ("stamps", "ranges", "way", "places")
        )
        return Stretches(trace, number, stamps, ranges, way, places, counted, _best_place(places, ranges, counted).T)

    def chunks(self, paths: int) -> Iterator["Stretches"]:
        """Yield as many rows at a time as can be compared with so many paths in a processor's cache."""
        return (self.rows(part) for part in chunks(len(self.trace), max(CHUNK // (paths * self.ranges.shape[1]), 1)))

    def seen(self, origin: Floats) -> "Stretches":
        """Return the readings with places moved by a motion (3,)."""
        return replace(self, places=se2.transform(origin, self.places))

    @property
    def counts(self) -> Floats:
        """(p,) readings."""
        return np.asarray(self.counted.sum(axis=1))

    def driven(self, longest: float) -> Floats:
        """Return log likelihoods (p, g) of the readings, of all the longest in m, if the robot drove its way or twice that."""
        # A way shorter than the errors of ranges is lost in them.
        change, way = np.diff(self.ranges)[:, None], np.maximum(np.diff(self.way), PathPolicy.noise[0])[:, None]
        scales, counted = 2.0 * PathPolicy.noise[:, None], self.counted[:, None, 1:]

        def within(most: Floats) -> Floats:
            spread = np.arctan((change + most) / scales) - np.arctan((change - most) / scales)
            return np.asarray(np.sum(np.log(spread / (2.0 * np.pi * most)) * counted, axis=2))

        return np.asarray(np.logaddexp(within(way), within(2.0 * way)) - np.log(2.0) - np.log(longest))


def _on_stretches(log: SensorLog, every: Stretches, offsets: Floats, longest: float) -> Floats:
    """Return log likelihoods (g, s, h) of s stretches, for g scales of errors, if the way by the wheels has a factor, or the
    radio's clock one of some offsets, s; longest: of all ranges, m.

    Whatever the clock, on a stretch where the wheels slip only the way is known, or its path is any of these.
    """
    odometry, factors = log.odometry, PathPolicy.factors[:, None, None]
    likely = np.zeros((int(every.number.max()) + 1, len(PathPolicy.noise), len(factors) + len(offsets)))
    lost = np.zeros((*likely.shape[:2], 1))
    for some in every.chunks(likely.shape[2]):
        shifted = some.stamps[:, None] + offsets[:, None]
        places = np.stack([np.interp(shifted, odometry.stamps, odometry.poses[:, k]) for k in (0, 1)], axis=-1)
        paths = np.concatenate([factors * some.places[:, None], places], axis=1)
        np.add.at(likely, some.number, _best_place(paths, some.ranges[:, None], some.counted[:, None]).swapaxes(0, 1))
        np.add.at(lost, some.number, some.driven(longest)[..., None])
    of_any = np.logaddexp.reduce(likely, axis=2, keepdims=True) - np.log(likely.shape[2])
    return np.asarray(np.logaddexp(likely, np.log(PathPolicy.wheels) + np.logaddexp(lost, of_any)).swapaxes(0, 1))


def _at_moments(
    log: SensorLog, traces: Sequence[Trace], near: Explanation | None = None, *, to_compare: bool
) -> list[Explanation]:
    """Return names that are exchanged, and paths that go on elsewhere, from a moment on.

    About each moment the readings of a stretch before and after it are compared, in the frame of the robot at that moment;
    where another explanation is given, at moments whose stretches meet its own. To compare recordings, other paths count which
    are hardly likely enough to be told. At most moments the path by the wheels leaves nothing to be explained.
    """
    odometry, half, rows = log.odometry, PathPolicy.stretch, list[Explanation]()
    way = odometry.travelled
    moments = np.arange(half, float(way[-1]) - half, 0.25 * half)
    if near is not None:
        moments = moments[(moments + half > near.begin) & (near.end > moments - half)]
    longest = max(float(trace.ranges.max(initial=0.0)) for trace in traces)
    sides = [Stretches.of(traces, begins, begins + half) for begins in (moments - half, moments)]
    one, other = (side.trace * len(moments) + side.number for side in sides)
    before, after = sides[0].rows(np.isin(one, other)), sides[1].rows(np.isin(other, one))
    each, likely = np.arange(len(before.trace)), np.zeros((len(moments), 2, len(PathPolicy.noise)))
    as_driven = Moment(before, after, [], longest).same(each, each, np.zeros((1, *se2.POSE)))[..., 0].T
    np.add.at(likely, before.number, np.stack([as_driven, before.likely + after.likely], axis=1))
    path, any_place = likely.max(axis=2).T
    for k in np.flatnonzero(path < any_place - EvidencePolicy.very_strong).tolist():
        own, at = np.flatnonzero(before.number == k), float(moments[k])
        origin = se2.inverse(odometry.at(np.array([np.interp(at, way, odometry.stamps)]))[0])
        names = [traces[k].anchor for k in before.trace[own].tolist()]
        about = Moment(before.rows(own).seen(origin), after.rows(own).seen(origin), names, longest)
        rows += [replace(row, begin=at - half, end=at + half) for row in about.rows(to_compare)]
    return rows


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """Readings of anchors before and after a moment."""

    before: Stretches
    after: Stretches
    """(a,) of each anchor one."""
    names: list[str]
    """(a,) of the anchors."""
    longest: float
    """Of all ranges, m."""

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

    def refined(
        self, motions: Floats, size: float, sign: float = 1.0, names: Ints | None = None, enough: float = np.inf
    ) -> float:
        """Return the log likelihood of the best motion about the best of some (m, 3), within a size, m, coarse to fine; of one
        that is likely enough where there is."""
        likely = self.likely(motions, sign, names)
        best, most = motions[np.argmax(likely)], float(likely.max())
        around = np.stack(np.meshgrid(*3 * [np.array([-0.5, 0.0, 0.5])]), axis=-1).reshape(-1, 3)
        for reach in size * 0.5 ** np.arange(np.log2(size / PathPolicy.usual_motion) + 3.0):
            if most > enough:
                break
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
        null = self.refined(small, usual_motion, enough=sound)
        if null > sound:
            return
        ways = one.driven(self.longest), two.driven(self.longest)
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
        changed = list(dict.fromkeys(name for k, name in zip(to, self.names, strict=True) if self.names[k] != name))
        prior, kind = float(np.log(PathPolicy.fault)) - null, "exchanged-names"
        if changed:
            # The number of cycles of so many of the anchors.
            gain -= math.lgamma(count + 1.0) - math.lgamma(count - len(changed) + 1.0) - math.log(len(changed))
            yield Explanation(gain + prior, kind, {"exchanged": True, "anchors": changed}, names=names)
        number = -float(np.log(self.longest))
        nowhere = max(float(a.likely.sum(axis=0).max() + number * b.counts.sum()) for a, b in ((one, two), (two, one)))
        yield Explanation(nowhere + prior, kind, {"exchanged": False, "anchors": changed})


_WHEELS = "wheels-against-ranges"
"""What is told of a path that goes on elsewhere."""


def _best_order(pairs: Floats) -> Ints:
    """Return the order (a,) with the largest sum of values (a, a), one of each row and column.

    Rows are placed one after another, each at the end of the shortest path of replacements (R. Jonker, A. Volgenant, A shortest
    augmenting path algorithm for dense and sparse linear assignment problems, 1987); scipy.optimize takes longer to load.
    """
    column_of, row_of = np.full(len(pairs), -1), np.full(len(pairs), -1)
    worth, price = pairs.max(axis=1), np.zeros(len(pairs))
    for row in range(len(pairs)):
        loss, before = worth[row] + price - pairs[row], np.full(len(pairs), row)
        passed, holder = np.zeros(len(pairs), dtype=bool), row
        while holder >= 0:
            column = int(np.where(passed, np.inf, loss).argmin())
            passed[column], holder = True, int(row_of[column])
            if holder >= 0:
                through = loss[column] + worth[holder] + price - pairs[holder]
                shorter = ~passed & (through < loss)
                loss[shorter], before[shorter] = through[shorter], holder
        # At these prices no row on the path loses by its replacement.
        held = passed & (row_of >= 0)
        price[held] += loss[column] - loss[held]
        worth[np.append(row_of[held], row)] -= loss[column] - np.append(loss[held], 0.0)
        while holder != row:
            holder = int(before[column])
            row_of[column], column_of[holder], column = holder, column, int(column_of[holder])
    return column_of


def _best_place(paths: Floats, ranges: Floats, counted: Floats) -> Floats:
    """Return log likelihoods (g, ...) of ranges (..., n) along paths (..., n, 2) to one place each, for g scales of errors.

    Counted (..., n) are 1 for a reading, and 0 where there is none. As many rows at a time as fit in a processor's cache.
    """
    most = max(CHUNK // max(int(np.prod(paths.shape[1:-1])), 1), 1)
    parts = [_best_place_of_few(paths[some], ranges[some], counted[some]) for some in chunks(max(len(paths), 1), most)]
    return np.concatenate(parts, axis=1)


def _best_place_of_few(paths: Floats, ranges: Floats, counted: Floats) -> Floats:
    """Return the same; squares of ranges are linear in the place and the square of its distance from the middle of the path."""
    many = counted.sum(axis=-1)
    middle = (counted[..., None, :] @ paths)[..., 0, :] / many[..., None]
    x, y = (-2.0 * (paths[..., k] - middle[..., k, None]) for k in (0, 1))
    measured, from_middle = np.maximum(np.abs(ranges), SHORTEST_RANGE), 0.25 * (x**2 + y**2)
    squares = ranges**2 - from_middle
    rows = np.stack([x, y, np.broadcast_to(1.0, x.shape), squares], axis=-2)
    unknown = rows[..., :-1, :]
    # Of squares of two distances the difference is that of the distances times their sum; one of the two is yet unknown.
    both = measured + np.einsum("...n,...n", measured, counted)[..., None] / many[..., None]
    weights = np.broadcast_to(counted / both**2, squares.shape)
    for _ in range(PathPolicy.rounds):
        normal = (unknown * weights[..., None, :]) @ np.swapaxes(rows, -1, -2)
        found = np.linalg.solve(normal[..., :-1] + PathPolicy.ridge * np.eye(normal.shape[-2]), normal[..., -1:])
        of_place = (np.swapaxes(found, -1, -2) @ unknown)[..., 0, :]
        both = measured + np.sqrt(np.maximum(of_place + from_middle, 0.0))
        errors = (of_place - squares) / both
        weights = counted / (both**2 * (1.0 + (errors / PathPolicy.noise[1]) ** 2))
    scales = PathPolicy.noise.reshape(-1, *(1,) * (errors.ndim - 1))
    off = np.einsum("...n,...n", np.log(1.0 + (errors / scales[..., None]) ** 2), counted)
    return np.asarray(-off - many * np.log(np.pi * scales) - 1.5 * np.log(many))
