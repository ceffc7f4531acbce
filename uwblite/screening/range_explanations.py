"""What explains ranges that do not fit the path by the wheels: the wheels, the radio's clock, or the anchors' names.

The ranges to an anchor are distances from the path to one place. Each row of the table changes what they are taken to: the
times of the ranges, the names of the anchors, the path after a moment or over a stretch of the way. Each has prior odds, and
all are compared by one likelihood with the recording as it stands and with one another: what fits best is the cause, and a row
that explains the same readings less well is none.

Of the readings of an anchor along a stretch of the way the likelihood is that of the best place (places and their common error
cost by Schwarz, 1978), with Cauchy errors; that of a drive of which only the way is known, where the path is wrong; or that of
any numbers, where they are no distances. An anchor may be moved by itself at any moment.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.special import gammaln

from .. import se2
from ..arrays import Floats, Ints
from ..findings import Fact
from ..problem.alternatives import EvidencePolicy
from ..sensor_log import SensorLog, plausible


@dataclass(frozen=True, slots=True)
class RangePolicy:
    """Priors of the explanations, and what is compared."""

    late: float = 1e-3
    """Probability of a radio whose clock is off by seconds."""
    exchanged: float = 1e-3
    """Of anchors whose names are exchanged at a given moment."""
    wheels: float = 1e-2
    """Of wheels that are wrong from a given moment on, or over a given stretch."""
    moved: float = 1e-3
    """Of one anchor that is moved at a given moment."""
    most_late: float = 20.0
    """Largest offset of the clock, s; all up to it are equally probable."""
    usual_delay: float = 1.0
    """Offset that is no fault but calibrated with the map, s; and between the offsets that are compared."""
    noise: tuple[float, ...] = (0.1, 0.2, 0.4)
    """Scales of the errors of ranges, m, that of a path by wheels over a stretch included; each row has its best."""
    apart: float = 0.5
    """Way between two readings of an anchor that count, m: the errors of ranges last for so long."""
    stretch: float = 8.0
    """Way for which wheels alone give the shape of the path, m."""
    fewest: int = 6
    """Readings of an anchor in a stretch: three give its place and its error."""
    factors: Floats = field(default_factory=lambda: np.geomspace(0.5, 2.0, 15))
    """Ways of the robot / ways by the wheels that are compared."""
    usual_motion: float = 0.3
    """Motion that sound wheels miss over twice such a way, m and rad: the map takes it up."""
    turn: float = 0.05
    """Between the turns that are compared, rad."""
    rounds: int = 5
    """Of reweighting of the readings of a place."""
    usual_error: float = 0.2
    """Scale of errors by which readings are weighted there, m."""
    ridge: float = 1e-6
    """Added to normal equations: a robot that stands shows a distance only."""


_SAME = np.zeros(3)
"""The motion that changes nothing."""


@dataclass(frozen=True, slots=True)
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

    def between(self, begin: float, end: float, frame: Floats = _SAME) -> "Trace":
        """Return the readings on a stretch of the way, m, its end included, with places moved by a motion (3,)."""
        own = (self.way > begin) & (self.way <= end)
        places = se2.transform(frame, self.places[own])
        return Trace(self.anchor, self.stamps[own], self.ranges[own], self.way[own], places)


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


def explained_by_ranges(log: SensorLog, policy: RangePolicy = RangePolicy()) -> tuple[SensorLog, list[Fact]]:
    """Return the recording with the radio's clock set right, where that explains its ranges best, and what explains them."""
    traces = _traces(log, policy)
    if not traces:
        return log, []
    (late, ways), moments = _over_stretches(log, traces, policy), _at_moments(log, traces, policy)
    if late.log_odds > EvidencePolicy.very_strong and log.ranges is not None:
        in_time = replace(log, ranges=replace(log.ranges, stamps=log.ranges.stamps - late.figures["late"]))
        left = _at_moments(in_time, _traces(in_time, policy), policy)
        # A clock that is off contradicts the path at many moments; set right, at fewer.
        if _most(left) <= _most(moments):
            return in_time, [Fact.of(late.kind, **late.figures), *_facts(_with_names_undone(in_time, left, policy), in_time)]
    return log, _facts([ways, *_with_names_undone(log, moments, policy)], log)


def _with_names_undone(log: SensorLog, rows: list[Explanation], policy: RangePolicy) -> list[Explanation]:
    """Return the rows without those that the exchange of names explains: with the names exchanged back they are no more.

    An exchange contradicts the path, too, at moments somewhat before it and after it, where it is on one side: what holds there
    of two explanations of the same readings shows in what either leaves.
    """
    exchanges = [row for row in rows if row.names and row.log_odds > EvidencePolicy.very_strong]
    for row in sorted(exchanges, key=lambda row: -row.log_odds):
        near = [other for other in rows if other.begin < row.end and row.begin < other.end]
        undone = _with_names(log, 0.5 * (row.begin + row.end), row.names)
        left = _at_moments(undone, _traces(undone, policy), policy, row)
        if row in rows and _most(left) < min(_most(near) - EvidencePolicy.very_strong, row.log_odds):
            rows = [row, *left, *(other for other in rows if other not in near)]
            log = undone
    return rows


def _with_names(log: SensorLog, way: float, names: dict[str, str]) -> SensorLog:
    """Return the recording with anchors of other names from a moment on, given by the way, m."""
    ranges = log.ranges
    assert ranges is not None
    at = np.interp(way, log.odometry.travelled, log.odometry.stamps)
    others = np.array([ranges.anchor_ids.index(names.get(name, name)) for name in ranges.anchor_ids], dtype=np.intp)
    return replace(log, ranges=replace(ranges, anchor=np.where(ranges.stamps > at, others[ranges.anchor], ranges.anchor)))


def _most(rows: Sequence[Explanation]) -> float:
    """Return the log odds of the likeliest row."""
    return max((row.log_odds for row in rows), default=-np.inf)


def _facts(rows: Sequence[Explanation], log: SensorLog) -> list[Fact]:
    """Return the rows for which there is very strong evidence, of those on one stretch the likeliest."""
    stamps, way, taken = log.odometry.stamps, log.odometry.travelled, list[Explanation]()
    for row in sorted(rows, key=lambda row: -row.log_odds):
        apart = all(row.end < other.begin or row.begin > other.end for other in taken)
        if row.log_odds > EvidencePolicy.very_strong and apart:
            taken.append(row)
    facts = []
    for row in taken:
        points = np.array([row.begin, 0.5 * (row.begin + row.end), row.end])
        begin, at, end = (stamps[np.searchsorted(way, points, "right").clip(1) - 1] - stamps[0]).tolist()
        facts.append(Fact.of(row.kind, begin=begin, at=at, end=end, **row.figures))
    return facts


def _traces(log: SensorLog, policy: RangePolicy) -> list[Trace]:
    """Return the traces of all anchors while there is odometry."""
    ranges, odometry, found = log.ranges, log.odometry, []
    if ranges is None or len(odometry.stamps) < 2:
        return []
    usable = plausible(ranges.ranges) & (ranges.stamps >= odometry.stamps[0]) & (ranges.stamps <= odometry.stamps[-1])
    for anchor, own in ranges.by_pair(usable):
        way = odometry.travelled_at(ranges.stamps[own])
        first = np.unique(np.floor(way / policy.apart), return_index=True)[1]
        rows = own[first]
        places = odometry.at(ranges.stamps[rows])[:, :2]
        found.append(Trace(ranges.anchor_ids[anchor], ranges.stamps[rows], ranges.ranges[rows], way[first], places))
    return found


def _over_stretches(log: SensorLog, traces: Sequence[Trace], policy: RangePolicy) -> tuple[Explanation, Explanation]:
    """Return a radio's clock that is off throughout, and wheels with another scale over a stretch."""
    offsets = np.arange(-policy.most_late, policy.most_late + 0.5 * policy.usual_delay, policy.usual_delay)
    count = len(policy.factors)
    edges = np.append(np.arange(0.0, max(log.odometry.travelled[-1] - policy.stretch, 0.1), policy.stretch), np.inf)
    sound = np.zeros((len(policy.noise), count + len(offsets), len(edges) - 1))
    each = np.zeros((len(policy.noise), 0, len(offsets)))
    for number, (begin, end) in enumerate(zip(edges[:-1] - 1e-9, edges[1:], strict=True)):
        for trace in (trace.between(begin, end) for trace in traces):
            if len(trace.ranges) < policy.fewest:
                continue
            shifted = log.odometry.at((trace.stamps + offsets[:, None]).ravel())[:, :2].reshape(len(offsets), -1, 2)
            paths = np.concatenate([policy.factors[:, None, None] * trace.places, shifted])
            one = _best_place(paths, trace.ranges, np.ones(len(trace.ranges)), policy)
            sound[:, :, number] += one
            each = np.concatenate([each, one[:, None, count:]], axis=1)
    scaled, late = sound[:, :count], sound[:, count:].sum(axis=2)
    usual, far = scaled.sum(axis=2), np.abs(offsets) > 1.5 * policy.usual_delay
    null = float(max(usual.max(), late[:, ~far].max()))
    # Turns that are wrong throughout look like an offset in each stretch, each another one.
    apart = float((each.max(axis=2) - np.log(len(offsets))).sum(axis=1).max(initial=-np.inf))
    late = late[np.argmax(late.max(axis=1)), far]
    odds = float(np.logaddexp.reduce(late)) - np.log(len(late)) + np.log(policy.late)
    by = float(np.average(offsets[far], weights=np.exp(late - late.max())))
    clock = Explanation(odds - max(null, apart), "late-ranges", {"late": -by})
    found = [(-np.inf, 0, 0, 0, 0)]
    for now, other in np.ndindex(count, count):
        gains = [_best_stretch(one[other] - one[now]) for one in scaled]
        found += [(usual[g, now] + gain, now, other, a, b) for g, (gain, a, b) in enumerate(gains)]
    odds, now, other, a, b = max(found)
    factor = float(policy.factors[now] / policy.factors[other])
    costs = np.log(policy.wheels) - np.log(count * (len(edges) - 1))
    end = min(float(edges[b]), float(log.odometry.travelled[-1]))
    other_ways = {"what": "ways", "value": factor}
    return clock, Explanation(odds - null + float(costs), "wheels-against-ranges", other_ways, float(edges[a]), end)


def _at_moments(
    log: SensorLog, traces: Sequence[Trace], policy: RangePolicy, near: Explanation | None = None
) -> list[Explanation]:
    """Return names that are exchanged, and paths that go on elsewhere, from a moment on.

    About each moment the readings of a stretch before and after it are compared, in the frame of the robot at that moment.

    Parameters
    ----------
    near : only moments whose stretches overlap with those of this one.
    """
    odometry, half, every = log.odometry, policy.stretch, 0.25 * policy.stretch
    way = odometry.travelled
    longest, found = max(float(trace.ranges.max(initial=0.0)) for trace in traces), list[Explanation]()
    for at in np.arange(half, float(way[-1]) - half, every).tolist():
        if near is not None and (at + half <= near.begin or near.end <= at - half):
            continue
        origin = se2.inverse(odometry.at(np.array([np.interp(at, way, odometry.stamps)]))[0])
        sides = [(trace.between(at - half, at, origin), trace.between(at, at + half, origin)) for trace in traces]
        sides = [side for side in sides if min(len(trace.ranges) for trace in side) >= policy.fewest]
        moment = Moment.of(sides, longest, policy)
        if moment is not None:
            found += [replace(row, begin=at - half, end=at + half) for row in moment.rows()]
    return found


@dataclass(frozen=True, slots=True, eq=False)
class Side:
    """Readings of several anchors on one stretch, filled up to the most that one of them has."""

    places: Floats
    """(a, n, 2) of the base, m."""
    ranges: Floats
    """(a, n) m."""
    counted: Floats
    """(a, n) 1 for a reading, 0 for what fills up."""

    @staticmethod
    def of(traces: Sequence[Trace]) -> "Side":
        """Fill up the readings of each anchor."""
        shape = len(traces), max(len(trace.ranges) for trace in traces)
        places, ranges, counted = np.zeros((*shape, 2)), np.ones(shape), np.zeros(shape)
        for k, trace in enumerate(traces):
            many = len(trace.ranges)
            places[k, :many], ranges[k, :many], counted[k, :many] = trace.places, trace.ranges, 1.0
        return Side(places, ranges, counted)


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """Readings of anchors before and after a moment."""

    before: Side
    after: Side
    names: list[str]
    """(a,) of the anchors."""
    sides: Floats
    """(2, a, g) log likelihoods of the readings to one place before, and to one after."""
    driven: Floats
    """(2, a, g) the same where only the way is known."""
    nothing: Floats
    """(2, a) the same where ranges are no distances."""
    policy: RangePolicy

    @staticmethod
    def of(sides: Sequence[tuple[Trace, Trace]], longest: float, policy: RangePolicy) -> "Moment | None":
        """Fit the places on both sides; None without anchors."""
        if not sides:
            return None
        before, after = (Side.of([pair[k] for pair in sides]) for k in (0, 1))
        likely = [_best_place(side.places, side.ranges, side.counted, policy).T for side in (before, after)]
        driven = np.array([[_by_way(pair[k], longest, policy) for pair in sides] for k in (0, 1)])
        nothing = np.array([[_no_distances(pair[k], longest) for pair in sides] for k in (0, 1)])
        return Moment(before, after, [one.anchor for one, _ in sides], np.array(likely), driven, nothing, policy)

    @property
    def alone(self) -> Floats:
        """(a, g) log likelihoods of the readings to two places each."""
        return np.asarray(self.sides.sum(axis=0))

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
        likely = _best_place(np.concatenate([still, moved], axis=2), ranges, counted, self.policy)
        apart = self.sides[0, k] + self.sides[1, other]
        return np.asarray(np.logaddexp(likely, np.log(self.policy.moved) + apart.T[:, :, None]))

    def refined(self, motions: Floats, size: float, sign: float = 1.0, names: Ints | None = None) -> tuple[Floats, float]:
        """Return the best motion (3,) about the best of some (m, 3), within a size, m, coarse to fine; its log likelihood."""
        best = motions[np.argmax(self.likely(motions, sign, names))]
        around = np.stack(np.meshgrid(*3 * [np.array([-0.5, 0.0, 0.5])]), axis=-1).reshape(-1, 3)
        for reach in size * 0.5 ** np.arange(np.log2(size / self.policy.usual_motion) + 3.0):
            tried = best + around * reach
            likely = self.likely(tried, sign, names)
            best = tried[np.argmax(likely)]
        return best, float(likely.max())

    def exchanged(self, motions: Floats) -> tuple[Ints, float]:
        """Return which anchor each is after the moment (a,) if the path goes on by some motion (m, 3); its log likelihood."""
        each = np.arange(len(self.names))
        k, other = np.indices((len(each), len(each))).reshape(2, -1)
        pairs = self.same(k, other, motions).max(axis=0).reshape(len(each), len(each), len(motions))
        orders = [linear_sum_assignment(-pairs[:, :, m])[1] for m in range(len(motions))]
        best = int(np.argmax([pairs[each, order, m].sum() for m, order in enumerate(orders)]))
        return orders[best], self.refined(motions[best : best + 1], self.policy.usual_motion, names=orders[best])[1]

    def rows(self) -> Iterator[Explanation]:
        """Yield what explains a change; nothing where nothing could: with all anchors at any place the path is no likelier."""
        policy, count, turn = self.policy, len(self.names), np.array([0.0, 0.0, 1.0])
        turns = np.arange(-np.pi, np.pi, policy.turn)
        usual = np.abs(turns) < policy.usual_motion
        small, any_turn = turns[usual, None] * turn, turns[:: len(turns) // 12, None] * turn
        sound = float(self.alone.sum(axis=0).max()) - EvidencePolicy.very_strong
        if float(self.likely(small).max()) > sound:
            return
        null = self.refined(small, policy.usual_motion)[1]
        if null > sound:
            return
        large = self.likely(turns[~usual, None] * turn)
        turned = float(np.logaddexp.reduce(large)) - np.log(len(large))
        rows = [("turned", turned, float(np.degrees(turns[~usual][np.argmax(large)])))]
        unknown = (self.driven[:1] + self.sides[1:], self.sides[:1] + self.driven[1:], self.driven.sum(axis=0)[None])
        rows += [("turns", float(np.concatenate(unknown).sum(axis=1).max()), 0.0)]
        rows += [("mirrored", self.refined(small, policy.usual_motion, -1.0)[1], 0.0)]
        free = 1.5 * np.log(self.before.counted.sum() + self.after.counted.sum())
        rows += [("elsewhere", self.refined(any_turn, policy.stretch)[1] - free, 0.0)]
        rows += [("mirrored", self.refined(any_turn, policy.stretch, -1.0)[1] - free, 0.0)]
        for what, gain, value in rows:
            prior = policy.exchanged if what == "mirrored" else policy.wheels
            figures = {"what": what, "value": value}
            yield Explanation(gain - null + float(np.log(prior)), "wheels-against-ranges", figures)
        to, gain = self.exchanged(small)
        changed = [name for k, name in zip(to, self.names, strict=True) if self.names[k] != name]
        # The number of cycles of so many of the anchors.
        gain -= gammaln(count + 1.0) - gammaln(count - len(changed) + 1.0) - np.log(max(len(changed), 1))
        unordered = (self.nothing[:1, :, None] + self.sides[1:], self.sides[:1] + self.nothing[1:, :, None])
        nowhere = float(np.concatenate(unordered).sum(axis=1).max())
        prior, kind = float(np.log(policy.exchanged)) - null, "exchanged-names"
        if changed:
            names = {self.names[k]: name for k, name in zip(to, self.names, strict=True)}
            yield Explanation(gain + prior, kind, {"what": "exchanged", "anchors": changed}, names=names)
        yield Explanation(nowhere + prior, kind, {"what": "no distances", "anchors": changed})


def _best_stretch(gains: Floats) -> tuple[float, int, int]:
    """Return the largest sum of successive gains (n,), with its first one and the one after its last (Kadane)."""
    sums = np.concatenate([[0.0], np.cumsum(gains)])
    least = np.minimum.accumulate(sums)
    end = 1 + int(np.argmax(sums[1:] - least[:-1]))
    begin = int(np.argmin(sums[:end]))
    return float(sums[end] - sums[begin]), begin, end


def _best_place(paths: Floats, ranges: Floats, counted: Floats, policy: RangePolicy) -> Floats:
    """Return log likelihoods (g, ...) of ranges (..., n) along paths (..., n, 2) to one place each, for g scales of errors.

    Counted (..., n) are 1 for a reading, and 0 where there is none.

    Squares of ranges are linear in the place and the square of its distance from the middle of the path.
    """
    many = counted.sum(axis=-1)
    middle = np.sum(paths * counted[..., None], axis=-2) / many[..., None]
    x, y = (-2.0 * (paths[..., k] - middle[..., k, None]) for k in (0, 1))
    squares, twice = ranges**2 - 0.25 * (x**2 + y**2), 2.0 * ranges
    rows = np.stack([x, y, np.broadcast_to(1.0, x.shape), squares], axis=-2)
    sure = counted / twice**2
    weights = np.broadcast_to(sure, squares.shape)
    for _ in range(policy.rounds):
        normal = (rows[..., :3, :] * weights[..., None, :]) @ np.swapaxes(rows, -1, -2)
        found = np.linalg.solve(normal[..., :3] + policy.ridge * np.eye(3), normal[..., 3:])
        errors = (found[..., 0, :] * x + found[..., 1, :] * y + found[..., 2, :] - squares) / twice
        weights = sure / (1.0 + (errors / policy.usual_error) ** 2)
    scales = np.array(policy.noise).reshape(-1, *(1,) * (errors.ndim - 1))
    off = np.sum(counted * np.log(1.0 + (errors / scales[..., None]) ** 2), axis=-1)
    return np.asarray(-off - many * np.log(np.pi * scales) - 1.5 * np.log(many))


def _by_way(trace: Trace, longest: float, policy: RangePolicy) -> Floats:
    """Return log likelihoods (g,) of the ranges of a trace if the robot drove its way, or twice that, in any direction."""
    # A way shorter than the errors of ranges is lost in them.
    change, way = np.diff(trace.ranges), np.maximum(np.diff(trace.way), policy.noise[0])
    scales = 2.0 * np.array(policy.noise)[:, None]

    def within(most: Floats) -> Floats:
        spread = np.arctan((change + most) / scales) - np.arctan((change - most) / scales)
        return np.asarray(np.sum(np.log(spread / (2.0 * np.pi * most)), axis=1))

    return np.asarray(np.logaddexp(within(way), within(2.0 * way)) - np.log(2.0) - np.log(longest))


def _no_distances(trace: Trace, longest: float) -> float:
    """Return the log likelihood of ranges that may be any numbers up to the longest."""
    return -len(trace.ranges) * float(np.log(longest))
