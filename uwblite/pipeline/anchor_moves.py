"""Anchors that were moved during a recording: from that moment on they have a second name.

The detection needs a trajectory, not a map: it is made once odometry and ranges are optimised, and where the lidar has
straightened the trajectory once more, always from the names as recorded. Ranges to places that are wrong bend a trajectory
that odometry alone holds, and the bent one hides moves. So where one anchor was moved, the trajectory is estimated again with
all anchors apart before and after, which presumes nothing of any, and the moves are found on that one.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..findings import WARNING, Finding, warning
from ..radio.change_points import ON_GIVEN_PATH, ON_OWN_PATH, Evidence, Move, find_moves
from ..radio.range_noise import short_term_sigma
from ..radio.trilateration import usable
from ..sensor_log import OdometryBreaks, Screening, SensorLog, UwbRanges
from ..sensor_log.anchor_names import first_place, name_and_number
from .estimate import Estimate, Task
from .radio_stages import first_optimisation
from .recordings import Recording, gather

Moves = dict[str, list[Move]]
"""By the anchor's name as recorded."""


def with_moves_apart(estimate: Estimate, task: Task, logs: Sequence[SensorLog]) -> list[SensorLog] | None:
    """Return the recordings with anchors that were moved under another name from then on; None where the names stay.

    Parameters
    ----------
    logs : the recordings with the names as they were recorded.
    """
    # Of several recordings, one with a lidar holds the anchors that those without one have in common with it.
    given = any(estimate.held_by_scans[recording.rows].mean() >= _MOSTLY for recording in task.recordings.each)
    moves = _moves_of_all(estimate, task, logs, ON_GIVEN_PATH if given else ON_OWN_PATH)
    renamed = [_renamed(log, found) for log, found in zip(logs, moves, strict=True)]
    now = [recording.log.ranges for recording in task.recordings.each]
    same = all(_same(log.ranges, ranges, found) for log, ranges, found in zip(renamed, now, moves, strict=True))
    return None if same else renamed


_MOSTLY = 0.5
"""Share of a recording's keyframes that a lidar must have matched to hold its trajectory: one that sees next to nothing in a
yard matched a tenth of them, and ranges bent the rest."""


def first_with_moves_apart(estimate: Estimate, task: Task, logs: Sequence[SensorLog]) -> list[SensorLog] | None:
    """Return the same after a first optimisation, whose trajectory is bent where anchors were moved."""
    moves = _moves_of_all(estimate, task, logs, ON_OWN_PATH)
    if not any(moves):
        return None
    apart = [_renamed(log, _of_all(log, found)) for log, found in zip(logs, moves, strict=True)]
    said = task.stages.mark()
    estimate, task = optimised_with_names(apart, estimate, task)
    task.stages.back_to(said)
    moves = _moves_of_all(estimate, task, logs, ON_OWN_PATH)
    return [_renamed(log, found) for log, found in zip(logs, moves, strict=True)] if any(moves) else None


def optimised_with_names(renamed: Sequence[SensorLog], estimate: Estimate, task: Task) -> tuple[Estimate, Task]:
    """Return the first optimisation and the task with anchors renamed.

    A recording whose names stay is not bootstrapped again: what it shows alone does not depend on the others.

    Parameters
    ----------
    estimate, task : the first optimisation with other names, and its task.
    """
    before = [recording.log for recording in task.recordings.each]
    alone = estimate.alone or [None] * len(renamed)
    known = [own if alike(log, other) else None for own, log, other in zip(alone, renamed, before, strict=True)]
    task = replace(task, recordings=gather(renamed, task.config.keyframes))
    return first_optimisation(task, known), task


def alike(one: SensorLog, other: SensorLog) -> bool:
    """Return whether two renamings of one recording have the same names, ranges left out and remarks."""
    a, b = one.ranges, other.ranges
    if one is other or a is None or b is None:
        return one is other or a is b
    same_names = a.anchor_ids == b.anchor_ids and np.array_equal(a.anchor, b.anchor)
    return same_names and np.array_equal(a.ranges, b.ranges, equal_nan=True) and _remarks(one) == _remarks(other)


def named_so(task: Task, renamed: Sequence[SensorLog]) -> bool:
    """Return whether a task is that of the recordings with these names."""
    return all(alike(recording.log, log) for recording, log in zip(task.recordings.each, renamed, strict=True))


def short_ranges(estimate: Estimate) -> int:
    """Return how many ranges are shorter than the distance to the anchor's place: wrong poses or names cause many."""
    ranges = estimate.ranges
    return 0 if ranges is None else int(np.sum(ranges.residuals(estimate.graph)[:, 0] * ranges.sigma > SHORT))


SHORT = 0.5
"""m by which no obstacle and no radio makes a range shorter than the distance; errors of the path stay below it."""


def _remarks(log: SensorLog) -> tuple[Finding, ...]:
    return () if log.screening is None else log.screening.findings


def _of_all(log: SensorLog, moves: Moves) -> Moves:
    """Return all moves as moves of all anchors; one of several at about the same time stands for them."""
    every = sorted((move for found in moves.values() for move in found), key=lambda move: move.stamp)
    apart = [m for k, m in enumerate(every) if k == 0 or m.stamp - every[k - 1].stamp > _TOGETHER]
    # The time during which an anchor was carried is known for this anchor only.
    apart = [replace(move, left=move.stamp) for move in apart]
    return {} if log.ranges is None else dict.fromkeys(log.ranges.anchor_ids, apart)


_TOGETHER = 30.0
"""Moves within so much of each other are taken for one, s."""


def _same(a: UwbRanges | None, b: UwbRanges | None, moves: Moves) -> bool:
    """Return whether ranges have the same names and the same ones are left out, but for a few at each move."""
    if a is None or b is None:
        return True
    differ = np.asarray(a.anchor_ids)[a.anchor] != np.asarray(b.anchor_ids)[b.anchor]
    differ |= (a.ranges > 0.0) != (b.ranges > 0.0)
    return int(differ.sum()) <= _FEW * sum(map(len, moves.values()))


_FEW = 2
"""Ranges by which a moment may be off."""


def _moves_of_all(estimate: Estimate, task: Task, logs: Sequence[SensorLog], needed: Evidence) -> list[Moves]:
    each = zip(task.recordings.each, logs, strict=True)
    return [_moves(recording, log, estimate, task, needed) for recording, log in each]


def _moves(recording: Recording, log: SensorLog, estimate: Estimate, task: Task, needed: Evidence) -> Moves:
    """Return the moves of the anchors of a recording, by their names as recorded (log)."""
    edges, ranges = estimate.ranges, log.ranges
    if ranges is None or edges is None or estimate.bootstrap is None:
        return {}
    # The recording's ranges stand in the edges in their own order; some may have been left out there.
    edges = replace(edges.rows(recording.has(edges.pose)), ranges=ranges.ranges)
    positions = edges.tag_positions(estimate.graph.poses)
    sound = usable(edges.ranges, task.config.trilateration)
    sigma = short_term_sigma(edges.stamps[sound], edges.anchor[sound], edges.ranges[sound], task.config.ranges)
    moves = {}
    for k, name in enumerate(ranges.anchor_ids):
        own = np.flatnonzero((ranges.anchor == k) & sound)
        at, stamps, level = positions[own], edges.stamps[own], edges.rows(own).planar_ranges()
        found = find_moves(at, level, stamps, sigma, task.config.trilateration, needed)
        if found:
            moves[name] = found
    return moves


def said_of_places(task: Task, names: Sequence[str]) -> list[SensorLog]:
    """Return the recordings without remarks about places that are not in the map: these were joined with earlier ones.

    Parameters
    ----------
    names : the map's anchors. Remarks about ranges left out because the anchor was being carried are kept.
    """
    places = {first_place(name) for name in names}
    return [_said_of(recording.log, places) for recording in task.recordings.each]


def _said_of(log: SensorLog, places: set[str]) -> SensorLog:
    if log.screening is None:
        return log
    said = []
    for remark in log.screening.findings:
        if not remark.anchor or remark.anchor in places:
            said.append(remark)
        elif remark.cure:
            said.append(warning("sustained-outliers", remark.cure))
    return replace(log, screening=replace(log.screening, findings=tuple(said)))


def _renamed(log: SensorLog, moves: Moves) -> SensorLog:
    """Return a recording with the ranges of moved anchors under another name from each move on, and remarks that say so.

    Readings made while an anchor was carried are set to 0, which is no distance.
    """
    ranges = log.ranges
    if ranges is None or not moves:
        return log
    names = np.asarray(ranges.anchor_ids)[ranges.anchor].astype(object)
    measured, heights = ranges.ranges.copy(), dict(log.mounting.anchor_heights)
    remarks: list[Finding] = []
    for name, found in moves.items():
        base, number = name_and_number(name)
        own = names == name
        for move in found:
            number += 1
            other = f"{base}@{number}"
            names[own & (ranges.stamps >= move.stamp)] = other
            if name in heights:
                heights[other] = heights[name]
            carried = own & (ranges.stamps >= move.left) & (ranges.stamps < move.stamp)
            measured[carried] = 0.0
            start, end = (moment - log.odometry.stamps[0] for moment in (move.left, move.stamp))
            when = f"between t = {start:.0f} and {end:.0f} s" if carried.any() else f"at about t = {end:.0f} s"
            less, without = "", ""
            if carried.any():
                less = f" (its {carried.sum()} ranges meanwhile were left out)"
                without = f"anchor {name} seemed to be moved by {move.distance:.1f} m {when}{less}: {_SAME}"
            text = f"anchor {name} was moved by {move.distance:.1f} m {when}{less}; from then on it is called {other}"
            remarks.append(Finding("moved-anchor", WARNING, text, without, anchor=other))
    ids, anchor = np.unique(names.astype(str), return_inverse=True)
    before = log.screening or Screening((), OdometryBreaks.none())
    return replace(
        log,
        ranges=replace(ranges, ranges=measured, anchor=anchor.astype(np.intp), anchor_ids=tuple(ids.tolist())),
        mounting=replace(log.mounting, anchor_heights=heights),
        screening=replace(before, findings=(*before.findings, *remarks)),
    )


_SAME = "both places are the same within their uncertainty"
