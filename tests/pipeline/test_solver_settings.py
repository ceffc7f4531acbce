"""When a run's optimisations end is the user's choice."""

from dataclasses import replace

from helpers.room_recording import recording, two_rounds

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
