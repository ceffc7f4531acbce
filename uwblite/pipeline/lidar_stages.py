"""The walk's second half: what the lidar says, from scans to the joint refinement.

Clouds per keyframe are followed from one to the next, which makes sub-maps stiff and shows how late the lidar's clock
is; once loops are closed all overlapping clouds pull on all poses, and visits to one place are compared.
"""

from dataclasses import dataclass, replace

import numpy as np

from .. import keyframes
from ..arrays import Bools, Floats, Ints
from ..constraints import Clock, Constraints
from ..graph.calibration import RADIO, with_free, with_nonnegative_heights
from ..graph.graph import Edges, Graph
from ..graph.robust import SQUARED
from ..graph.solver import optimize
from ..lidar import clouds, joint_refinement, scan_matching, scan_to_scan, visibility
from ..lidar.clouds import Clouds
from ..lidar.joint_refinement import RefinementConfig, RefinementResult
from ..lidar.scan_matching import CloudRasters
from ..mapping_config import MappingConfig
from ..radio.range_measurements import learn_noise
from .progress import Stages, solver_figures
from .recordings import Estimate, Recording, Recordings

_BLOCK = 32
"""Keyframes whose rays are held at once."""


@dataclass(frozen=True, slots=True, eq=False)
class Scans:
    """Lidar of a run, ready for matching."""

    clouds: Clouds
    """One per keyframe."""
    raster: CloudRasters
    """Of the same clouds."""
    twist: Floats
    """(k, 3) velocity of the base at each keyframe, own frame, m/s, m/s, rad/s."""
    clock: Clock
    """When each keyframe was."""
    known: Constraints
    """What the user told; some pairs may be forbidden."""
    delay: float
    """Of the lidar's clock, s, with which the clouds were made."""

    def may_meet(self, i: Ints, j: Ints) -> Bools:
        """Tell which pairs of keyframes the user has not forbidden to match."""
        return self.known.allowed(self.clock, i, j)

    @classmethod
    def of(cls, recordings: Recordings, known: Constraints, config: MappingConfig, delay: float = 0.0) -> "Scans | None":
        """Make clouds of all recordings, the lidar's clock taken as late by `delay` s; None without lidar."""
        if not any(recording.has_scans for recording in recordings.each):
            return None
        built = clouds.joined([block for recording in recordings.each for block in _clouds(recording, config, delay)])
        raster = scan_matching.rasterize(built, config.clouds.raster, max(config.refinement.first_gate, 0.2))
        return cls(built, raster, recordings.twist, recordings.clock, known, delay)


def _clouds(recording: Recording, config: MappingConfig, delay: float) -> list[Clouds]:
    """Return the clouds of a recording's keyframes, a block at a time; empty ones without lidar."""
    log, frames = recording.log.with_later_scans(delay), recording.frames
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


def track(
    estimate: Estimate, scans: Scans, recordings: Recordings, config: MappingConfig, stages: Stages
) -> tuple[Estimate, RefinementResult, Scans]:
    """Track; where the lidar's clock turns out to be off by much, make the clouds anew with that and track again."""
    estimate, tracked = _track(estimate, scans, recordings, config, stages)
    for _ in range(_RETIMINGS):
        delay = estimate.graph.calibration.get("laser_delay")
        again = None if abs(delay - scans.delay) < _LATE else Scans.of(recordings, scans.known, config, delay)
        if again is None:
            break
        scans = again
        stages.end("clouds made anew", laser_delay=round(delay, 4))
        estimate, tracked = _track(estimate, scans, recordings, config, stages)
    return estimate, tracked, scans


_LATE = 0.015
"""s; the clouds' clock may be off by this much: a robot's velocity hardly changes meanwhile."""
_RETIMINGS = 3
"""How often clouds are made anew, at most; each time a quarter of the error is left."""


def _track(
    estimate: Estimate, scans: Scans, recordings: Recordings, config: MappingConfig, stages: Stages
) -> tuple[Estimate, RefinementResult]:
    """Match each cloud with those just before and after it, so that sub-maps are stiff."""
    rules = config.refinement
    # Ranges that lie would tear neighbours apart; softly pulled, neighbours keep the wheels' word until clouds correct it.
    soft = _softened(estimate)
    whole = replace(soft, wheels=replace(soft.wheels, kernel=SQUARED))
    graph = estimate.graph.with_estimates_of(optimize(estimate.graph.with_edges(*whole.edges), config.solver)[0])
    followed = scan_to_scan.follow(
        scans.clouds, scans.raster, estimate.wheels, graph, rules.first_gate, config.tracking, config.search
    )
    estimate, soft = replace(estimate, wheels=followed.wheels), replace(soft, wheels=followed.wheels)
    graph = graph.with_estimates_of(optimize(graph.with_edges(*soft.edges, followed.steps), config.solver)[0])
    gate = float(np.clip(followed.miss, rules.later_gate, rules.first_gate))
    settings = replace(rules, partners=0, rounds=rules.track_rounds, first_gate=gate)
    i, j = joint_refinement.choose_pairs(scans.clouds, graph.poses, recordings.path, recordings.of_keyframe, settings)
    graph, refined = _match_round(graph, soft.edges, scans, i, j, settings, config, stages, "tracking")
    stages.end(
        "tracking", pairs=len(i), searched=followed.searched, used=int(refined.used.sum()), gate=round(gate, 3),
        sigma=round(refined.sigma, 4), rounds=refined.rounds,
    )
    return replace(estimate, graph=graph), refined


def _softened(estimate: Estimate) -> Estimate:
    """Return the part with ranges that hold the trajectory only where nothing else does."""
    radio = estimate.radio
    return estimate if radio is None else replace(estimate, radio=replace(radio, sigma=radio.sigma * _SOFTNESS))


_SOFTNESS = 10.0
"""Factor on the ranges' standard deviations."""


def _match_round(
    graph: Graph, edges: tuple[Edges, ...], scans: Scans, i: Ints, j: Ints, settings: RefinementConfig,
    config: MappingConfig, stages: Stages, stage: str,
) -> tuple[Graph, RefinementResult]:
    """Refine a graph with these pairs of clouds (e,), (e,), those that the user has forbidden left out."""
    kept = scans.may_meet(i, j)
    i, j = i[kept], j[kept]
    refined = joint_refinement.refine(
        graph.with_edges(*edges),
        scans.clouds,
        scans.raster,
        scans.twist,
        i,
        j,
        settings,
        config.solver,
        stages.reporter(stage),
        scans.delay,
    )
    return graph.with_estimates_of(refined.graph), refined


def refine_jointly(
    estimate: Estimate, scans: Scans, recordings: Recordings, config: MappingConfig, stages: Stages
) -> tuple[Estimate, RefinementResult | None]:
    """Let all overlapping clouds pull on all poses; what the ranges weigh is learnt anew from where the lidar puts them."""
    if config.refinement.rounds == 0:
        return estimate, None
    graph, radio = estimate.graph, estimate.radio
    graph = with_free(graph, *RADIO) if radio is not None else graph
    refined: RefinementResult | None = None
    for lap in range(config.refinement.selections):
        edges = replace(estimate, radio=radio).edges
        i, j = joint_refinement.choose_pairs(
            scans.clouds, graph.poses, recordings.path, recordings.of_keyframe, config.refinement
        )
        settings = config.refinement
        if lap > 0:
            settings = replace(settings, first_gate=settings.later_gate)
        before = graph.poses
        graph, refined = _match_round(graph, edges, scans, i, j, settings, config, stages, "joint refinement")
        graph = with_nonnegative_heights(graph)
        shift = float(np.sqrt(np.mean(np.sum((graph.poses - before)[:, :2] ** 2, axis=1))))
        if radio is not None:
            radio, _ = learn_noise(radio, graph, len(graph.anchors), config.ranges, steady=True)
        stages.end(
            f"joint refinement {lap + 1}", pairs=len(i), used=int(refined.used.sum()), rounds=refined.rounds,
            sigma=round(refined.sigma, 4), shift=round(shift, 5), **solver_figures(refined.summary),
        )
        if shift < config.refinement.same_pairs:
            break
    return replace(estimate, graph=graph, radio=radio), refined


def check_map_consistency(estimate: Estimate, scans: Scans, recordings: Recordings, stages: Stages) -> None:
    """Compare what visits to the same place saw; doubt a map in which they saw through each other's walls."""
    share, visits = visibility.free_space_violation(scans.clouds, estimate.graph.poses, recordings.path, recordings.of_keyframe)
    stages.end("visits compared", visits=visits, free_space_violation=round(share, 4))
    if share > _DISAGREEMENT and visits >= _ENOUGH_VISITS:
        stages.doubts.append(
            f"{share:.0%} of what was seen on one visit to a place stands where another visit saw free space: "
            "parts of the map lie in a wrong place to each other"
        )


_DISAGREEMENT = 0.05
"""Share from which visits do not show the same place; people, glass and doors leave half of it."""
_ENOUGH_VISITS = 10
"""Views of another visit from which their disagreement counts."""
