"""When a run's optimisations end is the user's choice."""

from dataclasses import replace

import numpy as np
from helpers.laser_walks import chained
from helpers.planted_graphs import plain_ranges
from helpers.planted_tasks import estimate_of
from helpers.room_recording import recording, two_rounds

from uwblite.graph.graph import Graph
from uwblite.graph.normal_equations import NormalEquations
from uwblite.graph.solver import Optimizer, SolverConfig
from uwblite.mapping import MappingConfig, build_map
from uwblite.radio.bootstrap_attempt import BootstrapPolicy


def test_every_optimisation_of_a_run_ends_by_the_runs_settings(monkeypatch):
    """But those by which anchors are first placed: they end early, and others follow."""
    seen, optimize = [], Optimizer.optimize

    def watched(self, graph, config, *rest):
        seen.append(config)
        return optimize(self, graph, config, *rest)

    monkeypatch.setattr(Optimizer, "optimize", watched)
    log = recording(two_rounds())
    log = log.crop(end=float(log.odometry.stamps[0]) + 40.0)
    build_map(log, replace(MappingConfig(), solver=SolverConfig(gradient_tolerance=3e-9)))
    later = [config for config in seen if config != BootstrapPolicy.solver]
    assert len(later) > 20
    assert {config.gradient_tolerance for config in later} == {3e-9}


def test_an_optimizer_that_is_handed_on_analyses_a_pattern_once(monkeypatch):
    analysed, analyse = [], NormalEquations.__init__

    def counted(self, *words):
        analysed.append(self)
        analyse(self, *words)

    poses = np.column_stack([0.3 * np.arange(20.0), np.zeros(20), np.zeros(20)])
    ranges = plain_ranges(np.arange(20), np.arange(20) % 2, np.full(20, 3.0), 0.1)
    wheels = chained(poses, np.array([0.01, 0.01, 0.003]))
    anchors = np.array([[1.0, 3.0], [4.0, -3.0]])
    estimate = estimate_of(Graph(poses, anchors, edges=(ranges,)), ranges=ranges, odometry=wheels)
    monkeypatch.setattr(NormalEquations, "__init__", counted)
    optimizer, config = Optimizer(), SolverConfig()
    first = estimate.solved(config, optimizer)[0]
    once = len(analysed)
    again = first.solved(config, optimizer)[0]
    assert len(analysed) == once
    assert len(first.solved(config)) == 2
    assert len(analysed) > once
    np.testing.assert_allclose(again.graph.poses, first.graph.poses, atol=1e-3)
