"""Anchors that were moved, added or taken away between recordings, found once all poses are known well."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ..arrays import Floats, Ints
from ..graph.calibration import BIAS, RADIO, with_free
from ..graph.graph import Graph
from ..graph.marginals import marginals
from ..graph.optimizer import Optimizer
from ..graph.robust import Kernel
from ..graph.solver import SolverConfig
from ..radio.range_measurements import learn_noise
from ..radio.range_noise import RangeNoiseConfig
from ..sensor_log.anchor_names import first_place, numbered, radio_name
from .estimate import Estimate, Task
from .joining import warn_of_moved_anchor
from .lidar_stages import solved
from .radio_stages import with_range_noise

_LEAST_MOVE = 0.25
"""An anchor whose places in two recordings are nearer to each other than this was not moved, m."""
_TOLERANCE = 0.5
"""How far places of one anchor with two names may lie apart beyond their sigmas, m; NLOS and biases are not yet known well."""
_MOVED = 20.0
"""Squared Mahalanobis distance between two recordings' places of an anchor from which on it was moved (2 degrees of
freedom; 5e-5 by chance, the rest for errors that the sigmas leave out)."""


def separate_moved_anchors(estimate: Estimate, task: Task) -> Estimate:
    """Give anchors that were moved between recordings several places, and all others one place, once poses are known well.

    With the poses fixed, every recording's ranges determine where each anchor stood then; places are different where their
    uncertainty does not explain their distance. Before joining, one recording may have had an anchor's mirror image: such
    an anchor was not moved, if its places are now within a tolerance. Ranges have little weight so far beside the
    lidar: a wrong anchor does not bend the trajectory yet, and all is solved once, with the resulting names.
    """
    if len(task.recordings) == 1 or estimate.ranges is None or estimate.bootstrap is None:
        return estimate
    recording_of = task.recordings.of_keyframe[estimate.ranges.pose]
    place, covariance, pairs = _places_by_recording(estimate, recording_of, task.config.solver, task.config.ranges)
    ids, anchors, anchor = list(estimate.anchor_ids), estimate.graph.anchors.copy(), estimate.ranges.anchor.copy()
    source = list(range(len(ids)))
    first = np.array([ids.index(name) for name in map(_first_of(ids, task), ids)], dtype=np.intp)
    sigma = np.sqrt(np.trace(covariance, axis1=1, axis2=2)).tolist()
    task.stages.withdraw("moved-anchor", "new_id")
    for k in np.unique(first).tolist():
        rows = np.flatnonzero(first[pairs[:, 0]] == k)
        rows = rows[np.argsort(pairs[rows, 1], kind="stable")].tolist()
        number_of: dict[int, int] = {}
        for row in rows:
            named, recording = pairs[row].tolist()
            same = [
                n for r, n in number_of.items() if not _differ(place[row] - place[r], covariance[row] + covariance[r])
                and (pairs[r, 0] == named or np.hypot(*(place[row] - place[r])) <= _tolerance(sigma[row], sigma[r]))
            ]  # fmt: skip
            number = same[0] if same else named if number_of else k
            if not same and number in number_of.values():
                number = len(ids)
                ids.append(numbered(ids[k], recording))
                source.append(k)
                anchors = np.vstack([anchors, place[row]])
            elif not same and number != named:
                anchors[number] = place[row]
            number_of[row] = number
            anchor[(estimate.ranges.anchor == named) & (recording_of == recording)] = number
            if number != number_of[rows[0]]:
                off = float(np.hypot(*(place[row] - place[rows[0]])))
                warn_of_moved_anchor(task, ids[number_of[rows[0]]], off, recording, ids[number])
    if np.array_equal(anchor, estimate.ranges.anchor):
        return estimate
    found, kept = estimate.bootstrap, [n for n in range(len(ids)) if n >= len(first) or first[n] == n or np.any(anchor == n)]
    fresh = [source[n] for n in kept]
    found = replace(
        found, placed=found.placed[fresh], ambiguous=found.ambiguous[fresh],
        hypotheses=tuple(found.hypotheses[source[n]] if n < len(first) else () for n in kept),
    )  # fmt: skip
    graph = replace(estimate.graph, anchors=anchors[kept], fixed_anchors=~found.placed)
    ranges = replace(estimate.ranges, anchor=np.searchsorted(kept, anchor))
    names = tuple(ids[n] for n in kept)
    graph = with_free(graph, *RADIO)
    return _solved_again(replace(estimate, graph=graph, ranges=ranges, bootstrap=found, anchor_ids=names), task)


def _solved_again(estimate: Estimate, task: Task) -> Estimate:
    """Return the optimum, or the start for it after a joint refinement, with ranges assigned to other anchors than before.

    It starts at the place from all ranges of an anchor: from the place of one recording, ranges of others look like outliers.
    """
    assert estimate.ranges is not None
    together = np.zeros(len(estimate.ranges), dtype=np.intp)
    place, _, pairs = _places_by_recording(estimate, together, task.config.solver, task.config.ranges)
    anchors = estimate.graph.anchors.copy()
    anchors[pairs[:, 0]] = place
    estimate = replace(estimate, graph=replace(estimate.graph, anchors=anchors))
    # After a joint refinement all is solved in any case.
    return solved(with_range_noise(estimate, task.config), task.config.solver) if estimate.joint is None else estimate


def _tolerance(one: float, other: float) -> float:
    """Return how far two places of one anchor with these standard deviations may lie apart, m."""
    return _TOLERANCE + 2.0 * float(np.hypot(one, other))


def _first_of(ids: Sequence[str], task: Task) -> Callable[[str], str]:
    """Return what gives for the name of a place that of the anchor's first one; itself where the user names such places."""
    given = {a.id for a in task.given.anchors} | {name for d in task.given.distances for name in d.anchors}
    if any(name != first_place(name) for name in given):
        return str
    return lambda name: first_place(name) if first_place(name) in ids else name


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
    # Outliers of the joint map may be of an anchor that was moved: first all ranges have the same weight.
    alike = np.ones(len(alive))
    edges = replace(ranges.rows(alive), anchor=which.reshape(-1).astype(np.intp), kernel=Kernel("cauchy", 2.5), weights=alike)
    optimizer = Optimizer()
    edges, _ = learn_noise(edges, optimizer.optimize(alone.with_edges(edges), solver)[0], len(pairs), noise)
    solved = optimizer.optimize(alone.with_edges(edges), solver)[0]
    return solved.anchors, marginals(solved).covariances.anchors, pairs


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
        _warn_of_absence(task, estimate.anchor_ids[k], first, last, absent)
    return estimate


_EXPECTED = 10.0
"""An anchor is absent from a recording that should have so many ranges to it, by other recordings at the same places."""


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
    """Return which recordings passed within reach of an anchor but have no ranges to it."""
    which = ", ".join(map(str, numbers))
    return f"recording{'s' if len(numbers) > 1 else ''} {which} drove within its reach without hearing it"
