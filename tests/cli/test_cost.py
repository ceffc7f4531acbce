"""The estimate of time and memory: positive, growing with everything it depends on."""

import pytest

from uwblite.cli import cost


@pytest.fixture(autouse=True)
def _one_speed(monkeypatch):
    monkeypatch.setattr(cost, "_slowness", lambda: 1.0)


@pytest.mark.parametrize("place", range(4))
def test_time_grows_with_path_ranges_scans_and_beams(place):
    few, many = [100.0, 1000, 5000, 682], [100.0, 1000, 5000, 682]
    many[place] *= 2
    assert 0 < cost.expected_seconds(*few) < cost.expected_seconds(*many)


@pytest.mark.parametrize("place", range(4))
def test_memory_grows_with_path_scans_beams_and_cells(place):
    few, many = [100.0, 5000, 682, 100_000], [100.0, 5000, 682, 100_000]
    many[place] *= 2
    assert 50 < cost.expected_megabytes(*few) < cost.expected_megabytes(*many)


def test_without_lidar_it_costs_less():
    assert cost.expected_seconds(300.0, 2000, 0, 0) < 0.5 * cost.expected_seconds(300.0, 2000, 9000, 682)
    assert cost.expected_megabytes(300.0, 0, 0, 0) < 0.5 * cost.expected_megabytes(300.0, 9000, 682, 300_000)


