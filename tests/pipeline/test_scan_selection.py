"""Thinning: what is kept is what a map looks at, once and for all."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted import box, odometry, recording, scans, wander
from hypothesis import given, settings
from hypothesis import strategies as st

from uwblite import se2
from uwblite.grid.occupancy_grid import GridConfig
from uwblite.mapping import MappingConfig, build_map
from uwblite.odometry.attached import choose_scans
from uwblite.odometry.keyframes import KeyframeConfig, of
from uwblite.pipeline.calibration_checks import without_known_calibration
from uwblite.pipeline.recordings import prepared, thinned
from uwblite.sensor_log import Odometry, SensorLog

FRAMES, GRID = KeyframeConfig(), GridConfig()


def planted(seed, metres=12.0):
    """Return a recording whose robot wanders and drifts."""
    rng = np.random.default_rng(seed)
    stamps, truth = wander(rng, metres, speed=0.2)
    return recording(odometry(stamps, truth, rng, noise=0.02), None, scans(stamps, truth, box(12, 12)))


@settings(max_examples=8)
@given(st.integers(0, 100))
def test_what_is_kept_stays_and_holds_all_that_is_looked_at(seed):
    log = planted(seed)
    once = thinned(log, FRAMES, GRID)
    again = thinned(once, FRAMES, GRID)
    assert again is once
    kept = np.searchsorted(log.scans.stamps, once.scans.stamps)
    np.testing.assert_array_equal(log.scans.ranges[kept], once.scans.ranges)
    assert once.notes.scans_left_out == len(log.scans.stamps) - len(kept) > 0
    _, near = choose_scans(log.scans, of(log, FRAMES), FRAMES)
    assert np.isin(near, kept).all()
    # Between neighbours the laser moved no farther than half the grid's step and one more scan.
    poses = se2.interpolate_trajectory(log.odometry.stamps, log.odometry.poses, log.scans.stamps)
    step = np.hypot(*np.diff(poses[:, :2], axis=0).T).max()
    gaps = np.hypot(*np.diff(poses[kept, :2], axis=0).T)
    assert gaps.max() < 0.5 * GRID.move_distance + step


def test_a_map_of_the_thinned_recording_is_the_same_map():
    log = planted(3, 8.0)
    config = MappingConfig()
    whole, part = build_map(log, config), build_map(thinned(log, config.keyframes, config.grid), config)
    np.testing.assert_array_equal(whole.trajectory, part.trajectory)
    np.testing.assert_array_equal(whole.grid.log_odds, part.grid.log_odds)
    assert whole.grid.scans_used == part.grid.scans_used


def test_a_recording_is_prepared_once():
    config = MappingConfig()
    once = prepared(planted(4, 3.0), config)
    assert once.screening is not None
    assert once.notes.scans_left_out > 0
    again = prepared(once, config)
    assert (again.scans, again.odometry, again.notes) == (once.scans, once.odometry, once.notes)
    assert prepared(once, replace(config, use_lidar=False)).scans is None


@pytest.mark.parametrize("change", ["no scans", "all"])
def test_nothing_to_leave_out(change):
    log = planted(0, 3.0)
    if change == "no scans":
        log = log.without(lidar=True)
    grid = GRID if change == "no scans" else replace(GRID, move_distance=0.0)
    assert thinned(log, FRAMES, grid) is log


def test_no_offset_of_the_lidars_clock_where_the_format_excludes_one():
    """All recordings must exclude it: the settings are those of all."""
    log = SensorLog(Odometry(np.arange(3.0), np.zeros((3, 3))))
    bound = replace(log, notes=replace(log.notes, one_clock=True))
    config = MappingConfig()
    assert without_known_calibration(config, [bound, bound]).calibration.laser_delay == 0.0
    assert without_known_calibration(config, [bound, log]) == config
