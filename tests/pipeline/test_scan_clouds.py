"""Clouds of keyframes: after keyframes were added, those taken over and those made again are as if all were made at once."""

import numpy as np
import pytest
from helpers.planted import box, odometry, recording, scans, wander

from uwblite.graph.work import Work
from uwblite.pipeline import keyframe_data
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.pipeline.recordings import denser, gather

CONFIG = MappingConfig()


def drive(seed, length=6.0, lidar=True):
    rng = np.random.default_rng(seed)
    stamps, truth = wander(rng, length)
    seen = scans(stamps, truth, box(9, 7), beams=120, rng=rng, noise=0.01) if lidar else None
    return recording(odometry(stamps, truth, rng, noise=0.003, turn_noise=0.002), None, seen)


@pytest.mark.parametrize("steps", [[], [3], [0, 4, 5, 19]])
def test_clouds_taken_over_are_those_made_again(steps):
    logs = [drive(1), drive(2, lidar=False), drive(3)]
    before = gather(logs, CONFIG.keyframes)
    last = before.each[2]
    after = denser(before, np.array([*steps, last.first + np.argmax(last.frames.duration)]), 4)
    assert len(after.stamps) > len(before.stamps)
    old = keyframe_data.make(before, CONFIG, 0.02, Work())
    mixed = keyframe_data.remake(old, before, after, CONFIG)
    fresh = keyframe_data.make(after, CONFIG, 0.02, Work())
    for name in ("offsets", "points", "normals", "owner", "normal_variance"):
        np.testing.assert_array_equal(getattr(mixed.clouds, name), getattr(fresh.clouds, name))
    for k in range(len(fresh.clouds)):
        np.testing.assert_array_equal(mixed.raster.cells(k), fresh.raster.cells(k))
    assert mixed.delay == fresh.delay == 0.02
    # Steps that were cut and their neighbours alone are made again.
    former = np.concatenate([keyframe_data._former(*pair, CONFIG, 0.02) for pair in zip(before.each, after.each, strict=True)])
    assert 0 < np.sum(former < 0) < len(former) / 2
    np.testing.assert_array_equal(before.stamps[former[former >= 0]], after.stamps[former >= 0])
