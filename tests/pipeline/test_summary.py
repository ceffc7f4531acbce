"""The result in the user's words: anchors with status and reason, calibration with state, warnings and doubts."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted import odometry, ranges, recording, wander
from helpers.planted_graphs import loop

from uwblite import se2
from uwblite.evaluation.trajectory import evaluate_trajectory
from uwblite.graph.calibration import CalibrationConfig
from uwblite.graph.marginals import marginals
from uwblite.graph.pose_edges import ScanEdges
from uwblite.map_result import AnchorEstimate, Notice
from uwblite.mapping import MappingConfig, build_map
from uwblite.odometry.wheels import with_noise_shown
from uwblite.pipeline.mapping_config import preset
from uwblite.pipeline.summary import _distrusted, _reason_to_distrust, _with_steady_errors
from uwblite.sensor_log import SensorMounting

PLACES = np.array([[6.5, 1.0], [-5.5, 5.0], [-2.0, -6.5], [1.0, 7.0]])
BIAS = np.array([0.4, -0.1, 0.2, 0.0])
LEVEL = SensorMounting(anchor_height=0.0)
"""Anchors at the height of the tag, which is given."""


def planted_run(seed=1, metres=150.0, sigma=0.04, **more):
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
    unaware = marginals(with_noise_shown(result.graph))
    one, other = (np.einsum("kii->k", c[1:, :2, :2]) for c in (result.keyframe_covariances, unaware.poses))
    assert np.all(one > other)
    assert all(np.trace(a.covariance) > np.trace(c) for a, c in zip(result.anchors, unaware.anchors, strict=True))


def test_a_doubt_about_the_whole_map_distrusts_the_anchors_that_were_well():
    def anchor(status):
        return AnchorEstimate("A", np.zeros(2), np.eye(2), 9, 1.0, 0.0, 0.1, 0.1, status, "" if status == "ok" else "few")

    anchors, part, whole = (anchor("ok"), anchor("unplaced")), Notice("no-closure", "", {}), Notice("halves-disagree", "", {})
    assert _distrusted(anchors, []) is anchors
    assert _distrusted(anchors, [part]) is anchors
    found = _distrusted(anchors, [part, whole])
    assert [(a.status, a.reason) for a in found] == [("distrusted", "the map is doubted"), ("unplaced", "few")]


@pytest.mark.parametrize(
    ("used", "sigma", "longest", "bias", "reason"),
    [
        (0.6, 4.0, 5.0, -1.5, ""),
        (0.4, 0.1, 5.0, 0.0, "only 40% of its ranges agree"),
        (1.0, 1e17, 5.0, 0.0, "its place is known to 1e+17 m only, and its longest range is 5.0 m"),
        (1.0, np.nan, 5.0, 0.0, "its place is known to nan m only"),
        (1.0, 0.1, 5.0, -1.7, "a constant error of -1.7 m"),
    ],
)
def test_an_anchor_is_distrusted_for_a_reason(used, sigma, longest, bias, reason):
    found = _reason_to_distrust(used, sigma, longest, bias)
    assert bool(found) == bool(reason)
    assert reason in found


@pytest.mark.parametrize(("steady", "lidar", "counted"), [(0.1, False, True), (0.0, False, False), (0.1, True, False)])
def test_what_ranges_err_alike_counts_in_covariances_where_no_lidar_holds_the_poses(monkeypatch, steady, lidar, counted):
    asked = []

    def learnt(edges, graph, anchors, config, *, steady):
        asked.append((edges, anchors, steady))
        return edges, ()

    monkeypatch.setattr("uwblite.pipeline.summary.learn_noise", learnt)
    graph = loop()[0]
    i, none = np.zeros(1, dtype=int), np.zeros((1, 3))
    scans = ScanEdges(i, i + 1, none, np.eye(3)[None], none, none, np.full(4, -1))
    graph = graph.with_edges(scans) if lidar else graph
    found = _with_steady_errors(graph, 3, replace(MappingConfig().ranges, steady=steady))
    assert found.edges == graph.edges
    assert asked == ([(graph.edges[2], 3, True)] if counted else [])
