"""Ranges of each radio along the path, and broken steps of it: the rival of anchors that move together.

Sound anchors seem to move where the path is torn: from a broken step on, one rigid motion of the path explains the ranges to
all anchors, and no anchor was moved. So moves that begin together compete with such a step, which the closures to other visits
may exclude.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from .. import se2
from ..arrays import Floats, Ints, evenly
from ..findings import Fact
from ..radio.place_evidence import Explanation, MovePolicy, PlaceModel, Track, intervals_of
from ..radio.place_intervals import explain
from ..radio.range_noise import MOST_RANGES, short_term_sigma
from ..radio.trilateration import path_placements
from ..sensor_log.sensors import radio_name
from .estimate import Estimate, Task


class BreakPolicy:
    """What is known beforehand of a step at which the path is torn, and how it is sought."""

    broken: float = 0.1
    """Probability that a recording's path has one."""
    size: float = 1.0
    """Standard deviation of the error of such a step, m and rad."""
    rounds: int = MovePolicy.laps
    """Most solutions of a path that ranges hold; two are usual."""
    near: int = 3
    """Ranges by which the time of a change may be off."""


@dataclass(frozen=True, slots=True, eq=False)
class RadioTrack:
    """One radio's ranges."""

    name: str
    numbers: tuple[int, ...]
    """Of the graph's anchors that are its places, the first one first."""
    rows: Ints
    """(m,) of the estimate's ranges, in the order of recordings and of time."""
    chosen: Ints
    """Those of them (indices into rows) of which the track is."""
    pose: Ints
    """Keyframe of each range of the track."""
    model: PlaceModel
    """Of the track."""

    @property
    def track(self) -> Track:
        """The ranges that are explained."""
        return self.model.track

    def inside(self, begin: int, end: int) -> Ints:
        """Return which ranges of the track are from keyframes begin <= k < end."""
        return np.flatnonzero((self.pose >= begin) & (self.pose < end))


def radio_tracks(estimate: Estimate, task: Task) -> list[RadioTrack]:
    """Return the radios that have a place, with their ranges along the estimate's path."""
    ranges, ids, config = estimate.ranges, estimate.anchor_ids, task.config
    assert ranges is not None
    # Prior knowledge of the user refers to anchors by their present numbers.
    names = [name if task.constraints.of_anchors or radio_name(name) not in ids else radio_name(name) for name in ids]
    recording, positions = task.recordings.of_keyframe[ranges.pose], ranges.tag_positions(estimate.graph.poses)
    used = ranges.alive & estimate.placed[ranges.anchor]
    values = np.append(estimate.graph.calibration.values, 0.0)[ranges.calibration]
    level = replace(ranges, ranges=ranges.corrected / (1.0 + values[:, 0]), late=np.zeros(0)).planar_ranges()
    of_each, true = ranges.anchor + len(ids) * recording, ranges.corrected / (1.0 + values[:, 0])
    sigma = short_term_sigma(ranges.stamps[used], of_each[used], true[used], config.ranges)
    radios = []
    for name in dict.fromkeys(names):
        numbers = tuple(k for k, other in enumerate(names) if other == name)
        rows = np.flatnonzero(used & np.isin(ranges.anchor, numbers))
        rows = rows[np.lexsort((ranges.stamps[rows], recording[rows]))]
        if not len(rows):
            continue
        chosen = evenly(len(rows), MOST_RANGES)
        sample = rows[chosen]
        unknown = ranges.calibration[sample[0], 2] >= 0
        height = float(np.sqrt(max(values[sample[0], 2], 0.0)))
        heights = (height, *(h for h in (0.0, *MovePolicy.heights) if h != height)) if unknown else (0.0,)
        track = Track(positions[sample], level[sample], recording[sample], sigma, heights)
        model = PlaceModel(track, config.trilateration, config.ranges)
        radios.append(RadioTrack(name, numbers, rows, chosen, ranges.pose[sample], model))
    return radios


def range_evidence(estimate: Estimate, task: Task) -> float:
    """Return the logarithm of the evidence of all ranges along the estimate's path, their anchors placed anew."""
    return sum(explain(radio.model).evidence for radio in radio_tracks(estimate, task))


@dataclass(frozen=True, slots=True, eq=False)
class _Change:
    """A radio's change to another place within a recording."""

    radio: int
    interval: Ints
    """Rows of its track at the new place, until the next change."""
    before: int
    """Number of the place before."""
    frames: tuple[int, int]
    """Keyframes between which it lies."""

    def with_other(self, other: "_Change") -> bool:
        """Return whether another change may be at the same time."""
        return self.frames[0] <= other.frames[1] and other.frames[0] <= self.frames[1]


def _changes(radios: Sequence[RadioTrack], found: Sequence[Explanation]) -> Iterator[_Change]:
    for number, (radio, each) in enumerate(zip(radios, found, strict=True)):
        for one, other in pairwise(intervals_of(each.place)):
            if radio.track.recording[one[-1]] == radio.track.recording[other[0]]:
                frames = int(radio.pose[one[-BreakPolicy.near :][0]]), int(radio.pose[other[: BreakPolicy.near][-1]])
                yield _Change(number, other, int(each.place[one[-1]]), frames)


def _groups(radios: Sequence[RadioTrack], found: Sequence[Explanation]) -> list[list[_Change]]:
    """Return changes within recordings, each group with all that may be at the time of its first one."""
    groups, changes = list[list[_Change]](), list(_changes(radios, found))
    for change in changes:
        if not any(change.with_other(other) for group in groups for other in group):
            groups.append([other for other in changes if change.with_other(other)])
    return groups


def without_moves_of_path(
    estimate: Estimate, task: Task, radios: Sequence[RadioTrack], found: Sequence[Explanation]
) -> tuple[list[Explanation], list["BrokenStep"]]:
    """Return the explanations without moves that a broken step of the path explains better, for all radios together; and the
    broken steps."""
    kept, broken = list(found), list[BrokenStep]()
    for group in _groups(radios, found):
        rival = BrokenStep(estimate, task, radios, kept, [c for c in _changes(radios, kept) if group[0].with_other(c)])
        if rival.moves and rival.gain() + rival.log_prior() > 0.0:
            kept = [_without_unused(each) for each in rival.found]
            broken.append(rival)
    return kept, broken


def _without_unused(each: Explanation) -> Explanation:
    """Return an explanation without the places to which it has no range, as those of moves that were none."""
    used, number = np.unique(each.place, return_inverse=True)
    carried = int(used[0] < 0)
    return replace(each, place=number.reshape(-1) - carried, found=tuple(each.found[k] for k in used[carried:].tolist()))


def broken_steps(estimate: Estimate, task: Task, suspects: Ints) -> list[tuple[float, "BrokenStep"]]:
    """Return broken steps that explain ranges beside anchors that move together, the best one of each such time, with its gain.

    Parameters
    ----------
    suspects : keyframes before which a step may be broken as well, also where the ranges say nothing against it.
    """
    radios, best = radio_tracks(estimate, task), list[tuple[float, BrokenStep]]()
    found = [explain(radio.model) for radio in radios]
    for group in _groups(radios, found) or [[]]:
        tried = [BrokenStep(estimate, task, radios, found, group)] if group else []
        end = tried[0].end if tried else len(estimate.graph.poses)
        tried += [BrokenStep(estimate, task, radios, found, group, int(k)) for k in suspects if k < end]
        gains = [step.gain() for step in tried]
        best += [(max(gains), tried[int(np.argmax(gains))])] if tried else []
    return best


class BrokenStep:
    """The rival of moves that begin together: a broken step of the path, after which a stretch of it is displaced as one."""

    def __init__(
        self, estimate: Estimate, task: Task, radios: Sequence[RadioTrack], found: Sequence[Explanation],
        moves: Sequence[_Change], begin: int | None = None,
    ) -> None:
        self.estimate, self.radios, self.moves, self.found, self.before = estimate, radios, moves, list(found), list(found)
        heard, end = self._extent(task) if moves else (0, len(estimate.graph.poses))
        begin = heard if begin is None else begin
        self.recording = task.recordings.each[int(task.recordings.of_keyframe[begin])]
        self.begin = max(begin, self.recording.rows.start + 1)
        self.end = min(end, self.recording.rows.stop)
        for k, (radio, each) in enumerate(zip(radios, self.found, strict=True)):
            outside = np.setdiff1d(np.arange(len(radio.pose)), radio.inside(self.begin, self.end))
            if len(each.found) == 1 and len(outside) >= task.config.trilateration.min_ranges:
                # The stretch has pulled the place along.
                self.found[k] = replace(each, found=(radio.model.likeliest(each.height, [outside])[0],))
        for move in moves:
            each = self.found[move.radio]
            place = each.place.copy()
            place[move.interval] = move.before
            self.found[move.radio] = replace(each, place=place)

    def _extent(self, task: Task) -> tuple[int, int]:
        """Return the first keyframe of the longest move, and the one at which it ends or the recording does."""
        first = max(self.moves, key=lambda move: len(move.interval))
        radio, last = self.radios[first.radio], int(first.interval[-1])
        recording = radio.track.recording
        more = last + 1 < len(radio.pose) and recording[last + 1] == recording[last]
        end = int(radio.pose[last]) + 1 if more else task.recordings.each[int(recording[last])].rows.stop
        return int(radio.pose[first.interval[0]]), end

    def gain(self) -> float:
        """Return by how much its evidence is greater than that of the moves, if a step is broken there."""
        poses = self.estimate.graph.poses
        worth = [radio.model.worth(each.place) for radio, each in zip(self.radios, self.before, strict=True)]
        radios = [k for k, radio in enumerate(self.radios) if len(radio.inside(self.begin, self.end))]
        moved = sum(self.radios[k].model.with_places(self.before[k], worth[k]).evidence for k in radios)
        for _ in range(MovePolicy.laps):
            # Places that a displaced stretch has pulled along hide some of the step, so both are found in turn.
            self.motion, spread = self._fitted()
            gain = self._evidence(radios, worth) - moved
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
            of = self.estimate.ranges.anchor[radio.rows[radio.chosen]]
            for number in radio.numbers:
                own = each.place[(of == number) & (each.place >= 0)]
                anchors[number] = each.places[np.bincount(own).argmax()] if len(own) else anchors[number]
        return anchors

    def _displacement(self) -> Floats:
        """Return the motion (3,) of the stretch in the map."""
        origin = self.estimate.graph.poses[self.begin - 1]
        return np.asarray(se2.compose(se2.compose(origin, self.motion), se2.inverse(origin)))

    def _evidence(self, radios: Sequence[int], worth: Sequence[Floats]) -> float:
        """Return the evidence of some radios' ranges, of a worth (m,) each, with the stretch moved and places likeliest."""
        moved = self._displacement()
        for k in radios:
            radio = self.radios[k]
            inside, path = radio.inside(self.begin, self.end), radio.track.path.copy()
            path[inside] = se2.transform(moved, path[inside])
            self.found[k] = radio.model.along(path).with_places(self.found[k], worth[k])
        return sum(self.found[k].evidence for k in radios)

    def _fitted(self) -> tuple[Floats, float]:
        """Return the step's error (3,) that explains the stretch's ranges best, and the log of the share of its prior left."""
        home = se2.inverse(self.estimate.graph.poses[self.begin - 1])
        parts = []
        for radio, each in zip(self.radios, self.found, strict=True):
            own = radio.inside(self.begin, self.end)
            own = own[each.place[own] >= 0]
            at, bias = each.place[own], np.array([place.bias for place in each.found])
            root = np.sqrt(radio.model.worth(each.place)[own]) / radio.model.usual.sigma
            parts.append((each.places[at], radio.track.path[own], radio.track.level(each.height)[own] - bias[at], root))
        places, tags, measured, root = (np.concatenate(each) for each in zip(*parts, strict=True))
        place, tag = se2.transform(home, places), se2.transform(home, tags)

        _, motion, information = path_placements(place, tag, measured, root, BreakPolicy.size)[0]
        return motion, float(-0.5 * np.linalg.slogdet(information)[1] - len(motion) * np.log(BreakPolicy.size))

    def _cost(self, poses: Floats) -> float:
        """Return chi2 of what ties the stretch to the rest besides ranges: scans of other visits, and what the user gave.

        The prior of a broken step takes the place of the wheels' noise, and of that of scans that follow each other.
        """
        return replace(self.estimate.graph, poses=poses).with_edges(self.estimate.closures.edges).chi2()

    def fact(self) -> Fact:
        """Return that a stretch of the path is displaced."""
        stamps, start = self.recording.frames.stamps, float(self.recording.log.odometry.stamps[0])
        begin, end = (float(stamps[k - self.recording.first]) for k in (self.begin, self.end - 1))
        names = sorted({self.radios[move.radio].name for move in self.moves})
        off, turned = float(np.hypot(*self.motion[:2])), float(np.rad2deg(abs(self.motion[2])))
        where = {"recording": self.recording.number + 1, "stretch": (begin, end), "start": start}
        return Fact.of("path-displaced", **where, anchors=names, apart=off, turned=turned)
