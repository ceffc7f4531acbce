"""Figures of the scans before a map is made, and what they show."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from ..findings import NOTE, WARNING, Finding
from ..lidar.laser_mounting import Turning, compare
from ..sensor_log import LaserScans, SensorLog
from .odometry_figures import check_equal_stamps, check_silences, rhythm

_SAMPLE = 400
"""Scans that are enough for shares of beams."""
_BEAMS, _SCANS = 30, 20
"""Least number of beams and of scans that show turns."""
_FEW, _MANY = 0.1, 0.4
"""Share of beams that hit something, below which a lidar says little; share of error codes that is worth a note."""
_LATE = 0.06
"""s; clock offsets below are not distinguished from the time that a sweep takes."""
_TURNS, _SIGMAS = 0.12, 4.0
"""Relative difference of turns by laser and wheels that slip does not explain, and standard deviations."""


def lidar_figures(log: SensorLog) -> dict[str, Any]:
    """Return rhythm, field of view, and shares of beams of the scans."""
    scans = log.scans
    assert scans is not None
    beams = scans.ranges.shape[1]
    sample = scans.ranges[:: max(1, len(scans.ranges) // _SAMPLE)].astype(np.float64)
    return rhythm(scans.stamps, expected_gap=1.0) | {
        "beams": beams,
        "field of view deg": round(float(np.degrees(abs(scans.angle_increment) * (beams - 1))), 1),
        "range max m": round(scans.range_max, 3),
        "share of beams that hit": round(float(scans.hits(sample).mean()), 3),
        "share that saw nothing": round(float(np.isposinf(sample).mean()), 3),
        "share that is invalid": round(float(np.isnan(sample).mean()), 3),
    }


def turning_figures(log: SensorLog, turn_ratio: tuple[float, float]) -> tuple[dict[str, float], Turning | None]:
    """Return what laser and wheels measure of turns, as figures and as such; turn_ratio : see Screening."""
    turning = compare(log) if shows_turns(log.scans) else None
    if turning is None:
        return {}, None
    figures = {
        "pairs": turning.pairs,
        "misfit rad": round(turning.as_given, 4),
        "misfit if mounted the other way up rad": round(turning.other, 4),
        "laser_delay s": round(turning.delay, 3),
    }
    if turn_ratio[0] > 0.0:
        figures["turn by laser / turn by wheels"] = round(turn_ratio[0], 3)
    return figures, turning


def shows_turns(scans: LaserScans | None) -> bool:
    """Return whether scans are enough, and have beams enough, to show turns."""
    return scans is not None and scans.ranges.shape[1] >= _BEAMS and len(scans.stamps) >= _SCANS


def check_lidar(figures: dict[str, Any]) -> Iterator[Finding]:
    """Yield what rhythm and beams of the scans show."""
    yield from check_silences("lidar", figures)
    yield from check_equal_stamps("lidar", figures)
    share, invalid = figures["share of beams that hit"], figures["share that is invalid"]
    if share < _FEW:
        text = f"only {100 * share:.0f} % of the beams hit anything within {figures['range max m']:.1f} m"
        cure = "the place is wider than the laser reaches: drive along the walls; in the middle only ranges constrain the pose"
        yield Finding("few-hits", WARNING, text, cure, "lidar")
    elif invalid > _MANY:
        text = f"{100 * invalid:.0f} % of the readings are error codes"
        yield Finding("error-codes", NOTE, text, "dark or slanting surfaces; they are left out and clear no space", "lidar")


def check_turning(turning: Turning | None, turn_ratio: tuple[float, float]) -> Iterator[Finding]:
    """Yield what the turns of laser and wheels show of clock, beam order and track width.

    Parameters
    ----------
    turn_ratio : turn by the laser / turn by the wheels, with its standard deviation; nan where nothing shows it.
    """
    if turning is None:
        cure = "clock offset and mounting of the laser cannot be checked"
        yield Finding("no-turns", NOTE, "the robot hardly turns in place", cure, "lidar")
        return
    if not turning.agree:
        text = f"laser and wheels disagree on turning (typically by {turning.misfit:.2f} rad of {turning.typical:.2f} rad)"
        yield Finding("turns-disagree", WARNING, text, "check the stamps, the beam order and the wheels' heading", "lidar")
        return
    if abs(turning.delay) > _LATE and turning.delay_clear:
        text = (
            f"the laser's stamps are about {abs(turning.delay):.2f} s too {'early' if turning.delay > 0.0 else 'late'} for the "
            f"odometry's clock (laser_delay {turning.delay:+.2f} s, to be added to them)"
        )
        cure = "a map measures it better and corrects small offsets; stamp both with one clock, each when its reading begins"
        yield Finding("laser-delay", WARNING, text, cure, "lidar")
    ratio, sigma = turn_ratio
    if ratio > 0.0 and abs(ratio - 1.0) > max(_TURNS, _SIGMAS * sigma):
        text = f"the wheels measure about {1.0 / ratio:.2f} times the turns of the laser"
        cure = "set the track width of the base; uwblite corrects it where the recording shows it"
        yield Finding("turn-factor", WARNING, text, cure, "odometry")
