"""Test whether the ranges to one anchor agree with the map throughout, and which results depend on them where they do not."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from ..arrays import Bools, Floats, runs_of
from ..findings import WARNING, WHEELS_AGAINST_LIDAR, Finding, doubt, warning
from ..map_result import AnchorEstimate
from ..pipeline.estimate import Task
from ..sensor_log.sensors import first_place, name_and_number
from .repairs import check_recordings


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


def check_sustained_outliers(table: dict[str, Floats], anchor_ids: Sequence[str], task: Task) -> Iterator[Finding]:
    """Warn of each anchor whose ranges disagree with the map for long: its line of sight was blocked, or it was moved.

    Without a lidar, ranges alone determine the path: where half of the anchors disagree for long, that is a doubt.

    Parameters
    ----------
    table : MapResult.range_table. anchor_ids : names.
    """
    several = len(task.recordings) > 1
    for recording in task.recordings.each:
        start, where = float(recording.frames.stamps[0]), f"recording {recording.number + 1}: " if several else ""
        heard = wrong = 0
        for k, name in enumerate(anchor_ids):
            own = (table["anchor"] == k) & (table["weight"] > 0) & (table["recording"] == recording.number)
            stretches = outlier_stretches(table["stamp"][own], table["agrees"][own] > 0.5) if own.any() else []
            heard, wrong = heard + bool(own.any()), wrong + bool(stretches)
            if stretches:
                when = ", ".join(f"{a - start:.0f} to {b - start:.0f} s" for a, b in stretches[:4])
                yield warning(
                    "sustained-outliers",
                    f"{where}anchor {name} disagrees with the map for long (t = {when}{' ...' if len(stretches) > 4 else ''}): "
                    "its line of sight was blocked, or it was moved; these ranges are down-weighted",
                    anchor=name,
                    stretches=stretches,
                )
        if wrong and 2 * wrong >= heard and not recording.has_scans:
            text = (
                f"{where}{wrong} of {heard} anchors disagree with the map for long, and only ranges and odometry constrain the "
                "path: the others may be too few; map the parts before and after separately, or give the anchors' places"
            )
            yield doubt("ranges-disagree", text, disagreeing=wrong, heard=heard)


def check_wheels_against_lidar(table: dict[str, Floats], anchors: Sequence[AnchorEstimate], task: Task) -> Iterator[Finding]:
    """Doubt a map whose wheels and lidar contradict each other; a warning where the ranges decide for the lidar.

    The map follows the lidar. Ranges to three anchors or more that agree with it, over the recording and in each stretch in
    question, would not agree with a path that the lidar has bent: then only the wheels are wrong. Anchors that seem to have
    been moved are not used: a bent path could have displaced them.

    Parameters
    ----------
    table : MapResult.range_table; empty without ranges. anchors : in the order of its numbers.
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
        if agree and all(len(set(anchor[r].tolist())) >= _ENOUGH and near[r].mean() >= _MANY_NEAR for r in inside):
            text = f"{finding.text}; the ranges agree with the lidar there: check the wheels"
            finding = replace(finding, severity=WARNING, text=text)
        yield finding


_ENOUGH, _NEAR = 3, 0.3
"""Anchors whose ranges fix the robot's place by themselves, and how near to the map their ranges are then, m: a path that is
half a metre off is not so near to three distances."""
_MOST_NEAR, _MANY_NEAR = 0.85, 0.6
"""Share of all their ranges, and of those in each stretch, even if few, that must be as near. Right maps have 0.9 to
0.96, one of a lidar that saw the floor now and then 0.78, with an error of 0.43 m."""
