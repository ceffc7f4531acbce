"""Lines are looked up as densely as their bounds ask for; poses lie on the line."""

import numpy as np
import pytest
from helpers.planning_worlds import grid_of, random_grid

from uwblite.navigation import smoothing
from uwblite.navigation.clearance import clearance_map
from uwblite.navigation.smoothing import _graded, along_lines, sampled, smoothed


def test_costs_along_lines_are_integrals():
    clearance = clearance_map(random_grid(1), 0.1)
    rng = np.random.default_rng(0)
    begin, end = (rng.uniform(clearance.geometry.origin + 0.3, clearance.geometry.corner - 0.3, (40, 2)) for _ in range(2))
    found = along_lines(clearance, begin, end)
    for b, e, cost, clear, open_, crossing in zip(begin, end, *found, strict=True):
        dense = b + np.linspace(0.0, 1.0, 4001)[:, None] * (e - b)
        squared, rates = clearance.at(dense)
        assert cost == pytest.approx(rates.mean() * np.hypot(*(e - b)), rel=0.03, abs=1e-3)
        assert not (clear and squared.min() < 0.1**2 - 1e-9)
        assert not (crossing and clear)
        assert open_ == (clear and rates.max() == 1.0)


def test_batches_change_nothing(monkeypatch):
    clearance = clearance_map(random_grid(2), 0.1)
    rng = np.random.default_rng(1)
    begin, end = (rng.uniform(clearance.geometry.origin, clearance.geometry.corner, (60, 2)) for _ in range(2))
    whole = along_lines(clearance, begin, end)
    monkeypatch.setattr(smoothing, "AT_ONCE", 100)
    for one, other in zip(whole, along_lines(clearance, begin, end), strict=True):
        assert np.array_equal(one, other)


def test_a_staircase_becomes_straight():
    clearance = clearance_map(grid_of("\n".join(["." * 60] * 60)), 0.2)
    stairs = np.repeat(np.arange(1.05, 4.0, 0.1), 2)
    line = smoothed(clearance, np.stack([stairs[1:], stairs[:-1]], axis=1))
    assert len(line) == 2


def test_places_lie_on_their_pieces_and_closer_near_corners():
    line = np.array([[0.0, 0.0], [25.6, 0.0], [25.6, 0.1], [19.2, 4.9]])
    places, piece = _graded(line, 0.1)
    ways = np.diff(places, axis=0)
    along = np.diff(line, axis=0)[piece]
    assert ways[:, 0] * along[:, 1] == pytest.approx(ways[:, 1] * along[:, 0], abs=1e-12)
    assert np.add.reduceat(np.hypot(*ways.T), np.flatnonzero(np.diff(piece, prepend=-1))) == pytest.approx([25.6, 0.1, 8.0])
    gaps = np.hypot(*ways[piece == 0].T)
    away = np.minimum(places[:-1][piece == 0, 0], 25.6 - places[1:][piece == 0, 0])
    assert gaps[:8] == pytest.approx(0.1)
    assert gaps[-8:] == pytest.approx(0.1)
    assert np.all(gaps <= np.maximum(0.1, away / 8) + 1e-9)
    assert len(gaps) == 2 * (16 + 3 * 8)


def test_a_line_that_is_cheapest_stays_and_corners_without_a_turn_go():
    clearance = clearance_map(grid_of("\n".join(["." * 60] * 60)), 0.2)
    line = np.array([[1.0, 1.0], [2.0, 1.5], [4.0, 2.5]])
    assert np.array_equal(smoothed(clearance, line), line[[0, 2]])


def test_poses_lie_evenly_on_every_piece():
    poses, distances = sampled(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.25]]), 0.1)
    assert distances == pytest.approx(np.concatenate([np.arange(0.0, 1.01, 0.1), 1.0 + 0.25 * np.arange(1, 4) / 3]))
    assert poses[:10, 2] == pytest.approx(0.0)
    assert poses[10:, 2] == pytest.approx(np.pi / 2)
