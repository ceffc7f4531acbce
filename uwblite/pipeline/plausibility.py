"""What in the estimates themselves tells against them: values far from usual, turns of the wrong sign, readings out of time."""

from collections.abc import Sequence

import numpy as np

from ..arrays import Bools, Floats
from ..graph.calibration import CalibrationConfig, Unknown, stem
from ..graph.graph import Graph, PriorEdges
from ..map_result import CalibrationEstimate
from .recordings import Recordings

_UNUSUAL = 3.0
"""Prior standard deviations beyond which an estimate is told."""
_RADIO_OR_WHEELS = "check the radio's settings and, where no lidar measures the distances, the scale of the wheels"
_WRONG_TURNS = 0.25
"""Relative error of the wheels' turns beyond which their sign is no longer sure."""


def implausible_calibration(
    calibrated: Sequence[CalibrationEstimate], usual: dict[str, Unknown], config: CalibrationConfig
) -> list[str]:
    """Return a warning for each estimate clearly far outside what is usual.

    Parameters
    ----------
    calibrated : estimates.
    usual : unknowns with their prior standard deviations, by name.
    config : says what scale of its ranges a sound radio has.
    """
    told = []
    for value in calibrated:
        sigma = config.range_scale_sound if value.name == "range_scale" else usual[value.name].sigma
        clear = abs(value.value) > _UNUSUAL * max(sigma, value.sigma)
        if value.state == "estimated" and not value.name.startswith("height2") and clear:
            unit = "" if value.unit == "1" else f" {value.unit}"
            told.append(
                f"{value.meaning} came out as {value.value:+.3g} +- {value.sigma:.2g}{unit}, where {sigma:.2g}{unit} is usual: "
                + (_RADIO_OR_WHEELS if value.name == "range_scale" else "check that sensor and its settings")
            )
    return told


def mirror_ambiguity(graph: Graph, recordings: Recordings, config: CalibrationConfig) -> list[str]:
    """Return a doubt for each recording whose ranges or scans fit only where the wheels' turns are scaled grossly.

    Ranges alone do not tell a map from its mirror image: a drive mirrored together with its anchors has the same ranges.
    Only the sign of the wheels' turns does, and a laser, or anchors known beforehand. Where turns must be scaled by a
    factor far from 1, by minus that factor the mirror image fits as well, and nothing vouches for the sign. A laser that
    sees the turns go the other way may itself be upside down.
    """
    known = sum(len(e) for e in graph.edges if isinstance(e, PriorEdges) and e.block == "anchors")
    if known > 2 or config.heading_scale <= 0.0:
        return []
    factors = [
        1.0 + float(value)
        for name, value in zip(graph.calibration.names, graph.calibration.values, strict=True)
        if stem(name) == "heading_scale" and abs(value) > _WRONG_TURNS
    ]
    if any(recording.has_scans for recording in recordings.each):
        return [
            f"the map may be mirrored: the wheels' turns agree with the laser's only when multiplied by {factor:.2f}; "
            "is the laser upside down (--laser-flipped), or does the odometry's heading count the other way?"
            for factor in factors
            if factor < 0.0
        ]
    return [
        f"the map may be mirrored: the wheels' turns agree with the ranges only when multiplied by {factor:.2f}, "
        f"and by {-factor:.2f} its mirror image fits as well; check sign and scale of the odometry's heading, "
        "or give the places of three anchors"
        for factor in factors
    ]


def outlier_stretches(stamps: Floats, agrees: Bools) -> list[tuple[float, float]]:
    """Return the stretches (first and last stamp, s) in which most of one anchor's readings (m,) disagree with the map.

    Bins of equal counts; fewer than 100 readings show no stretches.
    """
    if len(stamps) < 100:
        return []
    order = np.argsort(stamps, kind="stable")
    bins = np.array_split(order, min(40, len(order) // 20))
    bad = np.array([agrees[b].mean() < 0.4 for b in bins], dtype=bool)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], bad, [False]]).astype(np.int64)))
    runs = edges.reshape(-1, 2)
    return [(float(stamps[bins[a][0]]), float(stamps[bins[b - 1][-1]])) for a, b in runs if b - a >= 2]


def sustained_outliers(table: dict[str, Floats], anchor_ids: Sequence[str], start: float) -> list[str]:
    """Return a warning for each anchor that is wrong for long: something stood in its way, or it was moved.

    Parameters
    ----------
    table : MapResult.range_table. anchor_ids : names. start : stamp from which times are told, s.
    """
    told = []
    for k, name in enumerate(anchor_ids):
        own = (table["anchor"] == k) & (table["weight"] > 0)
        stretches = outlier_stretches(table["stamp"][own], table["agrees"][own] > 0.5) if own.any() else []
        if stretches:
            when = ", ".join(f"{a - start:.0f} to {b - start:.0f} s" for a, b in stretches[:4])
            told.append(
                f"anchor {name} disagrees with the map for long (t = {when}{' ...' if len(stretches) > 4 else ''}): "
                "its sight was blocked, or it was moved; these ranges count for little"
            )
    return told


def ranges_outside_odometry(recordings: Recordings, slack: float) -> list[str]:
    """Return a warning where ranges were stamped outside the odometry's time by more than the slack, s."""
    told = []
    for recording in recordings.each:
        ranges, odometry = recording.log.ranges, recording.log.odometry.stamps
        if ranges is None or not len(ranges.stamps):
            continue
        outside = int(np.sum((ranges.stamps < odometry[0] - slack) | (ranges.stamps > odometry[-1] + slack)))
        if outside:
            told.append(
                f"{outside} of {len(ranges.stamps)} ranges were stamped outside the odometry's time and left out: "
                "start the odometry first and stop it last, and use one clock"
            )
    return told
