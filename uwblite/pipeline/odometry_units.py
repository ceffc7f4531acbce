"""Test of the odometry's unit: ranges, which are times of flight, may show another one; lidar and heights count, too."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..arrays import Floats
from ..sensor_log import SensorLog
from .estimate import Estimate, Task
from .mapping_config import MappingConfig
from .recordings import Recording


def with_units_checked(config: MappingConfig, logs: Sequence[SensorLog]) -> MappingConfig:
    """Return the settings without the hypothesis that a unit of the wheels is wrong, where a lidar has measured their ways.

    Ranges through walls to an anchor or two may fit wheels several times too short better than a path that is right. Lidar and
    wheels that agree would both have to be wrong, by one factor. With recordings of which some show nothing, it stays.
    """
    ways = np.array([float("nan") if log.screening is None else log.screening.lidar_by_wheels for log in logs])
    if not np.all(np.abs(ways - 1.0) <= _OTHER_UNIT):
        return config
    priors = config.calibration
    return replace(config, calibration=replace(priors, odometry_unit=min(priors.odometry_unit, priors.odometry_scale)))


def with_given_mounting_and_clock(config: MappingConfig, logs: Sequence[SensorLog]) -> MappingConfig:
    """Return the settings without the calibration values that the recordings fix.

    Against stamps of receipt in bursts no clock has an offset, nor where a format has one clock for all. Where the poses of a
    log are those of the laser, the laser has its place, and the point about which the robot turns is unknown instead.
    """
    priors = config.calibration
    late = {sensor for log in logs if log.screening is not None for sensor in log.screening.in_bursts}
    if late or all(log.notes.one_clock for log in logs):
        priors = replace(priors, laser_delay=0.0, range_delay=0.0 if "odometry" in late else priors.range_delay)
    mounted = [log.mounting for log in logs if log.scans is not None]
    if mounted and all(mounting.laser_is_base for mounting in mounted):
        priors = replace(priors, laser_offset=0.0)
    return replace(config, calibration=priors)


def odometry_unit_factors(estimate: Estimate, task: Task) -> Floats:
    """Return the factor (r,) by which the odometry of each recording is to be multiplied to be in metres.

    It is 1 where the unit is right up to what a calibration of the wheels' radius may take up.
    """
    calibration, recordings = estimate.graph.calibration, task.recordings
    places = [calibration.index("odometry_scale", recording=n) for n in range(len(recordings))]
    factors = np.array([1.0 if place < 0 else 1.0 + float(calibration.values[place]) for place in places])
    factors = np.where(np.abs(factors - 1.0) > _OTHER_UNIT, factors, 1.0)
    other = estimate.other_heights
    for recording, factor in zip(recordings.each, factors.tolist(), strict=True):
        if factor != 1.0:
            high = other is not None and not other.taken and not _lidar_agrees(recording, factor)
            task.stages.note(
                "odometry-unit",
                recording=recording.number + 1,
                name=recording.name if len(recordings) > 1 else "",
                factor=factor,
                checked=recording.has_scans or len(task.given.anchors) > 1 or bool(task.given.distances),
                high=other.high if other is not None and high else None,
            )
    return factors


def _lidar_agrees(recording: Recording, factor: float) -> bool:
    """Return whether lidar distances that are a factor longer than the odometry's are likelier than equal ones."""
    screening = recording.log.screening
    ratio = float("nan") if screening is None else screening.lidar_by_wheels
    return abs(ratio - factor) < abs(ratio - 1.0)


_OTHER_UNIT = 0.12
"""Relative error of travelled distance from which on it is not a wheel radius to be calibrated but another unit."""
