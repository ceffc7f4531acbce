"""What of a match is handed on: free space is asked only for promising matches, with the points of both sub-maps."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.laser_walks import HALL, scanned

from uwblite import se2
from uwblite.lidar.correlative_matching import CorrelativeConfig
from uwblite.loop_closure import matching
from uwblite.loop_closure.candidates import Candidates
from uwblite.loop_closure.closures import LoopClosureConfig


def test_free_space_is_asked_with_the_points_of_both_sub_maps(monkeypatch):
    clouds = scanned(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.3], [2.0, 0.0, 0.6]]), HALL)
    config, asked = LoopClosureConfig(), []

    def violations(free_a, a, free_b, b, pose):
        asked.append((free_a, free_b, pose))
        np.testing.assert_array_equal(a, clouds.cloud("abc".index(free_a))[0])
        np.testing.assert_array_equal(b, clouds.cloud("abc".index(free_b))[0])
        return 0.25

    monkeypatch.setattr(matching, "violates_free_space", violations)
    least = min(config.overlap, config.overlap_after_search)
    share, rms = np.array([least, least - 0.01, 1.0, 1.0]), np.array([config.sigma, 0.0, config.sigma * 1.01, 0.0])
    candidates = SimpleNamespace(target=np.array([0, 0, 0, 1]), source=np.array([1, 1, 2, 2]))
    best = SimpleNamespace(share=share, rms=rms, pose=["first", "few", "far", "last"])
    promising = matching._promising(best, np.full(4, np.inf), config)
    batch = SimpleNamespace(candidates=candidates, free=["a", "b", "c"], clouds=clouds)
    assert matching._free_space_violations(batch, best, promising).tolist() == [0.25, 0.0, 0.0, 0.25]
    assert asked == [("a", "b", "first"), ("b", "c", "last")]
    batch.free = None
    assert matching._free_space_violations(batch, best, promising).tolist() == [0.0] * 4


def test_stretches_are_compared_by_the_surface_that_speaks_for_a_place(monkeypatch):
    """Sub-maps by the share of all points."""
    truth = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.3]])
    clouds, config = scanned(truth, HALL), LoopClosureConfig()
    ends, guess = np.array([0, 0]), np.tile(se2.between(truth[0], truth[1]), (2, 1))
    stretches = Candidates(ends, ends + 1, guess, np.zeros((2, 3, 3)), np.ones(2), False, long=True)
    monkeypatch.setattr(matching, "_guesses", lambda batch: (np.arange(2), guess))
    monkeypatch.setattr(matching, "net_overlap", lambda *args: np.full(len(args[2]), 13.7))
    for candidates, net in ((stretches, 13.7), (replace(stretches, long=False), np.inf)):
        found, _ = matching._fit(matching._Batch(candidates, clouds, 1.0, None, config, CorrelativeConfig()))
        assert found.net.tolist() == [net, net]
        np.testing.assert_allclose(found.best.pose, guess, atol=1e-3)
        assert found.found.all()


def test_of_a_wide_search_the_net_overlap_is_enough():
    """Stretches that meet for a third of their length are a promising pair; long walls alone are none."""
    config = LoopClosureConfig()
    best = SimpleNamespace(share=np.array([0.3, 0.9]), rms=np.zeros(2))
    net = config.net_overlap + np.array([0.1, -0.1])
    assert matching._promising(best, net, config).tolist() == [True, False]


def test_places_are_searched_as_far_as_they_are_uncertain(monkeypatch):
    """In heading to three sigma, at least 0.1 rad and at most the limit; matching starts from guesses that are certain."""
    config, asked, steps = LoopClosureConfig(), [], []

    def search(target, source, guess, half_widths, settings):
        asked.append((target, source, *half_widths))
        steps.append((settings.resolution, settings.spread, settings.angle_step))
        return SimpleNamespace(poses=np.tile(guess, (30, 1)))

    monkeypatch.setattr(matching, "search", search)
    monkeypatch.setattr(matching, "_window", lambda guess, half_width, turn, *_: (guess, (half_width, half_width, turn)))
    spread, sigma = np.array([config.direct, 1.0, 2.0, 9.0]), np.array([1.0, 0.01, 0.1, 9.0])
    candidates = SimpleNamespace(
        spread=spread, covariance=np.eye(3) * sigma[:, None, None] ** 2, guess=np.arange(12.0).reshape(4, 3),
        target=np.array([0, 1, 2, 3]), source=np.array([4, 5, 6, 7]),
    )  # fmt: skip
    numbers = SimpleNamespace(chosen=lambda which: int(which[0]))
    fine, coarse = (0.15, 0.12, 0.03), pytest.approx((0.3, 0.24, 0.02))  # twice the cells, finer headings for long clouds
    for candidates.long, places, step in ((False, config.places, fine), (True, matching.MatchingPolicy.many_places, coarse)):
        asked.clear(), steps.clear()
        rows, guesses = matching._guesses(matching._Batch(candidates, numbers, 0.1, None, config, CorrelativeConfig()))
        wide = (3, 7, 9.0, 9.0, config.search_angle)
        assert asked == [(1, 5, 1.0, 1.0, 0.1), (2, 6, 2.0, 2.0, pytest.approx(0.3)), wide]
        assert steps == [step] * 3
        assert rows.tolist() == [0] + [1] * places + [2] * places + [3] * places
        np.testing.assert_array_equal(guesses, candidates.guess[rows])


@pytest.mark.parametrize("guess", [(0.0, 0.0, 0.2), (35.0, -80.0, 1.0), (-4.0, 15.0, 0.0)])
def test_a_search_leaves_out_only_places_at_which_two_clouds_do_not_overlap(guess):
    """Of places all over the uncertainty, those left out have less than a twentieth of the points within the other's extent."""
    rng, half_width = np.random.default_rng(0), 100.0
    target = scanned(np.array([[0.0, 0.0, 0.0]]), HALL)
    source = scanned(np.array([[2.0, 1.0, 0.7]]), HALL)
    centre, (wide, tall, turn) = matching._window(np.array(guess), half_width, 0.4, target, source)
    assert (centre[2], turn) == (guess[2], 0.4)
    assert wide * tall < half_width**2 / 4.0
    places = np.array(guess) + rng.uniform(-1.0, 1.0, (2000, 3)) * [half_width, half_width, np.pi]
    out = np.any(np.abs(places - centre)[:, :2] > [wide, tall], axis=1)
    low, high = np.quantile(target.points, [0.05, 0.95], axis=0)
    for place in places[out]:
        points = se2.transform(place, source.points)
        assert np.mean(np.all((points > low) & (points < high), axis=1)) <= 0.05


def test_where_clouds_cannot_overlap_nothing_is_searched():
    cloud = scanned(np.array([[0.0, 0.0, 0.0]]), HALL)
    _, half_widths = matching._window(np.array([900.0, 0.0, 0.0]), 10.0, 0.1, cloud, cloud)
    assert half_widths[0] == 0.0
