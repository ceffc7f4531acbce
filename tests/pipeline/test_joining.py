"""Recordings become one: which of two recordings says where an anchor is, and which anchors do not join in."""

from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest

from uwblite import se2
from uwblite.errors import DataError
from uwblite.graph.graph import Graph
from uwblite.pipeline.joining import _FIRST_TOLERANCE, _laid_on, _one_bootstrap, _other_name
from uwblite.radio.bootstrap import BootstrapResult

STATES = [(False, False), (True, True), (True, False)]
"""Placed, ambiguous."""


def one_anchor(name, placed, ambiguous):
    """Return an estimate of one anchor whose hypotheses are its name and stay where they are."""
    bootstrap = BootstrapResult(Graph(np.zeros((1, 3))), np.array([placed]), ((name,),), np.array([ambiguous]))
    estimate = SimpleNamespace(bootstrap=bootstrap)
    estimate.with_hypotheses_moved = lambda motion: estimate
    return estimate


@pytest.mark.parametrize(("first", "second"), list(product(STATES, repeat=2)))
def test_the_clearer_of_two_recordings_says_where_an_anchor_is(first, second):
    """Placed and clear before placed before not placed; the first recording where both are alike."""
    estimates, worth = [one_anchor("one", *first), one_anchor("two", *second)], [a + (a and not b) for a, b in (first, second)]
    joined = _one_bootstrap(estimates, [np.zeros(3)] * 2, [np.array([0])] * 2, 1)
    assert joined.placed.tolist() == [max(worth) > 0]
    assert joined.ambiguous.tolist() == [max(worth) == 1]
    assert joined.hypotheses == (("two",) if worth[1] > worth[0] else ("one",),)


def test_anchors_of_one_recording_alone_keep_what_it_says_and_none_is_no_bootstrap():
    estimates = [one_anchor("one", True, True), SimpleNamespace(bootstrap=None), one_anchor("two", True, False)]
    estimates[1].with_hypotheses_moved = lambda motion: estimates[1]
    joined = _one_bootstrap(estimates, [np.zeros(3)] * 3, [np.array([2]), np.zeros(0, int), np.array([0])], 3)
    assert joined.hypotheses == (("two",), (), ("one",))
    assert (joined.placed.tolist(), joined.ambiguous.tolist()) == ([True, False, True], [False, False, True])
    assert _one_bootstrap(estimates[1:2], [np.zeros(3)], [np.zeros(0, int)], 0) is None


@pytest.mark.parametrize(("off", "moved"), [(0.9, False), (2.0, True)])
def test_an_anchor_that_lies_further_off_than_first_places_may_does_not_join_in(off, moved):
    """0.5 m, and twice the root of 0.2^2 + 0.15^2 m^2 = 0.25 m, which is 0.5 m more."""
    motion, recording = np.array([3.0, -2.0, 0.7]), SimpleNamespace(name="other.log")
    places = {"A": [0.0, 0.0], "B": [8.0, 0.0], "C": [0.0, 6.0], "D": [7.0, 7.0]}
    placed = {name: (np.array(place), 0.2) for name, place in places.items()}
    found = {name: (se2.transform(se2.inverse(motion), place), 0.15) for name, (place, _) in placed.items()}
    found["D"] = (se2.transform(se2.inverse(motion), placed["D"][0] + [off, 0.0]), 0.15)
    laid, gone = _laid_on(found, placed, recording)
    assert list(gone) == (["D"] if moved else [])
    if moved:
        np.testing.assert_allclose(laid, motion, atol=1e-6)
        assert gone["D"] == pytest.approx(off)
    with pytest.raises(DataError, match=r"other.log shares 1 placed anchors with the others \(B\)"):
        _laid_on({"B": found["B"], "X": found["A"]}, placed, recording)


def test_a_moved_anchor_is_called_as_the_earlier_recording_that_found_it_there():
    here, placed = np.array([2.0, 2.0]), {"A#2": (np.array([2.0, 2.6]), 0.0), "A#3": (np.array([2.0, 2.4]), 0.0)}
    assert _FIRST_TOLERANCE == 0.5
    assert _other_name("A", here, 0.0, 3, placed) == "A#3"
    assert _other_name("A", here, 0.06, 3, placed) == "A#2"
    assert _other_name("A", here, 0.0, 2, placed) == "A#3"
    assert _other_name("A", here + 5.0, 0.0, 3, placed) == "A#4"
