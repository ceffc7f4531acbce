"""Rules over what the screening of a recording saw and repaired: each makes a finding of one fact."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

from ..findings import DOUBT, WARNING, Fact, Finding, doubt, warning
from ..sensor_log import SensorLog

Rule = Callable[..., Finding]


def say(facts: Iterable[Fact], rules: Mapping[str, Rule]) -> Iterator[Finding]:
    """Yield the finding of each fact, with the fact's figures where the rule gives none."""
    for fact in facts:
        finding = rules[fact.kind](**fact.figures)
        yield finding if finding.figures else replace(finding, figures=dict(fact.figures))


def by_kind(*rules: Rule) -> dict[str, Rule]:
    """Return rules by the kind of fact that each is named after."""
    return {rule.__name__.replace("_", "-"): rule for rule in rules}


def check_recording(log: SensorLog) -> list[Finding]:
    """Return what the screening found in one recording; nothing before it is screened."""
    return [] if log.screening is None else list(say(log.screening.facts, RULES))


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
    """Return the first three stretches, s, as words, and how many more there are."""
    more = f", and {len(stretches) - 3} more stretches" if len(stretches) > 3 else ""
    words = (f"t = {a:.0f} to {b:.0f} s" if round(a) < round(b) else f"t = {a:.0f} s" for a, b in stretches[:3])
    return ", ".join(words) + more


def made_up_stamps(period: float) -> Finding:
    """Warn of stamps on a grid too coarse for a sensor's clock: they were made by counting messages."""
    text = (
        f"odometry and scans are stamped exactly every {period:g} s: these stamps were generated, not measured, so speeds, "
        "durations and the delay of the laser are in an unknown unit of time; stamp each reading with a clock"
    )
    return warning("made-up-stamps", text)


def stamps_of_receipt(sensors: Sequence[str]) -> Finding:
    """Warn of stamps that are times of receipt behind a queue: no clock offset can be estimated against them."""
    text = (
        f"the stamps of {' and '.join(sensors)} come in bursts: they are times of receipt behind a queue, not of measurement, "
        "so no clock offset is estimated, and speeds mean little; stamp each reading when it is measured"
    )
    return warning("stamps-of-receipt", text)


def clock_set_back(sensor: str, by: float) -> Finding:
    """Doubt a recording in which a sensor's clock was set back: its readings are in another order than they were made."""
    text = f"the clock of the {sensor} was set back by up to {by:.1f} s: cut the log there"
    return replace(doubt("clock-set-back", text), sensor=sensor)


def clock_jump(clock: str, sensor: str, by: float, at: float, moved: float) -> Finding:
    """Warn of a clock that was set forward, as the ends of the sensors show; the stamps were moved back."""
    text = (
        f"the clock of the {clock} was set forward by {by:.1f} s at t = {at:.0f} s, as the ends of the sensors show: the "
        f"{sensor}'s later stamps were moved by {moved:+.1f} s"
    )
    return warning("clock-jump", text)


def late_ranges(late: float) -> Finding:
    """Doubt ranges whose clock is off by seconds, as the path by the wheels shows; what is left of the offset bends the map."""
    text = (
        f"the ranges are stamped about {late:.0f} s late for the odometry, whose path they fit then: their stamps were moved "
        f"by {-late:+.1f} s; use one clock"
    )
    return replace(doubt("late-ranges", text), sensor="radio")


def exchanged_names(begin: float, at: float, end: float, what: str, anchors: Sequence[str]) -> Finding:
    """Warn of ranges that fit the path by the wheels under other names from a moment on, or under none."""
    which = f"those of {', '.join(anchors)} fit the places of others" if what == "exchanged" else "fit no places at all"
    text = (
        f"from about t = {at:.0f} s on, or until then, the ranges do not fit the places of their anchors along the path by the "
        f"wheels, but {which}: check the anchors' ids in the radio and in what reads them"
    )
    return replace(warning("exchanged-names", text), sensor="radio")


def wheels_against_ranges(begin: float, at: float, end: float, what: str, value: float) -> Finding:
    """Warn of wheels that the ranges to the anchors contradict, more than clocks, names and moved anchors would explain."""
    text = {
        "ways": f"from t = {begin:.0f} to {end:.0f} s the wheels count {value:.2f} times the way that they count otherwise",
        "turned": f"at about t = {at:.0f} s the robot turned by {value:+.0f} degrees more than the wheels count",
        "mirrored": f"from about t = {at:.0f} s the wheels turn the other way round, as if left and right were swapped",
        "elsewhere": f"at about t = {at:.0f} s the robot is suddenly elsewhere than the wheels say, carried or slipped",
        "turns": f"about t = {at:.0f} s no path that the wheels count fits: one of them, or the heading, is stuck or slips",
    }[what]
    return replace(warning("wheels-against-ranges", f"{text}, by the ranges to the anchors in reach"), sensor="odometry")


def outside_odometry(sensor: str, count: int, total: int, off: float) -> Finding:
    """Warn of readings outside the odometry's time; doubt a recording of which most are: its clocks differ."""
    most = count > _MOST_OUTSIDE * total
    text = (
        f"{count} of {total} {sensor} were stamped outside the odometry's time and left out: "
        f"{f'the clocks differ by about {off:.0f} s; ' if most else ''}"
        "start the odometry first and stop it last, and use one clock"
    )
    return Finding(f"{sensor}-outside-odometry", DOUBT if most else WARNING, text)


_MOST_OUTSIDE = 0.5
"""Share of readings outside the odometry's time from which on the rest of a recording says little."""


def stamps_in_bursts(readings: str, size: float, period: float) -> Finding:
    """Warn of readings that share a stamp because they waited in a buffer; they were spread over the time since the last."""
    text = (
        f"{readings} come in bursts of about {size:.0f} with one stamp, every {period:.2f} s: they were spread over the time "
        "since the previous burst; stamp each reading when it is made"
    )
    return warning("stamps-in-bursts", text)


def repeated_odometry(count: int) -> Finding:
    """Warn of readings of the odometry that are in the log twice."""
    return warning("repeated-odometry", f"odometry readings that are in the log twice: {count}; one of each was left out")


def odometry_glitches(count: int, first: float) -> Finding:
    """Warn of readings of the odometry whose removal makes the path continuous again."""
    text = f"{count} odometry readings lie far from the path (the first at t = {first:.1f} s) and were left out"
    return warning("odometry-glitches", text)


def odometry_breaks(at: Sequence[float], largest: float) -> Finding:
    """Warn of steps of the odometry that no motion explains: the path was joined there by the motion before and after."""
    text = (
        f"the odometry jumps at t = {listed(at, 1)} s (by up to {largest:.2f} m): only other sensors connect the path before "
        "and after"
    )
    return warning("odometry-breaks", text)


def odometry_gap(begin: float, seconds: float) -> Finding:
    """Warn of a silence of the odometry in which the robot drove on: the pose after it counts, with the noise of the way."""
    text = (
        f"the odometry is silent for {seconds:.0f} s from t = {begin:.0f} s, while the robot drove on; ranges and scans of "
        "that time were left out"
    )
    return warning("odometry-gap", text)


def carried(at: Sequence[float], silent: float = 0.0) -> Finding:
    """Doubt a recording in which the robot is suddenly elsewhere: it was carried, or the log was cut.

    Other sensors find it at another place after a silence of the odometry in which the wheels stood, or from one reading to
    the next.
    """
    if silent:
        text = (
            f"the odometry is silent for {silent:.0f} s from t = {at[0]:.0f} s, but the robot was moved meanwhile: only "
            "other sensors connect the path before and after"
        )
        return doubt("carried", text)
    where = ", ".join(f"t = {time:.0f} s" for time in at[:4])
    text = (
        f"at {where}{' ...' if len(at) > 4 else ''} the robot is suddenly elsewhere: it was carried, or the log was cut; only "
        "other sensors connect the path before and after"
    )
    return doubt("carried", text)


def wheels_stand_still(begin: float, end: float, by_scans: bool) -> Finding:
    """Warn of wheels that count nothing while other sensors move, where the scans replace them; doubt where ranges alone do."""
    outcome = "the motion between scans is used instead" if by_scans else "the trajectory there rests on ranges alone"
    text = f"the wheels count nothing from t = {begin:.0f} to {end:.0f} s while the robot moves: {outcome}"
    return Finding("wheels-stand-still", WARNING if by_scans else DOUBT, text)


def hardly_moving(way: float, seconds: float, turned: float) -> Finding:
    """Doubt a recording of a robot that stands: nothing can be placed from one spot."""
    text = (
        f"the robot hardly moves: {way:.2f} m in {seconds:.0f} s (turning {turned:.1f} rad); does the base "
        "report its wheels, in metres? Drive through the building"
    )
    return doubt("hardly-moving", text)


def gyro(used: float = 0.0, bias: float = 0.0, rests: bool = False, why: str = "") -> Finding:
    """Say in which share of the odometry the heading is the gyro's, and its bias; or why it is not used."""
    how = "by the robot's rests" if rests else "against the wheels"
    text = f"the heading is the gyro's in {used:.0%} of the odometry; its bias is {bias:+.5f} rad/s {how}" if used else why
    if used and why:
        text += f"; {why}"
    return warning("gyro", text)


def heading_against_path(inverted: str, settled: bool) -> Finding:
    """Warn of a heading that turns against the path: its sign was inverted, as the lidar shows where there is one."""
    text = f"the odometry's heading turns against its path: {inverted} was inverted"
    if not settled:
        text += "; nothing in the recording shows whether the map is mirrored, so compare it with the building"
    return warning("heading-against-path", text)


def laser_turned_over(flipped: bool) -> Finding:
    """Doubt a recording whose laser and wheels turn in opposite directions: one of the two is the other way round."""
    text = (
        "laser and wheels turn in opposite directions: the laser was taken as mounted "
        f"{'upside down' if flipped else 'upright'}, not as given; if the wheels are swapped instead, the map is mirrored: "
        f"settle it by {'' if flipped else 'leaving out '}`mounting.laser_flipped`, or by the odometry's sign"
    )
    return doubt("laser-turned-over", text)


def laser_turned_away(degrees: float, pose: Sequence[float]) -> Finding:
    """Warn of a laser that looks elsewhere than its pose says, by the motion that it and the wheels measure."""
    text = (
        f"the laser's direction differs by {degrees:+.0f} degrees from its given pose, by the motion that both "
        f"measure; corrected: `mounting.T_base_laser={pose[0]:.3f},{pose[1]:.3f},{pose[2]:.3f}`"
    )
    return warning("laser-turned-away", text)


def late_scans(count: int, total: int) -> Finding:
    """Warn of scans that a queue delivered late: between neighbours that agree with the odometry, they show another place."""
    text = (
        f"{count} of {total} scans came late: they show where the robot was before, as their neighbours prove; their "
        "poses are those that they show"
    )
    return warning("late-scans", text)


def scans_do_not_match(share: float) -> Finding:
    """Doubt a recording whose scans a short time apart hardly ever match: the readings are noise."""
    text = (
        f"successive scans do not match (nine of ten pairs share less than {100 * share:.0f} % of their "
        "points): the readings are noise, or beam order or angles are not as stated; check the lidar's driver"
    )
    return doubt("scans-do-not-match", text)


def wheels_against_lidar(start: float, stretches: Sequence[tuple[float, float]]) -> Finding:
    """Doubt a recording whose wheels and lidar measure different motions for long, one factor for all taken out."""
    text = (
        f"wheels and lidar measure different motions ({spans([(a - start, b - start) for a, b in stretches])}): one of the two "
        "is stuck, slips or has another scale there than elsewhere; cut that part off, or drive it again"
    )
    return Finding("wheels-against-lidar", DOUBT, text, stretches=tuple(stretches))


def repeated_scans(count: int, total: int, stretches: Sequence[tuple[float, float]], often: bool) -> Finding:
    """Warn of scans that repeat the one before to the last digit."""
    why = "the driver sends scans again" if often else "the lidar or its driver was stuck"
    text = f"{count} of {total} scans equal the scan before ({spans(stretches)}): {why}; they were left out"
    return warning("repeated-scans", text)


def repeated_readings(count: int, total: int, value: float, reach: bool) -> Finding:
    """Warn of a reading of the lidar that stands for no distance: it is the same wherever the robot is."""
    what = "the lidar reports its reach where it sees nothing" if reach else "a code, or a part of the robot in view"
    text = f"{count} of {total} readings of the lidar are exactly {value:g} m, wherever the robot is: {what}"
    return warning("repeated-readings", f"{text}; they are not taken as walls")


def own_body(count: int, total: int, sectors: Sequence[tuple[float, float]]) -> Finding:
    """Warn of beams that see the robot itself: the same nearby at all places and headings."""
    parts = ", ".join(f"{a:.0f} to {b:.0f}" for a, b in sectors[:3]) + " ..." * (len(sectors) > 3)
    text = (
        f"{count} of {total} beams of the lidar (at {parts} degrees) see the same nearby however the robot is "
        "turned: the robot itself; they were left out"
    )
    return warning("own-body", text)


def repeated_ranges(anchor: str, stretches: Sequence[tuple[float, float]]) -> Finding:
    """Warn of an anchor whose range stands still while the robot moves, more often than noise allows."""
    text = f"anchor {anchor} repeats one range while the robot moves ({spans(stretches)}); these were left out"
    return replace(warning("repeated-ranges", text), anchor=anchor)


def marked_ranges(count: int, total: int, value: float, lidar: bool) -> Finding:
    """Warn of a value that a radio reports where it has no measurement; doubt where too few ranges are left without lidar."""
    text = (
        f"{count} of {total} ranges are exactly {value:g} m, wherever the robot is: the radio reports "
        "this value where it has no measurement; they were left out"
    )
    most = not lidar and count > _MOST_MARKS * total
    return Finding("marked-ranges", DOUBT if most else WARNING, text)


_MOST_MARKS = 0.5
"""Share of a radio's readings that stand for no distance, from which on the rest is too little where no lidar is."""


def shared_name(anchor: str, jumps: int, total: int) -> Finding:
    """Warn of a name that two anchors have: its ranges alternate between two distances while the robot drives on."""
    text = (
        f"two anchors seem to have the name {anchor}: its ranges jump between two distances "
        f"({jumps} of {total} times by more than the robot drove); they were left out, give each anchor its own name"
    )
    return replace(warning("shared-name", text), anchor=anchor)


RULES = by_kind(
    made_up_stamps,
    stamps_of_receipt,
    clock_set_back,
    clock_jump,
    late_ranges,
    exchanged_names,
    wheels_against_ranges,
    outside_odometry,
    stamps_in_bursts,
    repeated_odometry,
    odometry_glitches,
    odometry_breaks,
    odometry_gap,
    carried,
    wheels_stand_still,
    hardly_moving,
    gyro,
    heading_against_path,
    laser_turned_over,
    laser_turned_away,
    late_scans,
    scans_do_not_match,
    wheels_against_lidar,
    repeated_scans,
    repeated_readings,
    own_body,
    repeated_ranges,
    marked_ranges,
    shared_name,
)
"""By the kind of fact."""
