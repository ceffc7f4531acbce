"""Trajectories caught on the wrong side of a line of anchors, and when another side is a doubt."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from helpers.planted import NOMINAL, drive, odometry, ranges

from uwblite import se2
from uwblite.arrays import rms_length
from uwblite.assessment.certainty import check_other_side
from uwblite.constraints import Constraints
from uwblite.graph.graph import Graph
from uwblite.graph.solver import optimize
from uwblite.pipeline import radio_stages, range_alternatives
from uwblite.pipeline.estimate import Estimate, Task
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.pipeline.progress import Stages
from uwblite.pipeline.recordings import gather
from uwblite.sensor_log import SensorLog


@cache
def there_and_back(across: float) -> tuple[Task, np.ndarray]:
    """Return a drive along a corridor and back, beside four anchors on a line or with every other one so far across, m."""
    rng = np.random.default_rng(3)
    stamps, truth = drive([[0.5, 0.0, 0.0], [0.2, 0.0, 0.8], [0.5, 0.0, 0.0]], [56.0, np.pi / 0.8, 56.0])
    places = np.array([[1.0, 1.0], [10.0, 1.0 - across], [19.0, 1.0], [28.0, 1.0 - across]])
    radio = ranges(rng, stamps, truth, places, rate=4.0, sigma=0.05)
    log = SensorLog(odometry(stamps, truth, rng, scale=1.0, noise=0.01, turn_noise=0.01), radio, None, NOMINAL)
    config = MappingConfig()
    task = Task(gather([log], config.keyframes), config, Constraints(), Stages(None, None))
    at = task.recordings.stamps
    return task, np.column_stack([np.interp(at, log.odometry.stamps, column) for column in truth[:, :2].T])


@cache
def estimated(across: float) -> Estimate:
    """Return the first estimate of that drive."""
    return radio_stages.first_optimisation(there_and_back(across)[0])


def error(found: np.ndarray, true: np.ndarray) -> float:
    """Return the rms distance of places from where they are, up to reflection, m."""
    both = (found[:, :2] * [1.0, side] for side in (1.0, -1.0))
    return min(rms_length(se2.transform(se2.align(places, true), places) - true) for places in both)


def test_a_way_caught_on_the_wrong_side_of_the_anchors_is_freed():
    (task, true), estimate = there_and_back(0.0), estimated(0.0)
    graph = estimate.graph.with_edges(*estimate.odometry_and_ranges)
    assert error(graph.poses, true) < 0.15
    # One way is caught where it is put to the other side of the anchors.
    caught = optimize(graph.with_estimates_of(estimate.other_side), task.config.solver)[0]
    assert error(caught.poses, true) > 0.3
    best = range_alternatives.sides(caught, estimate.placed, task.config.solver)[0].graph
    assert best.chi2() < caught.chi2() - 4.0
    assert error(best.poses, true) < 0.1


@pytest.mark.parametrize(("beside", "line"), [([], 1), ([4.0], 1), ([4.0, -4.0], 0), ([0.5, -0.5, 0.5], 1)])
def test_anchors_stand_on_a_line_but_for_one(beside, line):
    """Four of them along a wall at y = 2, and more beside it; in a corridor 1 m wide none is far enough across."""
    along = np.column_stack([np.arange(4) * 9.0, np.full(4, 2.0)])
    anchors = np.concatenate([along, [[4.0 * k, 2.0 + off] for k, off in enumerate(beside)]]) if beside else along
    path = np.column_stack([np.linspace(0.0, 27.0, 50), 1.8 - 0.02 * np.abs(np.arange(50) - 20), np.zeros(50)])
    starts = range_alternatives.mirrored_tails(Graph(path, anchors, ()), np.ones(len(anchors), dtype=bool))
    assert len(starts) == line


def test_anchors_on_both_sides_leave_no_other_side():
    (task, true), estimate = there_and_back(2.4), estimated(2.4)
    graph = estimate.graph.with_edges(*estimate.odometry_and_ranges)
    assert error(graph.poses, true) < 0.15
    assert not range_alternatives.mirrored_tails(graph, estimate.placed)
    assert [each.graph for each in range_alternatives.sides(graph, estimate.placed, task.config.solver)] == [graph]
    assert estimate.other_side is None


@pytest.mark.parametrize("caught", [False, True])
def test_a_map_is_doubted_where_another_side_fits_about_as_well(caught):
    """So is one that is caught on the wrong side, and not the one on the side for which there is very strong evidence."""
    (task, _), estimate = there_and_back(0.0), estimated(0.0)
    estimate = replace(estimate, graph=estimate.graph.with_edges(*estimate.odometry_and_ranges))
    if caught:
        start = estimate.graph.with_estimates_of(estimate.other_side)
        estimate = replace(estimate, graph=optimize(start, task.config.solver)[0])
    found = list(check_other_side(estimate, task))
    assert [finding.kind for finding in found] == ["other-side"] * caught
    assert all(finding.figures["apart"] > range_alternatives.RangePolicy.elsewhere for finding in found)
