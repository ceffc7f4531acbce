"""Input and output of a live localisation: the lidar's geometry and the state."""

from dataclasses import dataclass, field

import numpy as np

from ..arrays import Floats
from ..config import documented


@documented
@dataclass(frozen=True, slots=True)
class Scanner:
    """Geometry of a lidar, with the field names of sensor_msgs/LaserScan."""

    angle_min: float
    """rad."""
    angle_increment: float
    """rad."""
    time_increment: float = 0.0
    """s between rays."""
    range_min: float = 0.02
    range_max: float = 30.0
    """m."""

    @property
    def usable(self) -> bool:
        """Whether it gives the direction of each ray; a broken header does not."""
        return bool(np.isfinite((self.angle_min, self.angle_increment, self.time_increment)).all())


@documented
@dataclass(frozen=True, slots=True, eq=False)
class LocalizerState:
    """Present estimate of the robot's pose."""

    stamp: float
    """s, of the last odometry."""
    pose: Floats
    """(3,) T_map_base, of the likeliest hypothesis; nan where there is none."""
    covariance: Floats
    """(3, 3) m, m, rad; map frame; of all hypotheses together while there are several."""
    quality: float
    """0..1: how likely this pose is against all others, times how well the last measurements agree with the map there."""
    odometry: Floats
    """(3,) T_odom_base at the same time, as the wheels have it: pose * odometry^-1 is T_map_odom."""
    lost: bool
    """The pose is not known, or not to half a metre; `pose` is the best guess."""
    reason: str = ""
    """Why it is not known, for people."""
    alternatives: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """(k, 3) other poses that are possible, the likeliest first."""
    moved_anchors: tuple[str, ...] = ()
    """Anchors whose ranges have disagreed for long with a pose on which all other measurements agree."""
    age: float = 0.0
    """s since anything was measured at all, where that is too long."""
    silent: dict[str, float] = field(default_factory=dict)
    """Sensors that send nothing while they should, and for how long, s."""
