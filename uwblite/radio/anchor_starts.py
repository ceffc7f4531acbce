"""Starting positions for the anchors of an imported graph with ranges and no positions."""

from dataclasses import replace

import numpy as np

from ..arrays import Floats
from ..graph.graph import Graph
from ..graph.point_edges import seen_anchors
from ..graph.range_edges import RangeEdges
from .trilateration import TrilaterationConfig, trilaterate


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
        positions, ranges = _distances_to(graph, anchor)
        found = trilaterate(positions, ranges, TrilaterationConfig())
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

    An anchor that starts far away, or on the wrong side of a path, can end in a local minimum and bend the path there; the
    global search of trilateration avoids this.
    """
    anchors = graph.anchors.copy()
    for anchor in np.flatnonzero(~graph.fixed_anchors).tolist():
        own = replace(graph, edges=tuple(e.rows(e.anchor == anchor) for e in graph.edges if isinstance(e, RangeEdges)))
        found = trilaterate(*_distances_to(own, anchor), TrilaterationConfig())
        places = [graph.anchors[anchor], *(h.position for h in found)]
        costs = [_moved(own, anchor, place).chi2() for place in places]
        anchors[anchor] = places[int(np.argmin([(1.0 - _CLEARLY) * costs[0], *costs[1:]]))]
    return None if np.array_equal(anchors, graph.anchors) else replace(graph, anchors=anchors)


_CLEARLY = 0.02
"""Share of its cost by which another place of an anchor must be better; on noise alone minima differ by less."""


def _moved(graph: Graph, anchor: int, place: Floats) -> Graph:
    anchors = graph.anchors.copy()
    anchors[anchor] = place
    return replace(graph, anchors=anchors)


def _distances_to(graph: Graph, anchor: int) -> tuple[Floats, Floats]:
    """Return positions (m, 2) of the tag and ranges (m,) of one anchor, m."""
    positions, ranges = [np.zeros((0, 2))], [np.zeros(0)]
    for edges in graph.edges:
        if isinstance(edges, RangeEdges):
            own = edges.rows(edges.anchor == anchor)
            positions.append(own.tag_positions(graph.poses))
            ranges.append(own.ranges)
    return np.concatenate(positions), np.concatenate(ranges)


def _without(edges: RangeEdges, anchors: list[int]) -> RangeEdges:
    return replace(edges, weights=np.where(np.isin(edges.anchor, anchors), 0.0, edges.own_weights))
