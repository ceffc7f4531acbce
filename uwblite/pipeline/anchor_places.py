"""Where each anchor stood, and when: decided once, within recordings and between them, on a path that is known well enough.

Each radio's ranges are explained by places and intervals (radio/place_intervals.py). Sound anchors seem to move where the path
is torn: from a broken step on, one rigid motion of the path explains the ranges to all anchors, and no anchor was moved. So
moves that begin together compete with such a step, which the closures to other visits may exclude. Where ranges alone hold the
path, all is solved with the places found, and these are decided on the path that results, until they stay.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import ClassVar

import numpy as np
from scipy.optimize import least_squares

from .. import se2
from ..arrays import Floats, Ints
from ..graph.optimizer import Optimizer
from ..radio import prior_selection
from ..radio.place_intervals import Explanation, MovePolicy, PlaceModel, Track, explain, intervals_of
from ..radio.range_noise import short_term_sigma
from ..sensor_log.anchor_names import place_name, radio_name
from .estimate import Estimate, Task
from .lidar_stages import solved
from .radio_stages import rough, with_range_noise


@dataclass(frozen=True, slots=True)
class BreakPolicy:
    """What is known beforehand of a step at which the path is torn."""

    broken: ClassVar[float] = 0.1
    """Probability that a recording's path has one."""
    size: ClassVar[float] = 1.0
    """Standard deviation of the error of such a step, m and rad."""
    turns: ClassVar[int] = 8
    """Headings from which the error of the step is sought."""
    rounds: ClassVar[int] = 4
    """Most solutions of a path that ranges hold; two are usual."""


@dataclass(frozen=True, slots=True, eq=False)
class _Radio:
    """One radio's ranges."""

    name: str
    numbers: tuple[int, ...]
    """Of the graph's anchors that are its places, the first one first."""
    rows: Ints
    """(m,) of the estimate's ranges, in the order of recordings and of time."""
    some: Ints
    """Those of them (indices into rows) of which the track is."""
    track: Track


def decide_places(estimate: Estimate, task: Task) -> Estimate:
    """Give every anchor the places of greatest evidence, each with a name, and tell which were moved."""
    if estimate.ranges is None or not estimate.placed.any():
        return estimate
    before, told = estimate, _Told(task)
    for _ in range(BreakPolicy.rounds):
        radios = _radios(estimate, task)
        found = [explain(radio.track, task.config.trilateration, task.config.ranges) for radio in radios]
        found = _against_broken_path(estimate, task, radios, found, told)
        other = _with_places(estimate, task, radios, found, told)
        if _same(other, estimate):
            break
        estimate = _reoptimised(other, task) if estimate.rests_on_ranges else with_range_noise(other, task.config)
        if not estimate.rests_on_ranges:
            break
    told.report()
    if estimate is not before:
        task.stages.end("places of anchors", places=len(estimate.anchor_ids))
    return estimate


def _same(one: Estimate, other: Estimate) -> bool:
    """Return whether two estimates have the same places, and the same ranges of each."""
    assert one.ranges is not None
    assert other.ranges is not None
    same = one.anchor_ids == other.anchor_ids and np.array_equal(one.ranges.anchor, other.ranges.anchor)
    return same and np.array_equal(one.ranges.alive, other.ranges.alive)


def _reoptimised(estimate: Estimate, task: Task) -> Estimate:
    """Return the optimum with other places; its path follows the ranges, and so do their noise and the radios' priors."""
    config, optimizer = task.config, Optimizer()
    estimate = solved(with_range_noise(estimate, config), rough(config.solver), optimizer)
    estimate = with_range_noise(estimate, config)
    measured = estimate.problem.edges[len(estimate.graph.edges) :]
    estimate = replace(estimate, graph=prior_selection.select_priors(estimate.graph, measured, config.calibration))
    return solved(estimate, config.solver, optimizer)


def _radios(estimate: Estimate, task: Task) -> list[_Radio]:
    """Return the radios that have a place, with their ranges along the estimate's path."""
    ranges, ids = estimate.ranges, estimate.anchor_ids
    assert ranges is not None
    # Prior knowledge of the user refers to anchors by their present numbers.
    given = bool(task.given.anchors or task.given.distances)
    names = [name if given or radio_name(name) not in ids else radio_name(name) for name in ids]
    recording, positions = task.recordings.of_keyframe[ranges.pose], ranges.tag_positions(estimate.graph.poses)
    used = ranges.alive & estimate.placed[ranges.anchor]
    values = np.append(estimate.graph.calibration.values, 0.0)[ranges.calibration]
    true = replace(ranges, ranges=ranges.corrected / (1.0 + values[:, 0]), late=np.zeros(0))
    level = true.planar_ranges()
    of_each = ranges.anchor + len(ids) * recording
    sigma = short_term_sigma(ranges.stamps[used], of_each[used], ranges.ranges[used], task.config.ranges)
    radios = []
    for name in dict.fromkeys(names):
        numbers = tuple(k for k, other in enumerate(names) if other == name)
        rows = np.flatnonzero(used & np.isin(ranges.anchor, numbers))
        rows = rows[np.lexsort((ranges.stamps[rows], recording[rows]))]
        if not len(rows):
            continue
        some = np.unique(np.linspace(0, len(rows) - 1, min(len(rows), MovePolicy.most_ranges)).round().astype(np.intp))
        own = rows[some]
        unknown = ranges.calibration[own[0], 2] >= 0
        height = float(np.sqrt(max(values[own[0], 2], 0.0)))
        heights = (height, *(h for h in (0.0, *MovePolicy.heights) if h != height)) if unknown else (0.0,)
        track = Track(positions[own], level[own], recording[own], sigma, heights)
        radios.append(_Radio(name, numbers, rows, some, track))
    return radios


def _with_places(
    estimate: Estimate, task: Task, radios: Sequence[_Radio], found: Sequence[Explanation], told: "_Told"
) -> Estimate:
    """Return the estimate with the places that were found, each as an anchor; ranges made on the way have no weight."""
    ranges, bootstrap = estimate.ranges, estimate.bootstrap
    assert ranges is not None
    assert bootstrap is not None
    told.moves.clear()
    recording = task.recordings.of_keyframe[ranges.pose]
    ids, anchors, anchor = list(estimate.anchor_ids), list(estimate.graph.anchors), ranges.anchor.copy()
    weights, source, hypotheses = ranges.own_weights.copy(), list(range(len(ids))), list(bootstrap.hypotheses)
    for radio, each in zip(radios, found, strict=True):
        if len(radio.numbers) == len(each.found) == 1:
            continue
        place = each.place[np.searchsorted(radio.some, np.arange(len(radio.rows)), "right") - 1]
        names = _names(radio.name, place, recording[radio.rows])
        for k, name in enumerate(names):
            if name not in ids:
                ids.append(name)
                anchors.append(each.found[k].position)
                source.append(radio.numbers[0])
                hypotheses.append((each.found[k], each.found[k]))
            number = ids.index(name)
            anchors[number] = each.found[k].position
            anchor[radio.rows[place == k]] = number
        weights[radio.rows[place < 0]] = 0.0
        told.add(place, each, names, ranges.stamps[radio.rows], recording[radio.rows])
    unused = [k for radio in radios for k in radio.numbers if not np.any(anchor[radio.rows] == k)]
    kept = np.array([k for k in range(len(ids)) if k not in unused])
    fresh = np.array(source)[kept]
    bootstrap = replace(
        bootstrap, placed=bootstrap.placed[fresh], ambiguous=bootstrap.ambiguous[fresh],
        hypotheses=tuple(hypotheses[k] for k in kept),
    )  # fmt: skip
    graph = replace(estimate.graph, anchors=np.array(anchors)[kept], fixed_anchors=estimate.graph.fixed_anchors[fresh])
    ranges = replace(ranges, anchor=np.searchsorted(kept, anchor), weights=weights)
    return replace(estimate, graph=graph, ranges=ranges, bootstrap=bootstrap, anchor_ids=tuple(ids[k] for k in kept))


def _names(radio: str, place: Ints, recording: Ints) -> list[str]:
    """Return the name of each place of a radio, see place_name."""
    names, first = list[str](), int(recording[0])
    for k in range(int(place.max()) + 1):
        number = int(recording[np.argmax(place == k)])
        held = [n for n in dict.fromkeys(place[recording == number].tolist()) if n >= 0]
        names.append(place_name(radio, held.index(k) + 1, number if number != first else 0))
    return names


class _Told:
    """What the user is told of places, once they are decided."""

    def __init__(self, task: Task) -> None:
        self.task = task
        self.moves: list[dict[str, object]] = []
        self.broken: dict[int, dict[str, object]] = {}

    def add(self, place: Ints, found: Explanation, names: Sequence[str], stamps: Floats, recording: Ints) -> None:
        """Note each change of place (m,) of a radio with ranges at stamps (m,), s, in recordings (m,) 0, 1, ..."""
        placed = np.flatnonzero(place >= 0)
        for k in np.flatnonzero(np.diff(place[placed])).tolist():
            last, first = int(placed[k]), int(placed[k + 1])
            number, way = int(recording[first]), first - last - 1
            name, now = names[place[last]], names[place[first]]
            distance = float(np.hypot(*(found.places[place[first]] - found.places[place[last]])))
            figures: dict[str, object] = {
                "anchor": name, "distance": round(distance, 4), "recording": number + 1, "new_id": now,
            }  # fmt: skip
            if recording[last] == number:
                start = self.task.recordings.each[number].log.odometry.stamps[0]
                between = [float(stamps[row] - start) for row in (last + 1, first)]
                figures |= {"between": between, "way": way, "several": len(self.task.recordings) > 1}
            self.moves.append(figures)

    def report(self) -> None:
        """Note moves, and the stretches of a path that seem to be displaced."""
        for figures in self.moves:
            self.task.stages.note("moved-anchor", **figures)
        for figures in self.broken.values():
            self.task.stages.note("path-displaced", **figures)


@dataclass(frozen=True, slots=True, eq=False)
class _Change:
    """A radio's change to another place within a recording."""

    radio: int
    """Number of it."""
    interval: Ints
    """Rows of its track at the new place, until the next change."""
    before: int
    """Number of the place before."""
    frames: tuple[int, int]
    """Keyframes between which it lies."""

    def with_other(self, other: "_Change") -> bool:
        """Return whether another change may be at the same time."""
        return self.frames[0] <= other.frames[1] and other.frames[0] <= self.frames[1]


def _changes(estimate: Estimate, radios: Sequence[_Radio], found: Sequence[Explanation]) -> Iterator[_Change]:
    """Yield all changes of place within recordings."""
    assert estimate.ranges is not None
    for number, (radio, each) in enumerate(zip(radios, found, strict=True)):
        pose, intervals = estimate.ranges.pose[radio.rows[radio.some]], intervals_of(each.place)
        for one, other in pairwise(intervals):
            if radio.track.recording[one[-1]] == radio.track.recording[other[0]]:
                # The time of a change is known to a few ranges.
                frames = int(pose[one[-_NEAR:][0]]), int(pose[other[:_NEAR][-1]])
                yield _Change(number, other, int(each.place[one[-1]]), frames)


_NEAR = 3
"""Ranges by which the time of a change may be off."""


def _against_broken_path(
    estimate: Estimate, task: Task, radios: Sequence[_Radio], found: Sequence[Explanation], told: _Told
) -> list[Explanation]:
    """Return the explanations without moves that a broken step of the path explains better, for all radios together."""
    kept = list(found)
    told.broken.clear()
    done = list[_Change]()
    for change in _changes(estimate, radios, found):
        if not any(change.with_other(other) for other in done):
            together = [other for other in _changes(estimate, radios, kept) if change.with_other(other)]
            done.append(change)
            rival = BrokenStep(estimate, task, radios, kept, together)
            if together and rival.gain() + rival.log_prior() > 0.0:
                kept = rival.found
                told.broken[rival.begin] = rival.told()
    return kept


def range_evidence(estimate: Estimate, task: Task) -> float:
    """Return the logarithm of the evidence of all ranges along the estimate's path, their anchors placed anew."""
    radios = _radios(estimate, task)
    return sum(explain(radio.track, task.config.trilateration, task.config.ranges).evidence for radio in radios)


def broken_steps(estimate: Estimate, task: Task, suspects: Ints) -> list[tuple[float, "BrokenStep"]]:
    """Return broken steps that explain ranges beside anchors that move together, the best one of each such time, with its gain.

    Parameters
    ----------
    suspects : keyframes before which a step may be broken as well: the ranges show its time by when they reach an anchor, and
        where they say nothing against anchors that stand still, it may still be broken.
    """
    config, radios, groups = task.config, _radios(estimate, task), list[list[_Change]]()
    found = [explain(radio.track, config.trilateration, config.ranges) for radio in radios]
    for change in _changes(estimate, radios, found):
        if not any(change.with_other(other) for group in groups for other in group):
            groups.append([other for other in _changes(estimate, radios, found) if change.with_other(other)])
    best = []
    for group in groups or [[]]:
        tried = [BrokenStep(estimate, task, radios, found, group)] if group else []
        end = tried[0].end if tried else len(estimate.graph.poses)
        tried += [BrokenStep(estimate, task, radios, found, group, int(k)) for k in suspects if k < end]
        gains = [step.gain() for step in tried]
        best += [(max(gains), tried[int(np.argmax(gains))])] if tried else []
    return best


class BrokenStep:
    """The rival of moves that begin together: a broken step of the path, after which a stretch of it is displaced as one."""

    def __init__(
        self, estimate: Estimate, task: Task, radios: Sequence[_Radio], found: Sequence[Explanation],
        moves: Sequence[_Change], begin: int | None = None,
    ) -> None:
        self.estimate, self.task, self.radios, self.moves, self.found = estimate, task, radios, moves, list(found)
        assert estimate.ranges is not None
        self.before = list(found)
        self.pose = [estimate.ranges.pose[radio.rows[radio.some]] for radio in radios]
        heard, self.end = self._extent() if moves else (0, len(estimate.graph.poses))
        begin = heard if begin is None else begin
        self.recording = task.recordings.each[int(task.recordings.of_keyframe[begin])]
        self.begin = max(begin, self.recording.rows.start + 1)
        self.end = min(self.end, self.recording.rows.stop)
        for k, (radio, pose, each) in enumerate(zip(radios, self.pose, self.found, strict=True)):
            outside = np.flatnonzero((pose < self.begin) | (pose >= self.end))
            if len(each.found) == 1 and len(outside) >= task.config.trilateration.min_ranges:
                # The stretch has pulled the place along.
                model = PlaceModel(radio.track, task.config.trilateration, task.config.ranges)
                self.found[k] = replace(each, found=(model.likeliest(each.height, [outside])[0],))
        for move in moves:
            each = self.found[move.radio]
            place = each.place.copy()
            place[move.interval] = move.before
            self.found[move.radio] = replace(each, place=place)

    def _extent(self) -> tuple[int, int]:
        """Return the first keyframe of the longest move, and the one at which it ends or the recording does."""
        first = max(self.moves, key=lambda move: len(move.interval))
        pose, last = self.pose[first.radio], int(first.interval[-1])
        recording = self.radios[first.radio].track.recording
        more = last + 1 < len(pose) and recording[last + 1] == recording[last]
        end = int(pose[last]) + 1 if more else self.task.recordings.each[int(recording[last])].rows.stop
        return int(pose[first.interval[0]]), end

    def gain(self) -> float:
        """Return by how much its evidence is greater than that of the moves, if a step is broken there."""
        poses = self.estimate.graph.poses
        for _ in range(MovePolicy.laps):
            # Places that a displaced stretch has pulled along hide some of the step, so both are found in turn.
            self.motion, spread = self._fitted()
            gain = self._evidence()
        gain += spread - 0.5 * float(self.motion @ self.motion) / BreakPolicy.size**2
        return gain - 0.5 * (self._cost(self.displaced(poses)) - self._cost(poses))

    def log_prior(self) -> float:
        """Return the logarithm of the prior probability of a broken step just there, and of one where it ends."""
        ends = 1 if self.end == self.recording.rows.stop else 2
        return ends * float(np.log(BreakPolicy.broken / len(self.recording.frames)))

    def displaced(self, poses: Floats) -> Floats:
        """Return poses (k, 3) with the stretch moved to where the ranges have it."""
        poses = poses.copy()
        poses[self.begin : self.end] = se2.compose(self._displacement(), poses[self.begin : self.end])
        return poses

    def places(self, anchors: Floats) -> Floats:
        """Return anchors (a, 2) at the places that the ranges show with the stretch moved, m."""
        assert self.estimate.ranges is not None
        anchors = anchors.copy()
        for radio, each in zip(self.radios, self.found, strict=True):
            for number in radio.numbers:
                own = each.place[(self.estimate.ranges.anchor[radio.rows[radio.some]] == number) & (each.place >= 0)]
                anchors[number] = each.places[np.bincount(own).argmax()] if len(own) else anchors[number]
        return anchors

    def _displacement(self) -> Floats:
        """Return the motion (3,) of the stretch in the map."""
        origin = self.estimate.graph.poses[self.begin - 1]
        return np.asarray(se2.compose(se2.compose(origin, self.motion), se2.inverse(origin)))

    def _evidence(self) -> float:
        """Return by how much the evidence of all ranges is greater than with the moves, the places at their likeliest."""
        config, gain, moved = self.task.config, 0.0, self._displacement()
        for k, (radio, pose) in enumerate(zip(self.radios, self.pose, strict=True)):
            inside = (pose >= self.begin) & (pose < self.end)
            if not inside.any():
                continue
            here = PlaceModel(radio.track, config.trilateration, config.ranges)
            path = np.where(inside[:, None], se2.transform(moved, radio.track.path), radio.track.path)
            there = PlaceModel(replace(radio.track, path=path), config.trilateration, config.ranges)
            shares = here.worth(self.before[k].place)
            one, self.found[k] = (m.with_places(e, shares) for m, e in ((here, self.before[k]), (there, self.found[k])))
            gain += self.found[k].evidence - one.evidence
        return gain

    def _fitted(self) -> tuple[Floats, float]:
        """Return the error (3,) of the step that explains the stretch's ranges best, and the logarithm of what share of its
        prior the ranges leave."""
        origin = self.estimate.graph.poses[self.begin - 1]
        places, tags, level, root = [], [], [], []
        for k, (radio, pose) in enumerate(zip(self.radios, self.pose, strict=True)):
            own = np.flatnonzero((pose >= self.begin) & (pose < self.end) & (self.found[k].place >= 0))
            each = self.found[k]
            at = each.place[own]
            places.append(each.places[at])
            tags.append(radio.track.path[own])
            level.append(radio.track.level(each.height)[own] - np.array([f.bias for f in each.found])[at])
            share = PlaceModel(radio.track, self.task.config.trilateration, self.task.config.ranges).worth(each.place)[own]
            root.append(np.sqrt(share) / max(2.0 * radio.track.sigma, _SIGMA))
        place, tag = (se2.transform(se2.inverse(origin), np.concatenate(points)) for points in (places, tags))
        measured, weight = np.concatenate(level), np.concatenate(root)

        def errors(step: Floats) -> Floats:
            """Return whitened errors of the ranges, and the prior of the step."""
            distance = np.hypot(*(se2.transform(step, tag) - place).T)
            return np.append(weight * (distance - measured), step / BreakPolicy.size)

        moved = [(self.before[m.radio].places, m.before, int(self.before[m.radio].place[m.interval[0]])) for m in self.moves]
        here, there = (
            se2.transform(se2.inverse(origin), np.array(points).reshape(-1, 2))
            for points in ([at[one] for at, one, _ in moved], [at[other] for at, _, other in moved])
        )
        shift = np.append((here - there).sum(axis=0) / max(len(moved), 1), 0.0)
        turned = [np.array([0.0, 0.0, angle]) for angle in np.linspace(-np.pi, np.pi, BreakPolicy.turns, endpoint=False)]
        starts = [np.zeros(3), shift, *turned, *([se2.align(there, here)] if len(here) > 1 else [])]
        tried = [least_squares(errors, start, loss="cauchy", f_scale=_LOSS) for start in starts]
        done = min(tried, key=lambda each: float(each.cost))
        spread = -0.5 * np.linalg.slogdet(done.jac.T @ done.jac)[1] - 3.0 * np.log(BreakPolicy.size)
        return np.asarray(done.x), float(spread)

    def _cost(self, poses: Floats) -> float:
        """Return chi2 of what ties the stretch to the rest besides ranges: scans of other visits, and what the user gave.

        The prior of a broken step takes the place of the wheels' noise, and of that of scans that follow each other.
        """
        return replace(self.estimate.graph, poses=poses).with_edges(self.estimate.closures.edges).chi2()

    def told(self) -> dict[str, object]:
        """Return the figures that the user is told."""
        stamps, start = self.recording.frames.stamps, float(self.recording.log.odometry.stamps[0])
        begin, end = (float(stamps[k - self.recording.first]) for k in (self.begin, self.end - 1))
        names = sorted({self.radios[move.radio].name for move in self.moves})
        off, turned = float(np.hypot(*self.motion[:2])), float(np.rad2deg(abs(self.motion[2])))
        return {
            "recording": self.recording.number + 1, "stretch": (begin, end), "start": start, "anchors": names, "apart": off,
            "turned": turned,
        }  # fmt: skip


_SIGMA, _LOSS = 0.1, 2.5
"""Least standard deviation of ranges of known places, m, and from how many on an error counts less."""
