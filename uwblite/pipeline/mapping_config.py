"""All settings of the stages from recordings to a map, and presets of them."""

from dataclasses import dataclass, field
from typing import Literal

from ..config import documented
from ..errors import ConfigError
from ..graph.calibration import CalibrationConfig
from ..graph.robust import SQUARED
from ..graph.solver import SolverConfig
from ..grid.occupancy_grid import GridConfig
from ..lidar.clouds import CloudConfig
from ..lidar.correlative_matching import CorrelativeConfig
from ..lidar.joint_refinement import RefinementConfig
from ..lidar.point_to_point import IcpConfig
from ..lidar.scan_to_scan import TrackingConfig
from ..lidar.submaps import SubmapConfig
from ..loop_closure.closures import LoopClosureConfig
from ..odometry.keyframes import KeyframeConfig
from ..odometry.wheels import OdometryNoiseConfig
from ..radio.range_noise import RangeNoiseConfig
from ..radio.trilateration import TrilaterationConfig


@documented
@dataclass(frozen=True, slots=True)
class MappingConfig:
    """All settings, a group per stage."""

    use_uwb: bool = True
    """Use the ranges."""
    use_lidar: bool = True
    """Use the scans."""
    use_loops: bool = True
    """Search loop closures and match clouds of different times."""
    detect_laser_flip: bool = True
    """Take the laser as mounted upside down, or upright where it is given as upside down, if its turns agree with the
    odometry's only then."""
    align: Literal["odometry", "first-pose", "walls", "anchors"] = "odometry"
    """Where the map's axes lie: where the odometry began; at the first pose; there, turned so that most walls run along x
    and y; or at the first placed anchor, x towards the last."""
    crop: tuple[float, float, float, float] | None = None
    """Keep only this part of the grid: x0, y0, x1, y1, m, map frame."""
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    odometry: OdometryNoiseConfig = field(default_factory=OdometryNoiseConfig)
    ranges: RangeNoiseConfig = field(default_factory=RangeNoiseConfig)
    trilateration: TrilaterationConfig = field(default_factory=TrilaterationConfig)
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    clouds: CloudConfig = field(default_factory=CloudConfig)
    submaps: SubmapConfig = field(default_factory=SubmapConfig)
    loop_closure: LoopClosureConfig = field(default_factory=LoopClosureConfig)
    icp: IcpConfig = field(default_factory=IcpConfig)
    scan_to_scan: TrackingConfig = field(default_factory=TrackingConfig)
    correlative: CorrelativeConfig = field(default_factory=CorrelativeConfig)
    refinement: RefinementConfig = field(default_factory=RefinementConfig)
    solver: SolverConfig = field(default_factory=SolverConfig)
    grid: GridConfig = field(default_factory=GridConfig)


PRESETS = ("default", "paper")


def preset(name: str) -> MappingConfig:
    """Return the settings of a preset.

    ``default``: what is best. ``paper``: the plain choices of Liu et al.: nothing calibrated, every error squared, one
    standard deviation for all ranges, sub-maps of 9 m shaped by wheels and radio alone, point-to-point ICP with outlier
    distance 0.1 m, fitness 0.1 m2 and at most 300 iterations between those that overlap, one second optimisation.
    First positions of the anchors, of which the paper does not speak, are found as always.

    Raises
    ------
    ConfigError : there is no such preset.
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
            scan_to_scan=TrackingConfig(on=False),
            loop_closure=LoopClosureConfig(method="icp", partners=1000, rounds=1),
            icp=IcpConfig(max_correspondence_distance=0.1, max_iterations=300, fitness_sigma=0.1),
            refinement=RefinementConfig(rounds=0),
        )
    raise ConfigError(f"unknown preset {name!r}; choose {' or '.join(PRESETS)}")
