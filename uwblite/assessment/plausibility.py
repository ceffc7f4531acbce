"""Plausibility of a result: warnings and doubts from the estimates themselves.

Each rule yields findings; docs/findings.md describes their kinds.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ..arrays import Floats
from ..findings import WHEELS_AGAINST_LIDAR, Finding, doubt, kinds, warning
from ..graph.calibration import HEIGHT, RANGE_SCALE, Unknown
from ..graph.graph import PriorEdges, UnknownKey
from ..grid.occupancy_grid import OccupancyGrid
from ..map_result import AnchorEstimate, CalibrationEstimate
from ..pipeline.calibration_checks import OTHER_UNIT
from ..pipeline.estimate import Estimate, Task
from ..screening.units import likely_unit
from ..sensor_log.sensors import name_and_number
from .causes import explained
from .certainty import check_certainty, check_drifts, check_other_side
from .facts import check_recordings, say
from .range_agreement import DISAGREE, check_range_agreement, check_wheels_against_lidar
from .residual_tests import check_odometry, check_range_scatter, check_support
from .sensor_checks import check_sensors
from .untied_parts import check_untied_parts, check_untied_recordings

_UNUSUAL = 3.0
"""Prior standard deviations beyond which an estimate gets a warning."""
_RADIO_OR_WHEELS = "check the radio's settings and, where no lidar measures the distances, the scale of the wheels"
_LOST_WAY = 0.03
"""Share of the distance that, by the ranges, the wheels missed, from which on a map is too short."""
_UNRELATED = 0.2
"""Factor of the odometry's turns below which they are unrelated to those of the map: slip removes up to half of them."""
_WRONG_TURNS, _SLIPS_AT_MOST = 0.25, 0.4
"""Relative error of the odometry's turns beyond which their sign is no longer sure: where they are too small, and where too
large. Wheels that slip count too much, never too little: skid steering as if its track were wider, by two thirds at most."""
_ONE_TIME = 30.0
"""Moves within so much of each other count as simultaneous, s."""
_POOR_FIT = 4.0
"""chi2 per degree of freedom beyond which errors are twice the assumed noise: the model is not valid."""


@dataclass(frozen=True, slots=True, eq=False)
class ResultView:
    """What the rules about a result look at."""

    task: Task
    estimate: Estimate
    anchors: Sequence[AnchorEstimate]
    calibrated: Sequence[CalibrationEstimate]
    usual: Mapping[UnknownKey, Unknown]
    """Unknowns with their prior standard deviations."""
    table: dict[str, Floats]
    """MapResult.range_table."""
    grid: OccupancyGrid | None
    sigma: float
    """m, see check_certainty."""


def judge(view: ResultView) -> None:
    """Add the findings that the recordings, the stages and the finished estimate give rise to, causes before consequences."""
    findings = view.task.stages.findings
    for finding in _findings(view):
        findings.append(finding)
    findings[:] = explained(findings, partial(_left_without, view))


def _findings(view: ResultView) -> Iterator[Finding]:
    """Yield the findings of all rules; a rule may look at what those before it have added to the stages' findings."""
    estimate, task, anchors, table, grid = view.estimate, view.task, view.anchors, view.table, view.grid
    yield from say(task.stages.facts)
    yield from check_repairs(task)
    yield from check_certainty(estimate, view.sigma, task)
    yield from check_anchors(anchors)
    yield from check_range_agreement(anchors, table, task)
    yield from check_moved_together(anchors, table, task)
    yield from check_sensors([recording.log for recording in task.recordings.each])
    yield from check_closures(estimate, grid)
    yield from check_calibration(view.calibrated, view.usual, task)
    yield from check_lengths(estimate, task)
    yield from check_range_scatter(estimate, table.get("residual", np.zeros(0)), grid, task)
    yield from check_odometry(estimate, task)
    yield from check_support(estimate, task)
    yield from check_drifts(estimate, task)
    yield from check_untied_parts(estimate, task)
    yield from check_untied_recordings(estimate, task)
    yield from check_other_side(estimate, task)
    yield from check_handedness(estimate, task)
    yield from check_fit(task)
    yield from check_wheels_against_lidar(table, anchors, task)


def _left_without(view: ResultView, cause: Finding) -> set[tuple[str, str]]:
    """Return kind and anchor of what remains of the findings about all ranges where the times of a cause are left out."""
    ranges, table = view.estimate.ranges, view.table
    if ranges is None:
        return set()
    during = np.zeros(len(ranges), dtype=bool)
    for begin, end in cause.stretches:
        during |= (table["stamp"] >= begin) & (table["stamp"] <= end)
    kept = np.flatnonzero(~during | ((table["recording"] != cause.recording - 1) & (cause.recording > 0)))
    table = {name: column[kept] for name, column in table.items()}
    anchors = []
    for k, anchor in enumerate(view.anchors):
        agrees = table["agrees"][table["anchor"] == k]
        share = float(agrees.mean()) if len(agrees) else 1.0
        well = anchor.status == "distrusted" and share >= DISAGREE
        anchors.append(replace(anchor, used_share=share, status="ok" if well else anchor.status))
    estimate = replace(view.estimate, ranges=ranges.rows(kept))
    scatter = check_range_scatter(estimate, table["residual"], view.grid, view.task)
    found = [*scatter, *check_range_agreement(anchors, table, view.task), *check_anchors(anchors)]
    return {(finding.kind, finding.anchor) for finding in found}


def check_repairs(task: Task) -> Iterator[Finding]:
    """Say what the screening of the recordings found, but for what only a finished map can judge."""
    found = check_recordings([recording.log for recording in task.recordings.each])
    yield from (finding for finding in found if finding.kind != WHEELS_AGAINST_LIDAR)


def check_anchors(anchors: Sequence[AnchorEstimate]) -> Iterator[Finding]:
    """Warn of anchors that are not ok; doubt a map without any.

    Mirror ambiguity is a doubt where every anchor in reach has it.
    """
    unclear = not any(anchor.status == "ok" for anchor in anchors)
    for anchor in anchors:
        if anchor.status != "ok":
            add = doubt if anchor.status == "mirror-ambiguous" and unclear else warning
            text = f"anchor {anchor.id} is {anchor.status}: {anchor.reason}"
            yield replace(add(f"anchor-{anchor.status}", text, anchor=anchor.id), anchor=anchor.id)
    if anchors and all(a.status == "unplaced" for a in anchors):
        text = "no anchor could be placed: the trajectory rests on odometry and lidar alone; drive curves near the anchors"
        yield doubt("no-anchor", text)


def check_moved_together(anchors: Sequence[AnchorEstimate], table: dict[str, Floats], task: Task) -> Iterator[Finding]:
    """Doubt a map in which half of the anchors changed at one time.

    Swapped wheels, a changed radio or clock, or a lidar that displaces the trajectory have the same effect. With a lidar,
    a single anchor may have been moved, and between recordings all of them.
    """
    lidar = task.recordings.have_scans
    if not table or not anchors or (lidar and len(task.recordings.each) > 1):
        return
    names, stamps = [name_and_number(anchor.id) for anchor in anchors], table["stamp"]
    base = np.array([name for name, _ in names])[table["anchor"].astype(np.intp)]
    moves = sorted((a.since, k) for k, a in enumerate(anchors) if np.isfinite(a.since) and names[k][1] > 1)
    for start, _ in moves:
        these = [k for since, k in moves if start <= since < start + _ONE_TIME]
        early, late = stamps < start, stamps > max(anchors[k].since for k in these)
        both = set(base[early].tolist()) & set(base[late].tolist())
        changed = {names[k][0] for k in these}
        enough = len(changed) >= max(0.5 * len(both), 2 if lidar else min(2, len(both)))
        if enough:
            when = float(start - task.recordings.stamps[0])
            likelier = "an error of lidar, radio or clocks is likelier"
            if not lidar:
                likelier = "a change of wheels, tag or radio is likelier, and only the odometry connects both parts of the map"
            text = (
                f"{len(changed)} of {len(both | changed)} anchors seem to have moved at about t = {when:.0f} s: {likelier}; "
                "map both parts separately and compare"
            )
            yield doubt("anchors-moved-together", text, at=when, moved=len(changed), measured=len(both))
            return


def check_closures(estimate: Estimate, grid: OccupancyGrid | None) -> Iterator[Finding]:
    """Warn of a map without loop closures: how far it has drifted, its uncertainty says (see check_certainty)."""
    candidates = estimate.closures.candidates
    if grid is not None and candidates and not any(c.accepted for c in candidates):
        text = "no loop closure was accepted: drift is not corrected; drive through places twice"
        yield warning("no-closure", text, candidates=len(candidates))


def check_calibration(
    calibrated: Sequence[CalibrationEstimate], usual: Mapping[UnknownKey, Unknown], task: Task
) -> Iterator[Finding]:
    """Warn of each calibration value far outside its usual size; gross errors of the scale of ranges are `scales`.

    Ranges that are too long where the wheels counted nothing are a doubt: scans along a bare wall show only some of
    such stretches, and a map that lacks the others is too short. A value that a wrong unit explains is a doubt where no lidar
    shows whether the unit is that of the wheels or of the radio.

    Parameters
    ----------
    usual : unknowns with their prior standard deviations; of sound radios it is the settings' range_scale_sound.
    """
    said = kinds(task.stages.findings)
    for value in calibrated:
        scale = value.key.kind == RANGE_SCALE
        sigma = task.config.calibration.range_scale_sound if scale else usual[value.key].sigma
        clear = abs(value.value) > _UNUSUAL * max(sigma, value.sigma) and not (scale and abs(value.value) > OTHER_UNIT)
        if value.state != "estimated" or value.key.kind == HEIGHT or not clear:
            continue
        unit = "" if value.unit == "1" else f" {value.unit}"
        short = scale and value.value > _LOST_WAY and "wheels-stand-still" in said
        unit_of = likely_unit(1.0 + value.value) if value.key.kind in (RANGE_SCALE, "odometry_scale") else ""
        unclear = bool(unit_of) and not task.recordings.have_scans
        text = (
            f"{value.meaning} came out as {value.value:+.3g} \u00b1 {value.sigma:.2g}{unit}, where {sigma:.2g}{unit} is usual: "
            f"{_RADIO_OR_WHEELS if scale else 'check that sensor and its settings'}{unit_of}"
        )
        if short:
            text += "; the wheels missed some of the travelled distance: the map may be too short"
        add, figures = doubt if short or unclear else warning, {"value": value.value, "sigma": value.sigma, "usual": sigma}
        yield add("unusual-calibration", text, name=value.name, **figures)


def check_lengths(estimate: Estimate, task: Task) -> Iterator[Finding]:
    """Doubt a map whose ranges have other lengths, however uncertain, or whose lidar and wheels measured different ones.

    The map has the lidar's lengths, and without one those of the radio, which measures times of flight. What lidar and wheels
    measured is compared as it was before a calibration could take that up: no residual shows it.
    """
    calibration = estimate.graph.calibration
    place = calibration.index(RANGE_SCALE)
    error = float(calibration.values[place]) if place >= 0 and estimate.placed.any() else 0.0
    if abs(error) > OTHER_UNIT:
        text = f"the ranges are {1.0 + error:.2f} times the distances on the map: {_RADIO_OR_WHEELS}{likely_unit(1.0 + error)}"
        yield doubt("scales", text, range_scale=1.0 + error)
    screened = (recording.log.screening for recording in task.recordings.each)
    ratios = np.array([screening.lidar_by_wheels for screening in screened if screening is not None])
    off = ratios[np.isfinite(ratios) & (np.abs(ratios - 1.0) > OTHER_UNIT)]
    if len(off):
        text = (
            f"the lidar measures {off[0]:.2f} times the distance that the wheels count, and the map has the lidar's scale; "
            "check the units of both"
        )
        yield doubt("scales", text, lidar_by_wheels=float(off[0]))


def check_handedness(estimate: Estimate, task: Task) -> Iterator[Finding]:
    """Doubt a map whose ranges or scans fit only where the odometry's turns are scaled grossly.

    Ranges alone do not distinguish a map from its mirror image: a trajectory mirrored together with its anchors has the same
    ranges. Only the sign of the odometry's turns, a laser, or given anchors do. Where turns must be scaled by a
    factor far from 1, the mirror image fits as well with the negative factor, and the sign is undetermined. A laser that
    measures the opposite turns may itself be upside down; of scans in a wrong order a map with unrelated turns is made.
    """
    graph = estimate.graph
    given = sum(len(e) for e in graph.edges if isinstance(e, PriorEdges) and e.block == "anchors")
    if given > 2 or task.config.calibration.heading_scale <= 0.0:
        return
    for error in graph.calibration.values[graph.calibration.of_kinds("heading_scale")].tolist():
        factor = 1.0 + error
        if -_SLIPS_AT_MOST <= error <= _WRONG_TURNS or (task.recordings.have_scans and factor >= _UNRELATED):
            continue
        if not task.recordings.have_scans:
            text = (
                f"the map may be mirrored: the odometry's turns agree with the ranges only when multiplied by {factor:.2f}, "
                f"and by {-factor:.2f} its mirror image fits as well; check sign and scale of the odometry's heading, "
                "or give the places of three anchors"
            )
            yield doubt("mirrored", text, factor=factor)
        elif factor > -_UNRELATED:
            text = (
                "wheels and lidar measure different motions throughout: their turns have nothing in common (factor "
                f"{factor:.2f}); check the order of scans and beams, and whether the wheels count"
            )
            yield doubt(WHEELS_AGAINST_LIDAR, text, factor=factor)
        else:
            text = (
                f"the map may be mirrored: the odometry's turns agree with the laser's only when multiplied by {factor:.2f}; "
                "is the laser upside down (`mounting.laser_flipped`), or has the odometry's heading the wrong sign?"
            )
            yield doubt("mirrored", text, factor=factor)


def check_fit(task: Task) -> Iterator[Finding]:
    """Doubt a map whose residuals are far larger than the noise allows."""
    fits = [float(stage.figures["chi2_per_dof"]) for stage in task.stages.done if "chi2_per_dof" in stage.figures]
    if fits and fits[-1] > _POOR_FIT:
        times = float(np.sqrt(fits[-1]))
        text = (
            f"the residuals are {times:.1f} times as large as the noise allows (chi2/dof {fits[-1]:.1f}): a sensor or one of "
            "its settings is wrong; see the residuals in report.html"
        )
        yield doubt("poor-fit", text, chi2_per_dof=fits[-1])
