"""The page that is the algorithm: from recordings to trajectories, anchors and map.

``build_map`` reads as the paper does: keyframes and edges, first optimisation with wheels and radio, sub-maps and
loop closures, second optimisation with lidar edges, occupancy grid. Beyond the paper stand the calibration in the same
least squares, noise learnt from the data, tracking between neighbouring clouds and the joint refinement of all of them.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from . import (
    calibration,
    closure_candidates,
    closures,
    clouds,
    evidence,
    first_estimate,
    joining,
    keyframes,
    landmarks,
    loop_closure,
    map_frame,
    moved_anchors,
    occupancy_grid,
    pair_matching,
    plain_closures,
    refinement,
    se2,
    sessions,
    sight,
    submaps,
    summary,
    tracking,
    turning,
)
from .anchors import AnchorConfig
from .calibration import CalibrationConfig
from .closures import Closures, LoopClosureConfig
from .clouds import CloudConfig, Clouds
from .constraints import Clock, Constraints
from .constraints import apply as apply_constraints
from .errors import Cancelled, ConfigError
from .first_estimate import GrowthConfig
from .graph import Edges, Graph
from .grid_geometry import GridGeometry
from .icp import IcpConfig
from .keyframes import KeyframeConfig
from .map_result import MapResult, StageSummary
from .marginals import JointCovariance, marginals
from .measurement import OdometryNoiseConfig, learn_noise, range_edges, relocate, wheel_edges
from .occupancy_grid import GridConfig, OccupancyGrid, Sweeps
from .pair_matching import CloudRasters
from .range_noise import RangeNoiseConfig, short_term_sigma
from .refinement import Refined, RefinementConfig
from .robust import SQUARED
from .scan_search import SearchConfig
from .sensor_log import SensorLog
from .sessions import Drives, Part, Session
from .solver import SolverConfig, SolverSummary, optimize
from .submaps import SubmapConfig
from .thinning import thinned
from .tracking import TrackingConfig

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
_LARGE_GRID = 5_000_000
"""Cells from which on a grid's memory is announced."""
_BLOCK = 32
"""Keyframes whose rays are held at once."""
Progress = Callable[[str, int, int], object]
"""progress(stage, done, total); returning False asks to stop, see errors.Cancelled."""


@dataclass(frozen=True, slots=True)
class MappingConfig:
    """All settings, a group per stage."""

    use_uwb: bool = True
    """Use the ranges."""
    use_lidar: bool = True
    """Use the scans."""
    use_loops: bool = True
    """Search loop closures and match clouds of different times."""
    turn_laser: bool = True
    """Take the laser as mounted the other way up than told where its turns agree with the wheels' only so."""
    align: Literal["odometry", "first-pose", "walls", "anchors"] = "odometry"
    """Where the map's axes lie: where the odometry began; at the first pose; there, turned so that most walls run along x
    and y; or at the first placed anchor, x towards the last."""
    crop: tuple[float, float, float, float] | None = None
    """Keep only this part of the grid: x0, y0, x1, y1, m, map frame."""
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    odometry: OdometryNoiseConfig = field(default_factory=OdometryNoiseConfig)
    ranges: RangeNoiseConfig = field(default_factory=RangeNoiseConfig)
    anchors: AnchorConfig = field(default_factory=AnchorConfig)
    growth: GrowthConfig = field(default_factory=GrowthConfig)
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    clouds: CloudConfig = field(default_factory=CloudConfig)
    submaps: SubmapConfig = field(default_factory=SubmapConfig)
    loops: LoopClosureConfig = field(default_factory=LoopClosureConfig)
    icp: IcpConfig = field(default_factory=IcpConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    search: SearchConfig = field(default_factory=SearchConfig)
    refinement: RefinementConfig = field(default_factory=RefinementConfig)
    solver: SolverConfig = field(default_factory=SolverConfig)
    grid: GridConfig = field(default_factory=GridConfig)


class Stages:
    """Stage summaries in the making: names, figures, the caller's clock and progress callback."""

    def __init__(self, progress: Progress | None, clock: Callable[[], float] | None) -> None:
        self._progress, self._clock = progress, clock
        self._since = clock() if clock else 0.0
        self.done: list[StageSummary] = []
        self.warnings: list[str] = []
        self.doubts: list[str] = []

    def tell(self, stage: str, done: int, total: int) -> None:
        """Report progress; raises Cancelled where the callback returns False."""
        if self._progress is not None and self._progress(stage, done, total) is False:
            raise Cancelled(f"stopped by the caller during {stage}")

    def end(self, stage: str, **figures: object) -> None:
        """Close a stage."""
        now = self._clock() if self._clock else 0.0
        self.done.append(StageSummary(stage, now - self._since, figures))
        self._since = now
        self.tell(stage, 1, 1)

    def teller(self, stage: str) -> Callable[[int, int], None]:
        """Return a callback (done, total) for one stage."""
        return lambda done, total: self.tell(stage, done, total)


def build_map(
    logs: SensorLog | Sequence[SensorLog],
    config: MappingConfig | None = None,
    *,
    constraints: Constraints | None = None,
    progress: Progress | None = None,
    executor: Executor | None = None,
    clock: Callable[[], float] | None = None,
) -> MapResult:
    """Compute trajectories, anchors and map of one or more recordings.

    Parameters
    ----------
    logs : the recording, ranges or scans may be missing; or several that hear the same anchors, by whatever robots on
        whatever days: they become one map in the frame of the first.
    config : settings; None = defaults.
    constraints : what is known beforehand: surveyed anchors, pinned poses, an earlier map's anchors ...
    progress : called as progress(stage, done, total); returning False raises Cancelled.
    executor : any concurrent.futures executor; the result does not depend on it.
    clock : seconds, for the stages' timings; None = no timings.

    Raises
    ------
    DataError : there is nothing to map, or recordings share too few anchors. Cancelled : the callback asked to stop.
    """
    config, known = config or MappingConfig(), constraints or Constraints()
    stages = Stages(progress, clock)
    logs = [logs] if isinstance(logs, SensorLog) else logs
    logs = [log.without(uwb=not config.use_uwb, lidar=not config.use_lidar) for log in logs]
    logs = [_upright(log, config, stages) for log in logs]
    logs = [thinned(log, config.keyframes, config.grid) for log in logs]

    drives = sessions.gather(logs, config.keyframes)
    travelled = sum(float(s.frames.path.sum()) for s in drives.sessions)
    stages.end("keyframes", keyframes=len(drives.stamps), travelled=round(travelled, 3))

    parts = [_measurements(session, config) for session in drives.sessions]
    ranges = sum(len(part.radio) for part in parts if part.radio is not None)
    stages.end("edges", odometry=sum(len(part.wheels) for part in parts), ranges=ranges)

    part = _first_optimisation(parts, drives, config, stages)
    part = _constrained(part, known, drives, config, stages)

    scans = _Scans.of(drives, known, config)
    found = closures.no_closures()
    tracked: Refined | None = None
    refined: Refined | None = None
    if scans is not None:
        stages.end("clouds", points=len(scans.clouds.points))
        part = replace(part, graph=_free(part.graph, *_LASER))
        if config.tracking.on:
            part, tracked, scans = _track_on_time(part, scans, drives, config, stages)
            part = _heard_anew(part, tracked, config, stages)
        if config.use_loops:
            held = part.edges if tracked is None else (*part.edges, tracked.edges)
            close = _close_loops if config.loops.method == "search" else _close_loops_plainly
            part, found = close(part, held, scans, drives, config, stages, executor)
            if part.radio is not None:
                radio, _ = learn_noise(part.radio, part.graph, len(part.graph.anchors), config.ranges, steady=True)
                part = replace(part, radio=radio)
                lidar = (found.edges,) if tracked is None else (tracked.edges, found.edges)
                widened = evidence.choose_widths(part.graph, (*part.edges, *lidar), config.calibration)
                part = replace(part, graph=widened)
            part, refined = _refine_jointly(part, scans, drives, config, stages)
            apart = moved_anchors.apart(part, drives, config.solver, config.ranges)
            if apart.warnings:
                stages.warnings += apart.warnings
                part, refined = _refine_jointly(apart.part, scans, drives, config, stages)
        _look_again(part, scans, drives, stages)
    if known.landmark_distances:
        part, refined = _measured_distances(part, found, tracked, refined, known, scans, drives, config, stages)
    part = _final(part, found, tracked, refined)
    if refined is not None and part.radio is not None:
        part = replace(part, graph=_hold_negative_heights(optimize(part.graph, config.solver)[0]))
    part = _aligned(part, scans, config)
    # What only matching needed is most of the memory.
    scans = tracked = refined = None

    grid = _grid(drives, part.graph, config, executor, stages)
    uncertainty = marginals(refinement.with_fewer_pairs(part.graph))
    result = summary.summarise(
        drives, part, uncertainty, found, grid, config.calibration, stages.done, stages.warnings, stages.doubts
    )
    stages.end("summary")
    return replace(result, stages=tuple(stages.done))


def _upright(log: SensorLog, config: MappingConfig, stages: Stages) -> SensorLog:
    """Return the recording with the laser the way up that its turns show."""
    seen = turning.compare(log, _TURNS) if config.turn_laser and log.scans is not None else None
    if seen is None or not (seen.agree and seen.turned_over):
        return log
    flipped = not log.mounting.laser_flipped
    stages.warnings.append(
        f"the laser is mounted {'upside down' if flipped else 'upright'}, not as told: so its turns agree "
        f"{seen.told / max(seen.other, 1e-6):.0f} times better with the wheels'; it was taken that way"
    )
    return replace(log, mounting=replace(log.mounting, laser_flipped=flipped))


_TURNS = 300
"""Scan pairs looked at for the way up of the laser."""


def _measurements(session: Session, config: MappingConfig) -> Part:
    """Return a recording's graph by dead reckoning with its calibration priors, and what its wheels and radio measured."""
    log, frames, ids = session.log, session.frames, session.anchor_ids
    told = np.array([log.mounting.height_difference(a) is not None for a in ids], dtype=bool)
    listed = calibration.unknowns(config.calibration, ids, told)
    block = calibration.block(listed)
    graph = Graph(frames.odometry.copy(), np.zeros((len(ids), 2)), (), block)
    graph = graph.with_edges(calibration.prior_edges(listed))
    graph = _free(replace(graph, fixed_calibration=np.ones(len(listed), dtype=bool)), *_WHEELS, "bias", "range_scale")
    wheels = wheel_edges(frames, 0, config.odometry, block)
    if log.ranges is None:
        return Part(graph, wheels, None, None, ids)
    attached = keyframes.attach_ranges(log.ranges, log.odometry, frames, log.mounting)
    radio = range_edges(attached, 0, ids, log.mounting, block, config.ranges.sigma, config.anchors, config.ranges.kernel)
    return Part(graph, wheels, radio if np.any(radio.weights) else None, None, ids)


_WHEELS = ("odometry_scale", "heading_scale", "heading_per_metre", "heading_rate")
_LASER = ("laser_x", "laser_y", "laser_theta", "laser_delay")
_RADIO = ("height2", "tag_x", "tag_y", "range_delay")


def _free(graph: Graph, *names: str) -> Graph:
    """Return the graph with calibration unknowns of these names (an anchor's or a recording's own by their stem) set free."""
    assert graph.fixed_calibration is not None
    named = np.array([calibration.stem(name) in names for name in graph.calibration.names], dtype=bool)
    return replace(graph, fixed_calibration=graph.fixed_calibration & ~named)


def _estimates(graph: Graph, solved: Graph) -> Graph:
    """Return the graph with the estimates of another, its own edges kept."""
    return graph.updated(solved.poses, solved.anchors, solved.calibration.values)


def _first_optimisation(parts: Sequence[Part], drives: Drives, config: MappingConfig, stages: Stages) -> Part:
    """Grow each recording from nothing, bring them together and optimise wheels and radio (paper: first optimisation)."""
    parts = [_settled(_grown(part, drives, n, config, stages), config, stages) for n, part in enumerate(parts)]
    joined = joining.join(parts, drives)
    stages.warnings += joined.warnings
    if len(parts) == 1:
        return joined.part
    return _settled(joined.part, config, stages)


def _grown(part: Part, drives: Drives, number: int, config: MappingConfig, stages: Stages) -> Part:
    """Grow trajectory and anchors of one recording."""
    radio, path = part.radio, drives.path[drives.sessions[number].rows]
    if radio is None:
        return part
    alive = np.asarray(radio.weights) > 0
    sigma = short_term_sigma(radio.stamps[alive], radio.anchor[alive], radio.ranges[alive], config.ranges)
    growth = replace(config.growth, range_sigma=max(1.5 * sigma, config.growth.least_sigma))
    first = first_estimate.grow(part.graph, part.wheels, radio, path - path[0], growth, config.anchors)
    whose = {"recording": number + 1} if len(drives) > 1 else {}
    stages.end("first estimate", range_sigma=round(sigma, 4), placed=int(first.placed.sum()), **whose)
    # It grew from the middle; the map begins where the odometry did.
    back = se2.compose(part.graph.poses[0], se2.inverse(first.graph.poses[0]))
    graph = replace(_estimates(part.graph, map_frame.moved(first.graph, back)), fixed_anchors=~first.placed)
    radio = replace(radio, weights=(alive & first.placed[radio.anchor]).astype(np.float64))
    return replace(part, graph=graph, radio=radio, first=sessions.moved_hypotheses(first, back))


def _settled(part: Part, config: MappingConfig, stages: Stages) -> Part:
    """Optimise wheels and radio together, the ranges' noise learnt by the way."""
    graph, radio = part.graph, part.radio
    if radio is None or part.first is None:
        return part
    for lap in range(3):
        radio, _ = learn_noise(radio, graph, len(graph.anchors), config.ranges)
        if lap == 2:
            graph = _free(evidence.choose_widths(graph, (part.wheels, radio), config.calibration), *_RADIO)
        solved, result = optimize(graph.with_edges(part.wheels, radio), config.solver)
        graph = _hold_negative_heights(_estimates(graph, solved))
        stages.tell("first optimisation", lap + 1, 3)
    stages.end("first optimisation", placed=int(part.first.placed.sum()), **_solver_figures(result))
    return replace(part, graph=graph, radio=radio)


def _constrained(part: Part, known: Constraints, drives: Drives, config: MappingConfig, stages: Stages) -> Part:
    """Bring the first estimate into the user's frame, where one is known, and add what is known beforehand."""
    if known == Constraints():
        return part
    if known.places and config.align != "odometry":
        raise ConfigError("known places say where the map lies; leave out align, or the places")
    placed = np.zeros(len(part.anchor_ids), dtype=bool) if part.first is None else part.first.placed
    done = apply_constraints(known, part.graph, part.anchor_ids, placed, drives.clock)
    stages.warnings += [
        f"anchor {name} stands {off:.2f} m from its earlier place: it was moved" for name, off in done.moved.items()
    ]
    graph = _estimates(done.graph, optimize(done.graph.with_edges(*part.edges), config.solver)[0])
    stages.end("constraints", moved=sorted(done.moved), shift=[round(v, 4) for v in done.motion.tolist()])
    return replace(part, graph=graph, first=sessions.moved_hypotheses(part.first, done.motion))


def _hold_negative_heights(graph: Graph) -> Graph:
    """Return the graph with squared heights that came out negative put back to 0 and held."""
    names, values = graph.calibration.names, graph.calibration.values.copy()
    below = np.array([n.startswith("height2:") for n in names], dtype=bool) & (values < 0.0)
    values[below] = 0.0
    fixed = np.asarray(graph.fixed_calibration) | below
    return replace(graph.updated(graph.poses, graph.anchors, values), fixed_calibration=fixed)


@dataclass(frozen=True, slots=True, eq=False)
class _Scans:
    """Lidar of a run, ready for matching."""

    clouds: Clouds
    raster: CloudRasters
    twist: Floats
    clock: Clock
    known: Constraints
    delay: float
    """Of the lidar's clock, s, with which the clouds were made."""

    def may_meet(self, i: Ints, j: Ints) -> Bools:
        """Tell which pairs of keyframes the user has not forbidden to match."""
        return self.known.allowed(self.clock, i, j)

    @classmethod
    def of(cls, drives: Drives, known: Constraints, config: MappingConfig, delay: float = 0.0) -> "_Scans | None":
        if not any(session.has_scans for session in drives.sessions):
            return None
        built = clouds.joined([block for session in drives.sessions for block in _clouds(session, config, delay)])
        raster = pair_matching.paint(built, config.clouds.raster, max(config.refinement.first_gate, 0.2))
        return cls(built, raster, drives.twist, drives.clock, known, delay)


def _clouds(session: Session, config: MappingConfig, delay: float) -> list[Clouds]:
    """Return the clouds of a recording's keyframes, a block at a time; empty ones without lidar."""
    log, frames = session.log.with_later_scans(delay), session.frames
    if log.scans is None:
        none = np.zeros(0, dtype=np.int64)
        return [Clouds(np.zeros(len(frames) + 1, dtype=np.int64), np.zeros((0, 2)), np.zeros((0, 2)), none, np.zeros(0))]
    owner, chosen = keyframes.choose_scans(log.scans, frames, config.keyframes)
    parts = []
    for block in range(0, len(frames), _BLOCK):
        size = min(_BLOCK, len(frames) - block)
        own = slice(*np.searchsorted(owner, [block, block + size]).tolist())
        rays = keyframes.scan_points(log, frames, owner[own], chosen[own], config.clouds.range_max)
        parts.append(clouds.build(replace(rays, keyframe=rays.keyframe - block), size, config.clouds))
    return parts


def _match_round(
    graph: Graph, edges: tuple[Edges, ...], scans: _Scans, i: Ints, j: Ints, settings: RefinementConfig,
    config: MappingConfig, stages: Stages, stage: str,
) -> tuple[Graph, Refined]:
    kept = scans.may_meet(i, j)
    i, j = i[kept], j[kept]
    refined = refinement.refine(
        graph.with_edges(*edges), scans.clouds, scans.raster, scans.twist, i, j, settings, config.solver, stages.teller(stage),
        scans.delay,
    )
    return _estimates(graph, refined.graph), refined


def _without_forbidden(found: Closures, scans: _Scans) -> Closures:
    """Return closures with those the user has forbidden rejected."""
    kept = scans.may_meet(found.edges.i, found.edges.j)
    return found if kept.all() else found.without(kept, ["forbidden by the constraints"] * len(kept))


def _track(part: Part, scans: _Scans, drives: Drives, config: MappingConfig, stages: Stages) -> tuple[Part, Refined]:
    """Match each cloud with those just before and after it, so that sub-maps are stiff."""
    rules = config.refinement
    # Ranges that lie would tear neighbours apart; softly pulled, neighbours keep the wheels' word until clouds correct it.
    soft = _softened(part)
    whole = replace(soft, wheels=replace(soft.wheels, kernel=SQUARED))
    graph = _estimates(part.graph, optimize(part.graph.with_edges(*whole.edges), config.solver)[0])
    followed = tracking.follow(scans.clouds, scans.raster, part.wheels, graph, rules.first_gate, config.tracking, config.search)
    part, soft = replace(part, wheels=followed.wheels), replace(soft, wheels=followed.wheels)
    graph = _estimates(graph, optimize(graph.with_edges(*soft.edges, followed.steps), config.solver)[0])
    gate = float(np.clip(followed.miss, rules.later_gate, rules.first_gate))
    settings = replace(rules, partners=0, rounds=rules.track_rounds, first_gate=gate)
    i, j = refinement.choose_pairs(scans.clouds, graph.poses, drives.path, drives.session, settings)
    graph, refined = _match_round(graph, soft.edges, scans, i, j, settings, config, stages, "tracking")
    stages.end(
        "tracking", pairs=len(i), searched=followed.searched, used=int(refined.used.sum()), gate=round(gate, 3),
        sigma=round(refined.sigma, 4), rounds=refined.rounds,
    )
    return replace(part, graph=graph), refined


def _heard_anew(part: Part, tracked: Refined, config: MappingConfig, stages: Stages) -> Part:
    """Judge the ranges anew on the trajectory that neighbouring clouds have stiffened.

    Wheels alone are soft enough to be bent until anchors that lie for minutes seem to tell the truth. On the stiffer
    chain lies stand out.
    """
    graph, radio = part.graph, part.radio
    if radio is None:
        return part
    roughly = replace(config.solver, max_iterations=min(config.solver.max_iterations, _ROUGHLY))
    for solver in (roughly, config.solver):
        graph = relocate(radio, graph, ~np.asarray(graph.fixed_anchors), config.anchors)
        radio, _ = learn_noise(radio, graph, len(graph.anchors), config.ranges)
        graph = _estimates(graph, optimize(graph.with_edges(part.wheels, radio, tracked.edges), solver)[0])
    stages.end("ranges judged anew")
    return replace(part, graph=_hold_negative_heights(graph), radio=radio)


_ROUGHLY = 12
"""Iterations of an optimisation that another follows."""


def _softened(part: Part) -> Part:
    """Return the part with ranges that hold the trajectory only where nothing else does."""
    radio = part.radio
    return part if radio is None else replace(part, radio=replace(radio, sigma=radio.sigma * _SOFTNESS))


_SOFTNESS = 10.0
"""Factor on the ranges' standard deviations."""


def _track_on_time(
    part: Part, scans: _Scans, drives: Drives, config: MappingConfig, stages: Stages
) -> tuple[Part, Refined, _Scans]:
    """Track; where the lidar's clock turns out to be off by much, make the clouds anew with that and track again."""
    part, tracked = _track(part, scans, drives, config, stages)
    for _ in range(_RETIMINGS):
        delay = part.graph.calibration.get("laser_delay")
        again = None if abs(delay - scans.delay) < _LATE else _Scans.of(drives, scans.known, config, delay)
        if again is None:
            break
        scans = again
        stages.end("clouds made anew", laser_delay=round(delay, 4))
        part, tracked = _track(part, scans, drives, config, stages)
    return part, tracked, scans


_LATE = 0.015
"""s; the clouds' clock may be off by this much: a robot's velocity hardly changes meanwhile."""
_RETIMINGS = 3


def _close_loops(
    part: Part, edges: tuple[Edges, ...], scans: _Scans, drives: Drives, config: MappingConfig, stages: Stages,
    executor: Executor | None,
) -> tuple[Part, Closures]:
    """Build sub-maps, find closures among them and solve again, until nothing new is found (paper: second optimisation)."""
    session = drives.session
    base = part.graph.with_edges(*edges)
    found = closures.no_closures()
    tried: set[tuple[int, int, bool]] = set()
    missed: set[tuple[int, int]] = set()
    held = part.radio is not None
    for lap in range(config.loops.rounds):
        pieces = submaps.build(scans.clouds, base.poses, drives.path, session, config.submaps)
        free = sight.seen_free(scans.clouds, pieces, base.poses)
        pieces = sight.still(pieces, free)
        known = JointCovariance(base.with_edges(found.edges), pieces.reference)
        candidates = closure_candidates.propose(base, known, pieces, session, tried, missed, held, config.loops)
        tried |= candidates.names(config.loops)
        teller = stages.teller("loop closure")
        rules = replace(config.loops, through=max(config.loops.through, sight.unrest(pieces, free, base.poses, session)))
        new = loop_closure.find(candidates, pieces, rules, config.search, teller, free, executor)
        new = _without_forbidden(new, scans)
        missed |= set() if held else closure_candidates.missed(candidates, new, config.loops)
        found = closures.merged(found, new)
        base, found = loop_closure.reconcile(base, found, config.loops, config.solver)
        stages.end(
            f"loop closure {lap + 1}", submaps=len(pieces), candidates=len(candidates.target),
            accepted=len(new.edges), standing=len(found.edges),
        )
        tied = len(found.edges) >= config.loops.enough * len(pieces)
        if (tied or len(new.edges) < 0.05 * len(found.edges)) and not missed - {(a, b) for a, b, searched in tried if searched}:
            break
    return replace(part, graph=_estimates(part.graph, base)), found


def _close_loops_plainly(
    part: Part, edges: tuple[Edges, ...], scans: _Scans, drives: Drives, config: MappingConfig, stages: Stages,
    executor: Executor | None,
) -> tuple[Part, Closures]:
    """Align sub-maps pair by pair and solve once more with those that fit (paper: second optimisation)."""
    graph, session = part.graph, drives.session
    found = closures.no_closures()
    for lap in range(config.loops.rounds):
        pieces = submaps.build(scans.clouds, graph.poses, drives.path, session, config.submaps)
        teller = stages.teller("loop closure")
        found = plain_closures.find(graph, pieces, session, config.loops, config.icp, teller, executor)
        found = _without_forbidden(found, scans)
        stages.end(f"loop closure {lap + 1}", submaps=len(pieces), candidates=len(found.candidates), accepted=len(found.edges))
        solved, result = optimize(graph.with_edges(*edges, found.edges), config.solver)
        graph = _estimates(graph, solved)
        stages.end(f"second optimisation {lap + 1}", **_solver_figures(result))
    return replace(part, graph=graph), found


def _refine_jointly(
    part: Part, scans: _Scans, drives: Drives, config: MappingConfig, stages: Stages
) -> tuple[Part, Refined | None]:
    """Let all overlapping clouds pull on all poses; what the ranges weigh is learnt anew from where the lidar puts them."""
    if config.refinement.rounds == 0:
        return part, None
    graph, radio = part.graph, part.radio
    graph = _free(graph, *_RADIO) if radio is not None else graph
    refined: Refined | None = None
    for lap in range(config.refinement.selections):
        edges = replace(part, radio=radio).edges
        i, j = refinement.choose_pairs(scans.clouds, graph.poses, drives.path, drives.session, config.refinement)
        settings = config.refinement
        if lap > 0:
            settings = replace(settings, first_gate=settings.later_gate)
        before = graph.poses
        graph, refined = _match_round(graph, edges, scans, i, j, settings, config, stages, "joint refinement")
        graph = _hold_negative_heights(graph)
        shift = float(np.sqrt(np.mean(np.sum((graph.poses - before)[:, :2] ** 2, axis=1))))
        if radio is not None:
            radio, _ = learn_noise(radio, graph, len(graph.anchors), config.ranges, steady=True)
        stages.end(
            f"joint refinement {lap + 1}", pairs=len(i), used=int(refined.used.sum()), rounds=refined.rounds,
            sigma=round(refined.sigma, 4), shift=round(shift, 5), **_solver_figures(refined.summary),
        )
        if shift < config.refinement.same_pairs:
            break
    return replace(part, graph=graph, radio=radio), refined


def _look_again(part: Part, scans: _Scans, drives: Drives, stages: Stages) -> None:
    """Compare what visits to the same place saw; doubt a map in which they saw through each other's walls."""
    share, visits = sight.disagreement(scans.clouds, part.graph.poses, drives.path, drives.session)
    stages.end("visits compared", visits=visits, disagreement=round(share, 4))
    if share > _DISAGREEMENT and visits >= _ENOUGH_VISITS:
        stages.doubts.append(
            f"{share:.0%} of what was seen on one visit to a place stands where another visit saw free space: "
            "parts of the map lie in a wrong place to each other"
        )


_DISAGREEMENT = 0.05
"""Share from which visits do not show the same place; people, glass and doors leave half of it."""
_ENOUGH_VISITS = 10


def _final(part: Part, closures: Closures, tracked: Refined | None, refined: Refined | None) -> Part:
    """Return the graph with every measurement that holds it; the joint refinement's take the place of all other scans'."""
    if refined is not None:
        return replace(part, graph=part.graph.with_edges(*part.edges, refined.edges))
    lidar: tuple[Edges, ...] = (closures.edges,) if tracked is None else (tracked.edges, closures.edges)
    return replace(part, graph=part.graph.with_edges(*part.edges, *lidar))


def _measured_distances(
    part: Part, closures: Closures, tracked: Refined | None, refined: Refined | None, known: Constraints,
    scans: _Scans | None, drives: Drives, config: MappingConfig, stages: Stages
) -> tuple[Part, Refined | None]:
    """Let true distances between landmarks pull on the map as it is without them."""
    if scans is None:
        raise ConfigError("constraints: distances between landmarks need the lidar, which sees them")
    held = _final(part, closures, tracked, refined)
    poses = se2.compose(_alignment(held, scans, config), held.graph.poses)
    tied = landmarks.ties(known, scans.clouds, poses, drives.path)
    solved = optimize(held.graph.with_edges(tied.edges), config.solver)[0]
    part = replace(part, graph=_estimates(part.graph.with_edges(tied.edges), solved))
    if refined is not None:
        part, refined = _refine_jointly(part, scans, drives, config, stages)
    figures, warnings = landmarks.outcome(known, tied, part.graph)
    stages.warnings += warnings
    stages.end("measured distances", distances=figures)
    return part, refined


def _aligned(part: Part, scans: _Scans | None, config: MappingConfig) -> Part:
    """Put the map's axes where the settings want them."""
    motion = _alignment(part, scans, config)
    return replace(part, graph=map_frame.moved(part.graph, motion), first=sessions.moved_hypotheses(part.first, motion))


def _alignment(part: Part, scans: _Scans | None, config: MappingConfig) -> Floats:
    """Return T_new_map (3,), by which the map is turned to where the settings want its axes."""
    graph, normals = part.graph, np.zeros((0, 2))
    placed = np.zeros(len(graph.anchors), dtype=bool) if part.first is None else part.first.placed
    if scans is not None and config.align == "walls":
        normals = se2.rotate(graph.poses[scans.clouds.owner, 2], scans.clouds.normals)
    return map_frame.alignment(config.align, graph, placed, normals)


def _grid(
    drives: Drives, graph: Graph, config: MappingConfig, executor: Executor | None, stages: Stages
) -> OccupancyGrid | None:
    """Trace every scan from where the laser was at its first and last ray (paper: Bresenham, binary Bayes filter)."""
    sweeps = [_sweeps(session, graph) for session in drives.sessions if session.has_scans]
    if not sweeps:
        return None

    def announce(geometry: GridGeometry) -> None:
        """Say what a large grid will take; the caller may still stop."""
        if geometry.cells >= _LARGE_GRID:
            stages.tell(f"occupancy grid of {geometry.cells / 1e6:.0f} million cells, about {geometry.megabytes:.0f} MB", 0, 1)

    teller = stages.teller("occupancy grid")
    grid = occupancy_grid.from_sweeps(sweeps, config.grid, executor=executor, progress=teller, announce=announce)
    if config.crop is not None:
        grid = map_frame.cropped(grid, config.crop)
    stages.end("occupancy grid", scans=grid.scans_used, rows=grid.geometry.rows, cols=grid.geometry.cols)
    return grid


def _sweeps(session: Session, graph: Graph) -> Sweeps:
    """Return the scans of a recording with where its laser was."""
    scans, mounting, cal = session.log.scans, session.log.mounting, graph.calibration
    assert scans is not None
    correction = np.array([cal.get("laser_x"), cal.get("laser_y"), cal.get("laser_theta")])
    mount = se2.compose(correction, mounting.T_base_laser)
    first = scans.stamps + cal.get("laser_delay")
    last = first + scans.time_increment * (scans.ranges.shape[1] - 1)
    ends = [se2.compose(session.dense_trajectory(graph.poses, stamps), mount) for stamps in (first, last)]
    return Sweeps(scans, ends[0], ends[1], mounting.laser_flipped)


def _solver_figures(result: SolverSummary) -> dict[str, object]:
    return {
        "converged": result.converged,
        "reason": result.reason,
        "iterations": result.iterations,
        "chi2": round(result.chi2, 4),
        "dof": result.dof,
        "chi2_per_dof": round(result.chi2_per_dof, 4),
    }
