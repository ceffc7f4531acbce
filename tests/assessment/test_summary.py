"""The result in the user's words: anchors with status and reason, calibration with state, warnings and doubts."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted import odometry, ranges, recording, wander
from helpers.planted_graphs import plain_ranges
from helpers.planted_tasks import recordings_of, standing

from uwblite import se2
from uwblite.assessment.summary import (
    _anchor,
    _calibration,
    _distrusted,
    _range_table,
    _reason_to_distrust,
    _with_times,
)
from uwblite.evaluation.trajectory import evaluate_trajectory
from uwblite.findings import doubt
from uwblite.graph.calibration import CalibrationConfig, Unknown
from uwblite.graph.graph import Calibration, Graph, UnknownKey
from uwblite.graph.marginals import Covariances, marginals
from uwblite.map_result import AnchorEstimate
from uwblite.mapping import MappingConfig, build_map
from uwblite.pipeline.estimate import Estimate
from uwblite.pipeline.mapping_config import preset
from uwblite.radio.bootstrap_attempt import BootstrapResult
from uwblite.radio.trilateration import AnchorHypothesis
from uwblite.sensor_log import SensorMounting, UwbRanges

PLACES = np.array([[6.5, 1.0], [-5.5, 5.0], [-2.0, -6.5], [1.0, 7.0]])
BIAS = np.array([0.4, -0.1, 0.2, 0.0])
LEVEL = SensorMounting(anchor_height=0.0)
"""Anchors at the height of the tag, which is given."""


def planted_run(seed=1, metres=60.0, sigma=0.04, **more):
    """Return stamps, truth and the recording of a path among four anchors."""
    rng = np.random.default_rng(seed)
    stamps, truth = wander(rng, metres)
    wheels = odometry(stamps, truth, rng, scale=1.02, turn_scale=0.97, noise=0.01, turn_noise=0.01)
    radio = ranges(rng, stamps, truth, PLACES, rate=1.0, sigma=sigma, bias=BIAS, **more)
    return stamps, truth, recording(wheels, radio, mounting=LEVEL)


@pytest.fixture(scope="module")
def run():
    stamps, truth, log = planted_run()
    return stamps, truth, log, build_map(log)


def test_there_is_a_pose_per_odometry_stamp_and_a_covariance_per_keyframe(run):
    _, _, log, result = run
    np.testing.assert_array_equal(result.stamps, log.odometry.stamps)
    assert result.trajectory.shape == (len(log.odometry.stamps), 3)
    assert result.keyframe_covariances.shape == (len(result.keyframe_stamps), 3, 3)
    assert np.all(np.linalg.eigvalsh(result.keyframe_covariances) > -1e-12)
    assert len(result.graph.poses) == len(result.keyframe_stamps)
    assert result.stages[-1].name == "summary"


def test_every_range_has_a_row(run):
    _, _, log, result = run
    table = result.range_table
    assert {len(column) for column in table.values()} == {len(log.ranges.ranges)}
    np.testing.assert_array_equal(table["range"], log.ranges.ranges)
    assert np.all((table["weight"] >= 0) & (table["weight"] <= 1))
    assert np.median(np.abs(table["residual"])) < 2 * 0.04


def test_anchors_and_biases_lie_within_their_sigmas(run):
    stamps, truth, _, result = run
    laid = evaluate_trajectory(result.stamps, result.trajectory, stamps, truth).T_truth_map
    for anchor, place, bias in zip(result.anchors, PLACES, BIAS, strict=True):
        assert anchor.status == "ok"
        assert not anchor.reason
        assert anchor.used_share > 0.95
        error = se2.rotate(-laid[2], place - se2.transform(laid, anchor.position))
        # Laying one trajectory over the other adds the trajectory's own error of a few centimetres.
        covariance = anchor.covariance + 0.03**2 * np.eye(2)
        assert error @ np.linalg.solve(covariance, error) < 16.0
        assert abs(anchor.bias - bias) < 4 * anchor.bias_sigma + 0.02
        assert anchor.residual_rms == pytest.approx(0.04, rel=0.5)


def test_calibration_shows_what_the_recording_shows(run):
    result = run[3]
    values = {c.name: c for c in result.calibration}
    # The unknown is what corrects the wheels: they said 0.97 of every turn.
    turn = values["heading_scale"]
    assert turn.state == "estimated"
    assert turn.value == pytest.approx(1 / 0.97 - 1, abs=4 * turn.sigma + 0.003)
    assert values["laser_x"].state == "prior"
    assert values["laser_x"].reason
    assert all(c.state in ("estimated", "prior") and c.unit and c.meaning for c in result.calibration)
    assert all(c.reason or c.state == "estimated" for c in result.calibration)
    biases = [(values[f"bias:{a.id}"].value, values[f"bias:{a.id}"].sigma) for a in result.anchors]
    assert biases == [(a.bias, a.bias_sigma) for a in result.anchors]


def test_a_recording_without_lidar_reports_so_and_no_more(run):
    result = run[3]
    assert [w for w in result.warnings if "no lidar" in w.text]
    assert result.grid is None
    assert result.closures == ()
    assert result.doubts == ()


def test_a_mirror_is_named_with_its_alternative():
    rng = np.random.default_rng(2)
    stamps = np.arange(700) * 0.1
    truth = np.column_stack([0.3 * stamps, 0.002 * np.sin(stamps), np.zeros(700)])
    radio = ranges(rng, stamps, truth, np.array([[6.0, 3.0], [14.0, -4.0]]), rate=1.0, sigma=0.03)
    result = build_map(recording(odometry(stamps, truth, rng, noise=0.003, turn_noise=0.0005), radio, mounting=LEVEL))
    assert [a.status for a in result.anchors] == ["mirror-ambiguous"] * 2
    assert len(result.doubts) >= 2
    for anchor in result.anchors:
        assert anchor.reason
        # The alternative lies on the other side of the path, about as far away.
        assert np.sign(anchor.alternative[1]) == -np.sign(anchor.position[1])
        assert abs(anchor.alternative[0] - anchor.position[0]) < 1.5
        assert any(anchor.id in doubt.text for doubt in result.doubts)


@pytest.mark.slow
def test_an_anchor_with_false_ranges_is_named_and_bends_nothing(run):
    """Two thirds of one anchor's ranges are wrong by metres: the others hold the trajectory."""
    stamps, truth, log, good = run
    rng = np.random.default_rng(3)
    wild = (log.ranges.anchor == 2) & (rng.random(len(log.ranges.ranges)) < 0.67)
    with_outliers = log.ranges.ranges + np.where(wild, rng.uniform(1.0, 9.0, len(wild)), 0.0)
    result = build_map(replace(log, ranges=replace(log.ranges, ranges=with_outliers)))
    statuses = [a.status for a in result.anchors]
    assert statuses[:2] + statuses[3:] == ["ok"] * 3
    assert statuses[2] in ("distrusted", "unplaced")
    assert any(result.anchors[2].id in w.text for w in result.warnings)
    errors = [evaluate_trajectory(r.stamps, r.trajectory, stamps, truth).ate.rmse for r in (result, good)]
    assert errors[0] < 1.5 * errors[1] + 0.02


def test_an_anchor_of_a_few_ranges_is_unplaced(run):
    _, _, log, _ = run
    keep = (log.ranges.anchor != 1) | (np.cumsum(log.ranges.anchor == 1) <= 4)
    cut = [getattr(log.ranges, name)[keep] for name in ("stamps", "anchor", "ranges", "quality")]
    result = build_map(replace(log, ranges=type(log.ranges)(*cut, log.ranges.anchor_ids)))
    silent = result.anchors[1]
    assert silent.status == "unplaced"
    assert silent.ranges == 4
    assert np.isnan(silent.position).all()
    assert "4 ranges" in silent.reason
    assert result.doubts == ()


def test_noise_that_the_measurements_belie_is_a_doubt(run):
    """Ranges of 4 cm taken as of 5 mm, squared: chi2 per degree of freedom is about 8^2 less what the poses give way."""
    _, _, log, good = run
    paper = preset("paper")
    result = build_map(log, replace(paper, ranges=replace(paper.ranges, sigma=0.005)))
    assert any("chi2/dof" in d.text for d in result.doubts)
    assert not any("chi2/dof" in d.text for d in good.doubts)


def test_no_anchor_at_all_is_a_doubt(run):
    _, _, log, _ = run
    result = build_map(replace(log, ranges=replace(log.ranges, ranges=np.zeros(len(log.ranges.ranges)))))
    assert all(a.status == "unplaced" for a in result.anchors)
    assert any("no anchor could be placed" in d.text for d in result.doubts)


def test_calibration_that_is_switched_off_is_not_listed(run):
    _, _, log, _ = run
    config = MappingConfig(calibration=CalibrationConfig(range_bias=0.0, tag_offset=0.0, heading_rate=0.0))
    result = build_map(log, config)
    names = {c.name for c in result.calibration}
    assert not any(n.startswith("bias:") for n in names)
    assert not {"tag_x", "tag_y", "heading_rate"} & names
    assert all(a.bias == 0.0 for a in result.anchors)


def test_without_lidar_what_ranges_err_alike_is_stated(run):
    """Errors of 6 cm by direction and distance are in no residual; they count once in the sigmas."""
    result = run[-1]
    unaware = marginals(result.graph)
    one, other = (np.einsum("kii->k", c[1:, :2, :2]) for c in (result.keyframe_covariances, unaware.covariances.poses))
    # Those of poses between the ones along the path that are computed are interpolated.
    computed = np.unique(np.linspace(0, len(one), 60).round().astype(int))[1:] - 1
    assert np.all(one[computed] > other[computed])
    assert np.all(one > 0.9 * other)
    assert all(np.trace(a.covariance) > np.trace(c) for a, c in zip(result.anchors, unaware.covariances.anchors, strict=True))


def test_a_doubt_about_the_whole_map_distrusts_the_anchors_that_were_well():
    def anchor(status):
        return AnchorEstimate("A", np.zeros(2), np.eye(2), 9, 1.0, 0.0, 0.1, 0.1, status, "" if status == "ok" else "few")

    anchors, part, whole = (anchor("ok"), anchor("unplaced")), doubt("no-anchor", ""), doubt("drift", "")
    assert _distrusted(anchors, []) is anchors
    assert _distrusted(anchors, [part]) is anchors
    found = _distrusted(anchors, [part, whole])
    assert [(a.status, a.reason) for a in found] == [("distrusted", "the map is doubted"), ("unplaced", "few")]


@pytest.mark.parametrize(
    ("used", "sigma", "longest", "bias", "scatter", "reason"),
    [
        (0.5, 4.99, 5.0, -1.6, 1.5, ""),
        (0.4, 0.1, 5.0, 0.0, 0.1, "only 40% of its ranges agree"),
        (1.0, 5.0, 5.0, 0.0, 0.1, "its place is known to 5 m only"),
        (1.0, 1e17, 5.0, 0.0, 0.1, "its place is known to 1e+17 m only, and its longest range is 5.0 m"),
        (1.0, np.nan, 5.0, 0.0, 0.1, "its place is known to nan m only"),
        (1.0, 0.1, 5.0, -1.7, 0.1, "a constant error of -1.7 m"),
        (0.6, 0.1, 5.0, 0.0, 1.9, "its ranges scatter by 1.9 m about the map"),
    ],
)
def test_an_anchor_is_distrusted_for_a_reason(used, sigma, longest, bias, scatter, reason):
    found = _reason_to_distrust(used, sigma, longest, bias, scatter)
    assert bool(found) == bool(reason)
    assert reason in found


def anchor_of(found=None, ranges=None, recordings=None, k=1, limit=0.2):
    """Judge anchor B of two whose places and residuals are given; its first two ranges of three are within the limit."""
    graph = Graph(np.zeros((3, 3)), np.array([[9.0, 9.0], [3.0, 4.0]]), (), Calibration(BIASES, np.array([0.7, 0.2, 0.3])))
    covariance = covariances([np.eye(2), np.diag([0.04, 0.09])], [0.5, 0.6, 0.7])
    estimate = Estimate(graph, None, ranges, ("A", "B"), found)
    return _anchor(k, estimate, recordings, covariance, np.array([5.0, 0.1, -0.19, 0.21]), limit)


def covariances(anchors, calibration):
    """Return covariances of anchors (a, 2, 2) and standard deviations of calibration values (c,)."""
    none = np.zeros(0, dtype=np.intp)
    return Covariances(np.zeros((0, 3, 3)), np.array(anchors), np.array(calibration), none, np.zeros((0, 3, 0, 3)))


BIASES = (UnknownKey("bias", "A"), UnknownKey("bias", "B"), UnknownKey("bias", "B", 1))


def measured(bias=(0, 2, 1, 2)):
    columns = np.full((4, 6), -1)
    columns[:, 1] = bias
    return replace(
        plain_ranges(np.zeros(4, int), np.array([0, 1, 1, 1]), np.array([90.0, 5.0, 7.0, 6.0]), 0.1), calibration=columns
    )


def bootstrapped(placed=(True, True), ambiguous=(False, False)):
    places = tuple(AnchorHypothesis(np.array([float(k), -4.0]), 0.0, 0.1, 0.0, 0.1) for k in range(2))
    return BootstrapResult(None, np.array(placed), ((), places), np.array(ambiguous))


def test_an_anchor_is_summed_up_from_its_own_ranges():
    found = anchor_of(bootstrapped(), measured())
    assert (found.id, found.ranges, found.status, found.reason) == ("B", 3, "ok", "")
    np.testing.assert_array_equal(found.position, [3.0, 4.0])
    np.testing.assert_array_equal(found.covariance, np.diag([0.04, 0.09]))
    assert found.used_share == pytest.approx(2 / 3)
    # The bias in the first recording with ranges to it.
    assert (found.bias, found.bias_sigma) == (0.2, 0.6)
    assert found.residual_rms == pytest.approx(1.4826 * 0.11)
    assert found.alternative is None
    without = anchor_of(bootstrapped(), measured(bias=(-1, -1, -1, -1)))
    assert (without.bias, without.bias_sigma) == (0.0, 0.0)


@pytest.mark.parametrize(("left_out", "status"), [(False, "distrusted"), (True, "ok")])
def test_readings_that_are_left_out_are_not_too_short(left_out, status):
    """Five of forty, made while the anchor was carried and set to 0."""
    short = np.arange(40) < 5
    ranges = plain_ranges(np.zeros(40, int), np.zeros(40, int), np.where(short, 0.0, 5.0), 0.1)
    ranges = replace(ranges, calibration=np.full((40, 6), -1), weights=np.where(short & left_out, 0.0, 1.0))
    graph = Graph(np.zeros((1, 3)), np.array([[3.0, 4.0]]))
    covariance = covariances([0.04 * np.eye(2)], [])
    no = np.zeros(1, dtype=bool)
    estimate = Estimate(graph, None, ranges, ("A",), BootstrapResult(None, ~no, ((),), no))
    assert _anchor(0, estimate, None, covariance, np.where(short, -5.0, 0.0), 0.2).status == status


def test_an_anchor_with_a_mirror_image_says_where_and_what_else_is_wrong():
    found = anchor_of(bootstrapped(ambiguous=(False, True)), measured())
    assert (found.status, found.alternative.tolist()) == ("mirror-ambiguous", [1.0, -4.0])
    assert found.reason.startswith("the path past it is too straight")
    wild = anchor_of(bootstrapped(ambiguous=(False, True)), measured(), limit=0.01)
    assert (wild.status, wild.reason.split(";")[0]) == ("distrusted", "only 0% of its ranges agree with the map")
    assert "too straight" in wild.reason
    assert wild.alternative is None
    assert anchor_of(bootstrapped(), measured(), limit=0.01).status == "distrusted"
    # One hypothesis alone has no mirror image; the place of another anchor is no concern.
    assert anchor_of(bootstrapped(ambiguous=(True, False)), measured()).status == "ok"


def test_an_anchor_without_a_place_says_how_many_ranges_it_has():
    for found in (bootstrapped(placed=(True, False)), None):
        anchor = anchor_of(found, measured())
        assert (anchor.status, anchor.ranges, anchor.used_share) == ("unplaced", 3, 0.0)
        assert "3 ranges" in anchor.reason
        assert np.isnan(
            [*anchor.position, *anchor.covariance.ravel(), anchor.bias, anchor.bias_sigma, anchor.residual_rms]
        ).all()
    # Where no range could be used at all, the recordings say how many there are.
    heard = [(("B", "A"), [0, 0, 1]), (("A",), [0]), (("A", "B"), [1, 1, 1, 0])]
    of = [UwbRanges(np.zeros(len(k)), np.array(k), np.ones(len(k)), np.zeros(len(k)), ids) for ids, k in heard]
    assert anchor_of(recordings=standing(4, each=[{"ranges": each} for each in of])).ranges == 5


def named(*ids):
    return tuple(AnchorEstimate(i, np.zeros(2), np.eye(2), 9, 1.0, 0.0, 0.1, 0.1, "ok") for i in ids)


ONE = standing()
"""The only recording."""


def test_places_of_a_moved_anchor_say_from_when_on_they_hold():
    ranges = plain_ranges(np.zeros(6, int), np.array([0, 1, 1, 2, 2, 2]), np.ones(6), 0.1)
    ranges = replace(ranges, stamps=np.array([7.0, 9.0, 8.0, 30.0, 20.0, 25.0]))
    moved = _with_times(named("A", "B", "B@2", "C"), ranges, ONE)
    np.testing.assert_array_equal([a.since for a in moved], [np.nan, 8.0, 20.0, np.nan])
    for alike in (named("A", "B", "C"), named("A", "B@2")):
        assert _with_times(alike, ranges, ONE) is alike
    pair = named("A", "A@2")
    assert _with_times(pair, None, ONE) is pair
    unheard = _with_times(named("A", "B", "C", "C@2"), ranges, ONE)
    np.testing.assert_array_equal([a.since for a in unheard], [np.nan, np.nan, 20.0, np.nan])


def test_the_clock_of_a_move_is_that_of_the_recording_that_shows_it():
    """The first recording has B where it was, the second sees the move at 900 s, the third begins behind it, at 0 s."""
    recording, anchor = np.array([0, 1, 1, 2, 2]), np.array([0, 0, 1, 1, 1])
    ranges = replace(plain_ranges(recording, anchor, np.ones(5), 0.1), stamps=np.array([50.0, 800.0, 900.0, 0.0, 5.0]))
    three = recordings_of(np.zeros((3, 3)), None, np.arange(3))
    one, other = named("B", "B@2")
    moved = _with_times((one, replace(other, position=np.array([40.0, 0.0]))), ranges, three)
    assert [a.since for a in moved] == [800.0, 900.0]


@pytest.mark.parametrize(
    ("value", "fixed", "sigma", "by_steps", "state", "shown", "reason"),
    [
        (0.3, False, 0.69, None, "estimated", 0.69, ""), (0.3, False, 0.71, None, "prior", 0.71, "does not show it better"),
        (0.3, True, 0.1, None, "prior", 1.0, "fixed"), (0.0, True, 0.1, None, "prior", 1.0, "no measurement of it"),
        (0.3, True, 0.1, 0.05, "estimated", 0.05, ""),
    ],
)  # fmt: skip
def test_a_value_is_estimated_where_the_recording_shows_it_better_than_the_prior(
    value, fixed, sigma, by_steps, state, shown, reason
):
    graph = Graph(
        np.zeros((1, 3)),
        calibration=Calibration(BIASES, np.array([9.0, value, 9.0])),
        fixed_calibration=np.array([False, fixed, False]),
    )
    found = _calibration(1, Unknown(BIASES[1], 1.0, "m", "what"), graph, covariances([], [9.0, sigma, 9.0]), by_steps)
    assert (found.key, found.value, found.unit, found.meaning) == (BIASES[1], value, "m", "what")
    assert (found.state, found.sigma) == (state, shown)
    assert reason in found.reason
    assert bool(found.reason) == (state == "prior")


def test_the_table_of_ranges_says_where_each_was_taken():
    rng = np.random.default_rng(0)
    poses = rng.normal(size=(4, 3))
    ranges = replace(
        plain_ranges(np.array([3, 0, 2]), np.array([1, 0, 1]), np.array([4.0, 5.0, 6.0]), 0.1), turn=np.array([0.0, 3.0, 0.5])
    )
    recordings = recordings_of(poses, None, np.array([0, 0, 1, 2]))
    table = _range_table(ranges, Graph(poses), np.array([0.0, 2.0, 1.0]), 1.5, recordings)
    np.testing.assert_allclose(np.column_stack([table["x"], table["y"]]), ranges.tag_positions(poses))
    np.testing.assert_allclose(se2.wrap_angle(table["theta"] - poses[[3, 0, 2], 2] - ranges.turn), 0.0, atol=1e-12)
    assert np.abs(table["theta"]).max() <= np.pi
    assert [table[n].tolist() for n in ("recording", "agrees", "anchor", "residual")] == [
        [2, 0, 1],
        [1, 0, 1],
        [1, 0, 1],
        [0, 2, 1],
    ]


@pytest.mark.parametrize(
    ("many", "by", "limit", "status"),
    [
        (4, 0.51, 0.2, "distrusted"),
        (3, 0.51, 0.2, "ok"),
        (4, 0.49, 0.2, "ok"),
        (4, 0.51, 0.6, "ok"),
        (4, 0.61, 0.6, "distrusted"),
    ],
)
def test_ranges_are_too_short_by_half_a_metre_or_by_what_noise_allows(many, by, limit, status):
    """More than three of them, and more than one in twenty."""
    short = np.arange(60) < many
    ranges = plain_ranges(np.zeros(60, int), np.zeros(60, int), np.where(short, 5.0 - by, 5.0), 0.1)
    ranges = replace(ranges, calibration=np.full((60, 6), -1))
    graph = Graph(np.zeros((1, 3)), np.array([[3.0, 4.0]]))
    no = np.zeros(1, dtype=bool)
    estimate = Estimate(graph, None, ranges, ("A",), BootstrapResult(None, ~no, ((),), no))
    covariance = covariances([1e-4 * np.eye(2)], [])
    assert _anchor(0, estimate, None, covariance, np.where(short, -by, 0.0), limit).status == status
