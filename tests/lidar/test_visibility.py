"""Free space and the surfaces that stand in it: maps that fit together, and maps that were folded on purpose."""

import numpy as np
import pytest
from helpers.laser_walks import walked, with_a_walker

from uwblite import se2
from uwblite.lidar.submaps import SubmapConfig, build
from uwblite.lidar.visibility import (
    dynamic_share,
    free_space_violation,
    nearest_by_bearing,
    observed_free_space,
    static_points,
    violates_free_space,
)


@pytest.fixture(scope="module")
def hall():
    return walked(3)


def test_nearest_by_bearing_is_the_nearest_point_of_every_direction(hall):
    clouds = hall[2]
    nearest = nearest_by_bearing(clouds)
    bins = nearest.shape[1]
    points = clouds.cloud(7)[0]
    bearing = np.arctan2(points[:, 1], points[:, 0])
    for k in range(0, bins, 17):
        within = (bearing >= 2 * np.pi * k / bins - np.pi) & (bearing < 2 * np.pi * (k + 1) / bins - np.pi)
        expected = np.hypot(*points[within].T).min() if within.any() else np.inf
        assert nearest[7, k] == pytest.approx(expected)


def test_visits_agree_where_every_pose_is_true(hall):
    truth, path, clouds = hall
    share, within, visits = free_space_violation(clouds, truth, path, np.zeros(len(truth), dtype=np.intp))
    assert visits > 20
    assert share < 0.01
    assert within < 0.01


@pytest.mark.parametrize("error", [(2.0, 1.0, 0.0), (0.0, 0.0, 0.5)])
def test_visits_are_inconsistent_where_half_of_the_recording_lies_elsewhere(hall, error):
    truth, path, clouds = hall
    poses, half = truth.copy(), len(truth) // 2
    poses[half:] = se2.compose(np.array(error), truth[half:])
    share, within, _ = free_space_violation(clouds, poses, path, np.zeros(len(truth), dtype=np.intp))
    assert max(0.05, 3.0 * within) < share < 1.0


def test_one_visit_has_nothing_to_compare_with(hall):
    truth, path, clouds = hall
    share, _, visits = free_space_violation(clouds, truth, 0.01 * path, np.zeros(len(truth), dtype=np.intp))
    assert (share, visits) == (0.0, 0)


def test_one_keyframe_compared_with_many_is_one_visit(hall):
    """A person who stood before that one keyframe stands in all comparisons."""
    truth, path, clouds = hall
    again = next(k for k in range(len(truth) - 1, 0, -1) if np.sum(near(truth, k) & (path < path[k] - 10.0)) > 4)
    poses = truth + 1000.0 * np.outer(np.arange(len(truth)), (1, 0, 0))
    kept = near(truth, again) & (path < path[again] - 10.0)
    kept &= path < path[np.argmax(kept)] + 5.0
    kept[again] = True
    poses[kept] = truth[kept]
    share, _, visits = free_space_violation(clouds, poses, path, np.zeros(len(truth), dtype=np.intp))
    assert visits == 1
    assert share < 0.05


def near(poses, k):
    return np.hypot(*(poses[:, :2] - poses[k, :2]).T) < 1.5


def test_recordings_are_visits_of_their_own(hall):
    truth, path, clouds = hall
    recording = (np.arange(len(truth)) >= len(truth) // 2).astype(np.intp)
    assert free_space_violation(clouds, truth, 0.01 * path, recording)[2] > 0


def test_sub_maps_in_their_place_violate_no_free_space_and_elsewhere_they_do(hall):
    truth, path, clouds = hall
    pieces = build(clouds, truth, path, np.zeros(len(truth), dtype=np.intp), SubmapConfig(epsilon=4.0))
    free = observed_free_space(clouds, pieces, truth)
    where = truth[pieces.reference]
    pairs = ((a, b) for a in range(len(where)) for b in range(a + 2, len(where)))
    a, b = next((a, b) for a, b in pairs if np.hypot(*(where[a] - where[b])[:2]) < 2.0)
    points = [pieces.clouds.cloud(k)[0] for k in (a, b)]
    T_a_b = se2.between(where[a], where[b])
    assert violates_free_space(free[a], points[0], free[b], points[1], T_a_b) < 0.05
    assert violates_free_space(free[a], points[0], free[b], points[1], se2.compose(T_a_b, [1.5, 1.0, 0.0])) > 0.12


def test_people_violate_free_space_within_one_visit_as_they_do_between_two(hall):
    truth, path, clouds = hall
    share, within, _ = free_space_violation(with_a_walker(truth, clouds), truth, path, np.zeros(len(truth), dtype=np.intp))
    assert 0.01 < share < 1.5 * within


def test_what_moved_leaves_the_sub_maps_and_what_stands_stays(hall):
    truth, path, clouds = hall
    recording = np.zeros(len(truth), dtype=np.intp)
    settings = SubmapConfig(epsilon=4.0)
    quiet = build(clouds, truth, path, recording, settings)
    busy_clouds = with_a_walker(truth, clouds)
    busy = build(busy_clouds, truth, path, recording, settings)
    kept = [
        static_points(pieces, observed_free_space(own, pieces, truth)) for own, pieces in ((clouds, quiet), (busy_clouds, busy))
    ]
    assert len(kept[0].clouds.points) > 0.98 * len(quiet.clouds.points)
    walkers = [len(pieces.clouds.points) - len(quiet.clouds.points) for pieces in (busy, kept[1])]
    assert walkers[0] > 100
    # Not all: some stood where no other view of the sub-map looked.
    assert walkers[1] < 0.7 * walkers[0]


def test_dynamic_points_are_none_in_an_empty_hall_and_some_among_people(hall):
    truth, path, clouds = hall
    recording = np.zeros(len(truth), dtype=np.intp)

    def of(own):
        pieces = build(own, truth, path, recording, SubmapConfig(epsilon=4.0))
        return dynamic_share(pieces, observed_free_space(own, pieces, truth), truth, recording)

    assert of(clouds) < 0.05
    assert of(with_a_walker(truth, clouds)) > of(clouds) + 0.05


def test_sub_maps_of_different_recordings_do_not_follow_each_other(hall):
    truth, path, clouds = hall
    recording = np.arange(len(truth))
    pieces = build(clouds, truth, path, recording, SubmapConfig(epsilon=4.0))
    assert dynamic_share(pieces, observed_free_space(clouds, pieces, truth), truth, recording) == 0.0
