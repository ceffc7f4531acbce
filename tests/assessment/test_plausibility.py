"""What contradicts a result: turns of the wrong sign, values far from usual, ranges out of time; and where the map begins."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted import aligned_error, box, odometry, ranges, recording, scans, wander
from helpers.planted_tasks import estimate_of, recordings_of, standing, task_of

from uwblite import se2
from uwblite.assessment.plausibility import (
    check_anchors,
    check_calibration,
    check_closures,
    check_fit,
    check_handedness,
    check_lengths,
    check_moved_together,
)
from uwblite.constraints import Constraints, GivenAnchor
from uwblite.findings import warning
from uwblite.graph.calibration import Unknown
from uwblite.graph.graph import Calibration, Graph, PriorEdges, UnknownKey
from uwblite.grid.geometry import GridGeometry
from uwblite.grid.occupancy_grid import OccupancyGrid
from uwblite.loop_closure.closures import no_closures
from uwblite.map_result import AnchorEstimate, CalibrationEstimate, LoopClosure
from uwblite.mapping import MappingConfig, build_map
from uwblite.odometry.attached import OUTSIDE
from uwblite.sensor_log import OdometryBreaks, Screening, SensorMounting

PLACES = np.array([[6.5, 1.0], [-5.5, 5.0], [-2.0, -6.5], [1.0, 7.0]])
LEVEL = SensorMounting(anchor_height=0.0)


def run(seed=3, walls=None, scale=1.0, turn_scale=1.0, metres=50.0, radio_scale=1.0):
    """Return stamps, truth and the recording of a path among four anchors."""
    rng = np.random.default_rng(seed)
    stamps, truth = wander(rng, metres)
    wheels = odometry(stamps, truth, rng, scale=scale, turn_scale=turn_scale, noise=0.01, turn_noise=0.01)
    radio = ranges(rng, stamps, truth, PLACES, rate=1.0, sigma=0.04)
    radio = replace(radio, ranges=radio.ranges * radio_scale)
    lidar = None if walls is None else scans(stamps, truth, walls, rate=2.0, noise=0.01, rng=rng)
    return stamps, truth, recording(wheels, radio, lidar, LEVEL)


def stated(notices, words):
    return [t.text for t in notices if words in t.text]


@pytest.mark.parametrize("turn_scale", [-2.0, *(pytest.param(s, marks=pytest.mark.slow) for s in (2.0, 0.5))])
def test_gross_turns_leave_the_mirror_image_open(turn_scale):
    """By minus the factor that makes the turns agree, the mirror image fits as well: the ranges do not say which it is."""
    _, truth, log = run(turn_scale=turn_scale, metres=80.0)
    result = build_map(log)
    doubt = stated(result.doubts, "may be mirrored")
    assert len(doubt) == 1
    assert "odometry's heading" in doubt[0]
    error = [aligned_error(result.trajectory[:, :2], truth[:, :2], mirrored=m) for m in (False, True)]
    assert min(error) < 0.3


@pytest.mark.slow
def test_wheels_that_turn_rightly_and_lasers_vouch_for_the_sign():
    assert not stated(build_map(run()[2]).doubts, "mirrored")
    assert not stated(build_map(run(turn_scale=2.0, walls=box(12, 12), metres=40.0)[2]).doubts, "mirrored")


def handedness(graph, lidar):
    """Return the doubts about the handedness of a graph."""
    return [found for found in check_handedness(estimate_of(graph), task_of(lidar=lidar)) if found.severity == "doubt"]


@pytest.mark.parametrize(("error", "kind"), [
    (-1.9, "mirrored"), (-1.25, "mirrored"), (-1.04, "wheels-against-lidar"), (-0.93, "wheels-against-lidar"), (-0.47, None),
    (0.0, None), (1.0, None),
])  # fmt: skip
def test_wheels_that_turn_against_the_laser_or_without_it_are_doubted(error, kind):
    """-0.93: scans in reversed order; -0.47: skid steering whose effective track is 1.9 times the true one."""
    graph = Graph(np.zeros((1, 3)), calibration=Calibration((UnknownKey("heading_scale"),), np.array([error])))
    assert [n.kind for n in handedness(graph, lidar=True)] == ([] if kind is None else [kind])


@pytest.mark.parametrize(("error", "doubted"), [(0.24, False), (-0.39, False), (0.26, True), (-0.41, True), (-1.9, True)])
def test_without_a_laser_turns_that_no_slip_of_the_wheels_explains_leave_the_sign_open(error, doubted):
    graph = Graph(np.zeros((1, 3)), calibration=Calibration((UnknownKey("heading_scale"),), np.array([error])))
    found = stated(handedness(graph, lidar=False), f"multiplied by {1.0 + error:.2f}, and by {-1.0 - error:.2f} its mirror")
    assert len(found) == doubted


def test_given_anchors_decide_the_sign():
    log = run(turn_scale=2.0, metres=40.0)[2]
    given = Constraints(
        anchors=tuple(GivenAnchor(name, tuple(place), 0.05) for name, place in zip(log.ranges.anchor_ids, PLACES, strict=True))
    )
    result = build_map(log, constraints=given)
    assert not stated(result.doubts, "mirrored")


@pytest.mark.parametrize(("given", "doubted"), [(0, True), (2, True), (3, False), (4, False)])
@pytest.mark.parametrize("lidar", [False, True])
def test_three_given_anchors_decide_the_sign_and_two_do_not(given, doubted, lidar):
    """Two points and their mirror image lie on one another by a rigid motion; three do not."""
    prior = PriorEdges("anchors", np.arange(given), PLACES[:given], np.tile(np.eye(2), (given, 1, 1)))
    other = PriorEdges("calibration", np.zeros(3, int), np.zeros((3, 1)), np.ones((3, 1, 1)))
    calibration = Calibration((UnknownKey("heading_scale"),), np.array([-1.9]))
    graph = Graph(np.zeros((1, 3)), PLACES, calibration=calibration).with_edges(prior, other)
    assert len(handedness(graph, lidar)) == doubted


def moved_together(places, lidar=False, recordings=1):
    """Return the kinds of doubts that told_of_moves has."""
    return [notice.kind for notice in told_of_moves(places, lidar, recordings)]


def told_of_moves(places, lidar=False, recordings=1, moment=100.0):
    """Return the doubts about a map whose anchors A, B, ... have these places one after the other, from a moment, s, on."""
    anchors, stamps, anchor = [], [], []
    for name, own in zip("ABCD", places, strict=False):
        for number, place in enumerate(own):
            since = moment * number if len(own) > 1 else np.nan
            label = name if number == 0 else f"{name}@{number + 1}"
            anchors.append(AnchorEstimate(label, np.array(place), np.eye(2), 9, 1.0, 0.0, 0.1, 0.1, "ok", "", None, since))
            measured = np.arange(moment * number, 200.0 if number == len(own) - 1 else moment, 5.0)
            stamps.append(measured)
            anchor.append(np.full(len(measured), len(anchors) - 1))
    table = {"stamp": np.concatenate(stamps), "anchor": np.concatenate(anchor).astype(np.float64)}
    of_each = np.repeat(np.arange(recordings), 2)
    task = task_of(recordings_of(np.zeros((len(of_each), 3)), np.tile([0.0, 200.0], recordings), of_each, lidar=lidar))
    return [found for found in check_moved_together(anchors, table, task) if found.severity == "doubt"]


A, B, C, ELSEWHERE = (0.0, 0.0), (10.0, 0.0), (10.0, 10.0), (0.0, 20.0)


def test_anchors_that_were_moved_together_are_rather_another_change():
    assert moved_together([[A, ELSEWHERE], [B, (4.0, 9.0)], [C]]) == ["anchors-moved-together"]
    assert moved_together([[A, ELSEWHERE]]) == ["anchors-moved-together"]
    assert not moved_together([[A, ELSEWHERE], [B], [C]])


def test_a_move_shortly_before_the_end_is_one_of_the_anchors_that_are_measured_after_it():
    assert not told_of_moves([[A, ELSEWHERE], [B], [C]], moment=185.0)
    assert told_of_moves([[A, ELSEWHERE], [B, (4.0, 9.0)], [C]], moment=185.0)


def test_with_a_lidar_one_anchor_may_be_moved_and_all_of_them_between_recordings():
    two_of_three = [[A, ELSEWHERE], [B, (4.0, 9.0)], [C]]
    assert moved_together(two_of_three, lidar=True) == ["anchors-moved-together"]
    assert not moved_together(two_of_three, lidar=True, recordings=2)
    assert not moved_together([[A, ELSEWHERE]], lidar=True)


@pytest.mark.parametrize(("lidar", "cause"), [
    (True, "an error of lidar, radio or clocks is likelier"), (False, "a change of wheels, tag or radio is likelier"),
])  # fmt: skip
def test_what_looks_like_anchors_moved_together_depends_on_what_holds_the_trajectory(lidar, cause):
    (doubt,) = told_of_moves([[A, ELSEWHERE], [B, (4.0, 9.0)], [C]], lidar)
    assert doubt.text.startswith(f"2 of 3 anchors seem to have moved at about t = 100 s: {cause}")
    assert doubt.figures == {"at": 100.0, "moved": 2, "measured": 3}


def test_a_value_far_from_usual_is_reported():
    tight = replace(MappingConfig().calibration, odometry_scale=0.02, range_scale_sound=0.001, range_scale=0.002)
    result = build_map(run(scale=1.12, metres=35.0)[2], MappingConfig(calibration=tight))
    assert stated(result.warnings, "relative error of travelled distance came out as")
    assert not stated(build_map(run(scale=1.01, metres=35.0)[2]).warnings, "came out as")


def test_ranges_without_odometry_are_left_out_and_counted():
    _, _, log = run(metres=40.0)
    late = log.ranges.stamps > log.odometry.stamps[-1] - 20.0
    # A robot that drove on without odometry: these ranges were made who knows where.
    cut = replace(log, odometry=replace(log.odometry, stamps=log.odometry.stamps[:-200], poses=log.odometry.poses[:-200]))
    outside = cut.ranges.stamps > cut.odometry.stamps[-1] + OUTSIDE
    assert 30 < outside.sum() <= late.sum()
    result = build_map(cut)
    assert stated(result.warnings, f"{outside.sum()} of {len(outside)} ranges were stamped outside the odometry's time")
    np.testing.assert_array_equal(result.range_table["weight"][outside], 0.0)
    without = replace(
        cut,
        ranges=replace(cut.ranges, **{n: getattr(cut.ranges, n)[~outside] for n in ("stamps", "anchor", "ranges", "quality")}),
    )
    np.testing.assert_allclose(build_map(without).trajectory, result.trajectory, atol=1e-6)


def test_the_map_begins_where_the_odometry_did():
    """Wherever the bootstrap began."""
    log = run(0, metres=40.0)[2]
    moved = replace(log, odometry=replace(log.odometry, poses=se2.compose(np.array([3.0, -2.0, 1.0]), log.odometry.poses)))
    np.testing.assert_allclose(build_map(moved).trajectory[0], moved.odometry.poses[0], atol=1e-9)


@pytest.mark.slow
def test_anchors_with_false_ranges_by_turns_for_long_do_not_bend_the_map_of_a_laser():
    """Two of four anchors measure 2 m too little for 40 % of the time each: wheels alone are weak enough to follow them."""
    stamps, truth, log = run(11, walls=np.concatenate([box(13, 13), box(3, 2) + 0.5]), metres=100.0)
    radio, part = log.ranges, (log.ranges.stamps - stamps[0]) / np.ptp(stamps)
    outlying = (radio.anchor == 0) & (part > 0.1) & (part < 0.5) | (radio.anchor == 1) & (part > 0.5) & (part < 0.9)
    consistent, lied = (
        aligned_error(build_map(replace(log, ranges=replace(radio, ranges=stated))).trajectory[:, :2], truth[:, :2])
        for stated in (radio.ranges, np.maximum(radio.ranges - 2.0 * outlying, 0.1))
    )
    assert consistent < 0.03
    assert lied < 0.05


@pytest.mark.parametrize("radio_scale", [1.0, pytest.param(1.08, marks=pytest.mark.slow)])
def test_ranges_or_wheels_of_another_scale_are_reported(radio_scale):
    """Without a lidar nothing shows which of the two is wrong, but that they differ is plain: yards explain it."""
    result = build_map(run(radio_scale=radio_scale, metres=60.0)[2])
    assert stated(result.warnings, "relative error of all ranges") == []
    reported = stated(result.doubts, "relative error of all ranges")
    assert len(reported) == (radio_scale != 1.0)
    assert all("scale of the wheels" in text for text in reported)


@pytest.mark.parametrize(("statuses", "warnings", "doubts"), [
    (("unplaced", "unplaced"), ["anchor-unplaced"] * 2, ["no-anchor"]), (("ok", "ok"), [], []),
    (("mirror-ambiguous", "distrusted"), ["anchor-distrusted"], ["anchor-mirror-ambiguous"]),
    (("ok", "mirror-ambiguous"), ["anchor-mirror-ambiguous"], []),
    (("ok", "ok", "distrusted", "unplaced"), ["anchor-distrusted", "anchor-unplaced"], []),
])  # fmt: skip
def test_anchors_that_are_not_ok_are_named(statuses, warnings, doubts):
    """Mirror images are a doubt where no anchor has one place alone."""
    anchors = [AnchorEstimate(f"A{k}", np.zeros(2), np.eye(2), 9, 1.0, 0.0, 0.1, 0.1, s, "why") for k, s in enumerate(statuses)]
    found = list(check_anchors(anchors))
    assert [n.kind for n in found if n.severity == "warning"] == warnings
    assert [n.kind for n in found if n.severity == "doubt"] == doubts


@pytest.mark.parametrize(("accepted", "contradicted", "other", "grid", "kind"), [
    (0, 0, 3, True, "warning no-closure"), (0, 0, 3, False, None), (1, 0, 3, True, None), (0, 0, 0, True, None),
    (1, 5, 0, True, None),
])  # fmt: skip
def test_a_map_without_closures_is_named(accepted, contradicted, other, grid, kind):
    outcomes = ["accepted"] * accepted + ["contradicts-closures"] * contradicted + ["too-few-matches"] * other
    found = tuple(LoopClosure(0, 1, np.zeros(3), np.eye(3), 0.02, 0.5, o, "why") for o in outcomes)
    estimate = estimate_of(Graph(np.zeros((2, 3))), closures=replace(no_closures(), candidates=found))
    said = [
        f"{n.severity} {n.kind}"
        for n in check_closures(
            estimate, OccupancyGrid(GridGeometry(0.05, np.zeros(2), 4, 4), np.zeros((4, 4), np.float32)) if grid else None
        )
    ]
    assert said == ([] if kind is None else [kind])


@pytest.mark.parametrize(("fits", "doubted"), [((), False), ((9.0, 3.99), False), ((1.0, 4.01), True)])
def test_residuals_twice_as_large_as_noise_allows_after_the_last_optimisation_are_a_doubt(fits, doubted):
    task = task_of()
    for fit in fits:
        task.stages.end("optimisation", chi2_per_dof=fit)
    task.stages.end("summary")
    found = [n for n in check_fit(task) if n.severity == "doubt"]
    assert [n.figures["chi2_per_dof"] for n in found] == ([fits[-1]] if doubted else [])


@pytest.mark.parametrize(
    ("scale", "wheels", "doubted"), [(0.08, True, True), (0.02, True, False), (-0.08, True, False), (0.08, False, False)]
)
def test_ranges_that_are_too_long_show_ways_that_wheels_lost(scale, wheels, doubted):
    """Where it is known that the wheels lost some of their way, and by more than a radio is usually off."""
    task, key = task_of(lidar=True), UnknownKey("range_scale")
    stages = task.stages
    if wheels:
        stages.findings.append(warning("wheels-stand-still", "the wheels count nothing from t = 3 to 5 s"))
    value = CalibrationEstimate(key, scale, 0.004, "1", "relative error of all ranges", "estimated")
    stages.findings.extend(check_calibration([value], {}, task))
    of_scale = [notice.kind == "unusual-calibration" for notice in (*stages.warnings[wheels:], *stages.doubts)]
    assert of_scale == [True]
    assert len(stages.doubts) == doubted


@pytest.mark.parametrize(("scale", "lidar", "doubted"), [(0.094, False, True), (0.094, True, False), (-0.09, False, False)])
def test_a_scale_that_another_unit_explains_is_a_doubt_where_no_lidar_says_whose_it_is(scale, lidar, doubted):
    """0.0936: ranges in yards, or wheels that are 9 % larger than set."""
    task, key = task_of(lidar=lidar), UnknownKey("odometry_scale", recording=0)
    stages = task.stages
    value = CalibrationEstimate(key, scale, 0.01, "1", "relative error of travelled distance", "estimated")
    stages.findings.extend(check_calibration([value], {key: Unknown(key, 0.02, "1", "")}, task))
    notices = stages.doubts if doubted else stages.warnings
    assert [("yards" in n.text, n.kind) for n in notices] == [(scale > 0.09, "unusual-calibration")]
    assert len(stages.doubts) + len(stages.warnings) == 1


@pytest.mark.parametrize(("of", "off", "state", "said"), [
    ("range_scale", 0.119, "estimated", True), ("range_scale", 0.121, "estimated", False),
    ("odometry_scale", 0.121, "estimated", True),
    ("heading_scale", -0.3, "estimated", True), ("heading_scale", -0.3, "prior", False),
])  # fmt: skip
def test_unusual_values_are_warnings_and_gross_lengths_of_ranges_are_told_elsewhere(of, off, state, said):
    """By check_lengths; what the recording does not show is no finding."""
    key = UnknownKey(of)
    value = CalibrationEstimate(key, off, 0.01, "1", "relative error of all lengths", state)
    found = [(f.severity, f.kind) for f in check_calibration([value], {key: Unknown(key, 0.02, "1", "")}, task_of(lidar=True))]
    assert found == ([("warning", "unusual-calibration")] if said else [])


@pytest.mark.parametrize(("scale", "placed", "doubted"), [
    (1.119, True, False), (1.121, True, True), (0.849, True, True), (2.0, False, False), (None, True, False),
])  # fmt: skip
def test_ranges_of_another_scale_are_a_doubt_where_anchors_are_placed(scale, placed, doubted):
    """However uncertain the scale is."""
    of, value = ("bias", 5.0) if scale is None else ("range_scale", scale - 1.0)
    calibration = Calibration((UnknownKey(of, "A" if scale is None else None),), np.array([value]))
    graph = Graph(np.zeros((3, 3)), np.zeros((1, 2)), calibration=calibration)
    found = list(check_lengths(estimate_of(graph, placed=[placed]), task_of(lidar=True)))
    assert [(n.severity, n.kind, n.figures["range_scale"]) for n in found] == ([("doubt", "scales", scale)] if doubted else [])
    assert all(f"the ranges are {scale:.2f} times the distances on the map" in n.text for n in found)


@pytest.mark.parametrize(("ratios", "said"), [
    ((), None), ((np.nan, 1.0), None), ((1.0, 1.16), 1.16), ((0.84, 2.0), 0.84), ((1.11, 0.89), None),
])  # fmt: skip
def test_a_lidar_whose_ways_differ_by_more_than_an_eighth_from_the_wheels_is_named(ratios, said):
    """By the first such recording; recordings that compare nothing do not count."""
    each = [{"screening": Screening((), OdometryBreaks.none(), lidar_by_wheels=ratio)} for ratio in ratios]
    recordings = standing(len(ratios) + 1, lidar=True, each=each)
    found = check_lengths(estimate_of(Graph(np.zeros((2 * len(ratios) + 2, 3)))), task_of(recordings))
    assert [n.figures["lidar_by_wheels"] for n in found if n.severity == "doubt"] == ([] if said is None else [said])


