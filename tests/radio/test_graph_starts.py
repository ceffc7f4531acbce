"""Starts for graphs that come from elsewhere."""

from dataclasses import replace

import numpy as np
from helpers.planted_graphs import loop

from uwblite import se2
from uwblite.graph.pose_edges import RelativePoseEdges
from uwblite.graph.solver import optimize
from uwblite.radio.graph_starts import Start, starts, starts_nearby


def test_an_anchor_of_two_ranges_has_a_place_only_where_one_is_given():
    graph, truth, where = loop(2)
    *others, ranges = graph.edges
    few = ranges.rows(np.flatnonzero((ranges.anchor != 0) | (np.cumsum(ranges.anchor == 0) <= 2)))
    graph = replace(graph, poses=truth, anchors=np.full((3, 2), np.nan), edges=(*others, few))
    chains = np.zeros(len(truth), dtype=np.intp)
    [start] = starts(graph, chains)
    assert start.unplaced == (0,)
    assert np.isnan(start.placed(start.graph).anchors).tolist() == [[True] * 2, [False] * 2, [False] * 2]
    [again] = starts(graph, chains, np.array([[1.0, 2.0], [7.0, 7.0], [np.nan, np.nan]]))
    assert again.unplaced == ()
    # The second and third have ranges of 0.1 m from all around.
    np.testing.assert_allclose(again.graph.anchors, [[1.0, 2.0], *where[1:]], atol=0.2)
    assert again.graph.edges[-1] is few
    assert not again.graph.fixed_anchors.any()


def test_chains_that_nothing_ties_to_the_first_have_no_start():
    graph, truth, _ = loop(2, anchors=0)
    alone = replace(graph, edges=(graph.edges[0],))
    assert list(starts(alone, np.arange(len(truth)) // 30)) == []
    assert len(list(starts(alone, np.zeros(len(truth), dtype=np.intp)))) == 1


def test_starts_nearby_have_the_headings_or_the_anchors_anew():
    graph, truth, where = loop(1)
    best = optimize(replace(graph, poses=truth, anchors=where))[0]
    turned = replace(best, poses=best.poses + [0.0, 0.0, 2.0] * (np.arange(len(truth)) > 0)[:, None])
    far = replace(best, anchors=where + 50.0)
    by_headings, by_anchors = starts_nearby(Start(far, (7,)), turned)
    relative = [e for e in graph.edges if isinstance(e, RelativePoseEdges)]
    # Chi2 of the relative poses within a fifth of the number of their residuals: the linear solution is near the minimum.
    assert sum(np.sum(e.residuals(by_headings.graph) ** 2) for e in relative) < 1.2 * sum(3 * len(e) for e in relative)
    assert np.abs(se2.wrap_angle(by_headings.graph.poses[:, 2] - truth[:, 2])).max() < 0.2
    np.testing.assert_allclose(by_anchors.graph.anchors, where, atol=0.3)
    assert by_headings.unplaced == by_anchors.unplaced == (7,)
    assert list(starts_nearby(Start(best, ()), replace(best, edges=best.edges[:1]))) == []
