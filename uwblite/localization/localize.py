"""Localisation of a recording in an existing map: the live localiser, forwards and backwards over the recording.

The start pose need not be known; the map is not changed. Poses of both passes are averaged (passes); poses that neither pass
has are left out. Where the scans fit the map's walls nowhere, the place has changed or is another one: the anchors alone then
determine where the robot was, and the result is doubted.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Floats
from ..assessment.facts import check_recording
from ..errors import Cancelled, DataError
from ..findings import DOUBT, WARNING, Finding, doubt, of_severity, warning
from ..screening.screen import screen
from ..sensor_log import SensorLog
from .known_map import KnownMap
from .passes import Pass, pose_rows, run_pass, smoothed

LEAST_OVERLAP = 0.4
"""Share of the rays' ends in known space that must lie on walls of the map; the rest may be people, or what was moved."""
LEAST_LOCALIZED = 0.8
"""Share of the poses that must be known, and on which both passes must agree."""
Progress = Callable[[str, int, int], object]
"""Called with what is done, steps done, steps; what returns False stops the work."""


@dataclass(frozen=True, slots=True, eq=False)
class Localization:
    """A recording within an earlier map."""

    stamps: Floats
    """(n,) s, of the poses that are known."""
    trajectory: Floats
    """(n, 3) T_map_base; m, m, rad."""
    covariances: Floats
    """(n, 3, 3) m, m, rad; map frame; the map's own errors are in them."""
    localized: float
    """Share of the recording's poses that are known, 0..1."""
    overlap: float
    """Share of the rays' ends that lie on walls of the map, of those in its known space; nan without walls to compare."""
    warnings: tuple[Finding, ...]
    doubts: tuple[Finding, ...]


def localize(log: SensorLog, known: KnownMap, *, turn_laser: bool = True, progress: Progress | None = None) -> Localization:
    """Find the trajectory of a recording in an earlier map.

    Parameters
    ----------
    log : the recording, with ranges to at least two of the map's anchors, or with lidar in a place that no other part of
        the map looks like.
    known : the earlier map.
    turn_laser : take the laser as mounted the way that its scans show, see screening.screen.
    progress : called with what is done.

    Raises
    ------
    DataError : the recording has ranges to fewer than two of the map's anchors, and there are no walls to compare; or it is
        found nowhere in the map for certain.
    Cancelled : progress returned False.
    """
    _refuse_nothing_in_common(log, known)
    # Each anchor of the map takes time in every step; those without ranges add no information.
    known = replace(known, anchors=known.anchors.only(_shared(log, known)))
    log = screen(log, turn_laser)
    rows = pose_rows(log)
    passes = _both(log, known, rows, progress)
    doubts = []
    if _lost(passes) and known.walls is not None and len(_shared(log, known)) >= 2:
        doubts.append(_walls_differ(passes[0].reason))
        passes = _both(log, replace(known, walls=None), rows, progress)
    if _lost(passes):
        raise DataError(f"the recording is found nowhere in the map for certain: {passes[0].reason}")
    found = smoothed(*passes, known.covariance_at)
    there = np.isfinite(found.poses).all(axis=1)
    ends = passes[0].ends + passes[1].ends
    overlap = float(ends[0] / ends[1]) if ends[1] else float("nan")
    localized, agreed = float(there.mean()), 1.0 - float(found.contradicting[there].mean())
    warnings, more = _findings(log, known, passes, localized, agreed, overlap)
    return Localization(
        log.odometry.stamps[rows][there],
        found.poses[there],
        found.covariances[there],
        localized,
        overlap,
        warnings,
        (*doubts, *more),
    )


def _both(log: SensorLog, known: KnownMap, rows: np.ndarray, progress: Progress | None) -> tuple[Pass, Pass]:
    def reporter(name: str) -> Callable[[int, int], None]:
        def report(done: int, total: int) -> None:
            if progress is not None and progress(name, done, total) is False:
                raise Cancelled(f"stopped by the caller during {name}")

        return report

    return (
        run_pass(log, known, rows, False, reporter("localising forwards")),
        run_pass(log, known, rows, True, reporter("localising backwards")),
    )


def _lost(passes: tuple[Pass, Pass]) -> bool:
    return not any(np.isfinite(p.poses).any() for p in passes)


def _shared(log: SensorLog, known: KnownMap) -> list[str]:
    measured = set(log.ranges.anchor_ids) if log.ranges is not None else set()
    return [name for name in known.anchors.ids if name in measured]


def _refuse_nothing_in_common(log: SensorLog, known: KnownMap) -> None:
    shared = _shared(log, known)
    if len(shared) < 2 and (known.walls is None or log.scans is None):
        raise DataError(
            f"the recording has ranges to {len(shared)} of the map's anchors ({', '.join(known.anchors.ids)}); "
            "two or more are needed to find it in the map, or lidar in both"
        )


def _findings(
    log: SensorLog, known: KnownMap, passes: tuple[Pass, Pass], localized: float, agreed: float, overlap: float
) -> tuple[tuple[Finding, ...], tuple[Finding, ...]]:
    """Return warnings and doubts."""
    found = check_recording(log)
    shared = len(_shared(log, known))
    if shared < 2:
        text = f"it has ranges to {shared} of the map's anchors: its place is from the walls alone"
        found.append(warning("few-common-anchors", text, anchors=shared))
    for name in sorted({n for p in passes for n in p.moved_anchors}):
        text = f"anchor {name} does not stand where the map has it: it was moved; its ranges were left out"
        found.append(warning("moved-anchor", text, anchor=name))
    if overlap < LEAST_OVERLAP:
        found.append(_walls_differ(f"overlap {overlap:.0%}"))
    if localized < 1.0:
        reason = passes[0].reason or passes[1].reason or "measurements and map fell apart meanwhile"
        text = f"{1.0 - localized:.0%} of the recording is not localized and left out: {reason}"
        say = doubt if localized < LEAST_LOCALIZED else warning
        found.append(say("not-localized", text, localized=round(localized, 4)))
    if agreed < LEAST_LOCALIZED:
        text = f"forwards and backwards the recording is found at different places for {1.0 - agreed:.0%} of its poses"
        found.append(doubt("ambiguous-place", text, agreed=round(agreed, 4)))
    return of_severity(found, WARNING), of_severity(found, DOUBT)


def _walls_differ(why: str) -> Finding:
    return doubt(
        "walls-differ",
        f"the walls do not lie on those of the map ({why}): the place has changed, or it is another; the position rests on "
        "the anchors alone",
    )
