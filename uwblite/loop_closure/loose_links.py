"""Steps of the chain that no scan measures: clouds on one side of each are matched again with several on the other side.

A cloud made in a fast turn, behind people or over a gap in the scans may match neither neighbour; the chain then depends on one
step of the odometry, and an error of this step turns all poses before it.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, Ints
from ..graph.graph import Edges, Graph
from ..graph.pose_edges import OdometryEdges, RelativePoseEdges, ScanEdges
from ..lidar import submaps
from ..lidar.clouds import Clouds
from ..lidar.submaps import SubmapConfig, Submaps
from .candidates import Candidates
from .closures import LoopClosureConfig
from .slid_stretches import NEAR, directions_constrained, tied_parts

ANOTHER_VISIT = 10.0
"""Travelled distance between two visits, m."""


@dataclass(frozen=True, slots=True)
class LinkPolicy:
    """Links that no scan measures, and what is matched across them."""

    constrained: ClassVar[int] = 2
    """Least number of directions that scans fix in a measured link: along a bare corridor, only the odometry measures."""
    directions: ClassVar[int] = 3
    """Directions of a pose."""
    views: ClassVar[int] = 6
    """Keyframes of one side that make its sub-map; fewer do not count as a part of a map."""
    single: ClassVar[int] = 3
    """Keyframes of the other side that are each matched with it: after more, the views no longer overlap."""
    points: ClassVar[int] = 30
    """Clouds with fewer points are not matched."""
    distance: ClassVar[float] = 1.2
    """Half-width of the search, m: an odometry that stands still while the robot turns fast is not wrong by more in one
    step."""
    exceptions: ClassVar[int] = 5
    """Links up to which they are exceptions."""
    share: ClassVar[float] = 0.02
    """The same as a share of all steps; a lidar that loses more sees too little for a search."""
    far: ClassVar[float] = 10.0
    """Standard deviations from which a match contradicts the odometry."""


def loose_links(wheels: OdometryEdges, graph: Graph) -> Ints:
    """Return the steps of the odometry (l,) that scan edges do not fix; none where these are no exceptions."""
    links = np.flatnonzero(directions_constrained(graph)[wheels.i] < LinkPolicy.constrained)
    return links if len(links) <= max(LinkPolicy.exceptions, LinkPolicy.share * len(wheels)) else links[:0]


def untied_breaks(wheels: OdometryEdges, graph: Graph, measured: Bools, path: Floats) -> Ints:
    """Return the steps (b,) that no odometry measured (e,) and scan edges, of all visits, leave free in some direction.

    Along a bare corridor a lidar alone does not measure the distance. Clouds that are neither neighbours nor of another
    visit were matched at the poses of the chain, and add no information to it.

    Parameters
    ----------
    path : (k,) travelled distance, m.
    """
    near_or_again = replace(graph, edges=tuple(_near_or_again(e, path) for e in graph.edges))
    part = tied_parts(wheels, near_or_again, LinkPolicy.directions, measured)
    large = np.flatnonzero(np.bincount(part)[part] >= LinkPolicy.views)
    if not len(large):
        return large
    # A few keyframes between two breaks do not form a part: they belong to the part before.
    of = part[large[np.maximum(np.searchsorted(large, np.arange(len(part)), "right") - 1, 0)]]
    return np.flatnonzero(~measured & (of[wheels.i] != of[wheels.j]))


def _near_or_again(edges: Edges, path: Floats) -> Edges:
    """Return the scan edges between neighbours and between visits; other edges as they are."""
    if not isinstance(edges, ScanEdges):
        return edges
    near, again = np.abs(edges.i - edges.j) <= NEAR, np.abs(path[edges.i] - path[edges.j]) > ANOTHER_VISIT
    return edges.rows(np.flatnonzero(near | again))


def spanned(wheels: OdometryEdges, ties: RelativePoseEdges) -> Bools:
    """Return which steps of the odometry (e,) are spanned by edges between the two sides of links."""
    low, high = np.minimum(ties.i, ties.j), np.maximum(ties.i, ties.j)
    return np.any((wheels.i[:, None] >= low) & (wheels.j[:, None] <= high), axis=1)


def contradicted(wheels: OdometryEdges, graph: Graph) -> Bools:
    """Return which steps of the odometry (e,) a graph is far from."""
    return np.asarray(np.abs(wheels.residuals(graph)).max(axis=1, initial=0.0) > LinkPolicy.far)


def loosened(wheels: OdometryEdges, steps: Bools, config: LoopClosureConfig) -> OdometryEdges:
    """Return the odometry with the uncertainty of slipping wheels in some steps (e,)."""
    root = wheels.sqrt_information.copy()
    root[steps] = np.diag(1.0 / np.array([config.slip, config.slip, config.slip_angle]))
    return replace(wheels, sqrt_information=root)


def propose(
    graph: Graph,
    clouds: Clouds,
    wheels: OdometryEdges,
    links: Ints,
    recording: Ints,
    config: LoopClosureConfig,
    merging: SubmapConfig,
) -> tuple[Candidates, Submaps]:
    """Return candidates that connect the two sides of links (l,), and the pieces of the recording that are matched for them.

    Parameters
    ----------
    clouds : one per keyframe. recording : (k,). merging : how several clouds become one.
    """
    first, last, reference = _pieces(wheels.i[links], wheels.j[links], clouds, recording)
    made = submaps.of_pieces(clouds, graph.poses, first.reshape(-1), last.reshape(-1), reference.reshape(-1), merging)
    target = 2 * np.arange(len(first))
    guess = se2.between(graph.poses[reference[:, 0]], graph.poses[reference[:, 1]])
    covariance = np.tile(np.diag([config.slip**2, config.slip**2, config.slip_angle**2]), (len(target), 1, 1))
    return Candidates(target, target + 1, guess, covariance, np.full(len(target), LinkPolicy.distance), False), made


def _pieces(before: Ints, after: Ints, clouds: Clouds, recording: Ints) -> tuple[Ints, Ints, Ints]:
    """Return the pieces that are matched across links from keyframes before (l,) to after (l,): several clouds and a single
    one.

    Returns
    -------
    First keyframe (c, 2), one past the last and reference keyframe of both pieces of each candidate.
    """
    start = np.searchsorted(recording, recording[before])
    end = np.searchsorted(recording, recording[before], "right")
    # A sub-map across another link would itself contain an unmeasured step.
    sound, until = start.copy(), end.copy()
    sound[1:] = np.maximum(sound[1:], after[:-1])
    until[:-1] = np.minimum(until[:-1], before[1:] + 1)
    parts = []
    for n in range(LinkPolicy.single):
        behind, ahead = before - n, after + n
        onto = np.maximum(before + 1 - LinkPolicy.views, sound), before + 1, before, ahead, ahead + 1, ahead
        back = after, np.minimum(after + LinkPolicy.views, until), after, behind, behind + 1, behind
        parts += [np.stack(onto, axis=1)[ahead < end], np.stack(back, axis=1)[behind >= start]]
    pieces = np.concatenate(parts).reshape(-1, 2, 3)
    pieces = pieces[clouds.counts[pieces[:, 1, 2]] >= LinkPolicy.points]
    return pieces[..., 0], pieces[..., 1], pieces[..., 2]
