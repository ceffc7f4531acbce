"""Anchors that were moved between recordings, told once the lidar holds all poses."""

from dataclasses import replace

import numpy as np

from ..arrays import Floats, Ints
from ..graph import calibration
from ..graph.graph import Graph, PriorEdges
from ..graph.marginals import marginals
from ..graph.robust import Kernel
from ..graph.solver import SolverConfig, optimize
from ..radio.range_measurements import learn_noise
from ..radio.range_noise import RangeNoiseConfig
from .recordings import Estimate, JoinResult, Recordings, moved_anchor_text, numbered

_LEAST_MOVE = 0.25
"""An anchor that two recordings see nearer together than this was not moved, m."""
_MOVED = 20.0
"""Squared Mahalanobis distance between two recordings' places of an anchor from which on it was moved (2 degrees of
freedom; 5e-5 by chance, the rest for what the sigmas do not know)."""


def apart(estimate: Estimate, recordings: Recordings, solver: SolverConfig, noise: RangeNoiseConfig) -> JoinResult:
    """Give anchors that were moved between recordings a place of their own, once the poses are known well.

    With the poses held, every recording's ranges say where each anchor stood then; places whose distance their
    uncertainty does not explain are not the same.
    """
    if len(recordings) == 1 or estimate.radio is None or estimate.first is None:
        return JoinResult(estimate, ())
    heard = recordings.of_keyframe[estimate.radio.pose]
    place, covariance, pairs = _places_by_recording(estimate, heard, solver, noise)
    ids, anchors, anchor = list(estimate.anchor_ids), estimate.graph.anchors.copy(), estimate.radio.anchor.copy()
    source = list(range(len(ids)))
    warnings: list[str] = []
    for k in range(len(estimate.anchor_ids)):
        rows = np.flatnonzero(pairs[:, 0] == k).tolist()
        known = dict.fromkeys(rows[:1], k)
        for row in rows[1:]:
            recording = int(pairs[row, 1])
            same = [n for r, n in known.items() if not _differ(place[row] - place[r], covariance[row] + covariance[r])]
            if not same:
                ids.append(numbered(estimate.anchor_ids[k], recording))
                source.append(k)
                anchors = np.vstack([anchors, place[row]])
            known[row] = same[0] if same else len(ids) - 1
            if known[row] != k:
                anchor[(estimate.radio.anchor == k) & (heard == recording)] = known[row]
                off = float(np.hypot(*(place[row] - place[rows[0]])))
                warnings.append(moved_anchor_text(estimate.anchor_ids[k], off, recording, ids[known[row]]))
    if not warnings:
        return JoinResult(estimate, ())
    first = estimate.first
    first = replace(
        first, placed=first.placed[source], ambiguous=first.ambiguous[source],
        hypotheses=tuple(first.hypotheses[k] if n < len(estimate.anchor_ids) else () for n, k in enumerate(source)),
    )  # fmt: skip
    graph = replace(estimate.graph, anchors=anchors, fixed_anchors=~first.placed)
    radio = replace(estimate.radio, anchor=anchor)
    return JoinResult(replace(estimate, graph=graph, radio=radio, first=first, anchor_ids=tuple(ids)), tuple(warnings))


def _differ(off: Floats, covariance: Floats) -> bool:
    return bool(np.hypot(*off) > _LEAST_MOVE and off @ np.linalg.solve(covariance, off) > _MOVED)


def _places_by_recording(
    estimate: Estimate, heard: Ints, solver: SolverConfig, noise: RangeNoiseConfig
) -> tuple[Floats, Floats, Ints]:
    """Return place (p, 2), covariance (p, 2, 2) and (anchor, recording) of each anchor as each recording heard it."""
    radio, graph = estimate.radio, estimate.graph
    assert radio is not None
    assert estimate.first is not None
    assert graph.fixed_calibration is not None
    alive = np.flatnonzero((np.asarray(radio.weights) > 0) & estimate.first.placed[radio.anchor])
    pairs, which = np.unique(np.stack([radio.anchor[alive], heard[alive]], axis=1), axis=0, return_inverse=True)
    own = np.array([calibration.stem(name) == "bias" for name in graph.calibration.names], dtype=bool)
    priors = tuple(e for e in graph.edges if isinstance(e, PriorEdges) and e.block == "calibration")
    held, fixed = np.ones(len(graph.poses), dtype=bool), graph.fixed_calibration | ~own
    alone = Graph(graph.poses, graph.anchors[pairs[:, 0]], priors, graph.calibration, held, None, fixed)
    # What the joint map held to be outliers may be an anchor that was moved: first all ranges count alike.
    alike = np.ones(len(alive))
    edges = replace(
        radio.rows(alive), anchor=which.reshape(-1).astype(np.int64), kernel=Kernel("cauchy", 2.5), weights=alike
    )
    edges, _ = learn_noise(edges, optimize(alone.with_edges(edges), solver)[0], len(pairs), noise)
    solved = optimize(alone.with_edges(edges), solver)[0]
    return solved.anchors, marginals(solved).anchors, pairs
