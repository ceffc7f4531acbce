"""Many recordings in one graph: anchors have ids, so drives of other days and robots share a frame.

Each recording grows its own first estimate. The anchors that two have in common then say how one lies in the frame of
the other; one that was moved in between does not join in, gets a place of its own for each recording (``5C0B`` and
``5C0B#2``) and is named. Poses, wheels and ranges of all recordings become one graph with one numbering of poses.
What is wrong with wheels, tag and ranges stays each recording's own, see calibration.unknowns.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import calibration, keyframes, se2
from .anchors import AnchorHypothesis
from .constraints import Clock, consensus
from .errors import DataError
from .first_estimate import FirstEstimate
from .graph import Calibration, Edges, Graph, OdometryEdges, PriorEdges, RangeEdges
from .keyframes import KeyframeConfig, Keyframes
from .marginals import marginals
from .robust import Kernel
from .sensor_log import SensorLog
from .solver import SolverConfig, optimize

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

_APART = 1000.0
"""Travelled distance between the end of a recording and the begin of the next, m: never the same epoch."""
_FIRST_TOLERANCE = 0.5
"""How far first estimates of one anchor may lie apart beyond their sigmas, m; NLOS and biases are not yet known well."""
_LEAST_MOVE = 0.25
"""An anchor that two recordings see nearer together than this was not moved, m."""
_MOVED = 20.0
"""Squared Mahalanobis distance between two recordings' places of an anchor from which on it was moved (2 degrees of
freedom; 5e-5 by chance, the rest for what the sigmas do not know)."""


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """One recording among others."""

    number: int
    """0, 1, ..."""
    log: SensorLog
    frames: Keyframes
    first: int
    """The graph's number of its first keyframe."""

    @property
    def rows(self) -> slice:
        """Its keyframes among all."""
        return slice(self.first, self.first + len(self.frames))

    @property
    def has_scans(self) -> bool:
        """Whether it has lidar."""
        return self.log.scans is not None and len(self.log.scans.stamps) > 0

    @property
    def anchor_ids(self) -> tuple[str, ...]:
        """Names of the anchors it heard."""
        return self.log.ranges.anchor_ids if self.log.ranges is not None else ()

    def dense_trajectory(self, poses: Floats, stamps: Floats | None = None) -> Floats:
        """Return T_map_base (n, 3) at stamps (default: all of its odometry's), given the poses of all keyframes."""
        return keyframes.dense_trajectory(self.log.odometry, self.frames, poses[self.rows], stamps)

    @property
    def name(self) -> str:
        """What to call it in messages."""
        source = self.log.notes.source
        return f"recording {self.number + 1}{f' ({source})' if source else ''}"


@dataclass(frozen=True, slots=True, eq=False)
class Drives:
    """All recordings of a map, their keyframes in one numbering."""

    sessions: tuple[Session, ...]
    session: Ints
    """(k,) recording of each keyframe."""
    stamps: Floats
    """(k,) s, each on its recording's clock."""
    path: Floats
    """(k,) travelled distance, m; recordings lie far apart."""
    twist: Floats
    """(k, 3) velocity of the base at each keyframe, own frame, m/s, m/s, rad/s."""

    def __len__(self) -> int:
        return len(self.sessions)

    @property
    def clock(self) -> Clock:
        """When the keyframes were."""
        return Clock(self.stamps, self.session)


def gather(logs: Sequence[SensorLog], config: KeyframeConfig) -> Drives:
    """Choose the keyframes of all recordings and number them through.

    Raises
    ------
    DataError : there is no recording.
    """
    if not logs:
        raise DataError("no recording to map; give one or more")
    sessions: list[Session] = []
    paths: list[Floats] = []
    first, start = 0, 0.0
    for number, log in enumerate(logs):
        frames = keyframes.select(log.odometry, config)
        sessions.append(Session(number, log, frames, first))
        paths.append(start + np.concatenate([[0.0], np.cumsum(frames.path)]))
        first, start = first + len(frames), float(paths[-1][-1]) + _APART
    return Drives(
        tuple(sessions),
        np.repeat(np.arange(len(sessions)), [len(s.frames) for s in sessions]),
        np.concatenate([s.frames.stamps for s in sessions]),
        np.concatenate(paths),
        np.concatenate([s.frames.twist for s in sessions]),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """What is known of one recording, or of several joined: estimates and measurements."""

    graph: Graph
    """Estimates and calibration priors."""
    wheels: OdometryEdges
    radio: RangeEdges | None
    first: FirstEstimate | None
    """None without ranges."""
    anchor_ids: tuple[str, ...]
    """(a,) of the graph's anchors."""

    @property
    def edges(self) -> tuple[Edges, ...]:
        """Wheels, and ranges where there are any."""
        return (self.wheels,) if self.radio is None else (self.wheels, self.radio)


@dataclass(frozen=True, slots=True, eq=False)
class Joined:
    """All recordings in the frame of the first."""

    part: Part
    warnings: tuple[str, ...]
    """Anchors that were moved, in words."""


def join(parts: Sequence[Part], drives: Drives) -> Joined:
    """Bring all recordings into the frame of the first, by the anchors they have in common, and make them one graph.

    Recordings join in the order of how many anchors they share with those already in, so that a third may link two.

    Parameters
    ----------
    parts : each recording's own estimates, in its own frame and numbering.
    drives : the recordings.

    Raises
    ------
    DataError : a recording shares fewer than two placed anchors with the others.
    """
    if len(parts) == 1:
        return Joined(parts[0], ())
    known = _places(parts[0])
    motions = [np.zeros(3) for _ in parts]
    names = [list(part.anchor_ids) for part in parts]
    warnings: list[str] = []
    waiting = list(range(1, len(parts)))
    while waiting:
        found = {n: _places(parts[n]) for n in waiting}
        number = max(waiting, key=lambda n: (len(found[n].keys() & known.keys()), -n))
        motions[number], moved = _laid_on(found[number], known, drives.sessions[number])
        waiting.remove(number)
        for k, name in enumerate(names[number]):
            here, spread = found[number].get(name, (None, 0.0))
            if here is None:
                continue
            here = se2.transform(motions[number], here)
            if name in moved:
                names[number][k] = _other_name(name, here, spread, number, known)
                warnings.append(moved_text(name, moved[name], number, names[number][k]))
            known.setdefault(names[number][k], (here, spread))
    return Joined(_one_graph(parts, motions, names, drives), tuple(warnings))


def _other_name(name: str, here: Floats, spread: float, number: int, known: dict[str, tuple[Floats, float]]) -> str:
    """Return what to call an anchor that does not stand at its first place: as a recording that found it here does."""
    for earlier in range(1, number):
        other = _numbered(name, earlier)
        if other in known and np.hypot(*(known[other][0] - here)) < _FIRST_TOLERANCE + 2.0 * np.hypot(spread, known[other][1]):
            return other
    return _numbered(name, number)


def _numbered(name: str, recording: int) -> str:
    """Return what an anchor is called that stands elsewhere in a recording than before."""
    return f"{name}#{recording + 1}"


def moved_text(name: str, distance: float, recording: int, own: str) -> str:
    """Return what to tell of a moved anchor."""
    return f"anchor {name} was moved: in recording {recording + 1} it stands {distance:.2f} m away, and is called {own}"


def _places(part: Part) -> dict[str, tuple[Floats, float]]:
    """Return place (2,) and standard deviation (m) of the anchors of a part that are clear; of all placed if these are few."""
    if part.first is None:
        return {}
    placed = np.flatnonzero(part.first.placed & ~part.first.ambiguous)
    if len(placed) < 2:
        placed = np.flatnonzero(part.first.placed)
    spread = marginals(part.graph.with_edges(*part.edges)).anchors
    return {
        part.anchor_ids[k]: (part.graph.anchors[k], float(np.sqrt(np.clip(np.trace(spread[k]), 0.0, 25.0)))) for k in placed
    }


def _laid_on(
    found: dict[str, tuple[Floats, float]], known: dict[str, tuple[Floats, float]], session: Session
) -> tuple[Floats, dict[str, float]]:
    """Return the motion (3,) of a recording into the common frame, and the anchors that do not join in, with how far off."""
    common = sorted(found.keys() & known.keys())
    if len(common) < 2:
        raise DataError(
            f"{session.name} shares {len(common)} placed anchors with the others ({', '.join(common) or 'none'}); two or more "
            "are needed to bring it into their frame: map it alone, or record where common anchors are heard"
        )
    here, there = (np.array([side[name][0] for name in common]) for side in (found, known))
    spread = np.array([np.hypot(found[name][1], known[name][1]) for name in common])
    tolerance = _FIRST_TOLERANCE + 2.0 * spread
    motion = consensus(here, there, tolerance)
    off = np.hypot(*(se2.transform(motion, here) - there).T)
    return motion, {name: float(d) for name, d, most in zip(common, off, tolerance, strict=True) if d > most}


def _one_graph(parts: Sequence[Part], motions: Sequence[Floats], names: Sequence[Sequence[str]], drives: Drives) -> Part:
    """Make the parts one, each moved by its motion, its anchors under the given names."""
    ids = tuple(dict.fromkeys(name for own in names for name in own))
    place = [np.array([ids.index(name) for name in own], dtype=np.int64) for own in names]
    block, priors, fixed, at = _one_calibration([part.graph for part in parts])
    poses = np.concatenate([se2.compose(m, part.graph.poses) for m, part in zip(motions, parts, strict=True)])
    first = _one_first_estimate(parts, motions, place, len(ids))
    anchors = np.zeros((len(ids), 2))
    for part, motion, own in zip(reversed(parts), reversed(motions), reversed(place), strict=True):
        known = np.zeros(len(own), dtype=bool) if part.first is None else part.first.placed
        anchors[own[known]] = se2.transform(motion, part.graph.anchors[known])
    graph = Graph(
        poses, anchors, (priors,), block, fixed_anchors=None if first is None else ~first.placed, fixed_calibration=fixed
    )
    return replace(
        parts[0], graph=graph, wheels=_one_wheels([p.wheels for p in parts], at, drives),
        radio=_one_radio([p.radio for p in parts], at, place, drives), first=first, anchor_ids=ids,
    )  # fmt: skip


def _one_calibration(graphs: Sequence[Graph]) -> tuple[Calibration, PriorEdges, Bools, list[Ints]]:
    """Return the block of all recordings' unknowns, its priors, which are held, and where each graph's are in it."""
    named = [tuple(calibration.of_recording(name, n) for name in graph.calibration.names) for n, graph in enumerate(graphs)]
    names = tuple(dict.fromkeys(name for own in named for name in own))
    block = Calibration(names, np.zeros(len(names)))
    at = [calibration.indices(block, *own) for own in named]
    values, roots, fixed = block.values, np.zeros((len(names), 1, 1)), np.ones(len(names), dtype=bool)
    for graph, own in zip(reversed(graphs), reversed(at), strict=True):
        assert graph.fixed_calibration is not None
        fixed[own] &= graph.fixed_calibration
        values[own] = graph.calibration.values
        for edges in graph.edges:
            if isinstance(edges, PriorEdges) and edges.block == "calibration":
                roots[own[edges.index]] = edges.sqrt_information
    return block, PriorEdges("calibration", np.arange(len(names)), np.zeros((len(names), 1)), roots), fixed, at


def _one_first_estimate(
    parts: Sequence[Part], motions: Sequence[Floats], place: Sequence[Ints], anchors: int
) -> FirstEstimate | None:
    """Return the first estimates as one: an anchor that one recording shows clearly is clear."""
    placed, clear = np.zeros(anchors, dtype=bool), np.zeros(anchors, dtype=bool)
    hypotheses: list[tuple[AnchorHypothesis, ...]] = [()] * anchors
    some = [part.first for part in parts if part.first is not None]
    for part, motion, own in zip(parts, motions, place, strict=True):
        moved = moved_hypotheses(part.first, motion)
        if moved is None:
            continue
        for k, here in enumerate(own.tolist()):
            better = moved.placed[k] and not (placed[here] and (clear[here] or moved.ambiguous[k]))
            if better or not hypotheses[here]:
                hypotheses[here] = moved.hypotheses[k]
            placed[here] |= moved.placed[k]
            clear[here] |= bool(moved.placed[k] and not moved.ambiguous[k])
    return replace(some[0], placed=placed, hypotheses=tuple(hypotheses), ambiguous=placed & ~clear) if some else None


def moved_hypotheses(first: FirstEstimate | None, motion: Floats) -> FirstEstimate | None:
    """Return the first estimate, where there is one, with its places of anchors in a frame moved by T_new_old."""
    if first is None:
        return None
    moved = tuple(tuple(replace(h, position=se2.transform(motion, h.position)) for h in found) for found in first.hypotheses)
    return replace(first, hypotheses=moved)


def _renamed(indices: Ints, at: Ints) -> Ints:
    """Return indices into one block as indices into another, -1 left."""
    return np.append(at, -1)[indices]


def _one_wheels(wheels: Sequence[OdometryEdges], at: Sequence[Ints], drives: Drives) -> OdometryEdges:
    first = [s.first for s in drives.sessions]
    return replace(
        wheels[0],
        i=np.concatenate([w.i + f for w, f in zip(wheels, first, strict=True)]),
        j=np.concatenate([w.j + f for w, f in zip(wheels, first, strict=True)]),
        motion=np.concatenate([w.motion for w in wheels]),
        length=np.concatenate([w.length for w in wheels]),
        duration=np.concatenate([w.duration for w in wheels]),
        sqrt_information=np.concatenate([w.sqrt_information for w in wheels]),
        calibration=np.concatenate([_renamed(w.calibration, a) for w, a in zip(wheels, at, strict=True)]),
    )


def _one_radio(
    radios: Sequence[RangeEdges | None], at: Sequence[Ints], place: Sequence[Ints], drives: Drives
) -> RangeEdges | None:
    """Return the ranges of all; what tags sit elsewhere than the first goes into the lever arms."""
    moved = []
    tag = next((r.tag for r in radios if r is not None), None)
    for radio, session, own, rename in zip(radios, drives.sessions, place, at, strict=True):
        if radio is not None and tag is not None:
            arm = radio.lever_arm + se2.rotate(radio.turn, radio.tag - tag)
            moved.append(
                replace(
                    radio, pose=radio.pose + session.first, anchor=own[radio.anchor], lever_arm=arm, tag=tag,
                    calibration=_renamed(radio.calibration, rename),
                )
            )  # fmt: skip
    if not moved:
        return None
    stacked = ("pose", "anchor", "ranges", "sigma", "lever_arm", "turn", "velocity", "height", "calibration", "stamps")
    rows: dict[str, Any] = {name: np.concatenate([getattr(r, name) for r in moved]) for name in stacked}
    rows["weights"] = np.concatenate([np.ones(len(r)) if r.weights is None else r.weights for r in moved])
    return replace(moved[0], **rows)


def apart(part: Part, drives: Drives, solver: SolverConfig) -> Joined:
    """Give anchors that were moved between recordings a place of their own, once the poses are known well.

    With the poses held, every recording's ranges say where each anchor stood then; places whose distance their
    uncertainty does not explain are not the same.
    """
    if len(drives) == 1 or part.radio is None or part.first is None:
        return Joined(part, ())
    heard = drives.session[part.radio.pose]
    place, covariance, pairs = _places_by_recording(part, heard, solver)
    ids, anchors, anchor = list(part.anchor_ids), part.graph.anchors.copy(), part.radio.anchor.copy()
    source = list(range(len(ids)))
    warnings: list[str] = []
    for k in range(len(part.anchor_ids)):
        rows = np.flatnonzero(pairs[:, 0] == k).tolist()
        known = dict.fromkeys(rows[:1], k)
        for row in rows[1:]:
            recording = int(pairs[row, 1])
            same = [n for r, n in known.items() if not _differ(place[row] - place[r], covariance[row] + covariance[r])]
            if not same:
                ids.append(_numbered(part.anchor_ids[k], recording))
                source.append(k)
                anchors = np.vstack([anchors, place[row]])
            known[row] = same[0] if same else len(ids) - 1
            if known[row] != k:
                anchor[(part.radio.anchor == k) & (heard == recording)] = known[row]
                off = float(np.hypot(*(place[row] - place[rows[0]])))
                warnings.append(moved_text(part.anchor_ids[k], off, recording, ids[known[row]]))
    if not warnings:
        return Joined(part, ())
    first = part.first
    first = replace(
        first, placed=first.placed[source], ambiguous=first.ambiguous[source],
        hypotheses=tuple(first.hypotheses[k] if n < len(part.anchor_ids) else () for n, k in enumerate(source)),
    )  # fmt: skip
    graph = replace(part.graph, anchors=anchors, fixed_anchors=~first.placed)
    radio = replace(part.radio, anchor=anchor)
    return Joined(replace(part, graph=graph, radio=radio, first=first, anchor_ids=tuple(ids)), tuple(warnings))


def _differ(off: Floats, covariance: Floats) -> bool:
    return bool(np.hypot(*off) > _LEAST_MOVE and off @ np.linalg.solve(covariance, off) > _MOVED)


def _places_by_recording(part: Part, heard: Ints, solver: SolverConfig) -> tuple[Floats, Floats, Ints]:
    """Return place (p, 2), covariance (p, 2, 2) and (anchor, recording) of each anchor as each recording heard it."""
    radio, graph = part.radio, part.graph
    assert radio is not None
    assert part.first is not None
    assert graph.fixed_calibration is not None
    alive = np.flatnonzero((np.asarray(radio.weights) > 0) & part.first.placed[radio.anchor])
    pairs, which = np.unique(np.stack([radio.anchor[alive], heard[alive]], axis=1), axis=0, return_inverse=True)
    own = np.array([calibration.stem(name) == "bias" for name in graph.calibration.names], dtype=bool)
    priors = tuple(e for e in graph.edges if isinstance(e, PriorEdges) and e.block == "calibration")
    held, fixed = np.ones(len(graph.poses), dtype=bool), graph.fixed_calibration | ~own
    alone = Graph(graph.poses, graph.anchors[pairs[:, 0]], priors, graph.calibration, held, None, fixed)
    edges = replace(radio.rows(alive), anchor=which.reshape(-1).astype(np.int64), kernel=Kernel("cauchy", 2.5))
    solved = optimize(alone.with_edges(edges), solver)[0]
    return solved.anchors, marginals(solved).anchors, pairs
