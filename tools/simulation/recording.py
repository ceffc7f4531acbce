"""One drive through one building: every sensor's part."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import drive, laser, radio, real_rooms, wheels
from .fields import smooth_field
from .floorplans import FloorPlan
from .laser import LaserModel
from .plans import PLANS
from .radio import RadioModel
from .real_rooms import RealRooms

Floats = NDArray[np.float64]

_CHUNK = 8
"""Scans cast together; they share the walls that are near."""


@dataclass(frozen=True)
class FalseRanges:
    """A stretch in which one anchor is wrong by the same amount."""

    anchor: int
    """Number of the anchor, from 1."""
    start: float
    seconds: float
    metres: float


@dataclass(frozen=True)
class Settings:
    """What is simulated; seconds, metres, radians."""

    world: str = "hall"
    seed: int = 0
    minutes: float | None = None
    """None: as long as the plan says."""
    speed: float = 0.2
    odometry_rate: float = 20.0
    odometry_scale: float = 1.0
    """All odometry errors times this."""
    slips: int = 0
    spin: float = 0.0
    """m/s that the wheels count beyond the robot's motion where they slip for seconds; 0 = they slip for a moment."""
    scan_rate: float = 10.0
    """At most 10 Hz; less keeps every n-th sweep of the scanner."""
    uwb_rate: float = 0.5
    """Ranging epochs per second, each with up to four anchors."""
    anchors: int | None = None
    """How many, at random places; None: as in the plan."""
    radio: RadioModel = field(default_factory=RadioModel)
    laser: LaserModel = field(default_factory=LaserModel)
    nlos: str = "normal"
    nlos_anchors: tuple[int, ...] = ()
    """Anchors (from 1) to which nlos applies, the others being normal; empty: all."""
    outliers: float = 0.0
    """Share of ranges that are nonsense of either sign."""
    zeros: float = 0.0
    """Share of ranges that are 0."""
    false_ranges: tuple[FalseRanges, ...] = ()
    anchor_height: float = 0.6
    tag_height: float = 0.6
    write_heights: bool = False
    tag: tuple[float, float] = (-0.05, 0.0)
    laser_pose: tuple[float, float, float] = (0.10, 0.0, 0.0)
    """Mounting of the laser as the log states it."""
    laser_error: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """True mounting minus stated mounting."""
    laser_flipped: bool = False
    uwb_delay: float = 0.0
    """Stamp of a range minus its true time on the odometry's clock."""
    laser_delay: float = 0.0
    rooms: RealRooms | None = None
    """Errors that stay with places, walls and floors, people and an operator who stops; None: easy rooms without them."""
    people: int = 0
    without: tuple[str, ...] = ()
    """Sensors that are missing: uwb, laser."""
    robot: int | None = None
    """Which robot, so that several recordings are of the same one; None: one of the seed's own."""
    building: int | None = None
    """Which building of this plan: range offsets of walls, multipath, biases of anchors; None: one of the seed's own."""


@dataclass(frozen=True)
class Recording:
    """What the robot recorded, and the truth."""

    settings: Settings
    plan: FloorPlan
    anchors: Floats
    """(a, 2) true places."""
    stamps: Floats
    """(n,) of the odometry."""
    odometry: Floats
    """(n, 3)."""
    truth: Floats
    """(n, 3) true poses of the base at the stamps; theta unwrapped."""
    scan_stamps: Floats
    """(k,) first ray, on the laser's clock."""
    scan_poses: Floats
    """(k, 3) odometry pose written into the scan."""
    scans: NDArray[np.int32]
    """(k, beams) mm."""
    surfaces: NDArray[np.int16]
    """(k, beams) wall, or number of walls plus column, that each ray measured; -1 = none, a passer-by, or a mixed pixel."""
    range_stamps: Floats
    """(m,) on the radio's clock."""
    range_anchors: NDArray[np.intp]
    """(m,) index into anchors."""
    ranges: Floats
    """(m,) m, as reported."""
    calibration: dict[str, Any]
    """True values of everything an estimator might want to know."""


def _rng(settings: Settings, part: int) -> np.random.Generator:
    # A generator per part: switching one option leaves the other sensors' random numbers as they were.
    return np.random.default_rng([settings.seed, part])


def _lasting(owner: int | None, part: int, rng: np.random.Generator) -> np.random.Generator:
    """Return the generator of what a robot or a building keeps from recording to recording, a recording's own without one."""
    return rng if owner is None else np.random.default_rng([owner, 1000 + part])


def simulate(settings: Settings) -> Recording:
    """Simulate a recording."""
    plan = PLANS[settings.world]()
    seconds = 60.0 * (settings.minutes or plan.minutes)
    track = drive.wander(plan, _rng(settings, 0), settings.speed * seconds + 5.0)
    halts = [] if settings.rooms is None else real_rooms.stops(settings.rooms, seconds, _rng(settings, 10))
    motion = drive.follow(track, plan.start[2], settings.speed, seconds, stops=halts)
    anchors = _place_anchors(settings, plan)
    stamps = np.round(np.arange(int(seconds * settings.odometry_rate) + 1) / settings.odometry_rate, 6)
    size = settings.odometry_scale * (1.0 if settings.rooms is None else settings.rooms.wheels)
    faults = wheels.draw_errors(_lasting(settings.robot, 1, _rng(settings, 1)), size)
    slips = wheels.draw_slips(motion, _rng(settings, 2), settings.slips, settings.spin)
    stated = wheels.odometry(motion, stamps, faults, slips, _rng(settings, 3), _floor(settings, motion, stamps))
    crowd = people(settings, plan, seconds)
    scan_stamps, scans, surfaces = _scan(settings, plan, motion, crowd)
    stated_at = scan_stamps + settings.laser_delay
    range_stamps, range_anchors, ranges, truth_uwb = _range(settings, plan, motion, anchors, crowd)
    scan_poses = np.stack([np.interp(stated_at, stamps, stated[:, k]) for k in range(3)], axis=1)
    mounting = np.asarray(settings.laser_pose) + np.asarray(settings.laser_error)
    calibration = {
        "settings": asdict(settings),
        "odometry": asdict(faults),
        "slips": slips,
        "uwb": truth_uwb,
        "laser": {"x": mounting[0], "y": mounting[1], "theta": mounting[2], "flipped": settings.laser_flipped},
        "tag": [*settings.tag, settings.tag_height],
        "clock": {"uwb_delay": settings.uwb_delay, "laser_delay": settings.laser_delay},
    }
    return Recording(
        settings,
        plan,
        anchors,
        stamps,
        stated,
        motion.at(stamps),
        stated_at,
        scan_poses,
        scans,
        surfaces,
        range_stamps,
        range_anchors,
        ranges,
        calibration,
    )


def _floor(settings: Settings, motion: drive.Motion, stamps: Floats) -> tuple[Floats, Floats] | None:
    """Return what the floor adds to way, m, and turn, rad, of each step of the odometry."""
    if settings.rooms is None:
        return None
    places, way = motion.at(stamps)[:, :2], np.hypot(*np.diff(motion.at(stamps)[:, :2], axis=0).T)
    there = _lasting(settings.building, 11, _rng(settings, 11))
    return real_rooms.floor_errors(settings.rooms, places[:-1], way, there, _rng(settings, 12))


def _place_anchors(settings: Settings, plan: FloorPlan) -> Floats:
    if settings.anchors is None:
        return plan.anchors
    rng = _rng(settings, 4)
    cells = drive.RoadMap(plan, 0.4).cells * 0.2
    places = [cells[rng.integers(len(cells))]]
    while len(places) < settings.anchors:
        # The farthest of a few keeps random anchors apart without making them regular.
        tries = cells[rng.integers(len(cells), size=4)]
        gaps = np.hypot(*(tries[:, None] - np.array(places)[None]).transpose(2, 0, 1)).min(axis=1)
        places.append(tries[np.argmax(gaps)])
    return np.array(places) + rng.uniform(-0.1, 0.1, (len(places), 2))


def people(settings: Settings, plan: FloorPlan, seconds: float) -> list[drive.Motion]:
    """Return the walks of the people: 1 m/s between goals of their own."""
    walks = []
    for k in range(settings.people + (0 if settings.rooms is None else settings.rooms.people)):
        rng = _rng(settings, 100 + k)
        cells = drive.RoadMap(plan, 0.4).cells * 0.2
        begin = cells[rng.integers(len(cells))]
        track = drive.wander(plan, rng, float(rng.uniform(0.7, 1.2)) * seconds, 0.4, begin)
        at = np.linspace(0.0, seconds, len(track))
        walks.append(drive.Motion(at, np.column_stack([track, np.zeros(len(track))])))
    return walks


def _bodies(crowd: list[drive.Motion], times: Floats, robot: Floats, legs: bool = False) -> Floats:
    """Return the circles (n, p, 3) that people are at the times (n,), or (n, 2 p, 3) their legs; none touches the robot."""
    if not crowd:
        return np.empty((len(times), 0, 3))
    xy = np.stack([walk.at(times)[:, :2] for walk in crowd], axis=1)
    away = np.hypot(*(xy - robot[:, None, :2]).transpose(2, 0, 1)) >= 0.6
    if legs:
        walks = [np.column_stack([walk.at(times)[:, :2], _course(walk, times)]) for walk in crowd]
        pairs = [real_rooms.legs(walk, 2.0 * np.pi * times / 1.1) for walk in walks]
        return np.concatenate(
            [p * np.where(a[:, None, None], 1.0, [1.0, 1.0, 0.0]) for p, a in zip(pairs, away.T, strict=True)], axis=1
        )
    radius = np.where(away, 0.18, 0.0)
    return np.concatenate([xy, radius[..., None]], axis=2)


def hidden_ranges(recording: Recording) -> NDArray[np.bool_]:
    """Return which ranges (m,) lead through a person."""
    settings, times = recording.settings, recording.range_stamps - recording.settings.uwb_delay
    crowd = people(settings, recording.plan, 60.0 * (settings.minutes or recording.plan.minutes))
    pose = np.stack([np.interp(times, recording.stamps, recording.truth[:, k]) for k in range(3)], axis=1)
    bodies, hidden = _bodies(crowd, times, pose), np.zeros(len(times), dtype=bool)
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    tag = pose[:, :2] + np.stack([c * settings.tag[0] - s * settings.tag[1], s * settings.tag[0] + c * settings.tag[1]], axis=1)
    for anchor, place in enumerate(recording.anchors):
        own = recording.range_anchors == anchor
        hidden[own] = radio.crossings(tag[own], place, np.empty((0, 4)), bodies[own]) > 0
    return hidden


def _course(walk: drive.Motion, times: Floats) -> Floats:
    """Return the direction (n,) in which a person walks, rad."""
    ahead = walk.at(times + 0.5)[:, :2] - walk.at(times - 0.5)[:, :2]
    return np.arctan2(ahead[:, 1], ahead[:, 0])


def _scan(
    settings: Settings, plan: FloorPlan, motion: drive.Motion, crowd: list[drive.Motion]
) -> tuple[Floats, NDArray[np.int32], NDArray[np.int16]]:
    """Return stamps (k,) on the odometry's clock, ranges (k, beams), mm, and the surfaces (k, beams) they are of."""
    model = settings.laser
    if "laser" in settings.without:
        return np.empty(0), np.empty((0, model.beams), dtype=np.int32), np.empty((0, model.beams), dtype=np.int16)
    rng, every = _rng(settings, 5), max(1, round(10.0 / settings.scan_rate))
    stamps = np.round(np.arange(0.037, motion.stamps[-1] - 0.1, 0.1 * every), 6)
    scene = scene_of(settings, plan, crowd, rng)
    out = np.empty((len(stamps), model.beams), dtype=np.int32)
    surfaces = np.empty(out.shape, dtype=np.int16)
    for first in range(0, len(stamps), _CHUNK):
        chunk = slice(first, first + _CHUNK)
        times = (stamps[chunk, None] + model.time_increment * np.arange(model.beams)).ravel()
        out[chunk], surfaces[chunk] = swept(scene, stamps[chunk], times, motion.at(times), rng)
    return stamps, out, surfaces


@dataclass(frozen=True)
class Scene:
    """What a laser meets."""

    settings: Settings
    plan: FloorPlan
    crowd: list[drive.Motion]
    model: LaserModel
    colour: Floats
    """(s,) m, constant error of each surface: walls, columns, people."""
    glass: NDArray[np.bool_]
    """(w,) which walls are of glass."""
    dark: NDArray[np.bool_]
    """(s,) which surfaces are painted dark."""


def scene_of(settings: Settings, plan: FloorPlan, crowd: list[drive.Motion], rng: np.random.Generator) -> Scene:
    """Draw what stays with the surfaces of a building."""
    model, rooms = settings.laser, settings.rooms
    if rooms is not None:
        model = replace(model, surface_sd=rooms.surface_sd, mixed=rooms.mixed, grazing=rooms.grazing)
    surfaces = _lasting(settings.building, 5, rng)
    colour = model.surface_sd * surfaces.standard_normal(len(plan.walls) + len(plan.columns) + len(crowd))
    glass = np.zeros(len(plan.walls), dtype=bool)
    if rooms is not None:
        # The outer walls stay: a place without any has no map.
        glass = _lasting(settings.building, 13, _rng(settings, 13)).random(len(plan.walls)) < rooms.glass
        glass[:4] = False
    paint = _lasting(settings.building, 14, _rng(settings, 14)).random(len(colour)) < model.dark
    return Scene(settings, plan, crowd, model, colour, glass, paint)


def swept(
    scene: Scene, stamps: Floats, times: Floats, pose: Floats, rng: np.random.Generator
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the readings (k, beams), mm, and surfaces (k, beams) of sweeps that begin at the stamps (k,).

    The rays leave at the times (k * beams,) from poses (k * beams, 3) of the base.
    """
    settings, plan, model, rooms = scene.settings, scene.plan, scene.model, scene.settings.rooms
    mounting = np.asarray(settings.laser_pose) + np.asarray(settings.laser_error)
    angles = mounting[2] + (-model.angles if settings.laser_flipped else model.angles)
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    origin = pose[:, :2] + np.stack([c * mounting[0] - s * mounting[1], s * mounting[0] + c * mounting[1]], axis=1)
    walls, columns = laser.near(plan.walls, plan.columns, origin.mean(axis=0), model.max_range + 0.5)
    still = np.broadcast_to(plan.columns[columns], (len(times), len(columns), 3))
    people = _bodies(scene.crowd, times, pose, legs=rooms is not None)
    round_things = np.concatenate([still, people], axis=1)
    whose = np.arange(people.shape[1]) // (1 if rooms is None else 2)
    bodies = len(plan.walls) + len(plan.columns) + whose
    ids = np.concatenate([walls, len(plan.walls) + columns, bodies, [-1]])
    heading = pose[:, 2] + np.tile(angles, len(stamps))
    true, cosine, surface = laser.cast(origin, heading, plan.walls[walls], round_things, model.max_range)
    shape = (len(stamps), model.beams)
    true, cosine, surface = true.reshape(shape), cosine.reshape(shape), ids[surface].reshape(shape)
    if rooms is not None:
        true = np.where(real_rooms.unseen_glass(rooms, scene.glass, surface, cosine), np.inf, true)
        surface = np.where(np.isfinite(true), surface, -1)
        true = true + rooms.warm_up[0] * np.exp(-stamps[:, None] / rooms.warm_up[1])
    stated, mixed = laser.disturb(true, cosine, surface, model, scene.colour, rng, scene.dark)
    far = model.far_sd * np.where(np.isfinite(true), true, 0.0)
    most = 5.0 * np.maximum(model.near_sd, far) + 3.0 * model.surface_sd
    own = (np.abs(0.001 * stated - true) < most) & ~mixed & (surface < len(plan.walls) + len(plan.columns))
    return stated, np.where(own, surface, -1)


def _range(
    settings: Settings, plan: FloorPlan, motion: drive.Motion, anchors: Floats, crowd: list[drive.Motion]
) -> tuple[Floats, NDArray[np.intp], Floats, dict[str, Any]]:
    """Return stamps (m,), anchor indices (m,), ranges (m,) and what is true of the radio."""
    model, count = settings.radio, len(anchors)
    bias = _biases(settings, count)
    truth: dict[str, Any] = {
        "bias": dict(zip(plan.anchor_ids, bias.tolist(), strict=False)),
        "scale": model.scale,
        "anchor_height": settings.anchor_height,
        "tag_height": settings.tag_height,
    }
    if "uwb" in settings.without or count == 0:
        return np.empty(0), np.empty(0, dtype=np.intp), np.empty(0), truth
    times = np.round(np.arange(0.213, motion.stamps[-1], 1.0 / settings.uwb_rate), 6)
    measured = ranged(settings, plan, anchors, times, motion.at(times), crowd, lambda part: _rng(settings, part))
    rng = _rng(settings, 8)
    epoch, anchor = picked(*measured[1:], model.per_epoch, rng)
    stamps, values = times[epoch], np.maximum(measured[0][epoch, anchor], 0.0)
    values = _spoil(settings, stamps, anchor, values, rng, max(plan.size))
    return stamps + settings.uwb_delay, anchor, np.round(values, 3), truth


def ranged(
    settings: Settings,
    plan: FloorPlan,
    anchors: Floats,
    times: Floats,
    pose: Floats,
    crowd: list[drive.Motion],
    draw: Callable[[int], np.random.Generator],
) -> tuple[Floats, Floats, Floats]:
    """Return what a tag would measure (n, a), m, at poses (n, 3) of the base, whether it is received, and at what effort.

    `draw` returns the generator of a part of the noise; what stays with building and robot comes from the settings.
    """
    model, count = settings.radio, len(anchors)
    bias = _biases(settings, count)
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    tag = pose[:, :2] + np.stack([c * settings.tag[0] - s * settings.tag[1], s * settings.tag[0] + c * settings.tag[1]], axis=1)
    bodies = _bodies(crowd, times, pose)
    ranges, received, effort = (np.empty((len(times), count)) for _ in range(3))
    pattern = _lasting(settings.robot, 7, _rng(settings, 7)).integers(2**31)
    for a, place in enumerate(anchors):
        rng = draw(200 + a)
        there = _lasting(settings.building, 200 + a, rng)
        ray = place - tag
        distance = np.sqrt((ray * ray).sum(axis=1) + (settings.anchor_height - settings.tag_height) ** 2)
        bearing = np.arctan2(ray[:, 1], ray[:, 0])
        # One antenna on the robot: every anchor meets the same pattern; each anchor has one of its own besides.
        antenna = radio.antenna_pattern(np.random.default_rng(pattern), bearing - pose[:, 2])
        antenna = (antenna + radio.antenna_pattern(there, bearing)) / np.sqrt(2.0)
        field_ = smooth_field(there, tag, model.multipath_length)
        shadow = plan.opacity * radio.crossings(tag, place, plan.walls, plan.columns)
        shadow += 0.5 * (radio.crossings(tag, place, np.empty((0, 4)), bodies) > 0)
        level = settings.nlos if not settings.nlos_anchors or a + 1 in settings.nlos_anchors else "normal"
        extra, lost = radio.excess(shadow, tag, level, rng, there)
        noise = model.noise_sd * rng.standard_normal(len(times))
        smooth = bias[a] + model.multipath_sd * field_ + model.antenna_sd * antenna
        if (rooms := settings.rooms) is not None:
            hidden = radio.crossings(tag, place, np.empty((0, 4)), bodies) > 0
            behind = np.angle(np.exp(1j * (bearing - pose[:, 2] - np.pi)))
            body, blocked = real_rooms.own_body(rooms, behind, draw(300 + a))
            smooth = bias[a] + real_rooms.range_errors(rooms, there, tag) + rooms.antenna_sd * antenna + body
            smooth += real_rooms.person_errors(rooms, hidden, draw(400 + a))
            noise = noise + real_rooms.gross_errors(rooms, len(times), draw(500 + a))
            lost = lost | blocked
        ranges[:, a] = model.scale * distance + smooth + extra + noise
        received[:, a] = ~lost & (rng.random(len(times)) >= model.loss) & (distance < min(model.max_range, plan.radio_range))
        effort[:, a] = distance + 6.0 * shadow
    return ranges, received, effort


def picked(
    received: Floats, effort: Floats, most: int, rng: np.random.Generator
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return epoch (m,) and anchor (m,) of the ranges that a tag reports: the easiest of each epoch, so many at most."""
    rank = np.argsort(np.argsort(effort + rng.uniform(0, 3, effort.shape), axis=1), axis=1)
    epoch, anchor = np.nonzero((received > 0) & (rank < most))
    return epoch, anchor


def _biases(settings: Settings, count: int) -> Floats:
    """Return the constant errors (a,) of the anchors, m."""
    return settings.radio.bias_sd * _lasting(settings.building, 6, _rng(settings, 6)).standard_normal(count)


def _spoil(
    settings: Settings, stamps: Floats, anchor: NDArray[np.intp], values: Floats, rng: np.random.Generator, size: float
) -> Floats:
    for false in settings.false_ranges:
        during = (anchor == false.anchor - 1) & (stamps >= false.start) & (stamps < false.start + false.seconds)
        values = np.where(during, np.maximum(values + false.metres, 0.0), values)
    kind, wild = rng.random(len(values)), rng.uniform(0.0, 1.5 * size, len(values))
    values = np.where(kind < settings.outliers, wild, values)
    return np.where(kind > 1.0 - settings.zeros, 0.0, values)


def with_overrides(settings: Settings, **values: Any) -> Settings:
    """Return the settings with the values that are not None put in."""
    return replace(settings, **{k: v for k, v in values.items() if v is not None})
