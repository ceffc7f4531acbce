"""Starting values from nothing: planted worlds are recovered from bent odometry and unknown anchors."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.laser_walks import chained
from helpers.planted import aligned_error, odometry, ranges, wander
from helpers.planted_graphs import plain_ranges

from uwblite import se2
from uwblite.graph.calibration import CalibrationConfig, block, prior_edges, unknowns
from uwblite.graph.graph import Graph
from uwblite.odometry.attached import attach_ranges
from uwblite.odometry.keyframes import KeyframeConfig, select
from uwblite.odometry.slips import LASTS
from uwblite.odometry.wheels import OdometryNoiseConfig, wheel_edges
from uwblite.problem.alternatives import EvidencePolicy
from uwblite.radio.bootstrap import bootstrap_graph, of_likeliest_slips
from uwblite.radio.bootstrap_attempt import Attempt, BootstrapPolicy, BootstrapResult, Measured
from uwblite.radio.range_measurements import range_edges
from uwblite.radio.range_noise import RangeNoiseConfig
from uwblite.radio.trilateration import TrilaterationConfig
from uwblite.sensor_log import LONGEST_RANGE, Odometry, SensorMounting, UwbRanges

SIGMA = 0.05
WELL = 0.3
"""m. Ranges of 0.05 m hold a pose to a few centimetres where three anchors are in reach; between ranges odometry drifts. A
bootstrapped trajectory is good enough as a start when it lies well within the width of the kernels that follow."""


def start(wheels: Odometry, radio: UwbRanges, calibrated: bool = True) -> tuple[BootstrapResult, np.ndarray]:
    """Bootstrap one recording; return the estimate and the keyframes' stamps."""
    graph, measured, stamps = problem(wheels, radio, calibrated)
    return bootstrap_graph(graph, measured, TrilaterationConfig()), stamps


def problem(wheels: Odometry, radio: UwbRanges, calibrated: bool = True) -> tuple[Graph, Measured, np.ndarray]:
    """Return the graph of one recording, what was measured, and the keyframes' stamps."""
    frames = select(wheels, KeyframeConfig())
    ids = radio.anchor_ids
    listed = unknowns(CalibrationConfig(anchor_height=0.0), ids, np.zeros(len(ids), dtype=bool)) if calibrated else ()
    calibration = block(listed)
    free = ("odometry_scale", "heading_scale", "heading_per_metre", "heading_rate", "bias", "range_scale")
    fixed = ~calibration.of_kinds(*free)
    graph = Graph(frames.odometry, np.zeros((len(ids), 2)), (prior_edges(listed),), calibration, fixed_calibration=fixed)
    mounting = SensorMounting()
    attached = attach_ranges(radio, wheels, frames, mounting)
    edges = range_edges(attached, ids, mounting, calibration, RangeNoiseConfig(0.1), LONGEST_RANGE)
    path = np.concatenate([[0.0], np.cumsum(frames.path)])
    measured = Measured(wheel_edges(frames, OdometryNoiseConfig(), calibration), edges, path, 1.5 * SIGMA)
    return graph, measured, frames.stamps


def judged(bootstrapped, keyframe_stamps, stamps, truth, places) -> tuple[float, float]:
    """Return the error of poses and of placed anchors, m, after one rigid motion that fits the poses."""
    at = se2.interpolate_trajectory(stamps, truth, keyframe_stamps)[:, :2]
    poses, anchors = bootstrapped.graph.poses[:, :2], bootstrapped.graph.anchors[bootstrapped.placed]
    p, q = poses - poses.mean(axis=0), at - at.mean(axis=0)
    angle = np.arctan2(np.sum(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]), np.sum(p * q))
    moved = se2.rotate(angle, anchors - poses.mean(axis=0)) + at.mean(axis=0)
    return aligned_error(poses, at), float(np.hypot(*(moved - places[bootstrapped.placed]).T).max(initial=0.0))


def places_around(rng, count) -> np.ndarray:
    """Return anchors (count, 2) in and around the driven square, at least 2 m apart."""
    places: list[np.ndarray] = []
    while len(places) < count:
        place = rng.uniform(-8, 8, 2)
        if all(np.hypot(*(place - other)) > 2.0 for other in places):
            places.append(place)
    return np.array(places)


WHEELS = {
    "good": {"scale": 1.01, "turn_scale": 1.01, "noise": 0.01, "turn_noise": 0.01},
    "drifts by more than 90 degrees": {"drift": 0.015, "noise": 0.01, "turn_noise": 0.01},
    "noisy heading": {"noise": 0.02, "turn_noise": 0.06},
    "track width twice too wide": {"turn_scale": 2.0, "noise": 0.01, "turn_noise": 0.01},
    "track width half": {"turn_scale": 0.5, "noise": 0.01, "turn_noise": 0.01},
}


@pytest.mark.parametrize("fault", WHEELS)
@pytest.mark.parametrize("seed", [2, pytest.param(1, marks=pytest.mark.slow), pytest.param(3, marks=pytest.mark.slow)])
def test_a_bent_trajectory_and_unknown_anchors_are_recovered(fault, seed):
    rng = np.random.default_rng(seed)
    stamps, truth = wander(rng, 150.0)
    places = places_around(rng, 4)
    wheels = odometry(stamps, truth, rng, **WHEELS[fault])
    bent = aligned_error(wheels.poses[:, :2], truth[:, :2])
    bias = rng.uniform(-0.2, 0.5, 4)
    bootstrapped, at = start(wheels, ranges(rng, stamps, truth, places, rate=1.0, sigma=SIGMA, bias=bias, outliers=0.1))
    error, anchor_error = judged(bootstrapped, at, stamps, truth, places)
    assert bootstrapped.placed.all()
    assert not bootstrapped.ambiguous.any()
    assert error < WELL, f"odometry alone {bent:.2f} m"
    assert anchor_error < 2 * WELL
    assert bent > 3 * error


@pytest.mark.parametrize("count", [1, 2, 3, 6, 12])
def test_any_number_of_anchors_serves(count):
    """One or two anchors leave the odometry to hold the rest: the result may not be worse than the odometry alone."""
    rng = np.random.default_rng(10 + count)
    stamps, truth = wander(rng, 150.0)
    places = places_around(rng, count)
    wheels = odometry(stamps, truth, rng, scale=0.99, turn_scale=1.02, drift=0.004, noise=0.01, turn_noise=0.01)
    radio = ranges(rng, stamps, truth, places, rate=max(0.5, 2.0 / count), sigma=SIGMA, outliers=0.1)
    bootstrapped, at = start(wheels, radio)
    error, anchor_error = judged(bootstrapped, at, stamps, truth, places)
    bent = aligned_error(wheels.poses[:, :2], truth[:, :2])
    assert bootstrapped.placed.all()
    assert error < (WELL if count >= 3 else max(2 * WELL, bent / 2))
    assert anchor_error < (2 * WELL if count >= 3 else 4 * WELL)


def test_anchors_that_are_in_reach_part_of_the_time_are_placed_when_they_come():
    rng = np.random.default_rng(21)
    stamps, truth = wander(rng, 200.0)
    end = stamps[-1]
    in_reach = np.array([[0, 0.45], [0, 0.45], [0.05, 0.5], [0.35, 1.0], [0.4, 1.0], [0.55, 1.0]]) * end
    places = places_around(rng, 6)
    wheels = odometry(stamps, truth, rng, drift=0.008, noise=0.01, turn_noise=0.02)
    bootstrapped, at = start(wheels, ranges(rng, stamps, truth, places, rate=1.0, sigma=SIGMA, outliers=0.1, in_reach=in_reach))
    error, anchor_error = judged(bootstrapped, at, stamps, truth, places)
    assert bootstrapped.placed.all()
    assert error < WELL
    assert anchor_error < 2 * WELL


def reversed_in_time(wheels: Odometry, radio: UwbRanges) -> tuple[Odometry, UwbRanges]:
    """Return the recording run backwards: the base drives the same way in reverse."""
    end = wheels.stamps[-1]
    back = UwbRanges(
        (end - radio.stamps)[::-1], radio.anchor[::-1].copy(), radio.ranges[::-1].copy(), radio.quality, radio.anchor_ids
    )
    return Odometry((end - wheels.stamps)[::-1], wheels.poses[::-1].copy()), back


@pytest.mark.parametrize(("turn_scale", "agrees"), [(1.0, True), (3.0, False)])
def test_an_attempt_goes_on_to_the_end_while_its_ranges_agree(turn_scale, agrees):
    """Wheels that count three turns for one contradict the ranges long before the end."""
    rng = np.random.default_rng(2)
    stamps, truth = wander(rng, 200.0)
    radio = ranges(rng, stamps, truth, places_around(rng, 6), sigma=SIGMA)
    graph, measured, _ = problem(odometry(stamps, truth, rng, turn_scale=turn_scale), radio)
    attempt = Attempt(graph, measured, TrilaterationConfig())
    assert attempt.agrees_to_the_end() is agrees
    assert attempt.complete is agrees
    assert attempt.placed.all() or not agrees
    assert attempt.path[attempt.high - 1] - attempt.path[attempt.low] < 120.0 or agrees


@pytest.mark.parametrize("seed", [31, pytest.param(32, marks=pytest.mark.slow)])
def test_the_result_does_not_depend_on_where_the_recording_starts(seed):
    """Forwards, backwards and without its first third, the same recording gives the same places."""
    rng = np.random.default_rng(seed)
    stamps, truth = wander(rng, 150.0)
    places = places_around(rng, 4)
    wheels = odometry(stamps, truth, rng, drift=0.012, noise=0.01, turn_noise=0.02)
    radio = ranges(rng, stamps, truth, places, rate=1.0, sigma=SIGMA, outliers=0.1)
    cut = stamps[-1] / 3
    late, in_reach = wheels.stamps >= cut, radio.stamps >= cut
    shorter = Odometry(wheels.stamps[late], wheels.poses[late])
    fewer = UwbRanges(
        radio.stamps[in_reach], radio.anchor[in_reach], radio.ranges[in_reach], radio.quality[in_reach], radio.anchor_ids
    )
    back = reversed_in_time(wheels, radio)
    for (one, other), stated, true in (
        ((wheels, radio), stamps, truth),
        (back, stamps, truth[::-1]),
        ((shorter, fewer), stamps, truth),
    ):
        bootstrapped, at = start(one, other)
        error, anchor_error = judged(bootstrapped, at, stated, true, places)
        assert bootstrapped.placed.all()
        assert error < WELL
        assert anchor_error < 2 * WELL


def test_a_straight_path_reports_that_its_anchors_are_ambiguous():
    rng = np.random.default_rng(41)
    stamps = np.arange(800) * 0.1
    truth = np.column_stack([0.3 * stamps, 0.003 * np.sin(stamps), np.zeros(800)])
    places = np.array([[5.0, 3.0], [15.0, -4.0], [22.0, 2.0]])
    wheels = odometry(stamps, truth, rng, noise=0.005, turn_noise=0.001)
    bootstrapped, _ = start(wheels, ranges(rng, stamps, truth, places, rate=1.0, sigma=SIGMA))
    assert bootstrapped.ambiguous.all()
    assert all(len(h) >= 2 for h in bootstrapped.hypotheses)
    for k, place in enumerate(places):
        found = np.array([h.position for h in bootstrapped.hypotheses[k][:2]])
        # Ranges fix how far along and how far aside; on which side is a guess, and both guesses are returned.
        sides = np.array([[place[0], abs(place[1])], [place[0], -abs(place[1])]])
        gap = np.hypot(*(found[:, None] - sides[None]).transpose(2, 0, 1))
        assert gap.min(axis=0).max() < 1.0
        np.testing.assert_array_equal(bootstrapped.graph.anchors[k], found[0])


def test_anchors_heard_late_and_from_one_line_alone_are_placed_and_ambiguous():
    """No stretch shows the side of any anchor: then all of the path is searched, and not the first metres alone."""
    rng = np.random.default_rng(42)
    stamps = np.arange(3000) * 0.1
    truth = np.column_stack([0.3 * stamps, 0.003 * np.sin(stamps), np.zeros(3000)])
    places = np.array([[62.0, 3.0], [72.0, -4.0]])
    wheels = odometry(stamps, truth, rng, noise=0.005, turn_noise=0.001)
    heard = np.array([[180.0, 290.0], [190.0, 299.0]])
    bootstrapped, _ = start(wheels, ranges(rng, stamps, truth, places, rate=1.0, sigma=SIGMA, in_reach=heard))
    assert bootstrapped.ambiguous.all()
    assert bootstrapped.placed.all()


def test_ranges_of_no_weight_and_none_at_all_leave_the_odometry():
    rng = np.random.default_rng(51)
    stamps, truth = wander(rng, 20.0)
    wheels = odometry(stamps, truth, rng, noise=0.01)
    radio = ranges(rng, stamps, truth, np.zeros((2, 2)))
    nothing = replace(radio, ranges=np.zeros(len(radio.ranges)))
    bootstrapped, at = start(wheels, nothing)
    assert not bootstrapped.placed.any()
    np.testing.assert_allclose(bootstrapped.graph.poses, se2.interpolate_trajectory(stamps, wheels.poses, at), atol=1e-9)


def test_ranges_that_never_agree_are_tried_with_no_other_heading_where_that_is_no_unknown():
    rng = np.random.default_rng(52)
    stamps, truth = wander(rng, 20.0)
    wheels = odometry(stamps, truth, rng, noise=0.01)
    radio = ranges(rng, stamps, truth, places_around(rng, 2))
    bootstrapped, _ = start(wheels, replace(radio, ranges=rng.uniform(1.0, 12.0, len(radio.ranges))), calibrated=False)
    assert np.isfinite(bootstrapped.graph.poses).all()


def test_a_robot_that_stands_places_nothing_for_sure():
    rng = np.random.default_rng(61)
    stamps, truth = np.arange(300) * 0.1, np.zeros((300, 3))
    bootstrapped, _ = start(Odometry(stamps, truth), ranges(rng, stamps, truth, np.array([[3.0, 1.0], [-2.0, 4.0]]), rate=2.0))
    assert bootstrapped.ambiguous.all() or not bootstrapped.placed.any()
    assert np.isfinite(bootstrapped.graph.poses).all()


@pytest.mark.parametrize("part", [slice(80, 110), slice(-110, -80)])
def test_a_slip_near_an_end_shows_in_the_few_ranges_beyond_it(part):
    """Wheels that spin for 3 s count 1.2 m and 0.7 rad too much; the ranges of the other 97 % of the way agree all the same."""
    rng = np.random.default_rng(34)
    stamps, truth = wander(rng, 150.0)
    places = places_around(rng, 4)
    motion = se2.between(truth[:-1], truth[1:])
    motion[part] += np.array([0.04, 0.0, 0.023])
    wheels = odometry(stamps, se2.chain(truth[0], motion), rng, noise=0.01, turn_noise=0.01)
    bootstrapped, at = start(wheels, ranges(rng, stamps, truth, places, rate=1.0, sigma=SIGMA))
    error, _ = judged(bootstrapped, at, stamps, truth, places)
    times = at[np.flatnonzero(bootstrapped.slips)]
    assert error < WELL / 3
    assert np.abs(times - stamps[part].mean()).max(initial=0.0) < 3.0 * LASTS


def test_the_mirror_image_of_an_attempt_is_a_rival_that_turns_the_other_way():
    """Wheels tell a path with slips from its image, and the image of an attempt that is mirrored is the sound one."""
    truth = se2.chain(np.zeros(3), np.tile([0.5, 0.0, 0.15], (39, 1)))
    motion = se2.between(truth[:-1], truth[1:])
    motion[22:26] += [0.5, 0.0, 0.2]
    anchors = np.array([[4.0, 3.0], [6.0, -3.0], [-4.0, 1.0]])
    pose, anchor = np.repeat(np.arange(40), 3), np.tile([0, 1, 2], 40)
    distance = np.hypot(*(truth[pose, :2] - anchors[anchor]).T)
    wheels = chained(se2.chain(np.zeros(3), motion), (0.02, 0.02, 0.02))
    measured = Measured(wheels, plain_ranges(pose, anchor, distance, 0.05), 0.5 * np.arange(40.0), 0.05)
    starts = Graph(truth, anchors), Graph(truth, anchors * [1.0, -1.0])
    sound, turned = (Attempt(each, measured, TrilaterationConfig(), ()) for each in starts)
    for attempt, poses in ((sound, truth), (turned, truth * [1.0, -1.0, -1.0])):
        attempt.placed[:], attempt.low, attempt.high, attempt.poses = True, 0, 40, poses.copy()
        attempt.slips[22:26] = 1.0
    solved, image = sound.with_slips(sound.slips), turned.mirrored()
    assert image.evidence() == pytest.approx(solved.evidence(), abs=0.1)
    assert aligned_error(image.poses[:, :2], truth[:, :2]) < 0.01
    assert sound.mirrored().evidence() < solved.evidence() - EvidencePolicy.very_strong


def slipping_over_four_steps() -> Attempt:
    """Return the attempt with true poses, and wheels that count half a metre and 0.2 rad too much over each of four steps."""
    truth = se2.chain(np.zeros(3), np.tile([0.5, 0.0, 0.15], (39, 1)))
    motion = se2.between(truth[:-1], truth[1:])
    motion[22:26] += [0.5, 0.0, 0.2]
    anchors = np.array([[4.0, 3.0], [6.0, -3.0], [-4.0, 1.0]])
    pose, anchor = np.repeat(np.arange(40), 3), np.tile([0, 1, 2], 40)
    rng = np.random.default_rng(8)
    distance = np.hypot(*(truth[pose, :2] - anchors[anchor]).T) + 0.05 * rng.standard_normal(120)
    wheels = chained(se2.chain(np.zeros(3), motion), (0.02, 0.02, 0.02))
    measured = Measured(wheels, plain_ranges(pose, anchor, distance, 0.05), 0.5 * np.arange(40.0), 0.05)
    attempt = Attempt(Graph(truth.copy(), anchors), measured, TrilaterationConfig(), ())
    attempt.placed[:], attempt.low, attempt.high, attempt.poses = True, 0, 40, truth.copy()
    return attempt


@pytest.mark.parametrize("forward", [True, False])
def test_an_attempt_that_slips_is_where_its_measurements_cost_least(forward):
    """But for the pose at the end that is known, which stays."""
    attempt = slipping_over_four_steps()
    slips = attempt.slipping(10, 36, forward=forward)
    assert set(np.flatnonzero(slips.slips)) <= set(range(18, 30))
    known = 10 if forward else 35
    again = slips._copy()
    again._anneal(10, 36, known, BootstrapPolicy.scales[1:])
    np.testing.assert_allclose(slips.poses, again.poses, atol=0.01)
    np.testing.assert_array_equal(slips.poses[known], attempt.poses[known])


@pytest.mark.parametrize("marked", [[(22, 26)], [(22, 26), (5, 9)], [(5, 9), (22, 26), (32, 36)], [(24, 28)], []])
def test_slips_that_nothing_pays_for_go_and_others_are_found(marked):
    """Slips of the wheels over four steps, and some that are not there."""
    attempt = slipping_over_four_steps()
    for first, last in marked:
        attempt.slips[first:last] = 1.0
    attempt = attempt.with_slips(attempt.slips)
    before = attempt.evidence(), attempt.slips.copy(), attempt.poses.copy()
    likely = of_likeliest_slips(attempt)
    steps = np.flatnonzero(likely.slips)
    assert set(steps) & {22, 23, 24, 25}
    assert steps.min() > 17
    assert steps.max() < 30
    assert likely.evidence() >= before[0]
    # The attempt itself is as it was.
    np.testing.assert_array_equal(attempt.slips, before[1])
    np.testing.assert_array_equal(attempt.poses, before[2])


def test_equal_inputs_give_equal_bytes():
    rng = np.random.default_rng(71)
    stamps, truth = wander(rng, 60.0)
    wheels = odometry(stamps, truth, rng, drift=0.01, noise=0.01)
    radio = ranges(rng, stamps, truth, places_around(rng, 3), rate=1.0, outliers=0.2)
    one, other = start(wheels, radio)[0], start(wheels, radio)[0]
    assert one.graph.poses.tobytes() == other.graph.poses.tobytes()
    assert one.graph.anchors.tobytes() == other.graph.anchors.tobytes()


def test_a_slip_is_sought_from_either_end_of_a_burst(monkeypatch):
    """Where the pose is known before it, and where it is known behind it."""
    asked, slipping = [], Attempt.slipping

    def noted(attempt, low, high, *, forward):
        asked.append((low, high, forward))
        return slipping(attempt, low, high, forward=forward)

    monkeypatch.setattr(Attempt, "slipping", noted)
    attempt = slipping_over_four_steps()
    of_likeliest_slips(attempt.with_slips(attempt.slips))
    ends = {span[:2] for span in asked}
    assert ends
    assert set(asked) == {(*span, forward) for span in ends for forward in (True, False)}
