"""PARAM lines of a CARMEN log: mounting of the sensors, and properties of the laser that its messages do not contain."""

import math
import re

import numpy as np

from ..arrays import Floats
from ..sensor_log import SensorMounting, fault_of_id
from .carmen_words import BrokenLine, numbers

_ANCHOR_HEIGHT = "uwb_anchor_height_"
_NUMBERS = frozenset((
    "uwb_tag_offset_x", "uwb_tag_offset_y", "uwb_tag_height", "uwb_anchor_height", "robot_frontlaser_offset",
    "robot_frontlaser_side_offset", "robot_frontlaser_angular_offset", "robot_front_laser_max", "laser_front_laser_max_range",
    "laser_front_laser_resolution", "laser_time_increment", "laser_range_min",
))  # fmt: skip
LASER_IS_BASE = "laser_is_base"
"""Parameter of uwblite's own: the poses of the log are those of the laser, see SensorMounting."""
_TAG = ("tag_offset_x", "tag_offset_y", "tag_height")
_FURTHER_TAG = re.compile(r"uwb[2-9]_tag_(offset_x|offset_y|height)")
_OF_LASER = ("laser_time_increment", "laser_range_min", "laser_flipped")
"""Parameters of the first lidar; of the second it is laser2_time_increment and so on."""
_FLIPPED = ("laser_flipped", "laser_front_laser_flipped", "laser_laser1_flipped", "robot_frontlaser_flipped")
_TRUE = {b"1": True, b"on": True, b"true": True, b"yes": True, b"0": False, b"off": False, b"false": False, b"no": False}


class Params:
    """The PARAM lines seen so far; a later line wins.

    Parameters
    ----------
    laser : which of the robot's lidars is read, counted from 1.
    """

    def __init__(self, laser: int = 1) -> None:
        self._names = {} if laser == 1 else dict.fromkeys(_OF_LASER, "")
        self._names |= {name.replace("laser", f"laser{laser}", 1): name for name in _OF_LASER}
        self._numbers: dict[str, float] = {}
        self._flipped = self._laser_is_base = False

    def take(self, tokens: list[bytes]) -> None:
        """Take one line `PARAM name value ...`; names that mean nothing here are ignored."""
        if len(tokens) < 3:
            raise BrokenLine("PARAM needs a name and a value")
        name = tokens[1].decode()
        name = self._names.get(name, name)
        if name in _FLIPPED:
            if tokens[2].lower() not in _TRUE:
                raise BrokenLine(f"PARAM {name} must be on or off")
            self._flipped = _TRUE[tokens[2].lower()]
        elif name == LASER_IS_BASE:
            self._laser_is_base = _TRUE.get(tokens[2].lower(), False)
        elif name in _NUMBERS or _FURTHER_TAG.fullmatch(name) or name.startswith(_ANCHOR_HEIGHT):
            if name.startswith(_ANCHOR_HEIGHT) and (fault := fault_of_id(name.removeprefix(_ANCHOR_HEIGHT))):
                raise BrokenLine(f"PARAM {_ANCHOR_HEIGHT}*: the anchor's id {fault}")
            (self._numbers[name],) = numbers(tokens[2:3], f"PARAM {name[:40]}", 1)

    def get(self, *names: str) -> float | None:
        """Return the first of these numbers that was given."""
        return next((self._numbers[name] for name in names if name in self._numbers), None)

    def gives_tag(self, number: int) -> bool:
        """Return whether the place of a further tag, 2 to 9, was given."""
        return any(f"uwb{number}_{name}" in self._numbers for name in _TAG)

    def mounting(self, T_base_laser: Floats | None, tags: int = 1, laser_is_base: bool = False) -> SensorMounting:
        """Return the mounting; where the laser messages give no pose of the laser, CARMEN's robot_frontlaser_* count.

        Parameters
        ----------
        T_base_laser : (3,) by the laser messages, None = not given.
        tags : how many tags the robot has.
        laser_is_base : the laser messages give the laser and the robot one pose, see SensorMounting.
        """
        given = self._numbers
        if T_base_laser is None:
            offsets = ("robot_frontlaser_offset", "robot_frontlaser_side_offset", "robot_frontlaser_angular_offset")
            T_base_laser = np.array([given.get(name, 0.0) for name in offsets])
        prefixes = ("uwb_", *(f"uwb{k}_" for k in range(2, tags + 1)))
        places = np.array([[given.get(prefix + name, 0.0) for name in _TAG] for prefix in prefixes])
        heights = {name.removeprefix(_ANCHOR_HEIGHT): z for name, z in sorted(given.items()) if name.startswith(_ANCHOR_HEIGHT)}
        height, is_base = given.get("uwb_anchor_height"), laser_is_base or self._laser_is_base
        return SensorMounting(
            T_base_laser, self._flipped, places[0], height, heights, more_tags=places[1:], laser_is_base=is_base
        )

    def guess_scanner(self, beams: int) -> tuple[float, float]:
        """Return angle_min and angle_increment, rad, of an FLASER message, which gives only its number of readings.

        The usual conventions: SICK LMS with 180/181 readings of 1 degree, 360/361 of half a degree, 401 of a quarter
        (100 degrees); 0.5 and 0.25 degrees over 270 (541, 1081); 682/683 steps of 1/1024 turn (URG-04LX); otherwise
        180 degrees over all readings. PARAM laser_front_laser_resolution (degrees) wins.
        """
        resolution = self.get("laser_front_laser_resolution")
        if resolution is not None and 0.0 < abs(resolution) <= 180.0:
            increment = math.radians(resolution)
        elif beams in _USUAL_DEGREES:
            increment = math.radians(_USUAL_DEGREES[beams])
        else:
            increment = math.pi / max(beams - 1, 1)
        # 180 readings of 1 degree begin at -90 degrees as 181 do; the last one is missing.
        rays = beams + 1 if beams in (180, 360, 400, 720) else beams
        return -0.5 * increment * (rays - 1), increment


_USUAL_DEGREES = {
    **dict.fromkeys((180, 181), 1.0),
    **dict.fromkeys((360, 361, 541), 0.5),
    **dict.fromkeys((400, 401, 720, 721, 1081), 0.25),
    **dict.fromkeys((682, 683), 360.0 / 1024),
}
