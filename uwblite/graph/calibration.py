"""Self-calibration: the scalar unknowns that a graph may contain, their kinds, and their priors."""

from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Bools, Ints
from .graph import Calibration, Graph, PriorEdges, UnknownKey

ODOMETRY = ("odometry_scale", "heading_scale", "heading_per_metre", "heading_rate")
"""Kinds of unknowns of the odometry."""
TURNING, OMNI = "sideways_per_turn", ("sideways_scale", "sideways_per_metre", "ahead_per_sideways")
"""Kinds of unknowns of an odometry that slips sideways: in turns, and of wheels that drive sideways."""
WHEELS = (*ODOMETRY, TURNING, *OMNI)
LASER = ("laser_x", "laser_y", "laser_theta", "laser_delay")
"""Kinds of unknowns of the lidar."""
BIAS, HEIGHT, RANGE_SCALE = "bias", "height2", "range_scale"
RANGING = (RANGE_SCALE, BIAS, HEIGHT, "tag_x", "tag_y", "range_delay")
"""Kinds of unknowns of a range."""
RADIO = RANGING[2:]
"""Kinds of unknowns of the radio that the bootstrap does not use."""
SHARED = (*LASER, RANGE_SCALE)
"""Kinds that all recordings have in common."""


@dataclass(frozen=True, slots=True)
class CalibrationConfig:
    """Prior standard deviation of each unknown; 0 switches it off (fixed at its nominal value)."""

    odometry_scale: float = 0.02
    """Relative error of travelled distance (wheel radius)."""
    odometry_unit: float = 1.0
    """The same where the unit of the wheels is set wrong, by any factor; used only where the recording shows it."""
    heading_scale: float = 0.3
    """Relative error of turned angle (track width)."""
    heading_per_metre: float = 0.05
    """Heading drift per travelled metre (unequal wheels), rad/m."""
    heading_rate: float = 0.0005
    """Heading drift per second while the robot moves (gyro bias), rad/s."""
    sideways_per_turn: float = 0.15
    """How far ahead of the base's origin or behind it a robot turns that slips in turns, m (skid steering); used as far as the
    recording shows it."""
    sideways_scale: float = 0.1
    """Relative error of sideways motion; only where the odometry measures some (mecanum and omni wheels)."""
    sideways_per_metre: float = 0.015
    """Angle between the base's x axis and the direction of forward motion, rad; of the same odometry."""
    ahead_per_sideways: float = 0.015
    """Angle between the base's y axis and the direction of sideways motion, rad; of the same odometry. Wheels of unequal load
    deflect both directions of motion, by two angles: with one alone the lidar's heading on the base would seem to be known."""
    range_scale: float = 0.15
    """Relative error of all ranges where the unit of the radios is wrong (0.07 has been seen); used as far as the recording
    shows it."""
    range_scale_sound: float = 0.001
    """The same for radios whose unit is right, as it is for most: their clocks are off by 2e-5, air slows the signal by 3e-4,
    and the correction for received power leaves a few centimetres in tens of metres."""
    range_bias: float = 0.8
    """Constant error of one anchor's ranges where the radios' antenna delays are not calibrated, m."""
    range_bias_sound: float = 0.1
    """The same where they are calibrated, m; the recording decides between the two (by the marginal likelihood)."""
    anchor_height: float = 1.5
    """Height of anchors above the tag where none is given, m."""
    tag_offset: float = 0.03
    """Error of the tag's position on the base in x and y, m."""
    range_delay: float = 0.1
    """Clock offset of the radio against the odometry, s."""
    laser_offset: float = 0.1
    """Error of the laser's position on the base in x and y, m."""
    laser_angle: float = 0.05
    """Error of the laser's heading on the base, rad."""
    laser_delay: float = 0.1
    """Clock offset of the laser against the odometry, s."""
    scan_duration: float = 0.1
    """Error of the time from a scan's first ray to its last, s; used as far as the recording shows it."""


@dataclass(frozen=True, slots=True)
class Unknown:
    """One scalar of the calibration block."""

    key: UnknownKey
    sigma: float
    """Prior standard deviation around 0."""
    unit: str
    meaning: str


def unknowns(
    config: CalibrationConfig,
    anchor_ids: tuple[str, ...],
    given_height: Bools,
    recording: int = 0,
    rises: tuple[float, ...] = (0.0,),
) -> tuple[Unknown, ...]:
    """List the scalar unknowns that a recording with these anchors adds to a graph.

    All but the scale of the ranges and the mounting of the laser are each recording's own: another robot, another day.

    Parameters
    ----------
    given_height : (a,) anchors whose height is given.
    recording : which one of the graph's.
    rises : m, height of each of the robot's tags above the first. A further tag has its own place and antenna delay, and
        where it is mounted higher or lower its own height below the anchors.
    """
    common = (
        ("odometry_scale", config.odometry_scale, "1", "relative error of travelled distance"),
        ("heading_scale", config.heading_scale, "1", "relative error of turned angle"),
        ("heading_per_metre", config.heading_per_metre, "rad/m", "heading drift per travelled metre"),
        ("heading_rate", config.heading_rate, "rad/s", "heading drift per second of motion"),
        (TURNING, config.sideways_per_turn, "m/rad", "motion to the left per turn"),
        (OMNI[0], config.sideways_scale, "1", "relative error of sideways motion"),
        (OMNI[1], config.sideways_per_metre, "1", "motion to the left per metre ahead"),
        (OMNI[2], config.ahead_per_sideways, "1", "motion ahead per metre to the left"),
        ("laser_x", config.laser_offset, "m", "correction of the laser's x on the base"),
        ("laser_y", config.laser_offset, "m", "correction of the laser's y on the base"),
        ("laser_theta", config.laser_angle, "rad", "correction of the laser's heading on the base"),
        ("laser_delay", config.laser_delay, "s", "laser clock against odometry clock"),
        (RANGE_SCALE, config.range_scale, "1", "relative error of all ranges"),
        ("tag_x", config.tag_offset, "m", "correction of the tag's x on the base"),
        ("tag_y", config.tag_offset, "m", "correction of the tag's y on the base"),
        ("range_delay", config.range_delay, "s", "radio clock against odometry clock"),
    )
    where = f" in recording {recording + 1}" if recording else ""

    def own(kind: str, sigma: float, unit: str, meaning: str, anchor: str | None = None, tag: int = 0) -> Unknown:
        shared = kind in SHARED
        key = UnknownKey(kind, anchor, None if shared else recording, tag)
        return Unknown(key, sigma, unit, meaning if shared else meaning + where)

    listed = [own(*row) for row in common]
    for tag, rise in enumerate(rises):
        name = f"tag {tag + 1}" if tag else "the tag"
        for axis in ("x", "y") if tag else ():
            listed.append(own(f"tag_{axis}", config.tag_offset, "m", f"correction of {name}'s {axis} on the base", tag=tag))
        for anchor, given in zip(anchor_ids, given_height, strict=True):
            text = f"constant error of ranges to anchor {anchor}{f' from {name}' if tag else ''}"
            listed.append(own(BIAS, config.range_bias, "m", text, anchor, tag))
            if not given and (rise or not tag):
                text = f"squared height of anchor {anchor} above {name}"
                listed.append(own(HEIGHT, config.anchor_height**2, "m\u00b2", text, anchor, tag))
    return tuple(u for u in listed if u.sigma > 0 and (u.key.recording is not None or recording == 0))


def of_recording(key: UnknownKey, recording: int) -> UnknownKey:
    """Return the key of an unknown in a recording; a shared one is the same in all."""
    return key if key.recording is None else key._replace(recording=recording)


def block(listed: tuple[Unknown, ...]) -> Calibration:
    """Return the calibration block with every unknown at its nominal value, 0."""
    return Calibration(tuple(u.key for u in listed), np.zeros(len(listed)))


def prior_edges(listed: tuple[Unknown, ...]) -> PriorEdges:
    """Return the weak priors, one per unknown."""
    sigma = np.array([u.sigma for u in listed])
    return PriorEdges("calibration", np.arange(len(listed)), np.zeros((len(listed), 1)), (1.0 / sigma)[:, None, None])


def indices(calibration: Calibration, *kinds: str) -> Ints:
    """Return the positions (len(kinds),) in the block, -1 where one is not an unknown."""
    return np.array([calibration.index(kind) for kind in kinds], dtype=np.intp)


def range_indices(calibration: Calibration, anchor: Ints, anchor_ids: tuple[str, ...], tag: Ints | None = None) -> Ints:
    """Return the (m, 6) calibration indices of RangeEdges for ranges to anchors (m,) by tags (m,), None = by one tag."""
    tags = np.zeros(len(anchor), dtype=np.intp) if tag is None else tag
    scale, delay = indices(calibration, RANGE_SCALE, "range_delay").tolist()

    def row(name: str, number: int) -> tuple[int, ...]:
        bias, height = (calibration.index(kind, name, tag=number) for kind in (BIAS, HEIGHT))
        x, y = (calibration.index(kind, tag=number) for kind in ("tag_x", "tag_y"))
        # A tag as high as the first one shares its squared heights.
        return scale, bias, calibration.index(HEIGHT, name) if height < 0 else height, x, y, delay

    table = [[row(name, number) for name in anchor_ids] for number in range(int(np.max(tags, initial=0)) + 1)]
    return np.array(table, dtype=np.intp).reshape(len(table), len(anchor_ids), len(RANGING))[tags, anchor]


def odometry_indices(calibration: Calibration, edges: int) -> Ints:
    """Return the (e, 8) calibration indices of OdometryEdges."""
    return np.broadcast_to(indices(calibration, *WHEELS), (edges, len(WHEELS)))


def with_free(graph: Graph, *kinds: str) -> Graph:
    """Return the graph with the calibration unknowns of these kinds set free."""
    return replace(graph, fixed_calibration=graph.fixed_calibration & ~graph.calibration.of_kinds(*kinds))
