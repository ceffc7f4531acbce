"""Findings about a recording before it is mapped: faults, their size, and what to do about them.

A doubt spoils the map or prevents it, a warning costs accuracy, a note is good to know. No map is needed; where the recording
itself shows a fault (heading in degrees, a laser upside down, clocks that differ), the screening has used it. With a map, its
findings are those of the recording as well.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from ..errors import DataError
from ..findings import DOUBT, NOTE, WARNING, WHEELS_AGAINST_LIDAR, Finding, of_severity, ranked
from ..screening.screen import screen
from ..sensor_log import SensorLog
from . import sensor_checks
from .causes import explained
from .facts import check_recording

if TYPE_CHECKING:
    from ..map_result import MapResult

_BROKEN = 0.001
"""Share of broken lines from which on a disk, cable or writer is bad."""


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """Result of the checks."""

    findings: tuple[Finding, ...]
    """Worst first."""
    figures: dict[str, Any] = field(default_factory=dict)
    """By sensor: rates, gaps, shares, counts (JSON-ready)."""

    @property
    def doubts(self) -> tuple[Finding, ...]:
        """The findings that spoil the map or prevent it."""
        return of_severity(self.findings, DOUBT)


@dataclass(frozen=True, slots=True, eq=False)
class RecordingView:
    """What the rules about a recording look at."""

    log: SensorLog
    """As it was read."""
    repaired: SensorLog | None
    """Screened; None where the screening refuses it."""
    result: "MapResult | None"
    """The map that was made for the check, where one was."""
    refusal: str
    """Why no map can be made."""
    figures: dict[str, Any]
    """See Diagnosis."""


def diagnose(
    log: SensorLog, *, result: "MapResult | None" = None, refused: str = "", repaired: SensorLog | None = None
) -> Diagnosis:
    """Examine a recording.

    Parameters
    ----------
    result : a map made for the check, where there is one: it shows the wheels' scale, the delay of the radio, the bias of each
        anchor, and whether the sensors agree.
    refused : why no map could be made; empty where it was, or was not tried.
    repaired : the recording screened, where that has been done.
    """
    try:
        repaired = repaired or screen(log)
    except DataError as error:
        refused = refused or str(error)
    figures: dict[str, Any] = {"odometry": sensor_checks.odometry_figures(log.odometry)}
    if log.ranges is not None and len(log.ranges.stamps):
        figures["uwb"] = sensor_checks.radio_figures(log)
        made = ((), ()) if result is None else (result.anchors, result.calibration)
        figures["radio calibration"] = sensor_checks.calibration_figures(*made)
    if log.scans is not None and len(log.scans.stamps):
        figures["lidar"] = sensor_checks.lidar_figures(log)
    view = RecordingView(log, repaired, result, refused, figures)
    rules = (_check_notes, _check_map, _check_each_sensor)
    return Diagnosis(explained(ranked(finding for rule in rules for finding in rule(view))), figures)


def screened(log: SensorLog) -> SensorLog | None:
    """Return a recording screened; None where a map refuses it."""
    try:
        return screen(log)
    except DataError:
        return None


def _check_notes(view: RecordingView) -> Iterator[Finding]:
    """Say what the reader saw: lines that are broken, oddities."""
    notes = view.log.notes
    if notes.broken:
        first = "; ".join(f"line {number}: {why}" for number, why in notes.broken_lines[:3])
        text = f"{notes.broken} of {notes.lines} lines are broken and were skipped ({first})"
        cure = "a recorder that was cut off leaves one; more point to a bad disk, cable or writer"
        yield Finding("broken-lines", WARNING if notes.broken > _BROKEN * max(notes.lines, 1) else NOTE, text, cure, "log")
    for words in notes.warnings:
        yield Finding("reader", WARNING, words, sensor="log")


def _check_map(view: RecordingView) -> Iterator[Finding]:
    """Say what the screening repaired or doubts, and what a map doubts or refuses; a map says what the screening found, too."""
    if view.refusal:
        yield Finding("refused", DOUBT, view.refusal, "no map is made before that is fixed", "log")
    if view.result is not None:
        yield from view.result.findings
        return
    yield from _check_sensors(view)
    for finding in [] if view.repaired is None else check_recording(view.repaired):
        if finding.kind == WHEELS_AGAINST_LIDAR and finding.severity == DOUBT:
            cure = "a map is doubted for it, unless its ranges agree with the lidar there"
            yield replace(finding, severity=WARNING, cure=cure)
        elif finding.severity == DOUBT:
            yield replace(finding, cure="the map will be doubted: repair the recording, or cut it there")
        else:
            yield replace(finding, cure="a map repairs it so; the files stay as they are")


def _check_sensors(view: RecordingView) -> Iterator[Finding]:
    """Say which sensors are missing."""
    repaired, notes = view.repaired, view.log.notes
    sensors = () if repaired is None else (repaired.ranges, repaired.scans)
    if repaired is not None and not any(sensor is not None and len(sensor.stamps) > 1 for sensor in sensors):
        text = "neither ranges nor scans are left to constrain the trajectory"
        yield Finding("odometry-alone", DOUBT, text, "odometry alone drifts", "log")
    for finding in sensor_checks.check_sensors([view.log]):
        if finding.kind == "no-ranges" and notes.unread:
            cure = f"there may be some in what was not read: {', '.join(notes.unread)}; `mappings` say where (see above)"
            finding = replace(finding, cure=cure)
        yield finding


def _check_each_sensor(view: RecordingView) -> Iterator[Finding]:
    """Say what the figures of each sensor show.

    A log whose odometry and scans share messages was corrected or thinned by a program: its rhythm is the program's, and not
    that of sensors, cables or computer.
    """
    figures = view.figures
    found = [*sensor_checks.check_odometry(view.log.odometry, figures["odometry"])]
    found += sensor_checks.check_radio(figures["uwb"]) if "uwb" in figures else ()
    found += sensor_checks.check_lidar(figures["lidar"]) if "lidar" in figures else ()
    for finding in found:
        if view.log.notes.one_clock and finding.kind in ("silences", "slow-odometry") and finding.sensor != "radio":
            cure = "a program wrote a pose with each scan that it used; where the raw log is left, map that"
            finding = replace(finding, severity=NOTE, cure=cure)
        yield finding
