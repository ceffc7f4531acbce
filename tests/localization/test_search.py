"""Branch and bound against trying every pose, and the factors of ranges against numeric derivatives."""

import dataclasses

import numpy as np
import pytest
from helpers.localization_room import ODD, cast, grid_of

from uwblite import se2
from uwblite.localization import search
from uwblite.localization.range_model import Ranges
from uwblite.localization.search import FARTHEST, LEVELS, field_of
from uwblite.localization.walls import Rays, walls_of

BOUNDS = (np.array([-1.0, -1.0]), np.array([6.0, 5.0]))
NO_RANGES = Ranges(np.zeros(0, np.intp), np.zeros((0, 2)), np.zeros((0, 2)), *np.zeros((5, 0)))


@pytest.fixture(scope="module")
def walls():
    return walls_of(grid_of(ODD))


@pytest.fixture(scope="module")
def room(walls):
    return search.field_of(walls)


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
    headings = np.linspace(0.0, 2.0 * np.pi, search._HEADINGS, endpoint=False)
    offsets = search._offsets(room, points, headings)
    rows, cols = np.nonzero(room.free)
    best, where = -1.0, None
    for turn in range(len(headings)):
        nodes = np.column_stack([np.full(len(rows), turn), rows, cols])
        scores = finished(search._scored(room, 0, offsets, nodes))
        if scores.max() > best:
            best, where = scores.max(), nodes[scores.argmax()]
    found = finished(search._by_scans(room, points, 1.0, NO_RANGES))
    assert found.complete
    expected = [*(room.origin + (where[:0:-1] + 0.5) * room.cell), se2.wrap_angle(headings[where[0]])]
    np.testing.assert_allclose(found.poses[0], expected, atol=1e-9)
    off = se2.between(np.array(pose), found.poses[0])
    # A cell and a step of the heading.
    assert np.hypot(*off[:2]) < 0.15
    assert abs(off[2]) < 0.06


def test_a_search_with_more_pauses_finds_the_same(room, monkeypatch):
    points = seen_from((1.0, 2.5, 0.4), 30)
    found = finished(search._by_scans(room, points, 1.0, NO_RANGES))
    monkeypatch.setattr(search, "UNIT", 1000)
    again = finished(search._by_scans(room, points, 1.0, NO_RANGES))
    np.testing.assert_array_equal(again.poses, found.poses)


def test_the_highest_scores_are_the_first_of_a_stable_sort():
    scores = np.random.default_rng(1).integers(0, 40, 1000) / 40.0
    for part in (scores, scores[:64], scores[:5], np.zeros(200)):
        np.testing.assert_array_equal(search._highest(part), np.argsort(-part, kind="stable")[:64])


def ranges_at(pose, anchors, tag):
    """Return exact ranges of a tag (2,) on the base to anchors (m, 2)."""
    there = se2.transform(np.asarray(pose), np.asarray(tag))
    count = len(anchors)
    noise = np.full(count, 0.15), np.zeros(count), np.full(count, 0.1), np.full(count, 1.5)
    return Ranges(np.arange(count), anchors, np.tile(tag, (count, 1)), np.hypot(*(anchors - there).T), *noise)


def test_a_few_points_of_walls_give_the_heading_where_ranges_fix_the_place(room):
    pose = np.array([1.0, 2.5, 0.4])
    points = seen_from(pose, 9)
    rays = Rays(points, np.zeros_like(points), np.ones(len(points), bool))
    ranges = ranges_at(pose, np.array([[0.0, 0.0], [5.0, 0.0], [0.0, 4.0], [5.0, 4.0]]), (0.05, 0.0))
    assert search.FEW_BESIDE <= len(search._thinned(rays)) < search.FEW_ENDS
    off = se2.between(pose, finished(search.places(room, rays, ranges, BOUNDS)).poses)
    near = np.hypot(off[:, 0], off[:, 1]) < 0.2
    assert np.abs(off[near, 2]).min() < 0.1


def test_of_places_that_look_alike_the_one_that_the_ranges_fit_comes_first():
    poses = np.column_stack([np.linspace(0.0, 6.0, 25), np.zeros((25, 2))])
    ranges = ranges_at(poses[17], np.array([[0.0, 3.0], [6.0, 3.0]]), (0.0, 0.0))
    found = finished(search._likeliest(poses, np.linspace(0.9, 0.85, 25), ranges, complete=True))
    np.testing.assert_allclose(found.poses[0], poses[17], atol=0.26)


def test_a_range_that_is_too_long_tells_half_as_much_against_a_place():
    """One range that fits a first place; by 0.15 m beyond all tolerance too long, or too short, for the others."""
    anchor = np.array([[10.0, 0.0]])
    one = ranges_at((0.0, 0.0, 0.0), anchor, (0.0, 0.0))
    beyond = np.sqrt(0.5) * 0.1 + search.SURE * 0.15 + 0.15
    centres = np.array([[0.0, 0.0], [beyond, 0.0], [-beyond, 0.0]])
    assert finished(search._allowed(centres, 0.1, one)).tolist() == [True, True, False]


def test_where_ranges_leave_too_many_places_no_place_is_tried():
    """One range of a hundred metres, wide as a house, in a field of a square kilometre."""
    one = ranges_at((0.0, 0.0, 0.0), np.array([[100.0, 0.0]]), (0.0, 0.0))
    bounds = (np.array([-500.0, -500.0]), np.array([500.0, 500.0]))
    wide = dataclasses.replace(one, sigma=np.array([80.0]))
    found = finished(search._by_ranges(wide, bounds))
    assert (len(found.poses), found.complete) == (0, False)


def test_of_many_places_the_first_of_those_near_each_other_are_kept_with_work_for_what_is_near():
    """As many as a house has at half a metre and 0.3 rad; to compare all with all would be 80 million operations."""
    poses = np.random.default_rng(4).uniform((0.0, 0.0, -np.pi), (40.0, 30.0, np.pi), (4000, 3))
    work = sum(search._distinct(poses, 4000, True))
    found, kept = finished(search._distinct(poses, 4000, True)), poses[:0]
    for pose in poses:
        if search.apart(pose, kept).all():
            kept = np.vstack([kept, pose])
    np.testing.assert_array_equal(found.poses, kept)
    looks = work - len(kept) * search._PER_LOOK
    assert (found.complete, looks < 100 * search._PER_PLACE * len(poses)) == (True, True)
    for most, complete in ((len(kept), True), (len(kept) - 1, False)):
        few = finished(search._distinct(poses, most, True))
        np.testing.assert_array_equal(few.poses, kept[:most])
        assert few.complete is complete


def test_a_cell_holds_the_likelihood_of_its_distance_to_the_nearest_wall(walls, room):
    rng = np.random.default_rng(1)
    rows, cols = (rng.integers(room.margin - 10, n - room.margin + 10, 400) for n in room.free.shape)
    centres = room.origin + (np.stack([cols, rows], axis=1) + 0.5) * room.cell
    apart = np.hypot(*(centres[:, None] - walls.points[None]).transpose(2, 0, 1)).min(axis=1)
    # An end is 0.1 m about its wall, and 0.1 m within its cell.
    spread = np.hypot(0.1, 0.1)
    expected = 255.0 * np.exp(-0.5 * (apart / spread) ** 2)
    found = room.levels[0][rows, cols].astype(float)
    # The table of nearest walls has cells of 0.05 m: the distance is known to half a diagonal of one.
    slope = 255.0 * np.exp(-0.5) / spread
    assert np.abs(found - expected).max() < slope * 0.5 * np.sqrt(2.0) * walls.cell + 1.0
    assert (found[apart > 0.8] == 0).all()


@pytest.mark.parametrize("level", range(1, LEVELS + 1))
def test_a_level_holds_the_maxima_over_squares_of_cells(room, level):
    base, size = room.levels[0], 2**level
    rng = np.random.default_rng(level)
    rows, cols = (rng.integers(0, n, 300) for n in base.shape)
    for row, col in zip(rows, cols, strict=True):
        assert room.levels[level][row, col] == base[row : row + size, col : col + size].max()


def test_every_point_of_a_scan_finds_a_cell(walls, room):
    """A robot stands in a free cell; what it sees is at most FARTHEST away."""
    rows, cols = np.nonzero(room.free)
    reach = FARTHEST / room.cell + 2**LEVELS
    assert rows.min() >= reach
    assert cols.min() >= reach
    assert rows.max() + reach < room.free.shape[0]
    assert cols.max() + reach < room.free.shape[1]
    inside = room.origin + (np.stack([cols, rows], axis=1) + 0.5) * room.cell
    assert (walls.state_at(*inside.T) == 0).all()
    assert len(rows) == pytest.approx(48.0 / room.cell**2, rel=0.05)


def test_a_large_map_gets_coarser_cells():
    wide = grid_of((), size=(200.0, 200.0), cell=0.5)
    room = field_of(walls_of(wide))
    assert room.cell > 0.1
    # Four million, and a rim for the coarsest level on every side.
    assert room.levels[0].size <= (np.sqrt(4e6) + 2 * 2 ** (LEVELS + 1) + 2) ** 2
    assert room.levels[0].size > 4e6, "no coarser than it must be"
    assert not room.levels[0].any()
