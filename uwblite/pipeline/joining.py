"""Many recordings in one graph: anchors have ids, so recordings of other days and robots share a frame.

The anchors that two recordings, bootstrapped each on its own, have in common give the pose of one in the frame of the other.
Far from its first pose all places of a recording err by metres, but alike: they are compared under their joint covariances with
the rigid motion into the other frame free, and what is left shows an anchor that was moved. It has a place for each recording
(``5C0B`` and ``5C0B#2``) until anchor_places decides. Systematic errors stay each recording's own, see calibration.unknowns.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from .. import se2
from ..arrays import Bools, Floats, Ints, rms_length
from ..errors import DataError
from ..graph import calibration
from ..graph.graph import Calibration, Graph, PriorEdges
from ..graph.marginals import anchor_covariance
from ..graph.pose_edges import OdometryEdges
from ..graph.range_edges import RangeEdges
from ..radio.bootstrap_attempt import BootstrapResult
from ..radio.trilateration import AnchorHypothesis
from ..sensor_log.sensors import first_place, place_name
from .estimate import Estimate
from .recordings import Recording, Recordings

Pairs = list[tuple[int, int]]
"""Number of an anchor in one set of places, and in the other."""


class JoiningPolicy:
    """Agreement of the places that recordings give to anchors."""

    systematic: float = 0.25
    """Standard deviation of what NLOS and biases, not yet known well, add to the distance between two first places, m."""
    largest: float = 5.0
    """m; an anchor whose first place is less sure, or open, still has to lie within some metres to join in."""
    moved: float = 20.0
    """Decrease of chi2 without an anchor (2 degrees of freedom) from which on it was moved: 5e-5 by chance, the rest for
    errors that the covariances leave out."""
    free: float = 1e3
    """m; standard deviation of a rigid motion of which nothing is known."""
    steps: int = 3
    """Gauss-Newton steps to the best motion, from the best one without covariances."""
    exact: float = 1e-9
    """m^2 and m; least variance of a place, and least extent of places."""


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Where some anchors are: (a, 2) m, and their joint covariance (2a, 2a) m^2."""

    names: tuple[str, ...]
    at: Floats
    covariance: Floats

    def moved(self, motion: Floats) -> "Places":
        """Return them in another frame, given T_new_old (3,)."""
        return Places(self.names, se2.transform(motion, self.at), _turned(self.covariance, motion[2]))


def places_of(estimate: Estimate) -> Places:
    """Return the places of the unambiguous anchors of a recording; of all placed if these are few."""
    if estimate.bootstrap is None:
        return Places((), np.zeros((0, 2)), np.zeros((0, 0)))
    placed = np.flatnonzero(estimate.placed & ~estimate.bootstrap.ambiguous)
    if len(placed) < 2:
        placed = np.flatnonzero(estimate.placed)
    values, vectors = np.linalg.eigh(anchor_covariance(estimate.graph.with_edges(*estimate.odometry_and_ranges), placed))
    bounded = np.asarray((vectors / (1.0 / np.maximum(values, JoiningPolicy.exact) + JoiningPolicy.largest**-2)) @ vectors.T)
    return Places(tuple(estimate.anchor_ids[k] for k in placed), estimate.graph.anchors[placed], bounded)


def agreement(found: Places, placed: Places) -> tuple[Floats, Pairs]:
    """Return the motion (3,) of places into the frame of others, and which anchors agree: two or more of the same name.

    Anchors leave one by one, each the one without which the others fit best, until that no longer shows.
    """
    pairs = [(k, placed.names.index(name)) for k, name in enumerate(found.names) if name in placed.names]
    motion, chi2 = fitted(found, placed, pairs)
    while len(pairs) > 2:
        less = [fitted(found, placed, pairs[:k] + pairs[k + 1 :]) for k in range(len(pairs))]
        k = int(np.argmin([left for _, left in less]))
        if chi2 - less[k][1] < JoiningPolicy.moved:
            break
        motion, chi2 = less[k]
        del pairs[k]
    return motion, pairs if chi2 < JoiningPolicy.moved or len(pairs) > 2 else []


def together(placed: Places, found: Places, names: Sequence[str]) -> Places:
    """Return places with those of a further recording, in the same frame, of which these are the names in common.

    Nothing is known of the rigid motion of the further recording but what its anchors in common show (Gaussian fusion).
    """
    union = (*placed.names, *(name for name in names if name not in placed.names))
    rows = _scalars(np.array([union.index(name) for name in names]))
    tangent = _tangent(found.at)
    c = JoiningPolicy
    free = found.covariance + c.free**2 * tangent @ tangent.T + 0.5 * c.systematic**2 * np.eye(len(rows))
    known = 2 * len(placed.names)
    information, vector = np.zeros((2 * len(union), 2 * len(union))), np.zeros(2 * len(union))
    information[:known, :known] = np.linalg.inv(placed.covariance + c.exact * np.eye(known))
    vector[:known] = information[:known, :known] @ placed.at.ravel()
    own = np.linalg.inv(free)
    information[np.ix_(rows, rows)] += own
    vector[rows] += own @ found.at.ravel()
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return Places(union, (covariance @ vector).reshape(-1, 2), covariance)


def fitted(found: Places, placed: Places, pairs: Pairs) -> tuple[Floats, float]:
    """Return the motion (3,) of places into the frame of others that fits pairs of them best, and chi2 there."""
    mine, theirs = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
    here, there = found.at[mine], placed.at[theirs]
    own, others = (p.covariance[np.ix_(_scalars(k), _scalars(k))] for p, k in ((found, mine), (placed, theirs)))
    others = others + JoiningPolicy.systematic**2 * np.eye(len(others))
    motion = se2.align(here, there)
    for _ in range(JoiningPolicy.steps):
        at = se2.transform(motion, here)
        factor = cho_factor(_turned(own, motion[2]) + others)
        tangent, off = _tangent(at), (at - there).ravel()
        weighted = cho_solve(factor, tangent)
        step = -np.linalg.solve(tangent.T @ weighted, weighted.T @ off)
        left = off + tangent @ step
        turn, middle = step[2] / _extent(at), at.mean(axis=0)
        motion = se2.compose(np.append(middle + step[:2] - se2.rotate(turn, middle), turn), motion)
    return motion, float(left @ cho_solve(factor, left))


def _tangent(at: Floats) -> Floats:
    """Return how places (2a, 3) move with a rigid motion: x, y, and a turn about their mean by which they move as far."""
    turned = se2.rotate(0.5 * np.pi, at - at.mean(axis=0)) / _extent(at)
    return np.column_stack([np.tile(np.eye(2), (len(at), 1)), turned.ravel()])


def _turned(covariance: Floats, angle: float) -> Floats:
    turn = np.kron(np.eye(len(covariance) // 2), se2.rotation(angle)[:2, :2])
    return np.asarray(turn @ covariance @ turn.T)


def _extent(at: Floats) -> float:
    """Return the rms distance of places from their mean, m."""
    return max(rms_length(at - at.mean(axis=0)), JoiningPolicy.exact)


def _scalars(numbers: Ints) -> Ints:
    """Return the numbers (2a,) of the coordinates of anchors (a,)."""
    return (2 * numbers[:, None] + np.arange(2)).ravel()


def join(estimates: Sequence[Estimate], recordings: Recordings) -> Estimate:
    """Bring the estimates of all recordings into the frame of the first by common anchors, and make them one graph.

    The recording that shares most anchors with those already joined is next, so that a third may link two.

    Raises
    ------
    DataError : a recording shares fewer than two placed anchors with the others, or no two have places that agree.
    """
    found = [places_of(estimate) for estimate in estimates]
    placed = found[0]
    motions = [np.zeros_like(estimate.graph.poses[0]) for estimate in estimates]
    names = [list(estimate.anchor_ids) for estimate in estimates]
    waiting = list(range(1, len(estimates)))
    while waiting:
        number = max(waiting, key=lambda n: (len(set(found[n].names) & set(placed.names)), -n))
        waiting.remove(number)
        motions[number], agree = _laid_on(found[number], placed, recordings.each[number])
        own = found[number].moved(motions[number])
        called = list(own.names)
        for k, name in enumerate(own.names):
            if name in placed.names and (k, placed.names.index(name)) not in agree:
                called[k] = place_name(name, 1, number)
                names[number][names[number].index(name)] = called[k]
        placed = together(placed, own, called)
    return _one_graph(estimates, motions, names, recordings)


def _laid_on(found: Places, placed: Places, recording: Recording) -> tuple[Floats, Pairs]:
    """Return the motion (3,) of a recording into the common frame, and which anchors agree there."""
    common = sorted(set(found.names) & set(placed.names))
    if len(common) < 2:
        raise DataError(
            f"{recording.name} shares {len(common)} placed anchors with the others ({', '.join(common) or 'none'}); two "
            "or more are needed to bring it into their frame: map it alone, or record where common anchors are in reach"
        )
    motion, pairs = agreement(found, placed)
    if not pairs:
        raise DataError(
            f"{recording.name} has the anchors {', '.join(common)} in common with the others, but in no two of them do their "
            "places agree: they were moved, or it is of another place; map it alone"
        )
    return motion, pairs


def _one_graph(
    estimates: Sequence[Estimate], motions: Sequence[Floats], names: Sequence[Sequence[str]], recordings: Recordings
) -> Estimate:
    """Return the estimates as one, each moved by its motion, its anchors under the given names."""
    # Second places stand last: they may be found to be none, and what the user gives is counted by number.
    ids = tuple(sorted(dict.fromkeys(name for own in names for name in own), key=lambda name: name != first_place(name)))
    place = [np.array([ids.index(name) for name in own], dtype=np.intp) for own in names]
    block, priors, fixed, at = _one_calibration([estimate.graph for estimate in estimates])
    poses = np.concatenate([se2.compose(m, estimate.graph.poses) for m, estimate in zip(motions, estimates, strict=True)])
    joined = _one_bootstrap(estimates, motions, place, len(ids))
    anchors = np.zeros((len(ids), 2))
    for estimate, motion, own in zip(reversed(estimates), reversed(motions), reversed(place), strict=True):
        placed = estimate.placed
        anchors[own[placed]] = se2.transform(motion, estimate.graph.anchors[placed])
    unplaced = np.zeros(len(ids), dtype=bool) if joined is None else ~joined.placed
    work = estimates[0].graph.work
    graph = Graph(poses, anchors, (priors,), block, fixed_anchors=unplaced, fixed_calibration=fixed, work=work)
    return replace(
        estimates[0],
        graph=graph,
        odometry=_one_odometry([e.odometry for e in estimates], at, recordings),
        ranges=_one_ranges([e.ranges for e in estimates], at, place, recordings),
        bootstrap=joined,
        anchor_ids=ids,
    )


def _one_calibration(graphs: Sequence[Graph]) -> tuple[Calibration, PriorEdges, Bools, list[Ints]]:
    """Return the block of all recordings' unknowns, its priors, which are fixed, and where each graph's are in it."""
    keyed = [[calibration.of_recording(key, n) for key in graph.calibration.keys] for n, graph in enumerate(graphs)]
    keys = tuple(dict.fromkeys(key for own in keyed for key in own))
    block, place = Calibration(keys, np.zeros(len(keys))), {key: k for k, key in enumerate(keys)}
    at = [np.array([place[key] for key in own], dtype=np.intp) for own in keyed]
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
    """Return indices into a block as indices into another, where -1 stays."""
    return np.append(at, -1)[indices]


def _one_odometry(odometry: Sequence[OdometryEdges], at: Sequence[Ints], recordings: Recordings) -> OdometryEdges:
    slips = [np.zeros(len(own)) if own.slips is None else own.slips for own in odometry]
    some = any(own.slips is not None for own in odometry)
    moved = [
        replace(
            own, i=own.i + recording.first, j=own.j + recording.first, calibration=_renamed(own.calibration, rename),
            slips=p if some else None,
        )
        for own, p, recording, rename in zip(odometry, slips, recordings.each, at, strict=True)
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
