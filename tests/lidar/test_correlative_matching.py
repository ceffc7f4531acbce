"""Planted poses found from metres away, scores against brute force, ambiguity named."""

import numpy as np
import pytest
from helpers.registration_worlds import CORRIDOR, ROOM, cloud, pair, wall_points

from uwblite import se2
from uwblite.config import override
from uwblite.errors import ConfigError
from uwblite.lidar.cloud_rasters import rasterize, surface_field
from uwblite.lidar.clouds import joined
from uwblite.lidar.correlative_matching import CorrelativeConfig, _peaks, score_grid, search
from uwblite.lidar.scan_matching import align_pairs, pairs_of

CENTRE = (3.0, 1.5)


def scores_of(target, source, guess, window):
    """Return the scores (c,) of the poses that are found."""
    scores = score_grid(target, source, guess, window, CorrelativeConfig())[0]
    return scores[tuple(_peaks(scores, CorrelativeConfig()).T)]


def rivalry(scores):
    """Return the second score relative to the first: near 1 the clouds do not distinguish the two places."""
    return scores[1] / scores[0] if len(scores) > 1 else 0.0


def _field(target, config):
    """Return the field (rows, columns) that scores look up, and its lower left corner."""
    raster = rasterize(target, config.resolution, 4 * config.resolution)
    return surface_field(raster, config.spread).T, raster.origin[0]


def _world(rng):
    """Return walls (w, 4) of a crooked room with columns and partitions."""
    corners = np.array([[0, 0], [8, 0], [8, 6], [0, 6]]) + rng.uniform(-1.0, 1.0, (4, 2))
    walls = [[*corners[k], *corners[(k + 1) % 4]] for k in range(4)]
    for _ in range(4):
        x, y, size, turn = *rng.uniform([1.5, 1.5], [6.5, 4.5]), rng.uniform(0.2, 0.5), rng.uniform(0.0, np.pi)
        box = se2.transform([x, y, turn], size * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]))
        walls += [[*box[k], *box[(k + 1) % 4]] for k in range(4)]
    return np.array(walls)


def test_scores_equal_brute_force():
    rng = np.random.default_rng(0)
    truth = np.array([0.4, 0.3, 0.2])
    target, source = pair(ROOM, truth, rng, CENTRE, spacing=0.2)
    config = CorrelativeConfig(resolution=0.1, angle_step=0.05, spread=0.1)
    guess = truth + np.array([0.13, -0.07, 0.01])
    scores, headings, shift_x, shift_y = score_grid(target, source, guess, (0.6, 0.5, 0.1), config)
    assert scores.shape == (5, 11, 13)
    field, origin = _field(target, config)
    for k, heading in enumerate(headings):
        cells = np.floor((se2.transform([*guess[:2], heading], source.points) - origin) / config.resolution).astype(int)
        normals = se2.rotate(heading, source.normals)
        for i, dy in enumerate(shift_y):
            for j, dx in enumerate(shift_x):
                column, row = (cells + np.array([dx, dy])).T
                inside = (row >= 0) & (row < field.shape[0]) & (column >= 0) & (column < field.shape[1])
                value = field[row[inside], column[inside]]
                each = value.real * normals[inside, 0] + value.imag * normals[inside, 1]
                assert scores[k, i, j] == pytest.approx(each.sum() / len(source.points), abs=1e-5)


@pytest.mark.parametrize("axis", [0, 1])
def test_points_count_that_only_a_far_shift_brings_onto_a_long_field(axis):
    """Of a wall along either axis half is seen, and the guess is off by most of the other half: the scores are a loop's."""
    rng, along = np.random.default_rng(3), np.eye(2)[axis]
    walls = np.array([[*(-4.0 * along), *(4.0 * along)]])
    target, source = pair(walls, np.zeros(3), rng, np.array([0.3, 0.3]), spacing=0.2)
    config = CorrelativeConfig(resolution=0.1, angle_step=0.05, spread=0.1)
    guess = np.array([*(3.7 * along), 0.0])
    scores, headings, shift_x, shift_y = score_grid(target, source, guess, (1.5, 1.5, 0.0), config)
    field, origin = _field(target, config)
    cells = np.floor((se2.transform([*guess[:2], headings[0]], source.points) - origin) / config.resolution).astype(int)
    for i, dy in enumerate(shift_y):
        for j, dx in enumerate(shift_x):
            column, row = (cells + np.array([dx, dy])).T
            inside = (row >= 0) & (row < field.shape[0]) & (column >= 0) & (column < field.shape[1])
            value = field[row[inside], column[inside]] * (source.normals[inside] @ [1.0, -1.0j])
            assert scores[0, i, j] == pytest.approx(value.real.sum() / len(source.points), abs=1e-5)


def test_the_field_is_the_likelihood_of_the_nearest_point():
    rng = np.random.default_rng(1)
    config = CorrelativeConfig(resolution=0.05, spread=0.1)
    target = cloud(wall_points(ROOM, rng))
    field, origin = _field(target, config)
    rows, columns = np.indices(field.shape)
    centres = origin + (np.stack([columns, rows], axis=-1).reshape(-1, 2) + 0.5) * config.resolution
    lines = target.points[target.normals.any(axis=1)]
    distance = np.hypot(*(centres[:, None] - lines[None]).transpose(2, 0, 1)).min(axis=1)
    expected = np.exp(-0.5 * (distance / config.spread) ** 2)
    # The table of nearest points is right to a cell; beyond its reach of four cells the field is zero.
    assert np.abs(np.abs(field).ravel() - expected).max() < 0.25
    assert np.abs(np.abs(field).ravel() - expected).mean() < 0.01


@pytest.mark.parametrize("seed", range(12))
def test_planted_poses_are_found_from_metres_and_tens_of_degrees(seed):
    rng = np.random.default_rng(seed)
    truth = np.array([*rng.uniform(-3.0, 3.0, 2), rng.uniform(-np.pi, np.pi)])
    target, source = pair(_world(rng), truth, rng, (4.0, 1.0))
    guess = truth + rng.uniform(-1.0, 1.0, 3) * [3.0, 3.0, 0.5]
    config = CorrelativeConfig()
    around = target, source, guess, (3.2, 3.2, 0.55)
    found, scores = search(*around, config), scores_of(*around)
    e = se2.between(found[0], truth)
    assert np.hypot(e[0], e[1]) < 1.5 * config.resolution
    assert abs(e[2]) < 1.5 * config.angle_step
    assert scores[0] > 0.5
    assert rivalry(scores) < 0.9
    assert (np.diff(scores) <= 0.0).all()
    clouds, i, j = joined([target, source]), np.array([0]), np.array([1])
    pairs = pairs_of(clouds, i, j, len(source.points))
    aligned = align_pairs(rasterize(clouds, 0.1, 0.5), pairs, found[:1], 0.5, 0.15)
    assert np.hypot(*se2.between(aligned.pose[0], truth)[:2]) < 0.015


def test_a_corridor_is_ambiguous_and_a_room_is_not():
    rng = np.random.default_rng(2)
    long = CORRIDOR * [2.0, 1.0, 2.0, 1.0]
    corridor = *pair(long, np.zeros(3), rng, (0.0, 0.0)), np.zeros(3), (2.0, 1.0, 0.3)
    room = *pair(ROOM, np.zeros(3), rng, CENTRE), np.zeros(3), (2.0, 1.0, 0.3)
    assert rivalry(scores_of(*corridor)) > 0.9
    assert rivalry(scores_of(*room)) < 0.75
    along = search(*corridor)
    separate = np.abs(along[:, None] - along[None]) + 1e-9 >= [0.5, 0.5, 0.2]
    assert (separate.any(axis=-1) | np.eye(len(along), dtype=bool)).all()


def test_equal_rooms_are_both_found():
    rng = np.random.default_rng(3)
    box = np.array([[0, 0, 3, 0], [3, 0, 3, 2], [3, 2, 0, 2], [0, 2, 0, 0]], dtype=float)
    rooms = [wall_points(box + np.array([x, 0.0, x, 0.0]), rng) for x in (0.0, 4.0)]
    inside = [np.tile([x + 1.5, 1.0], (len(room), 1)) for x, room in zip((0.0, 4.0), rooms, strict=True)]
    target = cloud(np.vstack(rooms), np.vstack(inside))
    source = cloud(wall_points(box, rng), np.array([1.5, 1.0]))
    around = target, source, np.array([2.0, 0.0, 0.0]), (2.5, 1.0, 0.2)
    assert rivalry(scores_of(*around)) > 0.9
    np.testing.assert_allclose(np.sort(search(*around)[:2, 0]), [0.0, 4.0], atol=0.2)


def test_the_back_of_a_wall_does_not_match_its_front():
    rng = np.random.default_rng(4)
    wall = np.array([[0.0, 0.0, 5.0, 0.0], [2.0, 0.0, 2.0, 0.6]])
    target = cloud(wall_points(wall, rng), np.array([3.0, 2.0]))
    behind = cloud(wall_points(wall[:1], rng), np.array([3.0, -2.0]))
    assert scores_of(target, behind, np.zeros(3), (0.3, 0.3, 0.1)).max(initial=0.0) < 0.05


@pytest.mark.parametrize("sizes", [(0, 50), (50, 0), (0, 0), (1, 1)])
def test_clouds_that_fit_nowhere_give_no_candidates(sizes):
    rng = np.random.default_rng(5)
    target, source = (cloud(rng.uniform(0.0, 2.0, (n, 2)) + k * 100.0) for k, n in enumerate(sizes))
    found = search(target, source, np.zeros(3), (0.5, 0.5, 0.1))
    assert found.shape == (0, 3)


def test_headings_are_wrapped():
    rng = np.random.default_rng(6)
    truth = np.array([0.0, 0.0, -np.pi + 0.05])
    target, source = pair(ROOM, truth, rng, CENTRE)
    found = search(target, source, np.array([0.0, 0.0, np.pi - 0.05]), (0.4, 0.4, 0.3))
    assert abs(found[0, 2] - truth[2]) < 0.05
    assert (np.abs(found[:, 2]) <= np.pi).all()


def test_the_same_input_gives_the_same_candidates():
    results = []
    for _ in range(2):
        target, source = pair(ROOM, np.zeros(3), np.random.default_rng(7), CENTRE)
        found = search(target, source, np.array([0.5, -0.5, 0.1]), (1.0, 1.0, 0.3))
        results.append(found.tobytes())
    assert results[0] == results[1]


@pytest.mark.parametrize("seed", range(5))
def test_peaks_are_those_of_a_loop(seed):
    """No neighbour within the grid is better, half of the best at least, and none within the separation of a better one."""
    rng = np.random.default_rng(seed)
    config = CorrelativeConfig(resolution=0.25, angle_step=0.1, candidates=100)
    scores = rng.random((7, 9, 11)).astype(np.float32)
    peaks = []
    for place in zip(*np.nonzero(scores), strict=True):
        around = scores[tuple(slice(max(k - 1, 0), k + 2) for k in place)]
        if scores[place] == around.max() and scores[place] >= 0.5 * scores.max():
            peaks.append(place)
    chosen = []
    for place in sorted(peaks, key=lambda p: -scores[p]):
        off = [np.abs(np.subtract(place, other)) for other in chosen]
        if all(d[0] >= 2 or d[1] >= 2 or d[2] >= 2 for d in off):
            chosen.append(place)
    np.testing.assert_array_equal(_peaks(scores, config), chosen)


@pytest.mark.parametrize("axis", range(3))
def test_the_shoulder_of_a_peak_is_no_peak(axis):
    """The score falls off slowly along one axis: places beyond the separation are still more than half as good."""
    at = np.stack(np.indices((13, 13, 13)), axis=-1) - 6
    slope = np.where(np.arange(3) == axis, 0.05, 1.0)
    scores = np.maximum(1.0 - np.abs(at) @ slope, 0.0).astype(np.float32)
    assert _peaks(scores, CorrelativeConfig(resolution=0.25, angle_step=0.1)).tolist() == [[6, 6, 6]]


@pytest.mark.parametrize("name", ["resolution", "angle_step", "spread", "candidates"])
def test_steps_and_widths_are_above_zero(name):
    with pytest.raises(ConfigError, match=rf"{name} = 0(\.0)? is out of range"):
        override(CorrelativeConfig(), [f"{name}=0"])
