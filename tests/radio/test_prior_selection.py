"""Widths of priors by marginal likelihood: the formula against an integral, and the choice on planted radios."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted import ranges, wander
from helpers.planted_graphs import plain_ranges

from uwblite.errors import SolverError
from uwblite.graph.calibration import CalibrationConfig, block, prior_edges, unknowns
from uwblite.graph.graph import Calibration, Graph, PriorEdges, UnknownKey
from uwblite.graph.marginals import calibration_covariance
from uwblite.graph.pose_edges import RelativePoseEdges
from uwblite.graph.solver import optimize
from uwblite.odometry.attached import attach_ranges
from uwblite.odometry.keyframes import KeyframeConfig, select
from uwblite.odometry.wheels import OdometryNoiseConfig, wheel_edges
from uwblite.radio import prior_selection
from uwblite.radio.prior_selection import (
    UnitPolicy,
    _common,
    _mean_under,
    _units,
    select_priors,
    with_alike_heights,
    with_calibrated_radio,
)
from uwblite.radio.range_measurements import range_edges
from uwblite.radio.range_noise import RangeNoiseConfig
from uwblite.sensor_log import LONGEST_RANGE, Odometry, SensorMounting

LEVEL = SensorMounting(anchor_height=0.0)
CONFIG = CalibrationConfig()
PLACES = np.array([[6.0, 4.5], [-6.0, 4.0], [5.5, -4.5], [-5.0, -4.0]])


def solved(seed, bias=(0.0,) * 4, scale=1.0):
    """Return the graph of a path whose poses are known, solved for anchors, scale and biases, and its edges."""
    rng = np.random.default_rng(seed)
    stamps, truth = wander(rng, 60.0)
    radio = ranges(rng, stamps, truth, PLACES, sigma=0.05, bias=bias)
    radio = replace(radio, ranges=(radio.ranges - np.array(bias)[radio.anchor]) * scale + np.array(bias)[radio.anchor])
    wheels = Odometry(stamps, truth)
    frames, ids = select(wheels, KeyframeConfig()), radio.anchor_ids
    listed = unknowns(CONFIG, ids, np.ones(4, dtype=bool))
    attached = attach_ranges(radio, wheels, frames, LEVEL)
    edges = range_edges(attached, ids, LEVEL, block(listed), RangeNoiseConfig(0.05), LONGEST_RANGE)
    constant = np.array([u.key.kind not in ("range_scale", "bias") for u in listed])
    fixed = np.ones(len(frames), dtype=bool)
    graph = Graph(frames.odometry, PLACES.copy(), (prior_edges(listed),), block(listed), fixed, fixed_calibration=constant)
    done = optimize(graph.with_edges(edges))[0]
    return graph.updated(done.poses, done.anchors, done.calibration.values), edges


def widths(graph):
    sigma = 1.0 / graph.edges[0].sqrt_information[:, 0, 0]
    return dict(zip((key.label for key in graph.calibration.keys), sigma, strict=True))


# Seed 0 happens to draw noise that looks like a scale of 0.003, four standard deviations from none.
@pytest.mark.parametrize("seed", range(1, 4))
def test_a_sound_radio_gets_narrow_priors(seed):
    graph, edges = solved(seed)
    found = widths(select_priors(graph, (edges,), CONFIG))
    assert found["range_scale"] < 2.0 * CONFIG.range_scale_sound
    assert CONFIG.range_bias_sound < found["bias:A00"] == found["bias:A03"] < 2.0 * CONFIG.range_bias_sound


@pytest.mark.parametrize("seed", range(2))
def test_a_radio_with_large_biases_gets_wide_ones(seed):
    graph, edges = solved(seed, bias=(0.9, 0.4, 1.3, 0.7))
    found = widths(select_priors(graph, (edges,), CONFIG))
    assert found["bias:A02"] > 3 * CONFIG.range_bias_sound
    assert found["odometry_scale"] == pytest.approx(CONFIG.odometry_scale, rel=1e-12)


@pytest.mark.parametrize("scale", [1.07, 1.02, 0.98, 0.93])
def test_a_scale_that_the_recording_shows_floats(scale):
    """The prior chosen draws it back by no more than a standard deviation of what the ranges alone say."""
    graph, edges = solved(1, scale=scale)
    chosen = select_priors(graph, (edges,), CONFIG)
    width = widths(chosen)["range_scale"]
    found = optimize(chosen.with_edges(edges))[0]
    sigma = calibration_covariance(found)[found.calibration.index("range_scale"), found.calibration.index("range_scale")] ** 0.5
    alone = 1.0 / np.sqrt(sigma**-2 - width**-2)
    assert abs(found.calibration.get("range_scale") - (scale - 1.0)) < 3.0 * sigma
    assert abs(scale - 1.0) * (sigma / width) ** 2 < alone


def test_the_width_of_the_scale_grows_with_what_the_recording_shows():
    """From nearly that of sound radios to that of radios that are off."""
    found = [
        widths(select_priors(graph, (edges,), CONFIG))["range_scale"]
        for graph, edges in (solved(1, scale=scale) for scale in (1.0, 1.001, 1.002, 1.003, 1.05))
    ]
    assert np.all(np.diff(found) >= 0.0)
    assert found[0] < 2.0 * CONFIG.range_scale_sound
    assert found[-1] == pytest.approx(CONFIG.range_scale)


def test_a_recording_that_does_not_show_the_scale_leaves_it_sound():
    """A scale that looks 1 % off, give or take 2 %."""
    graph, edges = solved(0, scale=1.01)
    vague = replace(edges, sigma=edges.sigma * 40.0)
    done = optimize(graph.with_edges(vague))[0]
    graph = graph.updated(done.poses, done.anchors, done.calibration.values)
    assert widths(select_priors(graph, (vague,), CONFIG))["range_scale"] < 0.01


def test_only_priors_of_units_and_biases_change():
    """Priors on poses and anchors stay as they are, and so does what is known of every other calibration value."""
    graph, edges = solved(0)
    surveyed = PriorEdges("anchors", np.arange(2), PLACES[:2], np.tile(20.0 * np.eye(2), (2, 1, 1)))
    pinned = PriorEdges("poses", np.arange(2), graph.poses[:2], np.tile(30.0 * np.eye(3), (2, 1, 1)))
    chosen = select_priors(graph.with_edges(surveyed, pinned), (edges,), CONFIG)
    assert chosen.edges[1:] == (surveyed, pinned)
    before, after = widths(graph), widths(chosen)
    changed = {name for name in before if after[name] != pytest.approx(before[name], rel=1e-12)}
    assert changed == {"range_scale", "bias:A00", "bias:A01", "bias:A02", "bias:A03"}
    np.testing.assert_array_equal(chosen.edges[0].value, graph.edges[0].value)
    np.testing.assert_array_equal(chosen.edges[0].index, graph.edges[0].index)


def driven(seed, scale=1.0, unit=1.0):
    """Return the graph of a path whose wheels count other units and whose radio has another scale, solved, and its edges."""
    rng = np.random.default_rng(seed)
    stamps, truth = wander(rng, 60.0)
    radio = ranges(rng, stamps, truth, PLACES, sigma=0.05)
    radio = replace(radio, ranges=radio.ranges * scale)
    wheels = Odometry(stamps, truth * np.array([1.0 / unit, 1.0 / unit, 1.0]))
    frames, ids = select(wheels, KeyframeConfig(distance=0.05)), radio.anchor_ids
    listed = unknowns(CONFIG, ids, np.ones(4, dtype=bool))
    attached = attach_ranges(radio, wheels, frames, LEVEL)
    edges = range_edges(attached, ids, LEVEL, block(listed), RangeNoiseConfig(0.05), LONGEST_RANGE)
    steps = wheel_edges(frames, OdometryNoiseConfig(), block(listed))
    constant = np.array([u.key.kind not in ("range_scale", "bias", "odometry_scale") for u in listed])
    graph = Graph(frames.odometry, PLACES / unit, (prior_edges(listed),), block(listed), fixed_calibration=constant)
    done = optimize(graph.with_edges(edges, steps))[0]
    return graph.updated(done.poses, done.anchors, done.calibration.values), (edges, steps)


@pytest.mark.parametrize(
    ("scale", "unit", "wide"),
    [
        (1.0, 1.0, None),
        (1.004, 0.97, None),
        (1.07, 1.0, "range_scale"),
        (0.93, 1.0, "odometry_scale"),
        (1.0, 1.1, "odometry_scale"),
        (1.0, 0.9, "odometry_scale"),
        (1.0, 1.4, "odometry_scale"),
        (1.0, 0.7, "odometry_scale"),
        (1.0, 2.0, "odometry_scale"),
    ],
)
def test_the_likeliest_unit_of_length_is_the_wrong_one(scale, unit, wide):
    """A radio measures times of flight and is never too short by much; a wheel's radius is a setting."""
    graph, edges = driven(1, scale, unit)
    found = widths(select_priors(graph, edges, CONFIG))
    if wide == "range_scale":
        assert found["range_scale"] == pytest.approx(CONFIG.range_scale)
    else:
        assert found["range_scale"] < 0.01
    expected = CONFIG.odometry_unit if wide == "odometry_scale" else CONFIG.odometry_scale
    assert found["odometry_scale"] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("scale", [1.1, 1.15, 1.3])
def test_where_a_lidar_knows_the_wheels_unit_a_radio_may_be_off_by_more(scale):
    graph, edges = driven(1, scale)
    found = widths(select_priors(graph, edges, replace(CONFIG, odometry_unit=0.12)))
    assert found["range_scale"] == pytest.approx(CONFIG.range_scale)
    assert found["odometry_scale"] == pytest.approx(CONFIG.odometry_scale, rel=1e-12)


@pytest.mark.parametrize(("count", "wide"), [(1.0, False), (1.03, False), (0.91, True), (1.1, True)])
def test_without_ranges_wheels_that_a_lidar_finds_far_off_get_a_wide_prior(count, wide):
    """Of 50 m, each metre is measured to 5 cm; nothing is said of a radio."""
    rng = np.random.default_rng(3)
    ahead = np.tile([1.0, 0.0, 0.0], (50, 1))
    stamps, truth = np.arange(51.0), np.column_stack([np.arange(51.0), np.zeros((51, 2))])
    wheels, way = Odometry(stamps, truth * count), replace(CONFIG, odometry_unit=0.12)
    listed = unknowns(way, ("A", "B"), np.ones(2, dtype=bool))
    steps = wheel_edges(select(wheels, KeyframeConfig(distance=1.0)), OdometryNoiseConfig(), block(listed))
    first = np.arange(len(steps.i))
    seen = ahead[first] + rng.standard_normal((len(first), 3)) * np.array([0.05, 0.05, 0.01])
    lidar = RelativePoseEdges(first, first + 1, seen, np.tile(np.diag([20.0, 20.0, 100.0]), (len(first), 1, 1)))
    constant = np.array([u.key.kind != "odometry_scale" for u in listed])
    graph = Graph(truth[: len(first) + 1], np.zeros((2, 2)), (prior_edges(listed),), block(listed), fixed_calibration=constant)
    done = optimize(graph.with_edges(lidar, steps))[0]
    before = graph.updated(done.poses, done.anchors, done.calibration.values)
    after = widths(select_priors(before, (lidar, steps), way))
    assert after["odometry_scale"] == pytest.approx(way.odometry_unit if wide else way.odometry_scale)
    assert {name for name in after if after[name] != widths(before)[name]} == ({"odometry_scale"} if wide else set())


@pytest.mark.parametrize(("wheels", "wrong"), [(0, []), (1, [[1]]), (2, [[1, 0], [0, 1], [1, 1]])])
def test_units_that_are_tried_are_the_radio_s_then_those_of_one_recording_s_wheels_then_of_all(wheels, wrong):
    """Four widths of the radio's scale, the sound one as likely as the three others together; a wrong unit one in ten."""
    units, odds, hypothesis = _units(1, wheels, CONFIG)
    right, scales = CONFIG.odometry_scale, np.geomspace(CONFIG.range_scale_sound, CONFIG.range_scale, 4)
    expected = [[scale] + [right] * wheels for scale in scales]
    expected += [[scales[0]] + [CONFIG.odometry_unit if one else right for one in these] for these in wrong]
    np.testing.assert_allclose(units, expected)
    np.testing.assert_allclose(np.exp(odds), [1.0] + [1.0 / 3.0] * 3 + [0.1] * len(wrong))
    assert hypothesis.tolist() == [0] * 4 + list(range(1, len(wrong) + 1))


def test_a_unit_of_the_wheels_that_is_no_less_sure_than_their_scale_is_not_tried():
    sure = replace(CONFIG, odometry_unit=CONFIG.odometry_scale)
    assert set(_units(1, 2, sure)[2].tolist()) == {0}
    assert _units(0, 2, sure)[0].tolist() == [[CONFIG.odometry_scale] * 2]


def test_a_scale_that_no_radio_has_is_no_scale():
    """Ranges 15 % too long, and nothing else whose unit could be wrong: the radio's scale stays with its sound prior."""
    graph, edges = solved(1, scale=1.15)
    assert widths(select_priors(graph, (edges,), CONFIG))["range_scale"] == pytest.approx(CONFIG.range_scale_sound)


@pytest.mark.parametrize("covariance", [np.diag([1e-320] * 20), np.full((20, 20), np.nan), -np.eye(20)])
def test_a_posterior_without_an_information_matrix_leaves_the_graph_alone(monkeypatch, covariance):
    """One whose inverse overflows, one that was not computed, one that is no covariance."""
    graph, edges = solved(1)
    monkeypatch.setattr(prior_selection, "calibration_covariance", lambda graph: covariance)
    assert select_priors(graph, (edges,), CONFIG) is graph


def test_where_no_width_is_possible_the_graph_is_left_alone(monkeypatch):
    """Rounding may leave a posterior that is no normal distribution under any of the widths."""
    graph, edges = solved(1)
    monkeypatch.setattr(prior_selection, "log_marginal_likelihood", lambda *args: -np.inf)
    assert select_priors(graph, (edges,), CONFIG) is graph


def test_nothing_free_leaves_the_graph_alone():
    graph, edges = solved(0)
    constant = replace(graph, fixed_calibration=np.ones(len(graph.calibration.values), dtype=bool))
    assert select_priors(constant, (edges,), CONFIG) is constant


@pytest.mark.filterwarnings("error")
def test_one_of_the_two_may_be_fixed():
    graph, edges = solved(1, bias=(0.9, 0.4, 1.3, 0.7))
    scale = graph.calibration.index("range_scale")
    constant = np.asarray(graph.fixed_calibration).copy()
    constant[scale] = True
    found = widths(select_priors(replace(graph, fixed_calibration=constant), (edges,), CONFIG))
    assert found["range_scale"] == pytest.approx(CONFIG.range_scale, rel=1e-12)
    assert found["bias:A02"] > 3 * CONFIG.range_bias_sound


def test_the_mean_under_other_priors_is_that_of_the_same_measurements():
    """Linear measurements again: solved with the other priors from the beginning."""
    rng = np.random.default_rng(3)
    a, y, before, after = rng.normal(size=(7, 3)), rng.normal(size=7), np.array([0.3, 1.0, 2.0]), np.array([0.9, 0.2, 5.0])
    covariance = np.linalg.inv(a.T @ a + np.diag(before**-2.0))
    expected = np.linalg.solve(a.T @ a + np.diag(after**-2.0), a.T @ y)
    np.testing.assert_allclose(_mean_under(covariance @ a.T @ y, covariance, before, after), expected)


def test_the_common_height_is_that_of_the_joint_normal_of_mean_and_heights():
    """Mean and squared heights of three anchors as one vector, for each spread tried; spreads by their evidence."""
    values, sigma = np.array([1.2, 2.5, 1.9]), np.full(3, 2.0)
    information = np.diag([4.0, 0.5, 2.0]) + 0.3
    covariance = np.linalg.inv(information + np.diag(sigma**-2.0))
    pulled, found = (information + np.diag(sigma**-2.0)) @ values, []
    for spread in np.geomspace(UnitPolicy.least_heights, 2.0, UnitPolicy.widths):
        prior = np.zeros((4, 4))
        prior[0, 0] = (UnitPolicy.together * 2.0) ** -2.0 + 3.0 / spread**2
        prior[0, 1:] = prior[1:, 0] = -1.0 / spread**2
        prior[1:, 1:] = np.eye(3) / spread**2
        joint = prior + np.pad(information, (1, 0))
        right = np.append(0.0, pulled)
        place = np.linalg.solve(joint, right)
        log_evidence = 0.5 * (right @ place + np.linalg.slogdet(prior)[1] - np.linalg.slogdet(joint)[1])
        found.append((log_evidence, place[0], np.linalg.inv(joint)[0, 0], spread))
    likely, mean, variance, spread = np.array(found).T
    weight = np.exp(likely - likely.max()) / np.exp(likely - likely.max()).sum()
    middle = weight @ mean
    expected = np.sqrt(weight @ (variance + (mean - middle) ** 2) + np.exp(2.0 * weight @ np.log(spread)))
    np.testing.assert_allclose(_common(values, covariance, sigma), (middle, expected), rtol=1e-9)


def test_a_calibrated_radio_has_the_narrowest_priors_tried():
    graph, _ = solved(0)
    done = with_calibrated_radio(graph, CONFIG)
    before, after = widths(graph), widths(done)
    sound = {"range_scale": CONFIG.range_scale_sound} | {f"bias:A0{k}": CONFIG.range_bias_sound for k in range(4)}
    assert after == pytest.approx(before | sound)
    # A prior that is narrower stays.
    narrow = replace(CONFIG, range_bias_sound=0.5, range_bias=0.5)
    assert widths(with_calibrated_radio(done, narrow)) == pytest.approx(after)


def test_heights_are_left_alone_where_the_measurements_leave_a_direction_open(monkeypatch):
    keys, places = tuple(map(UnknownKey, ["height2"] * 3)), np.array([[3.0, 1.0], [-2.0, 2.0], [1.0, -3.0]])
    columns = np.full((3, 6), -1)
    columns[:, 2] = np.arange(3)
    ranges = replace(plain_ranges(np.zeros(3, dtype=np.intp), np.arange(3), np.full(3, 4.0), 0.1), calibration=columns)
    heights = PriorEdges("calibration", np.arange(3), np.zeros((3, 1)), np.full((3, 1, 1), 0.1))
    graph = Graph(np.zeros((1, 3)), places, (heights, ranges), Calibration(keys, np.full(3, 4.0)))
    graph = replace(graph, fixed_anchors=np.ones(3, dtype=bool))
    alike = with_alike_heights(graph).edges[0]
    assert np.all(alike.value > 0.0)

    def open_direction(graph):
        raise SolverError("singular")

    monkeypatch.setattr(prior_selection, "calibration_covariance", open_direction)
    assert with_alike_heights(graph) is graph
