"""The lidar's clock, and how long a scan takes, are found by the steps to which matching descends, before any search."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted import box, odometry, ranges, recording, scans, wander
from helpers.told import told

from uwblite import se2
from uwblite.constraints import Constraints
from uwblite.pipeline import calibration_checks, neighbour_matching
from uwblite.pipeline.estimate import Task
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.pipeline.progress import Stages
from uwblite.pipeline.radio_stages import dead_reckoning, first_optimisation
from uwblite.pipeline.recordings import gather
from uwblite.sensor_log import Odometry, OdometryBreaks, Screening, SensorMounting


def descended(log):
    """Return the task of a recording, and its estimate and steps by the odometry and the clouds."""
    config = MappingConfig()
    recordings = gather([log], config.keyframes)
    task = Task(recordings, config, Constraints(), Stages(None, None))
    estimate = neighbour_matching.make_clouds(dead_reckoning(recordings.each[0], config), task)
    return task, *neighbour_matching._descended(estimate, task)


@pytest.mark.parametrize("late", [0.0, 0.08])
def test_keyframes_and_clouds_follow_the_lidar_s_clock(late):
    """Scans of a room whose stamps are late by a constant; the correction of a clock that is late is negative."""
    rng = np.random.default_rng(3)
    stamps, truth = wander(rng, 60.0)
    seen = scans(stamps, truth, box(9, 7), rate=10.0, beams=120, sweep=0.0)
    seen = seen.rows(np.arange(5, len(seen.stamps) - 5))
    log = recording(Odometry(stamps, truth), None, seen, mounting=SensorMounting()).with_later_scans(late)
    task, estimate, steps = descended(log)
    found, steps = neighbour_matching._with_clock_found(estimate, steps, task)
    assert found.lidar.delay == pytest.approx(-late, abs=0.005)
    assert (found.recordings is None) == (late == 0.0)
    assert np.mean(steps.share[steps.enough]) > 0.8
    assert [stage.name for stage in task.stages.done].count("scan-to-scan matching") == 0


@pytest.mark.parametrize(
    ("takes", "stated", "flipped"),
    [(0.1, 0.0, False), (0.1, 0.0, True), (0.2, 0.1, False), (0.1, 0.1, False), (0.0, 0.0, True)],
)
def test_a_scan_takes_as_long_as_clouds_of_other_headings_show(takes, stated, flipped):
    """Rays of a turning lidar, each cast at its own time; the log gives them the right middle and another duration."""
    rng = np.random.default_rng(4)
    stamps, truth = wander(rng, 80.0)
    mounting = SensorMounting(T_base_laser=np.array([0.1, 0.05, 0.4]), laser_flipped=flipped)
    walls = np.concatenate([box(13, 11), box(1.5, 1.5) + 1.5])
    seen = scans(stamps, truth, walls, beams=240, sweep=takes, noise=0.01, rng=rng, mounting=mounting)
    seen = replace(seen.rows(np.arange(5, len(seen.stamps) - 5)), time_increment=0.0, stamps=seen.stamps[5:-5] + 0.5 * takes)
    log = recording(Odometry(stamps, truth), None, seen, mounting=mounting).with_longer_scans(stated)
    task, estimate, steps = descended(log)
    found, steps = neighbour_matching._with_duration_found(estimate, steps, task)
    facts = [fact.figures for fact in task.stages.facts if fact.kind == "scan-duration"]
    if takes == stated:
        assert found is estimate
        assert not facts
        return
    (scans_now,) = (r.log.scans for r in found.recordings.each)
    assert scans_now.duration == pytest.approx(takes, abs=calibration_checks.TOLERANCE)
    np.testing.assert_allclose(scans_now.middles, seen.middles, atol=1e-9)
    assert facts[0]["stated"] == pytest.approx(stated)
    assert facts[0]["duration"] == scans_now.duration
    (finding,) = told(task.stages.facts)
    assert (finding.severity, finding.recording) == ("warning", 1)
    assert f"a scan takes {scans_now.duration:.3f} s" in finding.text
    assert f"`laser_time_increment` to {scans_now.duration / 239:.6f} s" in finding.text
    assert f"stamp scans {0.5 * (scans_now.duration - stated):.3f} s earlier" in finding.text
    assert np.mean(steps.share[steps.enough]) > 0.8


def test_a_duration_that_is_switched_off_stays_as_stated():
    rng = np.random.default_rng(4)
    stamps, truth = wander(rng, 30.0)
    seen = replace(scans(stamps, truth, box(13, 11), beams=240, sweep=0.1), time_increment=0.0)
    task, estimate, steps = descended(recording(Odometry(stamps, truth), None, seen, mounting=SensorMounting()))
    assert calibration_checks.missing_durations(estimate, steps, task)[1].all()
    received = replace(task.recordings.each[0].log, screening=Screening((), OdometryBreaks.none(), in_bursts=("odometry",)))
    each = (replace(task.recordings.each[0], log=received),)
    bursts = replace(task, recordings=replace(task.recordings, each=each))
    assert not calibration_checks.missing_durations(estimate, steps, bursts)[1].any()
    off = replace(task.config, calibration=replace(task.config.calibration, scan_duration=0.0))
    assert neighbour_matching._with_duration_found(estimate, steps, replace(task, config=off))[0] is estimate


@pytest.mark.parametrize("scale", [0.85, 1.15])
def test_turns_that_the_wheels_count_wrongly_are_no_duration_of_scans(scale):
    """Rays are placed by the wheels' turns: where these are wrong by some share, so seems a duration that is stated rightly."""
    rng = np.random.default_rng(4)
    stamps, truth = wander(rng, 80.0)
    walls = np.concatenate([box(13, 11), box(1.5, 1.5) + 1.5])
    seen = scans(stamps, truth, walls, beams=240, sweep=0.1, noise=0.01, rng=rng)
    task, estimate, steps = descended(recording(odometry(stamps, truth, turn_scale=scale), None, seen))
    assert not calibration_checks.missing_durations(estimate, steps, task)[1].any()


def test_an_error_that_grows_when_it_is_corrected_is_not_one_of_the_duration(monkeypatch):
    rng = np.random.default_rng(4)
    stamps, truth = wander(rng, 20.0)
    seen = scans(stamps, truth, box(13, 11), beams=120, sweep=0.0)
    task, estimate, steps = descended(recording(Odometry(stamps, truth), None, seen, mounting=SensorMounting()))
    shown = iter([(0.015, True), (0.022, True), (0.015, True)])
    monkeypatch.setattr(calibration_checks, "missing_durations", lambda *_: tuple(np.array([v]) for v in next(shown)))
    found, _ = neighbour_matching._with_duration_found(estimate, steps, task)
    assert found.recordings.each[0].log.scans.duration == 0.0
    np.testing.assert_array_equal(found.lidar.clouds.points, estimate.lidar.clouds.points)
    assert not task.stages.facts


def test_an_offset_that_grows_when_it_is_corrected_is_no_constant_of_the_clock(monkeypatch):
    rng = np.random.default_rng(4)
    stamps, truth = wander(rng, 20.0)
    seen = scans(stamps, truth, box(13, 11), beams=120, sweep=0.0)
    seen = seen.rows(np.arange(5, len(seen.stamps) - 5))
    task, estimate, steps = descended(recording(Odometry(stamps, truth), None, seen, mounting=SensorMounting()))
    shown = iter([0.02, 0.05])
    monkeypatch.setattr(calibration_checks, "late", lambda *_: next(shown))
    found, _ = neighbour_matching._with_clock_found(estimate, steps, task)
    assert found.lidar.delay == 0.0
    np.testing.assert_allclose(found.recordings.each[0].frames.stamps, task.recordings.each[0].frames.stamps, atol=1e-9)
    (fact,) = task.stages.facts
    assert (fact.kind, fact.figures) == ("clock-offset", {"offset": 0.02})


def test_a_step_over_which_the_wheels_slip_gets_keyframes_at_the_scans_within_it():
    """In a recording with ranges, which judge the path; between these scans the wheels still count what does not slip."""
    rng = np.random.default_rng(3)
    stamps, truth = wander(rng, 30.0)
    slip = (stamps[:-1] > 20.0) & (stamps[:-1] < 21.0)
    motion = se2.between(truth[:-1], truth[1:]) * np.where(slip, 3.0, 1.0)[:, None]
    places = np.array([[4.0, 3.0], [-4.0, 3.2], [3.8, -3.0], [-4.2, -2.8]])
    radio = ranges(rng, stamps, truth, places, sigma=0.05)
    seen = scans(stamps, truth, box(11, 10), rate=10.0, beams=180, sweep=0.0, noise=0.01, rng=rng)
    log = recording(Odometry(stamps, se2.chain(truth[0], motion)), radio, seen, mounting=SensorMounting(anchor_height=0.0))
    config = MappingConfig()
    task = Task(gather([log], config.keyframes), config, Constraints(), Stages(None, None))
    found = neighbour_matching.match_scan_to_scan(first_optimisation(task), task)
    added = np.setdiff1d(found.recordings.stamps, task.recordings.stamps)
    assert 0 < len(added) <= 3 * neighbour_matching.NeighbourPolicy.cuts
    assert np.all((added > 19.0) & (added < 22.0))
    true = se2.interpolate_trajectory(stamps, truth, found.recordings.stamps)
    off = se2.between(se2.between(true[:-1], true[1:]), se2.between(found.graph.poses[:-1], found.graph.poses[1:]))
    assert np.hypot(*off[:, :2].T).max() < 0.05
