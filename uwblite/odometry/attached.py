"""Ranges and rays attached to keyframes: the odometry since the keyframe is their lever arm."""

from dataclasses import dataclass

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, Ints, Table
from ..sensor_log import LaserScans, Odometry, SensorLog, SensorMounting, UwbRanges
from .keyframes import KeyframeConfig, Keyframes, velocity_at


@dataclass(frozen=True, slots=True, eq=False)
class AttachedRanges:
    """Ranges seen from keyframes."""

    keyframe: Ints
    """(m,) keyframe at or before the range."""
    stamps: Floats
    """(m,) s."""
    anchor: Ints
    """(m,)."""
    ranges: Floats
    """(m,) m."""
    lever_arm: Floats
    """(m, 2) base at the moment of ranging in the keyframe's frame, m; moved by a further tag's offset from the first."""
    turn: Floats
    """(m,) rad."""
    velocity: Floats
    """(m, 2) velocity of the tag in the keyframe's frame, m/s."""
    inside: Bools
    """(m,) whether the range was made while there was odometry; elsewhere the robot's place is not known."""
    rise: Floats
    """(m,) height of the tag that measured above the first one, m."""
    tag: Ints
    """(m,) which of the robot's tags measured."""


OUTSIDE = 0.2
"""Stamps so far outside the odometry's time still count as inside, s: a period of slow odometry."""


@dataclass(frozen=True, slots=True, eq=False)
class ScanPoints(Table):
    """Rays of chosen scans as points in the frame of their keyframes, deskewed ray by ray."""

    keyframe: Ints
    """(p,) keyframe of each point, non-decreasing."""
    points: Floats
    """(p, 2) m, base frame of the keyframe."""
    origins: Floats
    """(p, 2) position of the laser when it saw the point, m, same frame."""
    ray: Ints
    """(p,) beam number."""
    scan: Ints
    """(p,) which scan of the log."""


def attach_ranges(log_ranges: UwbRanges, odometry: Odometry, keyframes: Keyframes, mounting: SensorMounting) -> AttachedRanges:
    """Tie each range to the keyframe at or before it; ranges outside the odometry's time keep the nearest end's pose.

    The offset of a further tag from the first one is added to the lever arm, as if the base were shifted by it.
    """
    keyframe = np.clip(np.searchsorted(keyframes.stamps, log_ranges.stamps, "right") - 1, 0, len(keyframes) - 1)
    base = odometry.at(log_ranges.stamps)
    arm = se2.between(keyframes.odometry[keyframe], base)
    twist = velocity_at(odometry, log_ranges.stamps)
    tag = mounting.tags[log_ranges.tags]
    in_base = np.stack([twist[:, 0] - twist[:, 2] * tag[:, 1], twist[:, 1] + twist[:, 2] * tag[:, 0]], axis=1)
    beside = tag - mounting.tag_position
    return AttachedRanges(
        keyframe.astype(np.intp),
        log_ranges.stamps,
        log_ranges.anchor,
        log_ranges.ranges,
        arm[:, :2] + se2.rotate(arm[:, 2], beside[:, :2]),
        arm[:, 2],
        se2.rotate(arm[:, 2], in_base),
        (log_ranges.stamps >= odometry.stamps[0] - OUTSIDE) & (log_ranges.stamps <= odometry.stamps[-1] + OUTSIDE),
        beside[:, 2],
        log_ranges.tags,
    )


def choose_scans(scans: LaserScans, keyframes: Keyframes, config: KeyframeConfig) -> tuple[Ints, Ints]:
    """Choose for each keyframe the scans nearest in time; none serves two keyframes.

    Returns
    -------
    keyframe (s,), non-decreasing, and scan (s,) indices.
    """
    middle = scans.middles
    owner = np.searchsorted((keyframes.stamps[:-1] + keyframes.stamps[1:]) / 2.0, middle)
    distance = np.abs(middle - keyframes.stamps[owner])
    order = np.lexsort((distance, owner))
    rank = np.arange(len(order)) - np.searchsorted(owner[order], owner[order])
    each = config.scans_each(float(keyframes.path.sum()), scans.ranges.shape[1])
    kept = np.sort(order[rank < np.where(keyframes.alone, 1, each)[owner[order]]])
    return owner[kept].astype(np.intp), kept


def scan_points(log: SensorLog, keyframes: Keyframes, owner: Ints, chosen: Ints, range_max: float = np.inf) -> ScanPoints:
    """Turn chosen scans into points in the frame of their keyframes, each ray moved by the odometry at its own time.

    Parameters
    ----------
    owner, chosen : (s,) keyframe and scan indices, see choose_scans.
    range_max : longer readings are left out, m.
    """
    scans, mounting = log.scans, log.mounting
    assert scans is not None
    beams = scans.ranges.shape[1]
    start, end = scans.stamps[chosen], scans.stamps[chosen] + scans.duration
    anchor = keyframes.odometry[owner]
    first = se2.between(anchor, log.odometry.at(start))
    sweep = se2.between(first, se2.between(anchor, log.odometry.at(end)))
    readings = scans.ranges[chosen]
    scan, ray = np.nonzero(scans.hits(readings, range_max))
    fraction = ray / max(beams - 1, 1)
    laser = beam_origins(first, sweep, scan, fraction, mounting)
    sign = -1.0 if mounting.laser_flipped else 1.0
    bearing = laser[:, 2] + sign * scans.angles[ray]
    reach = readings[scan, ray].astype(np.float64)
    points = laser[:, :2] + reach[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
    return ScanPoints(owner[scan], points, laser[:, :2], ray.astype(np.intp), chosen[scan])


def beam_origins(first: Floats, sweep: Floats, scan: Ints, fraction: Floats, mounting: SensorMounting) -> Floats:
    """Return the pose (p, 3) of the laser at each ray: base pose at the sweep's start, moved by a fraction of the sweep.

    The motion is taken as linear in x, y and theta: over 0.1 s the error is below v omega t^2 / 8, some 0.1 mm.
    """
    moved = sweep[scan] * fraction[:, None]
    shift = moved[:, :2] + se2.rotate(moved[:, 2], mounting.T_base_laser[:2])
    xy = se2.transform_each(first, scan, shift)
    return np.concatenate([xy, (first[scan, 2] + moved[:, 2] + mounting.T_base_laser[2])[:, None]], axis=1)
