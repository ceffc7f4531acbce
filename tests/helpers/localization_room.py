"""A room with known walls and anchors, and a robot that drives through it: what a live localisation is tested with."""

from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np

from uwblite import se2
from uwblite.grid.geometry import GridGeometry
from uwblite.grid.occupancy_grid import OccupancyGrid
from uwblite.io.stored_result import StoredAnchor
from uwblite.localization import Localizer, Scanner
from uwblite.localization.known_map import KnownMap, known_anchors
from uwblite.localization.walls import walls_of
from uwblite.sensor_log import SensorMounting

CELL = 0.05
SCANNER = Scanner(-np.pi / 2, np.pi / 180, 0.0, 0.02, 8.0)
ODD = ((0, 0, 8, 0), (8, 0, 8, 6), (8, 6, 0, 6), (0, 6, 0, 0), (2, 0, 2, 1.5), (5, 6, 5, 4.5), (5, 4.5, 6, 4.5))
"""Walls x1, y1, x2, y2, m: no turn or mirror takes them onto themselves."""
EVEN = ODD[:4]
"""A rectangle: half a turn does."""
ANCHORS = {"A": (0.3, 0.4), "B": (7.6, 0.5), "C": (7.2, 5.6), "D": (0.5, 5.3)}


def grid_of(walls, origin=(-1.025, -1.025), size=(10.05, 8.05), cell=CELL):
    """Return the grid in which the walls are drawn one cell thick and all within the rectangle is free."""
    geometry = GridGeometry(cell, np.asarray(origin, dtype=float), round(size[1] / cell), round(size[0] / cell))
    x, y = geometry.centre_of(*np.indices((geometry.rows, geometry.cols))).transpose(2, 0, 1)
    odds = np.where((x > 0) & (x < 8) & (y > 0) & (y < 6), -4.0, 0.0)
    for x1, y1, x2, y2 in walls:
        along = np.linspace([x1, y1], [x2, y2], 2000)
        row, col = geometry.cell_of(along)
        odds[row, col] = 4.0
    return OccupancyGrid(geometry, odds.astype(np.float32))


def known_map(anchors, grid):
    """Return a map of anchors and a grid alone, with the laser's mounting from recordings."""
    return KnownMap(known_anchors(anchors, {}), None if grid is None else walls_of(grid), np.zeros(3))


def known(walls=ODD, anchors=ANCHORS):
    """Return the room as a localisation knows it."""
    stored = tuple(StoredAnchor(n, np.array(p, dtype=float), np.eye(2) * 1e-4, "ok", 0.0, 0.05) for n, p in anchors.items())
    return KnownMap(known_anchors(stored, {}), None if walls is None else drawn(walls), np.zeros(3))


@cache
def drawn(walls):
    """Return the walls as a localisation looks them up."""
    return walls_of(grid_of(walls))


def cast(pose, walls=ODD):
    """Return the readings of a scan from a pose (3,), m."""
    angle = pose[2] + SCANNER.angle_min + SCANNER.angle_increment * np.arange(181)
    best = np.full(len(angle), np.inf)
    for x1, y1, x2, y2 in walls:
        e, a = np.array([x2 - x1, y2 - y1]), np.array([x1, y1]) - pose[:2]
        cross = np.cos(angle) * e[1] - np.sin(angle) * e[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (a[0] * e[1] - a[1] * e[0]) / cross
            u = (a[0] * np.sin(angle) - a[1] * np.cos(angle)) / cross
        best = np.where((t > 0) & (u >= 0) & (u <= 1) & (t < best), t, best)
    return np.where(best < SCANNER.range_max, best, np.inf)


def path(points, speed=0.4, rate=5.0):
    """Return poses (n, 3) along corners (k, 2), turning on the spot at 1 rad/s."""
    poses = []
    heading = None
    for a, b in pairwise(points):
        a, b = np.array(a, dtype=float), np.array(b, dtype=float)
        course = float(np.arctan2(*(b - a)[::-1]))
        if heading is not None:
            turn = float(se2.wrap_angle(course - heading))
            steps = max(int(abs(turn) * rate), 1)
            poses += [[*a, heading + turn * k / steps] for k in range(1, steps)]
        steps = int(np.hypot(*(b - a)) / speed * rate)
        poses += [[*(a + (b - a) * k / steps), course] for k in range(steps)]
        heading = course
    return np.array(poses)


ROUND = ((1.0, 2.5), (3.5, 2.5), (3.5, 5.0), (1.5, 5.0), (1.5, 3.0), (6.5, 3.0), (6.5, 1.0), (4.0, 1.0))


@dataclass
class Drive:
    """A robot that drives and measures."""

    localizer: Localizer
    walls: tuple = ODD
    anchors: dict = None
    noise: float = 0.01
    stamp: float = 100.0
    odom: np.ndarray = None
    laser_turn: float = 0.0
    """rad, by which the laser is mounted otherwise than stated."""

    def __post_init__(self):
        self.rng = np.random.default_rng(3)
        self.anchors = ANCHORS if self.anchors is None else self.anchors
        self.odom = np.array([5.0, -7.0, 2.0]) if self.odom is None else self.odom
        self.last = None
        self.states = []

    def along(self, poses, scans=True, ranges=True, every=1):
        """Drive along poses (n, 3), a fifth of a second each; return the states after each.

        Parameters
        ----------
        every : which of the poses the odometry reports; the last one is always among them.
        """
        states = []
        for k, pose in enumerate(poses):
            if self.last is not None:
                self.odom = se2.compose(self.odom, se2.between(self.last, pose) * [1.01, 1.0, 1.0])
            self.last = pose
            state = self.localizer.state()
            if (len(poses) - 1 - k) % every == 0:
                state = self.localizer.add_odometry(self.stamp, *self.odom)
            if scans and self.walls:
                readings = cast(pose + np.array([0.0, 0.0, self.laser_turn]), self.walls) + self.rng.normal(0, self.noise, 181)
                state = self.localizer.add_scan(self.stamp, readings, SCANNER)
            if ranges and k % 5 == 0:
                names = sorted(self.anchors)
                true = [np.hypot(*(np.array(self.anchors[n]) - pose[:2])) for n in names]
                state = self.localizer.add_ranges(self.stamp, names, true + self.rng.normal(0, 3 * self.noise, len(true)))
            self.stamp += 0.2
            states.append(state)
        self.states += states
        return states

    def carried(self):
        """Lift the robot: its wheels do not turn."""
        self.last = None


def robot(room, **more):
    """Return a robot that knows nothing but the room."""
    return Drive(Localizer(room, SensorMounting()), **more)


def errors(states, poses):
    """Return the distances (n,) of the states from the truth, m; inf where there is none."""
    found = np.array([s.pose for s in states])
    return np.where(np.isnan(found[:, 0]), np.inf, np.hypot(*(found - poses)[:, :2].T))
