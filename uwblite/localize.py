"""Where a robot drove within a map that is there already: its anchors give the frame, its walls the last centimetres.

The new recording is mapped on its own, with the earlier map's anchors as known places, so that it needs no start pose
and has the accuracy of a whole map within itself; then its walls are laid over the earlier ones as one piece. Both maps
widen a wall alike, so that their difference is free of it. The earlier map is not changed.
"""

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from . import map_frame, se2
from .constraints import Constraints
from .errors import DataError
from .icp import IcpConfig, align
from .map_result import MapResult, StageSummary
from .mapping import MappingConfig, Progress, build_map
from .occupancy_grid import OccupancyGrid
from .point_cloud import PointCloud, make_cloud
from .sensor_log import SensorLog

Floats = NDArray[np.float64]

LEAST_OVERLAP = 0.4
"""Share of the new walls that must lie on earlier ones; the rest may be new, or not seen before."""
REACH = 1.5
"""The anchors alone are trusted to this, m."""


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
    log : the recording, with ranges to at least two of the map's anchors.
    anchors : the earlier map's anchors, see io.constraints_file.read_anchors.
    grid : the earlier map; None = anchors only.
    config : settings; None = defaults.
    progress, executor, clock : as for build_map.

    Raises
    ------
    DataError : the recording does not hear two of the map's anchors.
    """
    heard = set(log.ranges.anchor_ids) if log.ranges is not None else set()
    shared = [a.id for a in anchors.anchors if a.id in heard]
    if len(shared) < 2:
        raise DataError(
            f"the recording hears {len(shared)} of the map's anchors ({', '.join(a.id for a in anchors.anchors)}); "
            "two or more are needed to find it in the map"
        )
    config = replace(config or MappingConfig(), align="odometry", crop=None)
    result = build_map(log, config, constraints=anchors, progress=progress, executor=executor, clock=clock)
    if grid is None or result.grid is None:
        return Localization(result, np.zeros(3), float("nan"))
    return _laid_over(result, grid)


def _laid_over(result: MapResult, grid: OccupancyGrid) -> Localization:
    """Lay the new walls over the earlier ones and move everything along."""
    assert result.grid is not None
    earlier, new = _walls(grid), _walls(result.grid)
    settings = IcpConfig(max_correspondence_distance=0.15, coarse_distance=REACH, sigma=0.05, max_iterations=100)
    # The iteration's frame is the middle of the new walls: there a turn and a shift are independent.
    middle = np.array([*new.points.mean(axis=0), 0.0]) if len(new) else np.zeros(3)
    local = make_cloud(se2.transform(se2.inverse(middle), new.points))
    found = align(earlier, local, middle, settings)
    figures = {"overlap": round(found.overlap, 4), "rmse": round(found.rmse, 4), "reason": found.reason}
    if not found.converged or found.overlap < LEAST_OVERLAP:
        doubt = (
            f"the walls do not lie on those of the map (overlap {found.overlap:.0%}, {found.reason}): "
            "the place has changed, or it is another; the position rests on the anchors alone"
        )
        stages = (*result.stages, StageSummary("walls", 0.0, figures))
        return Localization(replace(result, doubts=(*result.doubts, doubt), stages=stages), np.zeros(3), found.overlap)
    motion = se2.compose(found.T_target_source, se2.inverse(middle))
    figures["shift"] = [round(v, 4) for v in motion.tolist()]
    return Localization(_moved(result, motion, StageSummary("walls", 0.0, figures)), motion, found.overlap)


def _walls(grid: OccupancyGrid) -> PointCloud:
    return make_cloud(grid.occupied_points())


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
