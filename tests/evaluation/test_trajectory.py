"""Trajectory and anchor errors: laws of the alignment, known errors, stretches, agreement with evo."""

import numpy as np
import pytest
from hypothesis import strategies as st

from uwblite import se2
from uwblite.errors import DataError
from uwblite.evaluation.trajectory import evaluate_anchors, evaluate_trajectory, statistics, stretches


def a_recording(n=400, seed=0):
    rng = np.random.default_rng(seed)
    step = np.stack([rng.uniform(0.0, 0.1, n), np.zeros(n), rng.normal(0, 0.1, n)], axis=1)
    poses = [np.array([3.0, -2.0, 0.7])]
    for s in step[1:]:
        poses.append(se2.compose(poses[-1], s))
    return np.arange(n) * 0.05, np.array(poses)


finite = st.floats(-50, 50)


def test_statistics_of_known_errors():
    s = statistics(np.array([3.0, 4.0, 0.0, 0.0]))
    assert (s.rmse, s.mean, s.median, s.max, s.count) == (2.5, 1.75, 1.5, 4.0, 4)
    assert s.std == pytest.approx(np.sqrt(2.5**2 - 1.75**2))


def test_no_error_in_another_frame_and_at_other_stamps():
    stamps, poses = a_recording()
    moved = se2.compose(np.array([5.0, 1.0, 2.5]), poses)
    between = 0.5 * (stamps[:-1] + stamps[1:])
    truth = se2.interpolate_trajectory(stamps, poses, between)
    found = evaluate_trajectory(stamps, moved, between, truth)
    assert found.ate.rmse == pytest.approx(0.0, abs=1e-9)
    assert found.heading.rmse == pytest.approx(0.0, abs=1e-9)
    assert found.rpe_position.rmse == pytest.approx(0.0, abs=1e-9)
    assert found.ate.count == len(between)


def test_noise_is_measured_at_its_size():
    stamps, poses = a_recording(4000)
    noise = np.random.default_rng(2).normal(0, (0.05, 0.05, 0.02), poses.shape)
    found = evaluate_trajectory(stamps, poses + noise, stamps, poses)
    assert found.ate.rmse == pytest.approx(0.05 * np.sqrt(2), rel=4 / np.sqrt(2 * 4000))
    assert found.heading.rmse == pytest.approx(0.02, rel=5 / np.sqrt(2 * 4000))


def test_scale_error_stays_in_the_figure():
    stamps, poses = a_recording()
    longer = poses * [1.1, 1.1, 1.0]
    assert evaluate_trajectory(stamps, longer, stamps, poses).ate.rmse > 0.05 * np.std(poses[:, :2])


def test_truth_without_heading_is_judged_by_position_only():
    stamps, poses = a_recording()
    truth = poses * [1.0, 1.0, 0.0]
    found = evaluate_trajectory(stamps, poses, stamps, truth)
    assert found.heading is None
    assert found.rpe_position is None
    assert found.ate.rmse == pytest.approx(0.0, abs=1e-9)


def test_gaps_and_ends_of_the_estimate_are_left_out():
    stamps, poses = a_recording()
    keep = (stamps < 5.0) | (stamps > 8.0)
    found = evaluate_trajectory(stamps[keep], poses[keep], np.append(stamps, 100.0), np.vstack([poses, poses[-1:]]))
    left = np.append(stamps, 100.0)[found.matched]
    assert not np.any((left > 5.0) & (left < 8.0))
    assert left.max() == stamps[-1]


def test_other_clock_is_an_error_that_reports_so():
    stamps, poses = a_recording()
    with pytest.raises(DataError, match=r"only 0 of 400 .*same recording and clock"):
        evaluate_trajectory(stamps, poses, stamps + 1e6, poses)


@pytest.mark.parametrize("length", [0, 1])
def test_an_estimate_of_one_pose_or_none_cannot_be_compared(length):
    stamps, poses = a_recording(5)
    with pytest.raises(DataError, match=rf"only {length} of 5 true stamps \(0.000 .. 0.200 s\) lie within the trajectory"):
        evaluate_trajectory(stamps[:length], poses[:length], stamps, poses)
    with pytest.raises(DataError, match=rf"only {length} of {length} true stamps"):
        evaluate_trajectory(stamps, poses, stamps[:length], poses[:length])


def test_stretches_are_the_shortest_that_are_long_enough():
    way = np.cumsum(np.concatenate([[0.0], np.full(100, 0.25)]))
    points = np.stack([way, np.zeros_like(way)], axis=1)
    np.testing.assert_array_equal(stretches(points, 1.0), np.arange(0, 101, 4))
    np.testing.assert_array_equal(stretches(points, 1.1), np.arange(0, 101, 5))
    assert len(stretches(points, 1000.0)) == 1


@pytest.mark.parametrize(("length", "stretches_of_delta"), [(0.9, 0), (1.0, 1), (1.9, 1), (2.0, 2)])
def test_a_single_stretch_has_relative_errors_already(length, stretches_of_delta):
    """Along a line, an estimate that is 2 % too long: 2 cm per stretch of a metre."""
    way = np.arange(0.0, length + 0.05, 0.1)
    truth = np.column_stack([way, np.zeros(len(way)), 1e-12 * way])
    found = evaluate_trajectory(way, truth * [1.02, 1.0, 1.0], way, truth, rpe_delta=1.0)
    if stretches_of_delta:
        assert found.rpe_position.rmse == pytest.approx(0.02)
        assert found.rpe_heading.max == pytest.approx(0.0, abs=1e-12)
    else:
        assert found.rpe_position is None
        assert found.rpe_heading is None


def test_anchors_are_compared_by_name():
    motion = np.array([1.0, 2.0, 0.5])
    true = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0]])
    estimate = se2.transform(se2.inverse(motion), true[[2, 0]] + [[0.3, 0.4], [0.0, 0.0]])
    found = evaluate_anchors(("c", "a", "x"), np.vstack([estimate, [[np.nan, 0]]]), ("a", "b", "c"), true, motion)
    assert found.ids == ("a", "c")
    assert found.missing == ("b",)
    np.testing.assert_allclose(found.distances, [0.0, 0.5], atol=1e-12)
    assert found.rmse == pytest.approx(0.5 / np.sqrt(2))
    assert np.isnan(evaluate_anchors((), np.empty((0, 2)), ("a",), true[:1], motion).rmse)


@pytest.mark.parametrize("delta", [1.0, 3.0])
def test_agrees_with_evo(tmp_path, delta):
    pytest.importorskip("evo", reason="evo is not installed (a development dependency)")
    from evo.core import metrics, sync, trajectory
    from evo.tools import file_interface

    stamps, poses = a_recording(2000, seed=3)
    noisy = poses + np.cumsum(np.random.default_rng(4).normal(0, 2e-3, poses.shape), axis=0)
    moved = se2.compose(np.array([8.0, -3.0, 1.9]), noisy)
    for name, rows in (("truth.tum", poses), ("estimate.tum", moved)):
        half = 0.5 * rows[:, 2]
        table = np.column_stack([stamps, rows[:, :2], np.zeros((len(rows), 3)), np.sin(half), np.cos(half)])
        np.savetxt(tmp_path / name, table, fmt="%.17g")

    truth = file_interface.read_tum_trajectory_file(str(tmp_path / "truth.tum"))
    estimate = file_interface.read_tum_trajectory_file(str(tmp_path / "estimate.tum"))
    truth, estimate = sync.associate_trajectories(truth, estimate)
    estimate.align(truth)
    assert isinstance(estimate, trajectory.PoseTrajectory3D)
    expected = {}
    for name, relation in (
        ("position", metrics.PoseRelation.translation_part),
        ("heading", metrics.PoseRelation.rotation_angle_rad),
    ):
        ape = metrics.APE(relation)
        ape.process_data((truth, estimate))
        rpe = metrics.RPE(relation, delta, metrics.Unit.meters, pairs_from_reference=True)
        rpe.process_data((truth, estimate))
        expected[name] = ape.get_all_statistics(), rpe.get_all_statistics()

    found = evaluate_trajectory(stamps, moved, stamps, poses, rpe_delta=delta)
    ours = {"position": (found.ate, found.rpe_position), "heading": (found.heading, found.rpe_heading)}
    for name, pair in ours.items():
        for mine, theirs in zip(pair, expected[name], strict=True):
            for figure in ("rmse", "mean", "median", "std", "max"):
                assert getattr(mine, figure) == pytest.approx(theirs[figure], abs=1e-6), (name, figure)
