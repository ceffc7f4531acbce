"""From the optimised graph to the result: anchors, calibration, doubts, in the user's words."""

from collections.abc import Sequence

import numpy as np

from ..arrays import Floats
from ..graph.calibration import CalibrationConfig, Unknown, unknowns
from ..graph.graph import Graph
from ..graph.marginals import Marginals
from ..graph.range_edges import RangeEdges
from ..grid.occupancy_grid import OccupancyGrid
from ..keyframes import OUTSIDE
from ..loop_closure.closures import Closures
from ..map_result import AnchorEstimate, CalibrationEstimate, MapResult, StageSummary
from . import plausibility
from .recordings import Estimate, Recording, Recordings

_SHOWN = 0.7
"""A calibration value is 'estimated' when the recording brought its sigma below this share of the prior's."""
_POOR = 4.0
"""chi2 per degree of freedom beyond which errors are twice what the noise allows: the model does not hold."""


def summarise(
    recordings: Recordings, estimate: Estimate, known: Marginals, closures: Closures, grid: OccupancyGrid | None,
    config: CalibrationConfig, stages: Sequence[StageSummary], warnings: Sequence[str],
    doubts: Sequence[str],
) -> MapResult:
    """Gather the result of a run; see MapResult."""
    graph, first, radio = estimate.graph, estimate.first, estimate.radio
    residuals, weights = _range_residuals(graph, radio)
    typical = 0.0
    if first is not None and radio is not None and first.placed.any():
        typical = float(np.median([_spread(residuals[radio.anchor == k]) for k in np.flatnonzero(first.placed)]))
    # By what ranges to a typical anchor scatter; by its own scatter, no anchor would ever lie.
    limit = 3.0 * max(typical, 0.05)
    anchors = tuple(_anchor(k, estimate, recordings, known, residuals, limit) for k in range(len(estimate.anchor_ids)))
    listed = {u.name: u for recording in recordings.each for u in _unknowns(recording, config)}
    calibrated = tuple(_calibration(k, listed[name], graph, known) for k, name in enumerate(graph.calibration.names))
    table = {} if radio is None else {
        "stamp": radio.stamps, "anchor": radio.anchor.astype(np.float64), "range": radio.ranges,
        "residual": residuals, "weight": weights, "agrees": (np.abs(residuals) < limit).astype(np.float64),
    }
    more, own_doubts = _doubts(recordings, anchors, closures, grid)
    more += plausibility.implausible_calibration(calibrated, listed, config) + plausibility.ranges_outside_odometry(
        recordings, OUTSIDE
    )
    more += plausibility.sustained_outliers(table, estimate.anchor_ids, float(recordings.stamps[0])) if table else []
    own_doubts += plausibility.mirror_ambiguity(graph, recordings, config)
    fits = [float(stage.figures["chi2_per_dof"]) for stage in stages if "chi2_per_dof" in stage.figures]
    if fits and fits[-1] > _POOR:
        times = float(np.sqrt(fits[-1]))
        own_doubts.append(f"measurements lie {times:.1f} times as far off as their noise allows (chi2/dof {fits[-1]:.1f})")
    stamps = [recording.log.odometry.stamps for recording in recordings.each]
    return MapResult(
        stamps=np.concatenate(stamps),
        trajectory=np.concatenate([recording.dense_trajectory(graph.poses) for recording in recordings.each]),
        recording=np.repeat(np.arange(len(recordings)), [len(own) for own in stamps]),
        keyframe_stamps=recordings.stamps,
        keyframe_recording=recordings.of_keyframe,
        keyframe_covariances=known.poses,
        graph=graph,
        anchors=anchors,
        calibration=calibrated,
        closures=closures.candidates,
        range_table=table,
        grid=grid,
        stages=tuple(stages),
        warnings=(*warnings, *more),
        doubts=(*doubts, *own_doubts),
    )


def _unknowns(recording: Recording, config: CalibrationConfig) -> tuple[Unknown, ...]:
    ids, mounting = recording.anchor_ids, recording.log.mounting
    told = np.array([mounting.height_difference(a) is not None for a in ids], dtype=bool)
    return unknowns(config, ids, told, recording.number)


def _range_residuals(graph: Graph, radio: RangeEdges | None) -> tuple[Floats, Floats]:
    """Return residuals (m,), m, and final weights (m,) of all ranges."""
    if radio is None:
        return np.zeros(0), np.zeros(0)
    whitened = radio.residuals(graph)[:, 0]
    own = np.ones(len(radio)) if radio.weights is None else radio.weights
    return whitened * radio.sigma, own * radio.kernel.weight(whitened**2)


def _spread(residuals: Floats) -> float:
    """Return the robust standard deviation of residuals about their median."""
    return 1.4826 * float(np.median(np.abs(residuals - np.median(residuals))))


def _anchor(
    k: int, estimate: Estimate, recordings: Recordings, known: Marginals, residuals: Floats, limit: float
) -> AnchorEstimate:
    graph, first, radio, name = estimate.graph, estimate.first, estimate.radio, estimate.anchor_ids[k]
    count = _count(name, recordings) if radio is None else int(np.sum(radio.anchor == k))
    if first is None or radio is None or not first.placed[k]:
        reason = f"its {count} ranges were too few or did not agree on a place"
        nowhere = np.full(2, np.nan)
        return AnchorEstimate(name, nowhere, np.full((2, 2), np.nan), count, 0.0, np.nan, np.nan, np.nan, "unplaced", reason)
    own = residuals[radio.anchor == k]
    # A share by distance, not by kernel weight: effective sigmas are wide where ranges repeat each other.
    used = float(np.mean(np.abs(own) < limit))
    # The bias in the first recording that heard it; in the others it is theirs, see the calibration.
    bias_at = int(radio.calibration[np.argmax(radio.anchor == k), 1])
    bias = float(graph.calibration.values[bias_at]) if bias_at >= 0 else 0.0
    bias_sigma = float(known.calibration[bias_at]) if bias_at >= 0 else 0.0
    status, reason, alternative = "ok", "", None
    if first.ambiguous[k] and len(first.hypotheses[k]) > 1:
        status, alternative = "mirror-ambiguous", first.hypotheses[k][1].position
        reason = "the path past it is too straight: a mirrored place explains its ranges about as well"
    elif used < 0.5:
        status, reason = "distrusted", f"only {used:.0%} of its ranges agree with the map"
    return AnchorEstimate(
        name, graph.anchors[k], known.anchors[k], count, used, bias, bias_sigma, _spread(own), status, reason, alternative
    )


def _count(name: str, recordings: Recordings) -> int:
    """Return how many ranges to an anchor the recordings hold."""
    heard = [(s.log.ranges, s.anchor_ids.index(name)) for s in recordings.each if name in s.anchor_ids]
    return sum(int(np.sum(ranges.anchor == k)) for ranges, k in heard if ranges is not None)


def _calibration(k: int, unknown: Unknown, graph: Graph, known: Marginals) -> CalibrationEstimate:
    value, fixed = float(graph.calibration.values[k]), graph.fixed_calibration
    if fixed is not None and fixed[k]:
        why = "this recording has no measurement of it" if value == 0.0 else "held"
        return CalibrationEstimate(unknown.name, value, unknown.sigma, unknown.unit, unknown.meaning, "prior", why)
    sigma = float(known.calibration[k])
    if sigma > _SHOWN * unknown.sigma:
        why = "the recording does not show it better than the prior"
        return CalibrationEstimate(unknown.name, value, sigma, unknown.unit, unknown.meaning, "prior", why)
    return CalibrationEstimate(unknown.name, value, sigma, unknown.unit, unknown.meaning, "estimated")


def _doubts(
    recordings: Recordings, anchors: tuple[AnchorEstimate, ...], closures: Closures, grid: OccupancyGrid | None
) -> tuple[list[str], list[str]]:
    """Return warnings and reasons not to trust the result."""
    warnings: list[str] = []
    doubts: list[str] = []
    for anchor in anchors:
        if anchor.status != "ok":
            (doubts if anchor.status == "mirror-ambiguous" else warnings).append(
                f"anchor {anchor.id} is {anchor.status}: {anchor.reason}"
            )
    placed = [a for a in anchors if a.status != "unplaced"]
    if anchors and not placed:
        doubts.append("no anchor could be placed: the trajectory rests on odometry and lidar alone")
    logs = [recording.log for recording in recordings.each]
    if not any(log.ranges is not None and len(log.ranges.ranges) for log in logs):
        warnings.append("no UWB ranges in use: the map rests on odometry and lidar")
    if grid is None:
        warnings.append("no lidar in use: trajectory and anchors only, no map")
    elif not any(log.scans is not None and np.isfinite(log.scans.ranges).any() for log in logs):
        warnings.append("the lidar saw nothing in any scan: the map is empty")
    accepted = sum(c.accepted for c in closures.candidates)
    if grid is not None and closures.candidates and accepted == 0:
        text = "no loop closure was accepted"
        (doubts if not placed else warnings).append(text)
    contradicted = sum("contradicts the other" in c.reason and not c.accepted for c in closures.candidates)
    if contradicted > max(accepted, 4):
        doubts.append(f"{contradicted} loop closures contradict the rest, {accepted} agree")
    return warnings, doubts
