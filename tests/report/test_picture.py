import tracemalloc
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uwblite.grid.geometry import GridGeometry
from uwblite.grid.occupancy_grid import OccupancyGrid
from uwblite.io.png import decode_png, encode_png
from uwblite.report.canvas import ACCEPTED, ANCHOR, HEIGHT, PATHS, PROPOSED, START, WIDTH, Canvas, rgb, text_mask
from uwblite.report.drawn_map import DrawnAnchor, DrawnClosure, DrawnMap
from uwblite.report.picture import FLOOR, INK, PAPER, WALL, Key, _legend, _paste, draw_errors, draw_map, rows_of, side_by_side
from uwblite.report.svg_map import round_length


def room(rows=80, cols=120, resolution=0.05):
    log_odds = np.full((rows, cols), -5.0, np.float32)
    log_odds[[0, -1], :] = log_odds[:, [0, -1]] = 5.0
    log_odds[5:10, 5:10] = 0.0
    return OccupancyGrid(GridGeometry(resolution, np.array([-2.0, 1.0]), rows, cols), log_odds)


def share(image, colour, tolerance=12):
    return (np.abs(image.astype(int) - colour).max(axis=-1) <= tolerance).mean()


STRIP = 70
"""Pixels that the strip below takes in these pictures at least."""
PATH_IN_ROOM = np.stack([np.linspace(-1.0, 3.0, 50), np.linspace(2.0, 4.0, 50), np.zeros(50)], axis=1)


def test_everything_is_on_it():
    anchors = [DrawnAnchor("5C0B", np.array([0.0, 3.0]), np.diag([0.04, 0.01])), DrawnAnchor("lost", np.full(2, np.nan))]
    drawn = DrawnMap(room(), [PATH_IN_ROOM], anchors, [DrawnClosure(np.array([[0.0, 2.0], [2.0, 4.0]]), True)])
    image = draw_map(drawn, caption="a room")
    assert image.dtype == np.uint8
    for colour in (WALL, PAPER, (255, 255, 255), ANCHOR):
        assert share(image, colour) > 1e-4
    for colour in (PATHS[0], ACCEPTED):
        assert share(image, colour, 60) > 1e-4
    np.testing.assert_array_equal(decode_png(encode_png(image)), image)
    np.testing.assert_array_equal(draw_map(drawn, caption="a room"), image)


def test_a_path_ends_in_a_ring_that_is_open_for_half_of_its_width():
    """A path of one place: the ring of its end lies on the disc of its start."""
    image = draw_map(DrawnMap(room(), [np.array([[1.0, 3.0, 0.0]])]), size=600)
    ring = np.abs(image[:-STRIP].astype(int) - PATHS[0]).max(axis=-1) < 12
    rows, cols = np.flatnonzero(ring.any(axis=1)), np.flatnonzero(ring.any(axis=0))
    hole = ~ring[(rows[0] + rows[-1]) // 2, cols[0] : cols[-1] + 1]
    assert 0.4 < hole.mean() < 0.7


def test_what_is_north_is_on_top_and_the_path_lies_on_its_cells():
    grid = room()
    grid.log_odds[:40], grid.log_odds[40:] = -5.0, 5.0
    image = draw_map(DrawnMap(grid, [np.array([[-1.0, 1.5, 0.0], [-1.0, 1.6, 0.0]])]), size=600)
    dark = np.abs(image.astype(int) - WALL).max(axis=-1) < 12
    rows = np.flatnonzero(dark.mean(axis=1) > 0.5)
    below = image[rows.max() + 5 : -100]
    assert rows.mean() < image.shape[0] / 2
    assert share(below, PATHS[0], 60) > 0
    assert share(image[: rows.max()], PATHS[0], 60) == 0


@pytest.mark.parametrize(("size", "resolution"), [(240, 0.01), (240, 0.3), (300, 0.05), (1500, 0.05)])
def test_thin_walls_survive_every_scale(size, resolution):
    image = draw_map(DrawnMap(room(200, 300, resolution), [PATH_IN_ROOM[:1]]), size=size)[:-STRIP]
    dark = np.abs(image.astype(int) - WALL).max(axis=-1) < 12
    assert (dark.any(axis=0).mean(), dark.any(axis=1).mean()) > (0.3, 0.3)
    assert image.shape[0] <= max(size * 1.2, 240)


def test_parts_may_be_missing():
    nothing = [DrawnMap(None, [PATH_IN_ROOM]), DrawnMap(None), DrawnMap(room()), DrawnMap(room(), [np.zeros((0, 3))])]
    for drawn in nothing:
        assert draw_map(drawn).shape[2] == 3


def test_round_lengths():
    assert [round_length(x) for x in (0.99, 1.0, 4.9, 5.0, 37.0, 0.03)] == [0.5, 1.0, 2.0, 5.0, 20.0, 0.02]


def test_a_stroke_has_its_width_and_smooth_edges():
    canvas = Canvas(np.full((40, 60, 3), 255, np.uint8))
    canvas.lines(np.array([[10.0, 20.0, 50.0, 20.0]]), 4.0, (0, 0, 0))
    ink = (255.0 - canvas.image[:, 30, 0]) / 255.0
    assert ink.sum() == pytest.approx(4.0, abs=0.7)
    canvas = Canvas(np.full((40, 60, 3), 255, np.uint8))
    canvas.polygon(np.array([[5.0, 5.0], [25.0, 5.0], [25.0, 15.0], [5.0, 15.0]]), (0, 0, 0))
    assert (255.0 - canvas.image[:, :, 0]).sum() / 255.0 == pytest.approx(200.0, rel=0.02)


def test_drawing_outside_is_harmless():
    canvas = Canvas(np.full((20, 30, 3), 255, np.uint8))
    canvas.discs(np.array([[-50.0, 5.0], [1e9, 3.0], [np.nan, 0.0]]), 5.0, (0, 0, 0))
    canvas.polygon(np.array([[-9.0, -9.0], [-5.0, -9.0], [-7.0, -5.0]]), (0, 0, 0))
    canvas.text(np.full(2, 500.0), "far", (0, 0, 0), halo=(255, 0, 0))
    assert (canvas.image == 255).all()
    canvas.lines(np.array([[-1e7, 10.0, 1e7, 10.0]]), 2.0, (0, 0, 0))
    canvas.discs(np.array([[0.0, 0.0]]), 3.0, (0, 0, 0))
    canvas.text(np.array([-8.0, -3.0]), "edge", (0, 0, 0))
    assert (canvas.image != 255).any()


def test_letters_differ_and_unknown_ones_become_boxes():
    letters = [chr(c) for c in range(33, 127) if text_mask(chr(c)).tobytes() != text_mask("\u20ac").tobytes()]
    assert {*"0123456789ABCDEFabcdef.-:_", *"xyz"} <= set(letters)
    assert len({text_mask(c).tobytes() for c in letters}) == len(letters)
    assert text_mask("ab", 3).shape == (3 * HEIGHT, 3 * (2 * WIDTH + 1))
    assert text_mask("\u20ac").any()
    assert text_mask("").shape[0] == HEIGHT


def test_recordings_have_colours_of_their_own():
    one, two = np.array([[0.0, 0.0], [4.0, 0.0]]), np.array([[0.0, 3.0], [4.0, 3.0]])
    image = draw_map(DrawnMap(None, [one, two]))
    assert share(image, PATHS[0], 0) > 0
    assert share(image, PATHS[1], 0) > 0
    assert share(draw_map(DrawnMap(None, [one])), PATHS[1], 0) == 0


@given(st.integers(0, 10_000), st.floats(0.5, 3000.0))
@settings(max_examples=25)
def test_a_polygon_is_what_lies_within_all_its_edges(seed, size):
    rng = np.random.default_rng(seed)
    angle = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 9)))[:: rng.choice([-1, 1])]
    corners = rng.uniform(0, 40, 2) + size * np.stack([np.cos(angle), 0.7 * np.sin(angle)], axis=1)
    image = np.zeros((30, 40, 3), dtype=np.uint8)
    Canvas(image).polygon(corners, (255, 255, 255))
    fine = (np.stack(np.meshgrid(np.arange(120), np.arange(90)), axis=-1) + 0.5) / 3
    edge, ahead = np.roll(corners, -1, axis=0) - corners, fine[:, :, None] - corners
    turn = edge[:, 0] * ahead[..., 1] - edge[:, 1] * ahead[..., 0]
    within = (turn >= 0).all(axis=-1) | (turn <= 0).all(axis=-1)
    cover = within.reshape(30, 3, 40, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(image[:, :, 0] / 255, cover, atol=2 / 255)


def test_an_anchor_that_may_stand_anywhere_takes_no_longer_than_others():
    """Its ellipse is many times the picture; only what is in the picture is looked at."""
    anchor = DrawnAnchor("far", np.array([0.0, 3.0]), np.diag([1e6, 1e4]))
    image = draw_map(DrawnMap(room(), [PATH_IN_ROOM], [anchor]), size=700)
    assert share(image, ANCHOR, 40) > 0


@pytest.mark.parametrize("far", [3e3, 1e7])
def test_what_strays_far_takes_neither_memory_nor_the_room_of_the_rest(far):
    path = np.insert(PATH_IN_ROOM, [20], [[far, -far, 0.0]], axis=0)
    anchors = [DrawnAnchor("near", np.array([0.0, 3.0])), DrawnAnchor("far", np.array([-far, far]), np.eye(2) * far)]
    closures = [DrawnClosure(np.array([[0.0, 2.0], [far, far]]), True)]
    tracemalloc.start()
    image = draw_map(DrawnMap(room(), [path], anchors, closures))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200e6
    assert max(image.shape) < 2000
    assert share(image, WALL) > 1e-4


def test_many_cells_in_one_pixel_equal_a_loop_over_blocks():
    """The surest wall of a block where there is one, else the surest floor; wherever the blocks begin."""
    log_odds = np.random.default_rng(3).choice([0.0, -5.0, 5.0], (50, 70), p=[0.2, 0.75, 0.05]).astype(np.float32)
    image = np.full((17, 21, 3), PAPER, np.uint8)
    _paste(image, OccupancyGrid(GridGeometry(0.1, np.array([0.3, 0.2]), 50, 70), log_odds), np.zeros(2), 1 / 0.4)
    for row in range(17):
        for col in range(21):
            block = log_odds[max(4 * row - 2, 0) : max(4 * row + 2, 0), max(4 * col - 3, 0) : max(4 * col + 1, 0)]
            if block.size:
                expected = WALL if block.max() > 0 else FLOOR if block.min() < 0 else PAPER
                np.testing.assert_array_equal(image[16 - row, col], expected)


def test_the_legend_is_of_what_is_drawn_and_never_cut():
    keys = [Key(text, PATHS[0], "line", 32) for text in ("path", "recording 2", "anchor, 2 sigma", "loop closure")]
    for width in (240, 500, 2000, *range(600, 1200)):
        rows = rows_of(width, keys)
        assert [key for row in rows for key in row] == keys
        assert all(len(row) == 1 or sum(key.wide for key in row) <= width for row in rows)
    assert len(rows_of(2000, keys)) == 1
    assert len(rows_of(240, keys)) > 1
    anchor = DrawnAnchor("A", np.zeros(2))
    plain, with_anchor = draw_map(DrawnMap(room(), [PATH_IN_ROOM])), draw_map(DrawnMap(room(), [PATH_IN_ROOM], [anchor]))
    assert share(plain[-26:], ANCHOR) == 0
    assert share(with_anchor[-60:], ANCHOR) > 0


def test_the_legend_names_every_part_that_is_drawn_and_no_other():
    here, step = np.zeros(2), np.array([[0.0, 0.0], [1.0, 0.0]])
    anchor, measured = DrawnAnchor("A", here), DrawnAnchor("A", here, np.eye(2))
    proposed, lost = DrawnAnchor("new1", here, kind="proposed"), DrawnAnchor("lost", np.full(2, np.nan))
    way = ["path", "start", "end"]
    for drawn, entries in (
        (DrawnMap(room()), []),
        (DrawnMap(room(), [step]), way),
        (DrawnMap(room(), [step] * 2), ["recording 1", "recording 2", "start", "end"]),
        (DrawnMap(None, (), [lost]), []),
        (DrawnMap(None, (), [anchor, lost]), ["anchor"]),
        (DrawnMap(None, (), [anchor, measured]), ["anchor, 2 sigma"]),
        (DrawnMap(None, (), [proposed]), ["proposed"]),
        (DrawnMap(None, (), [anchor, proposed]), ["anchor", "proposed"]),
        (DrawnMap(None, [step], (), [DrawnClosure(step, False)]), way),
        (DrawnMap(None, [step], (), [DrawnClosure(step, False), DrawnClosure(step, True)]), [*way, "loop closure"]),
        (DrawnMap(None, [step], doubted=[step]), [*way, "not to be trusted"]),
    ):
        assert [key.text for key in _legend(drawn)] == entries


def test_the_origin_and_the_axes_are_on_it():
    """A grid with the origin in its middle: the mark is where x and y are 0."""
    grid = OccupancyGrid(GridGeometry(0.05, np.array([-2.0, -1.5]), 60, 80), np.full((60, 80), -5.0, np.float32))
    image = draw_map(DrawnMap(grid), size=600)
    ink = np.argwhere(np.abs(image[:-50].astype(int) - INK).max(axis=-1) < 8)
    inner = ink[(ink[:, 0] < image.shape[0] - 120) & (ink[:, 1] > 60)]
    corner = [inner[:, 0].max(), inner[:, 1].min()]
    floor = np.argwhere((image == FLOOR).all(axis=-1))
    floor = floor[floor[:, 0] < image.shape[0] - 120]
    (top, left), cell = floor.min(axis=0), np.ptp(floor[:, 1]) / 80
    np.testing.assert_allclose(corner, [top + 30 * cell, left + 40 * cell], atol=0.8 * cell)


def test_ellipses_and_names_at_the_edge_are_whole():
    anchor = DrawnAnchor("A-LONG-NAME", np.array([3.9, 3.0]), np.diag([0.25, 0.01]))
    image = draw_map(DrawnMap(room(), [PATH_IN_ROOM], [anchor]), size=700)
    edge = image[: -STRIP - 60, -3:]
    assert share(edge, ANCHOR, 60) == 0


def test_start_and_end_have_the_marks_of_the_legend():
    image = draw_map(DrawnMap(room(), [PATH_IN_ROOM]), size=700)
    drawn = image[:-STRIP]
    rows, cols = np.nonzero(np.abs(drawn.astype(int) - START).max(axis=-1) < 12)
    assert len(rows) > 40
    assert cols.max() - cols.min() < 14
    # The path leads right and up: it starts on the left.
    assert cols.mean() < drawn.shape[1] / 2


def test_the_surer_a_cell_is_the_nearer_it_is_to_black_or_white():
    values = np.array([[-6.0, -1.0, -0.3, 0.0, 0.2, 0.9, 6.0]], dtype=np.float32)
    image = np.zeros((1, 7, 3), dtype=np.uint8)
    _paste(image, OccupancyGrid(GridGeometry(1.0, np.zeros(2), 1, 7), values), np.zeros(2), 1.0)
    assert (np.diff(image[0, :, 0].astype(int)) < 0).all()
    assert [tuple(image[0, k].tolist()) for k in (0, 3, 6)] == [FLOOR, PAPER, WALL]


def test_names_of_anchors_do_not_cover_walls():
    """An anchor beside the right wall of a room has its name on the left, where the floor is."""
    grid = room()
    corner = grid.geometry.corner
    inside = np.array([corner[0] - 1.2 * grid.geometry.resolution, grid.geometry.origin[1] + 1.0])
    log_odds = np.full_like(grid.log_odds, -4.0)
    log_odds[:, -1] = 4.0
    walled = OccupancyGrid(grid.geometry, log_odds)
    plain, named = (draw_map(DrawnMap(walled, anchors=[DrawnAnchor(name, inside)])) for name in ("", "5C0B"))
    written = np.any(plain != named, axis=2)
    assert written.any()
    assert not np.any(written & np.all(plain == WALL, axis=2))


def test_proposed_anchors_have_a_colour_and_an_entry_of_their_own():
    image = draw_map(DrawnMap(room(), [PATH_IN_ROOM], [DrawnAnchor("new1", np.array([0.0, 1.0]), kind="proposed")]))
    assert np.any(np.all(image == PROPOSED, axis=2))
    assert not np.any(np.all(image == ANCHOR, axis=2))


def test_the_picture_of_errors_says_what_it_shows():
    grid = room()
    points = grid.geometry.centre_of(np.array([5]), np.array([5]))
    one, other = (draw_errors(grid, points, np.array([0.3]), [], title) for title in ("Expected error", "Another error!"))
    changed = np.flatnonzero(np.any(one != other, axis=(1, 2)))
    assert changed.min() > len(one) - STRIP
    assert share(one, rgb("bee1aa")) > 0.3


def test_an_ellipse_is_of_two_standard_deviations_on_every_side_of_its_anchor():
    """Drawn thinly on a white floor: its middle, and four standard deviations along each axis, lengthwise and across."""
    grid, sigma = room(), np.array([0.5, 0.2])
    grid.log_odds[:] = -5.0
    each = [DrawnAnchor("", np.array([1.0, 3.0]), np.diag(variance)) for variance in (np.full(2, 1e-9), sigma**2)]
    plain, drawn = (draw_map(DrawnMap(grid, anchors=[anchor]), size=900) for anchor in each)
    rows, cols = np.nonzero(np.any(plain != drawn, axis=2))
    extent = np.array([np.ptp(cols), np.ptp(rows)])
    mark = np.abs(plain[: rows.max()].astype(int) - ANCHOR).max(axis=-1) < 12
    ink = np.argwhere(mark)[:, ::-1].mean(axis=0)
    assert extent[0] / extent[1] == pytest.approx(2.5, rel=0.1)
    np.testing.assert_allclose([(cols.min() + cols.max()) / 2, (rows.min() + rows.max()) / 2], ink, atol=0.1 * extent[1])


def test_pictures_side_by_side_are_as_high_as_the_highest():
    low, high = np.full((3, 4, 3), 7, np.uint8), np.full((5, 2, 3), 9, np.uint8)
    both = side_by_side([low, high])
    assert both.shape == (5, 6, 3)
    np.testing.assert_array_equal(both[:3, :4], low)
    np.testing.assert_array_equal(both[:, 4:], high)
    assert np.all(both[3:, :4] == FLOOR)


def test_stretches_that_are_not_to_be_trusted_are_marked_where_they_are():
    """Along that part of the path alone, and in the legend."""
    kept = {"anchors": [DrawnAnchor("A", np.array([0.0, 3.0]))]}
    pictures = [
        draw_map(DrawnMap(room(), paths, doubted=doubted, **kept))
        for paths, doubted in (([], []), ([PATH_IN_ROOM], []), ([PATH_IN_ROOM], [PATH_IN_ROOM[10:30, :2]]))
    ]
    path, marked = (np.flatnonzero((a != b)[:800].any(axis=(0, 2))) for a, b in pairwise(pictures))
    per_step = (path[-1] - path[0]) / 49
    assert marked[0] == pytest.approx(path[0] + 10 * per_step, abs=12)
    assert marked[-1] == pytest.approx(path[0] + 29 * per_step, abs=12)
    assert share(pictures[2], rgb("fabe14"), 70) > share(pictures[1], rgb("fabe14"), 70)
    assert (pictures[1][-STRIP:] != pictures[2][-STRIP:]).any()
