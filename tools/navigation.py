#!/usr/bin/env python3
"""A robot drives to goals by the live pose alone, in the simulator; writes docs/navigation.md.

    python tools/navigation.py                      lab and hall, 20 goals each
    python tools/navigation.py --only lab --goals 5 --print

The robot plans in the map of a recording, follows by pure pursuit where it believes to be, and is told nothing else: its wheels
err as the recording's do, it begins at an unknown place, and where it is lost it turns on the spot until it is found. A goal is
reached within 0.10 m of the truth; what it touches and how near it comes to obstacles is measured in the true building.
With the map of the defaults, that of the paper's settings, and by dead reckoning from a start that is told.
"""

import argparse
import sys
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from simulation import laser, radio, wheels
from simulation.fields import smooth_field
from simulation.plans import PLANS
from simulation.recording import Settings
from trials import ROOT, made, table, write_section

from uwblite import se2
from uwblite.errors import UwbliteError
from uwblite.evaluation.trajectory import evaluate_trajectory
from uwblite.io.result_text import RunRecord
from uwblite.io.results import write_result
from uwblite.io.stored_result import StoredResult, read_result
from uwblite.localization import Localizer, Scanner
from uwblite.localization.known_map import KnownMap, from_result
from uwblite.mapping import build_map
from uwblite.navigation.planner import Planner, make_planner
from uwblite.pipeline.mapping_config import preset
from uwblite.sensor_log import SensorMounting

WORLDS = {"lab": 10.0, "hall": 20.0}
"""Minutes of the recording that the map is made of."""
BUILDING = 7
RADIUS = 0.2
"""m, of the robot."""
MARGIN = 0.1
"""m that plans keep beyond it: what map, pose and pursuit are off by."""
NEAR = 0.10
"""m of the truth within which a goal is reached."""
STEP, SCAN_EVERY, RANGE_EVERY = 0.05, 4, 40
"""s of a step; steps between scans and between rounds of ranges."""
SPEED, TURN, LOOK = 0.25, 0.8, 0.35
"""m/s, rad/s, m of pure pursuit."""
MOST_SECONDS, MOST_LOST = 240.0, 60.0
"""s for a goal, and of being lost before it is given up."""


@dataclass
class Robot:
    """A robot in the true building."""

    world: str
    seed: int
    pose: np.ndarray
    odometry: np.ndarray = field(default_factory=lambda: np.zeros(3))
    stamp: float = 0.0

    def __post_init__(self) -> None:
        self.plan, self.settings = PLANS[self.world](), Settings(world=self.world, building=BUILDING)
        self.rng = np.random.default_rng([self.seed, 77])
        self.faults = wheels.draw_errors(self.rng, 1.0)
        model = self.settings.laser
        surfaces = len(self.plan.walls) + len(self.plan.columns)
        self.colour = model.surface_sd * np.random.default_rng([BUILDING, 1005]).standard_normal(surfaces)
        bias = np.random.default_rng([BUILDING, 1006]).standard_normal(len(self.plan.anchors))
        self.bias = self.settings.radio.bias_sd * bias
        self.speed = self.turn = 0.0

    def drive(self, speed: float, turn: float) -> None:
        """Drive for a step, as fast as wheels can change their speed."""
        self.speed += float(np.clip(speed - self.speed, -0.5 * STEP, 0.5 * STEP))
        self.turn += float(np.clip(turn - self.turn, -2.0 * STEP, 2.0 * STEP))
        way, angle = self.speed * STEP, self.turn * STEP
        self.pose = se2.compose(self.pose, se2.exp([way, 0.0, angle]))
        f = self.faults
        stated = f.distance_scale * way + f.distance_noise * np.sqrt(abs(way)) * self.rng.standard_normal()
        noise = np.sqrt(f.heading_noise_travel**2 * abs(way) + f.heading_noise_turn**2 * abs(angle))
        told = f.heading_scale * angle + f.drift * way + noise * self.rng.standard_normal()
        self.odometry = se2.compose(self.odometry, se2.exp([stated, 0.0, told]))
        self.stamp += STEP

    def clearance(self) -> float:
        """Return how far the robot's rim is from the nearest obstacle, m; below 0 it touches."""
        a, e = self.plan.walls[:, :2], self.plan.walls[:, 2:] - self.plan.walls[:, :2]
        along = np.clip(((self.pose[:2] - a) * e).sum(axis=1) / np.maximum((e * e).sum(axis=1), 1e-12), 0.0, 1.0)
        walls = np.hypot(*(a + along[:, None] * e - self.pose[:2]).T)
        columns = np.hypot(*(self.plan.columns[:, :2] - self.pose[:2]).T) - self.plan.columns[:, 2]
        return float(min(walls.min(initial=np.inf), columns.min(initial=np.inf))) - RADIUS

    def scan(self) -> np.ndarray:
        """Return the readings of a sweep that ends now, m."""
        model = self.settings.laser
        back = -model.time_increment * np.arange(model.beams)[::-1]
        poses = se2.compose(self.pose, se2.exp(np.stack([self.speed * back, 0.0 * back, self.turn * back], axis=1)))
        mount = np.asarray(self.settings.laser_pose)
        origin = poses[:, :2] + se2.rotate(poses[:, 2], np.broadcast_to(mount[:2], (model.beams, 2)))
        walls, columns = laser.near(self.plan.walls, self.plan.columns, self.pose[:2], model.max_range + 0.5)
        ids = np.concatenate([walls, len(self.plan.walls) + columns, [-1]])
        angles = poses[:, 2] + mount[2] + model.angles
        true, cosine, surface = laser.cast(origin, angles, self.plan.walls[walls], self.plan.columns[columns], model.max_range)
        stated = laser.disturb(true[None], cosine[None], ids[surface][None], model, self.colour, self.rng)[0] * 0.001
        return np.where(stated >= model.max_range, np.inf, np.where(stated < model.min_range, np.nan, stated))

    def ranges(self) -> tuple[list[str], list[float]]:
        """Return a round of ranges."""
        model, place = self.settings.radio, se2.transform(self.pose, np.asarray(self.settings.tag))
        names, values = [], []
        for a, anchor in enumerate(self.plan.anchors):
            there = np.random.default_rng([BUILDING, 1200 + a])
            alike = model.multipath_sd * smooth_field(there, place[None], model.multipath_length)[0]
            shadow = self.plan.opacity * radio.crossings(place[None], anchor, self.plan.walls, self.plan.columns)
            extra, lost = radio.excess(shadow, place[None], "normal", self.rng, there)
            if not lost[0] and self.rng.random() >= model.loss:
                names.append(self.plan.anchor_ids[a])
                noise = model.noise_sd * self.rng.standard_normal()
                values.append(float(np.hypot(*(anchor - place)) + self.bias[a] + alike + extra[0] + noise))
        return names[: model.per_epoch], values[: model.per_epoch]


@dataclass
class Tally:
    """What became of the goals."""

    goals: int = 0
    reached: int = 0
    touched: int = 0
    lost: int = 0
    recovered: int = 0
    errors: list[float] = field(default_factory=list)
    nearest: float = np.inf


class Driver:
    """Follows planned paths by a pose that it is told.

    Parameters
    ----------
    known : the map; None = dead reckoning from a pose in the map that is told.
    """

    def __init__(self, robot: Robot, planner: Planner, T_truth_map: np.ndarray, known: KnownMap | None) -> None:
        self.robot, self.planner, self.T_truth_map = robot, planner, T_truth_map
        model = robot.settings.laser
        scanner = Scanner(float(model.angles[0]), model.increment, model.time_increment, model.min_range, model.max_range)
        mounting = SensorMounting(np.asarray(robot.settings.laser_pose), tag_position=np.array([*robot.settings.tag, 0.0]))
        self.localizer = None if known is None else Localizer(known, mounting, scanner)
        start = se2.compose(se2.inverse(T_truth_map), robot.pose)
        self.T_map_odom = se2.compose(start, se2.inverse(robot.odometry))
        self.steps = 0

    def step(self, speed: float, turn: float) -> tuple[np.ndarray, bool]:
        """Drive for a step and return the pose (3,) in the map, and whether it is lost."""
        self.robot.drive(speed, turn)
        self.steps += 1
        if self.localizer is None:
            return se2.compose(self.T_map_odom, self.robot.odometry), False
        state = self.localizer.add_odometry(self.robot.stamp, *self.robot.odometry)
        if self.steps % SCAN_EVERY == 0:
            model = self.robot.settings.laser
            begin = self.robot.stamp - model.time_increment * (model.beams - 1)
            state = self.localizer.add_scan(begin, self.robot.scan())
        if self.steps % RANGE_EVERY == 0:
            state = self.localizer.add_ranges(self.robot.stamp, *self.robot.ranges())
        return state.pose, state.lost

    def find(self) -> np.ndarray | None:
        """Turn on the spot, and where that does not help drive ahead where there is room, until the pose is known."""
        for k in range(int(MOST_LOST / STEP)):
            ahead = k * STEP > 15.0 and self.robot.clearance() > 0.4
            pose, lost = self.step(0.15 if ahead else 0.0, 0.1 if ahead else 0.5)
            if not lost:
                return pose
        return None

    def go(self, goal: np.ndarray, tally: Tally) -> None:
        """Drive to a goal (2,) in the map."""
        tally.goals += 1
        pose, lost = self.step(0.0, 0.0)
        path = np.zeros((0, 2))
        for _ in range(int(MOST_SECONDS / STEP)):
            if lost:
                tally.lost += 1
                found = self.find()
                if found is None:
                    return
                tally.recovered += 1
                pose, path = found, np.zeros((0, 2))
            if not len(path):
                try:
                    path = self.planner.plan(pose, [goal], step=0.05).poses[:, :2]
                except UwbliteError:
                    return
            rest = float(np.hypot(*(goal - pose[:2])))
            if rest < 0.03:
                break
            speed, turn = pursued(path, pose, rest)
            pose, lost = self.step(speed, turn)
            gap = self.robot.clearance()
            tally.nearest = min(tally.nearest, gap)
            if gap < 0.0:
                tally.touched += 1
                return
        true = se2.transform(self.T_truth_map, goal)
        error = float(np.hypot(*(self.robot.pose[:2] - true)))
        tally.errors.append(error)
        tally.reached += error <= NEAR


def pursued(path: np.ndarray, pose: np.ndarray, rest: float) -> tuple[float, float]:
    """Return speed and turn towards the point of a path (n, 2) that lies LOOK ahead (R. Coulter, 1992); slower at the goal."""
    near = int(np.argmin(np.hypot(*(path - pose[:2]).T)))
    ahead = np.flatnonzero(np.hypot(*(path[near:] - path[near]).T) >= min(LOOK, 0.5 * rest + 0.05))
    target = path[near + int(ahead[0])] if len(ahead) else path[-1]
    bearing = float(se2.wrap_angle(np.arctan2(*(target - pose[:2])[::-1]) - pose[2]))
    speed = min(SPEED, 0.05 + 0.5 * rest) * max(np.cos(bearing), 0.0) if abs(bearing) < 1.0 else 0.0
    return float(speed), float(np.clip(2.5 * bearing, -TURN, TURN))


@dataclass(frozen=True)
class Ground:
    """A map and where it lies over the building."""

    result: StoredResult
    known: KnownMap
    T_truth_map: np.ndarray


def mapped(world: str, name: str, seed: int = 1) -> Ground:
    """Map a recording with a preset."""
    trial = made(replace(Settings(world=world, building=BUILDING, seed=seed), minutes=WORLDS[world], scan_rate=5.0))
    made_of = build_map(trial.log, preset(name))
    with tempfile.TemporaryDirectory(prefix="uwblite-") as folder:
        write_result(Path(folder) / "map", [trial.log], made_of, RunRecord("tools/navigation.py", ""))
        result = read_result(Path(folder) / "map")
    path = evaluate_trajectory(made_of.stamps, made_of.trajectory, trial.stamps, trial.poses)
    return Ground(result, from_result(result), path.T_truth_map)


def driven(ground: Ground, world: str, goals: int, dead_reckoning: bool, seed: int = 5) -> Tally:
    """Drive to so many goals, one after the other."""
    assert ground.result.grid is not None
    planner = make_planner(ground.result.grid, RADIUS + MARGIN)
    rng = np.random.default_rng(seed)
    start = np.asarray(PLANS[world]().start)
    robot = Robot(world, seed, start + np.array([0.0, 0.0, rng.uniform(-3.0, 3.0)]))
    driver, tally = Driver(robot, planner, ground.T_truth_map, None if dead_reckoning else ground.known), Tally()
    rows, cols = np.divmod(planner.nodes, planner.clearance.geometry.cols)
    places = planner.clearance.geometry.centre_of(rows, cols)
    here = se2.transform(se2.inverse(ground.T_truth_map), robot.pose[:2])
    reachable = _reachable(planner, here)
    for _ in range(goals):
        goal = places[reachable[rng.integers(len(reachable))]]
        before = tally.touched
        driver.go(goal, tally)
        if tally.touched > before:
            # Somebody puts it back to where it may stand, which it is not told.
            robot.pose, robot.speed, robot.turn = start.copy(), 0.0, 0.0
    return tally


def _reachable(planner: Planner, here: np.ndarray) -> np.ndarray:
    """Return the nodes that can be reached from a place."""
    from scipy.sparse.csgraph import connected_components

    _, label = connected_components(planner.graph, directed=False)
    g = planner.clearance.geometry
    rows, cols = np.divmod(planner.nodes, g.cols)
    near = int(np.argmin(np.hypot(*(g.centre_of(rows, cols) - here).T)))
    return np.flatnonzero(label == label[near])


VARIANTS = (
    ("map of the defaults", "default", False),
    ("map of the paper's settings", "paper", False),
    ("dead reckoning", "default", True),
)
"""Name, preset of the map, and whether the pose is dead reckoning."""


def main(argv: list[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default=",".join(WORLDS), help="worlds, separated by commas")
    parser.add_argument("--goals", type=int, default=20)
    parser.add_argument("--print", action="store_true", help="write nothing")
    args = parser.parse_args(argv)
    rows = []
    for world in args.only.split(","):
        for label, name, dead in VARIANTS:
            tally = driven(mapped(world, name), world, args.goals, dead)
            errors = np.array(tally.errors or [np.nan])
            rows.append([world, label, f"{tally.reached} of {tally.goals}", float(np.median(errors)), float(errors.max()),
                         tally.nearest, tally.touched, tally.lost, tally.recovered])  # fmt: skip
            print(*rows[-1], flush=True)
    head = ("world", "pose by", "reached within 0.10 m", "error at the goal, median, m", "worst, m", "nearest obstacle, m",
            "touched", "lost", "found again")  # fmt: skip
    text = table(head, rows)
    print(text)
    if not args.print:
        write_section(ROOT / "docs" / "navigation.md", "closed loop", text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
