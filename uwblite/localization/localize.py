"""Localisation of a recording in an existing map: the live localiser, forwards and backwards over the recording.

A pass estimates the pose from all earlier measurements, the pass in the opposite direction from all later ones. They are
independent, so that their poses are averaged by their covariances: the two-filter form of the optimal smoother (D. Fraser, J.
Potter, The optimum linear smoother as a combination of two optimum linear filters, 1969). Where the scans fit the map's walls
nowhere, the anchors alone determine where the robot was, and the result is doubted.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from .. import se2
from ..arrays import Bools, Floats, Ints
from ..assessment.facts import check_recording
from ..errors import Cancelled, DataError
from ..findings import DOUBT, WARNING, Finding, doubt, of_severity, warning
from ..screening.screen import screen
from ..sensor_log import SensorLog
from .known_map import KnownMap
from .localizer import Localizer
from .sensing import Scanner

LEAST_LOCALIZED = 0.8
"""Share of the poses that must be known, and on which both passes must agree."""
_SPACING = (0.1, 0.1, 1.0)
"""m, rad and s that count as one step each, and add up; poses and the scans that are used are a step apart."""
_CONTRADICTION = 1e-5
"""Probability of two passes that agree to be as far apart."""
_DIGITS = 4
"""Of shares in findings."""
_REPORTED = 1000
"""Events between two reports of progress."""
_RANGE, _ODOMETRY, _SCAN = 0, 1, 2
"""Kinds of events; of a range and an odometry at the same time the range comes first, and waits."""

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


@dataclass(frozen=True, slots=True, eq=False)
class Pass:
    """Result of one pass."""

    poses: Floats
    """(k, 3) T_map_base at the wanted times; nan where it was lost."""
    covariances: Floats
    """(k, 3, 3) m, m, rad; without the map's own errors."""
    ends: Floats
    """(2,) of rays on walls of the map, and in its known space, while the pose was known."""
    moved_anchors: tuple[str, ...]
    reason: str
    """Why it was lost in the end; empty where it was not."""


def localize(log: SensorLog, known: KnownMap, *, turn_laser: bool = True, progress: Progress | None = None) -> Localization:
    """Find the trajectory of a recording in an earlier map.

    Parameters
    ----------
    log : the recording, with ranges to at least two of the map's anchors, or with lidar in a place that no other part of
        the map looks like.
    known : the earlier map, which is not changed.
    turn_laser : take the laser as mounted the way that its scans show, see screening.screen.
    progress : called with what is done.

    Raises
    ------
    DataError : the recording has ranges to fewer than two of the map's anchors, and there are no walls to compare; or it is
        found nowhere in the map for certain.
    Cancelled : progress returned False.
    """
    measured = set(log.ranges.anchor_ids) if log.ranges is not None else set()
    shared = [name for name in known.anchors.ids if name in measured]
    if len(shared) < 2 and (known.walls is None or log.scans is None):
        raise DataError(
            f"the recording has ranges to {len(shared)} of the map's anchors ({', '.join(known.anchors.ids)}); "
            "two or more are needed to find it in the map, or lidar in both"
        )
    # Each anchor of the map takes time in every step; those without ranges add no information.
    known = replace(known, anchors=known.anchors.only(shared))
    log = screen(log, turn_laser)
    rows = np.unique(np.append(_first_of_each(_way(log)), len(log.odometry.stamps) - 1))
    passes, doubts = _both(log, known, rows, progress), []
    if _lost(passes) and known.walls is not None and len(shared) >= 2:
        text = (
            f"the walls do not lie on those of the map ({passes[0].reason}): the place has changed, or it is another; "
            "the position rests on the anchors alone"
        )
        doubts.append(doubt("walls-differ", text))
        passes = _both(log, replace(known, walls=None), rows, progress)
    if _lost(passes):
        raise DataError(f"the recording is found nowhere in the map for certain: {passes[0].reason}")
    poses, covariances, contradicting = smoothed(*passes, known.covariance_at)
    there, ends = np.isfinite(poses).all(axis=1), passes[0].ends + passes[1].ends
    overlap, localized = float(ends[0] / ends[1]) if ends[1] else float("nan"), float(there.mean())
    findings = [*doubts, *check_recording(log)]
    if len(shared) < 2:
        text = f"it has ranges to {len(shared)} of the map's anchors: its place is from the walls alone"
        findings.append(warning("few-common-anchors", text, anchors=len(shared)))
    for name in sorted({n for p in passes for n in p.moved_anchors}):
        text = f"anchor {name} does not stand where the map has it: it was moved; its ranges were left out"
        findings.append(warning("moved-anchor", text, anchor=name))
    if localized < 1.0:
        reason = passes[0].reason or passes[1].reason or "measurements and map fell apart meanwhile"
        text = f"{1.0 - localized:.0%} of the recording is not localized and left out: {reason}"
        say = doubt if localized < LEAST_LOCALIZED else warning
        findings.append(say("not-localized", text, localized=round(localized, _DIGITS)))
    if (agreed := 1.0 - float(contradicting[there].mean())) < LEAST_LOCALIZED:
        text = f"forwards and backwards the recording is found at different places for {1.0 - agreed:.0%} of its poses"
        findings.append(doubt("ambiguous-place", text, agreed=round(agreed, _DIGITS)))
    return Localization(
        log.odometry.stamps[rows][there],
        poses[there],
        covariances[there],
        localized,
        overlap,
        of_severity(findings, WARNING),
        of_severity(findings, DOUBT),
    )


def _both(log: SensorLog, known: KnownMap, rows: Ints, progress: Progress | None) -> tuple[Pass, Pass]:
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


def _way(log: SensorLog) -> Floats:
    """Return how far the odometry has come (n,), in units of _SPACING."""
    o = log.odometry
    step = np.column_stack([np.diff(o.poses, axis=0), np.diff(o.stamps)])
    far = np.hypot(step[:, 0], step[:, 1]), np.abs(se2.wrap_angle(step[:, 2])), step[:, -1]
    return np.concatenate([[0.0], np.cumsum(sum(part / unit for part, unit in zip(far, _SPACING, strict=True)))])


def _first_of_each(way: Floats) -> Ints:
    return np.unique(np.floor(way), return_index=True)[1].astype(np.intp)


def run_pass(log: SensorLog, known: KnownMap, rows: Ints, backwards: bool, report: Callable[[int, int], None]) -> Pass:
    """Play a recording through a localiser whose only prior knowledge is the map.

    Parameters
    ----------
    rows : (k,) of the odometry at which poses are wanted. backwards : from its end to its beginning: times change their sign.
    report : called with the events that are done and their number.
    """
    sign, s = -1.0 if backwards else 1.0, log.scans
    scanner = None if s is None else Scanner.of(s, sign)
    localizer = Localizer(replace(known, laser_delay=sign * known.laser_delay), log.mounting, scanner)
    poses = np.full(log.odometry.poses.shape, np.nan)
    covariances = np.full((*poses.shape, *poses.shape[1:]), np.nan)
    times, kinds, numbers = _events(log, known, sign)
    wanted, reason = set(rows.tolist()), ""
    for done, (at, kind, k) in enumerate(zip(times.tolist(), kinds.tolist(), numbers.tolist(), strict=True)):
        if kind == _ODOMETRY:
            state = localizer.add_odometry(at, *log.odometry.poses[k].tolist())
            if k in wanted and localizer.tracks:
                poses[k], covariances[k] = state.pose, state.covariance - known.covariance_at(state.pose[:2])
            reason = state.reason
        elif kind == _RANGE and (r := log.ranges) is not None:
            tag = 0 if r.tag is None else int(r.tag[k])
            localizer.add_ranges(at, [r.anchor_ids[r.anchor[k]]], [float(r.ranges[k])], tag)
        elif s is not None:
            localizer.add_scan(at, s.ranges[k])
        if done % _REPORTED == 0:
            report(done, len(times))
    return Pass(poses[rows], covariances[rows], localizer.ends, localizer.state().moved_anchors, reason)


def _events(log: SensorLog, known: KnownMap, sign: float) -> tuple[Floats, Ints, Ints]:
    """Return times (e,), kinds (e,) and rows (e,) of the measurements in the order of a pass."""
    o = log.odometry
    parts = [(_ODOMETRY, o.stamps, np.arange(len(o.stamps)))]
    if log.ranges is not None:
        parts.append((_RANGE, log.ranges.stamps, np.arange(len(log.ranges.stamps))))
    if log.scans is not None and len(log.scans.stamps) and known.walls is not None:
        used = _first_of_each(np.interp(log.scans.stamps, o.stamps, _way(log)))
        parts.append((_SCAN, log.scans.stamps[used], used))
    times = sign * np.concatenate([stamps for _, stamps, _ in parts])
    kinds = np.concatenate([np.full(len(rows), kind) for kind, _, rows in parts])
    order = np.lexsort((kinds, times))
    return times[order], kinds[order], np.concatenate([rows for _, _, rows in parts])[order]


def smoothed(one: Pass, other: Pass, of_map: Callable[[Floats], Floats]) -> tuple[Floats, Floats, Bools]:
    """Average two passes by their covariances.

    ``x = a + A (A + B)^-1 (b - a)``, ``P = A - A (A + B)^-1 A``. Where they contradict one another the more certain one is
    kept, with a covariance that includes the other.

    Parameters
    ----------
    of_map : from places (k, 2) to the covariances (k, 3, 3) of the map's own errors there, which both passes share.

    Returns
    -------
    Poses (k, 3), nan where both were lost, their covariances (k, 3, 3) with the map's own errors, and where (k,) both know the
    pose and it is not the same.
    """
    a, b = one.poses, other.poses
    off = b - a
    off[:, 2] = se2.wrap_angle(off[:, 2])
    both = np.isfinite(off).all(axis=1)
    poses = np.where(np.isfinite(a), a, b)
    covariances = np.where(np.isfinite(one.covariances), one.covariances, other.covariances)
    common = of_map(poses[:, :2])
    A, B, d = one.covariances[both], other.covariances[both], off[both]
    gain = A @ np.linalg.inv(A + B)
    squared = np.einsum("ni,nij,nj->n", d, np.linalg.inv(A + B + common[both]), d)
    far = squared > chdtri(d.shape[1], _CONTRADICTION)
    mean, joint = a[both] + np.einsum("nij,nj->ni", gain, d), A - gain @ A
    first = np.trace(A, axis1=1, axis2=2) <= np.trace(B, axis1=1, axis2=2)
    surer = np.where(first[:, None], a[both], b[both])
    wide = np.where(first[:, None, None], A, B) + d[:, :, None] * d[:, None, :]
    poses[both] = np.where(far[:, None], surer, mean)
    covariances[both] = np.where(far[:, None, None], wide, 0.5 * (joint + joint.transpose(0, 2, 1)))
    poses[:, 2] = se2.wrap_angle(poses[:, 2])
    contradicting = np.zeros(len(a), dtype=bool)
    contradicting[both] = far
    return poses, covariances + common, contradicting
