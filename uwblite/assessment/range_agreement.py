"""Whether the ranges to one anchor agree with the map throughout, and which results depend on them where they do not.

The table of these rules is MapResult.range_table, empty without ranges; its numbers are those of the anchors.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from ..arrays import Bools, Floats, runs_of
from ..findings import WARNING, WHEELS_AGAINST_LIDAR, Finding, doubt, warning
from ..map_result import AnchorEstimate
from ..pipeline.estimate import Task
from ..sensor_log.sensors import first_place, name_and_number
from .facts import check_recordings, spans

DISAGREE = 0.5
"""Share of an anchor's ranges that agree with the map, below which it is distrusted."""
_LEAST_AGREEING = 0.3
"""Least share of ranges that agree with a correct map: where a radio reports every other range as 0, it is 0.4."""
_ENOUGH, _NEAR = 3, 0.3
"""Anchors whose ranges fix the robot's place by themselves, and how near to the map their ranges are then, m: a path that is
half a metre off is not so near to three distances."""
_MOST_NEAR, _MANY_NEAR = 0.85, 0.6
"""Share of all their ranges, and of those in each stretch, even if few, that must be as near. Right maps have 0.9 to
0.96, one of a lidar that saw the floor now and then 0.78, with an error of 0.43 m."""


def outlier_stretches(stamps: Floats, agrees: Bools) -> list[tuple[float, float]]:
    """Return the stretches (first and last stamp, s) in which most of one anchor's readings (m,) disagree with the map.

    Bins of equal counts; fewer than 100 readings show no stretches.
    """
    if len(stamps) < 100:
        return []
    order = np.argsort(stamps, kind="stable")
    bins = np.array_split(order, min(40, len(order) // 20))
    bad = np.array([agrees[b].mean() < 0.4 for b in bins], dtype=bool)
    return [(float(stamps[bins[a][0]]), float(stamps[bins[b - 1][-1]])) for a, b in runs_of(bad) if b - a >= 2]


def check_range_agreement(anchors: Sequence[AnchorEstimate], table: dict[str, Floats], task: Task) -> Iterator[Finding]:
    """Warn of each anchor whose ranges disagree with the map for long; doubt a map that most ranges contradict.

    A line of sight was blocked, or an anchor was moved. Without a lidar, ranges alone determine the path: half of the anchors
    that disagree, or are distrusted, are a doubt as well; with one, where none is left that is neither distrusted nor moved. An
    anchor that was moved counts once.
    """
    placed = [a for a in anchors if a.status != "unplaced"]
    of_place = {a.id: name_and_number(a.id)[0] for a in placed}
    wrong = {of_place[a.id] for a in placed if a.status == "distrusted"}
    moved = {name for name, number in map(name_and_number, of_place) if number > 1}
    none_left = len(wrong | moved) == len(set(of_place.values())) >= _ENOUGH
    for finding in _outliers(anchors, table, task) if table else ():
        yield finding
        wrong |= {of_place[finding.anchor]} if finding.anchor in of_place else set()
    count, agreeing = sum(a.ranges for a in placed), sum(a.used_share * a.ranges for a in placed)
    if agreeing < _LEAST_AGREEING * count:
        text = (
            f"only {agreeing / count:.0%} of the ranges agree with the map: they are not distances to stationary anchors, or "
            "the trajectory is wrong; check the anchors' ids, and the unit and the clock of the radio"
        )
        yield doubt("ranges-disagree", text, share=agreeing / count)
    bad, heard = len(wrong | moved), len(set(of_place.values()))
    if task.recordings.have_scans:
        if none_left and len(task.recordings.each) == 1:
            text = f"all {heard} anchors were moved or are distrusted: likelier, ranges are no distances; check the radio"
            yield doubt("ranges-disagree", text, disagreeing=bad, heard=heard)
    elif (wrong or bad > 1) and 2 * bad >= heard:
        text = (
            f"{bad} of {heard} anchors were moved, disagree for long, or are distrusted, and only ranges and odometry "
            "constrain the trajectory: a wrong one is likelier than so many bad anchors, and the others may be too few; check "
            "the odometry, map the parts before and after separately, or give the anchors' places"
        )
        yield doubt("ranges-disagree", text, disagreeing=bad, heard=heard)


def _outliers(anchors: Sequence[AnchorEstimate], table: dict[str, Floats], task: Task) -> Iterator[Finding]:
    """Warn of each anchor whose ranges disagree with the map for long, recording by recording."""
    for recording in task.recordings.each:
        start = float(recording.frames.stamps[0])
        where = f"recording {recording.number + 1}: " if len(task.recordings) > 1 else ""
        for k, anchor in enumerate(anchors):
            own = (table["anchor"] == k) & (table["weight"] > 0) & (table["recording"] == recording.number)
            stretches = outlier_stretches(table["stamp"][own], table["agrees"][own] > 0.5) if own.any() else []
            if stretches:
                when = spans([(a - start, b - start) for a, b in stretches])
                found = warning(
                    "sustained-outliers",
                    f"{where}anchor {anchor.id} disagrees with the map for long ({when}): its line of sight was blocked, or it "
                    "was moved; these ranges are down-weighted",
                )
                yield replace(found, recording=recording.number + 1, anchor=anchor.id, stretches=tuple(stretches))


def check_wheels_against_lidar(table: dict[str, Floats], anchors: Sequence[AnchorEstimate], task: Task) -> Iterator[Finding]:
    """Doubt a map whose wheels and lidar contradict each other; a warning where the ranges decide for the lidar.

    The map follows the lidar. Ranges to three anchors or more that agree with it, over the recording and in each stretch in
    question, would not agree with a path that the lidar has bent: then only the wheels are wrong. Anchors that seem to have
    been moved are not used: a bent path could have displaced them.
    """
    recorded = check_recordings([recording.log for recording in task.recordings.each])
    against = [finding for finding in recorded if finding.kind == WHEELS_AGAINST_LIDAR]
    used = bool(len(table.get("stamp", ()))) and not any(name_and_number(a.id)[1] > 1 for a in anchors)
    if not against or not used:
        yield from against
        return
    still = np.array([a.status == "ok" and first_place(a.id) == a.id for a in anchors])[table["anchor"].astype(np.intp)]
    stamps, anchor, near = table["stamp"], table["anchor"], np.abs(table["residual"]) < _NEAR
    for finding in against:
        # Clocks of different recordings may show the same times.
        own = table["recording"] == finding.recording - 1
        inside = [own & still & (stamps >= a) & (stamps <= b) for a, b in finding.stretches]
        agree = own.any() and near[own].mean() >= _MOST_NEAR
        if agree and inside and all(len(set(anchor[r].tolist())) >= _ENOUGH and near[r].mean() >= _MANY_NEAR for r in inside):
            text = f"{finding.text}; the ranges agree with the lidar there: check the wheels"
            finding = replace(finding, severity=WARNING, text=text)
        yield finding
