"""The paper's closures: sub-maps that overlap by the graph, plain ICP, accepted by the fitness score."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.laser_walks import scanned
from helpers.planted import box, drive

from uwblite import se2
from uwblite.graph.graph import Graph
from uwblite.lidar.clouds import Clouds
from uwblite.lidar.point_to_point import IcpConfig
from uwblite.lidar.submaps import SubmapConfig, Submaps, build
from uwblite.loop_closure.closures import LoopClosureConfig
from uwblite.loop_closure.paper_method import _shared, candidates, find

ICP = IcpConfig(max_correspondence_distance=0.3, max_iterations=300, fitness_sigma=0.1)
PLAIN = LoopClosureConfig(method="icp", partners=1000)


@pytest.fixture(scope="module")
def laps():
    """Two laps of 2 m side in a room of 8 x 6 m with a cabinet, as poses, path and their clouds."""
    side = [(0.4, 0.0, 0.0), (0.0, 0.0, np.pi / 4)]
    _, truth = drive(side * 8, [5.0, 2.0] * 8, rate=2.0)
    path = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(truth[:, :2], axis=0).T))])
    walls = np.concatenate([box(8, 6), box(1.0, 0.6) + np.array([2.6, -2.0] * 2), [[-1.0, 3.0, -1.0, 2.2]]])
    return truth, path, scanned(truth, walls)


def pieces_of(laps, epsilon=2.0, poses=None):
    truth, path, clouds = laps
    recording = np.zeros(len(path), dtype=np.intp)
    return build(clouds, truth if poses is None else poses, path, recording, SubmapConfig(epsilon=epsilon)), recording


def test_candidates_are_pairs_that_overlap_and_are_not_neighbours(laps):
    pieces, recording = pieces_of(laps)
    target, source = candidates(laps[0], pieces, recording, 1000)
    # In one room every sub-map shows the same walls.
    every = [(a, b) for a in range(len(pieces)) for b in range(a + 2, len(pieces))]
    assert list(zip(target.tolist(), source.tolist(), strict=True)) == every


def test_neighbours_of_different_recordings_are_candidates(laps):
    pieces, recording = pieces_of(laps)
    later = recording.copy()
    later[pieces.first[3] :] = 1
    pairs = set(zip(*(c.tolist() for c in candidates(laps[0], pieces, later, 1000)), strict=True))
    assert (2, 3) in pairs
    assert (1, 2) not in pairs


def test_sub_maps_far_apart_are_no_candidates(laps):
    pieces, recording = pieces_of(laps)
    far = laps[0].copy()
    far[pieces.first[4] :, 0] += 50.0
    target, source = candidates(far, pieces, recording, 1000)
    assert len(target)
    assert np.all((target < 4) == (source < 4))


@pytest.mark.parametrize("seed", range(2))
def test_what_two_sub_maps_share_is_a_share_of_the_squares_of_the_smaller_one(seed):
    """Against sets of squares; a sub-map of one point, and one of none, among them."""
    rng = np.random.default_rng(seed)
    counts = np.array([1, 40, 0, 15, 3])
    owner, points = np.repeat(np.arange(5, dtype=np.int32), counts), rng.uniform(-1.0, 1.0, (counts.sum(), 2))
    points[0] = points[1]
    poses = np.column_stack([rng.uniform(-0.5, 0.5, (5, 2)), rng.uniform(-3.0, 3.0, 5)])
    poses[0] = poses[1]
    clouds = Clouds(np.append(0, np.cumsum(counts)), points, np.zeros_like(points), owner, np.zeros(len(points)))
    squares = [{tuple(c) for c in np.floor(se2.transform(poses[k], points[owner == k]) / 0.5).tolist()} for k in range(5)]
    expected = [[len(a & b) / max(min(len(a), len(b)), 1) for b in squares] for a in squares]
    none = np.zeros(5, dtype=np.intp)
    np.testing.assert_allclose(_shared(poses, Submaps(none, none, none, clouds, 0.1)), expected)
    assert expected[0][1] == 1.0


def test_partners_bound_the_candidates_best_first(laps):
    pieces, recording = pieces_of(laps)
    few, all_of_them = (candidates(laps[0], pieces, recording, limit) for limit in (2, 1000))
    partners = np.bincount(np.concatenate(few), minlength=len(pieces))
    assert partners.min() >= 2
    assert len(few[0]) < len(all_of_them[0])
    assert len(candidates(laps[0], pieces, recording, 0)[0]) == 0


def test_a_drifted_second_lap_is_put_back(laps):
    """Guesses are off by up to a decimetre; the closures are off by what voxels of 8 cm leave of point-to-point."""
    truth, path, _ = laps
    half = len(path) // 2
    bent = truth.copy()
    bent[half:] = se2.compose(np.array([0.06, -0.05, 0.01]), truth[half:])
    pieces, recording = pieces_of(laps, poses=bent)
    found = find(Graph(bent), pieces, recording, PLAIN, ICP)
    assert sum(c.accepted for c in found.candidates) == len(found.edges) > 5
    across = (found.edges.i < half - 4) & (found.edges.j > half + 4)
    assert across.any()
    guess = se2.between(bent[found.edges.i], bent[found.edges.j])
    true = se2.between(truth[found.edges.i], truth[found.edges.j])
    before, after = (np.hypot(*(p - true)[across, :2].T) for p in (guess, found.edges.T_i_j))
    assert np.median(after) < 0.5 * np.median(before)
    information = np.swapaxes(found.edges.sqrt_information, 1, 2) @ found.edges.sqrt_information
    kept = [c.information for c in found.candidates if c.accepted]
    np.testing.assert_allclose(information, kept, rtol=1e-6, atol=1e-6 * np.max(kept))


def test_every_candidate_is_kept_with_its_reason(laps):
    pieces, recording = pieces_of(laps)
    strict = find(Graph(laps[0]), pieces, recording, PLAIN, replace(ICP, fitness_sigma=1e-9))
    assert len(strict.edges) == 0
    assert len(strict.candidates) > 10
    assert all(not c.accepted and "fitness score" in c.reason for c in strict.candidates)
    short = find(Graph(laps[0]), pieces, recording, PLAIN, replace(ICP, max_iterations=1, tolerance_translation=1e-9))
    assert all("still moving" in c.reason for c in short.candidates)


def test_more_correlated_points_inform_less(laps):
    pieces, recording = pieces_of(laps)
    one, other = (find(Graph(laps[0]), pieces, recording, replace(PLAIN, correlation=c), ICP) for c in (1.0, 4.0))
    np.testing.assert_allclose(one.edges.sqrt_information, 2.0 * other.edges.sqrt_information, rtol=1e-9)


def test_a_single_sub_map_closes_nothing(laps):
    pieces, recording = pieces_of(laps, epsilon=1000.0)
    assert find(Graph(laps[0]), pieces, recording, PLAIN, ICP).candidates == ()
