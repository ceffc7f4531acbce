"""An offset of the lidar's clock is taken where all parts of a recording show it, and nowhere else."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.laser_walks import chained

from uwblite import se2
from uwblite.graph.calibration import CalibrationConfig, block, odometry_indices, prior_edges, scan_indices, unknowns
from uwblite.graph.graph import Graph
from uwblite.graph.pose_edges import ScanEdges
from uwblite.graph.solver import optimize
from uwblite.pipeline import clock_offset
from uwblite.pipeline.estimate import Estimate, ScanClouds
from uwblite.pipeline.mapping_config import MappingConfig

STEPS, PERIOD = 400, 0.3
LISTED = unknowns(CalibrationConfig(), (), np.zeros(0, dtype=bool))
CALIBRATION = block(LISTED)


def walked(offsets, made_with=0.0, noise=0.002):
    """Return the estimate of a winding walk with clouds that are late by offsets (STEPS + 1,), s, and its task."""
    rng = np.random.default_rng(4)
    turn = 0.8 * np.sin(np.arange(STEPS) / 4.0) + 0.3 * rng.standard_normal(STEPS)
    twist = np.column_stack([np.full(STEPS, 0.5), np.zeros(STEPS), turn])
    truth = se2.chain(np.zeros(3), se2.exp(PERIOD * twist))
    velocity = np.concatenate([twist, twist[-1:]])
    wheels = replace(chained(truth, (0.004, 0.004, 0.004)), motion=PERIOD * twist + 0.004 * rng.standard_normal((STEPS, 3)))
    wheels = replace(wheels, motion=se2.between(truth[:-1], truth[1:]) + 0.004 * rng.standard_normal((STEPS, 3)))
    object.__setattr__(wheels, "calibration", odometry_indices(CALIBRATION, STEPS))
    seen = se2.compose(truth, se2.exp(velocity * (offsets - made_with)[:, None]))
    i = np.arange(STEPS)
    steps = ScanEdges(
        i, i + 1, se2.between(seen[:-1], seen[1:]) + noise * rng.standard_normal((STEPS, 3)),
        np.tile(np.eye(3) / noise, (STEPS, 1, 1)), velocity[:-1], velocity[1:], scan_indices(CALIBRATION), made_with,
    )  # fmt: skip
    free = np.array([u.key.kind not in ("laser_delay", "heading_scale", "odometry_scale") for u in LISTED])
    graph = Graph(truth, edges=(prior_edges(LISTED),), calibration=CALIBRATION, fixed_calibration=free)
    scans = ScanClouds(None, None, made_with)
    estimate = Estimate(graph, wheels, None, (), steps=steps, scans=scans)
    estimate = estimate.with_estimates_of(optimize(estimate.problem)[0])
    recordings = SimpleNamespace(each=[SimpleNamespace(rows=slice(0, STEPS + 1))])
    task = SimpleNamespace(config=MappingConfig(), following=lambda estimate: SimpleNamespace(recordings=recordings))
    return estimate, task


@pytest.mark.parametrize("offset", [0.02, -0.09, 0.15])
def test_a_constant_offset_is_taken(offset):
    late = clock_offset.late(*walked(np.full(STEPS + 1, offset)))
    assert late == pytest.approx(offset, abs=0.1 * abs(offset) + 0.003)


def test_what_is_left_of_it_is_counted_from_that_with_which_clouds_were_made():
    assert clock_offset.late(*walked(np.full(STEPS + 1, 0.08), made_with=0.06)) == pytest.approx(0.02, abs=0.004)
    assert clock_offset.late(*walked(np.full(STEPS + 1, 0.08), made_with=0.08)) == 0.0


@pytest.mark.parametrize("changing", ["halves", "parts", "drift"])
def test_an_offset_that_changes_is_none(changing):
    parts = np.arange(STEPS + 1) * 8 // (STEPS + 1)
    offsets = {
        "halves": np.where(parts < 4, 0.1, 0.0),
        "parts": np.array([0.1, -0.05, 0.02, 0.12, -0.1, 0.03, 0.08, -0.06])[parts],
        "drift": np.linspace(-0.1, 0.14, STEPS + 1),
    }
    assert clock_offset.late(*walked(offsets[changing])) == 0.0


def test_noise_and_a_clock_that_is_fixed_have_none():
    estimate, task = walked(np.zeros(STEPS + 1), noise=0.02)
    assert clock_offset.late(estimate, task) == 0.0
    estimate, task = walked(np.full(STEPS + 1, 0.1))
    graph = replace(estimate.graph, fixed_calibration=np.ones(len(LISTED), dtype=bool))
    assert clock_offset.late(replace(estimate, graph=graph), task) == 0.0
