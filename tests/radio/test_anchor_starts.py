"""Anchors of other people's graphs that start in a wrong place."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted_graphs import loop
from scipy.optimize import brentq

from uwblite.radio import anchor_starts
from uwblite.radio.anchor_starts import place_anchors, search_anchors
from uwblite.radio.trilateration import AnchorHypothesis


def test_anchors_far_away_are_put_where_their_ranges_cost_less():
    graph, truth, where = loop(0)
    far = replace(graph, poses=truth, anchors=where + np.array([[60.0, -80.0], [0.0, 0.0], [0.0, 50.0]]))
    found = search_anchors(far).anchors
    # Ranges of 0.1 m from all around; the second stands where it was.
    np.testing.assert_allclose(found, where, atol=0.2)
    np.testing.assert_array_equal(found[1], where[1])


@pytest.mark.parametrize(("less", "put"), [(0.015, False), (0.025, True)])
def test_another_place_must_cost_a_fiftieth_less(monkeypatch, less, put):
    """An anchor so far off that its ranges cost so much more there than where the search finds it."""
    graph, truth, where = loop(0, anchors=1)
    at = replace(graph, poses=truth, anchors=where, edges=graph.edges[-1:])
    least = at.chi2()

    def moved(x):
        return replace(at, anchors=where + np.array([x, 0.0]))

    aside = brentq(lambda x: (1.0 - less) * moved(x).chi2() - least, 0.0, 1.0)
    hypothesis = AnchorHypothesis(where[0], 0.0, 0.1, 0.0, 0.0)
    monkeypatch.setattr(anchor_starts, "trilaterate", lambda *_: [hypothesis])
    found = search_anchors(moved(aside))
    assert (found is not None) == put
    assert not put or np.array_equal(found.anchors, where)


def test_anchors_in_their_places_and_fixed_ones_stay():
    graph, truth, where = loop(1)
    assert search_anchors(replace(graph, poses=truth, anchors=where)) is None
    assert search_anchors(replace(graph, anchors=where + 50.0, fixed_anchors=np.ones(3, dtype=bool))) is None


@pytest.mark.parametrize("fixed", [False, True])
def test_anchors_without_a_place_are_put_where_their_ranges_cost_least(fixed):
    """The first has two ranges only: it stays at the origin, and they count no more."""
    graph, truth, where = loop(2)
    *others, ranges = graph.edges
    few = ranges.rows(np.flatnonzero((ranges.anchor != 0) | (np.cumsum(ranges.anchor == 0) <= 2)))
    anchors = np.array([[np.nan, np.nan], [np.nan, np.nan], where[2]])
    given = np.array([False, False, fixed])
    found, lost = place_anchors(replace(graph, poses=truth, anchors=anchors, edges=(*others, few), fixed_anchors=given))
    assert lost == (0,)
    np.testing.assert_array_equal(found.anchors[[0, 2]], [[0.0, 0.0], where[2]])
    np.testing.assert_allclose(found.anchors[1], where[1], atol=0.2)
    assert found.fixed_anchors.tolist() == [True, False, fixed]
    assert found.edges[-1].own_weights.tolist() == np.where(few.anchor == 0, 0.0, few.own_weights).tolist()


def test_a_graph_whose_anchors_all_have_places_is_left_alone():
    graph, _, _ = loop(2)
    found, lost = place_anchors(graph)
    assert lost == ()
    np.testing.assert_array_equal(found.anchors, graph.anchors)
    assert found.edges is graph.edges
