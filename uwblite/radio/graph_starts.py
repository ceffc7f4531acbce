"""Starts for the optimisation of an imported graph: every chain and every anchor gets a place.

A descent ends in a local minimum, and further starts may lead to a lower one. Trajectories of several robots that
only ranges and landmarks connect are placed one after another, the best connected first, each rigid, by the ranges to placed
points (0 where the chain sees a landmark; trilateration.path_placements). The optimisation of the whole graph decides between
several hypotheses.

No descent from dead reckoning over kilometres finds the minimum: a path may also be straightened first by its ranges, outwards
from where its anchors are clearest, as that of a recording is (bootstrap_attempt.py).
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, Ints, concatenated
from ..graph.calibration import odometry_indices
from ..graph.chordal_start import chordal_start
from ..graph.graph import Graph
from ..graph.point_edges import LandmarkEdges, PointDistanceEdges, seen_anchors
from ..graph.pose_edges import OdometryEdges, RelativePoseEdges
from ..graph.problem_checks import given_anchors, tied_chains
from ..graph.range_edges import RangeEdges
from ..graph.unknowns import free_unknowns
from ..problem.alternatives import EvidencePolicy
from .bootstrap_attempt import Attempt, Measured
from .trilateration import TrilaterationConfig, path_placements, trilaterate

_CLEARLY = 0.02
"""Share of its cost by which another place of an anchor must be better; on noise alone minima differ by less."""
_MOST_RANGES, _LEAST_RANGES = 300, 4
"""Ranges used for one chain: more add no information; fewer are three unknowns and no check."""
_APART = 0.1
"""m and rad between places of a chain that are two."""
_CHAIN_SIGMA = 0.2
"""m; standard deviation of a range along a rigid chain: the error after some minutes of odometry."""


class Start(NamedTuple):
    """A graph to optimise."""

    graph: Graph
    unplaced: tuple[int, ...]
    """Anchors that could not be placed: they are fixed at the origin, and their ranges do not count."""

    def placed(self, optimised: Graph) -> Graph:
        """Return the graph as optimised from here; the anchors that could not be placed have no place (nan) in it."""
        unplaced = np.isin(np.arange(len(optimised.anchors)), self.unplaced)
        return replace(optimised, anchors=np.where(unplaced[:, None], np.nan, optimised.anchors))


def starts(graph: Graph, chains: Ints, elsewhere: Floats | None = None) -> Iterator[Start]:
    """Yield starts from the poses of each chain, the likeliest first; none where nothing ties some chain to the others.

    Parameters
    ----------
    graph : poses of each chain in a frame of its own; those of chain 0, and anchors that have a place, are where they are.
    chains : (n,) chain of each pose.
    elsewhere : (a, 2) m, places for anchors that these poses cannot place; nan, or None: there is none.
    """
    if tied_chains(graph, chains).all():
        for placed in place_chains(graph, chains):
            yield Start(*place_anchors(placed, elsewhere))


def starts_nearby(start: Start, optimised: Graph) -> Iterator[Start]:
    """Yield starts that may lead out of the minimum that was found: all poses by chordal_start, or anchors elsewhere."""
    for graph in (chordal_start(optimised), search_anchors(start.graph)):
        if graph is not None:
            yield Start(graph, start.unplaced)


def straightened(graph: Graph) -> Graph:
    """Return the graph with the poses of its one chain as odometry and ranges place them, unchanged without ranges.

    Anchors get the places found on the way (nan: none), but for those that are given. The path lies where given anchors, two
    at least, put it, else its first fixed pose.

    Parameters
    ----------
    graph : its poses follow the odometry; all are poses of one robot in the order of time.
    """
    ranges = [e for e in graph.edges if isinstance(e, RangeEdges) and len(e)]
    if not ranges:
        return graph
    motion = se2.between(graph.poses[:-1], graph.poses[1:])
    attempt = Attempt(
        Graph(graph.poses, np.zeros_like(graph.anchors)),
        Measured(
            _odometry(graph, motion),
            concatenated(ranges),
            np.append(0.0, np.cumsum(np.hypot(*motion[:, :2].T))),
            float(np.median(np.concatenate([e.sigma for e in ranges]))),
        ),
        TrilaterationConfig(),
    )
    attempt.run()
    known = given_anchors(graph) & attempt.placed
    first = int(np.argmin(free_unknowns(graph)["poses"]))
    moved = se2.compose(graph.poses[first], se2.inverse(attempt.poses[first]))
    if known.sum() > 1:
        moved = se2.align(attempt.anchors[known], graph.anchors[known])
    places = np.where(attempt.placed[:, None], se2.transform(moved, attempt.anchors), np.nan)
    return replace(
        graph,
        poses=se2.compose(moved, attempt.poses),
        anchors=np.where(given_anchors(graph)[:, None], graph.anchors, places),
    )


def _odometry(graph: Graph, motion: Floats) -> OdometryEdges:
    """Return the steps (n - 1, 3) between successive poses with the information of the edges that measured them; others are
    uncertain by 1 m and 1 rad."""
    each, root = np.arange(len(motion)), np.tile(np.eye(motion.shape[1]), (len(motion), 1, 1))
    for e in graph.edges:
        if isinstance(e, RelativePoseEdges):
            steps = e.rows(e.j == e.i + 1)
            root[steps.i] = steps.sqrt_information
    unknowns = odometry_indices(graph.calibration, len(motion))
    return OdometryEdges(each, each + 1, motion, motion[:, 0], np.ones(len(motion)), root, unknowns)


def ranges_to(edges: Iterable[RangeEdges], poses: Floats) -> tuple[Floats, Floats]:
    """Return positions (m, 2) of the tag at ranges along poses, and the distances (m,) in the plane that they measured, m."""
    places, distances = [np.zeros((0, 2))], [np.zeros(0)]
    for own in edges:
        places.append(own.tag_positions(poses))
        distances.append(own.planar_ranges())
    return np.concatenate(places), np.concatenate(distances)


def place_anchors(graph: Graph, elsewhere: Floats | None = None) -> tuple[Graph, tuple[int, ...]]:
    """Return the graph with a position for each anchor that has none, and the anchors that could not be placed.

    The poses are taken as they are; anchors without a position stand where a pose sees them, or are found from their ranges
    alone (trilateration.trilaterate), or have the place `elsewhere` (a, 2) where that is finite. Those that cannot be found
    are fixed at the origin with their ranges switched off.
    """
    graph = replace(graph, anchors=seen_anchors(graph))
    missing = np.flatnonzero(~np.isfinite(graph.anchors).all(axis=1))
    if not len(missing):
        return graph, ()
    anchors, lost = graph.anchors.copy(), []
    for anchor in missing.tolist():
        found = trilaterate(*ranges_to(_of_anchor(graph, anchor), graph.poses), TrilaterationConfig())
        if found:
            anchors[anchor] = found[0].position
        elif elsewhere is not None and np.isfinite(elsewhere[anchor]).all():
            anchors[anchor] = elsewhere[anchor]
        else:
            anchors[anchor] = 0.0
            lost.append(anchor)
    fixed = graph.fixed_anchors | np.isin(np.arange(len(anchors)), lost)
    edges = tuple(_without(e, lost) if isinstance(e, RangeEdges) and lost else e for e in graph.edges)
    return replace(graph, anchors=anchors, fixed_anchors=fixed, edges=edges), tuple(lost)


def search_anchors(graph: Graph) -> Graph | None:
    """Return the graph with anchors put where their ranges alone cost less from these poses, None where none does.

    An anchor that starts far away, or on the wrong side of a path, can end in a local minimum and bend the path there.
    """
    anchors = graph.anchors.copy()
    for anchor in np.flatnonzero(~graph.fixed_anchors).tolist():
        own = replace(graph, edges=_of_anchor(graph, anchor))
        found = trilaterate(*ranges_to(_of_anchor(graph, anchor), graph.poses), TrilaterationConfig())
        places, costs, tried = [graph.anchors[anchor], *(h.position for h in found)], [], graph.anchors.copy()
        for place in places:
            tried[anchor] = place
            costs.append(replace(own, anchors=tried).chi2())
        anchors[anchor] = places[int(np.argmin([(1.0 - _CLEARLY) * costs[0], *costs[1:]]))]
    return None if np.array_equal(anchors, graph.anchors) else replace(graph, anchors=anchors)


def _of_anchor(graph: Graph, anchor: int) -> tuple[RangeEdges, ...]:
    return tuple(e.rows(e.anchor == anchor) for e in graph.edges if isinstance(e, RangeEdges))


def _without(edges: RangeEdges, anchors: list[int]) -> RangeEdges:
    return replace(edges, weights=np.where(np.isin(edges.anchor, anchors), 0.0, edges.own_weights))


def place_chains(graph: Graph, chains: Ints) -> list[Graph]:
    """Return graphs with every chain placed, the likeliest first; see starts."""
    hypotheses = [(0.0, graph)]
    waiting, placed = set(chains.tolist()) - {0}, chains == 0
    while waiting:
        anchors = [_measured_from(g, placed) for _, g in hypotheses]
        chain = max(sorted(waiting), key=lambda c: len(_ties(hypotheses[0][1], anchors[0], chains == c, placed)[2]))
        of_chain = chains == chain
        found = [
            (cost + more, replace(g, poses=np.where(of_chain[:, None], se2.compose(T, g.poses), g.poses)))
            for (cost, g), in_map in zip(hypotheses, anchors, strict=True)
            for more, T in _places(*_ties(g, in_map, of_chain, placed))
        ]
        hypotheses = sorted(found, key=lambda h: h[0])[: EvidencePolicy.searched]
        waiting.remove(chain)
        placed = placed | of_chain
    return [g for _, g in hypotheses]


def _ties(graph: Graph, anchors: Floats, of_chain: Bools, placed: Bools) -> tuple[Floats, Floats, Floats]:
    """Return the distances by which a chain is tied to what is placed: points (r, 2) in the map, points (r, 2) in the chain's
    own frame, and how far apart these are (r,), m.

    Parameters
    ----------
    anchors : (a, 2) places in the map; nan = none. of_chain, placed : (n,) poses of the chain, and those placed in the map.
    """
    in_map, in_chain, distances = [np.zeros((0, 2))], [np.zeros((0, 2))], [np.zeros(0)]
    for e in graph.edges:
        if isinstance(e, PointDistanceEdges):
            for one, other in ((e.i, e.j), (e.j, e.i)):
                tied = of_chain[one] & placed[other]
                in_chain.append(graph.poses[one[tied], :2])
                in_map.append(graph.poses[other[tied], :2])
                distances.append(e.distance[tied])
        elif isinstance(e, RangeEdges | LandmarkEdges):
            tied = of_chain[e.pose] & np.isfinite(anchors[e.anchor]).all(axis=1)
            in_map.append(anchors[e.anchor[tied]])
            if isinstance(e, RangeEdges):
                in_chain.append(graph.poses[e.pose[tied], :2])
                distances.append(e.ranges[tied])
            else:
                in_chain.append(se2.transform(graph.poses[e.pose[tied]], e.position[tied]))
                distances.append(np.zeros(int(tied.sum())))
    every = max(-(-sum(map(len, distances)) // _MOST_RANGES), 1)
    return np.concatenate(in_map)[::every], np.concatenate(in_chain)[::every], np.concatenate(distances)[::every]


def _measured_from(graph: Graph, poses: Bools) -> Floats:
    """Return the anchors (a, 2), m, as placed by edges from some of the poses (n,); nan where there are none."""
    kinds = (e for e in graph.edges if isinstance(e, RangeEdges | LandmarkEdges))
    found, lost = place_anchors(replace(graph, edges=tuple(e.rows(np.flatnonzero(poses[e.pose])) for e in kinds)))
    anchors = found.anchors.copy()
    anchors[list(lost)] = np.nan
    return anchors


def _places(in_map: Floats, in_chain: Floats, distances: Floats) -> list[tuple[float, Floats]]:
    """Return (robust cost, T_map_chain) of the best places of a chain, apart from each other, by its ties (see _ties).

    Too few leave it where its own frame is.
    """
    if len(distances) < _LEAST_RANGES:
        return [(0.0, np.zeros(se2.POSE))]
    best: list[tuple[float, Floats]] = []
    for cost, motion, _ in path_placements(in_map, in_chain, distances, np.full(len(distances), 1.0 / _CHAIN_SIGMA)):
        if all(np.abs(se2.between(motion, other)).max() > _APART for _, other in best):
            best.append((cost, motion))
    return best[: EvidencePolicy.searched]
