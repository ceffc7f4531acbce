"""Checks of UWB ranges: counts, implausible readings, spikes, noise, coverage, mirror ambiguity."""

from typing import Any

import numpy as np

from ..arrays import Floats, white_noise
from ..map_result import AnchorEstimate, CalibrationEstimate
from ..sensor_log import LONGEST_RANGE, SHORTEST_RANGE, SensorLog, UwbRanges, plausible
from .findings import Findings, timing
from .odometry import STRAIGHT, straightness

FEW = 10
"""Ranges from which an anchor cannot be placed."""


def check_ranges(log: SensorLog, found: Findings) -> dict[str, Any]:
    """Check the ranges and return their figures."""
    ranges = log.ranges
    assert ranges is not None
    figures: dict[str, Any] = timing(ranges.stamps, "radio", found, expected_gap=3.0, repeats=_repeats(ranges))
    positive = ranges.ranges[ranges.ranges > 0]
    if len(positive) > FEW and np.quantile(positive, 0.95) < 0.1:
        found.warning("radio", f"95 % of the ranges are below {np.quantile(positive, 0.95):.3f} m", "check the unit: metres")
    travelled = log.odometry.travelled_at(ranges.stamps)
    where = log.odometry.at(ranges.stamps)[:, :2]
    figures["anchors"] = {}
    for index, anchor_id in enumerate(ranges.anchor_ids):
        mine = ranges.anchor == index
        figures["anchors"][anchor_id] = _check_anchor(
            anchor_id, ranges.stamps[mine], ranges.ranges[mine], travelled[mine], where[mine], found
        )
    figures["coverage"] = _check_coverage(log, found)
    return figures


def _repeats(ranges: UwbRanges) -> float:
    """Return the share of readings of an anchor that have the stamp of another of the same anchor.

    The ranges of one round share its stamp: only a second one of the same anchor shows stamps that are too coarse.
    """
    order = np.lexsort((ranges.stamps, ranges.anchor))
    stamps, anchor = ranges.stamps[order], ranges.anchor[order]
    again = (stamps[1:] == stamps[:-1]) & (anchor[1:] == anchor[:-1])
    return float(np.mean(again)) if len(again) else 0.0


def _check_anchor(
    anchor_id: str, stamps: Floats, values: Floats, travelled: Floats, where: Floats, found: Findings
) -> dict[str, Any]:
    usable, zeros = plausible(values), int(np.sum(np.abs(values) <= SHORTEST_RANGE))
    absurd = int(np.sum(~usable)) - zeros
    spikes, noise = _spikes(values[usable], travelled[usable])
    count = len(values)
    if zeros + absurd > 0.01 * count:
        found.add(
            "warning" if zeros + absurd > 0.1 * count else "note",
            "radio",
            f"anchor {anchor_id}: {zeros} of {count} readings are zero and {absurd} negative or beyond {LONGEST_RANGE:.0f} m",
            "they are left out; a radio that reports zero has missed its partner",
        )
    if int(usable.sum()) < FEW:
        found.warning(
            "radio", f"anchor {anchor_id}: only {int(usable.sum())} usable ranges", "it cannot be placed; drive nearer to it"
        )
        return {"count": count, "zeros": zeros, "absurd": absurd}
    share = spikes / int(usable.sum())
    if share > 0.02:
        found.add(
            "warning" if share > 0.15 else "note",
            "radio",
            f"anchor {anchor_id}: {100 * share:.0f} % of the ranges jump farther than the robot drove (line of sight blocked?)",
            "they are down-weighted; a higher or more open place helps the anchor",
        )
    width = straightness(where[usable])
    if width < STRAIGHT:
        found.warning(
            "radio",
            f"anchor {anchor_id} was in reach on a straight path only: it may stand on either side of it",
            "drive a curve within its reach; until then its mirror image is as likely",
        )
    return {
        "count": count,
        "rate Hz": round(count / max(float(np.ptp(stamps)), 1e-9), 3) if count > 1 else 0.0,
        "zeros": zeros,
        "absurd": absurd,
        "spikes": spikes,
        "noise m": round(noise, 4),
        "nearest m": round(float(values[usable].min()), 3),
        "farthest m": round(float(values[usable].max()), 3),
        "width of the path by its length": round(width, 4),
    }


def _spikes(values: Floats, travelled: Floats) -> tuple[int, float]:
    """Count readings that no motion explains, and estimate the short-term noise, m.

    Of two readings of one anchor the later differs by at most the distance driven, apart from noise. A spike leaves the
    median of its neighbours (two before, two after) by more than that motion and five times the noise.
    """
    if len(values) < 5:
        return 0, 0.0
    noise = white_noise(values)
    windows = np.lib.stride_tricks.sliding_window_view(values, 5)
    around = np.median(windows[:, [0, 1, 3, 4]], axis=1)
    driven = travelled[4:] - travelled[:-4]
    return int(np.sum(np.abs(windows[:, 2] - around) > driven + 5.0 * max(noise, 0.03))), noise


_WINDOW = 2.0
"""s."""


def _check_coverage(log: SensorLog, found: Findings) -> dict[str, float]:
    """Share of the time in which at least one, two and three anchors are in reach within a window."""
    ranges = log.ranges
    assert ranges is not None
    start, end = float(log.odometry.stamps[0]), float(log.odometry.stamps[-1])
    usable = plausible(ranges.ranges) & (ranges.stamps >= start) & (ranges.stamps <= end)
    # Windows without ranges are only counted, however long the recording claims to be.
    windows = max(1.0, np.ceil((end - start) / _WINDOW))
    slot = np.floor((ranges.stamps[usable] - start) / _WINDOW)
    measured = np.unique(np.stack([slot, ranges.anchor[usable].astype(np.float64)]), axis=1)
    count = np.unique(measured[0], return_counts=True)[1]
    shares = {f"at least {n}": round(min(float(np.sum(count >= n)) / float(windows), 1.0), 3) for n in (1, 2, 3)}
    if len(ranges.anchor_ids) > 1 and shares["at least 2"] < 0.5:
        found.warning(
            "radio",
            f"two anchors or more are in reach in only {100 * shares['at least 2']:.0f} % of the time",
            "place them so that two reach every spot; where one is in reach, the heading rests on the wheels",
        )
    if len(ranges.anchor_ids) == 1:
        found.note("radio", "there is one anchor", "it bounds the drift in distance, not in heading; two or more hold the map")
    return shares


def check_calibration(
    anchors: tuple[AnchorEstimate, ...], calibration: tuple[CalibrationEstimate, ...], found: Findings
) -> dict[str, Any]:
    """Check wheels, clocks and anchors by a map from wheels and radio alone."""
    figures: dict[str, Any] = {}
    limits = {
        "odometry_scale": (
            0.03,
            "the wheels are off against the radio by {:+.1%}",
            "set the wheel radius; uwblite corrects it",
        ),
        "heading_scale": (0.05, "the wheels' turns are off by {:+.1%}", "set the track width; uwblite corrects it"),
        "range_scale": (0.03, "all ranges are off by {:+.1%}", "calibrate the radio; uwblite corrects it"),
        "range_delay": (0.1, "the ranges' stamps need {:+.2f} s to suit the odometry", "uwblite corrects it; stamp on arrival"),
    }
    for value in calibration:
        if value.state != "estimated":
            continue
        figures[value.name] = {
            "value": round(value.value, 5), "sigma": round(value.sigma, 5), "unit": value.unit, "meaning": value.meaning,
        }  # fmt: skip
        limit, text, advice = limits.get(value.name, (np.inf, "", ""))
        if abs(value.value) > max(limit, 5.0 * value.sigma):
            found.warning("radio" if "range" in value.name else "odometry", text.format(value.value), advice)
    figures["bias guess m"] = {
        a.id: {"bias": round(a.bias, 3), "sigma": round(a.bias_sigma, 3)} for a in anchors if a.status == "ok"
    }
    for anchor in anchors:
        if anchor.status == "ok" and abs(anchor.bias) > max(0.3, 3.0 * anchor.bias_sigma):
            found.note(
                "radio",
                f"anchor {anchor.id} measures about {anchor.bias:+.2f} m too much (guess from wheels and radio)",
                "usual for uncalibrated antenna delay; uwblite estimates it for each anchor",
            )
        elif anchor.status != "ok":
            found.warning(
                "radio", f"anchor {anchor.id}: {anchor.status}: {anchor.reason}", "see the coverage and the path above"
            )
    return figures
