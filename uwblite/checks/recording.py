"""Findings about a recording before it is mapped: faults, their size, and what to do about them.

Each finding is ranked: ``serious`` spoils the map or stops it, ``warning`` costs accuracy, ``note`` is good to know.
The checks need no calibration and no map; where the recording itself shows a fault (heading in
degrees, a laser upside down, clocks that differ), it is used.
"""

from dataclasses import dataclass, field
from typing import Any

from ..errors import DataError
from ..findings import DOUBT, WHEELS_AGAINST_LIDAR
from ..findings import Finding as MapFinding
from ..map_result import AnchorEstimate, CalibrationEstimate
from ..screening.screen import screen
from ..sensor_log import SensorLog
from .findings import Finding, Findings
from .lidar import check_scans
from .odometry import check_odometry
from .radio import check_calibration, check_ranges

__all__ = ["Diagnosis", "Finding", "diagnose"]


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """Result of the checks."""

    findings: tuple[Finding, ...]
    """Worst first."""
    figures: dict[str, Any] = field(default_factory=dict)
    """By sensor: rates, gaps, shares, counts (JSON-ready)."""

    @property
    def serious(self) -> tuple[Finding, ...]:
        """The findings that spoil the map or stop it."""
        return tuple(f for f in self.findings if f.rank == "serious")


def diagnose(
    log: SensorLog,
    *,
    anchors: tuple[AnchorEstimate, ...] = (),
    calibration: tuple[CalibrationEstimate, ...] = (),
    doubts: tuple[MapFinding, ...] | None = None,
    refused: str = "",
    repaired: SensorLog | None = None,
) -> Diagnosis:
    """Examine a recording.

    Parameters
    ----------
    anchors, calibration, doubts : of a map made for the check, where there is one: it shows the wheels' scale, the delay of
        the radio and the bias of each anchor, and whether the sensors agree. doubts: None where no map was made.
    refused : why no map could be made; empty where it was, or was not tried.
    repaired : the recording screened, where that has been done.
    """
    found = Findings()
    _check_notes(log, found)
    _check_screening(repaired or log, doubts, found)
    odometry = check_odometry(log.odometry, found)
    figures: dict[str, Any] = {"odometry": odometry}
    if log.ranges is None or len(log.ranges.stamps) == 0:
        found.note("radio", "there are no UWB ranges", _advice_without_ranges(log))
    else:
        figures["uwb"] = check_ranges(log, found)
        figures["radio calibration"] = check_calibration(anchors, calibration, found)
    if log.scans is None or len(log.scans.stamps) == 0:
        found.note("lidar", "there are no laser scans", "there will be a trajectory and anchors, but no map")
    else:
        figures["lidar"] = check_scans(log, found)
    _check_map(doubts or (), refused, found)
    return Diagnosis(found.ranked(), figures)


def _advice_without_ranges(log: SensorLog) -> str:
    if log.notes.unread:
        return f"there may be some in what was not read: {', '.join(log.notes.unread)}; `mappings` say where (see above)"
    return "the map rests on wheels and lidar; check the tag if that is not meant"


def _check_screening(log: SensorLog, doubts: tuple[MapFinding, ...] | None, found: Findings) -> None:
    """Faults that a map repairs are warnings, those that it doubts or refuses are serious, except doubts that the map
    settled."""
    try:
        repaired = screen(log)
    except DataError as error:
        found.serious("log", str(error), "no map is made before that is fixed")
        return
    screening = repaired.screening
    sensors = [s for s in (repaired.ranges, repaired.scans) if s is not None and len(s.stamps) > 1]
    if not sensors:
        found.serious("log", "neither ranges nor scans are left to constrain the trajectory", "odometry alone drifts")
    for remark in screening.findings if screening is not None else ():
        if remark.kind == WHEELS_AGAINST_LIDAR and doubts is None:
            found.warning("log", remark.text, "a map is doubted for it, unless its ranges agree with the lidar there")
        elif remark.severity == DOUBT and (doubts is None or remark.kind in {doubt.kind for doubt in doubts}):
            found.serious("log", remark.text, "the map will be doubted: repair the recording, or cut it there")
        else:
            found.warning("log", remark.text, "a map repairs it so; the files stay as they are")


def _check_map(doubts: tuple[MapFinding, ...], refused: str, found: Findings) -> None:
    """The doubts of the check's map, or the reason why there is none, without those of the screening."""
    said = {finding.what for finding in found.ranked()}
    for text in [doubt.text for doubt in doubts] + ([refused] if refused else []):
        if text not in said:
            found.serious("map", text, "no map is made before that is fixed" if refused else "a map is doubted for it")


def _check_notes(log: SensorLog, found: Findings) -> None:
    notes = log.notes
    if notes.broken:
        first = "; ".join(f"line {number}: {why}" for number, why in notes.broken_lines[:3])
        share = notes.broken / max(notes.lines, 1)
        found.add(
            "warning" if share > 0.001 else "note",
            "log",
            f"{notes.broken} of {notes.lines} lines are broken and were skipped ({first})",
            "a recorder that was cut off leaves one; more point to a bad disk, cable or writer",
        )
    for warning in notes.warnings:
        found.warning("log", warning, "")
