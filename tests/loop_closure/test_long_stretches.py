"""Loops whose ends are known to many metres: closed where sub-maps fit at one place only, left open elsewhere."""

import numpy as np
import pytest
from helpers.laser_walks import returned

from uwblite import se2
from uwblite.graph.marginals import JointCovariance
from uwblite.lidar.correlative_matching import CorrelativeConfig
from uwblite.lidar.submaps import SubmapConfig, build, overlapping
from uwblite.lidar.visibility import observed_free_space
from uwblite.loop_closure.candidates import propose
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
    """Return truth, sub-maps, their free space and the uncertain pairs of a recording whose way back is known to 4 m."""
    truth, graph, path, clouds = returned(walls, 4.0, SHIFT)
    recording = np.zeros(len(truth), dtype=np.intp)
    pieces = build(clouds, graph.poses, path, recording, SubmapConfig(), overlapping)
    pairs = propose(graph, JointCovariance(graph, pieces.reference), pieces, recording, set(), False, CONFIG)
    free = observed_free_space(clouds, pieces, graph.poses)
    return truth, pieces, free, pairs.rows(np.flatnonzero(pairs.spread > CONFIG.direct))


@pytest.fixture(scope="module")
def unlike():
    return looked_for(UNLIKE)


def test_a_loop_is_closed_where_pillars_stand_unlike(unlike):
    """The guess is 7 m off; whatever is accepted is right, and something is."""
    truth, pieces, free, pairs = unlike
    found = find(pairs, pieces, free, CONFIG, CorrelativeConfig())
    error = se2.between(se2.between(truth[found.edges.i], truth[found.edges.j]), found.edges.T_i_j)
    assert len(found.edges) >= 2
    assert np.hypot(error[:, 0], error[:, 1]).max() < 0.1


def test_where_all_pillars_are_alike_none_is_accepted():
    _, pieces, free, pairs = looked_for(ALIKE)
    found = find(pairs.rows(slice(0, 12)), pieces, free, CONFIG, CorrelativeConfig())
    assert len(found.candidates)
    assert not len(found.edges)
    assert any(c.outcome == "ambiguous" for c in found.candidates)
