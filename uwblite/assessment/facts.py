"""Rules over facts: what the screening saw and repaired, and what the stages of mapping decided; one finding for each.

Most are a row of ``TEXTS``; a kind whose severity or words depend on its figures is a function of its name.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from string import Formatter
from typing import Any, ClassVar

from ..findings import DOUBT, WARNING, Fact, Finding, warning
from ..screening.units import likely_unit
from ..sensor_log import SensorLog

Rule = Callable[..., Finding]
_LISTED = 3
"""Stretches and sectors that a text names."""


def say(facts: Iterable[Fact]) -> Iterator[Finding]:
    """Yield the finding of each fact, with the fact's figures where the rule gives none."""
    for fact in facts:
        finding = RULES[fact.kind](**fact.figures)
        yield finding if finding.figures else replace(finding, figures=dict(fact.figures))


def check_recording(log: SensorLog) -> list[Finding]:
    """Return what the screening found in one recording; nothing before it is screened."""
    return [] if log.screening is None else list(say(log.screening.facts))


def check_recordings(logs: Sequence[SensorLog]) -> list[Finding]:
    """Return what the screening found in recordings, each with its recording's number and, where there are several, name."""
    found = []
    for number, log in enumerate(logs):
        where = f"recording {number + 1}: " if len(logs) > 1 else ""
        found += [replace(f, text=where + f.text, recording=number + 1) for f in check_recording(log)]
    return found


def listed(times: Sequence[float], digits: int = 0, most: int = 5) -> str:
    """Return the first of some times, s, as words."""
    return ", ".join(f"{time:.{digits}f}" for time in times[:most]) + (" ..." if len(times) > most else "")


def spans(stretches: Sequence[tuple[float, float]]) -> str:
    """Return the first stretches, s, as words, and how many more there are."""
    more = f", and {len(stretches) - _LISTED} more stretches" if len(stretches) > _LISTED else ""
    words = (f"t = {a:.0f} to {b:.0f} s" if round(a) < round(b) else f"t = {a:.0f} s" for a, b in stretches[:_LISTED])
    return ", ".join(words) + more


def _recordings(numbers: Sequence[int]) -> str:
    """Return the numbers of recordings as words."""
    *others, last = (str(number) for number in numbers)
    return f"recordings {', '.join(others)} and {last}" if others else f"recording {last}"


class _Words(Formatter):
    """Formats figures; beside Python's formats there are `times`, `whole` times, `spans`, `names`, `list`, `recordings` and
    `sectors` of lists, `factor` of what is added to 1, and `yes|no` of a truth, in which other figures may stand."""

    FORMATS: ClassVar[Mapping[str, Callable[[Any], str]]] = {
        "times": lambda times: listed(times, 1),
        "whole": listed,
        "list": ", ".join,
        "spans": spans,
        "names": lambda names: " and ".join(map(str, names)),
        "recordings": _recordings,
        "sectors": lambda parts: ", ".join(f"{a:.0f} to {b:.0f}" for a, b in parts[:_LISTED]) + " ..." * (len(parts) > _LISTED),
        "factor": lambda value: f"{1.0 + value:.2f}",
    }

    def format_field(self, value: Any, format_spec: str) -> Any:
        if "|" in format_spec:
            return format_spec.split("|")[0 if value else 1]
        known = self.FORMATS.get(format_spec)
        return super().format_field(value, format_spec) if known is None else known(value)


@dataclass(frozen=True, slots=True)
class Text:
    """What is said of a fact."""

    text: str
    """For people, with the fact's figures in braces."""
    severity: str = WARNING
    """As text; see Finding."""
    sensor: str = ""
    """As text; see Finding."""
    anchor: str = ""
    """As text; see Finding."""

    def finding(self, kind: str, figures: Mapping[str, Any]) -> Finding:
        """Return the finding with the figures of a fact."""
        words = (self.text, self.severity, self.sensor, self.anchor)
        text, severity, sensor, anchor = (_Words().vformat(each, (), figures) for each in words)
        return Finding(kind, severity, text, sensor=sensor, anchor=anchor)


_OUTSIDE = Text(
    "{count} of {total} {sensor} were stamped outside the odometry's time and left out: "
    "{most:the clocks differ by about {off:.0f} s; |}start the odometry first and stop it last, and use one clock",
    "{most:doubt|warning}",
)

TEXTS: Mapping[str, Text] = {
    "made-up-stamps": Text(
        "odometry and scans are stamped exactly every {period:g} s: these stamps were generated, not measured, so speeds, "
        "durations and the delay of the laser are in an unknown unit of time; stamp each reading with a clock",
    ),
    "stamps-of-receipt": Text(
        "the stamps of {sensors:names} come in bursts: they are times of receipt behind a queue, not of measurement, "
        "so no clock offset is estimated, and speeds mean little; stamp each reading when it is measured",
    ),
    "clock-set-back": Text(
        "the clock of the {sensor} was set back by up to {by:.1f} s: cut the log there",
        DOUBT,
        "{sensor}",
    ),
    "clock-jump": Text(
        "the clock of the {clock} was set forward by {by:.1f} s at t = {at:.0f} s, as the ends of the sensors show: the "
        "{sensor}'s later stamps were moved by {moved:+.1f} s",
    ),
    "late-ranges": Text(
        "the ranges are stamped about {late:z.0f} s late for the odometry{grows:, and {grows:+.0f} s more at its end|}, whose "
        "path they fit then: their stamps were corrected by that; use one clock",
        DOUBT,
        "radio",
    ),
    "antenna-delay": Text(
        "the ranges to {anchors:list} are {metres:.0f} m longer than the distances that they show along the way: antenna "
        "delays were never set; that was taken off; set them in the radios",
        sensor="radio",
    ),
    "stamps-in-bursts": Text(
        "{readings} come in bursts of about {size:.0f} with one stamp, every {period:.2f} s: they were spread over the time "
        "since the previous burst; stamp each reading when it is made",
    ),
    "repeated-odometry": Text(
        "odometry readings that are in the log twice: {count}; one of each was left out",
    ),
    "odometry-glitches": Text(
        "{count} odometry readings lie far from the path (the first at t = {first:.1f} s) and were left out",
    ),
    "odometry-breaks": Text(
        "the odometry jumps at t = {at:times} s (by up to {largest:.2f} m): only other sensors connect the path before and "
        "after",
    ),
    "odometry-gap": Text(
        "the odometry is silent for {seconds:.0f} s from t = {begin:.0f} s, while the robot drove on; ranges and scans of "
        "that time were left out",
    ),
    "hardly-moving": Text(
        "the robot hardly moves: {way:.2f} m in {seconds:.0f} s (turning {turned:.1f} rad); does the base "
        "report its wheels, in metres? Drive through the building",
        DOUBT,
    ),
    "laser-turned-away": Text(
        "the laser's direction differs by {degrees:+.0f} degrees from its given pose, by the motion that both "
        "measure; corrected: `mounting.T_base_laser={pose[0]:.3f},{pose[1]:.3f},{pose[2]:.3f}`",
    ),
    "late-scans": Text(
        "{count} of {total} scans came late: they show where the robot was before, as their neighbours prove; their "
        "poses are those that they show",
    ),
    "scans-do-not-match": Text(
        "successive scans do not match (nine of ten pairs share less than {share:.0%} of their "
        "points): the readings are noise, or beam order or angles are not as stated; check the lidar's driver",
        DOUBT,
    ),
    "repeated-ranges": Text(
        "anchor {anchor} repeats one range while the robot moves ({stretches:spans}); these were left out",
        anchor="{anchor}",
    ),
    "heading-against-path": Text(
        "the odometry's heading turns against its path: {inverted} was inverted"
        "{settled:|; nothing in the recording shows whether the map is mirrored, so compare it with the building}",
    ),
    "laser-turned-over": Text(
        "laser and wheels turn in opposite directions: the laser was taken as mounted {flipped:upside down|upright}, not as "
        "given; if the wheels are swapped instead, the map is mirrored: settle it by {flipped:|leaving out }"
        "`mounting.laser_flipped`, or by the odometry's sign",
        DOUBT,
    ),
    "repeated-scans": Text(
        "{count} of {total} scans equal the scan before ({stretches:spans}): "
        "{often:the driver sends scans again|the lidar or its driver was stuck}; they were left out",
    ),
    "repeated-readings": Text(
        "{count} of {total} readings of the lidar are exactly {value:g} m, wherever the robot is: "
        "{reach:the lidar reports its reach where it sees nothing|a code, or a part of the robot in view}; "
        "they are not taken as walls",
    ),
    "anchor-heights": Text(
        "the ranges fit anchors {height:.1f} m above the tag about as well as low ones: taken as {taken:high|low}; if they "
        "are {taken:low|high}, the trajectory differs by {apart:.1f} m (rms); give the anchors' heights "
        "(`mounting.anchor_height`)",
        DOUBT,
    ),
    "landmark-distance": Text(
        "the distance {landmarks} is {map:.3f} m in the map, not the {measured:.3f} m that were measured: "
        "all other measurements contradict it",
    ),
    "clock-offset": Text(
        "an offset of the lidar's clock ({offset:+.3f} s) grows when it is corrected: it is no constant, and none is used",
    ),
    "free-space-violation": Text(
        "{share:.0%} of what was seen on one visit to a place stands where another visit saw free space, and within one visit "
        "only {moving:.0%}: parts of the map are misplaced to each other; look at the closures in report.html",
        DOUBT,
    ),
    "wheels-stand-still": Text(
        "the wheels count nothing from t = {begin:.0f} to {end:.0f} s while the robot moves: {by_scans:the motion between "
        "scans is used instead|the trajectory there rests on ranges alone}",
        "{by_scans:warning|doubt}",
    ),
    "own-body": Text(
        "{count} of {total} beams of the lidar (at {sectors:sectors} degrees) see the same nearby however the robot is "
        "turned: the robot itself; they were left out",
    ),
    "new-anchor": Text(
        "anchor {anchor} has ranges only from recording {recording} on: {silent:recordings} drove within its reach "
        "without hearing it, so it is new or was off",
        anchor="{anchor}",
    ),
    "absent-anchor": Text(
        "anchor {anchor} has no ranges after recording {recording}: {silent:recordings} drove within its reach without "
        "hearing it, so it was taken away or is off",
        anchor="{anchor}",
    ),
    "turn-scale": Text(
        "from step to step the lidar turns {by_steps:factor} \u00b1 {sigma:.2f} times as much as the odometry, but the whole "
        "fits best with {by_all:factor}: single turns of the odometry are wrong; the steps' scale is used",
    ),
    "scans-astray": Text(
        "{scans} scans are so far from the {used} others that no grid can hold both; they are not drawn",
        DOUBT,
    ),
    "exchanged-names": Text(
        "from about t = {at:.0f} s on, or until then, the ranges do not fit the places of their anchors along the path by the "
        "wheels, but {exchanged:those of {anchors:list} fit the places of others|fit no places at all}: check the anchors' ids "
        "in the radio and in what reads them",
        DOUBT,
        "radio",
    ),
    "ranges-outside-odometry": _OUTSIDE,
    "scans-outside-odometry": _OUTSIDE,
    "carried": Text(
        "{silent:the odometry is silent for {silent:.0f} s from t = {at:whole} s, but the robot was moved meanwhile|"
        "at t = {at:whole} s the robot is suddenly elsewhere: it was carried, or the log was cut}; only other sensors connect "
        "the path before and after",
        DOUBT,
    ),
    "marked-ranges": Text(
        "{count} of {total} ranges are exactly {value:g} m, wherever the robot is: the radio reports this value where it has "
        "no measurement; they were left out",
        "{alone:doubt|warning}",
    ),
}
"""By the kind of fact, where one text says it."""


def _of_text(kind: str) -> Rule:
    return lambda **figures: TEXTS[kind].finding(kind, figures)


RULES: dict[str, Rule] = {kind: _of_text(kind) for kind in TEXTS}
"""By the kind of fact."""


def _rule(function: Rule) -> Rule:
    """Make a function the rule of the kind of its name."""
    RULES[function.__name__.replace("_", "-")] = function
    return function


@_rule
def wheels_against_ranges(begin: float, at: float, end: float, what: str, value: float) -> Finding:
    """Warn of wheels that the ranges to the anchors contradict, more than clocks, names and moved anchors would explain."""
    text = {
        "turned": f"at about t = {at:.0f} s the robot turned by {value:+.0f} degrees more than the wheels count",
        "mirrored": f"from about t = {at:.0f} s the wheels turn the other way round, as if left and right were swapped",
        "elsewhere": f"at about t = {at:.0f} s the robot is suddenly elsewhere: it slipped, or it or all anchors were carried",
        "turns": f"about t = {at:.0f} s no path that the wheels count fits: one of them, or the heading, is stuck or slips",
    }[what]
    return Finding("wheels-against-ranges", WARNING, f"{text}, by the ranges to the anchors in reach", sensor="odometry")


@_rule
def gyro(used: float = 0.0, bias: float = 0.0, rests: bool = False, why: str = "") -> Finding:
    """Say in which share of the odometry the heading is the gyro's, and its bias; or why it is not used."""
    how = "by the robot's rests" if rests else "against the wheels"
    text = f"the heading is the gyro's in {used:.0%} of the odometry; its bias is {bias:+.5f} rad/s {how}" if used else why
    if used and why:
        text += f"; {why}"
    return warning("gyro", text)


@_rule
def wheels_against_lidar(start: float, stretches: Sequence[tuple[float, float]], slips: bool) -> Finding:
    """Doubt a recording whose wheels and lidar measure different motions for long; warn where the wheels slip for a time.

    One factor for all motions is taken out before. Without stretches the two have nothing in common anywhere.
    """
    if not stretches:
        text = (
            "the motions that wheels and lidar measure have nothing in common: the scans are out of order, of another "
            "recording or in disorder themselves, or the odometry is; check both drivers"
        )
        return Finding("wheels-against-lidar", DOUBT, text)
    when = spans([(a - start, b - start) for a, b in stretches])
    text = f"the wheels count more motion than the lidar measures ({when}): they slip there, and the map follows the lidar"
    if not slips:
        text = (
            f"wheels and lidar measure different motions ({when}): one of the two is stuck, slips or has another scale there "
            "than elsewhere; cut that part off, or drive it again"
        )
    return Finding("wheels-against-lidar", WARNING if slips else DOUBT, text, stretches=tuple(stretches))


@_rule
def scan_duration(recording: int, name: str, stated: float, duration: float, increment: float) -> Finding:
    """Warn of scans whose rays are of other times than the log says."""
    text = (
        f"{f'{name}: ' if name else ''}a scan takes {duration:.3f} s from its first ray to its last, about the moment in its "
        f"middle by the log, not {stated:.3f} s: so scans from other headings and at other velocities fit; to state it, set "
        f"`laser_time_increment` to {increment:.6f} s and stamp scans {0.5 * (duration - stated):.3f} s earlier"
    )
    return Finding("scan-duration", WARNING, text, recording=recording, figures={"duration": duration, "stated": stated})


@_rule
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
    severity, figures = DOUBT if unclear or high is not None else WARNING, {"recording": recording, "factor": round(factor, 4)}
    return Finding("odometry-unit", severity, text, recording=recording, figures=figures)


_DOUBLE = 1.07
"""A factor is 2 or 1/2 up to this one: radii of wheels are known to some per cent."""
_TWICE = (
    "either the wheels' radius and diameter were mistaken for each other, or the radio reports twice or half "
    "the distance, and without a lidar or given anchors nothing decides; the map has the radio's lengths: compare one distance "
    "between two anchors"
)


@_rule
def moved_anchor(
    anchor: str, distance: float, recording: int = 0, new_id: str = "", between: Sequence[float] = (), several: bool = False
) -> Finding:
    """Warn of an anchor that stands elsewhere from some time on, in another recording, or than in an earlier map.

    `between` holds the times of the first range that is no longer from the one place and of the first from the other, s, and
    the number of ranges meanwhile, which are from neither.
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


@_rule
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


@_rule
def worse_than_parts(recording: int, stretch: tuple[float, float], start: float, off: float, turned: float) -> Finding:
    """Doubt the stretch of a map in which the lidar is not understood: without its matches there all fits better."""
    begin, end = (time - start for time in stretch)
    text = (
        f"from t = {begin:.0f} to {end:.0f} s the lidar is not understood: with its matches there left out and "
        f"all scans matched anew, the robot moves {off:.1f} m and {turned:.0f} deg differently, and ranges, wheels and rays "
        "together are more probable; the map follows that"
    )
    cure = (
        f"`end={begin:.0f}` gives the part that is supported best; map that, or "
        "`use_lidar=false` for what wheels and ranges alone say"
    )
    figures = {"off": off, "turned": turned}
    return Finding("worse-than-parts", DOUBT, text, cure, "lidar", (stretch,), recording, figures=figures)


@_rule
def coarse_grid(resolution: float, asked: float, cells: float) -> Finding:
    """Warn where the map is drawn with larger cells than requested; a map larger than any building is a doubt."""
    text = (
        f"the map is drawn with cells of {resolution:g} m instead of {asked:g} m: there would be more than {cells:g} million; "
        "raise grid.max_cells where there is memory (12 bytes each), or set `crop` or a smaller grid.max_range"
    )
    return Finding("coarse-grid", WARNING if resolution <= _COARSEST * asked else DOUBT, text)


_COARSEST = 10.0
"""Ratio of the cell size to the requested one, up to which a map counts as large; beyond it, poses or readings are wrong."""
