"""The lidar's clock is found by the steps to which matching descends, before any is searched for."""

import numpy as np
import pytest
from helpers.planted import box, recording, scans, wander

from uwblite.constraints import Constraints
from uwblite.pipeline import neighbour_matching
from uwblite.pipeline.estimate import Task
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.pipeline.progress import Stages
from uwblite.pipeline.radio_stages import dead_reckoning
from uwblite.pipeline.recordings import gather
from uwblite.sensor_log import Odometry, SensorMounting


@pytest.mark.parametrize("late", [0.0, 0.08])
def test_keyframes_and_clouds_follow_the_lidar_s_clock(late):
    """Scans of a room whose stamps are late by a constant; the correction of a clock that is late is negative."""
    rng = np.random.default_rng(3)
    stamps, truth = wander(rng, 60.0)
    seen = scans(stamps, truth, box(9, 7), rate=10.0, beams=120, sweep=0.0)
    seen = seen.rows(np.arange(5, len(seen.stamps) - 5))
    log = recording(Odometry(stamps, truth), None, seen, mounting=SensorMounting()).with_later_scans(late)
    config = MappingConfig()
    recordings = gather([log], config.keyframes)
    task = Task(recordings, config, Constraints(), Stages(None, None))
    estimate = neighbour_matching.make_clouds(dead_reckoning(recordings.each[0], config), task)
    found, steps = neighbour_matching._with_clock_found(estimate, task)
    assert found.lidar.delay == pytest.approx(-late, abs=0.005)
    assert (found.recordings is None) == (late == 0.0)
    assert np.mean(steps.share[steps.enough]) > 0.8
    assert [stage.name for stage in task.stages.done].count("scan-to-scan matching") == 0
