"""Many recordings in one graph: anchors have ids, so recordings of other days and robots share a frame.

Each recording is bootstrapped on its own. The anchors that two have in common then give the pose of one in the frame of
the other; one that was moved in between does not join in, gets a place of its own for each recording (``5C0B`` and
``5C0B#2``) and is named. Poses, wheels and ranges of all recordings become one graph with one numbering of poses.
Systematic errors of odometry, tag and ranges stay each recording's own, see calibration.unknowns.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, Ints
from ..errors import DataError
from ..graph import calibration
from ..graph.graph import Calibration, Graph, PriorEdges
from ..graph.marginals import marginals
from ..graph.pose_edges import OdometryEdges
from ..graph.range_edges import RangeEdges
from ..radio.bootstrap_attempt import BootstrapResult
from ..radio.trilateration import AnchorHypothesis
from ..sensor_log.anchor_names import first_place, numbered, radio_name
from .constraint_edges import consensus
from .estimate import Estimate, Task
from .recordings import Recording, Recordings

_FIRST_TOLERANCE = 0.5
"""How far first estimates of one anchor may lie apart beyond their sigmas, m; NLOS and biases are not yet known well."""
_MOST_VARIANCE = 25.0
"""m^2; an anchor whose first place is less sure, or open, still has to lie within some metres to join in."""


def join(estimates: Sequence[Estimate], task: Task) -> Estimate:
    """Bring all recordings into the frame of the first, by the anchors they have in common, and make them one graph.

    Recordings join in the order of how many anchors they share with those already in, so that a third may link two.

    Parameters
    ----------
    estimates : of each recording, in its own frame and numbering.
    task : takes a warning for each anchor that was moved.

    Raises
    ------
    DataError : a recording shares fewer than two placed anchors with the others.
    """
    recordings = task.recordings
    found = [_places(estimate) for estimate in estimates]
    placed = dict(found[0])
    motions = [np.zeros(3) for _ in estimates]
    names = [list(estimate.anchor_ids) for estimate in estimates]
    waiting = list(range(1, len(estimates)))
    while waiting:
        number = max(waiting, key=lambda n: (len(found[n].keys() & placed.keys()), -n))
        motions[number], moved = _laid_on(found[number], placed, recordings.each[number])
        waiting.remove(number)
        for k, name in enumerate(names[number]):
            here, spread = found[number].get(name, (None, 0.0))
            if here is None:
                continue
            here = se2.transform(motions[number], here)
            if name in moved:
                names[number][k] = _other_name(name, here, spread, number, placed)
                warn_of_moved_anchor(task, name, moved[name], number, names[number][k])
            placed.setdefault(names[number][k], (here, spread))
    return _one_graph(estimates, motions, names, recordings)


def warn_of_moved_anchor(task: Task, anchor: str, distance: float, recording: int, new_id: str) -> None:
    """Warn that an anchor stands elsewhere in a recording (0, 1, ...) than before, by a distance, m."""
    task.stages.warn(
        "moved-anchor",
        f"anchor {anchor} was moved: in recording {recording + 1} it stands {distance:.2f} m away, and is called {new_id}",
        anchor=anchor, distance=round(distance, 4), recording=recording + 1, new_id=new_id,
    )  # fmt: skip


def _other_name(name: str, here: Floats, spread: float, number: int, placed: dict[str, tuple[Floats, float]]) -> str:
    """Return what to call an anchor that does not stand at its first place: as a recording that found it here does."""
    for other, (place, sigma) in placed.items():
        if radio_name(other) == radio_name(name) and np.hypot(*(place - here)) < tolerance(spread, sigma):
            return other
    return numbered(name, number)


def tolerance(one: float, other: float) -> float:
    """Return how far two first places of one anchor with these standard deviations may lie apart, m."""
    return _FIRST_TOLERANCE + 2.0 * float(np.hypot(one, other))


def _places(estimate: Estimate) -> dict[str, tuple[Floats, float]]:
    """Return place (2,) and standard deviation (m) of the unambiguous anchors; of all placed if these are few."""
    if estimate.bootstrap is None:
        return {}
    placed = np.flatnonzero(estimate.placed & ~estimate.bootstrap.ambiguous)
    if len(placed) < 2:
        placed = np.flatnonzero(estimate.placed)
    spread = marginals(estimate.graph.with_edges(*estimate.odometry_and_ranges)).covariances.anchors
    return {
        estimate.anchor_ids[k]: (estimate.graph.anchors[k], float(np.sqrt(np.clip(np.trace(spread[k]), 0.0, _MOST_VARIANCE))))
        for k in placed
    }


def _laid_on(
    found: dict[str, tuple[Floats, float]], placed: dict[str, tuple[Floats, float]], recording: Recording
) -> tuple[Floats, dict[str, float]]:
    """Return the motion (3,) of a recording into the common frame, and the anchors that do not join in, with how far off."""
    common = sorted(found.keys() & placed.keys())
    if len(common) < 2:
        raise DataError(
            f"{recording.name} shares {len(common)} placed anchors with the others ({', '.join(common) or 'none'}); two "
            "or more are needed to bring it into their frame: map it alone, or record where common anchors are in reach"
        )
    here, there = (np.array([side[name][0] for name in common]) for side in (found, placed))
    most = np.array([tolerance(found[name][1], placed[name][1]) for name in common])
    motion = consensus(here, there, most)
    off = np.hypot(*(se2.transform(motion, here) - there).T)
    return motion, {name: float(d) for name, d, limit in zip(common, off, most, strict=True) if d > limit}


def _one_graph(
    estimates: Sequence[Estimate], motions: Sequence[Floats], names: Sequence[Sequence[str]], recordings: Recordings
) -> Estimate:
    """Make the estimates one, each moved by its motion, its anchors under the given names."""
    # Second places stand last: they may be found to be none, and what the user gives is counted by number.
    ids = tuple(sorted(dict.fromkeys(name for own in names for name in own), key=lambda name: name != first_place(name)))
    place = [np.array([ids.index(name) for name in own], dtype=np.int64) for own in names]
    block, priors, fixed, at = _one_calibration([estimate.graph for estimate in estimates])
    poses = np.concatenate([se2.compose(m, estimate.graph.poses) for m, estimate in zip(motions, estimates, strict=True)])
    joined = _one_bootstrap(estimates, motions, place, len(ids))
    anchors = np.zeros((len(ids), 2))
    for estimate, motion, own in zip(reversed(estimates), reversed(motions), reversed(place), strict=True):
        placed = estimate.placed
        anchors[own[placed]] = se2.transform(motion, estimate.graph.anchors[placed])
    unplaced = np.zeros(len(ids), dtype=bool) if joined is None else ~joined.placed
    graph = Graph(poses, anchors, (priors,), block, fixed_anchors=unplaced, fixed_calibration=fixed)
    return replace(
        estimates[0], graph=graph, odometry=_one_odometry([e.odometry for e in estimates], at, recordings),
        ranges=_one_ranges([e.ranges for e in estimates], at, place, recordings), bootstrap=joined, anchor_ids=ids,
    )  # fmt: skip


def _one_calibration(graphs: Sequence[Graph]) -> tuple[Calibration, PriorEdges, Bools, list[Ints]]:
    """Return the block of all recordings' unknowns, its priors, which are fixed, and where each graph's are in it."""
    keyed = [[calibration.of_recording(key, n) for key in graph.calibration.keys] for n, graph in enumerate(graphs)]
    keys = tuple(dict.fromkeys(key for own in keyed for key in own))
    block, place = Calibration(keys, np.zeros(len(keys))), {key: k for k, key in enumerate(keys)}
    at = [np.array([place[key] for key in own], dtype=np.int64) for own in keyed]
    values, roots, fixed = block.values, np.zeros((len(keys), 1, 1)), np.ones(len(keys), dtype=bool)
    for graph, own in zip(reversed(graphs), reversed(at), strict=True):
        fixed[own] &= graph.fixed_calibration
        values[own] = graph.calibration.values
        for priors in graph.calibration_priors:
            roots[own[priors.index]] = priors.sqrt_information
    return block, PriorEdges("calibration", np.arange(len(keys)), np.zeros((len(keys), 1)), roots), fixed, at


def _one_bootstrap(
    estimates: Sequence[Estimate], motions: Sequence[Floats], place: Sequence[Ints], anchors: int
) -> BootstrapResult | None:
    """Return the bootstraps as one: an anchor that one recording shows clearly is clear."""
    placed, clear = np.zeros(anchors, dtype=bool), np.zeros(anchors, dtype=bool)
    hypotheses: list[tuple[AnchorHypothesis, ...]] = [()] * anchors
    some = [estimate.bootstrap for estimate in estimates if estimate.bootstrap is not None]
    for estimate, motion, own in zip(estimates, motions, place, strict=True):
        moved = estimate.with_hypotheses_moved(motion).bootstrap
        if moved is None:
            continue
        for k, here in enumerate(own.tolist()):
            better = moved.placed[k] and not (placed[here] and (clear[here] or moved.ambiguous[k]))
            if better or not hypotheses[here]:
                hypotheses[here] = moved.hypotheses[k]
            placed[here] |= moved.placed[k]
            clear[here] |= bool(moved.placed[k] and not moved.ambiguous[k])
    return replace(some[0], placed=placed, hypotheses=tuple(hypotheses), ambiguous=placed & ~clear) if some else None


def _renamed(indices: Ints, at: Ints) -> Ints:
    """Return indices into one block as indices into another, -1 left."""
    return np.append(at, -1)[indices]


def _one_odometry(odometry: Sequence[OdometryEdges], at: Sequence[Ints], recordings: Recordings) -> OdometryEdges:
    """Return the odometry edges of all recordings."""
    moved = [
        replace(own, i=own.i + recording.first, j=own.j + recording.first, calibration=_renamed(own.calibration, rename))
        for own, recording, rename in zip(odometry, recordings.each, at, strict=True)
    ]
    return moved[0].followed_by(*moved[1:])


def _one_ranges(
    ranges: Sequence[RangeEdges | None], at: Sequence[Ints], place: Sequence[Ints], recordings: Recordings
) -> RangeEdges | None:
    """Return the ranges of all recordings; the offset of a tag from the first recording's goes into the lever arms."""
    moved = []
    tag = next((r.tag for r in ranges if r is not None), None)
    for own, recording, anchors, rename in zip(ranges, recordings.each, place, at, strict=True):
        if own is not None and tag is not None:
            arm = own.lever_arm + se2.rotate(own.turn, own.tag - tag)
            own = replace(own, pose=own.pose + recording.first, anchor=anchors[own.anchor], lever_arm=arm, tag=tag)
            moved.append(replace(own, calibration=_renamed(own.calibration, rename)))
    return moved[0].followed_by(*moved[1:]) if moved else None
