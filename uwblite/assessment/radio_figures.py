"""Figures of UWB ranges before a map is made, and what they show: counts, implausible readings, spikes, noise, coverage."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from ..arrays import Floats, white_noise
from ..findings import NOTE, WARNING, Finding
from ..map_result import AnchorEstimate, CalibrationEstimate
from ..sensor_log import LONGEST_RANGE, SHORTEST_RANGE, SensorLog, UwbRanges, plausible
from .odometry_figures import FINEST, STRAIGHT, check_equal_stamps, check_silences, rhythm, straightness

FEW = 10
"""Ranges from which an anchor cannot be placed."""
_MISSED, _MANY_MISSED = 0.01, 0.1
"""Shares of readings that measure nothing, for a note and for a warning."""
_SPIKES, _MANY_SPIKES = 0.02, 0.15
"""Shares of ranges that no motion explains, for a note and for a warning."""
_WINDOW = 2.0
"""s; anchors within it are in reach at one time."""
_SELDOM = 0.5
"""Share of the time in which two anchors are in reach, below which the heading often rests on the wheels."""


def radio_figures(log: SensorLog) -> dict[str, Any]:
    """Return rhythm, each anchor's figures and the coverage of the ranges."""
    ranges = log.ranges
    assert ranges is not None
    travelled, where = log.odometry.travelled_at(ranges.stamps), log.odometry.at(ranges.stamps)[:, :2]
    figures: dict[str, Any] = rhythm(ranges.stamps, expected_gap=3.0, repeated=_repeats(ranges))
    figures["anchors"] = {}
    for index, anchor_id in enumerate(ranges.anchor_ids):
        own = ranges.anchor == index
        figures["anchors"][anchor_id] = _anchor_figures(ranges.stamps[own], ranges.ranges[own], travelled[own], where[own])
    figures["coverage"] = _coverage(log, ranges)
    return figures


def check_radio(figures: dict[str, Any]) -> Iterator[Finding]:
    """Yield what the figures of the ranges show."""
    yield from check_silences("radio", figures)
    yield from check_equal_stamps("radio", figures)
    for anchor_id, own in figures["anchors"].items():
        yield from _check_anchor(anchor_id, own)
    share = figures["coverage"]["at least 2"]
    if len(figures["anchors"]) > 1 and share < _SELDOM:
        text = f"two anchors or more are in reach in only {100 * share:.0f} % of the time"
        cure = "place them so that two reach every spot; where one is in reach, the heading rests on the wheels"
        yield Finding("few-in-reach", WARNING, text, cure, "radio")
    if len(figures["anchors"]) == 1:
        cure = "it bounds the drift in distance, not in heading; two or more hold the map"
        yield Finding("one-anchor", NOTE, "there is one anchor", cure, "radio")


def _repeats(ranges: UwbRanges) -> float:
    """Return the share of readings of an anchor that have the stamp of another of the same anchor.

    The ranges of one round share its stamp: only a second one of the same anchor shows stamps that are too coarse.
    """
    order = np.lexsort((ranges.stamps, ranges.anchor))
    stamps, anchor = ranges.stamps[order], ranges.anchor[order]
    again = (np.diff(stamps) <= FINEST) & (anchor[1:] == anchor[:-1])
    return float(np.mean(again)) if len(again) else 0.0


def _anchor_figures(stamps: Floats, values: Floats, travelled: Floats, where: Floats) -> dict[str, Any]:
    """Return the figures of the ranges (n,) to one anchor; where : (n, 2) m, of the robot."""
    usable, zeros, count = plausible(values), int(np.sum(np.abs(values) <= SHORTEST_RANGE)), len(values)
    figures: dict[str, Any] = {"count": count, "zeros": zeros, "absurd": int(np.sum(~usable)) - zeros}
    if int(usable.sum()) < FEW:
        return figures
    spikes, noise = _spikes(values[usable], travelled[usable])
    return figures | {
        "rate Hz": round(count / max(float(np.ptp(stamps)), 1e-9), 3) if count > 1 else 0.0,
        "spikes": spikes,
        "noise m": round(noise, 4),
        "nearest m": round(float(values[usable].min()), 3),
        "farthest m": round(float(values[usable].max()), 3),
        "width of the path by its length": round(straightness(where[usable]), 4),
    }


def _check_anchor(name: str, figures: dict[str, Any]) -> Iterator[Finding]:
    """Yield what the figures of one anchor show."""
    count, missed = figures["count"], figures["zeros"] + figures["absurd"]
    if missed > _MISSED * count:
        text = (
            f"anchor {name}: {figures['zeros']} of {count} readings are zero and {figures['absurd']} negative or beyond "
            f"{LONGEST_RANGE:.0f} m"
        )
        cure = "they are left out; a radio that reports zero has missed its partner"
        yield Finding("missed-ranges", WARNING if missed > _MANY_MISSED * count else NOTE, text, cure, "radio", anchor=name)
    usable = count - missed
    if usable < FEW:
        text = f"anchor {name}: only {usable} usable ranges"
        yield Finding("few-ranges", WARNING, text, "it cannot be placed; drive nearer to it", "radio", anchor=name)
        return
    share = figures["spikes"] / usable
    if share > _SPIKES:
        text = f"anchor {name}: {100 * share:.0f} % of the ranges jump farther than the robot drove (line of sight blocked?)"
        cure = "they are down-weighted; a higher or more open place helps the anchor"
        yield Finding("spikes", WARNING if share > _MANY_SPIKES else NOTE, text, cure, "radio", anchor=name)
    if figures["width of the path by its length"] < STRAIGHT:
        text = f"anchor {name} was in reach on a straight path only: it may stand on either side of it"
        cure = "drive a curve within its reach; until then its mirror image is as likely"
        yield Finding("straight-path", WARNING, text, cure, "radio", anchor=name)


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


def _coverage(log: SensorLog, ranges: UwbRanges) -> dict[str, float]:
    """Return the share of the time in which at least one, two and three anchors are in reach within a window."""
    start, end = float(log.odometry.stamps[0]), float(log.odometry.stamps[-1])
    usable = plausible(ranges.ranges) & (ranges.stamps >= start) & (ranges.stamps <= end)
    # Windows without ranges are only counted, however long the recording claims to be.
    windows = max(1.0, np.ceil((end - start) / _WINDOW))
    slot = np.floor((ranges.stamps[usable] - start) / _WINDOW)
    measured = np.unique(np.stack([slot, ranges.anchor[usable].astype(np.float64)]), axis=1)
    count = np.unique(measured[0], return_counts=True)[1]
    return {f"at least {n}": round(min(float(np.sum(count >= n)) / float(windows), 1.0), 3) for n in (1, 2, 3)}


def calibration_figures(anchors: tuple[AnchorEstimate, ...], calibration: tuple[CalibrationEstimate, ...]) -> dict[str, Any]:
    """Return what a map tells of wheels, clocks and the bias of each anchor."""
    figures: dict[str, Any] = {
        value.name: {
            "value": round(value.value, 5),
            "sigma": round(value.sigma, 5),
            "unit": value.unit,
            "meaning": value.meaning,
        }
        for value in calibration
        if value.state == "estimated"
    }
    figures["bias guess m"] = {
        a.id: {"bias": round(a.bias, 3), "sigma": round(a.bias_sigma, 3)} for a in anchors if a.status == "ok"
    }
    return figures
