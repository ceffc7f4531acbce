"""Ways through planted walls, against the geometry of segments."""

import numpy as np
import pytest

from uwblite.radio import line_of_sight
from uwblite.radio.line_of_sight import blocked


def seen(start, end):
    """Return points of a wall, 5 cm apart as in a cloud, each seen three times."""
    start, end = np.array(start), np.array(end)
    along = np.linspace(0.0, 1.0, int(np.hypot(*(end - start)) / 0.05) + 1)
    return np.repeat(start + along[:, None] * (end - start), 3, axis=0)


def area(a, b):
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def crosses(tags, anchors, start, end):
    """Return which segments cut the wall, by the signs of areas."""

    def side(a, b, c):
        return area(b - a, c - a)

    start, end = np.broadcast_to(start, tags.shape), np.broadcast_to(end, tags.shape)
    apart = side(tags, anchors, start) * side(tags, anchors, end) < 0
    return apart & (side(start, end, tags) * side(start, end, anchors) < 0)


def test_ways_through_a_wall_are_those_that_cut_it():
    rng = np.random.default_rng(1)
    wall = np.array([-4.0, 0.3]), np.array([5.0, 1.1])
    tags = np.column_stack([rng.uniform(-8.0, 8.0, 400), rng.uniform(-8.0, -2.0, 400)])
    anchors = np.column_stack([rng.uniform(-8.0, 8.0, 400), rng.uniform(3.0, 8.0, 400)])
    cut = crosses(tags, anchors, *wall)
    # Within a cell of the wall's ends either answer is right.
    way = anchors - tags
    gap = np.min([np.abs(area(way, end - tags)) / np.hypot(*way.T) for end in wall], axis=0)
    clear = gap > 0.3
    assert clear.sum() > 300
    assert 50 < cut.sum() < 350
    found = blocked(tags, anchors, seen(*wall))
    assert not found[clear & ~cut].any()
    # A way may slip through where two cells of a slanting wall meet at a corner alone.
    assert np.mean(found[clear] == cut[clear]) > 0.99
    # Each by itself, whatever others are asked for.
    assert [blocked(tags[k : k + 9], anchors[k : k + 9], seen(*wall)).tolist() for k in (0, 200, 391)] == [
        found[k : k + 9].tolist() for k in (0, 200, 391)
    ]


def test_the_wall_that_an_anchor_hangs_on_and_the_robot_itself_do_not_count():
    wall = seen([-5.0, 0.0], [5.0, 0.0])
    tags, anchors = np.array([[0.0, -6.0], [0.0, 0.2], [0.0, -6.0]]), np.array([[0.0, 0.4], [0.0, 6.0], [0.0, 6.0]])
    assert blocked(tags, anchors, wall).tolist() == [False, False, True]
    assert blocked(tags[:, ::-1], anchors[:, ::-1], wall[:, ::-1]).tolist() == [False, False, True]


def test_single_points_are_no_surface_and_nothing_seen_blocks_nothing():
    tags, anchors = np.array([[0.0, -6.0]]), np.array([[0.0, 6.0]])
    assert not blocked(tags, anchors, np.array([[0.0, 0.0], [9.0, 9.0]])).any()
    assert not blocked(tags, anchors, np.zeros((0, 2))).any()
    assert blocked(tags[:0], anchors[:0], np.zeros((3, 2))).shape == (0,)


@pytest.mark.parametrize(("count", "wall"), [(2, False), (3, True)])
def test_three_points_in_a_cell_are_a_surface(count, wall):
    """The points of a cell 0.2 m wide in the middle of the way; the map ends elsewhere."""
    points = np.concatenate([np.full((count, 2), 0.05), [[-5.0, -5.0]]])
    assert blocked(np.array([[0.05, -4.0]]), np.array([[0.05, 4.0]]), points).tolist() == [wall]


def test_a_tag_at_the_anchor_is_not_blocked():
    here = np.array([[1.0, 1.0]])
    assert not blocked(here, here, seen([0.0, 0.0], [2.0, 2.0])).any()


def test_an_anchor_taken_for_far_away_costs_no_more_than_the_map_is_wide(monkeypatch):
    wall, tags = seen([-5.0, 0.0], [5.0, 0.0]), np.array([[0.0, -6.0], [2.0, -6.0], [2.0, 6.0], [-5.0, -6.0]])
    near, looked_up = np.array([[0.0, 6.0], [2.0, -9.0], [9.0, 6.0], [-5.0, 6.0]]), []
    look_up = line_of_sight._look_up
    monkeypatch.setattr(line_of_sight, "_look_up", lambda at, *rest: looked_up.append(at.shape[1]) or look_up(at, *rest))
    far = tags + 1e6 * (near - tags)
    assert blocked(tags, far, wall).tolist() == blocked(tags, near, wall).tolist() == [True, False, False, True]
    assert sum(looked_up) < 2 * 4 * (10.0 + 1.0) / (0.5 * 0.2)
