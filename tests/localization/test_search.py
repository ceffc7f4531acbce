"""Branch and bound against trying every pose, and the factors of ranges against numeric derivatives."""

import numpy as np
import pytest
from helpers.localization_room import ODD, cast, grid_of

from uwblite import se2
from uwblite.localization import search
from uwblite.localization.walls import walls_of
from uwblite.localization.window import Ranges

NO_RANGES = Ranges(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros(0))


@pytest.fixture(scope="module")
def room():
    return search.field_of(walls_of(grid_of(ODD)))


def seen_from(pose, count=40):
    """Return points (p, 2) of a scan in the frame of the base."""
    readings = cast(np.asarray(pose))
    angles = np.linspace(-np.pi / 2, np.pi / 2, len(readings))
    points = readings[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points = points[np.isfinite(readings)]
    return points[np.linspace(0, len(points) - 1, count).astype(int)]


@pytest.mark.parametrize("level", [1, 2, 3])
def test_a_node_bounds_every_pose_below_it(room, level):
    rng = np.random.default_rng(level)
    headings = np.arange(0.0, 2.0 * np.pi, 0.7)
    offsets = search._offsets(room, seen_from((1.0, 2.5, 0.4)), headings)
    size = 2**level
    rows, cols = (rng.integers(room.margin, n - room.margin, 30) for n in room.free.shape)
    nodes = np.column_stack([rng.integers(0, len(headings), 30), rows, cols])
    bounds = search._scored(room, level, offsets, nodes)
    shift = np.stack(np.meshgrid(np.arange(size), np.arange(size)), axis=-1).reshape(-1, 2)
    for node, bound in zip(nodes, bounds, strict=True):
        below = np.column_stack([np.full(len(shift), node[0]), node[1:] + shift])
        assert search._scored(room, 0, offsets, below).max() <= bound + 1e-12


def test_the_best_pose_is_that_of_trying_every_one(room):
    pose = (1.0, 2.5, 0.4)
    points = seen_from(pose, 14)
    headings = np.arange(0.0, 2.0 * np.pi - 0.5 * search._HEADING, search._HEADING)
    offsets = search._offsets(room, points, headings)
    rows, cols = np.nonzero(room.free)
    best, where = -1.0, None
    for turn in range(len(headings)):
        nodes = np.column_stack([np.full(len(rows), turn), rows, cols])
        scores = search._scored(room, 0, offsets, nodes)
        if scores.max() > best:
            best, where = scores.max(), nodes[scores.argmax()]
    found = search._by_scans(room, points, NO_RANGES)
    assert found.complete
    expected = [*(room.origin + (where[:0:-1] + 0.5) * room.cell), se2.wrap_angle(headings[where[0]])]
    np.testing.assert_allclose(found.poses[0], expected, atol=1e-9)
    off = se2.between(np.array(pose), found.poses[0])
    # A cell and a step of the heading.
    assert np.hypot(*off[:2]) < 0.15
    assert abs(off[2]) < 0.06


def some_ranges(seed):
    rng = np.random.default_rng(seed)
    places, tags = rng.uniform(-5, 5, (12, 2)), rng.uniform(-1, 1, (12, 2))
    pose = np.array([0.3, -0.4, 0.7])
    true = np.hypot(*(pose[:2] + se2.rotate(pose[2], tags) - places).T)
    return pose, Ranges(np.arange(12) % 3, places, tags, true + rng.normal(0, 0.2, 12), rng.uniform(0.1, 0.3, 12))


def test_factors_of_ranges_are_the_numeric_gradient_of_their_cost():
    for seed in range(3):
        pose, ranges = some_ranges(seed)
        pose = pose + np.array([0.1, -0.05, 0.03])

        def cost(x, ranges=ranges):
            error = search.range_errors(x[None], ranges)[0][0]
            return 2.0 * search._INDEPENDENT * np.log1p(np.square(error / (2.0 * ranges.sigma))).sum()

        steps = np.eye(3) * 1e-6
        gradient = [(cost(pose + s) - cost(pose - s)) / 2e-6 for s in steps]
        np.testing.assert_allclose(search.range_factors(pose[None], ranges)[1][0], gradient, rtol=1e-4, atol=1e-5)


def test_moments_are_wide_where_the_ranges_say_little_and_hold_the_truth():
    pose, ranges = some_ranges(4)
    mean, covariance = search.range_moments(search.refined_by_ranges(pose[None], ranges)[0], ranges)
    off = mean - pose
    assert off @ np.linalg.solve(covariance, off) < 16.0
    near = np.abs(ranges.anchor) == 0
    less = search.range_moments(pose, search.chosen(ranges, np.flatnonzero(near)))[1]
    assert np.trace(less) > 2.0 * np.trace(covariance)
