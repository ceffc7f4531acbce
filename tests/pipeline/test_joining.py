"""Recordings become one: which of two recordings says where an anchor is, and which anchors do not join in."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from helpers.laser_walks import chained
from helpers.planted import odometry, ranges, wander
from helpers.planted_graphs import plain_ranges, random_poses
from helpers.planted_tasks import estimate_of, recordings_of, standing

from uwblite import se2
from uwblite.errors import DataError
from uwblite.graph.calibration import CalibrationConfig, block, of_recording, prior_edges, unknowns
from uwblite.graph.graph import Graph
from uwblite.graph.marginals import anchor_covariance, marginals
from uwblite.odometry.attached import attach_ranges
from uwblite.odometry.keyframes import KeyframeConfig, select
from uwblite.odometry.wheels import OdometryNoiseConfig, wheel_edges
from uwblite.pipeline.estimate import Estimate
from uwblite.pipeline.joining import (
    Places,
    _laid_on,
    _one_bootstrap,
    _one_graph,
    _one_odometry,
    agreement,
    fitted,
    join,
    places_of,
    together,
)
from uwblite.radio.bootstrap_attempt import BootstrapResult
from uwblite.radio.range_measurements import range_edges
from uwblite.radio.range_noise import RangeNoiseConfig
from uwblite.radio.trilateration import AnchorHypothesis
from uwblite.sensor_log import LONGEST_RANGE, SensorMounting

STATES = [(False, False), (True, True), (True, False)]
"""Placed, ambiguous."""


def one_anchor(x, placed, ambiguous):
    """Return an estimate of one anchor with a hypothesis at (x, 0)."""
    graph, where = Graph(np.zeros((2, 3)), np.zeros((1, 2))), AnchorHypothesis(np.array([x, 0.0]), 0.0, 0.1, 0.0, 0.1)
    return estimate_of(graph, bootstrap=BootstrapResult(graph, np.array([placed]), ((where,),), np.array([ambiguous])))


def hypotheses(joined):
    """Return x of the hypotheses of each anchor."""
    return [[float(where.position[0]) for where in each] for each in joined.hypotheses]


@pytest.mark.parametrize(("first", "second"), list(product(STATES, repeat=2)))
def test_the_clearer_of_two_recordings_says_where_an_anchor_is(first, second):
    """Placed and clear before placed before not placed; the first recording where both are alike."""
    estimates, worth = [one_anchor(1.0, *first), one_anchor(2.0, *second)], [a + (a and not b) for a, b in (first, second)]
    joined = _one_bootstrap(estimates, [np.zeros(3)] * 2, [np.array([0])] * 2, 1)
    assert joined.placed.tolist() == [max(worth) > 0]
    assert joined.ambiguous.tolist() == [max(worth) == 1]
    assert hypotheses(joined) == [[2.0] if worth[1] > worth[0] else [1.0]]


def test_anchors_of_one_recording_alone_keep_what_it_says_and_none_is_no_bootstrap():
    without = estimate_of(Graph(np.zeros((2, 3))), bootstrap=None)
    estimates = [one_anchor(1.0, True, True), without, one_anchor(2.0, True, False)]
    joined = _one_bootstrap(estimates, [np.zeros(3)] * 3, [np.array([2]), np.zeros(0, int), np.array([0])], 3)
    assert hypotheses(joined) == [[2.0], [], [1.0]]
    assert (joined.placed.tolist(), joined.ambiguous.tolist()) == ([True, False, True], [False, False, True])
    assert _one_bootstrap(estimates[1:2], [np.zeros(3)], [np.zeros(0, int)], 0) is None


def test_slips_of_one_recording_are_kept_beside_another_without():
    """Those of steps of recordings that show none are 0."""
    wheels = chained(np.zeros((4, 3)), (0.01, 0.01, 0.01))
    slips, recordings = np.array([0.0, 0.7, 0.2]), recordings_of(np.zeros((8, 3)), None, np.repeat([0, 1], 4))
    one = _one_odometry([wheels, replace(wheels, slips=slips)], [np.zeros(0, dtype=np.intp)] * 2, recordings)
    assert one.slips.tolist() == [0.0, 0.0, 0.0, *slips]
    assert one.i.tolist() == [0, 1, 2, 4, 5, 6]
    assert _one_odometry([wheels] * 2, [np.zeros(0, dtype=np.intp)] * 2, recordings).slips is None


def test_a_recording_that_nothing_lays_on_the_others_is_refused():
    """One anchor in common leaves the heading open; two whose distance differs by 3 m are no common frame."""
    placed = Places(("A", "B"), np.array([[0.0, 0.0], [8.0, 0.0]]), 0.04 * np.eye(4))
    recording = standing(each=[{"name": "other.log"}]).each[0]
    with pytest.raises(DataError, match=r"other.log\) shares 1 placed anchors with the others \(B\)"):
        _laid_on(replace(placed, names=("X", "B")), placed, recording)
    with pytest.raises(DataError, match=r"other\.log\) has the anchors A, B in common with the others, but in no two"):
        _laid_on(replace(placed, at=np.array([[0.0, 0.0], [11.0, 0.0]])), placed, recording)
    motion, agree = _laid_on(placed.moved(np.array([3.0, -2.0, 0.7])), placed, recording)
    np.testing.assert_allclose(motion, se2.inverse(np.array([3.0, -2.0, 0.7])), atol=1e-9)
    assert agree == [(0, 0), (1, 1)]


def mapped(seed, tag, ids):
    """Return an estimate of one recording whose values are arbitrary, and its number of poses."""
    rng = np.random.default_rng(seed)
    stamps, truth = wander(rng, 8.0)
    wheels = odometry(stamps, truth, rng, noise=0.02, turn_noise=0.02)
    radio = replace(ranges(rng, stamps, truth, rng.uniform(-6.0, 6.0, (len(ids), 2))), anchor_ids=ids)
    frames, mounting = select(wheels, KeyframeConfig()), SensorMounting(tag_position=np.array([*tag, 0.3]))
    listed = unknowns(CalibrationConfig(), ids, np.zeros(len(ids), dtype=bool))
    priors = prior_edges(listed)
    priors = replace(priors, sqrt_information=priors.sqrt_information * rng.uniform(0.5, 2.0, (len(listed), 1, 1)))
    calibration = block(listed)
    # What recordings share is alike in both.
    values = np.where([u.key.recording is None for u in listed], 0.02, rng.normal(scale=0.05, size=len(listed)))
    graph = Graph(frames.odometry, rng.uniform(-6.0, 6.0, (len(ids), 2)), (priors,), replace(calibration, values=values))
    graph = replace(graph, fixed_calibration=rng.random(len(listed)) < 0.5)
    attached = attach_ranges(radio, wheels, frames, mounting)
    edges = range_edges(attached, ids, mounting, calibration, RangeNoiseConfig(0.1), LONGEST_RANGE)
    bootstrap = BootstrapResult(graph, np.ones(len(ids), dtype=bool), ((),) * len(ids), np.zeros(len(ids), dtype=bool))
    wheel = wheel_edges(frames, OdometryNoiseConfig(), calibration)
    return Estimate(graph, wheel, edges, ids, bootstrap), len(frames)


def together_of(*estimates):
    """Return the recordings of estimates, a keyframe at each pose."""
    poses = [estimate.graph.poses for estimate in estimates]
    return recordings_of(np.concatenate(poses), None, np.repeat(np.arange(len(poses)), [len(own) for own in poses]))


def test_recordings_in_one_graph_have_the_residuals_that_they_had_alone():
    """A rigid motion of a recording with its anchors changes no residual, wherever its tag sits; the second's come behind."""
    (one, first), (two, second) = mapped(1, (0.1, -0.2), ("A", "B", "C")), mapped(2, (-0.3, 0.4), ("D", "E", "F"))
    recordings = together_of(one, two)
    motion = np.array([3.0, -1.0, 0.9])
    joined = _one_graph([one, two], [np.zeros(3), motion], [one.anchor_ids, two.anchor_ids], recordings)
    assert joined.anchor_ids == ("A", "B", "C", "D", "E", "F")
    assert len(joined.graph.poses) == first + second
    np.testing.assert_allclose(joined.graph.poses[first:], se2.compose(motion, two.graph.poses))
    np.testing.assert_allclose(joined.graph.anchors[3:], se2.transform(motion, two.graph.anchors))
    for name in ("odometry", "ranges"):
        both = getattr(joined, name)
        alone = [getattr(e, name).residuals(e.graph) for e in (one, two)]
        np.testing.assert_allclose(both.residuals(joined.graph), np.concatenate(alone), atol=1e-9)
    keys, place = joined.graph.calibration.keys, {key: k for k, key in enumerate(joined.graph.calibration.keys)}
    assert len(set(keys)) == len(keys)
    (priors,) = joined.graph.edges
    for number, estimate in ((1, two), (0, one)):
        own = np.array([place[of_recording(key, number)] for key in estimate.graph.calibration.keys])
        shared = np.array([key.recording is None for key in estimate.graph.calibration.keys])
        (before,) = estimate.graph.edges
        np.testing.assert_array_equal(joined.graph.calibration.values[own], estimate.graph.calibration.values)
        if number == 0:  # of what is shared the first recording's prior holds, and it is fixed where both fix it
            np.testing.assert_array_equal(priors.sqrt_information[own], before.sqrt_information)
        else:
            np.testing.assert_array_equal(priors.sqrt_information[own[~shared]], before.sqrt_information[~shared])
            both = one.graph.fixed_calibration[shared] & two.graph.fixed_calibration[shared]
            np.testing.assert_array_equal(joined.graph.fixed_calibration[own[shared]], both)
        np.testing.assert_array_equal(joined.graph.fixed_calibration[own[~shared]], estimate.graph.fixed_calibration[~shared])


def test_an_anchor_of_two_recordings_stands_where_the_first_has_it():
    (one, _), (two, _) = mapped(3, (0.0, 0.0), ("A", "B", "C")), mapped(4, (0.0, 0.0), ("C", "D", "A"))
    recordings = together_of(one, two)
    joined = _one_graph([one, two], [np.zeros(3)] * 2, [("A", "B", "C"), ("C", "D", "A#2")], recordings)
    assert joined.anchor_ids == ("A", "B", "C", "D", "A#2")
    np.testing.assert_array_equal(joined.graph.anchors, [*one.graph.anchors, *two.graph.anchors[1:]])
    names = [joined.anchor_ids[k] for k in joined.ranges.anchor[len(one.ranges) :].tolist()]
    assert names == [("C", "D", "A#2")[k] for k in two.ranges.anchor.tolist()]


def test_a_third_recording_links_two_and_a_moved_anchor_has_a_place_of_its_own():
    """The first and the second share no anchor; the third shares two with either, and has one where the first has not."""
    world = {"A": (0.0, 0.0), "B": (9.0, 1.0), "C": (2.0, 8.0), "D": (-7.0, 3.0), "E": (-4.0, -6.0), "F": (5.0, -8.0)}
    frames, all_ids = np.array([[0.0, 0.0, 0.0], [2.0, 5.0, 1.1], [-3.0, 1.0, -2.0]]), ("ABC", "DEF", "ABCDE")
    estimates, poses = [], [0]
    for number, (frame, ids) in enumerate(zip(frames, all_ids, strict=True)):
        estimate, count = mapped(10 + number, (0.0, 0.0), tuple(ids))
        places = np.array([world[name] for name in ids])
        places[2] += 30.0 if number == 2 else 0.0
        graph = replace(estimate.graph, anchors=se2.transform(se2.inverse(frame), places))
        estimates.append(replace(estimate, graph=graph))
        poses.append(poses[-1] + count)
    joined = join(estimates, together_of(*estimates))
    assert joined.anchor_ids == ("A", "B", "C", "D", "E", "F", "C#3")
    expected = [*world.values(), (32.0, 38.0)]
    np.testing.assert_allclose(joined.graph.anchors, expected, atol=1e-6)
    for number, (first, frame) in enumerate(zip(poses[:3], frames, strict=True)):
        np.testing.assert_allclose(joined.graph.poses[first], se2.compose(frame, estimates[number].graph.poses[0]), atol=1e-6)


MOTION = np.array([30.0, -12.0, 2.1])
"""T_placed_found."""
WORLD = np.array([[2.0, 1.0], [25.0, -3.0], [60.0, 20.0], [55.0, -30.0], [90.0, 5.0]])


def swinging(names, at, heading, sigma=0.1):
    """Return places of which each is known to sigma (m), and all but for the first pose's heading (rad, standard deviation)."""
    swing = heading * se2.rotate(0.5 * np.pi, at).ravel()
    return Places(tuple(names), at, sigma**2 * np.eye(at.size) + np.outer(swing, swing))


def seen_twice(off=(), swung=0.06):
    """Return places of a recording, turned by its heading's error, and those of others; of the former, some are off (m)."""
    found = se2.transform(se2.inverse(MOTION), WORLD)
    found = se2.rotate(swung, found)
    for k, metres in off:
        found[k] += metres
    return swinging("ABCDE", found, 0.05), swinging("ABCDE", WORLD, 0.05)


def test_places_that_swing_by_metres_together_agree_and_the_motion_takes_it_out():
    found, placed = seen_twice()
    motion, pairs = agreement(found, placed)
    assert pairs == [(k, k) for k in range(5)]
    np.testing.assert_allclose(se2.transform(motion, found.at), WORLD, atol=1e-6)
    assert fitted(found, placed, pairs)[1] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(("off", "left"), [
    ([(2, (2.0, 0.5))], "ABDE"), ([(0, (0.0, -1.6)), (3, (-4.0, 0.0))], "BCE"), ([(4, (0.4, 0.3))], "ABCDE"),
])  # fmt: skip
def test_an_anchor_that_was_moved_by_less_than_its_own_sigma_does_not_agree(off, left):
    """At 60 m a heading of 0.05 rad makes a sigma of 3 m; beside the others it is known to 0.3 m."""
    found, placed = seen_twice(off)
    motion, pairs = agreement(found, placed)
    assert "".join(found.names[k] for k, _ in pairs) == left
    if len(left) < 5:
        agree = [k for k, _ in pairs]
        np.testing.assert_allclose(se2.transform(motion, found.at[agree]), WORLD[agree], atol=1e-6)


def test_chi2_is_that_of_the_distance_where_two_places_are_compared():
    """0.2^2 of each of the two ends in either recording, and 0.25^2 at each end that both ranges err by: along the line."""
    placed = Places(("A", "B"), np.array([[0.0, 0.0], [9.0, 0.0]]), 0.04 * np.eye(4))
    found = Places(("A", "B"), np.array([[1.0, 1.0], [1.0, 11.2]]), 0.04 * np.eye(4))
    motion, chi2 = fitted(found, placed, [(0, 0), (1, 1)])
    assert chi2 == pytest.approx(1.2**2 / (4 * 0.04 + 2 * 0.25**2))
    np.testing.assert_allclose(se2.transform(motion, found.at), [[-0.6, 0.0], [9.6, 0.0]], atol=1e-9)


def test_two_recordings_together_know_each_anchor_as_their_least_squares_does():
    """Anchors of either alone, too; a rigid motion of the second says nothing, what it knows of distances counts."""
    rng = np.random.default_rng(2)
    found, placed = swinging("BCX", rng.uniform(-9.0, 9.0, (3, 2)), 0.02), swinging("ABC", rng.uniform(-9.0, 9.0, (3, 2)), 0.02)
    union = together(placed, found, found.names)
    assert union.names == ("A", "B", "C", "X")
    shift = np.array([0.3, -0.2])
    shifted = together(placed, found.moved(np.append(shift, 0.0)), found.names)
    np.testing.assert_allclose(shifted.at[:3], union.at[:3], atol=1e-4)
    before, after = (np.trace(p.covariance[2:6, 2:6]) for p in (placed, union))
    assert after < before
    np.testing.assert_allclose(union.covariance, union.covariance.T, atol=1e-9)
    sigma_x = np.sqrt(np.trace(union.covariance[6:, 6:]))
    assert 0.1 < sigma_x < 2.0


def test_places_have_the_joint_covariance_of_the_graph_and_open_ones_some_metres():
    """Two anchors with ranges from many poses, of which the last has none: any place is as good."""
    rng = np.random.default_rng(0)
    poses, anchors = random_poses(rng, 60, 6.0), np.array([[8.0, 1.0], [-7.0, 2.0], [3.0, 3.0]])
    anchor = np.repeat(np.arange(2), 30)
    distance = np.hypot(*(poses[:, :2] - anchors[anchor]).T)
    graph = Graph(poses, anchors, fixed_poses=np.ones(60, dtype=bool))
    ranges = plain_ranges(np.arange(60), anchor, distance, 0.1)
    full = anchor_covariance(graph.with_edges(ranges), np.array([0, 1]))
    blocks = marginals(graph.with_edges(ranges)).covariances.anchors
    np.testing.assert_allclose([full[:2, :2], full[2:, 2:]], blocks[:2], rtol=1e-9)
    estimate = estimate_of(graph, ranges=ranges, anchor_ids=("A", "B", "C"))
    places = places_of(estimate)
    np.testing.assert_allclose(places.covariance[:2, :2], full[:2, :2], rtol=1e-3)
    np.testing.assert_allclose(np.diag(places.covariance)[4:], 25.0, rtol=0.05)
    assert places_of(replace(estimate, bootstrap=None)).names == ()


@pytest.mark.parametrize(("ambiguous", "used"), [([], "ABC"), ("A", "BC"), ("AB", "ABC"), ("ABC", "ABC")])
def test_anchors_that_may_be_mirrored_join_where_fewer_than_two_others_are_placed(ambiguous, used):
    """One that has no place at all joins never."""
    rng = np.random.default_rng(0)
    poses, anchors = random_poses(rng, 60, 6.0), np.array([[8.0, 1.0], [-7.0, 2.0], [3.0, 3.0], [1.0, 1.0]])
    anchor = np.arange(60) % 3
    ranges = plain_ranges(np.arange(60), anchor, np.hypot(*(poses[:, :2] - anchors[anchor]).T), 0.1)
    graph = Graph(poses, anchors, fixed_poses=np.ones(60, dtype=bool))
    placed, unclear = np.arange(4) < 3, np.array([name in ambiguous for name in "ABCD"])
    found = BootstrapResult(graph, placed, ((),) * 4, unclear)
    estimate = estimate_of(graph, ranges=ranges, anchor_ids="ABCD", bootstrap=found)
    places = places_of(estimate)
    assert places.names == tuple(used)
    np.testing.assert_array_equal(places.at, anchors[["ABCD".index(name) for name in used]])
