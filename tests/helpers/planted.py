"""Small worlds with a known truth: paths, the odometry along them, ranges to planted anchors and scans of straight walls."""

from math import atan2, cos, hypot, remainder, sin, tau

import numpy as np

from uwblite import se2
from uwblite.sensor_log import LaserScans, Odometry, SensorLog, SensorMounting, UwbRanges

NOMINAL = SensorMounting()


def drive(twists, seconds, rate=20.0, start=(0.0, 0.0, 0.0)) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps (n,) and true poses (n, 3) of a base that holds each twist (vx, vy, omega) for so many seconds."""
    counts = [max(1, round(s * rate)) for s in seconds]
    steps = np.repeat(np.asarray(twists, dtype=float) / rate, counts, axis=0)
    return np.arange(len(steps) + 1) / rate, chain(np.asarray(start, dtype=float), se2.exp(steps))


def wander(rng, metres, speed=0.5, rate=10.0, half_width=5.0, start=(0.0, 0.0, 0.0)) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps and true poses of a path between random goals in a square about the origin, turning smoothly."""
    x, y, theta = start
    goal, twists = rng.uniform(-half_width, half_width, 2), []
    for _ in range(int(metres / speed * rate)):
        if hypot(goal[0] - x, goal[1] - y) < 0.5:
            goal = rng.uniform(-half_width, half_width, 2)
        ahead = remainder(atan2(goal[1] - y, goal[0] - x) - theta, tau)
        turn = min(max(2.0 * ahead, -1.0), 1.0) / rate
        twists.append((speed / rate, 0.0, turn))
        x, y, theta = x + speed / rate * cos(theta + turn / 2), y + speed / rate * sin(theta + turn / 2), theta + turn
    return np.arange(len(twists) + 1) / rate, chain(np.array(start, dtype=float), se2.exp(np.array(twists)))


def chain(start, motion) -> np.ndarray:
    """Return the poses (n + 1, 3) reached from a start by motions (n, 3)."""
    theta = start[2] + np.concatenate([[0.0], np.cumsum(motion[:, 2])])
    shift = np.cumsum(se2.rotate(theta[:-1], motion[:, :2]), axis=0)
    return np.column_stack([start[:2] + np.concatenate([np.zeros((1, 2)), shift]), se2.wrap_angle(theta)])


def odometry(stamps, truth, rng=None, scale=1.0, turn_scale=1.0, drift=0.0, noise=0.0, turn_noise=0.0) -> Odometry:
    """Return what wheels report of a true motion.

    scale, turn_scale : said / true. drift : rad per metre. noise, turn_noise : m and rad per square root of a metre.
    """
    motion = se2.between(truth[:-1], truth[1:])
    length = np.hypot(motion[:, 0], motion[:, 1])
    stated = motion * [scale, scale, turn_scale]
    stated[:, 2] += drift * length
    if rng is not None:
        stated += rng.standard_normal(stated.shape) * np.sqrt(length)[:, None] * [noise, noise, turn_noise]
    return Odometry(stamps, chain(np.zeros(3), stated))


def ranges(
    rng, stamps, truth, anchors, rate=2.0, sigma=0.05, bias=None, outliers=0.0, tag=(0.0, 0.0), in_reach=None
) -> UwbRanges:
    """Return ranges to anchors (a, 2), one at a time round robin, stamped between the poses.

    bias : (a,) m. outliers : share of the ranges that are 0.5 to 5 m long or short. in_reach : (a, 2) s, first and last time.
    """
    count = int((stamps[-1] - stamps[0]) * rate * len(anchors))
    times = np.sort(rng.uniform(stamps[0], stamps[-1], count))
    which = np.arange(count) % len(anchors)
    if in_reach is not None:
        audible = (times >= np.asarray(in_reach)[which, 0]) & (times <= np.asarray(in_reach)[which, 1])
        times, which = times[audible], which[audible]
    place = se2.transform(se2.interpolate_trajectory(stamps, truth, times), np.asarray(tag))
    distance = np.hypot(*(place - anchors[which]).T) + sigma * rng.standard_normal(len(times))
    distance += 0.0 if bias is None else np.asarray(bias)[which]
    outlying = rng.random(len(times)) < outliers
    distance[outlying] += (rng.uniform(0.5, 5.0, len(times)) * np.where(rng.random(len(times)) < 0.8, 1.0, -1.0))[outlying]
    used, index = np.unique(which, return_inverse=True)
    ids = tuple(f"A{k:02d}" for k in used)
    return UwbRanges(times, index.astype(np.intp), np.maximum(distance, 0.0), np.full(len(times), 100.0), ids)


def cast(poses, bearings, walls) -> np.ndarray:
    """Return the distance (n,) from laser poses (n, 3) along bearings (n,), rad, to the nearest wall (w, 4); inf = none."""
    origin, angle = poses[:, :2], poses[:, 2] + bearings
    ray = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    nearest = np.full(len(poses), np.inf)
    for x1, y1, x2, y2 in walls:
        along, ahead = np.array([x2 - x1, y2 - y1]), np.array([x1, y1]) - origin
        cross = ray[:, 0] * along[1] - ray[:, 1] * along[0]
        safe = np.where(np.abs(cross) > 1e-12, cross, np.nan)
        t = (ahead[:, 0] * along[1] - ahead[:, 1] * along[0]) / safe
        u = (ahead[:, 0] * ray[:, 1] - ahead[:, 1] * ray[:, 0]) / safe
        nearest = np.where((t > 0) & (u >= 0) & (u <= 1) & (t < nearest), t, nearest)
    return nearest


def scans(
    stamps,
    truth,
    walls,
    rate=5.0,
    beams=180,
    fov=2 * np.pi,
    sweep=0.1,
    range_max=20.0,
    noise=0.0,
    rng=None,
    mounting=NOMINAL,
) -> LaserScans:
    """Return scans of walls, every ray cast from where the laser is at the ray's own time."""
    times = np.arange(stamps[0], stamps[-1] - sweep, 1.0 / rate)
    step, increment = fov / beams, sweep / beams
    rays = times[:, None] + increment * np.arange(beams)
    base = se2.interpolate_trajectory(stamps, truth, rays.ravel())
    bearings = np.tile(-fov / 2 + step * np.arange(beams), len(times)) * (-1.0 if mounting.laser_flipped else 1.0)
    distance = cast(se2.compose(base, mounting.T_base_laser), bearings, walls)
    if rng is not None:
        distance = distance + noise * rng.standard_normal(len(distance))
    distance = np.where(distance > range_max, np.inf, distance).reshape(len(times), beams)
    return LaserScans(times, distance.astype(np.float32), -fov / 2, step, increment, 0.05, range_max)


def recording(stated, radio=None, lidar=None, mounting=NOMINAL) -> SensorLog:
    """Return the parts as one recording."""
    return SensorLog(stated, radio, lidar, mounting)


def box(width, height) -> np.ndarray:
    """Return the four walls (4, 4) of a room about the origin."""
    w, h = width / 2, height / 2
    return np.array([[-w, -h, w, -h], [w, -h, w, h], [w, h, -w, h], [-w, h, -w, -h]])


def aligned_error(estimate, truth, mirrored=False) -> float:
    """Return the root mean square distance (m) between positions (n, 2) after the best rigid motion (or its mirror image)."""
    p = estimate - estimate.mean(axis=0)
    q = truth - truth.mean(axis=0)
    if mirrored:
        p = p * [1.0, -1.0]
    angle = np.arctan2(np.sum(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]), np.sum(p * q))
    return float(np.sqrt(np.mean(np.sum((se2.rotate(angle, p) - q) ** 2, axis=1))))


def surface_points(walls, columns):
    """Return points (n, 2), 2 cm apart or less, on walls (w, 4) of up to 8 m and around columns (c, 3)."""
    share, turn = (np.linspace(0.0, end, 800)[:, None] for end in (1.0, 2.0 * np.pi))
    points = [wall[:2] + share * (wall[2:] - wall[:2]) for wall in walls]
    points += [column[:2] + column[2] * np.hstack([np.cos(turn), np.sin(turn)]) for column in columns]
    return np.concatenate(points)
