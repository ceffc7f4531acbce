"""Recordings of which it is not sure that they are of one place: most of their common anchors stand elsewhere."""

from collections.abc import Iterator

import numpy as np

from ..findings import Finding, doubt
from ..pipeline.estimate import Estimate, Task
from ..sensor_log.anchor_names import radio_name


def check_untied_recordings(estimate: Estimate, task: Task) -> Iterator[Finding]:
    """Doubt a recording that has hardly more anchors where the others have them than elsewhere, and no closure with these.

    Where anchors disagree, which of them were moved is a majority's word, and two that agree by chance are no majority: the
    recording may as well be of another place with anchors of the same names.
    """
    recordings, ranges, names = task.recordings, estimate.ranges, estimate.anchor_ids
    if len(recordings.each) == 1 or ranges is None:
        return
    alive = ranges.rows(np.flatnonzero(ranges.alive))
    counts = np.zeros((len(recordings.each), len(names)), dtype=np.intp)
    np.add.at(counts, (recordings.of_keyframe[alive.pose], alive.anchor), 1)
    heard = (counts >= _HEARD) & estimate.placed
    radio = np.array([radio_name(name) for name in names])
    ends = recordings.of_keyframe[np.stack([estimate.closures.edges.i, estimate.closures.edges.j])]
    # Of two that contradict each other, the second is named.
    for recording in recordings.each[1 if len(recordings.each) == 2 else 0 :]:
        n, others = recording.number, np.delete(heard, recording.number, axis=0).any(axis=0)
        same = heard[n] & others
        moved = np.setdiff1d(np.intersect1d(radio[heard[n]], radio[others]), radio[same])
        tied = np.any((ends == n).any(axis=0) & (ends[0] != ends[1]))
        if len(moved) and int(same.sum()) - len(moved) < _MAJORITY and not tied:
            yield doubt(
                "untied-parts",
                f"{recording.name} has {int(same.sum())} anchors where the others have them and {len(moved)} elsewhere "
                f"({', '.join(moved.tolist())}), and no loop closure with them: it may lie elsewhere, or be of another place; "
                "record where both were, or map it alone",
                recording=n + 1, moved=moved.tolist(),
            )  # fmt: skip


_HEARD = 3
"""Ranges of a recording to an anchor from which on it says where that is."""
_MAJORITY = 2
"""More anchors that agree than do not, for those that agree to be the ones that were not moved."""
