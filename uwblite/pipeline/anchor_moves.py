"""Anchors that were moved while they were heard: from that moment on they have a second name.

The detection needs a trajectory, not a map: it is made once odometry and ranges are optimised, and where the lidar has
straightened the trajectory once more. The recording's ranges are then renamed, and its map begins again.
"""

from dataclasses import replace

import numpy as np

from ..radio.change_points import Move, find_move
from ..radio.range_noise import short_term_sigma
from ..sensor_log import OdometryBreaks, Remark, Screening, SensorLog, UwbRanges
from .estimate import Estimate, Task
from .recordings import Recording


def with_moves_apart(estimate: Estimate, task: Task) -> list[SensorLog] | None:
    """Return the recordings with anchors that were moved under a second name from then on; None where none was moved."""
    logs = [_renamed_log(recording, estimate, task) for recording in task.recordings.each]
    same = all(log is recording.log for log, recording in zip(logs, task.recordings.each, strict=True))
    return None if same else logs


def _renamed_log(recording: Recording, estimate: Estimate, task: Task) -> SensorLog:
    log, edges = recording.log, estimate.ranges
    ranges = heard_by = log.ranges
    if ranges is None or heard_by is None or edges is None or estimate.bootstrap is None:
        return log
    # The recording's ranges stand in the edges in their own order.
    heard = np.flatnonzero((edges.pose >= recording.rows.start) & (edges.pose < recording.rows.stop))
    positions = edges.tag_positions(estimate.graph.poses)
    usable = np.isfinite(edges.ranges) & (edges.ranges > _SHORTEST) & (edges.ranges < task.config.trilateration.max_range)
    sigma = short_term_sigma(edges.stamps[usable], edges.anchor[usable], edges.ranges[usable], task.config.ranges)
    remarks: list[Remark] = []
    start = float(log.odometry.stamps[0])
    for k, name in enumerate(recording.anchor_ids):
        own = heard[(heard_by.anchor == k) & usable[heard]]
        level = np.sqrt(np.maximum(edges.ranges[own] ** 2 - edges.height[own] ** 2, 1e-4))
        move = find_move(positions[own], level, edges.stamps[own], sigma, task.config.trilateration)
        if move is not None:
            ranges, other = _renamed(ranges, name, move)
            text = (
                f"anchor {name} was moved by {move.distance:.1f} m at about t = {move.stamp - start:.0f} s; from then on it is "
                f"called {other}"
            )
            remarks.append(Remark("moved-anchor", text))
    if not remarks:
        return log
    told_heights = log.mounting.anchor_heights
    known = {name: name_and_number(name)[0] for name in ranges.anchor_ids if name_and_number(name)[0] in told_heights}
    heights = {**{name: told_heights[base] for name, base in known.items()}, **told_heights}
    before = log.screening or Screening((), OdometryBreaks.none())
    screening = replace(before, remarks=(*before.remarks, *remarks))
    return replace(log, ranges=ranges, mounting=replace(log.mounting, anchor_heights=heights), screening=screening)


_SHORTEST = 0.02
"""Shorter readings are no distances, m."""


def name_and_number(name: str) -> tuple[str, int]:
    """Return the radio's name of an anchor and which of its places is meant: ``ID`` is the first, ``ID@2`` the second ..."""
    base, mark, number = name.rpartition("@")
    return (base, int(number)) if mark and number.isdigit() else (name, 1)


def _renamed(ranges: UwbRanges, name: str, move: Move) -> tuple[UwbRanges, str]:
    """Return the ranges with those of an anchor from a moment on under a new name, and that name."""
    base = name_and_number(name)[0]
    number = 1 + max(n for b, n in map(name_and_number, ranges.anchor_ids) if b == base)
    other = f"{base}@{number}"
    names = np.array([*ranges.anchor_ids, other])[ranges.anchor].astype(object)
    names[(names == name) & (ranges.stamps >= move.stamp)] = other
    ids, anchor = np.unique(names.astype(str), return_inverse=True)
    return replace(ranges, anchor=anchor.astype(np.int64), anchor_ids=tuple(ids.tolist())), other
