"""Scans brought to another geometry see the same surfaces, and invent none."""

import numpy as np
import pytest

from uwblite.io.readings import ScanGeometry, resampled


def wall(geometry, distance=2.0, bearing=0.3):
    """Ranges of an endless wall whose foot lies at a bearing, inf where it is not seen within 10 m."""
    away = np.cos(geometry.angles - bearing)
    with np.errstate(divide="ignore"):
        reach = np.where(away > 0, distance / away, np.inf)
    return np.where(reach < 10.0, reach, np.inf).astype(np.float32)[None]


@pytest.mark.parametrize("beams", [672, 679, 682])
def test_a_spinning_lidar_sees_the_same_wall_with_any_number_of_beams(beams):
    have, want = ScanGeometry(-np.pi, 2 * np.pi / beams, beams), ScanGeometry(-np.pi, 2 * np.pi / 676, 676)
    assert have.is_of_one_lidar_with(want)
    found, exact = resampled(wall(have), have, want)[0], wall(want)[0]
    near = exact < 6.0
    # A chord instead of the wall: r step^2 / 8 and less, and steep stretches take the nearer beam.
    error = np.abs(found[near] - exact[near])
    assert error.max() < 0.02
    assert np.median(error) < 1e-3
    assert np.sum(np.isfinite(found) != np.isfinite(exact)) <= 2


def test_the_same_geometry_changes_nothing():
    geometry = ScanGeometry(-1.5, 0.02, 150)
    seen = wall(geometry)
    seen[0, [3, 77]] = np.nan
    np.testing.assert_array_equal(resampled(seen, geometry, geometry), seen)


def test_edges_stay_sharp_and_unseen_angles_unknown():
    have, want = ScanGeometry(-1.0, 0.01, 180), ScanGeometry(-1.003, 0.01, 182)
    seen = np.where(np.arange(180) < 90, 1.0, 5.0).astype(np.float32)[None]
    found = resampled(seen, have, want)[0]
    assert set(np.unique(found[np.isfinite(found)])) == {1.0, 5.0}
    assert np.flatnonzero(np.isnan(found)).tolist() == [180, 181]


def test_nothing_seen_and_error_codes_are_not_averaged():
    have, want = ScanGeometry(0.0, 0.1, 4), ScanGeometry(0.02, 0.1, 3)
    found = resampled(np.array([[1.0, np.inf, np.nan, 2.0]], dtype=np.float32), have, want)[0]
    np.testing.assert_array_equal(found, np.array([1.0, np.inf, np.nan], dtype=np.float32))


def test_another_field_of_view_is_another_lidar():
    front = ScanGeometry(-np.pi / 2, np.pi / 180, 181)
    assert front.is_of_one_lidar_with(ScanGeometry(-np.pi / 2, np.pi / 180, 180))
    assert front.is_of_one_lidar_with(ScanGeometry(-np.pi / 2, np.pi / 360, 361))
    assert not front.is_of_one_lidar_with(ScanGeometry(-np.pi / 2, np.pi / 180, 90))
    assert not front.is_of_one_lidar_with(ScanGeometry(np.pi / 2, -np.pi / 180, 181))
    assert not front.is_of_one_lidar_with(ScanGeometry(0.0, np.pi / 180, 181))
