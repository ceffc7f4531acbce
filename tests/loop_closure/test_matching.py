"""What of a match is handed on: free space is asked only for promising matches, with the points of both sub-maps."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.laser_walks import HALL, scanned

from uwblite import se2
from uwblite.lidar.cloud_rasters import rasterize
from uwblite.lidar.clouds import CloudConfig
from uwblite.lidar.correlative_matching import CorrelativeConfig
from uwblite.lidar.scan_matching import Aligned, PairPolicy, match, pairs_of
from uwblite.lidar.visibility import free_around, net_overlap, violates_free_space
from uwblite.loop_closure import matching
from uwblite.loop_closure.candidates import Candidates
from uwblite.loop_closure.closures import LoopClosureConfig


def planted(truth, guess, spread=0.0, sigma=0.01, **options):
    """Return a batch of sub-maps seen from poses (k, 3), each from the second on matched with the first from a guess (e, 3)."""
    clouds, many = scanned(truth, HALL), len(truth) - 1
    target, source = np.zeros(many, dtype=np.intp), np.arange(1, many + 1)
    covariances = np.tile(np.eye(3) * sigma**2, (many, 1, 1))
    candidates = Candidates(target, source, guess, covariances, np.full(many, spread), False, **options)
    return matching._Batch(candidates, clouds, 0.5, None, LoopClosureConfig(), CorrelativeConfig())


TRUTH = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.3], [2.0, 0.0, 0.6], [0.5, 0.8, -0.4]])
STEPS = se2.between(TRUTH[:1], TRUTH[1:])


def test_promising_matches_are_tested_against_the_free_space_of_both_sub_maps():
    """The first is in its place, the second is not promising, the third is a metre off: through a wall."""
    batch = planted(TRUTH, STEPS)
    free = free_around(batch.clouds)
    off = STEPS + np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    best, promising = matched(batch, off), np.array([True, False, True])
    through = matching._free_space_violations(replace(batch, free=free), best, promising)
    points = [batch.clouds.cloud(k)[0] for k in range(len(TRUTH))]
    expected = [violates_free_space(free[0], points[0], free[k], points[k], off[k - 1]) for k in (1, 2, 3)]
    assert through.tolist() == [expected[0], 0.0, expected[2]]
    assert expected[0] < 0.01
    assert min(expected[1:]) > 0.05
    assert matching._free_space_violations(batch, best, promising).tolist() == [0.0] * 3


def matched(batch, poses):
    """Return the matches of a batch's pairs at poses (e, 3)."""
    raster, gate = rasterize(batch.clouds, CloudConfig.raster, PairPolicy.reach), batch.config.gate
    pairs = pairs_of(batch.clouds, batch.candidates.target, batch.candidates.source)
    return Aligned(poses, match(raster, pairs, poses, gate, gate / 2.0))


def test_stretches_are_compared_by_the_surface_that_speaks_for_a_place():
    """Sub-maps by the share of all points."""
    batch = planted(TRUTH, STEPS, long=True)
    for long in (True, False):
        found, _ = matching._fit(replace(batch, candidates=replace(batch.candidates, long=long)))
        np.testing.assert_allclose(found.best.pose, STEPS, atol=0.005)
        assert found.found.all()
        raster, ends = rasterize(batch.clouds, CloudConfig.raster, PairPolicy.reach), (batch.candidates.target, [1, 2, 3])
        net = batch.spacing * net_overlap(raster, None, *map(np.array, ends), STEPS, batch.config.gate)
        np.testing.assert_allclose(found.net, net if long else np.inf, rtol=0.05)


def test_of_a_wide_search_the_net_overlap_is_enough():
    """Stretches that meet for a third of their length are a promising pair; long walls alone are none."""
    config = LoopClosureConfig()
    best = SimpleNamespace(share=np.array([0.3, 0.9]), rms=np.zeros(2))
    net = config.net_overlap + np.array([0.1, -0.1])
    assert matching._promising(best, net, config).tolist() == [True, False]


@pytest.mark.parametrize("long", [False, True])
@pytest.mark.parametrize(("off", "sigma"), [((1.5, -1.2, 0.05), 0.001), ((-1.0, 1.8, 0.4), 0.15)])
def test_places_are_searched_as_far_as_they_are_uncertain(off, sigma, long):
    """In heading to three sigma, at least 0.1 rad; what is farther away is not found, and what is certain is not searched."""
    guess = STEPS[:1] + np.array(off)
    for spread, within in ((2.0, True), (1.0, False)):
        rows, poses = matching._guesses(planted(TRUTH[:2], guess, spread, sigma, long=long))
        assert len(rows) == len(poses) <= 30
        away = np.abs(poses - guess)
        assert np.all(away[:, :2] <= spread + 0.3)
        assert np.all(away[:, 2] <= max(3.0 * sigma, 0.1) + 0.03)
        near = np.abs(poses - STEPS[:1]) < [0.3, 0.3, 0.04]
        assert near.all(axis=1).any() == within
    rows, poses = matching._guesses(planted(TRUTH[:2], guess, LoopClosureConfig().direct, sigma, long=long))
    assert rows.tolist() == [0]
    np.testing.assert_array_equal(poses, guess)


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
