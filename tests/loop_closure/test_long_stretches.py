"""Loops whose ends are known to many metres: closed where long stretches fit at one place only, left open elsewhere."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.laser_walks import returned

from uwblite import se2
from uwblite.graph.marginals import JointCovariance
from uwblite.lidar.correlative_matching import CorrelativeConfig
from uwblite.lidar.submaps import SubmapConfig, of_pieces
from uwblite.loop_closure.candidates import (
    any_uncertain,
    cut,
    first_of,
    overlap_probability,
    propose,
    uncertain_pairs,
)
from uwblite.loop_closure.closures import LoopClosureConfig
from uwblite.loop_closure.verification import find

CONFIG = LoopClosureConfig()
SHIFT = np.array([7.0, -3.0, 0.04])
"""m, m, rad; by what the way back is wrong."""


def corridor(places):
    """Return two walls with pillars of 0.4 m at places (p,) along both."""
    x = np.asarray(places)
    pillars = [
        [[a, s, a, 0.8 * s], [a, 0.8 * s, a + 0.4, 0.8 * s], [a + 0.4, 0.8 * s, a + 0.4, s]] for a in x for s in (-2.0, 2.0)
    ]
    walls = [[-20.0, -2.0, 70.0, -2.0], [70.0, 2.0, -20.0, 2.0]]
    return np.concatenate([np.array(walls), np.array(pillars).reshape(-1, 4)])


UNLIKE = corridor(np.cumsum(np.random.default_rng(3).uniform(1.2, 5.0, 24)) - 15.0)
ALIKE = corridor(np.arange(-15.0, 65.0, 2.5))


def looked_for(walls):
    """Return truth, stretches and their uncertain pairs of a recording whose way back is known to 4 m."""
    truth, graph, path, clouds = returned(walls, 4.0, SHIFT)
    recording = np.zeros(len(truth), dtype=np.intp)
    pieces = of_pieces(clouds, graph.poses, *cut(path, recording), SubmapConfig())
    covariance = JointCovariance(graph, pieces.reference)
    few = propose(graph, covariance, pieces, recording, set(), False, CONFIG)
    assert np.all(few.spread <= CONFIG.search_limit)
    return truth, pieces, uncertain_pairs(graph, covariance, pieces, recording, set(), False, CONFIG, CONFIG.direct)


@pytest.fixture(scope="module")
def unlike():
    return looked_for(UNLIKE)


def test_each_stretch_overlaps_the_next_of_its_recording_by_half():
    truth, graph, path, clouds = returned(UNLIKE[:2], 4.0, SHIFT)
    pieces = of_pieces(clouds, graph.poses, *cut(path, (np.arange(len(truth)) >= 75).astype(np.intp)), SubmapConfig())
    own = np.flatnonzero(pieces.last <= 75)
    length = path[pieces.last - 1] - path[pieces.first]
    assert np.all(pieces.first[own[1:]] < pieces.last[own[:-1]])
    assert np.all(length[own[:-1]] > 25.0)
    assert not np.any((pieces.first < 75) & (pieces.last > 75))


def test_pairs_that_need_a_search_are_listed_the_likeliest_first(unlike):
    """Without ranges, the window is twice as wide as the covariance says: biases of steps are not in it."""
    _, _, pairs = unlike
    assert len(pairs.target)
    assert pairs.long
    assert np.all(pairs.spread > CONFIG.direct)
    assert np.all(np.diff(overlap_probability(pairs.guess, pairs.covariance, 15.0)) <= 0.0)
    for constrained, wider in ((False, 2.0), (True, 1.0)):
        first = first_of(replace(pairs, constrained=constrained))
        assert len(first.target) == min(40, len(pairs.target))
        np.testing.assert_allclose(first.spread, wider * pairs.spread[: len(first.target)])
        np.testing.assert_allclose(first.covariance, wider**2 * pairs.covariance[: len(first.target)])


@pytest.mark.parametrize(("far", "expected"), [(1.0, False), (4.0, True)])
def test_what_a_search_of_sub_maps_reaches_needs_no_stretches(far, expected):
    _, graph, path, _ = returned(UNLIKE[:2], far, SHIFT)
    recording = np.zeros(len(path), dtype=np.intp)
    reference = cut(path, recording)[2]
    assert any_uncertain(graph, JointCovariance(graph, reference), reference, recording, CONFIG) == expected


def test_a_loop_is_closed_where_pillars_stand_unlike(unlike):
    """The guess is 7 m off; whatever is accepted is right, and something is."""
    truth, pieces, pairs = unlike
    found = find(pairs, pieces, CONFIG, CorrelativeConfig())
    error = se2.between(se2.between(truth[found.edges.i], truth[found.edges.j]), found.edges.T_i_j)
    assert len(found.edges) >= 2
    assert np.hypot(error[:, 0], error[:, 1]).max() < 0.1


def test_where_all_pillars_are_alike_none_is_accepted():
    _, pieces, pairs = looked_for(ALIKE)
    found = find(pairs.rows(slice(0, 2)), pieces, CONFIG, CorrelativeConfig())
    assert len(found.candidates)
    assert not len(found.edges)
    assert any(c.outcome == "ambiguous" for c in found.candidates)


def test_stretches_of_thirty_metres_begin_in_the_middle_of_the_one_before():
    """Two recordings of 75 m and 40 m, which no stretch has both of."""
    path = np.concatenate([np.arange(0.0, 75.0, 0.5), 1000.0 + np.arange(0.0, 40.0, 0.5)])
    recording = np.repeat([0, 1], [150, 80])
    first, last, reference = cut(path, recording)
    assert np.all(recording[first] == recording[last - 1])
    covered = path[last - 1] - path[first]
    begins = np.diff(path[first])[np.diff(recording[first]) == 0]
    # A rest at the end of a recording is shorter.
    assert np.median(begins) == 15.0
    assert begins.max() <= 17.5
    inner = np.append(recording[first[1:]] == recording[first[:-1]], False)
    assert np.median(covered[inner]) == 29.5
    assert covered.max() <= 32.5
    np.testing.assert_array_equal(reference, (first + last - 1) // 2)
    assert set(np.concatenate([np.arange(a, b) for a, b in zip(first, last, strict=True)])) == set(range(230))
