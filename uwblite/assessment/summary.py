"""From the optimised graph to the result: anchors, calibration, warnings and doubts."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..arrays import OUTLIER, Floats, spread_about_median
from ..findings import Finding
from ..graph.calibration import Unknown, unknowns
from ..graph.graph import Graph
from ..graph.marginals import Covariances, about_best_fit, shape_error
from ..graph.range_edges import RangeEdges
from ..grid.occupancy_grid import OccupancyGrid
from ..map_result import AnchorEstimate, CalibrationEstimate, MapResult
from ..pipeline.estimate import Estimate, Task
from ..pipeline.radio_stages import heights_given, tag_rises
from ..pipeline.recordings import Recordings
from ..sensor_log.sensors import name_and_number
from . import plausibility
from .range_agreement import DISAGREE
from .residual_tests import NO_DISTANCES

_ABOUT_PARTS = ("anchor-mirror-ambiguous", "no-anchor")
"""Doubts that do not concern all anchors."""
_SHORT = 0.5
"""m by which no obstacle and no radio makes a range shorter than the distance; errors of the path stay below it."""
_FEW_SHORT, _SHARE_SHORT = 3, 0.05
"""Of an anchor's ranges, gross errors; in recordings without faults there was one at most."""
_IMPLAUSIBLE_BIAS = 1.6
"""Constant error of an anchor's ranges, m, twice that of the worst radios: its place is more probably wrong."""
_SHOWN = 0.7
"""A calibration value is 'estimated' when the recording brought its sigma below this share of the prior's."""


def summarise(estimate: Estimate, covariance: Covariances, grid: OccupancyGrid | None, task: Task) -> MapResult:
    """Gather the result; see MapResult."""
    recordings, stages, graph, ranges = task.recordings, task.stages, estimate.graph, estimate.ranges
    residuals, typical = np.zeros(0), 0.0
    if ranges is not None:
        residuals = -ranges.residuals(graph)[:, 0] * ranges.sigma
        own = [residuals[ranges.anchor == k] for k in np.flatnonzero(estimate.placed)]
        typical = float(np.median([spread_about_median(r) for r in own])) if own else 0.0
    # Relative to the scatter of a typical anchor's ranges; relative to its own scatter, no anchor would ever disagree.
    limit = OUTLIER * max(typical, 0.05)
    anchors = tuple(_anchor(k, estimate, recordings, covariance, residuals, limit) for k in range(len(estimate.anchor_ids)))
    anchors = _with_times(anchors, ranges, recordings)
    listed = {
        u.key: u
        for r in recordings.each
        for u in unknowns(task.config.calibration, r.anchor_ids, heights_given(r), r.number, tag_rises(r))
    }
    by_steps = {fact.figures["name"]: fact.figures["sigma"] for fact in stages.facts if fact.kind == "turn-scale"}
    calibrated = tuple(
        _calibration(k, listed[key], graph, covariance, by_steps.get(key.label)) for k, key in enumerate(graph.calibration.keys)
    )
    table = {} if ranges is None else _range_table(ranges, graph, residuals, limit, recordings)
    shape = shape_error(graph.poses[covariance.chosen], covariance.among)
    plausibility.judge(plausibility.ResultView(task, estimate, anchors, calibrated, listed, table, grid, shape))
    anchors = _distrusted(anchors, stages.doubts)
    stages.end("summary", passes=stages.passes)
    stamps = [recording.trajectory_stamps for recording in recordings.each]
    return MapResult(
        stamps=np.concatenate(stamps),
        trajectory=np.concatenate([r.dense_trajectory(graph.poses, t) for r, t in zip(recordings.each, stamps, strict=True)]),
        recording=np.repeat(np.arange(len(recordings)), [len(own) for own in stamps]),
        keyframe_stamps=recordings.stamps,
        keyframe_recording=recordings.of_keyframe,
        keyframe_covariances=covariance.poses,
        graph=graph,
        anchors=anchors,
        calibration=calibrated,
        closures=estimate.closures.candidates,
        range_table=table,
        grid=grid,
        stages=tuple(stages.done),
        findings=tuple(stages.findings),
        shape_poses=graph.poses[covariance.chosen],
        shape_covariances=about_best_fit(graph.poses[covariance.chosen], covariance.among),
    )


def _distrusted(anchors: tuple[AnchorEstimate, ...], doubts: Sequence[Finding]) -> tuple[AnchorEstimate, ...]:
    """Return the anchors, none of them 'ok' where a doubt is about the whole map."""
    if all(doubt.kind in _ABOUT_PARTS for doubt in doubts):
        return anchors
    return tuple(replace(a, status="distrusted", reason="the map is doubted") if a.status == "ok" else a for a in anchors)


def _range_table(
    ranges: RangeEdges, graph: Graph, residuals: Floats, limit: float, recordings: Recordings
) -> dict[str, Floats]:
    """Return the table of all ranges; see MapResult.range_table. Those agree whose residuals are below a limit, m."""
    x, y = ranges.tag_positions(graph.poses).T
    return {
        "stamp": ranges.stamps,
        "anchor": ranges.anchor.astype(np.float64),
        "range": ranges.ranges,
        "residual": residuals + ranges.ranges - ranges.corrected,
        "weight": ranges.own_weights * ranges.kernel.weight((residuals / ranges.sigma) ** 2),
        "agrees": (np.abs(residuals) < limit).astype(np.float64),
        "x": x,
        "y": y,
        "theta": ranges.headings(graph.poses),
        "recording": recordings.of_keyframe[ranges.pose].astype(np.float64),
    }


def _anchor(
    k: int, estimate: Estimate, recordings: Recordings, covariance: Covariances, residuals: Floats, limit: float
) -> AnchorEstimate:
    graph, found, ranges, name = estimate.graph, estimate.bootstrap, estimate.ranges, estimate.anchor_ids[k]
    if ranges is not None:
        count = int(np.sum(ranges.anchor == k))
    else:
        logs = [(r.log.ranges, r.anchor_ids.index(name)) for r in recordings.each if name in r.anchor_ids]
        count = sum(int(np.sum(own.anchor == index)) for own, index in logs if own is not None)
    if found is None or ranges is None or not found.placed[k]:
        reason = f"its {count} ranges were too few or did not agree on a place"
        nowhere = np.full(2, np.nan)
        return AnchorEstimate(name, nowhere, np.full((2, 2), np.nan), count, 0.0, np.nan, np.nan, np.nan, "unplaced", reason)
    own = residuals[ranges.anchor == k]
    # A share by distance, not by kernel weight: effective sigmas are large where ranges are correlated.
    used = float(np.mean(np.abs(own) < limit))
    # The bias in the first recording with ranges to it, by the first tag; the others are in the calibration.
    bias_at = int(ranges.calibration[ranges.anchor == k, 1].min())
    bias = float(graph.calibration.values[bias_at]) if bias_at >= 0 else 0.0
    bias_sigma = float(covariance.calibration[bias_at]) if bias_at >= 0 else 0.0
    status, reason, alternative = "ok", "", None
    if found.ambiguous[k] and len(found.hypotheses[k]) > 1:
        status, alternative = "mirror-ambiguous", found.hypotheses[k][1].position
        reason = "the path past it is too straight: a mirrored place explains its ranges about as well"
    sigma, longest = float(np.sqrt(np.trace(covariance.anchors[k]))), float(ranges.ranges[ranges.anchor == k].max())
    scatter = spread_about_median(own)
    # Readings that are no distances, or were left out as made on the way from place to place, are not short.
    measured = own[ranges.alive[ranges.anchor == k]]
    short = int(np.sum(measured + max(bias, 0.0) < -max(limit, _SHORT)))
    doubtful = _reason_to_distrust(used, sigma, longest, bias, scatter)
    if not doubtful and short > max(_FEW_SHORT, _SHARE_SHORT * len(measured)):
        doubtful = (
            f"{short} of its {len(measured)} ranges are too short for its place by {_SHORT} m or more: it stood elsewhere for "
            "a time, or another anchor has its name?"
        )
    if doubtful:
        # The mirror image of a place that its ranges contradict is contradicted as well.
        status, reason, alternative = "distrusted", "; ".join(filter(None, (doubtful, reason))), None
    return AnchorEstimate(
        name,
        graph.anchors[k],
        covariance.anchors[k],
        count,
        used,
        bias,
        bias_sigma,
        scatter,
        status,
        reason,
        alternative,
        short=short,
    )


def _reason_to_distrust(used: float, sigma: float, longest: float, bias: float, scatter: float) -> str:
    """Return the reason why an anchor is distrusted, '' where it is not.

    By the share of its ranges that agree with the map, the standard deviation of its place, m, its longest range, m (it stands
    nearer than that), the constant error and the robust standard deviation of its ranges, m.
    """
    if used < DISAGREE:
        return f"only {used:.0%} of its ranges agree with the map"
    if not sigma < longest:
        return f"its place is known to {sigma:.3g} m only, and its longest range is {longest:.1f} m"
    if abs(bias) > _IMPLAUSIBLE_BIAS:
        return f"its ranges fit only with a constant error of {bias:.1f} m, which no radio has"
    if scatter > NO_DISTANCES:
        return f"its ranges scatter by {scatter:.1f} m about the map: they are not distances to one place"
    return ""


def _with_times(
    anchors: tuple[AnchorEstimate, ...], ranges: RangeEdges | None, recordings: Recordings
) -> tuple[AnchorEstimate, ...]:
    """Report of anchors that were moved from when on each place holds, on the clock of the recording that shows it."""
    bases = np.array([name_and_number(a.id)[0] for a in anchors])
    if ranges is None or len(set(bases)) == len(bases):
        return anchors
    recording, dated = recordings.of_keyframe[ranges.pose], list(anchors)
    for k in range(len(anchors)):
        own = ranges.anchor == k
        if np.sum(bases == bases[k]) > 1 and own.any():
            # The first recording with ranges to this place and to another of the anchor; else the first with the one.
            others = np.isin(ranges.anchor, np.flatnonzero(bases == bases[k])) & ~own
            both = np.intersect1d(recording[own], recording[others])
            at = (both if len(both) else recording[own]).min()
            dated[k] = replace(anchors[k], since=float(np.min(ranges.stamps[own & (recording == at)])))
    return tuple(dated)


def _calibration(
    k: int, unknown: Unknown, graph: Graph, covariance: Covariances, by_steps: float | None
) -> CalibrationEstimate:
    """Return one value; by_steps: its standard deviation where the lidar's own turns fixed it before."""
    value, sigma, state, why = float(graph.calibration.values[k]), float(covariance.calibration[k]), "estimated", ""
    if by_steps is not None:
        sigma = by_steps
    elif graph.fixed_calibration[k]:
        sigma, state, why = unknown.sigma, "prior", "this recording has no measurement of it" if value == 0.0 else "fixed"
    elif sigma > _SHOWN * unknown.sigma:
        state, why = "prior", "the recording does not show it better than the prior"
    return CalibrationEstimate(unknown.key, value, sigma, unknown.unit, unknown.meaning, state, why)
