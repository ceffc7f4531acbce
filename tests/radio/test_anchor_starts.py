"""Anchors of other people's graphs that start in a wrong place."""

from dataclasses import replace

import numpy as np
from helpers.planted_graphs import loop

from uwblite.radio.anchor_starts import search_anchors


def test_anchors_far_away_are_put_where_their_ranges_cost_less():
    graph, truth, where = loop(0)
    far = replace(graph, poses=truth, anchors=where + np.array([[60.0, -80.0], [0.0, 0.0], [0.0, 50.0]]))
    found = search_anchors(far).anchors
    # Ranges of 0.1 m from all around; the second stands where it was.
    np.testing.assert_allclose(found, where, atol=0.2)
    np.testing.assert_array_equal(found[1], where[1])


def test_anchors_in_their_places_and_fixed_ones_stay():
    graph, truth, where = loop(1)
    assert search_anchors(replace(graph, poses=truth, anchors=where)) is None
    assert search_anchors(replace(graph, anchors=where + 50.0, fixed_anchors=np.ones(3, dtype=bool))) is None
