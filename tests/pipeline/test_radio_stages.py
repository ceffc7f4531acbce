"""Ranges: when their noise is re-estimated and the poses give way, and how the first optimisation goes."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import planted
from helpers.laser_walks import chained
from helpers.planted_graphs import loop, plain_ranges
from scipy.spatial.distance import pdist

from uwblite import se2
from uwblite.arrays import spread
from uwblite.constraints import Constraints
from uwblite.graph.graph import Graph
from uwblite.graph.pose_edges import RelativePoseEdges, ScanEdges
from uwblite.pipeline import radio_stages
from uwblite.pipeline.estimate import Estimate, Task
from uwblite.pipeline.lidar_stages import refine_jointly
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.pipeline.progress import Stages
from uwblite.pipeline.radio_stages import evidence_against, first_optimisation, reestimate_ranges
from uwblite.pipeline.recordings import gather
from uwblite.radio.range_noise import RangeNoiseConfig
from uwblite.sensor_log import SensorLog, SensorMounting


def test_next_to_no_matched_scans_hold_no_path_and_are_not_refined():
    graph, still = loop()[0], np.zeros((1, 3))
    step = ScanEdges(np.array([0]), np.array([1]), still, np.eye(3)[None], still, still, np.full(4, -1))
    few = Estimate(graph, graph.edges[0], graph.edges[2], (), steps=step)
    assert few.held_by_scans.tolist() == [True, True] + [False] * (len(graph.poses) - 2)
    assert (few.rests_on_ranges, replace(few, ranges=None).rests_on_ranges) == (True, False)
    assert refine_jointly(few, None) is few


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
    assert radio_stages._let_go(*of, RangeNoiseConfig()) is gone


def test_ranges_keep_a_path_that_scans_hardly_see():
    """Wheels that turn by 4 mrad a step too much, no step measured: noise learnt from a path that ranges were too weak to hold
    would be this path's own error, metres, and leave it where it is."""
    rng = np.random.default_rng(6)
    angle = np.arange(240) * 0.03
    truth = np.column_stack([15.0 * np.sin(angle), 15.0 - 15.0 * np.cos(angle), angle])
    anchors = np.array([[-20.0, -5.0], [22.0, -3.0], [20.0, 36.0], [-18.0, 33.0]])
    pose, anchor = np.repeat(np.arange(240), 2), rng.integers(0, 4, 480, dtype=np.intp)
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


PLACES = np.array([[6.0, 4.5], [-6.0, 4.0], [5.5, -4.5], [-5.0, -4.0]])


def surveyed(bias=(0.0,) * 4, scale=1.0, seed=3):
    """Return the task of a walk of 60 m among four anchors, with a radio of such biases, m, and scale."""
    rng = np.random.default_rng(seed)
    stamps, truth = planted.wander(rng, 60.0)
    radio = planted.ranges(rng, stamps, truth, PLACES, sigma=0.08, bias=bias)
    radio = replace(radio, ranges=radio.ranges * scale)
    wheels = planted.odometry(stamps, truth, rng, noise=0.01, turn_noise=0.01)
    level = SensorMounting(anchor_height=0.0)
    config = MappingConfig()
    return Task(gather([SensorLog(wheels, radio, None, level)], config.keyframes), config, Constraints(), Stages(None, None))


@pytest.mark.parametrize(
    ("bias", "scale"), [((0.0,) * 4, 1.0), ((0.1, -0.05, 0.08, 0.0), 1.0), ((0.9, 0.5, 1.2, 0.8), 1.0), ((0.0,) * 4, 1.07)]
)
def test_anchors_of_a_calibrated_radio_and_of_one_that_is_not(bias, scale):
    """The wide priors of the latter are paid for by its ranges alone. Distances between anchors are known to the biases of two
    calibrated radios, 0.1 m times the root of 2 as a standard deviation: three of these."""
    found = first_optimisation(surveyed(bias, scale))
    assert found.placed.all()
    assert np.max(np.abs(pdist(found.graph.anchors) - pdist(PLACES))) < 0.42
    calibration = found.graph.calibration
    if scale != 1.0:
        assert calibration.get("range_scale") == pytest.approx(scale - 1.0, abs=0.02)
    if np.ptp(bias) > 0.3:
        assert np.mean(calibration.values[calibration.of_kinds("bias")]) == pytest.approx(np.mean(bias), abs=0.3)


def test_evidence_is_for_the_better_of_two_estimates_and_against_the_other():
    task = surveyed()
    found = first_optimisation(task)
    anchors = found.graph.anchors + np.array([[0.4, 0.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    worse = replace(found, graph=replace(found.graph, anchors=anchors))
    gain = evidence_against(found, worse, task.config)
    assert gain > 10.0
    assert evidence_against(worse, found, task.config) == pytest.approx(-gain)
    assert evidence_against(found, found, task.config) == 0.0
