"""When the odometry's unit is another one, and what is said of it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.laser_walks import chained
from helpers.planted_graphs import loop, plain_ranges
from scipy.spatial.distance import pdist

from uwblite import se2
from uwblite.arrays import spread
from uwblite.constraints import Constraints, GivenAnchor
from uwblite.graph.graph import Calibration, Graph, UnknownKey
from uwblite.graph.pose_edges import RelativePoseEdges
from uwblite.pipeline import radio_stages
from uwblite.pipeline.estimate import Estimate, OtherHeights, Task
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.pipeline.progress import Stages
from uwblite.pipeline.radio_stages import odometry_unit_factors, reestimate_ranges, select_range_priors, with_units_checked
from uwblite.pipeline.recordings import Recordings


@pytest.mark.parametrize(("errors", "factors"), [
    ([0.11], [1.0]), ([0.17], [1.17]), ([-0.13], [0.87]), ([None], [1.0]), ([0.05, 0.5], [1.0, 1.5]),
])  # fmt: skip
def test_wheels_are_in_another_unit_from_an_eighth_on(errors, factors):
    """Of several recordings the one is named; no factor where the scale is no unknown."""
    values = [0.0 if e is None else e for e in errors]
    calibration = SimpleNamespace(index=lambda kind, recording: -1 if errors[recording] is None else recording, values=values)
    each, stages = [SimpleNamespace(name=f"{n}.log", number=n) for n in range(len(errors))], Stages(None, None)
    recordings = type("Recordings", (), {"each": each, "__len__": lambda self: len(each)})()
    estimate = SimpleNamespace(graph=SimpleNamespace(calibration=calibration), other_heights=None)
    task = SimpleNamespace(recordings=recordings, config=None, stages=stages)
    assert odometry_unit_factors(estimate, task).tolist() == factors
    wrong = [n for n, factor in enumerate(factors) if factor != 1.0]
    assert [w.figures for w in stages.warnings] == [{"recording": n + 1, "factor": factors[n]} for n in wrong]
    named = [w.text.startswith(f"{n}.log: ") for n, w in zip(wrong, stages.warnings, strict=True)]
    assert named == [len(errors) > 1] * len(wrong)


@pytest.mark.parametrize(
    ("factor", "lidar", "given", "height", "warned", "doubted"),
    [
        (1.1, None, 0, None, 0, 0),
        (1.41, None, 0, None, 1, 0),
        (2.06, None, 0, None, 0, 1),
        (0.515, None, 0, None, 0, 1),
        (0.515, 1.0, 0, None, 1, 0),
        (0.515, None, 2, None, 1, 0),
        (4.0, None, 0, None, 1, 0),
        (1.13, None, 0, None, 0, 1),
        (1.13, 1.0, 0, None, 1, 0),
        (1.13, None, 2, None, 1, 0),
        (1.1, None, 0, 4.7, 0, 0),
        (1.41, 1.0, 0, 4.7, 0, 1),
        (1.41, float("nan"), 0, 4.7, 0, 1),
        (1.41, 1.35, 0, 4.7, 1, 0),
        (0.7, None, 0, 4.7, 0, 1),
    ],
)
def test_a_factor_that_nothing_else_decides_is_a_doubt(factor, lidar, given, height, warned, doubted):
    """Twice, half and yards may be the radio's; anchors that hang high may look like either unit, where no lidar sees the ways.

    lidar: its ways by those of the wheels, nan where it shows none, None without.
    """
    stages = Stages(None, None)
    calibration = Calibration((UnknownKey("odometry_scale", recording=0),), np.array([factor - 1.0]))
    log = SimpleNamespace(screening=lidar and SimpleNamespace(lidar_by_wheels=lidar))
    recording = SimpleNamespace(name="run.log", number=0, has_scans=lidar is not None, log=log)
    recordings = Recordings((recording,), *(np.zeros(0),) * 4)
    given = Constraints(anchors=tuple(GivenAnchor(name, (0.0, 0.0)) for name in "AB"[:given]))
    task = SimpleNamespace(stages=stages, recordings=recordings, given=given, config=None)
    other = None if height is None else OtherHeights(height, taken=False, apart=1.0)
    estimate = SimpleNamespace(graph=SimpleNamespace(calibration=calibration), other_heights=other)
    factors = odometry_unit_factors(estimate, task)
    assert factors == pytest.approx([factor if warned or doubted else 1.0])
    assert (len(stages.warnings), len(stages.doubts)) == (warned, doubted)
    assert all(("4.7 m above the tag" in notice.text) == (height is not None) for notice in stages.doubts)


@pytest.mark.parametrize(("ways", "checked"), [
    ([1.1], True), ([0.9], True), ([1.13], False), ([0.23], False), ([None], False), ([float("nan")], False),
    ([1.0, 0.95], True), ([1.0, float("nan")], False), ([1.0, 1.3], False),
])  # fmt: skip
def test_wheels_whose_ways_a_lidar_measures_are_in_metres_whatever_the_ranges_say(ways, checked):
    """None: a recording that was not screened."""
    logs = [SimpleNamespace(screening=None if w is None else SimpleNamespace(lidar_by_wheels=w)) for w in ways]
    config = MappingConfig()
    found = with_units_checked(config, logs)
    assert (found.calibration.odometry_unit <= found.calibration.odometry_scale) == checked
    assert replace(found, calibration=config.calibration) == config
    if not checked:
        assert found is config


def test_noise_is_re_estimated_and_solved_with_twice_before_priors_are_chosen(monkeypatch):
    """The priors are those of the optimum of the last weights; without ranges nothing is done."""
    made, graph = [], loop()[0]
    estimate = Estimate(graph, graph.edges[0], None, ())
    assert select_range_priors(estimate, None) is estimate
    monkeypatch.setattr(radio_stages, "with_range_noise", lambda e, config, steady: made.append(f"noise {steady}") or e)
    solving = SimpleNamespace(optimize=lambda problem, solver: made.append(f"solve {solver.max_iterations}") or (graph, None))
    monkeypatch.setattr(radio_stages, "Optimizer", lambda: solving)
    monkeypatch.setattr(radio_stages.prior_selection, "select_priors", lambda graph, *rest: made.append("priors") or graph)
    gone = iter([False, True])
    monkeypatch.setattr(radio_stages, "_let_go", lambda held, weak: next(gone))
    config = MappingConfig()
    task = Task(None, replace(config, solver=replace(config.solver, max_iterations=7)), Constraints(), None)
    select_range_priors(replace(estimate, ranges=graph.edges[2]), task)
    assert made == ["noise True", "solve 7"] * 2 + ["priors"]
    # Where nothing but the ranges holds the poses, these weigh by their own errors alone.
    made.clear()
    select_range_priors(replace(estimate, ranges=graph.edges[2]), task)
    assert made == ["noise True", "solve 7"] * 2 + ["noise False", "solve 7"] * 2 + ["priors"]


@pytest.mark.parametrize(("growth", "gone"), [
    ((1.25, 1.2, 1.29, 1.0), False), ((1.4, 1.35, 1.4, 1.0), True), ((1.0, 9.0, 1.0, 1.1), False), ((), False),
])  # fmt: skip
def test_poses_have_let_ranges_go_where_those_of_most_anchors_scatter_more(growth, gone):
    """By a third and more; an anchor that lies is one alone."""
    rng = np.random.default_rng(5)
    count = len(growth)
    graph = Graph(np.zeros((1, 3)), np.array([[30.0, 0.0]] * count).reshape(-1, 2), ())
    anchor = np.repeat(np.arange(count), 200)
    off = 0.1 * rng.standard_normal(200)
    off *= 0.1 / spread(off)
    of = [
        Estimate(graph, None, plain_ranges(0 * anchor, anchor, 30.0 + np.repeat(times, 200) * np.tile(off, count), 0.1), ())
        for times in (np.ones(count), np.array(growth))
    ]
    assert radio_stages._let_go(*of) is gone


def test_ranges_keep_a_path_that_scans_hardly_see():
    """Wheels that turn by 4 mrad a step too much, no step measured: noise learnt from a path that ranges were too weak to hold
    would be this path's own error, metres, and leave it where it is."""
    rng = np.random.default_rng(6)
    angle = np.arange(240) * 0.03
    truth = np.column_stack([15.0 * np.sin(angle), 15.0 - 15.0 * np.cos(angle), angle])
    anchors = np.array([[-20.0, -5.0], [22.0, -3.0], [20.0, 36.0], [-18.0, 33.0]])
    pose, anchor = np.repeat(np.arange(240), 2), rng.integers(0, 4, 480)
    exact = np.hypot(*(truth[pose, :2] - anchors[anchor]).T)
    ranges = plain_ranges(pose, anchor, exact + 0.1 * rng.standard_normal(480), 0.12)
    steps = se2.between(truth[:-1], truth[1:]) + np.array([0.0, 0.0, 0.004])
    wheels = chained(truth, np.array([0.01, 0.01, 0.005]))
    path = [truth[0]]
    for step in steps:
        path.append(se2.compose(path[-1], step))
    graph = Graph(np.array(path), anchors, ())
    none = RelativePoseEdges(np.zeros(0, dtype=int), np.zeros(0, dtype=int), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    estimate = Estimate(graph, replace(wheels, motion=steps), ranges, ("A", "B", "C", "D"), steps=none)
    task = Task(None, MappingConfig(), Constraints(), Stages(None, None))
    found = reestimate_ranges(estimate, task)
    assert np.hypot(*(np.array(path)[-1, :2] - truth[-1, :2])) > 2.0
    # Where the map lies as a whole is free.
    error = pdist(found.graph.poses[::5, :2]) - pdist(truth[::5, :2])
    assert np.sqrt(np.mean(error**2)) < 0.1
    assert np.all((found.ranges.sigma > 0.07) & (found.ranges.sigma < 0.15))


def test_the_first_optimisation_reports_each_lap_and_frees_the_radio_in_the_last(monkeypatch):
    made, graph = [], loop()[0]
    bootstrap = SimpleNamespace(placed=np.array([True, False, True]))
    estimate = Estimate(graph, graph.edges[0], graph.edges[2], ("A", "B", "C"), bootstrap)
    monkeypatch.setattr(radio_stages, "with_range_noise", lambda e, config: made.append("noise") or e)
    monkeypatch.setattr(radio_stages, "optimize_with_heights", lambda *given: made.append("solve") or (graph, "result"))
    monkeypatch.setattr(radio_stages.prior_selection, "select_priors", lambda graph, *given: made.append("priors") or graph)
    monkeypatch.setattr(radio_stages, "with_free", lambda graph, *kinds: made.append("free") or graph)
    monkeypatch.setattr(radio_stages, "solver_figures", lambda result: {"chi2": 1.0})
    stages = SimpleNamespace(report=lambda *given: made.append(given), end=lambda *given, **more: made.append((given, more)))
    seen = SimpleNamespace(have_scans=True)
    radio_stages._optimised(estimate, SimpleNamespace(config=MappingConfig(), stages=stages, recordings=seen))
    name = "first optimisation"
    assert made == [
        "noise", "solve", (name, 1, 3), "noise", "solve", (name, 2, 3), "noise", "priors", "free", "solve", (name, 3, 3),
        ((name,), {"placed": 2, "chi2": 1.0}),
    ]  # fmt: skip
    made.clear()
    # Without a lidar, once more where another optimum was better.
    seen.have_scans = False
    monkeypatch.setattr(radio_stages.other_minima, "at_best", lambda e, task: made.append("other") or replace(e))
    radio_stages._optimised(estimate, SimpleNamespace(config=MappingConfig(), stages=stages, recordings=seen))
    assert made[-7:-1] == [(name, 3, 3), "other", "noise", "priors", "free", "solve"]
    without = replace(estimate, ranges=None)
    assert radio_stages._optimised(without, None) is without
