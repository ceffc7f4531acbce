"""Write a recording as a CARMEN log."""

import heapq
import os
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from .. import se2
from ..sensor_log import Gyro, LaserScans, Odometry, SensorLog, UwbRanges
from .carmen_words import LASER_IS_BASE
from .files import replacing

HOST = "uwblite"
_SCANS_AT_A_TIME = 256
_LASER_TYPE = 2
"""CARMEN's number for a Hokuyo URG; readers take the geometry from the fields that follow."""


def write_log(path: str | os.PathLike[str], log: SensorLog) -> None:
    """Write a recording as a CARMEN log, compressed where the name ends in ``.gz``.

    Stamps are written to the microsecond, odometry to the micrometre and microradian, UWB ranges to 0.1 mm and laser
    readings to the millimetre. An invalid reading is written as 0, "saw nothing" as the maximum range. Messages stand
    in time order; at equal stamps odometry comes first and the laser last.
    """
    with replacing(path) as stream:
        stream.write(b"# CARMEN Logfile\n")
        for name, value in _params(log):
            stream.write(f"PARAM {name} {value} 0 {HOST} 0\n".encode())
        parts = [zip(log.odometry.stamps.tolist(), _odometry_lines(log.odometry), strict=True)]
        parts += [] if log.gyro is None else [zip(log.gyro.stamps.tolist(), _gyro_lines(log.gyro), strict=True)]
        parts += [] if log.ranges is None else [zip(log.ranges.stamps.tolist(), _range_lines(log.ranges), strict=True)]
        parts += [] if log.scans is None else [zip(log.scans.stamps.tolist(), scan_lines(log), strict=True)]
        stream.writelines(line for _, line in heapq.merge(*parts, key=lambda row: row[0]))


def _params(log: SensorLog) -> Iterator[tuple[str, str]]:
    """Yield the names and values of the PARAM lines."""
    mounting = log.mounting
    if log.ranges is not None:
        x, y, z = mounting.tag_position
        yield from (("uwb_tag_offset_x", f"{x:.6f}"), ("uwb_tag_offset_y", f"{y:.6f}"), ("uwb_tag_height", f"{z:.6f}"))
        for k, (x, y, z) in enumerate(mounting.more_tags.tolist(), start=2):
            names = (f"uwb{k}_tag_{name}" for name in ("offset_x", "offset_y", "height"))
            yield from zip(names, (f"{v:.6f}" for v in (x, y, z)), strict=True)
        if mounting.anchor_height is not None:
            yield "uwb_anchor_height", f"{mounting.anchor_height:.6f}"
        for anchor, height in sorted(mounting.anchor_heights.items()):
            yield f"uwb_anchor_height_{anchor}", f"{height:.6f}"
    if log.scans is not None:
        yield "laser_flipped", "on" if mounting.laser_flipped else "off"
        if mounting.laser_is_base:
            yield LASER_IS_BASE, "on"
        yield "laser_time_increment", f"{log.scans.time_increment:.9g}"
        yield "laser_range_min", f"{log.scans.range_min:.6g}"


def _odometry_lines(odometry: Odometry) -> Iterator[bytes]:
    for stamp, (x, y, theta) in zip(odometry.stamps.tolist(), odometry.poses.tolist(), strict=True):
        yield f"ODOM {x:.6f} {y:.6f} {theta:.6f} 0 0 0 {stamp:.6f} {HOST} {stamp:.6f}\n".encode()


def _gyro_lines(gyro: Gyro) -> Iterator[bytes]:
    for stamp, heading in zip(gyro.stamps.tolist(), gyro.heading.tolist(), strict=True):
        yield f"GYRO {heading:.6f} 0 {stamp:.6f} {HOST} {stamp:.6f}\n".encode()


def _range_lines(ranges: UwbRanges) -> Iterator[bytes]:
    names, columns = ranges.anchor_ids, (ranges.tags, ranges.anchor, ranges.stamps, ranges.ranges, ranges.quality)
    for tag, anchor, stamp, distance, quality in zip(*(c.tolist() for c in columns), strict=True):
        name = f"UWB{tag + 1 if tag else ''} {names[anchor]}"
        yield f"{name} {distance:.4f} {quality:g} {stamp:.6f} {HOST} {stamp:.6f}\n".encode()


def scan_lines(log: SensorLog) -> Iterator[bytes]:
    """Yield the ROBOTLASER1 line of each scan; g2o attaches such lines to the vertex above them."""
    scans = log.scans
    if scans is None:
        return
    robot = np.round(log.odometry.at(scans.stamps), 6)
    laser = se2.compose(robot, log.mounting.T_base_laser)
    beams = scans.ranges.shape[1]
    fov = scans.angle_increment * max(beams - 1, 0)
    head = (
        f"ROBOTLASER1 {_LASER_TYPE} {scans.angle_min:.9f} {fov:.9f} {scans.angle_increment:.9f} "
        f"{_reach(scans):g} 0.01 0 {beams} "
    ).encode()
    form = b" ".join([b"%.3f"] * beams)
    for start in range(0, len(scans.stamps), _SCANS_AT_A_TIME):
        part = slice(start, start + _SCANS_AT_A_TIME)
        readings = map(form.__mod__, map(tuple, _clear_signs(scans, part).tolist()))
        rows = zip(readings, laser[part].tolist(), robot[part].tolist(), scans.stamps[part].tolist(), strict=True)
        for text, l, r, stamp in rows:
            poses = f"{l[0]:.9f} {l[1]:.9f} {l[2]:.9f} {r[0]:.6f} {r[1]:.6f} {r[2]:.6f}"
            yield head + text + f" 0 {poses} 0 0 0 0 0 {stamp:.6f} {HOST} {stamp:.6f}\n".encode()


def _clear_signs(scans: LaserScans, part: slice) -> NDArray[np.float32]:
    """Return readings as CARMEN writes them: 0 for invalid, the maximum range for nothing seen."""
    ranges = scans.ranges[part]
    # A reading that rounds up to the maximum range would turn into "nothing seen".
    seen = np.clip(ranges, 0.0, _reach(scans) - 0.001)
    invalid = ~(ranges >= scans.range_min)
    return np.where(np.isposinf(ranges), _reach(scans), np.where(invalid, 0.0, seen)).astype(np.float32)


def _reach(scans: LaserScans) -> float:
    """Return the maximum range, m, to the millimetre, as readings are written: one of a finer step would be no maximum."""
    return round(scans.range_max, 3)
