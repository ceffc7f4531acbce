"""Directions: the sign of the heading, whether the laser is upside down, and the direction in which it points."""

from dataclasses import replace

import numpy as np

from .. import se2
from ..arrays import Bools, Floats
from ..findings import Fact
from ..sensor_log import SensorLog
from .units import CLEARLY, heading_reading
from .wheel_motion import PairPolicy, Pairs, compare

_LEAST_TURNED, _ALIKE, _CONCENTRATED = 0.3, 0.5, 0.7
"""Angle by which a laser points elsewhere than given, and turn up to which a pair of scans shows the direction of driving;
difference up to which directions of motion agree, all rad; and share of pairs that must agree. Along bare walls a match stays
at the wheels' guess, whichever way the laser looks."""


def heading_with_the_path(log: SensorLog) -> tuple[SensorLog, list[Fact]]:
    """Return the recording with the heading's sign that agrees with the path; a lidar decides which is right."""
    reading = heading_reading(log.odometry)
    if reading.sound or reading.mirrored < reading.plain + CLEARLY:
        return log, []
    mirrors = {"the sign of its heading": np.array([1.0, 1.0, -1.0]), "the sign of its y": np.array([1.0, -1.0, 1.0])}
    tried = {
        what: replace(log, odometry=replace(log.odometry, poses=log.odometry.poses * signs)) for what, signs in mirrors.items()
    }
    fits = {what: _turns_alike(compare(other)) for what, other in tried.items()}
    best = max(fits, key=lambda what: fits[what])
    return tried[best], [Fact.of("heading-against-path", inverted=best, settled=fits[best] > 0)]


def _turns_alike(pairs: Pairs | None) -> int:
    """Return 1 where lidar and wheels turn the same way, -1 where they turn opposite ways, 0 where nothing shows it."""
    if pairs is None:
        return 0
    by_wheels, by_lidar = pairs.wheels[:, 2], pairs.lidar[:, 2]
    clear = pairs.measured & (np.minimum(np.abs(by_wheels), np.abs(by_lidar)) > PairPolicy.moving)
    if clear.sum() < PairPolicy.enough:
        return 0
    alike = float(np.mean((by_wheels * by_lidar > 0.0)[clear]))
    return int(alike > _CONCENTRATED) - int(1.0 - alike > _CONCENTRATED)


def laser_upright(log: SensorLog, pairs: Pairs) -> tuple[SensorLog, list[Fact]]:
    """Return the recording with the laser mounted upright or upside down, as its turns show.

    A laser upside down, beams in the wrong order and swapped wheels have the same effect: scans and wheels turn in opposite
    directions. This repairs the first two; the third would give a mirror image, and nothing distinguishes them.
    """
    if _turns_alike(pairs) >= 0:
        return log, []
    flipped = not log.mounting.laser_flipped
    log = replace(log, mounting=replace(log.mounting, laser_flipped=flipped))
    return log, [Fact.of("laser-turned-over", flipped=flipped)]


def laser_ahead(log: SensorLog, pairs: Pairs) -> tuple[SensorLog, list[Fact]]:
    """Return the recording with the direction of the laser that the driving shows, where that is far from the given one."""
    way = [np.hypot(m[:, 0], m[:, 1]) for m in (pairs.lidar, pairs.wheels)]
    clear = pairs.measured & (np.minimum(*way) > PairPolicy.clear) & (np.abs(pairs.lidar[:, 2]) < _LEAST_TURNED)
    if clear.sum() < PairPolicy.enough:
        return log, []
    by_wheels, by_lidar = (se2.as_complex(m[clear]) for m in (pairs.wheels, pairs.lidar))
    turns = by_wheels * by_lidar.conj() / np.abs(by_wheels * by_lidar)
    middle = float(np.angle(turns.mean()))
    off = np.angle(turns * se2.unit_complex(-middle))
    alike = np.abs(off) < _ALIKE
    angle = middle + float(np.median(off[alike])) if alike.any() else 0.0
    if abs(angle) < _LEAST_TURNED or np.mean(alike) < _CONCENTRATED:
        return log, []
    given = log.mounting.T_base_laser
    turned = np.array([given[0], given[1], float(se2.wrap_angle(given[2] + angle))])
    around = se2.compose(np.array([0.0, 0.0, angle]), given)
    mount, tags = turned, log.mounting.tags
    if _lever_error(pairs, clear, given, around) < _lever_error(pairs, clear, given, turned):
        mount, tags = around, np.column_stack([se2.rotate(np.full(len(tags), angle), tags[:, :2]), tags[:, 2]])
    mounting = replace(log.mounting, T_base_laser=mount, laser_is_base=False, tag_position=tags[0], more_tags=tags[1:])
    fact = Fact.of("laser-turned-away", degrees=float(np.degrees(angle)), pose=mount.tolist())
    return replace(log, mounting=mounting), [fact]


def _lever_error(pairs: Pairs, clear: Bools, given: Floats, mount: Floats) -> float:
    """Return by how much motions of lidar and wheels differ with the laser mounted so, m, mean over clear pairs.

    A laser mounted another way round stands where it was given; where the wheels drive another way instead, it stands elsewhere
    on their base, and its tag as well. Turns swing the laser about the base: that distinguishes the two.
    """
    laser = se2.compose(se2.compose(se2.inverse(given), pairs.lidar[clear]), given)
    base = se2.compose(se2.compose(mount, laser), se2.inverse(mount))
    return float(np.mean(np.hypot(*(base - pairs.wheels[clear])[:, :2].T)))
