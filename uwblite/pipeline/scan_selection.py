"""The part of a recording that is used: its sensors, and the scans that a map needs.

A map uses the scans nearest to each keyframe, and traces one whenever the laser has moved far enough. In the recording of a
slow robot that is about every fifth scan.
"""

from dataclasses import replace

import numpy as np

from .. import se2
from ..grid.occupancy_grid import GridConfig
from ..grid.tracing import moved_scans
from ..odometry import keyframes
from ..odometry.attached import choose_scans
from ..odometry.keyframes import KeyframeConfig
from ..screening.screen import screen
from ..sensor_log import SensorLog
from .mapping_config import MappingConfig

_STEPS = 2
"""Scans kept within the distance after which the grid traces the next one: odometry does not know that distance exactly."""


def prepared(log: SensorLog, config: MappingConfig) -> SensorLog:
    """Return a recording screened, with the sensors in use and only the scans that a map needs.

    From one that was screened before, only unused sensors are removed.
    """
    log = log.without(uwb=not config.use_uwb, lidar=not config.use_lidar)
    if log.screening is not None:
        return log
    return thinned(screen(log, config.detect_laser_flip), config.keyframes, config.grid)


def thinned(log: SensorLog, frames: KeyframeConfig, grid: GridConfig) -> SensorLog:
    """Return the recording with the scans that a map of it may need; the notes count the others.

    Thinning the result again with the same settings changes nothing.

    Parameters
    ----------
    frames, grid : which scans make clouds and which are traced. ``grid.move_distance = 0`` keeps all.
    """
    scans = log.scans
    if scans is None or not len(scans.stamps) or grid.move_distance <= 0.0:
        return log
    _, near = choose_scans(scans, keyframes.of(log, frames), frames)
    base = log.odometry.at(scans.stamps)
    laser = se2.compose(base, log.mounting.T_base_laser)
    traced = moved_scans(laser, grid.move_distance / _STEPS, grid.move_angle / _STEPS)
    kept = np.union1d(near, traced)
    if len(kept) == len(scans.stamps):
        return log
    left_out = log.notes.scans_left_out + len(scans.stamps) - len(kept)
    return replace(log, scans=scans.rows(kept), notes=replace(log.notes, scans_left_out=left_out))
