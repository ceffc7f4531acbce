"""A straight path leaves an anchor its mirror image; a bend in it, or a range that decides, does not."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted_graphs import plain_ranges, relative_edges
from helpers.planted_tasks import estimate_of, task_of

from uwblite import se2
from uwblite.graph.graph import Calibration, Graph, PriorEdges, UnknownKey
from uwblite.graph.pose_edges import RelativePoseEdges
from uwblite.graph.range_edges import RangeEdges
from uwblite.graph.robust import Kernel
from uwblite.graph.solver import SolverConfig, optimize
from uwblite.pipeline.range_alternatives import _costs, _images, _second_places, find_mirror_images, mirrored_whole
from uwblite.radio.bootstrap_attempt import BootstrapResult
from uwblite.radio.trilateration import AnchorHypothesis

ANCHOR = np.array([4.0, 3.0])


def place(position):
    """Return the hypothesis that an anchor is there."""
    return AnchorHypothesis(np.asarray(position), 0.0, 0.1, 0.0, 0.1)


def estimated(graph, ranges, placed, ambiguous, hypotheses):
    return estimate_of(graph, ranges=ranges, bootstrap=BootstrapResult(graph, placed, hypotheses, ambiguous))


def estimate(bend, believed=ANCHOR):
    """An anchor with ranges of 0.1 m noise along 10 m that end `bend` metres off the straight line; the poses are known."""
    x = np.linspace(0.0, 10.0, 60)
    tags = np.column_stack([x, np.where(x > 6.0, (x - 6.0) / 4.0 * bend, 0.0)])
    count, none = len(x), np.zeros((len(x), 2))
    noise = np.random.default_rng(5).normal(0.0, 0.1, count)
    edges = RangeEdges(
        np.arange(count), np.zeros(count, dtype=np.intp), np.hypot(*(tags - ANCHOR).T) + noise, np.full(count, 0.1), none,
        np.zeros(count), none, np.zeros(2), np.zeros(count), np.full((count, 6), -1),
    )  # fmt: skip
    poses, known = np.column_stack([tags, np.zeros(count)]), np.ones(count, dtype=bool)
    graph = Graph(poses, np.array([believed]), (edges,), fixed_poses=known)
    return estimated(graph, edges, np.array([True]), np.array([False]), ((place(believed),),))


TASK, WITHOUT_LIDAR = task_of(lidar=True), task_of(lidar=False)


@pytest.mark.parametrize(("bend", "ambiguous"), [(0.0, True), (0.05, True), (1.0, False), (3.0, False)])
def test_the_path_decides(bend, ambiguous):
    done = find_mirror_images(estimate(bend), TASK)
    assert done.bootstrap.ambiguous.tolist() == [ambiguous]
    if ambiguous:
        assert np.hypot(*(done.bootstrap.hypotheses[0][1].position - ANCHOR * (1, -1))) < 0.3
    assert np.array_equal(done.graph.anchors, [ANCHOR])


def bent(bend):
    """Return an estimate by odometry and ranges that err by 0.15 m from place to place: a straight path bends with them."""
    before = estimate(bend)
    poses, x = before.graph.poses, before.graph.poses[:, 0]
    ranges = replace(before.ranges, ranges=before.ranges.ranges + 0.15 * np.sin(2.0 * x))
    steps = np.arange(len(x) - 1)
    root = np.tile(np.diag([100.0, 100.0, 50.0]), (len(steps), 1, 1))
    odometry = RelativePoseEdges(steps, steps + 1, se2.between(poses[:-1], poses[1:]), root)
    graph = Graph(poses, before.graph.anchors, (odometry, ranges), fixed_poses=np.arange(len(x)) == 0)
    return replace(before, graph=optimize(graph, SolverConfig())[0], ranges=ranges)


@pytest.mark.parametrize(("bend", "ambiguous"), [(0.0, True), (3.0, False)])
def test_a_path_that_bent_to_suit_one_place_bends_to_suit_the_other(bend, ambiguous):
    """Unless a lidar holds it; one that sees nothing does not."""
    before = bent(bend)
    held = replace(before, graph=replace(before.graph, fixed_poses=np.ones(len(before.graph.poses), dtype=bool)))
    assert not find_mirror_images(held, TASK).bootstrap.ambiguous.any()
    for task in (TASK, WITHOUT_LIDAR):
        done = find_mirror_images(before, task)
        assert done.bootstrap.ambiguous.tolist() == [ambiguous]
        if ambiguous:
            assert np.hypot(*(done.bootstrap.hypotheses[0][1].position - ANCHOR * (1, -1))) < 1.0


def test_a_path_that_the_lidar_holds_suits_no_other_place_by_ranges_that_weigh_little():
    """With all ranges from one direction taken as one they prefer no place; the comparison at given poses has decided."""
    before = estimate(2.0)
    weak = replace(before.ranges, sigma=20.0 * before.ranges.sigma)
    held = replace(before, graph=replace(before.graph, edges=(weak,)))
    assert not find_mirror_images(held, TASK).bootstrap.ambiguous.any()
    assert find_mirror_images(held, WITHOUT_LIDAR).bootstrap.ambiguous.all()


def test_a_bend_seen_by_ranges_that_err_alike_decides_nothing():
    """As many ranges, all worth two of them: what the bend says is within their common errors."""
    before = estimate(0.5)
    assert not find_mirror_images(before, TASK).bootstrap.ambiguous.any()
    alike = replace(before.ranges, weights=np.full(len(before.ranges), 2.0 / len(before.ranges)))
    assert find_mirror_images(replace(before, ranges=alike), TASK).bootstrap.ambiguous.all()


def test_what_ranges_of_little_worth_say_together_decides():
    """Beyond the bend each range counts a two hundredth, as through obstacles; the other place is metres off."""
    before = estimate(3.0)
    weights = np.where(before.graph.poses[:, 0] > 6.0, 0.005, 1.0)
    ranges = replace(before.ranges, weights=weights, kernel=Kernel("cauchy", 2.5))
    assert not find_mirror_images(replace(before, ranges=ranges), TASK).bootstrap.ambiguous.any()


def test_what_the_bootstrap_took_for_ambiguous_is_decided_along_the_final_path():
    before = estimate(3.0)
    unsure = replace(before.bootstrap, ambiguous=np.array([True]), hypotheses=((place(ANCHOR), place(ANCHOR * (1, -1))),))
    assert not find_mirror_images(replace(before, bootstrap=unsure), TASK).bootstrap.ambiguous.any()


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_an_anchor_that_later_moved_to_its_second_place_is_ambiguous_with_its_first(side):
    places = (place(ANCHOR), place(ANCHOR * (1.0, -1.0)))
    before = estimate(0.0, ANCHOR * (1.0, side))
    unsure = replace(before.bootstrap, ambiguous=np.array([True]), hypotheses=(places,))
    done = find_mirror_images(replace(before, bootstrap=unsure), TASK).bootstrap
    assert done.ambiguous.all()
    np.testing.assert_allclose(done.hypotheses[0][1].position, ANCHOR * (1.0, -side), atol=0.3)


@pytest.mark.parametrize("fixed", [False, True])
def test_an_anchor_that_is_fixed_keeps_what_was_said_of_it(fixed):
    """Along a straight line, where one that is free is ambiguous."""
    before = estimate(0.0)
    graph = replace(before.graph, fixed_anchors=np.array([fixed]))
    done = find_mirror_images(replace(before, graph=graph), TASK)
    assert done.bootstrap.ambiguous.tolist() == [not fixed]
    assert (done.bootstrap is before.bootstrap) is fixed


def test_the_other_place_is_mirrored_at_the_line_that_fits_the_tag_s_places_best():
    """Of each anchor's own ranges that count; the bootstrap's second place is one more."""
    rng = np.random.default_rng(3)
    tags = np.column_stack([rng.normal(size=40), 0.1 * rng.normal(size=40)]) @ np.array([[0.6, 0.8], [-0.8, 0.6]])
    anchor = np.repeat([0, 1, 2, 3], 10)
    alive = np.arange(40) % 5 != 0
    ranges = replace(plain_ranges(np.arange(40), anchor, np.ones(40), 0.1), weights=alive.astype(float))
    places = rng.normal(size=(4, 2)) * 5.0
    second = place(np.array([7.0, 7.0]))
    graph = Graph(np.column_stack([tags, np.zeros(40)]), places.copy())
    placed, ambiguous = np.array([True, True, False, True]), np.array([False, True, False, True])
    before = estimated(graph, ranges, placed, ambiguous, ((), (second, second), (), (second,)))
    images, straight = _images(before, ranges)
    assert straight.tolist() == [True, True, False, True]
    np.testing.assert_array_equal(images[2], places[2])
    np.testing.assert_array_equal(_second_places(before)[[0, 1]], [places[0], [7.0, 7.0]])
    for k in (0, 1, 3):
        own = tags[(anchor == k) & alive]
        middle, (_, _, (along, across)) = own.mean(axis=0), np.linalg.svd(own - own.mean(axis=0))
        np.testing.assert_allclose((images[k] - middle) @ along, (places[k] - middle) @ along)
        np.testing.assert_allclose((images[k] - middle) @ across, -(places[k] - middle) @ across)
    np.testing.assert_array_equal(graph.anchors, places)


def test_two_ranges_from_beside_a_straight_way_hide_no_mirror_image():
    """They tilt the line that fits all places of the tag, but say little: the bootstrap's second place is tried as well."""
    tags = np.concatenate([np.column_stack([np.linspace(0.0, 10.0, 18), np.zeros(18)]), [[21.4, 17.7], [21.8, 17.8]]])
    there, image = np.array([-2.0, -36.0]), np.array([-2.0, 36.0])
    noise = np.random.default_rng(2).normal(0.0, 0.1, 20)
    measured = np.hypot(*(tags - image).T) + noise
    # Seen from beside, both places are as far.
    measured[18:] = np.hypot(*(tags[18:] - there).T)
    ranges = plain_ranges(np.arange(20), np.zeros(20, dtype=np.intp), measured, 0.1)
    ranges = replace(ranges, weights=np.where(np.arange(20) < 18, 1.0, 1e-5))
    poses, known = np.column_stack([tags, np.zeros(20)]), np.ones(20, dtype=bool)
    graph = Graph(poses, there[None], (ranges,), fixed_poses=known)
    for second, ambiguous in (((), False), ((place(image),), True)):
        yes = np.ones(1, dtype=bool)
        done = find_mirror_images(estimated(graph, ranges, yes, ~yes, ((place(there), *second),)), TASK).bootstrap
        assert done.ambiguous.tolist() == [ambiguous]
        if ambiguous:
            np.testing.assert_allclose(done.hypotheses[0][1].position, image, atol=1.0)


def test_costs_are_those_of_the_ranges_and_of_the_priors_of_bias_and_height():
    """Each prior once for every anchor whose ranges use it."""
    rng = np.random.default_rng(1)
    columns = np.full((6, 6), -1)
    columns[:, 1], columns[:, 2] = [0, 0, 1, 1, 1, 1], [2, 2, 2, 2, -1, -1]
    anchor = np.array([0, 0, 1, 1, 1, 2])
    ranges = replace(plain_ranges(np.zeros(6, int), anchor, rng.uniform(1.0, 9.0, 6), 0.5), calibration=columns)
    calibration = Calibration(
        (UnknownKey("bias", "A"), UnknownKey("bias", "B"), UnknownKey("height2")), np.array([0.3, -0.2, 0.4])
    )
    prior = PriorEdges("calibration", np.arange(3), np.zeros((3, 1)), np.array([2.0, 3.0, 5.0])[:, None, None])
    graph = Graph(np.zeros((1, 3)), rng.normal(size=(3, 2)), (prior,), calibration)
    worth = rng.uniform(size=6)
    squared, of_priors = ranges.residuals(graph)[:, 0] ** 2 * worth, np.array([0.6, 0.6, 2.0]) ** 2
    expected = [
        squared[:2].sum() + of_priors[[0, 2]].sum(),
        squared[2:5].sum() + of_priors[[1, 2]].sum(),
        squared[5] + of_priors[1],
    ]
    np.testing.assert_allclose(_costs(graph, replace(ranges, weights=worth)), expected)


@pytest.mark.parametrize(("bend", "ambiguous"), [(0.0, True), (0.02, True), (3.0, False)])
def test_a_path_and_its_anchors_have_a_mirror_image_together_unless_the_path_bends(bend, ambiguous):
    """Three anchors on one side of it; the odometry's turns alone hold the sides."""
    x = np.linspace(0.0, 10.0, 60)
    tags = np.column_stack([x, bend * np.sin(0.3 * x)])
    heading = np.append(np.arctan2(*np.diff(tags, axis=0).T[::-1]), 0.0)
    poses, anchors = np.column_stack([tags, heading]), np.array([[2.0, 3.0], [5.0, 4.0], [8.0, 2.5]])
    wheels = relative_edges(poses, np.arange(59), np.arange(1, 60), (0.01, 0.01, 0.005))
    pose, anchor = np.repeat(np.arange(60), 3), np.tile(np.arange(3), 60)
    noise = np.random.default_rng(2).normal(0.0, 0.1, 180)
    measured = plain_ranges(pose, anchor, np.hypot(*(tags[pose] - anchors[anchor]).T) + noise, 0.1)
    fixed = np.arange(60) == 0
    graph = Graph(poses, anchors, (wheels, measured), fixed_poses=fixed)
    best = optimize(graph, SolverConfig())[0]
    image = mirrored_whole(best, measured, np.ones(3, dtype=bool), SolverConfig())
    assert (image is not None) is ambiguous
    if image is not None:
        np.testing.assert_array_less(image.anchors[:, 1], 0.0)


@pytest.mark.parametrize(("turns", "ambiguous"), [(0.1, [True, True, True]), (0.005, [True, True, False])])
def test_an_anchor_beside_a_curve_has_a_mirror_image_with_all_others_where_no_turn_is_known(turns, ambiguous):
    """Two anchors are in reach of the straight part alone. A lidar would show which way the robot turns."""
    x = np.linspace(0.0, 20.0, 90)
    tags = np.column_stack([x, 0.05 * np.maximum(x - 8.0, 0.0) ** 2])
    heading = np.append(np.arctan2(*np.diff(tags, axis=0).T[::-1]), 0.0)
    poses, anchors = np.column_stack([tags, heading]), np.array([[2.0, 3.0], [5.0, -4.0], [11.0, 5.0]])
    wheels = relative_edges(poses, np.arange(89), np.arange(1, 90), (0.01, 0.01, turns))
    pose, anchor = np.concatenate([np.tile(np.arange(30), 2), np.arange(90)]), np.repeat([0, 1, 2], [30, 30, 90])
    noise = np.random.default_rng(2).normal(0.0, 0.1, len(pose))
    measured = plain_ranges(pose, anchor, np.hypot(*(tags[pose] - anchors[anchor]).T) + noise, 0.1)
    graph = optimize(Graph(poses, anchors, (wheels, measured), fixed_poses=np.arange(90) == 0), SolverConfig())[0]
    known, found = np.ones(3, dtype=bool), tuple((place(each),) for each in graph.anchors)
    before = estimated(graph, measured, known, ~known, found)
    done = find_mirror_images(before, WITHOUT_LIDAR).bootstrap
    assert done.ambiguous.tolist() == ambiguous
    images = [each[-1].position for each in done.hypotheses]
    for image, its, anchor in zip(images, ambiguous, graph.anchors, strict=True):
        assert np.hypot(*(image - anchor * (1.0, -1.0 if its else 1.0))) < 1.5  # the path turns about its middle
    assert find_mirror_images(before, TASK).bootstrap.ambiguous.tolist() == [True, True, False]
