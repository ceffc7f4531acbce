"""Self-calibration: which scalar unknowns the graph may carry, what is known of them beforehand, and their names."""

from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Bools, Ints
from .graph import Calibration, Graph, PriorEdges

WHEELS = ("odometry_scale", "heading_scale", "heading_per_metre", "heading_rate")
"""Unknowns of the wheels."""
LASER = ("laser_x", "laser_y", "laser_theta", "laser_delay")
"""Unknowns of the lidar."""
RADIO = ("height2", "tag_x", "tag_y", "range_delay")
"""Unknowns of the radio that a first estimate does without, by stem."""


@dataclass(frozen=True, slots=True)
class CalibrationConfig:
    """Prior standard deviation of each unknown; 0 switches it off (held at its nominal value)."""

    odometry_scale: float = 0.02
    """Relative error of travelled distance (wheel radius), 1."""
    odometry_unit: float = 1.0
    """The same where the wheels' unit is wrong: a setting, off by any factor. The data choose, see prior_selection."""
    heading_scale: float = 0.3
    """Relative error of turned angle (track width), 1."""
    heading_per_metre: float = 0.05
    """Heading drift per travelled metre (unequal wheels), rad/m."""
    heading_rate: float = 0.0005
    """Heading drift per second while the robot moves (gyro bias), rad/s."""
    range_scale: float = 0.15
    """Relative error of all ranges where the radios' idea of distance is off, 1; 0.07 is on record. The data choose."""
    range_scale_sound: float = 0.005
    """The same for radios that are sound, as most are: they measure times of flight."""
    range_bias: float = 0.8
    """Constant error of one anchor's ranges where nobody calibrated the radios' antennas, m."""
    range_bias_sound: float = 0.1
    """The same where the maker did, m. The data choose between these and what lies between."""
    anchor_height: float = 1.5
    """Height of anchors above the tag where nobody told, m."""
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


@dataclass(frozen=True, slots=True)
class Unknown:
    """One scalar of the calibration block."""

    name: str
    """For an anchor's own unknowns ``name:anchor_id``."""
    sigma: float
    """Prior standard deviation around 0."""
    unit: str
    meaning: str


def unknowns(
    config: CalibrationConfig, anchor_ids: tuple[str, ...], told_height: Bools, recording: int = 0
) -> tuple[Unknown, ...]:
    """List the scalar unknowns that a recording with these anchors brings into a graph.

    Wheels, tag and clocks, and what an anchor's ranges are wrong by, are each recording's own: another robot, another
    tag, another day. The scale of the radios and the mounting of the laser are those of the first recording.

    Parameters
    ----------
    told_height : (a,) whose height is known.
    recording : which one of the graph's; all but the first add their number to the names, see of_recording.
    """
    common = (
        Unknown("odometry_scale", config.odometry_scale, "1", "relative error of travelled distance"),
        Unknown("heading_scale", config.heading_scale, "1", "relative error of turned angle"),
        Unknown("heading_per_metre", config.heading_per_metre, "rad/m", "heading drift per travelled metre"),
        Unknown("heading_rate", config.heading_rate, "rad/s", "heading drift per second of motion"),
        Unknown("laser_x", config.laser_offset, "m", "correction of the laser's x on the base"),
        Unknown("laser_y", config.laser_offset, "m", "correction of the laser's y on the base"),
        Unknown("laser_theta", config.laser_angle, "rad", "correction of the laser's heading on the base"),
        Unknown("laser_delay", config.laser_delay, "s", "laser clock against odometry clock"),
        Unknown("range_scale", config.range_scale, "1", "relative error of all ranges"),
        Unknown("tag_x", config.tag_offset, "m", "correction of the tag's x on the base"),
        Unknown("tag_y", config.tag_offset, "m", "correction of the tag's y on the base"),
        Unknown("range_delay", config.range_delay, "s", "radio clock against odometry clock"),
    )
    own: list[Unknown] = []
    for anchor_id, told in zip(anchor_ids, told_height, strict=True):
        own.append(Unknown(f"bias:{anchor_id}", config.range_bias, "m", f"constant error of ranges to anchor {anchor_id}"))
        if not told:
            text = f"squared height of anchor {anchor_id} above the tag"
            own.append(Unknown(f"height2:{anchor_id}", config.anchor_height**2, "m\u00b2", text))
    listed = tuple(u for u in (*common, *own) if u.sigma > 0)
    if recording > 0:
        where = f" in recording {recording + 1}"
        renamed = (replace(u, name=of_recording(u.name, recording), meaning=u.meaning + where) for u in listed)
        listed = tuple(u for u in renamed if u.name not in SHARED)
    return listed


SHARED = ("laser_x", "laser_y", "laser_theta", "laser_delay", "range_scale")
"""Unknowns that all recordings have in common."""


def of_recording(name: str, recording: int) -> str:
    """Return what an unknown is called in a recording: ``name`` in the first (0), ``name#2`` in the second ..., where own."""
    return name if recording == 0 or name in SHARED else f"{name}#{recording + 1}"


def stem(name: str) -> str:
    """Return the name of an unknown without the anchor and the recording that it belongs to."""
    return name.split(":")[0].split("#")[0]


def block(listed: tuple[Unknown, ...]) -> Calibration:
    """Return the calibration block with every unknown at its nominal value, 0."""
    return Calibration(tuple(u.name for u in listed), np.zeros(len(listed)))


def prior_edges(listed: tuple[Unknown, ...]) -> PriorEdges:
    """Return the weak priors, one per unknown."""
    sigma = np.array([u.sigma for u in listed])
    return PriorEdges("calibration", np.arange(len(listed)), np.zeros((len(listed), 1)), (1.0 / sigma)[:, None, None])


def indices(calibration: Calibration, *names: str) -> Ints:
    """Return the positions (len(names),) of names in the block, -1 where one is not an unknown."""
    return np.array([calibration.index(name) for name in names], dtype=np.int64)


def range_indices(calibration: Calibration, anchor: Ints, anchor_ids: tuple[str, ...]) -> Ints:
    """Return the (m, 6) calibration indices of RangeEdges for ranges to the given anchors (m,)."""
    bias = indices(calibration, *(f"bias:{a}" for a in anchor_ids))
    height = indices(calibration, *(f"height2:{a}" for a in anchor_ids))
    scale, tag_x, tag_y, delay = indices(calibration, "range_scale", "tag_x", "tag_y", "range_delay")
    table = np.stack([np.full(len(bias), scale), bias, height, *(np.full(len(bias), k) for k in (tag_x, tag_y, delay))], axis=1)
    return table[anchor]


def odometry_indices(calibration: Calibration, edges: int) -> Ints:
    """Return the (e, 4) calibration indices of OdometryEdges."""
    return np.broadcast_to(indices(calibration, *WHEELS), (edges, 4))


def scan_indices(calibration: Calibration) -> Ints:
    """Return the (4,) calibration indices of ScanEdges."""
    return indices(calibration, *LASER)


def with_free(graph: Graph, *names: str) -> Graph:
    """Return the graph with calibration unknowns of these names (an anchor's or a recording's own by their stem) set free."""
    assert graph.fixed_calibration is not None
    named = np.array([stem(name) in names for name in graph.calibration.names], dtype=bool)
    return replace(graph, fixed_calibration=graph.fixed_calibration & ~named)


def with_nonnegative_heights(graph: Graph) -> Graph:
    """Return the graph with squared heights that came out negative put back to 0 and held."""
    names, values = graph.calibration.names, graph.calibration.values.copy()
    below = np.array([n.startswith("height2:") for n in names], dtype=bool) & (values < 0.0)
    values[below] = 0.0
    fixed = np.asarray(graph.fixed_calibration) | below
    return replace(graph.updated(graph.poses, graph.anchors, values), fixed_calibration=fixed)
