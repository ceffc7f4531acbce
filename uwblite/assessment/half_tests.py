"""Comparison of the wheels' calibration from both halves of a recording: ranges alone hardly show a change of it.

A heading that stands still from some time on, or a tyre that was changed, can be explained by wrong values of the
wheels' calibration, constant over the whole recording, and displaced anchors, with hardly larger residuals. So both halves are
estimated once more, each with a calibration of its own, from the joint estimate. Where a lidar measures the motion from
scan to scan, such a change is seen directly (screening/wheel_motion.py).

Turns whose sign changed (wheels swapped, a gyro turned over) are not near the joint estimate. There each half is
bootstrapped on its own: their anchors are then mirror images of each other, and seem to have been moved. A half that fits its
own mirror image about as well, as along a straight way past all anchors, says nothing.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from .. import se2
from ..arrays import Floats, rms_length
from ..findings import Finding, doubt, kinds
from ..graph.calibration import RANGE_SCALE
from ..graph.graph import Graph, PriorEdges
from ..graph.marginals import marginals
from ..graph.solver import optimize
from ..pipeline.estimate import Estimate, Task
from ..pipeline.mirror_images import mirrored_whole
from ..pipeline.progress import Stages
from ..pipeline.radio_stages import bootstrapped, dead_reckoning
from ..pipeline.recordings import Recording, gather
from ..sensor_log.anchor_names import radio_name

_CHANGES = {"odometry_scale": 0.1, "heading_scale": 0.2, "heading_per_metre": 0.05}
"""Differences between halves that no faultless base has: of lengths, of turns, and of turns per metre, rad/m."""
_SIGMAS = 4.0
"""Standard deviations of the difference that it must exceed."""
_LEAST_STEPS, _LEAST_RANGES = 30, 40
"""Least number of steps and of ranges of a half that is tested."""
_FEW = 8
"""Ranges to an anchor with which a half can estimate it."""


def check_halves(estimate: Estimate, task: Task) -> Iterator[Finding]:
    """Doubt a map of a recording without lidar whose halves need different wheels."""
    for recording in task.recordings.each:
        if recording.has_scans or estimate.ranges is None:
            continue
        if "range-scatter" not in kinds(task.stages.findings):
            # Ranges that are no distances give no anchors by either half; a bootstrap would be useless.
            yield from _check_sign_of_turns(_with_places(recording, estimate), task)
        rows, middle = recording.rows, (recording.rows.start + recording.rows.stop) // 2
        halves = [_calibration(estimate, recording, slice(*ends), task) for ends in ((rows.start, middle), (middle, rows.stop))]
        if halves[0] is None or halves[1] is None:
            continue
        yield from _compare(halves[0], halves[1], task)


def _compare(one: Floats, other: Floats, task: Task) -> Iterator[Finding]:
    """Doubt where values and standard deviations (3, 2) of two halves differ."""
    difference, sigma = np.abs(one[:, 0] - other[:, 0]), np.hypot(one[:, 1], other[:, 1])
    for k, (kind, most) in enumerate(_CHANGES.items()):
        if difference[k] > max(most, _SIGMAS * sigma[k]):
            text = (
                f"the halves of the recording need different calibrations of the wheels ({kind} {one[k, 0]:+.3f} and "
                f"{other[k, 0]:+.3f}, difference known to {sigma[k]:.3f}): wheels, gyro or ranges changed meanwhile; "
                "map the halves separately"
            )
            yield doubt("halves-disagree", text, first=float(one[k, 0]), second=float(other[k, 0]), sigma=float(sigma[k]))


def _calibration(estimate: Estimate, recording: Recording, rows: slice, task: Task) -> Floats | None:
    """Return values and standard deviations (3, 2) of the wheels by some keyframes; None where these are too few."""
    graph, wheels, ranges = estimate.graph, estimate.odometry, estimate.ranges
    places = [graph.calibration.index(kind, recording=recording.number) for kind in _CHANGES]
    if ranges is None or min(places) < 0:
        return None
    steps = np.flatnonzero((wheels.i >= rows.start) & (wheels.j < rows.stop))
    own = (ranges.pose >= rows.start) & (ranges.pose < rows.stop) & ranges.alive
    unseen = np.bincount(ranges.anchor[own], minlength=len(graph.anchors)) < _FEW
    used = np.flatnonzero(own & ~unseen[ranges.anchor])
    if len(steps) < _LEAST_STEPS or len(used) < _LEAST_RANGES:
        return None
    fixed = np.ones(len(graph.poses), dtype=bool)
    fixed[rows.start + 1 : rows.stop] = False
    priors = tuple(_loose(e, places[0]) for e in graph.calibration_priors)
    fixed_values = graph.fixed_calibration | graph.calibration.of_kinds(RANGE_SCALE)
    fixed_values[places] = False
    alone = Graph(graph.poses, graph.anchors, priors, graph.calibration, fixed, unseen, fixed_values, graph.work)
    solved = optimize(alone.with_edges(wheels.rows(steps), ranges.rows(used)), task.config.solver)[0]
    return np.column_stack([solved.calibration.values[places], marginals(solved).covariances.calibration[places]])


def _loose(priors: PriorEdges, place: int) -> PriorEdges:
    """Return priors of the calibration that leave the scale of the wheels to the data."""
    factor = np.where(priors.index == place, 1.0 / _LOOSER, 1.0)
    return replace(priors, sqrt_information=factor[:, None, None] * priors.sqrt_information)


_LOOSER = 20.0
"""Factor on the prior standard deviation of that unit: a change during the recording may have any size."""


def _check_sign_of_turns(recording: Recording, task: Task) -> Iterator[Finding]:
    """Doubt where anchors by either half alone are mirror images of each other."""
    stamps = recording.frames.stamps
    middle = float(stamps[len(stamps) // 2])
    halves = (_anchors_alone(recording, *ends, task) for ends in ((-np.inf, middle), (middle, np.inf)))
    one, other = (_radios_at_one_place(anchors) for anchors in halves)
    both = sorted(one.keys() & other.keys())
    if len(both) < _TRIANGLE:
        return
    p, q = np.array([one[name] for name in both]), np.array([other[name] for name in both])
    turned, mirrored = _misfit(p, q), _misfit(p * (1.0, -1.0), q)
    if turned > max(_FAR, _CLEARLY * mirrored):
        text = (
            f"the anchors found from the first and from the second half of the recording are mirror images ({turned:.1f} m "
            f"apart, {mirrored:.1f} m when mirrored): the odometry's turns are wrong in one of the halves"
        )
        yield doubt("halves-disagree", text, apart=turned, mirrored=mirrored)


def _radios_at_one_place(anchors: dict[str, Floats]) -> dict[str, Floats]:
    """Return the places (2,) of the radios that have one place, from those of anchors, by the name of the radio."""
    names = [radio_name(name) for name in anchors]
    return {name: place for name, place in zip(names, anchors.values(), strict=True) if names.count(name) == 1}


def _with_places(recording: Recording, estimate: Estimate) -> Recording:
    """Return a recording with each place of an anchor that was moved as an anchor of its own."""
    ranges, names = estimate.ranges, estimate.anchor_ids
    if ranges is None or recording.log.ranges is None or len(set(map(radio_name, names))) == len(names):
        return recording
    measured = replace(recording.log.ranges, anchor=ranges.anchor[recording.has(ranges.pose)], anchor_ids=names)
    return replace(recording, log=replace(recording.log, ranges=measured))


_TRIANGLE = 3
"""Anchors that have a handedness."""
_FAR, _CLEARLY = 1.0, 4.0
"""Least distance between both halves' anchors, m, and its least ratio to that of their mirror images."""
_RANGES_ALONE = 1500
"""Ranges with which a half is bootstrapped, at most."""
_WIDE = 0.1
"""Least ratio of width to length of a path that shows to which side it turns."""


def _anchors_alone(recording: Recording, start: float, end: float, task: Task) -> dict[str, Floats]:
    """Return the anchors (2,) by a part of a recording alone, in a frame of their own; none where it determines them badly."""
    log = recording.log.crop(start, end)
    if log.ranges is None or len(log.ranges.stamps) < _LEAST_RANGES or len(log.odometry.stamps) < _LEAST_STEPS:
        return {}
    some = np.arange(0, len(log.ranges.stamps), -(-len(log.ranges.stamps) // _RANGES_ALONE))
    thinned = gather([replace(log, ranges=log.ranges.rows(some))], task.config.keyframes)
    own = replace(task, recordings=thinned, stages=Stages(None, None))
    found = bootstrapped(dead_reckoning(thinned.each[0], task.config, task.stages.work), 0, own)
    places = found.graph.poses[:, :2]
    spread = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    if found.ranges is None or spread[1] < _WIDE * spread[0]:
        return {}
    often = np.bincount(found.ranges.anchor, found.ranges.alive, minlength=len(found.anchor_ids)) >= _FEW
    shown = found.placed & often
    best = optimize(found.problem, task.config.solver)[0]
    if mirrored_whole(best, found.ranges, shown & ~best.fixed_anchors, task.config.solver) is not None:
        return {}
    return {found.anchor_ids[k]: found.graph.anchors[k] for k in np.flatnonzero(shown)}


def _misfit(p: Floats, q: Floats) -> float:
    """Return the rms distance of points (n, 2) after the best rigid motion, m."""
    return rms_length(se2.transform(se2.align(p, q), p) - q)
