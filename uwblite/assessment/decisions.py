"""Rules over what the stages of mapping saw and decided: each makes a finding of one fact."""

from collections.abc import Sequence
from dataclasses import replace

from ..findings import DOUBT, WARNING, Finding, doubt, warning
from ..screening.units import likely_unit
from .repairs import by_kind


def odometry_unit(recording: int, name: str, factor: float, checked: bool, high: float | None) -> Finding:
    """Warn of wheels in another unit by the ranges, which are times of flight.

    It is a doubt where something else explains the factor as well and neither a lidar nor given places decide: wheels whose
    radius and diameter were mistaken for each other, ranges in yards, anchors high above the tag.
    """
    double, unit = 2.0 / _DOUBLE < max(factor, 1.0 / factor) < 2.0 * _DOUBLE, likely_unit(factor)
    unclear = (double or "yards" in unit) and not checked
    reason = _TWICE if unclear and double else "the odometry has a wrong unit and was multiplied by that"
    text = (
        f"{f'{name}: ' if name else ''}by the ranges (times of flight) the robot drove {factor:.3f} times the distance that "
        f"its odometry counts: {reason}{unit}"
    )
    if high is not None:
        text += f"; or the odometry is right and the anchors are {high:.1f} m above the tag: give their heights"
    said = Finding("odometry-unit", DOUBT if unclear or high is not None else WARNING, text, recording=recording)
    return replace(said, figures={"recording": recording, "factor": round(factor, 4)})


_DOUBLE = 1.07
"""A factor is 2 or 1/2 up to this one: radii of wheels are known to some per cent."""
_TWICE = (
    "either the wheels' radius and diameter were mistaken for each other, or the radio reports twice or half "
    "the distance, and without a lidar or given anchors nothing decides; the map has the radio's lengths: compare one distance "
    "between two anchors"
)


def anchor_heights(height: float, taken: bool, apart: float) -> Finding:
    """Doubt a map without lidar where the ranges do not decide how high the anchors are, and the map depends on it."""
    words, instead = ("high", "low") if taken else ("low", "high")
    text = (
        f"the ranges fit anchors {height:.1f} m above the tag about as well as low ones: taken as {words}; if they are "
        f"{instead}, the trajectory differs by {apart:.1f} m (rms); give the anchors' heights (`mounting.anchor_height`)"
    )
    return doubt("anchor-heights", text)


def moved_anchor(
    anchor: str, distance: float, recording: int = 0, new_id: str = "", between: Sequence[float] = (), several: bool = False
) -> Finding:
    """Warn of an anchor that stands elsewhere from some time on, in another recording, or than in an earlier map.

    `between` holds the last time at the one place, the first at the other, s, and the number of ranges meanwhile.
    """
    if not recording:
        text = f"anchor {anchor} stands {distance:.2f} m from its earlier place: it was moved"
    elif not between:
        text = f"anchor {anchor} was moved: in recording {recording} it stands {distance:.2f} m away, and is called {new_id}"
    else:
        begin, end, way = between
        when = f"between t = {begin:.0f} and {end:.0f} s" if way else f"at about t = {end:.0f} s"
        less = f" (its {way:.0f} ranges meanwhile were left out)" if way else ""
        where = f"recording {recording}: " if several else ""
        text = f"{where}anchor {anchor} was moved by {distance:.1f} m {when}{less}; from then on it is called {new_id}"
    return Finding("moved-anchor", WARNING, text, recording=recording, anchor=anchor)


def path_displaced(
    recording: int, stretch: tuple[float, float], start: float, anchors: Sequence[str], apart: float, turned: float
) -> Finding:
    """Doubt a map with a stretch that the ranges to all anchors in reach show elsewhere: a step of the path is broken there."""
    begin, end = (time - start for time in stretch)
    text = (
        f"from t = {begin:.0f} to {end:.0f} s the ranges to {', '.join(anchors)} fit a path that lies {apart:.1f} m and "
        f"{turned:.0f} deg from the map's: a step is broken at the beginning, by slip or a wrong match of scans; drive "
        "there again, or map the parts before and after separately"
    )
    figures = {"recording": recording, "begin": stretch[0], "end": stretch[1], "apart": apart}
    return Finding("path-displaced", DOUBT, text, stretches=(stretch,), recording=recording, figures=figures)


def new_anchor(anchor: str, recording: int, silent: Sequence[int]) -> Finding:
    """Warn of an anchor to which recordings before the first with ranges (1, 2, ...) should have ranges."""
    text = f"anchor {anchor} has ranges only from recording {recording} on: {_drove_there(silent)}, so it is new or was off"
    return replace(warning("new-anchor", text), anchor=anchor)


def absent_anchor(anchor: str, recording: int, silent: Sequence[int]) -> Finding:
    """Warn of an anchor to which recordings after the last with ranges (1, 2, ...) should have ranges."""
    text = f"anchor {anchor} has no ranges after recording {recording}: {_drove_there(silent)}, so it was taken away or is off"
    return replace(warning("absent-anchor", text), anchor=anchor)


def _drove_there(numbers: Sequence[int]) -> str:
    """Return which recordings passed within reach of an anchor but have no ranges to it."""
    which = ", ".join(map(str, numbers))
    return f"recording{'s' if len(numbers) > 1 else ''} {which} drove within its reach without hearing it"


def landmark_distance(landmarks: str, measured: float, map: float) -> Finding:
    """Warn of a measured distance between landmarks that all other measurements contradict."""
    text = (
        f"the distance {landmarks} is {map:.3f} m in the map, not the {measured:.3f} m that were measured: "
        "all other measurements contradict it"
    )
    return warning("landmark-distance", text)


def clock_offset(offset: float) -> Finding:
    """Warn of an offset of the lidar's clock that grows when it is corrected.

    With a clock that is off by a constant, each correction leaves a part of the error before it.
    """
    text = f"an offset of the lidar's clock ({offset:+.3f} s) grows when it is corrected: it is no constant, and none is used"
    return warning("clock-offset", text)


def free_space_violation(share: float, visits: int) -> Finding:
    """Doubt a map in which points of one visit to a place stand in the free space of another visit."""
    text = (
        f"{share:.0%} of what was seen on one visit to a place stands where another visit saw free space: "
        "parts of the map are misplaced to each other; look at the closures in report.html"
    )
    return doubt("free-space-violation", text)


def open_loops(pairs: int, first: float, second: float, sigma: float) -> Finding:
    """Doubt a map in which stretches that may show the same place are still too uncertain for any search."""
    text = (
        f"the scans at t = {first:.0f} s and at t = {second:.0f} s may show the same place, but their relative position is "
        f"known to {sigma:.1f} m only and no scan match confirms it ({pairs} such pairs): drive there once more in the same "
        "direction, or force the closure"
    )
    return doubt("open-loops", text)


def turn_scale(name: str, by_steps: float, sigma: float, by_all: float) -> Finding:
    """Warn of a scale of turns that the lidar's steps contradict: single turns of the odometry are wrong."""
    text = (
        f"from step to step the lidar turns {shown(by_steps, sigma)} times as much as the odometry, but the whole fits best "
        f"with {1.0 + by_all:.2f}: single turns of the odometry are wrong; the steps' scale is used"
    )
    return warning("turn-scale", text)


def shown(value: float, sigma: float) -> str:
    """Return the factor 1 + value with its standard deviation."""
    return f"{1.0 + value:.2f} \u00b1 {sigma:.2f}"


def scans_astray(scans: int, used: int) -> Finding:
    """Doubt a map of which scans lie so far from the others that no grid can hold both."""
    text = f"{scans} of {scans + used} scans are so far from the others that no grid can hold both; they are not drawn"
    return doubt("scans-astray", text)


def coarse_grid(resolution: float, asked: float, cells: float) -> Finding:
    """Warn where the map is drawn with larger cells than requested; a map larger than any building is a doubt."""
    text = (
        f"the map is drawn with cells of {resolution:g} m instead of {asked:g} m: there would be more than {cells:g} million; "
        "raise grid.max_cells where there is memory (12 bytes each), or set `crop` or a smaller grid.max_range"
    )
    return Finding("coarse-grid", WARNING if resolution <= _COARSEST * asked else DOUBT, text)


_COARSEST = 10.0
"""Ratio of the cell size to the requested one, up to which a map counts as large; beyond it, poses or readings are wrong."""

RULES = by_kind(
    odometry_unit,
    anchor_heights,
    moved_anchor,
    path_displaced,
    new_anchor,
    absent_anchor,
    landmark_distance,
    clock_offset,
    free_space_violation,
    open_loops,
    turn_scale,
    scans_astray,
    coarse_grid,
)
"""By the kind of fact."""
