"""Loop closures found so far, and the common settings of all searches for them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np

from .. import se2
from ..arrays import Bools, Floats
from ..config import setting
from ..graph.pose_edges import RelativePoseEdges
from ..lidar.scan_matching import PairPolicy
from ..lidar.scan_to_scan import TrackingConfig
from ..map_result import LoopClosure


@dataclass(frozen=True, slots=True)
class LoopClosureConfig:
    """Search and acceptance of loop closures."""

    method: Literal["search", "icp"] = "search"
    """search: candidates by the uncertainty of the graph, verified by all settings of this group. icp: the paper's method
    with the settings of [icp]; of this group it uses rounds, partners and correlation only."""
    partners: int = 4
    """Candidates per sub-map and round, best expected overlap first."""
    rounds: int = 4
    """Most rounds of searching and solving; ends early when a round finds nothing new."""
    direct: ClassVar[float] = 0.5
    """Matching starts from the graph's guess when its uncertainty (3 sigma) is below this, m; else a search comes first."""
    reach: float = setting(6.0, advanced=True)
    """Sub-maps whose middles lie farther apart than this, after the uncertainty is taken off, are no candidates, m."""
    search_limit: float = setting(8.0, advanced=True)
    """Largest half-width of a search among sub-maps, m. Where a pair is less certain, long stretches are compared first."""
    search_angle: ClassVar[float] = 0.7
    """Largest half-width of a search, rad."""
    gate: float = PairPolicy.gate
    """Outlier distance d of the final matching, m (the paper uses 0.1)."""
    sigma: float = 0.05
    """Fitness: greatest root mean square distance of matched points, m."""
    overlap: float = 0.4
    """Least share of points with a match when the graph's guess was good."""
    overlap_after_search: ClassVar[float] = 0.5
    """Least share of points with a match after a search, which can be fooled."""
    net_overlap: ClassVar[float] = 10.0
    """Least surface that speaks for a place of long stretches in every direction (see lidar/visibility.py), m, counted both
    ways: along a corridor, five metres of doors and pillars. Of 220 pairs searched over 20 m in four buildings, 49 of the 73
    best places that are right have more, and 4 of the 147 that are wrong, 3 where one corridor is a copy of another."""
    uniqueness: ClassVar[float] = 0.85
    """A second place that matches this share as well as the first makes a search ambiguous."""
    agrees: ClassVar[float] = 4.0
    """Standard deviations within which measurements of a pose agree; of its three directions together, by the Mahalanobis
    distance, 0.1 % are farther off. Where no radio holds the trajectory, one slip or false step puts a chain of steps wrong far
    beyond its covariance, and matches need to agree with the second optimisation alone."""
    points: ClassVar[int] = 250
    """Points looked up per pair."""
    match_sigma: ClassVar[float] = TrackingConfig.sigma
    """Standard deviation of a match, m."""
    correlation: float = setting(24.0, advanced=True)
    """Matches that together weigh as one: they share the bending of both sub-maps."""
    through: float = setting(0.12, advanced=True)
    """Largest share of one sub-map's points that may stand where the other saw free space. Where sub-maps driven one after
    the other have more, because people walk about, their share is the limit."""
    places: ClassVar[int] = 3
    """Places found by a search that are matched before one is chosen."""


@dataclass(frozen=True, slots=True, eq=False)
class Closures:
    """Closures found so far: accepted edges between keyframes, and the record of every candidate."""

    edges: RelativePoseEdges
    """One per accepted candidate, in their order."""
    candidates: tuple[LoopClosure, ...]

    def without(self, keep: Bools, outcome: str, reasons: Sequence[str]) -> "Closures":
        """Return the collection with some accepted candidates rejected.

        Parameters
        ----------
        keep : (e,) of the edges. outcome : of each other one. reasons : (e,) its outcome in words.
        """
        records, standing = list(self.candidates), [k for k, c in enumerate(self.candidates) if c.accepted]
        for k in np.flatnonzero(~keep).tolist():
            records[standing[k]] = replace(records[standing[k]], outcome=outcome, reason=reasons[k])
        return Closures(self.edges.rows(np.flatnonzero(keep)), tuple(records))


def collected(records: Sequence[LoopClosure], sqrt_information: Floats) -> Closures:
    """Return candidates, those accepted as edges, too, with the square roots (c, 3, 3) of their information."""
    good = np.array([closure.accepted for closure in records], dtype=bool)
    kept = [closure for closure in records if closure.accepted]
    i, j = (np.array([getattr(closure, end) for closure in kept], dtype=np.intp) for end in ("i", "j"))
    T_i_j = np.array([closure.T_i_j for closure in kept]).reshape(-1, *se2.POSE)
    return Closures(RelativePoseEdges(i, j, T_i_j, sqrt_information[good]), tuple(records))


def no_closures() -> Closures:
    """Return the empty collection."""
    return collected((), np.zeros((0, *se2.POSE, *se2.POSE)))


def merged(one: Closures, other: Closures) -> Closures:
    """Return both collections as one, with the kernel of the other's edges where it has any."""
    last = other if len(other.edges) else one
    edges = replace(one.edges.followed_by(other.edges), kernel=last.edges.kernel)
    return Closures(edges, one.candidates + other.candidates)
