"""The value that each stage takes and returns: estimates, and the measurements behind them, by origin."""

from concurrent.futures import Executor
from dataclasses import dataclass, field, replace

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, Ints, rms_length
from ..constraints import Constraints
from ..graph.graph import Edges, Graph
from ..graph.pose_edges import OdometryEdges, ScanEdges
from ..graph.range_edges import RangeEdges
from ..graph.solver import Optimizer, SolverConfig, SolverSummary
from ..lidar.cloud_rasters import ScanClouds
from ..lidar.surface_rays import MeasuredSurfaces
from ..loop_closure.closures import Closures, no_closures
from ..odometry.slips import expected, slip_sigma
from ..problem.solution import solve
from ..radio.bootstrap_attempt import BootstrapResult
from .mapping_config import MappingConfig
from .progress import Stages
from .recordings import Recordings

_NEXT_TO_NOTHING = 0.1
"""Share of the poses that matches of clouds constrain, below which a lidar helps no map; in a nearly empty hall of 70 x 45 m,
where it does, they constrain a quarter."""


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """The further input of every stage, beside the estimate."""

    recordings: Recordings
    config: MappingConfig
    constraints: Constraints
    """Prior knowledge given by the user."""
    stages: Stages
    """Collects the stages' figures, warnings and doubts."""
    executor: Executor | None = None

    def following(self, estimate: "Estimate") -> "Task":
        """Return the task for the keyframes of an estimate."""
        return self if estimate.recordings is None else replace(self, recordings=estimate.recordings)

    def allowed(self, i: Ints, j: Ints) -> Bools:
        """Return which pairs of keyframes (e,), (e,) the user has not forbidden to match."""
        return self.constraints.allowed(self.recordings.clock, i, j)


@dataclass(frozen=True, slots=True)
class OtherHeights:
    """Heights of anchors that the ranges do not refute."""

    high: float
    """Height of the anchors above the tag where they are high, m."""
    taken: bool
    """Whether they are taken as high; otherwise as low."""
    apart: float
    """How far the trajectory under the hypothesis that is not taken is from the estimate, rms after alignment, m."""


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The estimate of one recording, or of several joined, after a stage."""

    graph: Graph
    """Estimates and priors; the user's prior knowledge is among its edges. After the final optimisation it holds every
    measurement."""
    odometry: OdometryEdges
    ranges: RangeEdges | None
    anchor_ids: tuple[str, ...]
    """(a,) of the graph's anchors."""
    bootstrap: BootstrapResult | None = None
    """None without ranges."""
    scans: ScanClouds | None = None
    """None without lidar, and again after the final optimisation."""
    steps: ScanEdges | None = None
    """Between neighbouring clouds; None before scan-to-scan matching."""
    rejected: Bools | None = None
    """(k,) keyframes whose step to the next the clouds measure falsely, see ScanOdometry; None = none."""
    closures: Closures = field(default_factory=no_closures)
    other_heights: OtherHeights | None = None
    other_side: Graph | None = None
    """Of a recording without lidar: another optimum of odometry and ranges; None where none was found."""
    recordings: Recordings | None = None
    """With the keyframes of the graph's poses; None while these are the task's."""
    joint: ScanEdges | None = None
    """Between all overlapping clouds, in place of steps and closures; None before the joint refinement."""
    surfaces: MeasuredSurfaces | None = None
    """To which the poses have been adjusted; None before that, and where there are none."""
    alone: tuple["Estimate", ...] = ()
    """Of each recording before they were joined; empty with one recording, and after the first optimisation."""

    @property
    def placed(self) -> Bools:
        """(a,) anchors that have a position."""
        return np.zeros(len(self.anchor_ids), dtype=bool) if self.bootstrap is None else self.bootstrap.placed

    @property
    def lidar(self) -> ScanClouds:
        """The clouds, for stages that run only where there are any."""
        assert self.scans is not None
        return self.scans

    @property
    def odometry_and_ranges(self) -> tuple[Edges, ...]:
        """The edges of the first optimisation."""
        wheels = expected(self.odometry)
        return (wheels,) if self.ranges is None else (wheels, self.ranges)

    @property
    def steps_and_closures(self) -> tuple[Edges, ...]:
        """The edges that the lidar adds before the joint refinement."""
        return (self.closures.edges,) if self.steps is None else (self.steps, self.closures.edges)

    @property
    def held_by_scans(self) -> Bools:
        """(k,) poses that some match of clouds constrains."""
        held = np.zeros(len(self.graph.poses), dtype=bool)
        for edges in (*self.graph.edges, self.steps, self.joint):
            if isinstance(edges, ScanEdges):
                held[edges.i] = held[edges.j] = True
        return held

    @property
    def slipped(self) -> Bools:
        """(e,) steps of the odometry whose noise is that of wheels that slip, or half of it at least."""
        noise = 1.0 / np.einsum("eii->ei", self.odometry.sqrt_information)
        return np.asarray((2.0 * noise > slip_sigma(self.odometry)).all(axis=1))

    @property
    def rests_on_ranges(self) -> bool:
        """Whether ranges alone determine the trajectory: there is no lidar, or it sees next to nothing."""
        return self.ranges is not None and float(self.held_by_scans.mean()) < _NEXT_TO_NOTHING

    @property
    def problem(self) -> Graph:
        """The graph with every measurement in it."""
        lidar = self.steps_and_closures if self.joint is None else (self.joint,)
        return self.graph.with_edges(*self.odometry_and_ranges, *lidar)

    def solved(self, config: SolverConfig, optimizer: Optimizer | None = None) -> tuple["Estimate", SolverSummary]:
        """Return the estimate at the optimum of all of its measurements, and how the search went; see problem/solution.py."""
        found, summary = solve(self.problem, config, optimizer)
        graph = replace(self.graph.with_estimates_of(found), fixed_calibration=found.fixed_calibration)
        return replace(self, graph=graph), summary

    def moved_since(self, poses: Floats) -> float:
        """Return how far its poses are from earlier ones (k, 3), root mean square, m."""
        return rms_length((self.graph.poses - poses)[:, :2])

    def with_estimates_of(self, solved: Graph) -> "Estimate":
        """Return the estimate with poses, anchors and calibration of a solved graph."""
        return replace(self, graph=self.graph.with_estimates_of(solved))

    def with_hypotheses_moved(self, motion: Floats) -> "Estimate":
        """Return the estimate with the bootstrap's hypotheses of anchors in a frame moved by T_new_old (3,)."""
        if self.bootstrap is None:
            return self
        moved = tuple(
            tuple(replace(h, position=se2.transform(motion, h.position)) for h in found) for found in self.bootstrap.hypotheses
        )
        return replace(self, bootstrap=replace(self.bootstrap, hypotheses=moved))
