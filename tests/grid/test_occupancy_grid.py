import math
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uwblite import se2
from uwblite.errors import ConfigError, DataError
from uwblite.grid.geometry import GridGeometry
from uwblite.grid.occupancy_grid import FREE, OCCUPIED, UNKNOWN, GridConfig, from_counts
from uwblite.grid.ray_counter import WEIGHT_UNIT, RayCounter, mark_rays
from uwblite.grid.tracing import Sweeps, from_sweeps, in_runs, moved_scans
from uwblite.sensor_log import LaserScans

DEFAULT = GridConfig()


def from_scans(first, scans, config=DEFAULT, *, last=None, **options):
    """Make the map of one recording's scans."""
    return from_sweeps([Sweeps(scans, first, last)], config, **options)


def with_blind_scans(poses, scans, far):
    """Return poses and scans with two more, so far from the origin, m, that have no reading."""
    corners = np.array([[-far, -far, 0.0], [far, far, 0.0]])
    blind = np.full((2, scans.ranges.shape[1]), np.nan, np.float32)
    stamps = np.append(scans.stamps, scans.stamps[-1] + np.array([1.0, 2.0]))
    return np.concatenate([poses, corners]), replace(scans, stamps=stamps, ranges=np.concatenate([scans.ranges, blind]))


def scan_rays(scans, reach, first, last=None, *, flipped=False):
    return Sweeps(scans, first, last, flipped).rays(np.arange(len(first)), reach)


def bresenham(row, col, row_end, col_end):
    """Bresenham's line with the integer error term, cell by cell, first cell included, last excluded."""
    d_row, d_col = row_end - row, col_end - col
    n, d = max(abs(d_row), abs(d_col)), min(abs(d_row), abs(d_col))
    steep = abs(d_row) > abs(d_col)
    cells, error = [], 0
    for _ in range(n):
        cells.append((row, col))
        error += 2 * d
        aside = error >= n
        if aside:
            error -= 2 * n
        if steep or aside:
            row += int(np.sign(d_row))
        if not steep or aside:
            col += int(np.sign(d_col))
    return cells


def counted(geometry, origins, endpoints, scan, weak, walls):
    """Hits and misses by looping over scans, rays and cells; where walls are given, the rays saw nothing."""
    hits = np.zeros((geometry.rows, geometry.cols), int)
    misses = np.zeros_like(hits)
    for number in sorted(set(scan.tolist())):
        passed, ended = set(), set()
        for ray in np.flatnonzero(scan == number):
            begin, end = geometry.cell_of(origins[ray]), geometry.cell_of(endpoints[ray])
            for cell in bresenham(*map(int, begin), *map(int, end)):
                if walls is not None and geometry.inside(*cell) and walls[cell]:
                    break
                passed.add(cell)
            if walls is None:
                ended.add(tuple(map(int, end)))
        for counts, weight, cells in ((hits, 1, ended), (misses, WEIGHT_UNIT if walls is None else weak, passed - ended)):
            for cell in cells:
                if geometry.inside(*cell):
                    counts[cell] += weight
    return hits, misses


def geometry_of(size, resolution=0.1):
    return GridGeometry(resolution, np.array([-1.0, -0.5]), size, size + 3)


@pytest.mark.parametrize("reach", [1, 2, 3, 7, 30])
def test_lines_are_bresenhams_in_every_direction(reach):
    size = 2 * reach + 1
    for row in range(-reach, reach + 1):
        cols = np.arange(-reach, reach + 1)
        marks = np.zeros((len(cols), size, size), np.uint8)
        start = np.arange(len(cols)) * size * size + reach * size + reach
        mark_rays(marks.reshape(-1), start, np.full(len(cols), row), cols, size)
        for slot, col in enumerate(cols):
            expected = np.zeros((size, size), np.uint8)
            for r, c in bresenham(reach, reach, reach + row, reach + int(col)):
                expected[r, c] = 1
            np.testing.assert_array_equal(marks[slot], expected)


def test_long_lines_round_exactly():
    rng = np.random.default_rng(1)
    for n in (255, 256, 257, 2000, 5000):
        d = np.unique(np.concatenate([[0, 1, n // 2, n - 1, n], rng.integers(0, n, 3)]))
        marks = np.zeros((n + 1) * (n + 1), np.uint8)
        for shorter in d:
            mark_rays(marks, np.array([0]), np.array([shorter]), np.array([n]), n + 1)
            k = np.arange(n)
            expected = (2 * k * int(shorter) + n) // (2 * n) * (n + 1) + k
            assert marks[expected].all()
            marks[expected] = 0
            assert not marks.any()


@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.integers(1, 5))
@settings(max_examples=25, deadline=None)
def test_counts_equal_a_loop_over_cells(seed, rays, scans):
    rng = np.random.default_rng(seed)
    geometry = geometry_of(18)
    # Some rays leave the grid and come back to it; some end where they begin.
    origins = rng.uniform(-2.0, 2.0, (rays, 2))
    endpoints = origins + rng.choice([0.0, 0.3, 2.0], (rays, 1)) * rng.normal(size=(rays, 2))
    scan = np.sort(rng.integers(0, scans, rays))
    for walls in (None, rng.random((geometry.rows, geometry.cols)) < rng.choice([0.0, 0.05, 0.5])):
        counter = RayCounter(geometry, 0.25)
        counter.insert_rays(origins, endpoints, scan, walls)
        hits, misses = counted(geometry, origins, endpoints, scan, 4, walls)
        np.testing.assert_array_equal(counter.hits, hits)
        np.testing.assert_array_equal(counter.misses, misses)


def test_a_cell_that_more_scans_see_than_are_traced_at_once_counts_them_all():
    counter = RayCounter(geometry_of(18))
    counter.insert_rays(np.zeros((600, 2)), np.tile([0.35, 0.0], (600, 1)), np.arange(600))
    row, col = counter.geometry.cell_of(np.array([[0.0, 0.0], [0.35, 0.0]]))
    assert counter.misses[row[0], col[0]] == 600 * WEIGHT_UNIT
    assert counter.hits[row[1], col[1]] == counter.hits.sum() == 600


def test_counts_do_not_depend_on_working_memory(monkeypatch):
    rng = np.random.default_rng(2)
    origins = rng.uniform(0, 1, (400, 2))
    endpoints, scan = origins + rng.normal(size=(400, 2)), np.arange(400) // 7
    results = []
    for cells in (1, 3000, 1 << 22):
        monkeypatch.setattr("uwblite.grid.ray_counter._SCRATCH_CELLS", cells)
        counter = RayCounter(geometry_of(30), 0.25)
        counter.insert_rays(origins, endpoints, scan)
        results.append((counter.hits, counter.misses))
    for hits, misses in results[1:]:
        np.testing.assert_array_equal(hits, results[0][0])
        np.testing.assert_array_equal(misses, results[0][1])


def test_geometry_turns_cells_into_metres_and_back():
    geometry = GridGeometry.around(np.array([-3.21, 4.0]), np.array([7.77, 9.99]), 0.05, 10**6)
    row, col = (a.reshape(-1) for a in np.mgrid[: geometry.rows, : geometry.cols])
    back = geometry.cell_of(geometry.centre_of(row, col))
    np.testing.assert_array_equal(back[0], row)
    np.testing.assert_array_equal(back[1], col)
    inside = geometry.inside(*geometry.cell_of(np.array([[-3.21, 4.0], [7.77, 9.99], [7.77, 4.0]])))
    assert inside.all()
    np.testing.assert_allclose(geometry.origin / 0.05, np.round(geometry.origin / 0.05), atol=1e-9)
    assert geometry.centre_of(np.array(0), np.array(0))[1] < geometry.centre_of(np.array(1), np.array(0))[1]


@pytest.mark.parametrize("size", [(70.0, 40.0), (51.0, 51.0), (1e7, 1e7), (1e6, 0.1)])
def test_too_large_a_map_gets_larger_cells(size):
    high = np.array(size)
    grid = GridGeometry.around(np.zeros(2), high, 0.05, 10**6)
    assert grid.cells <= 10**6
    assert (grid.corner >= high).all()
    assert (grid.origin <= 0.0).all()
    quarters = grid.resolution / 0.05 * 4.0
    assert quarters == pytest.approx(round(quarters))
    # No coarser than needed: a quarter of the resolution asked for less, and there would be too many.
    finer = grid.resolution - 0.25 * 0.05
    if size[0] == size[1]:
        assert finer < 0.05 or (size[0] / finer + 4) ** 2 > 0.98 * 10**6
    assert grid.resolution > 0.05


def test_the_smallest_grid_is_a_cell_with_two_around_it_on_every_side():
    """A point lies in four cells at most; with fewer than 6 x 6 there is no map."""
    point = np.array([0.01, 0.01])
    assert GridGeometry.around(point, point, 0.05, 36).cells == 25
    assert GridGeometry.around(point - 0.02, point, 0.05, 36).cells == 36
    with pytest.raises(ConfigError, match=r"grid\.max_cells"):
        GridGeometry.around(point - 0.02, point, 0.05, 35)


def test_a_map_without_a_size_is_refused():
    with pytest.raises(ConfigError, match="no map of nan"):
        GridGeometry.around(np.zeros(2), np.array([np.nan, 1.0]), 0.05, 10**6)
    with pytest.raises(ConfigError, match=r"no map of 3 x 1 m fits into 10 cells; raise grid\.max_cells"):
        GridGeometry.around(np.array([1.0, 2.0]), np.array([4.0, 3.0]), 0.05, 10)


def room_scans(poses, half=2.0, beams=360, noise=0.0, range_max=10.0, seed=0):
    """Scans of the square room |x|, |y| <= half from poses inside it."""
    increment = 2.0 * math.pi / beams
    bearing = poses[:, 2:] + (-math.pi + increment * np.arange(beams))
    direction = np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.where(direction == 0, np.inf, (half * np.sign(direction) - poses[:, None, :2]) / direction)
    ranges = reach.min(axis=-1) + noise * np.random.default_rng(seed).normal(size=bearing.shape)
    ranges = np.where(ranges > range_max, np.inf, ranges).astype(np.float32)
    stamps = 0.1 * np.arange(len(poses))
    return LaserScans(stamps, ranges, -math.pi, increment, 0.0, 0.02, range_max)


def drive(scans=40):
    t = np.linspace(0.0, 2.0 * math.pi, scans)
    return np.stack([0.8 * np.cos(t), 0.8 * np.sin(t), t], axis=1)


def test_a_room_comes_out_as_a_room():
    poses = drive()
    grid = from_scans(poses, room_scans(poses, noise=0.01), GridConfig(move_distance=0.0))
    states, geometry = grid.states(), grid.geometry
    row, col = (a.astype(np.intp) for a in np.mgrid[: geometry.rows, : geometry.cols])
    centre = geometry.centre_of(row, col)
    depth = 2.0 - np.abs(centre).max(axis=-1)
    # Noise of 1 cm moves the wall by less than two cells of 5 cm.
    assert (states[depth > 0.1] == FREE).all()
    assert (states[depth < -0.1] == UNKNOWN).all()
    wall = grid.occupied_points()
    assert np.abs(np.abs(wall).max(axis=1) - 2.0).max() < 0.1
    along = np.floor(wall[np.abs(wall[:, 0] - 2.0) < 0.1, 1] / 0.05)
    assert len(set(along)) > 0.95 * 80


@pytest.mark.parametrize(("count", "traced"), [(9000, 8000), (25500, 8500)])
def test_of_very_many_scans_evenly_spread_ones_are_traced(count, traced):
    poses = np.column_stack([0.1 * np.arange(count), np.zeros(count), np.zeros(count)])
    scans = LaserScans(0.1 * np.arange(count), np.full((count, 2), 3.0, dtype=np.float32), 0.0, 1.5, 0.0, 0.02, 5.0)
    few, all_ = (from_scans(poses, scans, GridConfig(move_distance=distance)) for distance in (0.09, 0.0))
    assert (few.scans_used, all_.scans_used) == (traced, count)
    assert few.geometry.cols > 0.999 * all_.geometry.cols
    ahead = few.geometry.cell_of(np.array([[0.1 * count / 2.0, 0.01]]))
    assert few.states()[ahead] == all_.states()[ahead] == FREE


def test_someone_who_stood_there_for_a_while_is_gone():
    poses = np.repeat(np.array([[0.0, 0.0, 0.0]]), 60, axis=0)
    scans = room_scans(poses)
    scans.ranges[:6, 170:190] = 1.0
    grid = from_scans(poses, scans, GridConfig(move_distance=0.0))
    row, col = grid.geometry.cell_of(np.array([[0.999, 0.0]]))
    assert grid.states()[row, col] == FREE
    first = replace(scans, stamps=scans.stamps[:6], ranges=scans.ranges[:6])
    few = from_scans(poses[:6], first, GridConfig(move_distance=0.0))
    assert few.states()[few.geometry.cell_of(np.array([[0.999, 0.0]]))] != FREE


def test_beams_that_saw_nothing_never_draw_and_clear_only_so_far():
    # Bresenham's lines from one cell leave gaps between them; a robot that moves a little fills them.
    poses = 0.05 * np.random.default_rng(0).normal(size=(100, 3)).clip(-2, 2)
    scans = room_scans(poses, half=5.0, beams=1440, range_max=3.0)
    assert not np.isfinite(scans.ranges).any()
    grid = from_scans(poses, scans, GridConfig(move_distance=0.0, max_clear_distance=2.0))
    states, geometry = grid.states(), grid.geometry
    assert (states != OCCUPIED).all()
    row, col = (a.astype(np.intp) for a in np.mgrid[: geometry.rows, : geometry.cols])
    far = np.linalg.norm(geometry.centre_of(row, col), axis=-1)
    assert (states[far > 2.25] == UNKNOWN).all()
    assert (states[far < 1.8] == FREE).all()
    none = from_scans(poses, scans, GridConfig(move_distance=0.0, max_clear_distance=0.0))
    assert (none.states() == UNKNOWN).all()


def test_beams_that_saw_nothing_do_not_clear_behind_walls():
    # Every second scan a dark stretch of the wall swallows its beams.
    poses = drive(60)
    scans = room_scans(poses, half=1.5)
    bearing = se2.wrap_angle(poses[:, 2:] + scans.angles)
    scans.ranges[(np.abs(bearing) < 0.4) & (np.arange(60) % 2 == 0)[:, None]] = np.inf
    grid = from_scans(poses, scans, GridConfig(move_distance=0.0, clear_weight=1.0))
    row, col = (a.astype(np.intp) for a in np.mgrid[: grid.geometry.rows, : grid.geometry.cols])
    outside = np.abs(grid.geometry.centre_of(row, col)).max(axis=-1) > 1.6
    assert (grid.states()[outside] == UNKNOWN).all()
    assert grid.states()[grid.geometry.cell_of(np.array([1.51, 0.0]))] == OCCUPIED
    end = scan_rays(scans, room_scans(poses, half=1.5).ranges, poses).endpoints.reshape(60, -1, 2)
    scans.ranges[(end[:, :, 0] > 1.49) & (np.abs(end[:, :, 1]) < 0.5)] = np.inf
    grid = from_scans(poses, scans, GridConfig(move_distance=0.0, clear_weight=1.0))
    assert grid.states()[grid.geometry.cell_of(np.array([2.0, 0.0]))] == FREE


def test_weak_clearing_needs_more_scans_than_strong():
    config = GridConfig(move_distance=0.0, max_clear_distance=2.0, clear_weight=0.25)
    poses = np.zeros((8, 3))
    grid = from_scans(poses, room_scans(poses, half=5.0, range_max=3.0), config)
    seen = from_scans(poses, room_scans(poses, half=1.5), config)
    assert grid.probability()[grid.geometry.cell_of(np.array([1.0, 0.0]))] > 0.196
    assert seen.probability()[seen.geometry.cell_of(np.array([1.0, 0.0]))] < 0.196


@given(st.lists(st.booleans(), min_size=1, max_size=40), st.integers(1, 8))
def test_runs_equal_a_loop(flags, least):
    expected, start = [False] * len(flags), 0
    for i in range(len(flags) + 1):
        if i == len(flags) or not flags[i]:
            if i - start >= least:
                expected[start:i] = [True] * (i - start)
            start = i + 1
    np.testing.assert_array_equal(in_runs(np.array([flags]), least)[0], expected)


def test_rays_start_where_the_laser_was_at_their_time():
    scans = room_scans(np.zeros((1, 3)), beams=5)
    first, last = np.array([[0.0, 0.0, 3.1]]), np.array([[0.4, -0.2, -3.1]])
    rays = scan_rays(scans, scans.ranges, first, last)
    np.testing.assert_allclose(rays.origins, np.linspace(0, 1, 5)[:, None] * [0.4, -0.2], atol=1e-12)
    turn = 3.1 + np.linspace(0, 1, 5) * (2 * math.pi - 6.2)
    for ray in range(5):
        pose = np.array([*rays.origins[ray], turn[ray]])
        angle, reach = scans.angles[ray], scans.ranges[0, ray]
        expected = se2.transform(pose, reach * np.array([math.cos(angle), math.sin(angle)]))
        np.testing.assert_allclose(rays.endpoints[ray], expected, atol=1e-5)


@pytest.mark.parametrize("deskewed", [False, True])
def test_the_map_of_a_laser_upside_down_is_that_of_its_beams_in_the_other_order(deskewed):
    """Not square, so that a mirror image is another map; some beams see nothing."""
    poses = drive(20) + np.array([0.7, 0.2, 0.3])
    scans = room_scans(poses, range_max=2.4)
    other = replace(scans, ranges=np.roll(scans.ranges[:, ::-1], 1, axis=1))
    last, config = poses.copy() if deskewed else None, GridConfig(move_distance=0.0)
    upright, flipped = (from_sweeps([Sweeps(s, poses, last, flip)], config) for s, flip in ((scans, False), (other, True)))
    np.testing.assert_allclose(flipped.geometry.origin, upright.geometry.origin)
    assert np.mean(flipped.states() != upright.states()) < 0.01
    assert np.mean(upright.states()[::-1] != upright.states()) > 0.05


def test_progress_over_several_recordings_counts_all_their_scans_twice():
    """Once for the beams that saw something, once for those that saw nothing."""
    steps = []
    sweeps = [Sweeps(room_scans(poses), poses) for poses in (drive(70), drive(9)[:0], drive(5))]
    grid = from_sweeps(sweeps, GridConfig(move_distance=0.0), progress=lambda done, total: steps.append((done, total)))
    assert grid.scans_used == 75
    assert steps == [(64, 150), (70, 150), (75, 150), (139, 150), (145, 150), (150, 150)]


def test_the_grid_ends_where_knowledge_ends():
    # Neither walls nor the first pose lie on edges of cells, where rounding decides.
    poses = np.add(drive(30), [0.012, 0.013, 0.0])
    scans = room_scans(poses, half=2.01)
    grid = from_scans(poses, scans, last=np.add(poses, [0.0, 0.0, 0.5]))
    known = grid.log_odds != 0
    rows, cols = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    assert (rows[0], cols[0]) == (2, 2)
    assert (len(known) - rows[-1], known.shape[1] - cols[-1]) == (3, 3)
    # The frame is where it was: cells of a larger grid have the same values.
    both = with_blind_scans(poses, scans, 5.9)
    whole = from_scans(both[0], both[1], last=np.add(both[0], [0.0, 0.0, 0.5]))
    np.testing.assert_array_equal(whole.log_odds, grid.log_odds)
    np.testing.assert_allclose(whole.geometry.origin, grid.geometry.origin, atol=1e-12)


def test_a_flipped_laser_sees_the_mirror_image():
    scans = room_scans(np.array([[0.5, 0.2, 0.0]]), beams=90)
    there = scan_rays(scans, scans.ranges, np.zeros((1, 3))).endpoints
    mirrored = scan_rays(scans, scans.ranges, np.zeros((1, 3)), flipped=True).endpoints
    np.testing.assert_allclose(mirrored, there * [1, -1], atol=1e-5)


def test_scans_that_did_not_move_are_not_traced_again():
    poses = np.array([[0, 0, 0], [0.05, 0, 0], [0.11, 0, 0], [0.11, 0, 0.05], [0.11, 0, 0.2], [0.11, 0, 0.2 - 2 * np.pi]])
    np.testing.assert_array_equal(moved_scans(poses, 0.1, 0.1), [0, 2, 4])
    np.testing.assert_array_equal(moved_scans(poses[:, [1, 0, 2]] + [0.0, 5.0, 0.0], 0.1, 0.1), [0, 2, 4])
    assert len(moved_scans(poses[:0], 0.1, 0.1)) == 0
    # Just as far is far enough; eighths of a metre have no rounding errors.
    eighths = np.column_stack([0.125 * np.arange(5.0), np.zeros((5, 2))])
    np.testing.assert_array_equal(moved_scans(eighths, 0.25, 0.1), [0, 2, 4])
    np.testing.assert_array_equal(moved_scans(poses, 0.0, 0.1), np.arange(6))
    assert from_scans(poses, room_scans(poses), GridConfig()).scans_used == 3


def test_progress_counts_the_scans_of_both_passes():
    poses, steps = drive(100), []
    grid = from_scans(poses, room_scans(poses), last=poses + 0.01, progress=lambda done, total: steps.append((done, total)))
    assert steps == sorted(steps)
    assert steps[-1] == (2 * grid.scans_used, 2 * grid.scans_used)


def test_scan_by_scan_insertion_makes_the_same_map():
    poses = drive(30)
    scans = room_scans(poses)
    config = GridConfig(move_distance=0.0)
    whole = from_scans(poses, scans, config)
    counter = RayCounter(whole.geometry, config.clear_weight)
    for k in range(30):
        rays = Sweeps(scans, poses).rays(np.array([k]), scans.ranges[[k]])
        counter.insert_rays(rays.origins, rays.endpoints)
    assert from_counts(counter, config).log_odds.tobytes() == whole.log_odds.tobytes()


def test_log_odds_are_bayes():
    config = GridConfig(p_hit=0.7, p_miss=0.4, clamp=100.0)
    odds = (0.7 / 0.3) ** 3 * (0.4 / 0.6) ** 7
    for chosen, expected in ((config, odds), (replace(config, clamp=0.1), math.exp(np.clip(math.log(odds), -0.1, 0.1)))):
        counter = RayCounter(geometry_of(5), 0.25)
        counter.hits[1, 1], counter.misses[1, 1] = 3, 7 * WEIGHT_UNIT
        grid = from_counts(counter, chosen)
        assert grid.probability()[1, 1] == pytest.approx(expected / (1 + expected), rel=1e-5)
        assert grid.log_odds[0, 0] == 0.0


@pytest.mark.parametrize("backwards", [False, True])
def test_the_grid_holds_the_farthest_scans_in_whatever_block_they_stand(backwards):
    """150 scans are traced in blocks; a hall is driven up and most of the way back, so its end lies in the middle block."""
    along = np.concatenate([np.linspace(0.0, 20.0, 75), np.linspace(20.0, 8.0, 75)])
    poses = np.stack([(-along if backwards else along) + 0.0123, np.full(150, 0.0123), np.zeros(150)], axis=1)
    scans = LaserScans(0.1 * np.arange(150), np.full((150, 8), 1.01, np.float32), -math.pi, math.pi / 4, 0.0, 0.02, 5.0)
    grid = from_scans(poses, scans, GridConfig(move_distance=0.0))
    rays = scan_rays(scans, scans.ranges, poses)
    whole = from_scans(*with_blind_scans(poses, scans, 25.0), GridConfig(move_distance=0.0))
    row, col = grid.geometry.cell_of(rays.endpoints)
    assert grid.geometry.inside(row, col).all()
    np.testing.assert_array_equal(grid.log_odds[row, col], whole.log_odds[whole.geometry.cell_of(rays.endpoints)])
    assert np.count_nonzero(grid.log_odds) == np.count_nonzero(whole.log_odds)


def test_misuse_is_named():
    scans = room_scans(drive(3))
    with pytest.raises(DataError, match="poses"):
        from_scans(drive(2), scans)
    with pytest.raises(DataError, match="no scans"):
        from_scans(np.zeros((0, 3)), LaserScans(np.zeros(0), np.zeros((0, 4), np.float32), 0.0, 0.1, 0.0, 0.02, 5.0))
    with pytest.raises(DataError, match="belong together"):
        RayCounter(geometry_of(5)).insert_rays(np.zeros((2, 2)), np.zeros((3, 2)))
    one = np.zeros((1, 2)), np.ones((1, 2))
    with pytest.raises(DataError, match="walls"):
        RayCounter(geometry_of(5)).insert_rays(*one, None, np.zeros((5, 5), bool))
    with pytest.raises(DataError, match="too long"):
        RayCounter(geometry_of(5)).insert_rays(np.zeros((1, 2)), np.full((1, 2), 1e6))


@pytest.mark.parametrize("wrong", [
    {"p_hit": 0.5}, {"p_hit": 1.0}, {"p_miss": 0.5}, {"p_miss": 0.0}, {"resolution": 0.9e-4}, {"resolution": 1001.0},
    {"clear_weight": 1.01}, {"clear_weight": -0.01}, {"clamp": 0.0}, {"max_cells": 0},
])  # fmt: skip
def test_settings_that_no_bayes_filter_or_no_grid_can_have_are_refused(wrong):
    with pytest.raises(ConfigError, match=f"{next(iter(wrong))} = .* is out of range"):
        GridConfig(**wrong)


def test_the_limits_of_the_settings_are_allowed():
    GridConfig(resolution=1e-4, clear_weight=0.0, max_cells=1)
    GridConfig(resolution=1e3, clear_weight=1.0, p_hit=0.999, p_miss=0.001)


@pytest.mark.parametrize("far", [3e3, 1e7])
def test_a_scan_that_a_wrong_reading_threw_far_away_is_not_drawn_and_counted(far):
    poses = drive()
    plain = from_scans(poses, room_scans(poses), GridConfig(move_distance=0.0))
    astray = np.insert(poses, 20, [far, -far, 1.0], axis=0)
    tracemalloc.start()
    grid = from_scans(astray, room_scans(np.insert(poses, 20, poses[20], axis=0)), GridConfig(move_distance=0.0))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 50e6
    assert (plain.scans_astray, grid.scans_astray, grid.scans_used) == (0, 1, len(poses))
    np.testing.assert_array_equal(grid.log_odds, plain.log_odds)


def test_a_grid_too_large_is_made_coarser_before_it_is_allocated():
    """Two places far apart would make a map of 10^12 cells."""
    poses = drive(4)
    poses[2:, :2] = 5e4
    tracemalloc.start()
    grid = from_scans(poses, room_scans(drive(4)), GridConfig(max_cells=10**6))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 50e6
    assert grid.geometry.resolution > 50.0
    assert grid.scans_used == 4
    reported = []
    sweeps = Sweeps(room_scans(drive(3)), drive(3))
    grid = from_sweeps([sweeps], DEFAULT, announce=reported.append)
    assert reported[0].cells >= grid.geometry.cells
    assert reported[0].megabytes == pytest.approx(reported[0].cells * 12e-6)
