"""Anchors that are new or were taken away between recordings: some have ranges to them, though others drove in their reach."""

import numpy as np

from ..arrays import Ints
from ..sensor_log.sensors import radio_name
from .estimate import Estimate, Task


def name_new_and_absent_anchors(estimate: Estimate, task: Task) -> Estimate:
    """Warn of anchors with ranges in some recordings alone, though others drove where these have them."""
    ranges = estimate.ranges
    if len(task.recordings) == 1 or ranges is None:
        return estimate
    recording_of, number = task.recordings.of_keyframe, len(task.recordings)
    # Where an anchor was moved, one place follows the other: the move is reported, and the anchor was present all the time.
    names = np.array([radio_name(name) for name in estimate.anchor_ids])
    # A recording with too few ranges to an anchor to place it gives these no weight, but it has them.
    heard = np.flatnonzero(ranges.ranges > 0.0)
    counts = np.zeros((len(names), number), dtype=np.intp)
    np.add.at(counts, (ranges.anchor[heard], recording_of[ranges.pose[heard]]), 1)
    for k in np.flatnonzero(estimate.placed).tolist():
        present = counts[names == names[k]].sum(axis=0) > 0
        if present.all():
            continue
        away = np.hypot(*(estimate.graph.poses[:, :2] - estimate.graph.anchors[k]).T)
        own = ranges.pose[heard[ranges.anchor[heard] == k]]
        within = away <= np.median(away[own])
        near = np.bincount(recording_of[within], minlength=number)
        rate = within[own].sum() / max(int(near[present].sum()), 1)
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
