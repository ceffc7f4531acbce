"""Figures of wheels, radio and lidar as a log has them, before a map is made, and the rules over these figures."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ..arrays import BEYOND_NOISE, CHUNK, Floats, chunks, white_noise
from ..findings import NOTE, WARNING, Finding
from ..map_result import AnchorEstimate, CalibrationEstimate
from ..screening.repeats import RepeatPolicy
from ..screening.units import CLEARLY, heading_agreement, heading_reading
from ..sensor_log import LONGEST_RANGE, SHORTEST_RANGE, Odometry, SensorLog, UwbRanges, plausible

Figures = dict[str, Any]


class CheckPolicy:
    """From where on something is worth a finding."""

    some: float = 0.02
    """Share of readings, or of the time, with a fault from which on it costs accuracy; and width of a path by its length below
    which its two sides cannot be distinguished."""
    many: float = 0.1
    """Share from which on it is a warning."""
    few: int = 10
    """Least number of ranges by which an anchor can be placed."""
    finest: float = 1.5e-6
    """s; stamps are written no finer than 1e-6, which `record` puts between rows that came in one piece."""
    periods: float = 5.0
    """Usual periods of a sensor, and seconds, that are a long silence."""
    slowest: float = 5.0
    """Hz; ranges and rays between odometry readings that are farther apart are placed badly at usual speeds."""
    window: float = 2.0
    """s; anchors within it are in reach at one time."""


def check_sensors(logs: Sequence[SensorLog]) -> Iterator[Finding]:
    """Warn of sensors without data in all recordings."""
    scans = [log.scans for log in logs if log.scans is not None and len(log.scans.stamps)]
    ranges = any(log.ranges is not None and len(log.ranges.stamps) for log in logs)
    if not ranges:
        text = "no UWB ranges in use: " + (
            "the map rests on odometry and lidar" if scans else "the path rests on odometry alone"
        )
        yield Finding("no-ranges", WARNING, text, "check the tag if that is not meant", "radio")
    if not scans:
        text = "no lidar in use: no map" + (
            ", and only the odometry's turns show that trajectory and anchors are not mirrored" if ranges else ""
        )
        yield Finding("no-lidar", WARNING, text, "check the lidar if that is not meant", "lidar")
    elif not any(np.isfinite(each.ranges).any() for each in scans):
        yield Finding("empty-scans", WARNING, "no scan has a reading: the map is empty", sensor="lidar")


def rhythm(stamps: Floats, *, expected_gap: float, repeated: float | None = None) -> Figures:
    """Return the figures of a sensor's rhythm.

    Parameters
    ----------
    stamps : (n,) s, non-decreasing.
    expected_gap : a silence longer than this is a gap, s (or five periods, where that is longer).
    repeated : share of equal stamps that is not right, where some are; None = any is wrong.
    """
    steps = np.diff(stamps)
    some = steps > CheckPolicy.finest
    period = float(np.median(steps[some])) if some.any() else 0.0
    gap = max(expected_gap, CheckPolicy.periods * period)
    longest = int(np.argmax(steps)) if len(steps) else 0
    equal = float(np.mean(~some)) if len(steps) else 0.0
    figures = {
        "duration s": stamps[-1] - stamps[0],
        "rate Hz": 1.0 / period if period else 0.0,
        "longest gap s": steps.max(initial=0.0),
        "longest gap at s": stamps[longest] - stamps[0],
        "gaps longer than s": gap,
        "silent s": steps[steps > gap].sum(),
        "share of equal stamps": equal,
        "share of wrongly equal stamps": equal if repeated is None else repeated,
    }
    return {"count": len(stamps), "gaps": int(np.sum(steps > gap))} | _rounded(figures)


def _rounded(figures: Mapping[str, float]) -> Figures:
    return {name: round(float(value), 4) for name, value in figures.items()}


def check_rhythm(sensor: str, figures: Figures) -> Iterator[Finding]:
    """Say when a sensor was silent: a warning where that is long, or much of the recording; and warn of equal stamps.

    Stamps that equal the one before are of low resolution, or of readings that arrived in one piece.
    """
    if figures["gaps"]:
        much = figures["silent s"] > CheckPolicy.some * figures["duration s"] or figures["longest gap s"] > CheckPolicy.periods
        text = (
            f"{figures['gaps']} silences longer than {figures['gaps longer than s']:.1f} s; the longest is "
            f"{figures['longest gap s']:.1f} s at t = {figures['longest gap at s']:.1f} s"
        )
        cure = "check cable, power and processor load at these times"
        yield Finding("silences", WARNING if much and sensor != "odometry" else NOTE, text, cure, sensor)
    share = figures["share of wrongly equal stamps"]
    if share > CheckPolicy.some:
        text = f"{share:.0%} of the stamps equal the one before"
        cure = "stamps of low resolution, or readings that arrived in one piece: stamp each reading when it is made"
        yield Finding("equal-stamps", NOTE if sensor == "radio" else WARNING, text, cure, sensor)


def odometry_figures(odometry: Odometry) -> Figures:
    """Return rhythm, path and speed of the wheels."""
    steps = odometry.steps
    length, span = np.hypot(steps[:, 0], steps[:, 1]), np.diff(odometry.stamps)
    moving = (length > 0.0) & (span > 0.0)
    agreement = {"agreement with the motion": heading_agreement(odometry)[0]}
    figures = {
        "path m": length.sum(),
        "turned rad": np.abs(steps[:, 2]).sum(),
        "speed m/s": np.median(length[moving] / span[moving]) if moving.any() else 0.0,
        "width of the path by its length": width_by_length(odometry.poses[:, :2]),
    }
    return rhythm(odometry.stamps, expected_gap=0.5) | {"heading": _rounded(agreement)} | _rounded(figures)


def check_odometry(odometry: Odometry, figures: Figures) -> Iterator[Finding]:
    """Warn of wheels that are read seldom, and of a robot that moves across its heading.

    The latter where neither another sign nor another unit of the heading explains it.
    """
    yield from check_rhythm("odometry", figures)
    reading = heading_reading(odometry)
    if not reading.sound and max(reading.mirrored, reading.degrees) < reading.plain + CLEARLY:
        text = f"the robot often moves across its heading (agreement {reading.plain:.2f} of 1)"
        cure = "right for an omnidirectional base; otherwise check the heading's unit and sign, and the axes"
        yield Finding("moves-across-heading", WARNING, text, cure, "odometry")
    if 0.0 < figures["rate Hz"] < CheckPolicy.slowest:
        text = f"only {figures['rate Hz']:.1f} readings a second"
        cure = "ranges and rays are placed between them by interpolation; 10 Hz or more is better"
        yield Finding("slow-odometry", WARNING, text, cure, "odometry")


def width_by_length(xy: Floats) -> float:
    """Return the width of the path by its length: ratio of the standard deviations along its principal axes."""
    small, large = np.linalg.eigvalsh(np.cov(xy.T)) if len(xy) > 2 else (0.0, 0.0)
    return float(np.sqrt(max(small, 0.0) / large)) if large > 0 else 0.0


def radio_figures(log: SensorLog) -> Figures:
    """Return rhythm, each anchor's figures and the coverage of the ranges."""
    ranges = log.ranges
    assert ranges is not None
    travelled, where = log.odometry.travelled_at(ranges.stamps), log.odometry.at(ranges.stamps)[:, :2]
    figures = rhythm(ranges.stamps, expected_gap=3.0, repeated=_repeats(ranges))
    figures["anchors"] = {}
    for index, anchor_id in enumerate(ranges.anchor_ids):
        own = ranges.anchor == index
        figures["anchors"][anchor_id] = _anchor_figures(ranges.stamps[own], ranges.ranges[own], travelled[own], where[own])
    figures["coverage"] = _coverage(log, ranges)
    return figures


def _repeats(ranges: UwbRanges) -> float:
    """Return the share of readings with the stamp of another of the same anchor; the ranges of one round share its stamp."""
    order = np.lexsort((ranges.stamps, ranges.anchor))
    stamps, anchor = ranges.stamps[order], ranges.anchor[order]
    again = (np.diff(stamps) <= CheckPolicy.finest) & (anchor[1:] == anchor[:-1])
    return float(np.mean(again)) if len(again) else 0.0


def _anchor_figures(stamps: Floats, values: Floats, travelled: Floats, where: Floats) -> Figures:
    """Return the figures of the ranges (n,) to one anchor; where : (n, 2) m, of the robot, frame of the odometry."""
    usable, zeros, count = plausible(values), int(np.sum(np.abs(values) <= SHORTEST_RANGE)), len(values)
    counts: Figures = {"count": count, "zeros": zeros, "absurd": int(np.sum(~usable)) - zeros}
    if int(usable.sum()) < CheckPolicy.few:
        return counts
    spikes, noise = _spikes(values[usable], travelled[usable])
    figures = {
        "rate Hz": count / max(float(np.ptp(stamps)), CheckPolicy.finest),
        "noise m": noise,
        "nearest m": values[usable].min(),
        "farthest m": values[usable].max(),
        "width of the path by its length": width_by_length(where[usable]),
    }
    return counts | {"spikes": spikes} | _rounded(figures)


def _spikes(values: Floats, travelled: Floats) -> tuple[int, float]:
    """Count ranges (n,) that leave the median of two before and two after by more than motion and noise; and the noise, m."""
    windows = np.lib.stride_tricks.sliding_window_view(values, 5)
    noise = white_noise(values)
    around = np.median(np.delete(windows, 2, axis=1), axis=1)
    limit = travelled[4:] - travelled[:-4] + BEYOND_NOISE * max(noise, RepeatPolicy.usual_noise)
    return int(np.sum(np.abs(windows[:, 2] - around) > limit)), noise


def _coverage(log: SensorLog, ranges: UwbRanges) -> dict[str, float]:
    """Return the share of the time in which at least one, two and three anchors are in reach within a window."""
    start, end = float(log.odometry.stamps[0]), float(log.odometry.stamps[-1])
    usable = plausible(ranges.ranges) & (ranges.stamps >= start) & (ranges.stamps <= end)
    # Windows without ranges are only counted, however long the recording claims to be.
    windows = max(1.0, np.ceil((end - start) / CheckPolicy.window))
    slot = np.floor((ranges.stamps[usable] - start) / CheckPolicy.window)
    measured = np.unique(np.stack([slot, ranges.anchor[usable].astype(np.float64)]), axis=1)
    count = np.unique(measured[0], return_counts=True)[1]
    return _rounded({f"at least {n}": min(float(np.sum(count >= n)) / float(windows), 1.0) for n in (1, 2, 3)})


def check_radio(figures: Figures) -> Iterator[Finding]:
    """Warn of too few anchors in reach at one time."""
    yield from check_rhythm("radio", figures)
    for anchor_id, own in figures["anchors"].items():
        yield from _check_anchor(anchor_id, own)
    share = figures["coverage"]["at least 2"]
    if len(figures["anchors"]) > 1 and share < 0.5:
        text = f"two anchors or more are in reach in only {share:.0%} of the time"
        cure = "place them so that two reach every spot; where one is in reach, the heading rests on the wheels"
        yield Finding("few-in-reach", WARNING, text, cure, "radio")
    if len(figures["anchors"]) == 1:
        cure = "it bounds the drift in distance, not in heading; two or more hold the map"
        yield Finding("one-anchor", NOTE, "there is one anchor", cure, "radio")


def _check_anchor(name: str, figures: Figures) -> Iterator[Finding]:
    """Say what the figures of one anchor show."""
    count, missed = figures["count"], figures["zeros"] + figures["absurd"]
    if missed > CheckPolicy.some * count:
        text = (
            f"anchor {name}: {figures['zeros']} of {count} readings are zero and {figures['absurd']} negative or beyond "
            f"{LONGEST_RANGE:.0f} m"
        )
        cure = "they are left out; a radio that reports zero has missed its partner"
        severity = WARNING if missed > CheckPolicy.many * count else NOTE
        yield Finding("missed-ranges", severity, text, cure, "radio", anchor=name)
    usable = count - missed
    if usable < CheckPolicy.few:
        text = f"anchor {name}: only {usable} usable ranges"
        yield Finding("few-ranges", WARNING, text, "it cannot be placed; drive nearer to it", "radio", anchor=name)
        return
    share = figures["spikes"] / usable
    if share > CheckPolicy.some:
        text = f"anchor {name}: {share:.0%} of the ranges jump farther than the robot drove (line of sight blocked?)"
        cure = "they are down-weighted; a higher or more open place helps the anchor"
        yield Finding("spikes", WARNING if share > CheckPolicy.many else NOTE, text, cure, "radio", anchor=name)
    if figures["width of the path by its length"] < CheckPolicy.some:
        text = f"anchor {name} was in reach on a straight path only: it may stand on either side of it"
        cure = "drive a curve within its reach; until then its mirror image is as likely"
        yield Finding("straight-path", WARNING, text, cure, "radio", anchor=name)


def calibration_figures(anchors: tuple[AnchorEstimate, ...], calibration: tuple[CalibrationEstimate, ...]) -> Figures:
    """Return what a map tells of wheels, clocks and the bias of each anchor."""
    known = [value for value in calibration if value.state == "estimated"]
    words = {value.name: {"unit": value.unit, "meaning": value.meaning} for value in known}
    figures: Figures = {v.name: words[v.name] | _rounded({"value": v.value, "sigma": v.sigma}) for v in known}
    biases = {a.id: _rounded({"bias": a.bias, "sigma": a.bias_sigma}) for a in anchors if a.status == "ok"}
    return figures | {"bias guess m": biases}


def lidar_figures(log: SensorLog) -> Figures:
    """Return rhythm, field of view, and shares of beams of the scans."""
    scans = log.scans
    assert scans is not None
    beams, kinds = scans.ranges.shape[1], ("share of beams that hit", "share that saw nothing", "share that is invalid")
    counts = np.zeros(len(kinds))
    for rows in chunks(len(scans.ranges), max(CHUNK // beams, 1)):
        some = scans.ranges[rows]
        counts += [np.count_nonzero(kind) for kind in (scans.hits(some), some == np.inf, np.isnan(some))]
    shares = (counts / scans.ranges.size).tolist()
    figures = {
        "field of view deg": np.degrees(abs(scans.angle_increment) * (beams - 1)),
        "range max m": scans.range_max,
        **dict(zip(kinds, shares, strict=True)),
    }
    return rhythm(scans.stamps, expected_gap=1.0) | {"beams": beams} | _rounded(figures)


def check_lidar(figures: Figures) -> Iterator[Finding]:
    """Say what rhythm and beams of the scans show."""
    yield from check_rhythm("lidar", figures)
    share, invalid = figures["share of beams that hit"], figures["share that is invalid"]
    if share < CheckPolicy.many:
        text = f"only {share:.0%} of the beams hit anything within {figures['range max m']:.1f} m"
        cure = "the place is wider than the laser reaches: drive along the walls; in the middle only ranges constrain the pose"
        yield Finding("few-hits", WARNING, text, cure, "lidar")
    elif invalid > 0.5:
        cure = "dark or slanting surfaces; they are left out and clear no space"
        yield Finding("error-codes", NOTE, f"{invalid:.0%} of the readings are error codes", cure, "lidar")
