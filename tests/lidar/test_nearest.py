"""The table of nearest points against brute force."""

import numpy as np
import pytest

from uwblite.errors import DataError
from uwblite.lidar.nearest import make_raster


@pytest.mark.parametrize("reach", [0.1, 0.2, 0.6])
def test_lookup_is_nearest_to_the_accuracy_of_a_cell(reach):
    rng = np.random.default_rng(0)
    points, queries = rng.uniform(0.0, 4.0, (150, 2)), rng.uniform(-1.0, 5.0, (3000, 2))
    raster = make_raster(points, reach)
    found = raster.lookup(*queries.T)
    distances = np.hypot(*(queries[:, None] - points[None]).transpose(2, 0, 1))
    nearest = distances.min(axis=1)
    # Query and point are each half a cell's diagonal from their cell's centre, at most.
    slack = 2.0**0.5 * raster.cell
    none = found == len(points)
    assert (nearest[none] > reach - slack).all()
    assert (nearest[~none] < reach + slack).all()
    chosen = distances[np.flatnonzero(~none), found[~none]]
    assert (chosen - nearest[~none] <= 2.0 * slack).all()


def test_stride_tables_every_nth_point_under_its_own_number():
    points = np.stack([np.arange(10) * 1.0, np.zeros(10)], axis=-1)
    raster = make_raster(points, 0.4, stride=3)
    assert raster.lookup(*points.T).tolist() == [0, 10, 10, 3, 10, 10, 6, 10, 10, 9]


def test_an_empty_cloud_is_near_to_nothing():
    assert make_raster(np.zeros((0, 2)), 0.2).lookup(np.array([0.0, 1e6]), np.array([0.0, -1e6])).tolist() == [0, 0]


def test_a_cloud_too_wide_for_a_table_is_refused():
    with pytest.raises(DataError, match="filter outliers"):
        make_raster(np.array([[0.0, 0.0], [1e6, 1e6]]), 0.1)


def test_far_queries_find_nothing():
    raster = make_raster(np.zeros((1, 2)), 0.2)
    far = np.array([-1e12, 1e12, 0.0, -5.0])
    assert raster.lookup(far, far[::-1].copy()).tolist() == [1, 1, 1, 1]
