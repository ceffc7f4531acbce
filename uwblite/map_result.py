"""Result of mapping: estimates, their covariances, and the stages by which they came about."""

from dataclasses import dataclass, field

import numpy as np

from .arrays import Bools, Floats, Ints
from .config import documented
from .findings import DOUBT, WARNING, Finding, of_severity
from .graph.calibration import HEIGHT
from .graph.graph import Graph, UnknownKey
from .graph.work import StageSummary
from .grid.occupancy_grid import OccupancyGrid


@documented
@dataclass(frozen=True, slots=True, eq=False)
class AnchorEstimate:
    """One anchor as the map has it."""

    id: str
    position: Floats
    """(2,) m, map frame; nan where the anchor could not be placed."""
    covariance: Floats
    """(2, 2) m^2."""
    ranges: int
    """Ranges in the recording."""
    used_share: float
    """Share of its ranges, 0..1, that agree with the map: within 3 times the scatter of ranges to a typical anchor."""
    bias: float
    """m, added to every range of this anchor."""
    bias_sigma: float
    """m."""
    residual_rms: float
    """Robust standard deviation of its range residuals, m."""
    status: str
    """'ok', 'mirror-ambiguous', 'unplaced' or 'distrusted'."""
    reason: str = ""
    """Why the status is not 'ok', in words."""
    alternative: Floats | None = None
    """(2,) the mirrored position, m, where the status is 'mirror-ambiguous'."""
    since: float = float("nan")
    """First range from this place, s, where the anchor was moved during the recording; else nan."""
    short: int = 0
    """Ranges shorter than the distance to its place, by more than noise."""


@documented
@dataclass(frozen=True, slots=True, eq=False)
class CalibrationEstimate:
    """One calibration value that the recording was asked for."""

    key: UnknownKey
    value: float
    sigma: float
    """Standard deviation, same unit."""
    unit: str
    meaning: str
    state: str
    """'estimated', or 'prior': the recording cannot show it."""
    reason: str = ""
    """Why it stayed at the prior."""

    @property
    def is_height(self) -> bool:
        """Whether it is the square of an anchor's height above or below the tag, m^2."""
        return self.key.kind == HEIGHT

    @property
    def name(self) -> str:
        """The key as text, such as ``bias:5C0B``."""
        return self.key.label


OUTCOMES = {
    "accepted": "accepted",
    "not-found": "the search found no place",
    "few-matches": "too few points match",
    "far-matches": "matches lie too far apart",
    "free-space-violation": "points would stand in free space",
    "degenerate": "the surfaces do not fix the pose",
    "ambiguous": "another place matches as well",
    "contradicts-graph": "contradicts the graph",
    "contradicts-closures": "contradicts the other closures",
    "not-converged": "the alignment did not converge",
    "forbidden": "forbidden by the constraints",
}
"""What may become of a candidate for a loop closure, and its name for people."""


@documented
@dataclass(frozen=True, slots=True, eq=False)
class LoopClosure:
    """One candidate pair of sub-maps or keyframes and what became of it."""

    i: int
    """Keyframe index of the target."""
    j: int
    """Keyframe index of the source."""
    T_i_j: Floats
    """(3,) measured pose of j in i."""
    information: Floats
    """(3, 3) in the chart e = Z^-1 (Xi^-1 Xj)."""
    fitness: float
    """Root mean square distance of matched points, m."""
    overlap: float
    """Share of source points that found a match, 0..1."""
    outcome: str
    """One of OUTCOMES."""
    reason: str
    """The outcome in words, with its figures."""

    @property
    def accepted(self) -> bool:
        """Whether it constrains the map."""
        return self.outcome == "accepted"


@documented
@dataclass(frozen=True, slots=True, eq=False)
class MapResult:
    """The map of one or more recordings."""

    stamps: Floats
    """(n,) s, one per odometry stamp, and one per keyframe or matched scan between two that are far apart."""
    trajectory: Floats
    """(n, 3) T_map_base at the stamps."""
    recording: Ints
    """(n,) which recording each stamp belongs to (all 0 for one recording)."""
    keyframe_stamps: Floats
    """(k,) s."""
    keyframe_recording: Ints
    """(k,) which recording each keyframe belongs to."""
    keyframe_covariances: Floats
    """(k, 3, 3) marginal covariance of each keyframe, map frame (relative to the first pose)."""
    graph: Graph
    """Final graph: poses are the keyframes."""
    anchors: tuple[AnchorEstimate, ...]
    calibration: tuple[CalibrationEstimate, ...]
    closures: tuple[LoopClosure, ...]
    """Accepted and rejected."""
    range_table: dict[str, Floats]
    """Per range: stamp (s), anchor (index into anchors), range (m), residual (m, measured minus expected), weight (0..1) in the
    last optimisation, agrees (1 or 0) as anchors' used_share counts it, x and y of the tag (m) and heading theta of the base
    (rad), map frame, recording (from 0)."""
    grid: OccupancyGrid | None
    """None without lidar."""
    stages: tuple[StageSummary, ...]
    findings: tuple[Finding, ...]
    """What to know about the result, in the order in which it was found."""
    shape_poses: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """(p, 3) poses all over the map."""
    shape_covariances: Floats = field(default_factory=lambda: np.zeros((0, 3, 3)))
    """(p, 3, 3) their covariances in the frame that fits all of them best: how far the map is bent there; m, m, rad."""

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """Warnings for the user."""
        return of_severity(self.findings, WARNING)

    @property
    def doubts(self) -> tuple[Finding, ...]:
        """Reasons not to trust the result; non-empty means exit code 3."""
        return of_severity(self.findings, DOUBT)

    @property
    def doubted_stretches(self) -> tuple[tuple[int, float, float], ...]:
        """(recording from 1, first and last time, s) of the stretches that doubts are about, in the order of time.

        Empty where nothing is doubted, and where a doubt is about the map as a whole.
        """
        if not all(finding.stretches for finding in self.doubts):
            return ()
        return tuple(sorted({(finding.recording, *span) for finding in self.doubts for span in finding.stretches}))

    def doubted_paths(self) -> list[Floats]:
        """Return x, y (n, 2), m, of the trajectory along each doubted stretch."""
        return [
            self.trajectory[(self.recording == number - 1) & (self.stamps >= first) & (self.stamps <= last), :2]
            for number, first, last in self.doubted_stretches
        ]

    def trusted(self, stamps: Floats, recording: Ints) -> Bools:
        """Return at which times (n,), s, of recordings (n,), from 0, no doubt concerns the pose."""
        if self.doubts and not self.doubted_stretches:
            return np.zeros(len(stamps), dtype=bool)
        trusted = np.ones(len(stamps), dtype=bool)
        for number, first, last in self.doubted_stretches:
            trusted &= (recording != number - 1) | (stamps < first) | (stamps > last)
        return trusted
