"""Places that a search found, against the present ones."""

import numpy as np

from uwblite import se2
from uwblite.localization import hypotheses
from uwblite.localization.comparison import PlaceSearch, _no_repetition
from uwblite.localization.known_map import KnownMap
from uwblite.localization.range_model import KnownAnchors, range_errors
from uwblite.localization.search import UNIT
from uwblite.localization.verdict import CERTAIN
from uwblite.localization.window import Window, WindowRange


def test_a_place_near_an_earlier_one_stays_only_if_it_is_far_better():
    poses = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.3, 0.1, 0.0], [2.0, 0.0, 0.0], [0.3, 0.0, 1.0]])
    weight = np.array([-10.0, -10.0 + CERTAIN - 0.1, -10.0 + CERTAIN + 0.1, -30.0, -30.0])
    np.testing.assert_array_equal(_no_repetition(poses, weight, 1), [True, False, True, True, True])
    np.testing.assert_array_equal(_no_repetition(poses, weight, 5), np.ones(5, bool))


def test_a_search_that_was_driven_through_compares_in_the_present_frame():
    """Ranges to four anchors tell place and heading: what is found hangs on the robot, however far it drove meanwhile."""
    anchors = np.array([[0.0, 0.0], [9.0, 1.0], [8.0, 8.0], [-1.0, 7.0]])
    stated = KnownAnchors(tuple("abcd"), anchors, *np.zeros((2, 4)), np.full(4, 0.05), np.full(4, 0.1))
    known = KnownMap(stated, None, np.zeros(3))
    path = np.column_stack([np.linspace(2.0, 6.0, 21), 3.0 + np.sin(np.linspace(0.0, 3.0, 21)), np.linspace(0.0, 0.8, 21)])
    window = Window()
    for k, pose in enumerate(path):
        for a, place in enumerate(anchors):
            metres = float(np.hypot(*(pose[:2] - place)))
            window.entries.append(WindowRange(a, metres, pose, np.zeros(2), 0.2 * k, 0.1 * k))
    places, driven = PlaceSearch(known), np.array([1.0, 0.3, 0.4])
    nobody, candidates = hypotheses.none(4), path[-1] + [[0.9, 0.7, 0.5]]
    places.begin(window, path[-1], 4.0, candidates)
    now = se2.compose(path[-1], driven)
    found = None
    while not places.idle:
        found, work = places.advance(nobody, now)
        assert work <= 2 * UNIT
    assert found is not None
    best = found.bank.poses[np.argmax(found.weight)]
    # Odometry and map have one frame here, and the ranges are exact.
    np.testing.assert_allclose(se2.between(now, best), 0.0, atol=0.05)
    # One that was there before is refined as those that are found.
    assert len(found.bank) > 1
    assert not hypotheses.apart(best, found.bank.poses[-1])
    error = range_errors(best[None], found.ranges)[0]
    np.testing.assert_allclose(error, 0.0, atol=0.1)
