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


def finished(steps):
    """Return what a search returns in the end."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return end.value


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
    bounds = finished(search._scored(room, level, offsets, nodes))
    shift = np.stack(np.meshgrid(np.arange(size), np.arange(size)), axis=-1).reshape(-1, 2)
    for node, bound in zip(nodes, bounds, strict=True):
        below = np.column_stack([np.full(len(shift), node[0]), node[1:] + shift])
        assert finished(search._scored(room, 0, offsets, below)).max() <= bound + 1e-12


def test_the_best_pose_is_that_of_trying_every_one(room):
    pose = (1.0, 2.5, 0.4)
    points = seen_from(pose, 14)
    headings = np.arange(0.0, 2.0 * np.pi - 0.5 * search._HEADING, search._HEADING)
    offsets = search._offsets(room, points, headings)
    rows, cols = np.nonzero(room.free)
    best, where = -1.0, None
    for turn in range(len(headings)):
        nodes = np.column_stack([np.full(len(rows), turn), rows, cols])
        scores = finished(search._scored(room, 0, offsets, nodes))
        if scores.max() > best:
            best, where = scores.max(), nodes[scores.argmax()]
    found = finished(search._by_scans(room, points, NO_RANGES))
    assert found.complete
    expected = [*(room.origin + (where[:0:-1] + 0.5) * room.cell), se2.wrap_angle(headings[where[0]])]
    np.testing.assert_allclose(found.poses[0], expected, atol=1e-9)
    off = se2.between(np.array(pose), found.poses[0])
    # A cell and a step of the heading.
    assert np.hypot(*off[:2]) < 0.15
    assert abs(off[2]) < 0.06
