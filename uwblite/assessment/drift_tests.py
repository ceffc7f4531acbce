"""Tests for drift of values that an estimate takes as constant; where ranges alone constrain the trajectory, it bends instead.

A radio that warms up, wheels that wear or lose air: bent paths and displaced anchors explain nearly all of such an effect, and
no residual is conspicuous. The small remainder is compared with the pattern that each of these faults would leave: a score
test (graph/marginals.py) gives the best-fitting size. A wheel that slips for seconds is hidden in the same way: the error
of each step is small, and the calibration of the turns absorbs the rest.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ..arrays import Floats
from ..findings import Finding, doubt
from ..graph.graph import Edges, Graph, edge_weights
from ..graph.marginals import added_unknown
from ..graph.pose_edges import OdometryEdges, ScanEdges
from ..odometry.wheels import TurnScale, turn_scales
from ..pipeline.estimate import Estimate, Task
from ..pipeline.recordings import Recording, Recordings
from .facts import shown
from .moments import between_keyframes, seconds

_SIGMAS = 2.5
"""Standard deviations that a drift must exceed, in addition to its limit."""
_LONGER, _SCALE = 0.4, 0.07
"""Limits: m by which all ranges grow over a recording, and the change of the wheels' scale.
Faultless recordings, 30 of simulated and three of real places, have up to 0.24 m and 0.05 (1.7 and 2.8 sigma)."""
_TURN, _TURN_SIGMAS = 0.3, 4.0
"""rad by which turns are wrong over a short stretch, and standard deviations. Faultless recordings, 30 of simulated and three
of real places, have up to 3.6 sigma with 0.22 rad, the largest of about forty stretches in each."""
_WAY, _MOST = 8, 128
"""Steps of such a stretch, 2.4 m, and number of stretches that are tested: those on which the turns fit worst."""
_STEP = 1e-4
"""Share of a unit that is the step of numeric derivatives."""


def check_drifts(estimate: Estimate, task: Task) -> Iterator[Finding]:
    """Doubt a map without lidar in which ranges or wheels drift."""
    graph, ranges, wheels, rec = estimate.graph, estimate.ranges, estimate.odometry, task.recordings
    if ranges is None or not len(wheels) or not estimate.placed.any() or rec.have_scans:
        return
    for recording in rec.each:
        since = _age(recording, rec)
        (grown,), (sigma_grown,) = added_unknown(graph, ranges, (since[ranges.pose] / ranges.sigma)[None, :, None])
        (scaled,), (sigma_scaled,) = added_unknown(graph, wheels, _growth(graph, wheels, since)[None])
        patterns = (
            (grown, sigma_grown, _LONGER, f"all ranges seem to grow by {grown:.1f} m over the recording (radio warming up?)"),
            (scaled, sigma_scaled, _SCALE, _scale_text(scaled)),
        )
        # Either changes the size of the path beside the ranges: they are rival explanations of one remainder.
        drifting = [each for each in patterns if abs(each[0]) > max(each[2], _SIGMAS * each[1])]
        if drifting:
            value, sigma, _, text = max(drifting, key=lambda each: abs(each[0]) / each[1])
            why = f"{text}: without a lidar this bends path and anchors and leaves small residuals; record with a lidar"
            yield doubt("drift", why, value=float(value), sigma=float(sigma))
    yield from _check_turns(graph, wheels, rec)


def _scale_text(by: float) -> str:
    return f"the odometry's scale seems to change by {by:+.0%} (tyres flat or worn?)"


def _age(recording: Recording, rec: Recordings) -> Floats:
    """Return the time of each keyframe (k,) as a part of its recording's, 0 in the middle; 0 for other recordings."""
    stamps, since = recording.frames.stamps, np.zeros(len(rec.stamps))
    since[recording.rows] = (stamps - 0.5 * (stamps[0] + stamps[-1])) / max(float(np.ptp(stamps)), _STEP)
    return since


def _growth(graph: Graph, wheels: OdometryEdges, since: Floats) -> Floats:
    """Return the change (e, 3) of the wheels' residuals by a scale that grows by 1 over a recording."""
    motion = wheels.motion * (1.0 + _STEP * since[wheels.i, None] * np.array([1.0, 1.0, 0.0]))
    return _change(graph, wheels, replace(wheels, motion=motion))


def _check_turns(graph: Graph, wheels: OdometryEdges, rec: Recordings) -> Iterator[Finding]:
    """Doubt a map in which, by the ranges, the odometry turns wrongly over a short stretch."""
    steps = np.arange(0, len(wheels) - _WAY + 1, _WAY // 2)[:, None] + np.arange(_WAY)
    # The numerators of the test, with the graph at its optimum: a stretch that fits well needs no other turn.
    score = np.einsum("eij,ei,e->ej", wheels.sqrt_information, wheels.residuals(graph), edge_weights(wheels, graph))[:, 2]
    steps = steps[np.argsort(-np.abs(score[steps].sum(axis=1)), kind="stable")[:_MOST]]
    shifts = np.zeros((len(steps), len(wheels), 3))
    shifts[np.arange(len(steps))[:, None], steps] = wheels.sqrt_information[steps, :, 2] / _WAY
    turns, sigmas = added_unknown(graph, wheels, shifts)
    wrong = np.flatnonzero(np.abs(turns) > np.maximum(_TURN, _TURN_SIGMAS * sigmas))
    if len(wrong):
        worst = wrong[np.argmax(np.abs(turns[wrong]) / sigmas[wrong])]
        span, turn = (int(wheels.i[steps[worst, 0]]), int(wheels.j[steps[worst, -1]])), float(np.abs(turns[worst]))
        at = seconds(rec, span[0])
        why = f"from t = {at:.0f} s the ranges contradict the odometry by {turn:.1f} rad within some metres: did a wheel slip?"
        yield between_keyframes(doubt("odometry-slips", why, turn=turn, sigma=float(sigmas[worst]), at=at), rec, span)


def _change(graph: Graph, edges: Edges, changed: Edges) -> Floats:
    """Return the change of the residuals (e, d) by a unit, of edges changed by a step."""
    return (changed.residuals(graph) - edges.residuals(graph)) / _STEP


def check_turn_scales(estimate: Estimate, task: Task) -> Iterator[Finding]:
    """Doubt a map whose scale of turns is not that of the lidar's own steps, or differs between parts of the recording."""
    for edges in estimate.graph.edges:
        if isinstance(edges, ScanEdges):
            for index, found in turn_scales(estimate.odometry, edges, estimate.graph).items():
                yield from _judge(found, float(estimate.graph.calibration.values[index]), task)


def _judge(found: TurnScale, used: float, task: Task) -> Iterator[Finding]:
    """Return the text about what is wrong with the scale that a map uses."""
    if found.varies:
        parts = ", ".join(f"{1.0 + value:.2f}" for value in found.stretches)
        yield doubt(
            "turn-scale",
            f"the lidar turns {parts} times as much as the odometry in the four quarters of the recording: no calibration "
            "changes so; the map's heading is wrong, or the odometry failed",
            stretches=found.stretches.tolist(),
        )
    elif abs(used - found.value) > _WRONG and found.contradicts(used):
        yield doubt(
            "turn-scale",
            f"the map multiplies the odometry's turns by {1.0 + used:.2f}, but from step to step the lidar turns "
            f"{shown(found.value, found.sigma)} times as much: a turn of the map or a loop closure is wrong",
            by_steps=found.value,
            sigma=found.sigma,
            by_all=used,
        )


_WRONG = 0.1
"""Difference of the scale of turns that noise does not explain: a tenth of all turns missing or too much."""
