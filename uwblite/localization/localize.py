"""Where a robot drove within a map that is there already: its anchors give the frame, its walls the last centimetres.

The new recording is mapped on its own, with the earlier map's anchors as known places, so that it needs no start pose
and has the accuracy of a whole map within itself; then its walls are laid over the earlier ones as one piece. Both maps
widen a wall alike, so that their difference is free of it. Where fewer than two of the map's anchors are in reach, the
walls are sought in the whole map, whatever way they lie. The earlier map is not changed.
"""

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from .. import se2
from ..arrays import Floats
from ..constraints import Constraints
from ..errors import DataError
from ..grid.occupancy_grid import OccupancyGrid
from ..lidar.cloud_rasters import rasterize
from ..lidar.clouds import Clouds, joined, make_cloud, two_sided
from ..lidar.correlative_matching import CorrelativeConfig, search
from ..lidar.pair_alignment import align_pairs
from ..lidar.scan_matching import nondegenerate_step, pair_points
from ..map_result import MapResult, Notice, StageSummary
from ..mapping import MappingConfig, Progress, build_map
from ..pipeline import map_frame
from ..sensor_log import SensorLog

LEAST_OVERLAP = 0.4
"""Share of the new walls that must lie on earlier ones; the rest may be new, or not seen before."""
REACH = 1.5
"""Standard deviation of a position by anchors alone, m."""


@dataclass(frozen=True, slots=True, eq=False)
class Localization:
    """A recording within an earlier map."""

    result: MapResult
    """As of a map of its own, in the earlier map's frame."""
    correction: Floats
    """(3,) what the walls moved it by from where the anchors had it; m, m, rad."""
    overlap: float
    """Share of the new walls that lie on earlier ones; nan without walls to compare."""


def localize(
    log: SensorLog,
    anchors: Constraints,
    grid: OccupancyGrid | None,
    config: MappingConfig | None = None,
    *,
    progress: Progress | None = None,
    executor: Executor | None = None,
    clock: Callable[[], float] | None = None,
) -> Localization:
    """Find the trajectory of a recording in an earlier map.

    Parameters
    ----------
    log : the recording, with ranges to at least two of the map's anchors, or with lidar in a place that no other part of
        the map looks like.
    anchors : the earlier map's anchors, see io.constraints_file.read_anchors.
    grid : the earlier map; None = anchors only.
    config : settings; None = defaults.
    progress, executor, clock : as for build_map.

    Raises
    ------
    DataError : the recording has ranges to fewer than two of the map's anchors, and there are no walls to compare.
    """
    measured = set(log.ranges.anchor_ids) if log.ranges is not None else set()
    shared = [a.id for a in anchors.anchors if a.id in measured]
    alone = len(shared) < 2
    if alone and (grid is None or log.scans is None):
        raise DataError(
            f"the recording has ranges to {len(shared)} of the map's anchors ({', '.join(a.id for a in anchors.anchors)}); "
            "two or more are needed to find it in the map, or lidar in both"
        )
    config = replace(config or MappingConfig(), align="odometry", crop=None)
    known = Constraints() if alone else anchors
    result = build_map(log, config, constraints=known, progress=progress, executor=executor, clock=clock)
    if grid is None or result.grid is None:
        return Localization(result, np.zeros(3), float("nan"))
    if alone:
        text = f"it has ranges to {len(shared)} of the map's anchors: its place is from the walls alone"
        notice = Notice("few-common-anchors", text, {"anchors": len(shared)})
        result = replace(result, warnings=(*result.warnings, notice))
    return _laid_over(result, grid, anywhere=alone)


def _laid_over(result: MapResult, grid: OccupancyGrid, *, anywhere: bool) -> Localization:
    """Lay the new walls over the earlier ones and move everything along."""
    assert result.grid is not None
    earlier, new = grid.occupied_points(), result.grid.occupied_points()
    # The iteration's frame is the middle of the new walls: there a turn and a shift are independent.
    middle = np.array([*new.mean(axis=0), 0.0]) if len(new) else np.zeros(3)
    there, here = make_cloud(earlier), make_cloud(se2.transform(se2.inverse(middle), new))
    fits = _fits(there, here, _anywhere(there, here) if anywhere else middle[None])
    found = fits[0]
    figures = {"overlap": round(found.overlap, 4), "rmse": round(found.rmse, 4), "reason": found.reason}
    if not found.converged or found.overlap < LEAST_OVERLAP:
        doubt = Notice(
            "walls-differ",
            f"the walls do not lie on those of the map (overlap {found.overlap:.0%}, {found.reason}): the place has changed, "
            f"or it is another; the position {'is not known' if anywhere else 'rests on the anchors alone'}",
            {"overlap": round(found.overlap, 4)},
        )
        stages = (*result.stages, StageSummary("walls", 0.0, figures))
        return Localization(replace(result, doubts=(*result.doubts, doubt), stages=stages), np.zeros(3), found.overlap)
    rival = max((fit.overlap for fit in fits[1:] if _elsewhere(fit, found)), default=0.0)
    if rival > _UNIQUE * found.overlap:
        text = f"the walls fit elsewhere in the map about as well (overlap {rival:.0%} against {found.overlap:.0%})"
        doubt = Notice("ambiguous-place", text, {"overlap": round(found.overlap, 4), "rival": round(rival, 4)})
        result = replace(result, doubts=(*result.doubts, doubt))
    motion = se2.compose(found.pose, se2.inverse(middle))
    figures["shift"] = [round(v, 4) for v in motion.tolist()]
    return Localization(_moved(result, motion, StageSummary("walls", 0.0, figures)), motion, found.overlap)


_GATE = 0.15
"""m; walls farther apart do not lie on one another."""
_CONVERGED = 0.005
"""m and rad; the last step of an alignment that has converged, a tenth of a cell."""
_LEAST_MATCHES = 10
_ITERATIONS = 40
_RASTER = 0.1
"""m; cell of the table of nearest wall points."""
_UNIQUE = 0.85
"""A second place whose overlap is this share of the first's makes the first doubtful."""
_EVERYWHERE = CorrelativeConfig(resolution=0.25, angle_step=0.05, spread=0.25, candidates=8, separation=1.0)
"""Coarse: the alignment that follows reaches farther than a step."""


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """Where the new walls came to lie."""

    pose: Floats
    """(3,) of the new walls, about their middle, in the earlier map."""
    overlap: float
    """Share of the new walls that lie on earlier ones, 0..1."""
    rmse: float
    """m, of the distances across the matched walls."""
    converged: bool
    reason: str


def _fits(earlier: Clouds, new: Clouds, guesses: Floats) -> list[_Fit]:
    """Align the new walls with the earlier ones from several guesses (g, 3); the best fit comes first.

    A grid does not contain from which side a wall was seen: the new walls enter with either normal, of which one matches.
    """
    sides, target = two_sided(new), np.zeros(len(guesses), dtype=np.int64)
    clouds, raster = joined([earlier, sides], np.float64), rasterize(earlier, _RASTER, REACH)
    points = pair_points(clouds, target + 1, len(sides.points))
    found = align_pairs(clouds, raster, target, target + 1, guesses, points, REACH, _GATE, _ITERATIONS)
    steps = np.abs(nondegenerate_step(found.factors)[0]).max(axis=1)
    figures = (found.pose, 2.0 * found.share, found.rms, found.factors.matched, steps)
    fits = [_fit(*values) for values in zip(*figures, strict=True)]
    return sorted(fits, key=lambda fit: (-fit.converged, -fit.overlap))


def _fit(pose: Floats, overlap: float, rmse: float, matches: int, step: float) -> _Fit:
    reason = "step below tolerance"
    if matches < _LEAST_MATCHES:
        reason = f"no overlap: {matches} wall points have a partner"
    elif step > _CONVERGED:
        reason = f"stopped after {_ITERATIONS} iterations, still moving"
    return _Fit(pose, float(overlap), float(rmse), reason == "step below tolerance", reason)


def _anywhere(earlier: Clouds, local: Clouds) -> Floats:
    """Return poses (c, 3) of the new walls, about their middle, at which they may lie in the earlier map."""
    if not len(earlier.points) or not len(local.points):
        return np.zeros((1, 3))
    low, high = earlier.points.min(axis=0), earlier.points.max(axis=0)
    width, depth = ((high - low) / 2.0).tolist()
    middle, window = np.array([*(low + high) / 2.0, 0.0]), (width, depth, np.pi)
    poses = search(earlier, local, middle, window, _EVERYWHERE, oriented=False).poses
    return poses if len(poses) else np.zeros((1, 3))


def _elsewhere(one: _Fit, other: _Fit) -> bool:
    x, y, theta = se2.between(one.pose, other.pose).tolist()
    return bool(one.converged and (np.hypot(x, y) > 0.5 or abs(theta) > 0.1))


def _moved(result: MapResult, motion: Floats, stage: StageSummary) -> MapResult:
    """Return the result in a frame moved by T_new_old; its grid, drawn in the old one, is left out."""
    turn = np.eye(3)
    turn[:2, :2] = se2.rotate(motion[2], np.eye(2)).T
    covariances = turn @ result.keyframe_covariances @ turn.T
    anchors = tuple(
        replace(
            a,
            position=se2.transform(motion, a.position),
            covariance=turn[:2, :2] @ a.covariance @ turn[:2, :2].T,
            alternative=None if a.alternative is None else se2.transform(motion, a.alternative),
        )
        for a in result.anchors
    )
    return replace(
        result,
        trajectory=se2.compose(motion, result.trajectory),
        keyframe_covariances=covariances,
        graph=map_frame.moved(result.graph, motion),
        anchors=anchors,
        grid=None,
        stages=(*result.stages, stage),
    )
