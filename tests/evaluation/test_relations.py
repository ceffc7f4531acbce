"""Relations: the metric against numbers by hand, clocks, gaps, and relations without an answer."""

from itertools import pairwise

import numpy as np
import pytest
from helpers.planted import wander

from uwblite import se2
from uwblite.errors import DataError
from uwblite.evaluation.relations import evaluate_relations
from uwblite.evaluation.trajectory import covered


def related(stamps, poses, pairs):
    """Return the true relations between samples (r, 2) of a trajectory."""
    i, j = np.asarray(pairs).T
    return (stamps[i], stamps[j], se2.between(poses[i], poses[j]))


def test_the_truth_has_no_error_in_whatever_frame_and_order():
    stamps, truth = wander(np.random.default_rng(1), 20.0)
    pairs = np.random.default_rng(2).integers(len(stamps), size=(50, 2))
    moved = se2.compose(np.array([5.0, -3.0, 2.0]), truth)
    found = evaluate_relations(stamps, moved, related(stamps, truth, pairs))
    assert found.translations.max < 1e-9
    assert found.rotations.max < 1e-9
    assert found.far == 0.0
    assert found.answered.all()


def test_errors_are_those_of_the_relative_pose():
    """Straight on for 2 m, the second half 0.6 m too far to the left and turned by 0.1 rad."""
    stamps = np.arange(5.0)
    poses = np.column_stack([0.5 * stamps, np.zeros(5), np.zeros(5)])
    relations = (stamps[[0, 0, 3]], stamps[[1, 4, 4]], np.array([[0.5, 0, 0], [2.0, 0, 0], [0.5, 0, 0]]))
    wrong = poses.copy()
    wrong[3:] = se2.compose(np.array([1.5, 0.6, 0.1]), se2.between(poses[3], poses[3:]))
    found = evaluate_relations(stamps, wrong, relations)
    end = se2.between(np.array([2.0, 0.0, 0.0]), wrong[4])
    np.testing.assert_allclose(found.translation, [0.0, np.hypot(end[0], end[1]), 0.0], atol=1e-12)
    np.testing.assert_allclose(found.rotation, [0.0, 0.1, 0.0], atol=1e-12)
    assert found.translations.mean == pytest.approx(np.hypot(end[0], end[1]) / 3)
    assert found.far == pytest.approx(1 / 3)


def test_poses_are_asked_at_the_lidars_clock():
    stamps, truth = wander(np.random.default_rng(3), 20.0)
    taken = np.linspace(1.0, stamps[-1] - 1.0, 40)
    at = se2.interpolate_trajectory(stamps, truth, taken)
    relations = (taken[:-1] - 0.25, taken[1:] - 0.25, se2.between(at[:-1], at[1:]))
    assert evaluate_relations(stamps, truth, relations, delay=0.25).translations.max < 1e-9
    assert evaluate_relations(stamps, truth, relations).translations.max > 1e-3


def test_relations_without_an_answer_are_failures():
    stamps = np.concatenate([np.arange(0.0, 10.0), np.arange(40.0, 50.0)])
    poses = np.zeros((20, 3))
    first, second = np.array([1.0, 2.0, -3.0, 45.0]), np.array([3.0, 20.0, 1.0, 51.0])
    found = evaluate_relations(stamps, poses, (first, second, np.zeros((4, 3))))
    np.testing.assert_array_equal(found.answered, [True, False, False, False])
    assert found.translations.count == 1
    assert found.far == 0.75
    with pytest.raises(DataError, match="answers none of the 1 relations"):
        evaluate_relations(stamps, poses, (first[1:2], second[1:2], np.zeros((1, 3))))


def test_scans_at_the_ends_are_answered_though_the_clock_is_late():
    stamps = np.arange(0.0, 10.0, 0.1)
    ends = (stamps[:1], stamps[-1:], np.zeros((1, 3)))
    for delay in (-0.15, 0.15):
        assert evaluate_relations(stamps, np.zeros((len(stamps), 3)), ends, delay).answered.all()


@pytest.mark.parametrize("delay", [0.0, 0.5, -0.5])
@pytest.mark.parametrize("seed", range(3))
def test_a_scan_is_answered_between_poses_at_most_10_s_apart_at_the_lidars_clock(seed, delay):
    """One by one; the ends may be overhung by the delay and a rounded stamp."""
    rng = np.random.default_rng(seed)
    stamps = 100.0 + np.cumsum(np.append(0.0, rng.choice([0.5, 10.0, 10.5, 30.0], 12)))
    scans = np.concatenate([rng.uniform(99.0, stamps[-1] + 1.0, 200), stamps[:-1] + 0.3, stamps - 0.9e-3, stamps + 0.9e-3])
    expected = []
    for at in scans + delay:
        inside = stamps[0] - abs(delay) - 1e-3 <= at <= stamps[-1] + abs(delay) + 1e-3
        gap = next((b - a for a, b in pairwise(stamps) if at <= b), stamps[-1] - stamps[-2])
        expected.append((inside and gap <= 10.0) or np.abs(at - stamps).min() <= 1e-3)
    assert covered(stamps, scans + delay, 10.0, abs(delay) + 1e-3).tolist() == expected
    assert covered(stamps[:1], np.array([100.5, 100.1, 99.4]), 10.0, 0.501).tolist() == [True, True, False]
