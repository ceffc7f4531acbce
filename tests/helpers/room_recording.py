"""A recording of a small room with columns of nothing but walls: wheels without errors, ranges, scans."""

import numpy as np

from uwblite import se2
from uwblite.sensor_log import LaserScans, Odometry, SensorLog, UwbRanges

ROOM = np.array([[0.0, 0.0], [6.0, 0.0], [6.0, 4.5], [3.0, 4.5], [3.0, 5.5], [0.0, 5.5], [0.0, 0.0]])
ANCHORS = {"A1": (0.5, 0.5), "B2": (5.5, 4.0), "C3": (0.5, 5.0)}


def walls_seen(pose, bearings):
    """Return the distance (b,) to the walls of ROOM along bearings in the laser's frame, m."""
    a, b = ROOM[:-1], ROOM[1:]
    direction = np.stack([np.cos(pose[2] + bearings), np.sin(pose[2] + bearings)], axis=1)
    edge = b - a
    cross = direction[:, None, 0] * edge[None, :, 1] - direction[:, None, 1] * edge[None, :, 0]
    to = a - pose[:2]
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (to[None, :, 0] * edge[None, :, 1] - to[None, :, 1] * edge[None, :, 0]) / cross
        part = (to[None, :, 0] * direction[:, None, 1] - to[None, :, 1] * direction[:, None, 0]) / cross
    return np.where((along > 0) & (part >= 0) & (part <= 1), along, np.inf).min(axis=1)


def two_rounds():
    """Two rounds through a room from place to place, turning on the spot: true poses at 20 Hz."""
    places = [(1.2, 1.2), (4.6, 0.9), (5.1, 3.2), (3.4, 2.2), (2.3, 4.6), (0.8, 3.9), (1.9, 2.4)] * 2
    poses = [np.array([*places[-1], 0.4])]
    for place in places:
        here = poses[-1]
        way = np.array(place) - here[:2]
        turn = float(se2.wrap_angle(np.arctan2(way[1], way[0]) - here[2]))
        for move, amount, speed in ((np.array([0, 0, 1.0]), turn, 0.6), (np.array([1.0, 0, 0]), np.hypot(*way), 0.25)):
            steps = max(1, round(abs(amount) / speed * 20))
            for _ in range(steps):
                poses.append(se2.compose(poses[-1], move * amount / steps))
    return np.array(poses)


def recording(poses, *, flipped=False, lag=0.0):
    stamps = 100.0 + 0.05 * np.arange(len(poses))
    rng = np.random.default_rng(1)
    ids = tuple(sorted(ANCHORS))
    when = np.repeat(np.arange(100.0, stamps[-1], 0.5), len(ids))
    where = se2.interpolate_trajectory(stamps, poses, when)[:, :2]
    anchor = np.tile(np.arange(len(ids)), len(when) // len(ids))
    ranges = np.hypot(*(where - np.array([ANCHORS[i] for i in ids])[anchor]).T) + rng.normal(0, 0.03, len(when))
    scan_stamps = np.arange(100.0, stamps[-1], 0.2)
    bearings = np.linspace(-2.0, 2.0, 161)
    sign = -1.0 if flipped else 1.0
    seen = [walls_seen(p, sign * bearings) for p in se2.interpolate_trajectory(stamps, poses, scan_stamps)]
    readings = np.array(seen) + rng.normal(0, 0.01, (len(seen), len(bearings)))
    scans = LaserScans(scan_stamps + lag, readings.astype(np.float32), -2.0, 0.025, 0.0, 0.02, 5.6)
    return SensorLog(Odometry(stamps, poses), UwbRanges(when, anchor, ranges, np.full(len(when), 100.0), ids), scans)
