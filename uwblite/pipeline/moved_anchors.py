"""Anchors that were moved, added or taken away between recordings, found once all poses are known well."""

from dataclasses import replace

import numpy as np

from ..arrays import Floats, Ints
from ..graph.calibration import BIAS
from ..graph.graph import Graph
from ..graph.marginals import marginals
from ..graph.optimizer import Optimizer
from ..graph.robust import Kernel
from ..graph.solver import SolverConfig
from ..radio.range_measurements import learn_noise
from ..radio.range_noise import RangeNoiseConfig
from ..sensor_log.anchor_names import numbered, radio_name
from .estimate import Estimate, Task
from .joining import warn_of_moved_anchor
from .lidar_stages import refine_jointly

_LEAST_MOVE = 0.25
"""An anchor that two recordings see nearer together than this was not moved, m."""
_MOVED = 20.0
"""Squared Mahalanobis distance between two recordings' places of an anchor from which on it was moved (2 degrees of
freedom; 5e-5 by chance, the rest for errors that the sigmas leave out)."""


def separate_moved_anchors(estimate: Estimate, task: Task) -> Estimate:
    """Give anchors that were moved between recordings a place of their own, once the poses are known well.

    With the poses fixed, every recording's ranges determine where each anchor stood then; places whose distance their
    uncertainty does not explain are not the same. Where one was moved, the joint refinement is done again.
    """
    if len(task.recordings) == 1 or estimate.ranges is None or estimate.bootstrap is None:
        return estimate
    recording_of = task.recordings.of_keyframe[estimate.ranges.pose]
    place, covariance, pairs = _places_by_recording(estimate, recording_of, task.config.solver, task.config.ranges)
    ids, anchors, anchor = list(estimate.anchor_ids), estimate.graph.anchors.copy(), estimate.ranges.anchor.copy()
    source = list(range(len(ids)))
    moved = False
    for k, name in enumerate(estimate.anchor_ids):
        rows = np.flatnonzero(pairs[:, 0] == k).tolist()
        number_of = dict.fromkeys(rows[:1], k)
        for row in rows[1:]:
            recording = int(pairs[row, 1])
            same = [n for r, n in number_of.items() if not _differ(place[row] - place[r], covariance[row] + covariance[r])]
            if not same:
                ids.append(numbered(name, recording))
                source.append(k)
                anchors = np.vstack([anchors, place[row]])
            number_of[row] = same[0] if same else len(ids) - 1
            if number_of[row] != k:
                moved = True
                anchor[(estimate.ranges.anchor == k) & (recording_of == recording)] = number_of[row]
                off = float(np.hypot(*(place[row] - place[rows[0]])))
                warn_of_moved_anchor(task, name, off, recording, ids[number_of[row]])
    if not moved:
        return estimate
    found = estimate.bootstrap
    found = replace(
        found, placed=found.placed[source], ambiguous=found.ambiguous[source],
        hypotheses=tuple(found.hypotheses[k] if n < len(estimate.anchor_ids) else () for n, k in enumerate(source)),
    )  # fmt: skip
    graph = replace(estimate.graph, anchors=anchors, fixed_anchors=~found.placed)
    ranges = replace(estimate.ranges, anchor=anchor)
    return refine_jointly(replace(estimate, graph=graph, ranges=ranges, bootstrap=found, anchor_ids=tuple(ids)), task)


def _differ(off: Floats, covariance: Floats) -> bool:
    return bool(np.hypot(*off) > _LEAST_MOVE and off @ np.linalg.solve(covariance, off) > _MOVED)


def _places_by_recording(
    estimate: Estimate, recording_of: Ints, solver: SolverConfig, noise: RangeNoiseConfig
) -> tuple[Floats, Floats, Ints]:
    """Return place (p, 2), covariance (p, 2, 2) and (anchor, recording) of each anchor in each recording."""
    ranges, graph = estimate.ranges, estimate.graph
    assert ranges is not None
    alive = np.flatnonzero(ranges.alive & estimate.placed[ranges.anchor])
    pairs, which = np.unique(np.stack([ranges.anchor[alive], recording_of[alive]], axis=1), axis=0, return_inverse=True)
    alone = Graph(
        graph.poses, graph.anchors[pairs[:, 0]], graph.calibration_priors, graph.calibration,
        fixed_poses=np.ones(len(graph.poses), dtype=bool),
        fixed_calibration=graph.fixed_calibration | ~graph.calibration.of_kinds(BIAS),
    )  # fmt: skip
    # Outliers of the joint map may be of an anchor that was moved: first all ranges count alike.
    alike = np.ones(len(alive))
    edges = replace(ranges.rows(alive), anchor=which.reshape(-1).astype(np.int64), kernel=Kernel("cauchy", 2.5), weights=alike)
    optimizer = Optimizer()
    edges, _ = learn_noise(edges, optimizer.optimize(alone.with_edges(edges), solver)[0], len(pairs), noise)
    solved = optimizer.optimize(alone.with_edges(edges), solver)[0]
    return solved.anchors, marginals(solved).anchors, pairs


def name_new_and_absent_anchors(estimate: Estimate, task: Task) -> Estimate:
    """Warn of anchors with ranges in some recordings alone, though others drove where these have them."""
    ranges = estimate.ranges
    if len(task.recordings) == 1 or ranges is None:
        return estimate
    recording_of, number = task.recordings.of_keyframe, len(task.recordings)
    # Where an anchor was moved, one place follows the other: that is reported, and the anchor has ranges all the time.
    names = np.array([radio_name(name) for name in estimate.anchor_ids])
    alive = np.flatnonzero(ranges.alive)
    counts = np.zeros((len(names), number), dtype=np.int64)
    np.add.at(counts, (ranges.anchor[alive], recording_of[ranges.pose[alive]]), 1)
    for k in np.flatnonzero(estimate.placed).tolist():
        present = counts[names == names[k]].sum(axis=0) > 0
        if present.all():
            continue
        away = np.hypot(*(estimate.graph.poses[:, :2] - estimate.graph.anchors[k]).T)
        own = ranges.pose[alive[ranges.anchor[alive] == k]]
        within = away <= np.median(away[own])
        near = np.bincount(recording_of[within], minlength=number)
        rate = within[own].sum() / max(int(near[present].sum()), 1)
        absent = np.flatnonzero(~present & (rate * near >= _EXPECTED))
        first, last = np.flatnonzero(present)[[0, -1]].tolist()
        _warn_of_absence(task, estimate.anchor_ids[k], first, last, absent)
    return estimate


_EXPECTED = 10.0
"""Ranges to an anchor that a recording should have, by those of others from the same places, for their absence to count."""


def _warn_of_absence(task: Task, anchor: str, first: int, last: int, absent: Ints) -> None:
    """Warn of an anchor to which recordings before the first or after the last with ranges (0, 1, ...) should have ranges."""
    before, after = ([int(n) + 1 for n in absent[side]] for side in (absent < first, absent > last))
    if before:
        task.stages.warn(
            "new-anchor",
            f"anchor {anchor} has ranges only from recording {first + 1} on: {_drove_there(before)}, so it is new or was off",
            anchor=anchor, recording=first + 1, silent=before,
        )  # fmt: skip
    if after:
        task.stages.warn(
            "absent-anchor",
            f"anchor {anchor} has no ranges after recording {last + 1}: {_drove_there(after)}, so it was taken away "
            "or is off",
            anchor=anchor, recording=last + 1, silent=after,
        )  # fmt: skip


def _drove_there(numbers: list[int]) -> str:
    """Return which recordings drove within reach of an anchor without hearing it."""
    which = ", ".join(map(str, numbers))
    return f"recording{'s' if len(numbers) > 1 else ''} {which} drove within its reach without hearing it"
