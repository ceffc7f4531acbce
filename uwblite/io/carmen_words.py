"""The words of CARMEN messages: numbers, stamps, PARAM lines, what stands around the readings of a laser, broken lines."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Floats
from ..errors import ConfigError
from ..sensor_log import MOST_METRES, MOST_SECONDS, SensorMounting, fault_of_id


class BrokenLine(ValueError):
    """One line cannot be used; the text says why. It never leaves the reader."""


def numbers(tokens: list[bytes], what: str, count: int) -> list[float]:
    """Return exactly `count` finite numbers."""
    if len(tokens) != count:
        raise BrokenLine(f"{what} has too few fields")
    values = [float(token) for token in tokens]
    if not math.isfinite(sum(values)):
        raise BrokenLine(f"{what} holds a number that is not finite")
    if max(map(abs, values)) > MOST_METRES:
        raise BrokenLine(f"{what} holds a number beyond anything that a robot measures")
    return values


def stamp_of(token: bytes) -> float:
    """Return a stamp, s, that is a time."""
    stamp = float(token)
    if not math.isfinite(stamp):
        raise BrokenLine("the stamp is not finite")
    if abs(stamp) > MOST_SECONDS:
        raise BrokenLine("the stamp is no time")
    return stamp


def columns_of(lines: list[bytes], words: int) -> list[tuple[bytes, ...]] | None:
    """Return the words of lines by their place in the line; None where a line has another number of words."""
    rows = [line.split() for line in lines]
    return list(zip(*rows, strict=True)) if {len(row) for row in rows} == {words} else None


def sound_columns(stamps: Sequence[bytes], others: Sequence[Sequence[bytes]]) -> Floats | None:
    """Return the numbers (n, 1 + c) of words in columns, stamps first; None where one is no number or beyond any."""
    try:
        values = np.array([list(map(float, column)) for column in (stamps, *others)])
    except ValueError:
        return None
    sound = np.abs(values[0]).max() <= MOST_SECONDS and np.abs(values[1:]).max(initial=0.0) <= MOST_METRES
    return np.ascontiguousarray(values.T) if sound else None


def is_message_name(name: bytes) -> bool:
    """Return whether a word could be the name of a message of some CARMEN module: capitals, digits, _ and -."""
    plain = name.replace(b"_", b"").replace(b"-", b"")
    return 2 <= len(name) <= 40 and plain.isalnum() and plain.isupper() and plain[:1].isalpha()


def why_broken(error: ValueError) -> str:
    """Return one short printable line about a broken line."""
    text = str(error).replace("could not convert string to float", "not a number")
    text = "".join(c if c.isprintable() else "?" for c in text)
    return text if len(text) <= 100 else text[:97] + "..."


MAX_BEAMS = 100_000
"""A message that claims more readings is broken."""
RANK = {b"RAWLASER1": 0, b"FLASER": 1, b"ROBOTLASER1": 2}
"""Messages that may carry the same scans; only those of the highest rank in the log are used."""
HEAD = {b"RAWLASER1": 9, b"FLASER": 2, b"ROBOTLASER1": 9}
"""Words before the readings."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Geometry that a message gives; messages with equal layout go into one array."""

    beams: int
    angle_min: float = 0.0
    angle_increment: float = 0.0
    range_max: float = 0.0
    """m; 0 where the message does not give it."""


def kinds_of(message: str) -> dict[bytes, bytes]:
    """Return the messages that hold the scans of one lidar, each with the kind that it is read as.

    Parameters
    ----------
    message : name of the only message to read, such as ROBOTLASER2 of the second lidar; empty = the first lidar's.
    """
    if not message:
        return {name: name for name in RANK}
    kind = "FLASER" if message == "RLASER" else re.sub("(?<=LASER)[1-5]$", "1", message)
    if kind.encode() not in RANK:
        raise ConfigError(f"scans are not read from {message!r}; choose ROBOTLASER1 to 5, RAWLASER1 to 5, FLASER or RLASER")
    return {message.encode(): kind.encode()}


def parse_head(name: bytes, tokens: list[bytes]) -> Layout:
    """Read the words before the readings."""
    what = name.decode()
    beams = int(tokens[-1])
    if not 1 <= beams <= MAX_BEAMS:
        raise BrokenLine(f"{what} announces {beams} readings")
    if name == b"FLASER":
        return Layout(beams)
    angle_min, fov, increment = numbers(tokens[2:5], what, 3)
    stated = float(tokens[5])
    range_max = stated if 0.0 < stated <= MOST_METRES else 0.0  # an infinite one is none
    if increment == 0.0:
        increment = fov / max(beams - 1, 1)
    if abs(increment) * (beams - 1) > 2.1 * math.pi or abs(angle_min) > 2.1 * math.pi:
        raise BrokenLine(f"{what}: {beams} readings {increment:g} rad apart are more than a turn")
    return Layout(beams, angle_min, increment, range_max)


def places_behind(name: bytes, tail: Sequence[bytes], ipc_left_out: bool) -> tuple[int, int]:
    """Return which of the words behind the readings the poses of laser and robot begin at (RAWLASER1 has none), and which is
    the stamp."""
    if name == b"FLASER":
        if len(tail) not in (8, 9):
            raise BrokenLine(f"FLASER has {len(tail)} fields behind its readings, expected 9")
        return 0, 6 if len(tail) == 9 else 7
    rest = len(tail) - 1 - int(tail[0]) if tail and len(tail[0]) < 10 and tail[0].isdigit() else len(tail)
    if name == b"RAWLASER1":
        rest = rest if rest in (2, 3) else len(tail)
        if rest not in (2, 3):
            raise BrokenLine(f"RAWLASER1 has {len(tail)} fields behind its readings, expected 4 + remissions")
        return len(tail) - rest, len(tail) - (3 if rest == 3 else 1)
    rest = rest if 12 <= rest <= 14 else len(tail)
    if not 12 <= rest <= 14:
        raise BrokenLine(f"ROBOTLASER1 has {len(tail)} fields behind its readings, expected 15 + remissions")
    # 14 = with turn_axis and ipc_timestamp, 12 = with neither; 13 is one of them.
    has_ipc = rest == 14 or (rest == 13 and not ipc_left_out)
    return len(tail) - rest, len(tail) - (3 if has_ipc else 1)


_ANCHOR_HEIGHT = "uwb_anchor_height_"
_NUMBER = re.compile(
    r"uwb[2-9]?_tag_(offset_x|offset_y|height)|uwb_anchor_height(_.*)?|robot_frontlaser_(side_|angular_)?offset"
    r"|robot_front_laser_max|laser_front_laser_(max_range|resolution)|laser_(time_increment|range_min)"
)
"""Names of parameters that are numbers."""
LASER_IS_BASE = "laser_is_base"
"""Parameter of uwblite's own: the poses of the log are those of the laser, see SensorMounting."""
_TAG = ("tag_offset_x", "tag_offset_y", "tag_height")
_OF_LASER = ("laser_time_increment", "laser_range_min", "laser_flipped")
"""Parameters of the first lidar; of the second it is laser2_time_increment and so on."""
_FLIPPED = ("laser_flipped", "laser_front_laser_flipped", "laser_laser1_flipped", "robot_frontlaser_flipped")
_TRUE = {b"1": True, b"on": True, b"true": True, b"yes": True, b"0": False, b"off": False, b"false": False, b"no": False}


class Params:
    """The PARAM lines seen so far, for one of the robot's lidars, counted from 1; a later line wins."""

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
        elif _NUMBER.fullmatch(name):
            if name.startswith(_ANCHOR_HEIGHT) and (fault := fault_of_id(name.removeprefix(_ANCHOR_HEIGHT))):
                raise BrokenLine(f"PARAM {_ANCHOR_HEIGHT}*: the anchor's id {fault}")
            (self._numbers[name],) = numbers(tokens[2:3], f"PARAM {name[:40]}", 1)

    def get(self, *names: str) -> float | None:
        """Return the first of these numbers that was given."""
        return next((self._numbers[name] for name in names if name in self._numbers), None)

    def gives_tag(self, number: int) -> bool:
        """Return whether the place of a further tag, 2 to 9, was given."""
        return any(f"uwb{number}_{name}" in self._numbers for name in _TAG)

    def mounting(self, T_base_laser: Floats | None, tags: int, laser_is_base: bool = False) -> SensorMounting:
        """Return the mounting; where the laser messages give no pose of the laser, CARMEN's robot_frontlaser_* count.

        Parameters
        ----------
        T_base_laser : (3,) by the laser messages, None = not given.
        tags : how many tags the robot has.
        laser_is_base : the laser messages give the laser and the robot one pose, see SensorMounting.
        """
        values = self._numbers
        if T_base_laser is None:
            offsets = ("robot_frontlaser_offset", "robot_frontlaser_side_offset", "robot_frontlaser_angular_offset")
            T_base_laser = np.array([values.get(name, 0.0) for name in offsets])
        prefixes = ("uwb_", *(f"uwb{k}_" for k in range(2, tags + 1)))
        places = np.array([[values.get(prefix + name, 0.0) for name in _TAG] for prefix in prefixes])
        heights = {
            name.removeprefix(_ANCHOR_HEIGHT): z for name, z in sorted(values.items()) if name.startswith(_ANCHOR_HEIGHT)
        }
        height, is_base = values.get("uwb_anchor_height"), laser_is_base or self._laser_is_base
        return SensorMounting(
            T_base_laser, self._flipped, places[0], height, heights, more_tags=places[1:], laser_is_base=is_base
        )

    def guess_scanner(self, beams: int) -> tuple[float, float]:
        """Return angle_min and angle_increment, rad, of an FLASER message, which gives only its number of readings.

        PARAM laser_front_laser_resolution (degrees) wins; a number that no usual scanner has spans 180 degrees.
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
"""Angle between the readings of SICK LMS and URG-04LX scanners, by their number."""
