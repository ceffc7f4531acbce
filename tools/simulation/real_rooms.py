"""What real rooms do to sensors beyond noise: errors that stay with a place, a wall, a direction or a floor.

Averaging never removes them: who comes to the place again meets them again. The figures and where they are from; "assumed"
is what no source that could be read gives a figure for.

Radio. The range error of a DW1000 changes with the received level from -11.0 to +8.1 cm at 64 MHz PRF (Decawave APS011,
table 2, as quoted in Qorvo's forum, topic 1872), and the same topic reports up to 80 cm over the antenna's angles, others 15 cm
(bitcraze/crazyflie-firmware, issue 680) and 20 cm (Makerfabs-ESP32-UWB, issue 4) to either side; a standard deviation of 6 cm
by direction is on the careful side of these. An antenna null loses the first path and takes a later one, always too
long. Lengths of multipath: assumed, from parts of a room to its size (over parts of a wavelength, 5 cm at 6.5 GHz, a moving
tag averages). A body: mean ranging errors of 20 cm at the best place on a body and more at others (Otim et al., Impact of
body wearable sensor positions on UWB ranging, 2019), up to metres (Otim et al., Electronics 8(11):1351, 2019); Kilic et al.
(WPNC 2012) find the direct path weakened but hardly a range error at 3 to 5.5 GHz, so the excess here, 12 cm for the robot
and 30 cm for a person, is between these. A few ranges wrong by metres: users' reports; their share is assumed.

Wheels. Bumps and floors are what Borenstein and Feng (IEEE Trans. Robotics and Automation 12(6), 1996) call non-systematic
errors, and test with bumps of a centimetre under one wheel; 0.6 degrees for each is assumed. So is the size of patches of
carpet and of cross slopes; with their turn odometry alone is about as far off as in the paper.

Lidar. For a URG-04LX, accuracy "depends strongly on colour, brightness and material", with time drift after switching on
and faulty readings of dark surfaces and at high angles on shiny ones (Kneip et al., ICRA 2009, abstract; Okubo, Ye and
Borenstein, SPIE 7332, 2009, also on mixed pixels); its data sheet allows 1 cm up to 1 m and 1 % beyond. 1.2 cm by surface
and 1 cm of warming up are of that size, assumed; glass is seen from straight ahead only.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .fields import smooth_field

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Rng = np.random.Generator


@dataclass(frozen=True)
class RealRooms:
    """Sizes of the errors; sources in the module's text."""

    range_fields: tuple[tuple[float, float], ...] = ((0.04, 0.3), (0.06, 1.5), (0.06, 6.0))
    """Standard deviation, m, and length, m, of range errors that stay with the place."""
    antenna_sd: float = 0.06
    """m, by the direction in which either antenna is hit."""
    body_excess: float = 0.12
    """m, mean, where the robot's own body stands in the way."""
    body_half_angle: float = np.deg2rad(50.0)
    """Half of the sector behind the tag that the body shadows, rad."""
    body_loss: float = 0.3
    """Share of ranges lost there."""
    person_excess: float = 0.3
    """m, mean, of a range through a person."""
    gross: float = 0.01
    """Share of ranges that are wrong by metres."""
    gross_size: float = 3.0
    """m, mean of these; one in four is too short."""
    patch_length: float = 3.0
    """Size of a patch of floor, m."""
    patch_way: float = 0.01
    """Relative error of ways on a patch."""
    patch_turn: float = 0.0049
    """Turn that a patch adds, rad/m; with this odometry alone is 1.11 m off in the hall on average over 20 recordings of
    31 min, which differ by 0.39 m (standard deviation); the paper's one was 1.37 m off."""
    wheels: float = 0.3
    """The base's own errors relative to those of easy rooms: the floor makes the rest."""
    bump_every: float = 10.0
    """Mean way between bumps, m."""
    bump_turn: float = np.deg2rad(0.6)
    """rad."""
    surface_sd: float = 0.012
    """m, constant error of one surface."""
    warm_up: tuple[float, float] = (0.01, 1200.0)
    """m at the start, and the time in which it falls to a third, s."""
    mixed: float = 0.6
    """Share of the rays at an edge that return a distance between the two surfaces."""
    grazing: float = np.deg2rad(72.0)
    """Angle of incidence at which half of the rays at 3 m are lost."""
    glass: float = 0.06
    """Share of the walls that are glass."""
    glass_cosine: float = 0.96
    """Cosine of incidence below which glass is not seen."""
    people: int = 2
    """People walking about, each on two legs."""
    stop_every: float = 60.0
    """Mean time between two stops of the operator, s."""
    stop_longest: float = 15.0
    """s."""


def range_errors(rooms: RealRooms, there: Rng, tag: Floats) -> Floats:
    """Return the errors (n,), m, that stay with the places (n, 2) of the tag."""
    return np.sum([sd * smooth_field(there, tag, length) for sd, length in rooms.range_fields], axis=0)


def own_body(rooms: RealRooms, behind: Floats, rng: Rng) -> tuple[Floats, Bools]:
    """Return the excess (n,), m, of ranges by the angle from straight behind the robot (n,), rad, and which are lost.

    The excess grows smoothly towards the middle of the shadow, and is the same whenever the angle is.
    """
    late = 1.0 + BODY_SPREAD * rng.standard_normal(len(behind))
    lost = rng.random(len(behind)) < rooms.body_loss * _body_depth(rooms, behind)
    return body_delay(rooms, behind) * np.maximum(late, 0.0), lost


BODY_SPREAD = 0.3
"""Relative standard deviation of the robot's own shadow."""


def body_delay(rooms: RealRooms, behind: Floats) -> Floats:
    """Return the mean excess (n,), m, of ranges by the angle from straight behind the robot (n,), rad."""
    return np.asarray(rooms.body_excess * 1.6 * _body_depth(rooms, behind))


def _body_depth(rooms: RealRooms, behind: Floats) -> Floats:
    return np.maximum(np.cos(np.clip(behind / rooms.body_half_angle, -1.0, 1.0) * 0.5 * np.pi), 0.0)


def person_errors(rooms: RealRooms, hidden: Bools, rng: Rng) -> Floats:
    """Return the excess (n,), m, of ranges that a person hides."""
    return np.where(hidden, rng.exponential(rooms.person_excess, len(hidden)), 0.0)


def gross_errors(rooms: RealRooms, count: int, rng: Rng) -> Floats:
    """Return errors (n,), m, of which most are 0 and a few metres long."""
    size = rng.exponential(rooms.gross_size, count) * np.where(rng.random(count) < 0.25, -1.0, 1.0)
    return np.where(rng.random(count) < rooms.gross, size, 0.0)


def floor_errors(rooms: RealRooms, places: Floats, way: Floats, there: Rng, rng: Rng) -> tuple[Floats, Floats]:
    """Return what the wheels count too much of way, m, and miss of turn, rad, in each step (n,) at places (n, 2)."""
    slip = rooms.patch_way * smooth_field(there, places, rooms.patch_length) * way
    drag = rooms.patch_turn * smooth_field(there, places, rooms.patch_length) * np.abs(way)
    bumps = rng.random(len(way)) < np.abs(way) / rooms.bump_every
    return slip, drag + np.where(bumps, rooms.bump_turn * rng.standard_normal(len(way)), 0.0)


def stops(rooms: RealRooms, seconds: float, rng: Rng) -> list[tuple[float, float, float]]:
    """Return when the operator stops, for how long, s, and by how much the robot turns on the spot then, rad."""
    found, time = [], 20.0 + float(rng.exponential(rooms.stop_every))
    while time < seconds - 20.0:
        pause = float(rng.uniform(2.0, rooms.stop_longest))
        turn = float(rng.choice([0.0, 0.0, 0.5 * np.pi, -0.5 * np.pi, 2.0 * np.pi, -2.0 * np.pi]))
        found.append((time, pause, turn))
        time += pause + abs(turn) / 0.5 + float(rng.exponential(rooms.stop_every))
    return found


def legs(walk: Floats, stride: Floats) -> Floats:
    """Return the two legs (n, 2, 3), x, y, radius, of a person at poses (n, 3) with a phase of the stride (n,), rad."""
    ahead = np.stack([np.cos(walk[:, 2]), np.sin(walk[:, 2])], axis=1)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    swing = 0.25 * np.sin(stride)[:, None] * ahead
    sides = np.stack([walk[:, :2] + 0.11 * left + swing, walk[:, :2] - 0.11 * left - swing], axis=1)
    return np.concatenate([sides, np.full((*sides.shape[:2], 1), 0.06)], axis=2)


def unseen_glass(rooms: RealRooms, glass: Bools, surface: NDArray[np.intp], cosine: Floats) -> Bools:
    """Return which rays (k, beams) go through glass; glass (w,): which walls are."""
    wall = (surface >= 0) & (surface < len(glass))
    return wall & glass[np.where(wall, surface, 0)] & (cosine < rooms.glass_cosine)
