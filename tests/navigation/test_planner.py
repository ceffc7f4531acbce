"""Paths against a plain Dijkstra of the test's own, and the laws that hold for every path."""

import heapq

import numpy as np
import pytest
from helpers.planning_worlds import distance_to_squares, grid_of, random_grid
from scipy.sparse.csgraph import connected_components, dijkstra

from uwblite.grid.geometry import GridGeometry
from uwblite.grid.occupancy_grid import OCCUPIED, OccupancyGrid
from uwblite.navigation import steps
from uwblite.navigation.planner import NoPathError, make_planner
from uwblite.navigation.steps import STEPS

RADIUS = 0.15


def reference_costs(planner, first):
    """Return the cost from one cell to every other (rows, cols) by a heap and loops; corners are not cut."""
    passable, cost = planner.clearance.passable(), planner.clearance.cell_cost().astype(np.float64)
    found = np.full(passable.shape, np.inf)
    queue = [(0.0, first)]
    while queue:
        here, (row, col) = heapq.heappop(queue)
        if here >= found[row, col]:
            continue
        found[row, col] = here
        for dr, dc in STEPS:
            r, c = row + dr, col + dc
            inside = 0 <= r < passable.shape[0] and 0 <= c < passable.shape[1]
            if inside and passable[r, c] and passable[r, col] and passable[row, c]:
                step = planner.clearance.geometry.resolution * np.hypot(dr, dc) * 0.5 * (cost[row, col] + cost[r, c])
                heapq.heappush(queue, (here + step, (r, c)))
    return found


def free_places(planner, count, seed):
    """Return places (count, 2) where the robot may stand."""
    return planner.steps.places(np.random.default_rng(seed).choice(planner.steps.nodes(), count))


def step_cost(planner, start, goal):
    """Return the cost of the cheapest steps from beside one place to beside another, by a search through the whole map."""
    nodes = planner.steps.nodes()
    first, last = np.searchsorted(nodes, [planner._beside(start), planner._beside(goal)])
    return dijkstra(planner.steps.graph(nodes), indices=first)[last]


@pytest.mark.parametrize("unknown", ["refuse", "price"])
@pytest.mark.parametrize("seed", range(2))
def test_costs_of_the_steps_are_those_of_a_plain_dijkstra(seed, unknown):
    grid = random_grid(seed)
    grid.log_odds[20:30, 20:26] = 0.0
    planner = make_planner(grid, RADIUS, unknown=unknown)
    nodes = np.flatnonzero(planner.clearance.passable())
    graph = planner.steps.graph(nodes)
    costs = dijkstra(graph, indices=0)
    first = np.divmod(int(nodes[0]), grid.geometry.cols)
    reference = reference_costs(planner, first).ravel()
    assert costs == pytest.approx(reference[nodes], rel=1e-6)
    assert abs(graph - graph.T).max() < 1e-12


@pytest.mark.parametrize("seed", range(2))
def test_laws_of_a_path(seed):
    grid = random_grid(seed)
    planner = make_planner(grid, RADIUS)
    places = free_places(planner, 8, seed).reshape(-1, 2, 2)
    for start, goal in places:
        try:
            path = planner.plan(start, [goal], step=0.07)
        except NoPathError:
            assert not np.isfinite(step_cost(planner, start, goal))
            continue
        straight = np.hypot(*(goal - start))
        assert np.array_equal(path.poses[[0, -1], :2], [start, goal])
        assert path.length >= straight - 1e-9
        assert path.cost >= path.length - 1e-9
        gaps = np.hypot(*np.diff(path.poses[:, :2], axis=0).T)
        assert gaps.max(initial=0.0) <= 0.07 + 1e-9
        assert path.distances == pytest.approx(np.concatenate([[0.0], np.cumsum(gaps)]))
        share = np.linspace(0.0, 1.0, 20)[:, None, None]
        dense = (path.poses[:-1, :2] + share * np.diff(path.poses[:, :2], axis=0)).reshape(-1, 2)
        obstacles = grid.states() == OCCUPIED
        assert distance_to_squares(grid, obstacles, np.concatenate([dense, start[None]])).min() >= RADIUS - 1e-6
        assert np.all(path.clearances <= distance_to_squares(grid, obstacles, path.poses[:, :2]) + 1e-6)
        # Smoothing gains; the bounds between the cells, and a corner's worth, make a straight way of steps a little dearer.
        assert path.cost <= step_cost(planner, start, goal) * 1.005 + 1e-3
        assert planner.plan(goal, [start]).cost == pytest.approx(path.cost, rel=0.02, abs=1e-3)


@pytest.mark.parametrize(("seed", "block", "radius"), [(0, 8, RADIUS), (1, 16, RADIUS), (0, 8, 0.2)])
def test_a_large_map_is_searched_in_parts_and_what_is_connected_stays_so(monkeypatch, seed, block, radius):
    """Regions are made in a map of 100 x 140 cells, and pieces of 2,500 nodes: connected exactly, and hardly dearer.

    For the larger robot some doors are passed at a place of their own, between the middles of cells.
    """
    grid = random_grid(seed, rows=100, cols=140, boxes=95)
    grid.log_odds[20:30, 20:26] = 0.0
    whole = make_planner(grid, radius, unknown="price")
    monkeypatch.setattr(steps, "AT_ONCE", 2500)
    monkeypatch.setattr(steps, "BLOCK", block)
    parts = make_planner(grid, radius, unknown="price")
    assert parts.steps.regions is not None
    assert (len(parts.steps.clearance.tight) > 0) == (radius > RADIUS)
    nodes = whole.steps.nodes()
    assert np.array_equal(nodes, parts.steps.nodes())
    label = connected_components(whole.steps.graph(nodes))[1]
    dearer = []
    for first, last in np.random.default_rng(seed).choice(len(nodes), (20, 2)).tolist():
        found = parts.steps.path(int(nodes[first]), int(nodes[last]))
        assert (found is not None) == (label[first] == label[last])
        reached = np.concatenate(list(parts.steps.reachable(int(nodes[first]))))
        assert np.array_equal(np.sort(reached), nodes[label == label[first]])
        if found is None:
            continue
        assert (found[0], found[-1]) == (nodes[first], nodes[last])
        start, goal = whole.steps.places(nodes[[first, last]])
        one, other = whole.plan(start, [goal]), parts.plan(start, [goal])
        assert distance_to_squares(grid, grid.states() == OCCUPIED, other.poses[:, :2]).min() >= radius - 1e-6
        dearer.append(other.cost / max(one.cost, 1e-9))
    assert np.median(dearer) < 1.01
    assert np.mean(dearer) < 1.05


@pytest.mark.parametrize("door", [0, 8])
def test_from_one_half_of_a_large_map_to_the_other_there_is_a_path_where_there_is_a_door(monkeypatch, door):
    monkeypatch.setattr(steps, "AT_ONCE", 2500)
    log_odds = np.full((100, 140), -4.0, dtype=np.float32)
    log_odds[:, 70:73] = 4.0
    log_odds[40 : 40 + door, 70:73] = -4.0
    planner = make_planner(OccupancyGrid(GridGeometry(0.05, np.zeros(2), *log_odds.shape), log_odds), RADIUS)
    assert planner.steps.regions is not None
    places = np.array([[1.0, 1.0], [6.0, 4.0]])
    first, last = (int(planner._beside(place)) for place in places)
    assert (planner.steps.path(first, last) is None) == (door == 0)
    reached = np.concatenate(list(planner.steps.reachable(first)))
    assert (last in reached) == (door > 0)


@pytest.mark.parametrize("unknown", ["refuse", "price"])
def test_a_long_corridor_is_hardly_searched_and_its_path_is_as_cheap(monkeypatch, unknown):
    """Three legs of 50 m, 1.8 m wide: where the way is open for long, no cell is searched."""
    log_odds = np.full((120, 1000), -4.0, dtype=np.float32)
    for k, row in enumerate(range(36, 116, 40)):
        log_odds[row : row + 4] = 4.0
        log_odds[row : row + 4, slice(2, 34) if k % 2 else slice(-34, -2)] = -4.0
    grid = OccupancyGrid(GridGeometry(0.05, np.zeros(2), *log_odds.shape), log_odds)
    start, goal = np.array([0.7, 0.8]), np.array([49.2, 5.2])
    whole = make_planner(grid, 0.2, unknown=unknown).plan(start, [goal])
    monkeypatch.setattr(steps, "AT_ONCE", 15_000)
    parts = make_planner(grid, 0.2, unknown=unknown)
    searched = []
    search = steps.StepSearch._search
    monkeypatch.setattr(steps.StepSearch, "_search", lambda s, n, *ends: searched.append(len(n)) or search(s, n, *ends))
    path = parts.plan(start, [goal])
    assert 0 < sum(searched) < 0.4 * len(parts.steps.nodes())
    assert whole.cost * 0.995 < path.cost < whole.cost * 1.005
    assert distance_to_squares(grid, grid.states() == OCCUPIED, path.poses[:, :2]).min() >= 0.2 - 1e-6


@pytest.mark.parametrize("cells", [7, 8, 9])
@pytest.mark.parametrize("resolution", [0.05, 0.1])
@pytest.mark.parametrize("shift", [0, 1])
def test_a_door_is_open_to_a_radius_a_tenth_of_a_cell_below_half_its_width(cells, resolution, shift):
    """Whether its middle lies on a cell or between two; the wall is as thick as three cells."""
    log_odds = np.full((60, 40 + shift), -4.0, dtype=np.float32)
    log_odds[29:32] = 4.0
    log_odds[29:32, 15 + shift : 15 + shift + cells] = -4.0
    grid = OccupancyGrid(GridGeometry(resolution, np.zeros(2), *log_odds.shape), log_odds)
    start, goal = resolution * np.array([18.0, 8.0]), resolution * np.array([18.3, 51.0])
    half = 0.5 * cells * resolution
    for upright in (grid, OccupancyGrid(GridGeometry(resolution, np.zeros(2), *log_odds.T.shape), log_odds.T.copy())):
        turned = upright is not grid
        ends = [end[::-1] if turned else end for end in (start, goal)]
        path = make_planner(upright, half - 0.1 * resolution).plan(ends[0], [ends[1]])
        places = np.concatenate([path.poses[:-1, :2] + s * np.diff(path.poses[:, :2], axis=0) for s in np.linspace(0, 1, 9)])
        least = distance_to_squares(upright, upright.states() == OCCUPIED, places).min()
        assert half - 0.1 * resolution - 1e-9 <= least <= half + 1e-9
        with pytest.raises(NoPathError, match=f"in cells of {resolution:g} m"):
            make_planner(upright, half + 0.01 * resolution).plan(ends[0], [ends[1]])


def test_a_gap_between_two_corners_is_open_to_a_tenth_of_a_cell():
    """The walls end in corners that lie askew to each other: of what is between them the robot needs all."""
    for right, up in ((5, 3), (6, 4), (7, 2), (4, 4), (3, 6)):
        log_odds = np.full((70, 70), -4.0, dtype=np.float32)
        log_odds[30 : 30 + 6, :30] = 4.0
        log_odds[36 + up : 42 + up, 30 + right :] = 4.0
        grid = OccupancyGrid(GridGeometry(0.1, np.zeros(2), 70, 70), log_odds)
        half = 0.05 * np.hypot(right, up)
        path = make_planner(grid, half - 0.012).plan(np.array([3.0, 1.5]), [np.array([4.0, 6.0])])
        assert distance_to_squares(grid, grid.states() == OCCUPIED, path.poses[:, :2]).min() >= half - 0.012 - 1e-9
        with pytest.raises(NoPathError):
            make_planner(grid, half + 0.001).plan(np.array([3.0, 1.5]), [np.array([4.0, 6.0])])


def test_an_open_way_is_taken_without_a_search(monkeypatch):
    planner = make_planner(grid_of("\n".join(["." * 60] * 60)), 0.2)
    monkeypatch.setattr("uwblite.navigation.steps.dijkstra", None)
    path = planner.plan(np.array([1.03, 1.11]), [np.array([4.5, 3.2])])
    assert path.cost == pytest.approx(np.hypot(3.47, 2.09), rel=1e-12)
    with pytest.raises(TypeError):
        planner.plan(np.array([0.25, 1.11]), [np.array([0.25, 3.2])])


def test_open_space_is_crossed_in_a_straight_line():
    planner = make_planner(grid_of("\n".join(["." * 60] * 60), resolution=0.05), 0.1)
    start, goal = np.array([0.91, 0.93]), np.array([2.02, 1.37])
    path = planner.plan(np.array([*start, 2.0]), [goal], step=0.1)
    assert path.length == pytest.approx(np.hypot(*(goal - start)), rel=1e-9)
    assert path.poses[0, 2] == pytest.approx(2.0)
    assert path.poses[1:, 2] == pytest.approx(np.arctan2(*(goal - start)[::-1]))


def test_around_the_end_of_a_wall_the_path_is_the_shortest_there_is(monkeypatch):
    # Where nearness costs nothing: two tangents, two arcs around the corners of the wall's end, and its width between them.
    monkeypatch.setattr("uwblite.navigation.clearance.NEAR_COST", 0.0)
    wide = "\n".join(["." * 81] * 60 + ["." * 40 + "#" + "." * 40] * 40)
    planner = make_planner(grid_of(wide, resolution=0.05), 0.2)
    path = planner.plan(np.array([0.8, 1.0]), [np.array([3.25, 1.0])])
    far = np.hypot(2.0 - 0.8, 2.0 - 1.0)
    arc = np.arctan2(1.0, 1.2) + np.arcsin(0.2 / far)
    shortest = 2 * (np.sqrt(far**2 - 0.2**2) + 0.2 * arc) + 0.05
    assert shortest < path.length < 1.015 * shortest
    assert path.cost == pytest.approx(path.length)


def test_a_narrow_door_is_passed_in_the_middle_and_too_narrow_a_one_not():
    text = "\n".join(["." * 40] * 20 + ["#" * 18 + "." * 5 + "#" * 17] + ["." * 40] * 20)
    grid = grid_of(text)
    start, goal = np.array([2.05, 0.8]), np.array([2.05, 3.4])
    path = make_planner(grid, 0.15).plan(start, [goal])
    assert np.abs(path.poses[:, 0] - 2.05).max() < 0.06
    with pytest.raises(NoPathError, match=r"no path to .* nearest reachable point") as caught:
        make_planner(grid, 0.255).plan(start, [goal])
    assert caught.value.nearest[1] < 2.0
    assert np.hypot(*(caught.value.nearest - goal)) < 1.8


def test_unknown_space_is_crossed_only_where_the_way_around_is_dearer():
    text = "\n".join(["." * 40] * 4 + ["." * 15 + "?" * 10 + "." * 15] * 30 + ["#" * 40])
    start, goal = np.array([1.0, 0.6]), np.array([3.0, 0.6])
    around = make_planner(grid_of(text), 0.1).plan(start, [goal])
    assert around.poses[:, 1].max() > 3.0
    through = make_planner(grid_of(text), 0.1, unknown="price").plan(start, [goal])
    assert through.poses[:, 1].max() < 1.0
    assert 1.0 + 4.0 + 1.0 - 0.4 < through.cost < 1.0 + 5.0 + 1.0 + 0.4


def test_places_on_the_way_are_passed_in_order():
    planner = make_planner(grid_of("\n".join(["." * 40] * 40)), 0.1)
    via = [np.array([3.0, 1.0]), np.array([3.0, 3.0])]
    path = planner.plan(np.array([1.0, 1.0]), [*via, np.array([1.0, 3.0])])
    where = [int(np.argmin(np.hypot(*(path.poses[:, :2] - v).T))) for v in via]
    assert np.hypot(*(path.poses[where, :2] - via).T).max() < 1e-9
    assert where == sorted(where)
    assert path.length == pytest.approx(6.0, rel=1e-6)


def test_a_robot_too_near_to_a_wall_may_leave_and_one_inside_of_it_not():
    planner = make_planner(grid_of("#" * 20 + "\n" + "\n".join(["." * 20] * 19)), 0.3)
    path = planner.plan(np.array([1.0, 1.75]), [np.array([1.0, 0.7])])
    assert path.clearances[0] < 0.3
    assert np.all(np.diff(path.clearances[:3]) > 0.0)
    with pytest.raises(NoPathError, match="cannot stand at the start"):
        planner.plan(np.array([1.0, 1.95]), [np.array([1.0, 0.7])])
    with pytest.raises(NoPathError, match="cannot stand at the start"):
        planner.plan(np.array([50.0, 1.0]), [np.array([1.0, 0.7])])


@pytest.mark.parametrize("at_once", [300_000, 200])
def test_a_robot_in_unknown_space_leaves_it_and_keeps_clear_of_what_is_known(monkeypatch, at_once):
    monkeypatch.setattr(steps, "AT_ONCE", at_once)
    text = "\n".join(["." * 40] * 16 + ["?" * 10 + "#" * 20 + "?" * 10] + ["?" * 40] * 16)
    grid = grid_of(text)
    planner, priced = make_planner(grid, 0.2), make_planner(grid, 0.2, unknown="price")
    start, goal = np.array([1.45, 0.85]), np.array([2.0, 2.7])
    path = planner.plan(start, [goal])
    known = grid.states() == OCCUPIED
    assert distance_to_squares(grid, known, path.poses[:, :2]).min() >= 0.2
    inside = path.clearances < planner.clearance.radius
    assert inside[0]
    assert np.all(np.diff(inside.astype(int)) <= 0)
    # Around the nearer end of the wall, at the price of unknown space, and as short as that way can be.
    assert path.poses[:, 0].min() < 0.9
    assert path.length < 1.1 * priced.plan(start, [goal]).length
    with pytest.raises(NoPathError, match="no path to"):
        planner.plan(goal, [start])
    with pytest.raises(NoPathError, match="has an obstacle there"):
        planner.plan(np.array([2.0, 1.65]), [goal])


def test_a_robot_that_unknown_space_and_walls_shut_in_cannot_leave():
    text = "\n".join(["." * 30] * 14 + ["." * 10 + "#" * 10 + "." * 10] + ["." * 10 + "#????????#" + "." * 10] * 8
                     + ["." * 10 + "#" * 10 + "." * 10])  # fmt: skip
    with pytest.raises(NoPathError, match=r"no path leads from the start .* out of unknown space"):
        make_planner(grid_of(text), 0.2).plan(np.array([1.5, 0.5]), [np.array([0.5, 2.0])])


def test_standing_still_is_a_path():
    path = make_planner(grid_of("\n".join(["." * 20] * 20)), 0.1).plan(np.array([1.0, 1.0, 0.5]), [np.array([1.0, 1.0])])
    assert path.length == path.cost == 0.0
    assert path.poses == pytest.approx(np.array([[1.0, 1.0, 0.5]]))


def test_a_robot_larger_than_the_map_stands_nowhere():
    with pytest.raises(NoPathError, match="nowhere"):
        make_planner(grid_of("....\n....\n....\n...."), 1.0)
