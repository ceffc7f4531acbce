#!/usr/bin/env python3
"""How a live localisation starts, tracks and recovers in maps of other recordings; writes docs/lab/localization.md.

    python tools/localization.py                          four worlds, three buildings each: an hour
    python tools/localization.py --only lab --starts 10   a part of it
    python tools/localization.py --keep grounds            maps and recordings are kept there and used again
    python tools/localization.py --print                  nothing written

A map is made of one simulated recording, a second recording of another path of another robot, from another day, is played
against it, in rooms with the errors of real ones (simulation/real_rooms.py): patches of floor and bumps, a radio whose errors
stay with places and directions, glass, people who walk about, an operator who stops. The lidar loses a sixth of its returns by
range, angle and paint, and the second robot's is mounted 0.012 rad otherwise than stated (not with --whole).
Starts: so many moments of the second recording at which the robot is within the map, nothing known; a start that is found more
than 0.5 m or 0.3 rad off the truth is a wrong one. Errors are in the map's frame as it lies over the building: the map's own
errors are in them.
"""

import one_thread  # noqa: F401

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from grounds import Place, mapped, played
from scipy.stats import chi2
from trials import ROOT, Trial, table, write_section

from uwblite import se2
from uwblite.grid.geometry import GridGeometry
from uwblite.grid.occupancy_grid import FREE, OccupancyGrid
from uwblite.localization import Localizer, LocalizerState, Scanner
from uwblite.localization.comparison import LOOK_BACK
from uwblite.localization.hypotheses import apart
from uwblite.localization.known_map import KnownMap
from uwblite.localization.range_model import expected_errors, range_likelihood
from uwblite.localization.walls import INDEPENDENT_RAYS, walls_of

WORLDS = ("hall", "lab", "corridor", "warehouse")
BUILDINGS = "83,91,97"
"""None of them was used to choose a setting."""
MOST_WAY = 10.0
"""m of driving in which a start should be found."""
WRONG = (0.5, 0.3)
"""m and rad; a pose that counts as found and is farther off is a wrong one."""
BEFORE = 40.0
"""s of driving before a robot is carried away, in which it is found and has tracked its pose: eight metres."""
WRONG_SECONDS = 40.0
"""s of each drive in a map that is not the building's."""
WANTED = 2.0
"""m of driving within which a start should be certain."""
STEPS, FAINT = (0.1, 0.05), 14.0
"""m and rad between poses of the exhaustive comparison; log-likelihood by which ranges of a pose may be worse than the best."""
ELSEWHERE = {"hall": "lab", "lab": "hall", "warehouse": "lab", "corridor": "lab"}
"""The other building."""
OTHER_TAG = 0.12
"""m, standard deviation of the delays of another tag."""
AFTER = 3.0
"""s for which a start, or a robot that was carried away, is watched after it was found."""
RECOVERED, WATCHED = 10.0, 40.0
"""s in which a robot that was carried away should be found, and for which it is watched."""


@dataclass(frozen=True)
class Bench:
    """A map and another recording in the same building."""

    world: str
    building: int
    known: KnownMap
    T_truth_map: np.ndarray
    """(3,)."""
    trial: Trial

    def played(self, start: float, end: float, uwb: bool = True, lidar: bool = True) -> Iterator[tuple[float, int, int]]:
        """Yield (time of arrival, sensor, row) of the measurements between two times, s, as they would come in."""
        log = self.trial.log
        rows = [(log.odometry.stamps, 0, 0.0)]
        if uwb:
            rows.append((log.ranges.stamps, 1, 0.0))
        if lidar:
            rows.append((log.scans.stamps, 2, log.scans.time_increment * (log.scans.ranges.shape[1] - 1)))
        found = [(t + late, kind, k) for stamps, kind, late in rows for k, t in enumerate(stamps) if start <= t < end]
        return iter(sorted(found))

    def localizer(self) -> Localizer:
        """Return one that knows nothing but the map."""
        s = self.trial.log.scans
        scanner = Scanner(s.angle_min, s.angle_increment, s.time_increment, s.range_min, s.range_max)
        return Localizer(self.known, self.trial.log.mounting, scanner)

    def feed(self, localizer: Localizer, kind: int, k: int) -> LocalizerState:
        """Hand over one measurement."""
        log = self.trial.log
        if kind == 0:
            return localizer.add_odometry(log.odometry.stamps[k], *log.odometry.poses[k])
        if kind == 1:
            r = log.ranges
            return localizer.add_ranges(r.stamps[k], [r.anchor_ids[r.anchor[k]]], [r.ranges[k]])
        return localizer.add_scan(log.scans.stamps[k], log.scans.ranges[k])

    def truth(self, stamps: np.ndarray) -> np.ndarray:
        """Return the true poses (n, 3) in the map's frame."""
        poses = se2.interpolate_trajectory(self.trial.stamps, self.trial.poses, stamps)
        return se2.compose(se2.inverse(self.T_truth_map), poses)

    def mapped(self, stamps: np.ndarray) -> np.ndarray:
        """Return at which times (n,) the robot is where the map has free space."""
        walls, (x, y) = self.known.walls, self.truth(stamps)[:, :2].T
        return np.ones(len(stamps), bool) if walls is None else walls.state_at(x, y) == FREE

    def errors(self, states: list[LocalizerState]) -> np.ndarray:
        """Return the errors (n, 2) of states, m and rad."""
        off = se2.between(self.truth(np.array([s.stamp for s in states])), np.array([s.pose for s in states]))
        return np.column_stack([np.hypot(off[:, 0], off[:, 1]), np.abs(off[:, 2])])

    def nees(self, states: list[LocalizerState]) -> np.ndarray:
        """Return the squared errors (n,) of states, normalised by their covariances."""
        off = np.array([s.pose for s in states]) - self.truth(np.array([s.stamp for s in states]))
        off[:, 2] = se2.wrap_angle(off[:, 2])
        return np.einsum("ni,ni->n", off, np.linalg.solve(np.array([s.covariance for s in states]), off[:, :, None])[:, :, 0])


def bench(place: Place, keep: Path | None = None) -> Bench:
    """Make the map and the other recording."""
    ground = mapped(place, keep=keep)
    return Bench(place.world, place.building, ground.known, ground.T_truth_map, played(place, keep))


@dataclass(frozen=True)
class Start:
    """What became of a start."""

    way: float
    """m driven until it was found; inf = not within MOST_WAY."""
    wrong: bool


def start(on: Bench, begin: float, uwb: bool = True, lidar: bool = True) -> Start:
    """Begin at a time of the recording, knowing nothing."""
    localizer, states, found = on.localizer(), [], np.inf
    true = on.trial.poses[:, :2]
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(true, axis=0).T))])
    zero = float(np.interp(begin, on.trial.stamps, way))
    for at, kind, k in on.played(begin, begin + 120.0, uwb, lidar):
        state = on.feed(localizer, kind, k)
        driven = float(np.interp(at, on.trial.stamps, way)) - zero
        if not state.lost:
            states.append(state)
            found = min(found, driven)
        if (driven > MOST_WAY and not states) or (states and state.stamp > states[0].stamp + AFTER):
            break
    wrong = bool(states) and bool((on.errors(states) > WRONG).any())
    return Start(found, wrong)


@dataclass(frozen=True)
class Track:
    """How a whole recording was tracked."""

    rms: float
    """m, while it was not lost."""
    worst: float
    """m."""
    lost: float
    """Share of the time after the start in which it was lost; as all of this, where the robot is within the map."""
    per_scan: float
    """ms of processor time, with the ranges and the odometry between the scans."""
    work: float
    """Millions of operations of the step that takes most, see Localizer.work: the same on every computer."""
    nees: float
    """Mean normalised squared error of the poses; 3 where the stated covariances are right."""
    inside: float
    """Share of the poses within the ellipsoid that should hold 95 %."""
    wrong: float
    """s in which it was certain of a wrong pose."""


def track(on: Bench, seconds: float, uwb: bool = True, lidar: bool = True) -> Track:
    """Play a recording from its beginning."""
    begin = float(on.trial.log.odometry.stamps[0])
    localizer, states, spent, scans, work = on.localizer(), [], 0.0, 0, 0
    for _, kind, k in on.played(begin, begin + seconds, uwb, lidar):
        clock = time.process_time()
        state = on.feed(localizer, kind, k)
        spent += time.process_time() - clock
        work, scans = max(work, localizer.work), scans + (kind == 2)
        if kind == 0:
            states.append(state)
    states = [s for s, inside in zip(states, on.mapped(np.array([s.stamp for s in states])), strict=True) if inside]
    lost = np.array([s.lost for s in states])
    per_scan, most = 1e3 * spent / scans if scans else np.nan, 1e-6 * work
    if lost.all():
        return Track(np.nan, np.nan, 1.0, per_scan, most, np.nan, np.nan, 0.0)
    sure = [s for s in states if not s.lost]
    errors, nees = on.errors(sure), on.nees(sure)
    error, period = errors[:, 0], float(np.median(np.diff([s.stamp for s in states])))
    wrong = period * float((errors > WRONG).any(axis=1).sum())
    inside = float(np.mean(nees <= chi2.ppf(0.95, 3)))
    again = float(lost[int(np.argmin(lost)) :].mean())
    rms = float(np.sqrt(np.mean(error**2)))
    return Track(rms, float(error.max()), again, per_scan, most, float(nees.mean()), inside, wrong)


@dataclass(frozen=True)
class Carried:
    """What became of a robot that was carried away."""

    seconds: float
    """Until the pose is right again and not lost; inf = not while it was watched."""
    stated: bool
    """Whether it said that it was lost."""
    wrong: bool
    """Whether it was then ever sure of a wrong place."""


def carried(on: Bench, leave: float, arrive: float, settled: float = AFTER) -> Carried:
    """Lift the robot at one time of the recording and set it down where it was at another one.

    Parameters
    ----------
    settled : s for which it is watched after it was found again, WATCHED s in all at most.
    """
    localizer, log = on.localizer(), on.trial.log
    stamps, poses = log.odometry.stamps, log.odometry.poses
    for _, kind, k in on.played(leave - BEFORE, leave):
        on.feed(localizer, kind, k)
    ends = se2.interpolate_trajectory(stamps, poses, np.array([leave, arrive]))
    moved = se2.compose(ends[0], se2.between(ends[1], poses))
    shift, stated, seconds, wrong = leave + 0.1 - arrive, False, np.inf, False
    for at, kind, k in on.played(arrive, arrive + WATCHED):
        if at > arrive + seconds + settled:
            break
        if kind == 0:
            state = localizer.add_odometry(stamps[k] + shift, *moved[k])
        elif kind == 1:
            r = log.ranges
            state = localizer.add_ranges(r.stamps[k] + shift, [r.anchor_ids[r.anchor[k]]], [r.ranges[k]])
        else:
            state = localizer.add_scan(log.scans.stamps[k] + shift, log.scans.ranges[k])
        stated |= state.lost
        if stated and not state.lost:
            there = replace(state, stamp=state.stamp - shift)
            right = bool((on.errors([there])[0] < WRONG).all())
            wrong |= not right
            seconds = min(seconds, there.stamp - arrive) if right else seconds
    return Carried(seconds, stated, wrong)


def with_moved_anchor(on: Bench) -> Bench:
    """Return the bench with one anchor of the map somewhere else than it stands."""
    places = on.known.anchors.positions.copy()
    places[0] += (2.0, 1.0)
    return replace(on, known=replace(on.known, anchors=replace(on.known.anchors, positions=places)))


def with_other_tag(on: Bench) -> Bench:
    """Return the bench with ranges of a tag whose delays differ from those of the map's, by a constant for each anchor."""
    ranges = on.trial.log.ranges
    late = OTHER_TAG * np.random.default_rng(0).standard_normal(len(ranges.anchor_ids))
    log = replace(on.trial.log, ranges=replace(ranges, ranges=ranges.ranges + late[ranges.anchor]))
    return replace(on, trial=replace(on.trial, log=log))


def scaled(on: Bench, grid: OccupancyGrid, factor: float) -> Bench:
    """Return the bench with a map in another unit."""
    g = grid.geometry
    walls = walls_of(replace(grid, geometry=GridGeometry(g.resolution * factor, g.origin * factor, g.rows, g.cols)))
    anchors = replace(on.known.anchors, positions=on.known.anchors.positions * factor)
    return replace(on, known=replace(on.known, walls=walls, anchors=anchors))


def abroad(on: Bench, other: KnownMap) -> Bench:
    """Return the bench with the map of another building, whose anchors bear the same ids."""
    count = min(len(on.known.anchors.ids), len(other.anchors.ids))
    there = other.anchors.only(other.anchors.ids[:count])
    return replace(on, known=replace(other, anchors=replace(there, ids=on.known.anchors.ids[:count])))


def certain(on: Bench, starts: int, uwb: bool, lidar: bool) -> tuple[int, int]:
    """Drive in a wrong map; return from how many starts, and in how many lines, one a second, the pose was ever certain."""
    begin, end = on.trial.log.odometry.stamps[[0, -1]].tolist()
    ever = lines = 0
    for moment in np.linspace(begin + 3.0, end - WRONG_SECONDS - 5.0, starts):
        localizer, at_next, count = on.localizer(), moment, 0
        for at, kind, k in on.played(moment, moment + WRONG_SECONDS, uwb, lidar):
            state = on.feed(localizer, kind, k)
            if at >= at_next:
                at_next += 1.0
                count += not state.lost
        ever, lines = ever + (count > 0), lines + count
    return ever, lines


def wrong_rows(on: Bench, grid: OccupancyGrid, other: KnownMap, starts: int) -> list[list[object]]:
    """Return the rows of maps that are not this building's, or not in the sensors' unit."""
    maps = {f"scaled by {factor}": scaled(on, grid, factor) for factor in (0.9, 1.05, 1.1)}
    maps["another building's, same anchor ids"] = abroad(on, other)
    lines = starts * int(WRONG_SECONDS)
    rows = []
    for name, wrong in maps.items():
        found = [certain(wrong, starts, *KINDS[kind]) for kind in ("all sensors", "without lidar")]
        rows.append([on.building, name, *(f"{lost} of {starts}, {n} of {lines} s" for lost, n in found)])
    return rows


KINDS = {"all sensors": (True, True), "without lidar": (True, False), "without UWB": (False, True)}


def start_moments(on: Bench, count: int) -> list[float]:
    """Return so many times at which the robot is within the map, s."""
    begin, end = on.trial.log.odometry.stamps[[0, -1]].tolist()
    moments = np.linspace(begin + 3.0, end - 75.0, 20 * count)
    return _spread(moments[on.mapped(moments)], count).tolist()


def start_row(on: Bench, name: str, count: int) -> list[object]:
    """Return the row of many starts."""
    found = [start(on, moment, *KINDS[name]) for moment in start_moments(on, count)]
    ways = np.array([s.way for s in found])
    within = np.isfinite(ways)
    typical, slow = (float(np.quantile(ways[within], q)) if within.any() else np.nan for q in (0.5, 0.95))
    return [on.building, name, count, f"{within.mean():.0%}", _short(typical), _short(slow), sum(s.wrong for s in found)]


def late_rows(on: Bench, count: int) -> list[list[object]]:
    """Return a row for each of many starts with all sensors that is not certain after WANTED m: what could be known there."""
    rows = []
    for moment in start_moments(on, count):
        way = start(on, moment).way
        if way > WANTED:
            inside, spread, ranges = posterior(on, moment)
            rows.append([on.building, f"{moment:.0f}", _short(way), ranges, f"{inside:.3f}", f"{spread:.2f}"])
    return rows


def posterior(on: Bench, begin: float) -> tuple[float, float, int]:
    """Compare every place and heading of the map by the measurements of WANTED m of driving.

    Returns
    -------
    The share of the probability within half a metre and 0.3 rad of the likeliest pose, the standard deviation of the place
    there along its longer axis, m, and the number of ranges. A grid of STEPS over all free space, no candidate left out.
    """
    localizer, true = on.localizer(), on.trial.poses[:, :2]
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(true, axis=0).T))])
    last = float(np.interp(np.interp(begin, on.trial.stamps, way) + WANTED, way, on.trial.stamps))
    for _, kind, k in on.played(begin, last):
        on.feed(localizer, kind, k)
    estimator, walls = localizer._estimator, on.known.walls
    assert walls is not None
    odom, odometer = estimator._odometer.pose, estimator._way
    ranges = estimator._window.ranges_since(localizer.known.anchors, odom, odometer)
    rays, ago = estimator._window.seen(odom, odometer, LOOK_BACK)
    axes = [np.arange(low, high, STEPS[0]) for low, high in zip(walls.geometry.origin, walls.geometry.corner, strict=True)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    places = places[walls.state_at(*places.T) == FREE]
    poses, weights = np.zeros((0, 3)), np.zeros(0)
    for heading in np.arange(0.0, 2.0 * np.pi, STEPS[1]):
        turned = np.column_stack([places, np.full(len(places), heading)])
        weight = range_likelihood(turned, ranges, expected=expected_errors(turned, ranges, on.known.anchors.errors))
        some = weight > max(weight.max(), weights.max(initial=-np.inf)) - FAINT
        poses, weights = np.concatenate([poses, turned[some]]), np.concatenate([weights, weight[some]])
    some = weights > weights.max() - FAINT
    poses, weights = poses[some], weights[some]
    independent = INDEPENDENT_RAYS * (1.0 + float(ago.max(initial=0.0)))
    for part in np.array_split(np.arange(len(poses)), 1 + len(poses) // 1000):
        weights[part] += walls.agreement(poses[part], rays, independent).log_likelihood
    share = np.exp(weights - weights.max())
    share /= share.sum()
    near = ~apart(poses[np.argmax(share)], poses)
    spread = np.cov(poses[near, :2].T, aweights=share[near])
    return float(share[near].sum()), float(np.sqrt(np.linalg.eigvalsh(spread)[-1])), len(ranges)


def track_rows(on: Bench, seconds: float) -> list[list[object]]:
    """Return the rows of tracking with all sensors, without some, and with an anchor moved."""
    rows = [(name, track(on, seconds, *used)) for name, used in KINDS.items()]
    rows.insert(1, ("one anchor moved by 2.2 m", track(with_moved_anchor(on), seconds)))
    rows.append(("without lidar, another tag", track(with_other_tag(on), seconds, *KINDS["without lidar"])))
    short = [map(_short, (t.nees, 100.0 * t.inside, t.wrong, t.per_scan, t.work)) for _, t in rows]
    return [[on.building, name, t.rms, t.worst, f"{t.lost:.1%}", *more] for (name, t), more in zip(rows, short, strict=True)]


def _short(value: float) -> str:
    return f"{value:.1f}" if np.isfinite(value) else "-"


def carried_rows(on: Bench, count: int) -> list[list[object]]:
    """Return the rows of robots that drove within the map and were carried to where it holds something, and nothing."""
    begin, end = on.trial.log.odometry.stamps[[0, -1]].tolist()
    moments = np.arange(begin + BEFORE, end - WATCHED, 1.0)
    leave = moments[_share_mapped(on, moments, np.arange(-BEFORE, 0.0)) == 1.0]
    kinds = {
        "something": moments[_share_mapped(on, moments, np.arange(0.0, RECOVERED, 0.5)) == 1.0],
        "nothing": moments[_share_mapped(on, moments, np.arange(0.0, WATCHED)) <= 0.5],
    }
    rows = []
    for name, there in kinds.items():
        settled, many = (AFTER if name == "something" else WATCHED), min(count, len(leave), len(there))
        arrive = np.roll(_spread(there, many), many // 2)
        found = [carried(on, *pair, settled) for pair in zip(_spread(leave, many).tolist(), arrive.tolist(), strict=True)]
        after = np.array([c.seconds for c in found])
        share, median = (f"{np.mean(after <= RECOVERED):.0%}", _short(float(np.median(after)))) if found else ("-", "-")
        rows.append([on.building, name, len(found), sum(c.stated for c in found), share, median, sum(c.wrong for c in found)])
    return rows


def _spread(moments: np.ndarray, count: int) -> np.ndarray:
    """Return so many of the moments, from all over them."""
    return moments[np.linspace(0, len(moments) - 1, count).astype(int)]


def _share_mapped(on: Bench, moments: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return at which share (n,) of the times (k,) after moments (n,), s, the robot is where the map has free space."""
    times = moments[:, None] + after
    return on.mapped(times.reshape(-1)).reshape(times.shape).mean(axis=1)


def main(argv: list[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default=",".join(WORLDS), help="worlds, separated by commas")
    parser.add_argument("--starts", type=int, default=100)
    parser.add_argument("--carried", type=int, default=20)
    parser.add_argument("--wrong", type=int, default=6, help="starts in each of four wrong maps")
    parser.add_argument("--seconds", type=float, default=480.0, help="of tracking")
    parser.add_argument("--seed", type=int, default=971)
    text = "of range offsets of walls, glass, multipath, biases of anchors; several are separated by commas"
    parser.add_argument("--building", default=BUILDINGS, help=text)
    parser.add_argument("--whole", action="store_true", help="the lidar loses no returns")
    parser.add_argument("--easy", action="store_true", help="rooms without the errors of real ones")
    parser.add_argument("--late", action="store_true", help="what could be known where a start is late, and nothing else")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep maps and recordings, and use those that are there")
    parser.add_argument("--print", action="store_true", help="write nothing")
    args = parser.parse_args(argv)
    for world in args.only.split(","):
        tables: dict[tuple[str, ...], list[list[object]]] = {}
        for building in args.building.split(","):
            place, other = (Place(w, int(building), args.seed, args.easy, not args.whole) for w in (world, ELSEWHERE[world]))
            found = late(place, args) if args.late else measured(place, other, args)
            for head, rows in found.items():
                tables.setdefault(head, []).extend(rows)
        text = "\n".join(table(head, rows) for head, rows in tables.items())
        print(text, flush=True)
        if not args.print:
            section = f"{'late starts' if args.late else 'localization'} {world}"
            write_section(ROOT / "docs" / "lab" / "localization.md", section, text)
    return 0


def late(place: Place, args: argparse.Namespace) -> dict[tuple[str, ...], list[list[object]]]:
    """Return the rows of one building's late starts by the head of their table."""
    head = (f"{place.world}, building", "start at, s", "certain after, m", f"ranges in {WANTED:.0f} m",
            "probability of the likeliest place", "its sigma, m")  # fmt: skip
    return {head: late_rows(bench(place, args.keep), args.starts)}


def measured(place: Place, other: Place, args: argparse.Namespace) -> dict[tuple[str, ...], list[list[object]]]:
    """Return the rows of one building by the heads of their tables."""
    on, few = bench(place, args.keep), max(args.starts // 10, 2)
    world = f"{on.world}, building"
    tables: dict[tuple[str, ...], list[list[object]]] = {
        (world, "starts with", "number", f"found within {MOST_WAY:.0f} m", "median, m driven", "95 %, m", "wrong"):
            [start_row(on, name, args.starts if name == "all sensors" else few) for name in KINDS],
        (world, "tracking with", "rms, m", "worst, m", "lost", "NEES (3)", "in 95 %, %", "wrong, s", "CPU per scan, ms",
         "most work of a step, 10^6"): track_rows(on, args.seconds),
        (world, "carried to where the map holds", "robots", "said lost", f"found again within {RECOVERED:.0f} s",
         "median, s", "wrong"): carried_rows(on, args.carried),
    }  # fmt: skip
    if args.wrong:
        grid = mapped(place, keep=args.keep).result.grid
        assert grid is not None
        rows = wrong_rows(on, grid, mapped(other, keep=args.keep).known, args.wrong)
        tables[world, "wrong map: certain in", "all sensors", "without lidar"] = rows
    return tables


if __name__ == "__main__":
    sys.exit(main())
