#!/usr/bin/env python3
"""A robot drives to goals by the live pose alone, in the simulator; writes docs/lab/localization.md.

    python tools/navigation.py                      lab, hall, warehouse and arena, 20 goals each
    python tools/navigation.py --only lab --goals 5 --print
    python tools/navigation.py --keep grounds       maps and recordings are kept there and used again

The robot plans in the map of a recording, follows by pure pursuit from its estimated pose, and gets nothing else: its wheels
err as the recording's do, people walk about, it begins at an unknown place, and where it is lost it turns on the spot until it
is found. A goal is reached within 0.10 m of the truth; what it touches and how near it comes to obstacles is measured in the
true building. With the map of the defaults, that of the paper's settings, and by dead reckoning from a given start.
"""

import one_thread  # noqa: F401

import argparse
import sys
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from grounds import Ground, Place, mapped
from simulation import real_rooms, wheels
from simulation.drive import Motion
from simulation.plans import PLANS
from simulation.recording import people, picked, ranged, scene_of, swept
from trials import ROOT, table, write_section

from uwblite import se2
from uwblite.errors import UwbliteError
from uwblite.localization import Localizer, Scanner
from uwblite.localization.known_map import KnownMap
from uwblite.navigation.clearance import clearance_map
from uwblite.navigation.planner import Planner, make_planner
from uwblite.sensor_log import SensorMounting

WORLDS = ("lab", "hall", "warehouse", "arena")
PEOPLE = 2
"""Who walk about besides those of real rooms."""
WALKED = 1800.0
"""s after which the people begin their walks again."""
RADIUS = 0.2
"""m, of the robot."""
MARGIN = 0.1
"""m that plans keep beyond it: what map, pose and pursuit are off by."""
NEAR = 0.10
"""m of the truth within which a goal is reached."""
CLOSE = 0.03
"""m from a goal, by its own pose, from which the robot stops as soon as it comes no nearer."""
STEP, SCAN_EVERY, RANGE_EVERY = 0.05, 4, 40
"""s of a step; steps between scans and between rounds of ranges."""
SPEED, TURN, LOOK = 0.25, 0.8, 0.35
"""m/s, rad/s, m of pure pursuit."""
MOST_SECONDS, MOST_LOST = 240.0, 60.0
"""s for a goal, and of being lost before it is given up."""
IN_VAIN = 3
"""Searches in vain after which a robot is left where it is: the goals that remain count as not reached."""
ROOMY = 1.0
"""m from obstacles and unknown space where a robot begins."""
NEAREST, FARTHEST = 2.0, 12.0
"""m between one goal and the next."""


class Robot:
    """A robot in the true building.

    Parameters
    ----------
    place : the building, and the recording of which its map is made. seed : of the noise. pose : (3,) where it begins.
    """

    def __init__(self, place: Place, seed: int, pose: np.ndarray) -> None:
        self.plan, self.settings = PLANS[place.world](), replace(place.settings, seed=seed, people=PEOPLE)
        self.pose, self.odometry, self.stamp = pose, np.zeros(3), 0.0
        self.speed = self.turn = 0.0
        self._noise: dict[int, np.random.Generator] = {}
        rooms = self.settings.rooms
        self.faults = wheels.draw_errors(self._draw(1), 1.0 if rooms is None else rooms.wheels)
        self.crowd = people(self.settings, self.plan, WALKED)
        self.scene = scene_of(self.settings, self.plan, self.crowd, self._draw(5))
        self._last: deque[tuple[float, np.ndarray]] = deque([(0.0, pose)], maxlen=4)

    def _draw(self, part: int) -> np.random.Generator:
        """Return the generator of a part of the noise, which goes on where it was."""
        return self._noise.setdefault(part, np.random.default_rng([self.settings.seed, part]))

    def put(self, pose: np.ndarray) -> None:
        """Set it down elsewhere, which its wheels do not notice."""
        self.pose, self.speed, self.turn = pose, 0.0, 0.0
        self._last.clear()
        self._last.append((self.stamp, pose))

    def drive(self, speed: float, turn: float) -> None:
        """Drive for a step, as fast as wheels can change their speed."""
        self.speed += float(np.clip(speed - self.speed, -0.5 * STEP, 0.5 * STEP))
        self.turn += float(np.clip(turn - self.turn, -2.0 * STEP, 2.0 * STEP))
        before, way, angle = self.pose, self.speed * STEP, self.turn * STEP
        self.pose = before + np.array([*se2.rotate(before[2] + 0.5 * angle, np.array([way, 0.0])), angle])
        ends = np.array([self.stamp, self.stamp + STEP])
        motion, rooms, floor = Motion(ends, np.stack([before, self.pose])), self.settings.rooms, None
        if rooms is not None:
            there = np.random.default_rng([self.settings.building, 1011])
            floor = real_rooms.floor_errors(rooms, before[None, :2], np.array([abs(way)]), there, self._draw(12))
        step = wheels.odometry(motion, ends, self.faults, [], self._draw(3), floor)[1]
        self.odometry = se2.compose(self.odometry, step)
        self.stamp += STEP
        self._last.append((self.stamp, self.pose))

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
        times = self.stamp - model.time_increment * np.arange(model.beams)[::-1]
        stamps, poses = (np.array(v) for v in zip(*self._last, strict=True))
        scene = replace(self.scene, crowd=self._walks())
        millimetres = swept(scene, times[:1], times, Motion(stamps, poses).at(times), self._draw(5))[0][0]
        stated = 0.001 * millimetres
        return np.where(stated >= model.max_range, np.inf, np.where(stated < model.min_range, np.nan, stated))

    def ranges(self) -> tuple[list[str], list[float]]:
        """Return a round of ranges."""
        now, settings = np.array([self.stamp]), self.settings
        measured = ranged(settings, self.plan, self.plan.anchors, now, self.pose[None], self._walks(), self._draw)
        anchors = picked(*measured[1:], settings.radio.per_epoch, self._draw(8))[1]
        return [self.plan.anchor_ids[a] for a in anchors], np.maximum(measured[0][0, anchors], 0.0).tolist()

    def _walks(self) -> list[Motion]:
        """Return the walks of the people, moved to the round of theirs that it is now."""
        return [replace(walk, stamps=walk.stamps + WALKED * (self.stamp // WALKED)) for walk in self.crowd]


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
    """Follows planned paths by a given pose.

    Parameters
    ----------
    known : the map; None = dead reckoning from a given pose in the map.
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
        path, rest = np.zeros((0, 2)), np.inf
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
                except UwbliteError as why:
                    print(f"goal {tally.goals} is given up: {why}", file=sys.stderr, flush=True)
                    return
            before, rest = rest, float(np.hypot(*(goal - pose[:2])))
            if rest < CLOSE and rest >= before:
                break
            speed, turn = pursued(path, pose, rest)
            pose, lost = self.step(speed, turn)
            gap = self.robot.clearance()
            tally.nearest = min(tally.nearest, gap)
            if gap < 0.0:
                tally.touched += 1
                return
        else:
            print(f"goal {tally.goals} is given up: not reached in {MOST_SECONDS:.0f} s", file=sys.stderr, flush=True)
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


def driven(ground: Ground, place: Place, goals: int, dead_reckoning: bool, seed: int = 5) -> Tally:
    """Drive to so many goals, one after the other."""
    assert ground.result.grid is not None
    planner = make_planner(ground.result.grid, RADIUS + MARGIN)
    rng = np.random.default_rng(seed)
    places = _free_places(planner)
    origin = se2.transform(se2.inverse(ground.T_truth_map), np.asarray(PLANS[place.world]().start)[:2])
    roomy = places[clearance_map(ground.result.grid, ROOMY).bounds(places) >= ROOMY**2]
    here = roomy[np.argmin(np.hypot(*(roomy - origin).T))]
    start = np.array([*se2.transform(ground.T_truth_map, here), rng.uniform(-3.0, 3.0)])
    robot = Robot(place, seed, start)
    driver, tally = Driver(robot, planner, ground.T_truth_map, None if dead_reckoning else ground.known), Tally()
    for goal in _goals(places, here, rng, goals):
        before = tally.touched
        if tally.lost - tally.recovered == IN_VAIN:
            tally.goals += 1
            continue
        driver.go(goal, tally)
        if tally.touched > before:
            # Somebody puts it back to where it may stand; the estimator gets no word of it.
            robot.put(start.copy())
    return tally


def _goals(places: np.ndarray, here: np.ndarray, rng: np.random.Generator, count: int) -> Iterator[np.ndarray]:
    """Yield goals (2,) among places (n, 2), each NEAREST to FARTHEST m from the one before."""
    for _ in range(count):
        away = np.hypot(*(places - here).T)
        some = np.flatnonzero((away >= NEAREST) & (away <= FARTHEST))
        here = places[some[rng.integers(len(some))]]
        yield here


def _free_places(planner: Planner) -> np.ndarray:
    """Return the places (n, 2), m, map frame, of the largest part of the map in which the robot can drive about."""
    from scipy.sparse.csgraph import connected_components

    nodes = planner.steps.nodes()
    _, label = connected_components(planner.steps.graph(nodes), directed=False)
    return planner.steps.places(nodes)[label == np.bincount(label).argmax()]


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
    parser.add_argument("--seed", type=int, default=301)
    parser.add_argument("--building", type=int, default=31, help="range offsets of walls, glass, multipath, biases of anchors")
    parser.add_argument("--easy", action="store_true", help="rooms without the errors of real ones")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep maps and recordings, and use those that are there")
    parser.add_argument("--print", action="store_true", help="write nothing")
    args = parser.parse_args(argv)
    rows = []
    for world in args.only.split(","):
        for label, name, dead in VARIANTS:
            place = Place(world, args.building, args.seed, args.easy)
            tally = driven(mapped(place, name, args.keep), place, args.goals, dead)
            errors, nearest = np.array(tally.errors or [np.nan]), tally.nearest if np.isfinite(tally.nearest) else np.nan
            rows.append([world, label, f"{tally.reached} of {tally.goals}", float(np.median(errors)), float(errors.max()),
                         nearest, tally.touched, tally.lost, tally.recovered])  # fmt: skip
            print(*rows[-1], flush=True)
    head = ("world", "pose by", "reached within 0.10 m", "error at the goal, median, m", "worst, m", "nearest obstacle, m",
            "touched", "lost", "found again")  # fmt: skip
    text = table(head, rows)
    print(text)
    if not args.print:
        write_section(ROOT / "docs" / "lab" / "localization.md", "closed loop", text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
