"""Named settings."""

from .errors import DataError
from .graph.calibration import CalibrationConfig
from .graph.robust import SQUARED
from .lidar.clouds import CloudConfig
from .lidar.joint_refinement import RefinementConfig
from .lidar.point_to_point import IcpConfig
from .lidar.scan_to_scan import TrackingConfig
from .lidar.submaps import SubmapConfig
from .loop_closure.closures import LoopClosureConfig
from .mapping import MappingConfig
from .radio.range_measurements import OdometryNoiseConfig
from .radio.range_noise import RangeNoiseConfig

NAMES = ("default", "paper")


def preset(name: str) -> MappingConfig:
    """Return the settings of a preset.

    ``default``: what is best. ``paper``: the plain choices of Liu et al.: nothing calibrated, every error squared, one
    standard deviation for all ranges, sub-maps of 9 m shaped by wheels and radio alone, point-to-point ICP with outlier
    distance 0.1 m, fitness 0.1 m2 and at most 300 iterations between those that overlap, one second optimisation.
    First positions of the anchors, of which the paper does not speak, are found as always.

    Raises
    ------
    DataError : there is no such preset.
    """
    if name == "default":
        return MappingConfig()
    if name == "paper":
        return MappingConfig(
            odometry=OdometryNoiseConfig(distance=0.012, kernel=SQUARED),
            ranges=RangeNoiseConfig(sigma=0.1, slow_share=0.0, steady=0.0, learn=False, kernel=SQUARED),
            calibration=CalibrationConfig(**dict.fromkeys(CalibrationConfig.__slots__, 0.0)),
            clouds=CloudConfig(linearity=1.0),
            submaps=SubmapConfig(epsilon=9.0),
            tracking=TrackingConfig(on=False),
            loops=LoopClosureConfig(method="icp", partners=1000, rounds=1),
            icp=IcpConfig(
                method="point_to_point", max_correspondence_distance=0.1, max_iterations=300, fitness_sigma=0.1
            ),
            refinement=RefinementConfig(rounds=0),
        )
    raise DataError(f"unknown preset {name!r}; choose {' or '.join(NAMES)}")
