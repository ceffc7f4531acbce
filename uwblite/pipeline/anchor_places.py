"""Where each anchor stood, and when: decided within recordings and between them, on a path that is known well enough.

Each radio's ranges are explained by places and intervals (radio/place_intervals.py); broken steps of the path compete with
moves that begin together (broken_steps.py). Where ranges alone hold the path, all is solved with the places found, and these
are decided on the path that results, until they stay. Where the path may have been torn they are decided once more when it is
mended (broken_stretches.py). Anchors that are new or were taken away between recordings have ranges in some of them, though
others drove in their reach.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..arrays import Floats, Ints
from ..findings import Fact
from ..graph.solver import Optimizer
from ..problem.alternatives import EvidencePolicy
from ..problem.solution import rough
from ..radio.place_evidence import Explanation
from ..radio.place_intervals import explain
from ..sensor_log.sensors import place_name, radio_name
from .broken_steps import BreakPolicy, RadioTrack, radio_tracks, without_moves_of_path
from .estimate import Estimate, Task
from .radio_stages import with_range_noise, with_selected_priors


def of_places(fact: Fact) -> bool:
    """Return whether a fact tells what was decided on anchors' places, along the path as it was then.

    An anchor that is not where the user has it was moved before any recording.
    """
    return fact.kind in ("moved-anchor", "path-displaced") and "recording" in fact.figures


def decide_places(estimate: Estimate, task: Task) -> Estimate:
    """Give every anchor the places of greatest evidence, each with a name, and tell which were moved."""
    if estimate.ranges is None or not estimate.placed.any():
        return estimate
    first, facts = estimate, list[Fact]()
    for _ in range(BreakPolicy.rounds):
        radios = radio_tracks(estimate, task)
        explanations, broken = without_moves_of_path(estimate, task, radios, [explain(radio.model) for radio in radios])
        candidate, moves = _apply_places(estimate, task, radios, explanations)
        facts = [*moves, *(step.fact() for step in broken)]
        if _same(candidate, estimate):
            break
        if not estimate.rests_on_ranges:
            estimate = with_range_noise(candidate, task.config)
            break
        estimate = _reoptimised(candidate, task)
    task.stages.restate(of_places, facts)
    if estimate is not first:
        task.stages.end("places of anchors", places=len(estimate.anchor_ids))
    return estimate


def _same(one: Estimate, other: Estimate) -> bool:
    """Return whether two estimates have the same places, and the same ranges of each."""
    assert one.ranges is not None
    assert other.ranges is not None
    if one.anchor_ids != other.anchor_ids or not np.array_equal(one.ranges.anchor, other.ranges.anchor):
        return False
    apart = np.hypot(*(one.graph.anchors - other.graph.anchors).T)
    return bool(np.all(apart <= EvidencePolicy.same_anchor)) and np.array_equal(one.ranges.alive, other.ranges.alive)


def _likelier(radio: RadioTrack, explanation: Explanation, anchor: Floats) -> bool:
    """Return whether the one place of a radio's ranges is likelier than where its anchor (2,) stands, at its own likeliest.

    An anchor that was placed along a path by wheels that slipped is at another optimum of its ranges along the lidar's path.
    """
    start = replace(explanation.found[0], position=anchor)
    present = radio.model.with_places(replace(explanation, found=(start,)), radio.model.alone)
    return explanation.evidence - present.evidence > EvidencePolicy.positive


def _reoptimised(estimate: Estimate, task: Task) -> Estimate:
    """Return the optimum with other places; its path follows the ranges, and so do their noise and the radios' priors."""
    config, optimizer = task.config, Optimizer()
    estimate = with_range_noise(estimate, config).solved(rough(config.solver), optimizer)[0]
    return with_selected_priors(with_range_noise(estimate, config), config).solved(config.solver, optimizer)[0]


def _apply_places(
    estimate: Estimate, task: Task, radios: Sequence[RadioTrack], explanations: Sequence[Explanation]
) -> tuple[Estimate, list[Fact]]:
    """Return the estimate with the places that were found, each as an anchor, and what is said of moves.

    Ranges made on the way from place to place have no weight.
    """
    ranges, bootstrap, moves = estimate.ranges, estimate.bootstrap, list[Fact]()
    assert ranges is not None
    assert bootstrap is not None
    recording = task.recordings.of_keyframe[ranges.pose]
    ids, anchors, anchor = list(estimate.anchor_ids), list(estimate.graph.anchors), ranges.anchor.copy()
    weights, source, hypotheses = ranges.own_weights.copy(), list(range(len(ids))), list(bootstrap.hypotheses)
    # Along a path that follows the ranges, or where the user says something of anchors, one place stays.
    replaced = not (estimate.rests_on_ranges or task.constraints.of_anchors)
    for radio, explanation in zip(radios, explanations, strict=True):
        if len(radio.numbers) == len(explanation.found) == 1:
            if replaced and _likelier(radio, explanation, anchors[radio.numbers[0]]):
                anchors[radio.numbers[0]] = explanation.found[0].position
            continue
        place = explanation.place[np.searchsorted(radio.chosen, np.arange(len(radio.rows)), "right") - 1]
        names = _names(radio.name, place, recording[radio.rows])
        for k, name in enumerate(names):
            if name not in ids:
                ids.append(name)
                anchors.append(explanation.found[k].position)
                source.append(radio.numbers[0])
                hypotheses.append((explanation.found[k], explanation.found[k]))
            number = ids.index(name)
            anchors[number] = explanation.found[k].position
            anchor[radio.rows[place == k]] = number
        weights[radio.rows[place < 0]] = 0.0
        moves.extend(_moves(task, explanation.places[place], place, names, ranges.stamps[radio.rows], recording[radio.rows]))
    unused = [k for radio in radios for k in radio.numbers if not np.any(anchor[radio.rows] == k)]
    kept = np.setdiff1d(np.arange(len(ids)), unused)
    fresh = np.array(source)[kept]
    left = tuple(hypotheses[k] for k in kept)
    bootstrap = replace(bootstrap, placed=bootstrap.placed[fresh], ambiguous=bootstrap.ambiguous[fresh], hypotheses=left)
    graph = replace(estimate.graph, anchors=np.array(anchors)[kept], fixed_anchors=estimate.graph.fixed_anchors[fresh])
    ranges = replace(ranges, anchor=np.searchsorted(kept, anchor), weights=weights)
    ids = [ids[k] for k in kept]
    return replace(estimate, graph=graph, ranges=ranges, bootstrap=bootstrap, anchor_ids=tuple(ids)), moves


def _names(radio: str, place: Ints, recording: Ints) -> list[str]:
    """Return the name of each place of a radio, see place_name."""
    names, first = list[str](), int(recording[0])
    for k in range(int(place.max()) + 1):
        number = int(recording[np.argmax(place == k)])
        held = [n for n in dict.fromkeys(place[recording == number].tolist()) if n >= 0]
        names.append(place_name(radio, held.index(k) + 1, number if number != first else 0))
    return names


def _moves(task: Task, positions: Floats, place: Ints, names: Sequence[str], stamps: Floats, recording: Ints) -> Iterator[Fact]:
    """Tell of each change of a radio's place, from the last range at the one to the first at the other.

    Parameters
    ----------
    positions : (m, 2) m, of the place that each of its ranges is from, in the order of time.
    place, stamps, recording : (m,) number of that place, -1 = none; (m,) s; (m,) from 0.
    names : of its places.
    """
    placed = np.flatnonzero(place >= 0)
    for k in np.flatnonzero(np.diff(place[placed])).tolist():
        last, first = int(placed[k]), int(placed[k + 1])
        number, way = int(recording[first]), first - last - 1
        name, next_name = names[place[last]], names[place[first]]
        distance = float(np.hypot(*(positions[first] - positions[last])))
        figures: dict[str, Any] = {"anchor": name, "distance": distance, "recording": number + 1, "new_id": next_name}
        if recording[last] == number:
            start = task.recordings.each[number].log.odometry.stamps[0]
            between = [*(float(stamps[row] - start) for row in (last + 1, first)), way]
            figures |= {"between": between, "several": len(task.recordings) > 1}
        yield Fact("moved-anchor", figures)


def name_new_and_absent_anchors(estimate: Estimate, task: Task) -> Estimate:
    """Warn of anchors with ranges in some recordings alone, though others drove where these have them."""
    ranges = estimate.ranges
    if len(task.recordings) == 1 or ranges is None:
        return estimate
    recording_of, number = task.recordings.of_keyframe, len(task.recordings)
    # Where an anchor was moved, one place follows the other: the move is reported, and the anchor was present all the time.
    names = np.array([radio_name(name) for name in estimate.anchor_ids])
    # A recording with too few ranges to an anchor to place it gives these no weight, but it has them.
    received = np.flatnonzero(ranges.ranges > 0.0)
    counts = np.zeros((len(names), number), dtype=np.intp)
    np.add.at(counts, (ranges.anchor[received], recording_of[ranges.pose[received]]), 1)
    for k in np.flatnonzero(estimate.placed).tolist():
        present = counts[names == names[k]].sum(axis=0) > 0
        if present.all():
            continue
        away = np.hypot(*(estimate.graph.poses[:, :2] - estimate.graph.anchors[k]).T)
        keyframes = ranges.pose[received[ranges.anchor[received] == k]]
        within = away <= np.median(away[keyframes])
        near = np.bincount(recording_of[within], minlength=number)
        rate = within[keyframes].sum() / max(int(near[present].sum()), 1)
        absent = np.flatnonzero(~present & (rate * near >= _EXPECTED))
        first, last = np.flatnonzero(present)[[0, -1]].tolist()
        _note_absence(task, estimate.anchor_ids[k], first, last, absent)
    return estimate


_EXPECTED = 10.0
"""An anchor is absent from a recording that should have so many ranges to it, by other recordings at the same places."""


def _note_absence(task: Task, anchor: str, first: int, last: int, absent: Ints) -> None:
    """Tell of an anchor to which recordings before the first or after the last with ranges (0, 1, ...) should have ranges."""
    before, after = ([int(n) + 1 for n in absent[side]] for side in (absent < first, absent > last))
    if before:
        task.stages.note("new-anchor", anchor=anchor, recording=first + 1, silent=before)
    if after:
        task.stages.note("absent-anchor", anchor=anchor, recording=last + 1, silent=after)
