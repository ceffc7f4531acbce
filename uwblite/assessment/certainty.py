"""How well a map knows the shape of the path: its covariances, another optimum, and drift of what it takes as constant.

A radio that warms up, wheels that wear or lose air: where ranges alone constrain the trajectory, bent paths and displaced
anchors explain nearly all of such an effect, and no residual is conspicuous. The small remainder is compared with the pattern
that each of these faults would leave: a score test (graph/marginals.py) gives the best-fitting size.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ..arrays import Floats
from ..findings import Finding, doubt
from ..graph.graph import Graph
from ..graph.marginals import added_unknown
from ..graph.pose_edges import OdometryEdges
from ..pipeline.estimate import Estimate, Task
from ..pipeline.range_alternatives import RangePolicy, sides
from ..pipeline.recordings import Recording, Recordings
from ..problem.alternatives import apart

_UNCERTAIN, _UNCERTAIN_SHARE = 0.4, 0.05
"""Expected error of places, m and as a share of the area's diameter. Of maps at this limit one in five is off by more than
half a metre; rooms mapped by odometry and ranges have 0.08 to 0.15 m."""
_OF_A_SITE = 0.005
"""Share of the diameter of a larger area without ranges: a hospital of 452 m whose relations are right to 0.13 m states 0.75 m;
two sites of 120 and 150 m that are off by 1.4 and 2.3 m state 1.1 and 1.0 m."""
_SIGMAS = 2.5
"""Standard deviations that a drift must exceed, in addition to its limit."""
_LONGER, _SCALE = 0.4, 0.07
"""Limits: m by which all ranges grow over a recording, and the change of the wheels' scale.
Faultless recordings, 30 of simulated and three of real places, have up to 0.24 m and 0.05 (1.7 and 2.8 sigma)."""
_STEP = 1e-4
"""Share of a unit that is the step of numeric derivatives."""


def check_certainty(estimate: Estimate, sigma: float, task: Task) -> Iterator[Finding]:
    """Doubt a map whose own uncertainties are so large that its shape is not known well.

    Sigma is the rms of the places' expected errors after alignment, m, the unit of length apart.
    """
    extent = float(np.hypot(*np.ptp(estimate.graph.poses[:, :2], axis=0)))
    # Ranges hold every place to the same error; without, that of a chain of steps grows with its length.
    most = _UNCERTAIN if estimate.ranges is not None else max(_UNCERTAIN, _OF_A_SITE * extent)
    if sigma > min(most, _UNCERTAIN_SHARE * extent):
        text = (
            f"the shape of the path is known to {sigma:.1f} m (rms) only, in an area {extent:.0f} m across: too few ranges and "
            "scans constrain the trajectory; add anchors, or drive where the lidar sees walls"
        )
        yield doubt("uncertain", text, sigma=sigma, extent=extent)


def check_other_side(estimate: Estimate, task: Task) -> Iterator[Finding]:
    """Doubt a map without lidar that has another optimum, which all measurements together do not exclude either."""
    graph, other = estimate.graph, estimate.other_side
    if task.recordings.have_scans or len(task.recordings) > 1:
        return
    alike = other is not None and other.poses.shape == graph.poses.shape and other.anchors.shape == graph.anchors.shape
    start = graph.with_estimates_of(other) if other is not None and alike else None
    for there in sides(graph, estimate.placed, task.config.solver, start):
        off = apart(there.graph, graph)
        if there.open and off > RangePolicy.elsewhere:
            text = (
                f"the ranges fit another trajectory about as well, on the other side of the line of the anchors for a time and "
                f"{off:.1f} m (rms) away (odds {np.exp(there.log_odds):.2g}): place an anchor off that line, or give the "
                "places of the anchors"
            )
            yield doubt("other-side", text, apart=off, log_odds=there.log_odds)
            return


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
            (scaled, sigma_scaled, _SCALE, f"the odometry's scale seems to change by {scaled:+.0%} (tyres flat or worn?)"),
        )
        # Either changes the size of the path beside the ranges: they are rival explanations of one remainder.
        drifting = [each for each in patterns if abs(each[0]) > max(each[2], _SIGMAS * each[1])]
        if drifting:
            value, sigma, _, text = max(drifting, key=lambda each: abs(each[0]) / each[1])
            why = f"{text}: without a lidar this bends path and anchors and leaves small residuals; record with a lidar"
            yield doubt("drift", why, value=float(value), sigma=float(sigma))


def _age(recording: Recording, rec: Recordings) -> Floats:
    """Return the time of each keyframe (k,) as a part of its recording's, 0 in the middle; 0 for other recordings."""
    stamps, since = recording.frames.stamps, np.zeros(len(rec.stamps))
    since[recording.rows] = (stamps - 0.5 * (stamps[0] + stamps[-1])) / max(float(np.ptp(stamps)), _STEP)
    return since


def _growth(graph: Graph, wheels: OdometryEdges, since: Floats) -> Floats:
    """Return the change (e, 3) of the wheels' residuals by a scale that grows by 1 over a recording, by a small step."""
    motion = wheels.motion * (1.0 + _STEP * since[wheels.i, None] * np.array([1.0, 1.0, 0.0]))
    return (replace(wheels, motion=motion).residuals(graph) - wheels.residuals(graph)) / _STEP
