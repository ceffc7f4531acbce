"""Steps that the odometry got wrong are found again, what cannot be distinguished counts as not found."""

import numpy as np
import pytest
from helpers.laser_walks import CORRIDOR, HALL, scanned

from uwblite import se2
from uwblite.lidar.pair_alignment import Aligned
from uwblite.lidar.scan_matching import PairFactors
from uwblite.lidar.step_search import FoundStep, StepSearch, _apart, _chained, _measurably

PATH = np.array([[-1.0 + 0.3 * k, 0.5 + 0.05 * k, 0.05 * k] for k in range(6)])
STEPS = se2.between(PATH[:-1], PATH[1:])


def _bays():
    """Yield walls (x, width, y, other y) of a corridor along x with equal bays, 0.4 m of 0.8 m deep by 0.2 m."""
    for x in np.arange(-10.0, 10.0, 0.8):
        for y, out in ((2.0, 0.2), (-1.0, -0.2)):
            yield x, 0.4, y, y
            yield x + 0.4, 0.4, y + out, y + out
            yield x + 0.4, 0.0, y, y + out
            yield x + 0.8, 0.0, y + out, y


def searched(walls, wrong, *, reach=8.0):
    """Search for the last step of a path through walls, the odometry's guess of it being off by a pose (3,)."""
    clouds = scanned(PATH, walls, 0.01, reach=reach)
    guess = se2.compose(STEPS[4], np.array(wrong))
    steps = np.concatenate([STEPS[:4], guess[None]])
    return StepSearch(clouds, 0.3, 0.2).find(4, 0, steps, guess[None])


@pytest.mark.parametrize("wrong", [(0.0, 0.0, 0.0), (0.4, -0.3, 0.15), (-0.35, 0.3, -0.2)])
def test_a_wrong_guess_is_corrected(wrong):
    found = searched(HALL, wrong)
    assert found.clear
    # 120 points with noise of 1 cm fix a pose to some millimetres.
    np.testing.assert_allclose(found.pose, STEPS[4], atol=0.01)
    assert found.score > 0.8
    assert found.second < found.score


def test_a_right_guess_stands_in_no_free_space_and_a_wrong_one_does():
    assert not searched(HALL, (0.0, 0.0, 0.0)).contradicts
    assert searched(HALL, (0.5, -0.4, 0.3)).contradicts


def test_along_a_corridor_all_places_are_one_and_the_walls_fix_the_rest():
    found = searched(CORRIDOR, (0.5, 0.2, 0.15), reach=5.0)
    assert found.clear
    _, across, turn = se2.compose(PATH[4], found.pose) - se2.compose(PATH[4], STEPS[4])
    # The corridor runs along x; how far is the odometry's to say.
    assert abs(across) < 0.02
    assert abs(turn) < 0.01


def test_two_distinct_places_alike_are_not_clear():
    """A corridor with a bay every 0.8 m: the next bay fits as well as the true one."""
    bays = np.array([[x, y, x + w, y2] for x, w, y, y2 in _bays()])
    found = searched(bays, (0.4, 0.0, 0.0), reach=5.0)
    assert not found.clear
    assert found.second > found.score - 0.08


def test_views_are_chained_by_the_steps_between_them():
    views = np.array([1, 2, 3, 4])
    expected = se2.between(PATH[4], PATH[views])
    np.testing.assert_allclose(_chained(STEPS, views), expected, atol=1e-12)


def test_places_are_apart_by_distance_or_by_heading():
    here = np.array([1.0, 2.0, 3.0])
    others = se2.compose(here, np.array([[0.1, 0.1, 0.0], [0.11, 0.11, 0.0], [0.0, 0.0, 0.14], [0.0, 0.0, -0.16]]))
    assert _apart(here, others).tolist() == [False, True, False, True]


def test_a_place_that_has_not_converged_does_not_differ_from_itself():
    """Every search has a best place, also among scans that have nothing to do with each other."""
    poses, count = np.array([[0.0, 0.0, 0.0], [0.0, 2.0, 0.0]]), np.full(2, 100)
    hessian = np.tile(1000.0 * np.eye(3), (2, 1, 1))
    factors = PairFactors(hessian, 0.0 * hessian, np.full((2, 3), 500.0), count, count, np.ones(2), np.ones(2))
    np.testing.assert_array_equal(_measurably(0, Aligned(poses, factors)), [False, True])


@pytest.mark.parametrize(
    ("score", "second", "clear"),
    [(0.45, -1.0, True), (0.4499, -1.0, False), (0.75, 0.66, True), (0.75, 0.68, False), (0.58, 0.5, False)],
)
def test_a_step_is_clear_where_enough_matches_and_no_distinct_place_nearly_as_well(score, second, clear):
    assert FoundStep(np.zeros(3), score, second, 0.0).clear is clear
    assert [FoundStep(np.zeros(3), score, second, t).contradicts for t in (0.12, 0.121)] == [False, True]
