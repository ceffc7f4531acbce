"""The share of beams towards walls that return nothing, over a planted room."""

import numpy as np
import pytest
from helpers.localization_room import ODD, SCANNER, cast, grid_of

from uwblite.grid.tracing import Sweeps, missing_share
from uwblite.sensor_log import LaserScans

POSES = np.array([[1.0 + 0.3 * k, 2.5, 0.7 * k] for k in range(20)])


def sweeps(lost, person=None):
    rng = np.random.default_rng(4)
    ranges = np.array([cast(pose) for pose in POSES], dtype=np.float32)
    if person is not None:
        ranges = np.minimum(ranges, person)
    ranges[rng.random(ranges.shape) < lost] = np.inf
    angles = (SCANNER.angle_min, SCANNER.angle_increment)
    scans = LaserScans(np.arange(20.0), ranges, *angles, 0.0, SCANNER.range_min, SCANNER.range_max)
    return Sweeps(scans, POSES)


@pytest.mark.parametrize("lost", [0.0, 0.2, 0.6])
def test_of_beams_that_return_nothing_at_random_their_share_is_found(lost):
    found = missing_share([sweeps(lost), sweeps(lost)], grid_of(ODD), 3.0)
    count = 20 * 23 * 0.6
    assert found == pytest.approx(lost, abs=4 * np.sqrt(max(lost * (1 - lost), 1e-9) / count))


def test_beams_that_end_at_a_person_before_the_wall_do_not_count():
    assert missing_share([sweeps(0.0, person=2.0)], grid_of(ODD), 3.0) == 0.0
    assert np.isnan(missing_share([sweeps(0.0, person=0.1)], grid_of(ODD), 3.0))
    assert np.isnan(missing_share([], grid_of(ODD), 3.0))
