"""Parts of a recording that only the odometry connects with the rest, without scans, closures or anchors.

Where the lidar gives no scans while the robot drives, where all anchors are replaced by others at once, or where the wheels
slip along a bare wall, only the odometry connects the later part of the map with the earlier one, and its errors leave no
residual. So its claim there is replaced by what wheels that slip can do: the marginal covariance of the relative pose of both
sides, by everything else that was measured, shows whether they are connected all the same. Where all other sensors end, the
odometry alone determines the rest.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ..arrays import BEYOND_NOISE, Bools, Floats, Ints
from ..findings import Finding, doubt
from ..graph.graph import Edges
from ..graph.marginals import JointCovariance
from ..graph.pose_edges import OdometryEdges, RelativePoseEdges, ScanEdges
from ..graph.range_edges import RangeEdges
from ..loop_closure.chain_breaks import TiePolicy
from ..pipeline.estimate import Estimate, Task
from ..pipeline.recordings import Recording, Recordings
from ..sensor_log.sensors import radio_name

_SILENT, _DRIVEN = 10.0, 3.0
"""Time without any scan, s, and distance meanwhile, m, after which an odometry that failed may have any error. Anchors that all
end, and others that all appear, within this time were not passed one after the other."""
_PART = 6
"""Least number of keyframes of a part for a doubt."""
_SLIP = np.array([1.0, 1.0, 0.2])
"""m, m, rad, by which wheels that slip are off in a step at most."""
_KNOWN, _KNOWN_SHARE = 0.5, 0.01
"""Share of it, and of the map's diameter, up to which the relative pose of two parts must be known, in any direction."""
_MOST = 64
"""Runs of such steps that are tested, those with the largest errors."""
_ANCHORS, _MEASURED = 2, 3
"""Least number of anchors that end or appear together, or by which more agree than do not; and of ranges to each of them, also
of constrained keyframes at an end of a recording."""
_SPIN = 5.0
"""Time, s, for which wheels spin."""
_PER_METRE = 0.02
"""rad/m; drift of heading by which wheels and gyros differ between floors, loads and temperatures. A robot that drives straight
on exceeds the limit below after 7 m."""
_ASTRAY = 0.5
"""m; error of a place from which on the map counts as wrong there, if it is more than _KNOWN_SHARE of the map's diameter."""


def check_untied_parts(estimate: Estimate, task: Task) -> Iterator[Finding]:
    """Doubt a map whose parts only the odometry connects, where another sensor had no data in between."""
    ranges = estimate.ranges
    alive = None if ranges is None else ranges.rows(np.flatnonzero(ranges.alive))
    yield from check_loose_ends(estimate, alive, task)
    for recording in task.recordings.each:
        stamps = recording.frames.stamps
        breaks = _without_scans(recording) if recording.has_scans else _exchanged(recording, alive)
        for before, after in breaks:
            first = recording.rows.start + int(np.searchsorted(stamps, before, "right"))
            last = recording.rows.start + int(np.searchsorted(stamps, after))
            sizes = first - recording.rows.start, recording.rows.stop - last
            if min(sizes) < _PART or not _loose_between(estimate, task, np.array([first - 1, last])):
                continue
            what = "the lidar is silent" if recording.has_scans else "all anchors are replaced by others"
            yield doubt(
                "untied-parts",
                f"from t = {before - stamps[0]:.0f} to {after - stamps[0]:.0f} s {what}, and neither scans nor anchors "
                "connect the parts before and after: each may be right, but their relative pose rests on the odometry alone; "
                "drive through the first part once more, or map the parts separately",
                start=before,
                end=after,
            )


def check_loose_ends(estimate: Estimate, ranges: RangeEdges | None, task: Task) -> Iterator[Finding]:
    """Doubt a map with a stretch that no scan, closure or range constrains, where usual wheels drift too far.

    Errors of the wheels there leave no residual, and sigmas assume faultless wheels. A stretch in the middle matters without
    ranges, where nothing else connects both sides; either of them errs by half.
    """
    ends = [] if ranges is None else [ranges.pose]
    ends += [np.append(e.i, e.j) for e in estimate.graph.edges if isinstance(e, ScanEdges | RelativePoseEdges)]
    held, most = np.unique(np.concatenate([np.zeros(0, dtype=np.intp), *ends])), max(_ASTRAY, _KNOWN_SHARE * _extent(estimate))
    for recording in task.recordings.each if len(held) else ():
        frames, places = recording.frames, estimate.graph.poses[recording.rows, :2]
        own, time = held[recording.has(held)] - recording.rows.start, frames.stamps - frames.stamps[0]
        first, last = (int(own[_MEASURED - 1]), int(own[-_MEASURED])) if len(own) >= _MEASURED else (0, 0)
        spans = [
            (f"until t = {time[first]:.0f} s", f"`start={time[first]:.0f}` leaves", 1.0, np.arange(first, -1, -1)),
            (f"from t = {time[last]:.0f} s", f"`end={time[last]:.0f}` leaves", 1.0, np.arange(last, len(places))),
        ]
        for k in np.flatnonzero(np.diff(own) > 1).tolist() if ranges is None else ():
            begin, end = (f"{time[row]:.0f}" for row in own[k : k + 2])
            when, cut = f"from t = {begin} to {end} s", f"`end={begin}` and `start={end}` leave"
            spans.append((when, cut, 0.5, np.arange(own[k], own[k + 1] + 1)))
        for when, cut, share, rows in spans:
            way = float(frames.path[np.minimum(rows[1:], rows[:-1])].sum())
            # A heading that drifts evenly moves the end of a straight path aside by half of the last turn.
            off = share * 0.5 * _PER_METRE * way * float(np.hypot(*(places[rows] - places[rows[0]]).T).max())
            between = share < 1.0
            if off > most and (not between or _loose_between(estimate, task, recording.rows.start + rows[[0, -1]])):
                loose = doubt(
                    "untied-parts",
                    f"{when}, over {way:.0f} m, neither scans nor ranges constrain the trajectory: usual wheels drift by "
                    f"{off:.1f} m over that distance; cut that part off, or find out why no sensor measured there",
                    at=float(frames.stamps[rows[0]]),
                    way=way,
                    error=off,
                )
                stretch = np.sort(frames.stamps[rows[[0, -1]]])
                stretches = ((float(stretch[0]), float(stretch[1])),)
                yield replace(loose, recording=recording.number + 1, stretches=stretches, cure=f"{cut} that part out")


def _loose_between(estimate: Estimate, task: Task, ends: Ints) -> bool:
    """Return whether only the odometry connects two keyframes (2,)."""
    wheels = estimate.odometry
    slips = ((wheels.i >= ends[0]) & (wheels.j <= ends[1]))[:, None] * _SLIP
    return not _tied(estimate, task.recordings.path, slips, ends[:1], ends[1:])[0]


def _without_scans(recording: Recording) -> list[tuple[float, float]]:
    """Return when, from and to, s, a robot that drives has no scans."""
    scans, odometry = recording.log.scans, recording.log.odometry
    if scans is None or len(scans.stamps) < 2:
        return []
    way = np.diff(odometry.travelled_at(scans.stamps))
    at = np.flatnonzero((np.diff(scans.stamps) > _SILENT) & (way > _DRIVEN))
    return [(float(scans.stamps[k]), float(scans.stamps[k + 1])) for k in at.tolist()]


def _exchanged(recording: Recording, ranges: RangeEdges | None) -> list[tuple[float, float]]:
    """Return the times, from and to, s, at which several anchors end for good and several others appear."""
    if ranges is None or not len(ranges):
        return []
    own = ranges.rows(np.flatnonzero(recording.has(ranges.pose)))
    order = np.argsort(own.stamps, kind="stable")
    stamps, anchor = own.stamps[order], own.anchor[order]
    _, appears = np.unique(anchor, return_index=True)
    _, from_end = np.unique(anchor[::-1], return_index=True)
    silent = len(anchor) - 1 - from_end
    # No anchor is measured both up to and after range k.
    spans = np.zeros(len(anchor) + 1, dtype=np.intp)
    np.add.at(spans, appears, 1)
    np.add.at(spans, silent, -1)
    at = np.flatnonzero(np.cumsum(spans)[: len(anchor)] == 0)[:-1]
    # Several are measured shortly before such a range, and several shortly after the next.
    sides = [
        ((stamps > stamps[k] - _SILENT) & (stamps <= stamps[k]), (stamps > stamps[k]) & (stamps < stamps[k + 1] + _SILENT))
        for k in at
    ]
    return [
        (float(stamps[k]), float(stamps[k + 1]))
        for k, pair in zip(at, sides, strict=True)
        if min(len(np.unique(anchor[side])) for side in pair) >= _ANCHORS
    ]


def _independent(edges: Edges, path: Floats, slid: Floats) -> Edges:
    """Return scan edges between neighbours, and between visits those that measure all directions well.

    Others of one visit were matched where the chain had put the clouds, and so were all of them in weak directions. Nor is the
    direction that an edge leaves free known exactly. A slip along a wall is seen aside by its size times the error of that
    direction, which differs from edge to edge: hundreds of edges between two visits would measure the slip by that alone, and
    those over one step count as one.

    Parameters
    ----------
    path : (k,) travelled distance, m. slid : (k,) variance of all slips up to each keyframe, m^2.
    """
    if not isinstance(edges, ScanEdges):
        return edges
    unit, over_a_step = np.array(TiePolicy.clear), 0.5 * TiePolicy.near * (TiePolicy.near + 1)
    information = np.swapaxes(edges.sqrt_information, 1, 2) @ edges.sqrt_information
    values, vectors = np.linalg.eigh(information * np.outer(unit, unit))
    values, free = np.maximum(values, 0.0), values[:, 0] < np.square(unit[0] / _SLIP[0])
    aside = over_a_step * np.square(unit[2] / unit[0]) * np.abs(slid[edges.i] - slid[edges.j]) * free
    root = np.sqrt(values / (1.0 + values * aside[:, None]))
    again = np.abs(path[edges.i] - path[edges.j]) > TiePolicy.another_visit
    kept = np.where(again, values[:, 0] > 1.0, np.abs(edges.i - edges.j) <= TiePolicy.near)
    edges = replace(edges, sqrt_information=root[:, :, None] * np.swapaxes(vectors, 1, 2) / unit)
    return edges.rows(np.flatnonzero(kept))


def _extent(estimate: Estimate) -> float:
    """Return the diameter of the map, m."""
    return float(np.hypot(*np.ptp(estimate.graph.poses[:, :2], axis=0)))


def _tied(estimate: Estimate, path: Floats, slips: Floats, i: Ints, j: Ints) -> Bools:
    """Return whether keyframes i (m,) are known from j (m,) by all measurements, where steps may slip by (e, 3), m, m, rad.

    Parameters
    ----------
    path : (k,) travelled distance, m.
    """
    wheels, steps = estimate.odometry, np.flatnonzero(slips.any(axis=1))
    root, slid = wheels.sqrt_information.copy(), np.zeros(len(path))
    covariance = np.linalg.inv(np.swapaxes(root[steps], 1, 2) @ root[steps]) + slips[steps, :, None] ** 2 * np.eye(3)
    root[steps] = np.swapaxes(np.linalg.cholesky(np.linalg.inv(covariance)), 1, 2)
    slid[wheels.j] = slips[:, 0] ** 2
    others = [_independent(e, path, np.cumsum(slid)) for e in estimate.graph.edges if not isinstance(e, OdometryEdges)]
    graph = replace(estimate.graph, edges=(*others, replace(wheels, sqrt_information=root)))
    relative = JointCovariance(graph, np.unique(np.append(i, j))).relative(i, j)
    known = max(_KNOWN, _KNOWN_SHARE * _extent(estimate) / float(_SLIP[0]))
    return np.asarray(np.linalg.eigvalsh(relative / np.outer(_SLIP, _SLIP))[:, -1] < known**2)


def untied_steps(estimate: Estimate, recordings: Recordings) -> Ints:
    """Return the steps (s,) of the odometry that slipped, or that the map contradicts, and whose sides nothing else connects.

    Their noise is that of a slip of the share that shows in some direction: wheels that slip forward may have turned as well.
    Without ranges, known slips, which the map follows, have their own noise. Steps with hardly any keyframes between them are
    one run; a few keyframes at an end of a recording are no part.
    """
    wheels = estimate.odometry
    noise = np.sqrt(np.diagonal(np.linalg.inv(np.swapaxes(wheels.sqrt_information, 1, 2) @ wheels.sqrt_information), 0, 1, 2))
    off = np.abs(wheels.residuals(estimate.graph))
    share = np.where(off > BEYOND_NOISE, off * noise / _SLIP, 0.0).max(axis=1, initial=0.0)
    # Ranges connect parts better than one pose with another: then known slips are in the map's own uncertainty.
    known = estimate.slipped[:, None] & (estimate.ranges is None)
    slips = np.minimum(np.where(share[:, None] > 0.0, share[:, None] * _SLIP, known * noise), _SLIP)
    rows = np.array([(r.rows.start, r.rows.stop) for r in recordings.each])[recordings.of_keyframe[wheels.i]]
    sides = np.minimum(wheels.i + 1 - rows[:, 0], rows[:, 1] - wheels.j)
    steps = np.flatnonzero(slips.any(axis=1) & (sides >= _PART))
    if not len(steps):
        return steps
    new = np.append(True, np.diff(wheels.i[steps]) >= _PART)
    first, last = steps[new], steps[np.append(new[1:], True)]
    for a, b in zip(first.tolist(), last.tolist(), strict=True):
        # Wheels that spin for seconds are off by the same in each step, and such errors add up.
        stamps = recordings.stamps[wheels.i[a : b + 1]]
        together = np.searchsorted(stamps, stamps + _SPIN) - np.arange(b + 1 - a)
        slips[a : b + 1] *= np.sqrt(together.max())
    largest = np.array([slips[a : b + 1].max() for a, b in zip(first, last, strict=True)])
    runs = np.sort(np.argsort(-largest, kind="stable")[:_MOST])
    return first[runs[~_tied(estimate, recordings.path, slips, wheels.i[first[runs]], wheels.j[last[runs]])]]


def check_untied_recordings(estimate: Estimate, task: Task) -> Iterator[Finding]:
    """Doubt a recording that has hardly more anchors where the others have them than elsewhere, and no closure with these.

    Where anchors disagree, which of them were moved is a majority's word, and two that agree by chance are no majority: the
    recording may as well be of another place with anchors of the same names.
    """
    recordings, ranges, names = task.recordings, estimate.ranges, estimate.anchor_ids
    if len(recordings.each) == 1 or ranges is None:
        return
    alive = ranges.rows(np.flatnonzero(ranges.alive))
    counts = np.zeros((len(recordings.each), len(names)), dtype=np.intp)
    np.add.at(counts, (recordings.of_keyframe[alive.pose], alive.anchor), 1)
    heard = (counts >= _MEASURED) & estimate.placed
    radio = np.array([radio_name(name) for name in names])
    ends = recordings.of_keyframe[np.stack([estimate.closures.edges.i, estimate.closures.edges.j])]
    # Of two that contradict each other, the second is named.
    for recording in recordings.each[1 if len(recordings.each) == 2 else 0 :]:
        n, others = recording.number, np.delete(heard, recording.number, axis=0).any(axis=0)
        same = heard[n] & others
        moved = np.setdiff1d(np.intersect1d(radio[heard[n]], radio[others]), radio[same])
        tied = np.any((ends == n).any(axis=0) & (ends[0] != ends[1]))
        if len(moved) and int(same.sum()) - len(moved) < _ANCHORS and not tied:
            yield doubt(
                "untied-parts",
                f"{recording.name} has {int(same.sum())} anchors where the others have them and {len(moved)} elsewhere "
                f"({', '.join(moved.tolist())}), and no loop closure with them: it may lie elsewhere, or be of another place; "
                "record where both were, or map it alone",
                recording=n + 1,
                moved=moved.tolist(),
            )
