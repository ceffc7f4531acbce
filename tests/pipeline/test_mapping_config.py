"""The presets: settings, and what a run with the paper's does and leaves out."""

from dataclasses import replace

import numpy as np
import pytest

from uwblite.config import from_dict, override, to_dict
from uwblite.errors import ConfigError
from uwblite.evaluation.trajectory import evaluate_trajectory
from uwblite.graph.pose_edges import OdometryEdges
from uwblite.graph.range_edges import RangeEdges
from uwblite.io.tum import read_tum
from uwblite.mapping import MappingConfig, build_map
from uwblite.pipeline.mapping_config import PRESETS, preset


@pytest.mark.parametrize(
    "name",
    [
        "ranges.correlation_length", "ranges.min_sigma", "trilateration.raster", "trilateration.bias_sigma",
        "refinement.first_gate",
    ],
)
def test_what_is_divided_by_is_not_zero(name):
    for value in ("0", "-0.0" if not name.endswith("raster") else "-1"):
        with pytest.raises(ConfigError, match=f"{name} = .* is out of range"):
            override(MappingConfig(), [f"{name}={value}"])


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_settings_that_survive_a_file(name):
    config = preset(name)
    assert from_dict(MappingConfig, to_dict(config)) == config


def test_the_default_changes_nothing_and_others_are_unknown():
    assert preset("default") == MappingConfig()
    with pytest.raises(ConfigError, match="unknown preset 'best'; choose default or paper"):
        preset("best")


def test_the_paper_s_figures_are_in_its_preset():
    paper = preset("paper")
    assert paper.submaps.epsilon == 9.0
    assert paper.icp.max_correspondence_distance == 0.1
    assert (paper.icp.fitness_sigma, paper.icp.max_iterations) == (0.1, 300)
    assert set(to_dict(paper.calibration).values()) == {0.0}


@pytest.fixture(scope="module")
def result(log):
    # In a small room a sub-map of 9 m would be the whole of a lap.
    return build_map(log.crop(0.0, 100.0), replace(preset("paper"), submaps=replace(preset("paper").submaps, epsilon=3.0)))


def test_the_paper_s_run_is_plain(result):
    assert result.calibration == ()
    assert [e.kernel.name for e in result.graph.edges] == ["none"] * len(result.graph.edges)
    radio = next(e for e in result.graph.edges if isinstance(e, RangeEdges))
    np.testing.assert_array_equal(radio.sigma, 0.1)
    assert {type(e).__name__ for e in result.graph.edges} <= {"OdometryEdges", "RangeEdges", "RelativePoseEdges"}
    names = [s.name for s in result.stages]
    assert [n for n in names if "track" in n or "joint" in n] == []
    assert [n for n in names if "optimisation" in n] == ["first optimisation", "second optimisation 1"]
    assert "loop closure 1" in names
    assert "loop closure 2" not in names


def test_the_paper_s_run_keeps_every_candidate_and_adds_the_accepted(result):
    assert any(c.accepted for c in result.closures)
    assert all(c.reason for c in result.closures)
    added = [e for e in result.graph.edges if not isinstance(e, OdometryEdges | RangeEdges)]
    assert len(added[0]) == sum(c.accepted for c in result.closures)
    (figures,) = [stage.figures for stage in result.stages if stage.name == "loop closure 1"]
    assert (figures["candidates"], figures["accepted"]) == (len(result.closures), len(added[0]))
    assert figures["submaps"] > 1


def test_the_paper_s_run_is_a_map(result, room_log):
    """Ranges with biases and multipath of 6 cm, fixed anchors' biases uncorrected: a decimetre or two."""
    errors = evaluate_trajectory(result.stamps, result.trajectory, *read_tum(room_log.parent / "room" / "truth.tum"))
    assert errors.ate.rmse < 0.2
    assert len(result.grid.occupied_points()) > 300


def test_absurd_readings_count_for_nothing_even_squared(log, result):
    spoilt = log.ranges.ranges.copy()
    # No two alike: one that returns is a mark and left out before.
    spoilt[::9], spoilt[4::9] = 0.0, 1e4 + np.arange(len(spoilt[4::9]))
    radio = next(
        e
        for e in build_map(
            replace(log, ranges=replace(log.ranges, ranges=spoilt)), replace(preset("paper"), use_lidar=False)
        ).graph.edges
        if isinstance(e, RangeEdges)
    )
    np.testing.assert_array_equal(radio.weights[::9], 0.0)
    np.testing.assert_array_equal(radio.weights[4::9], 0.0)


@pytest.mark.parametrize("off", [{"use_uwb": False}, {"use_loops": False}, {"use_uwb": False, "use_loops": False}])
def test_the_methods_of_table_1_run(log, off):
    """Odometry with closures, odometry with UWB, odometry alone."""
    result = build_map(log.crop(0.0, 60.0), replace(preset("paper"), **off))
    assert result.grid is not None
    assert (len(result.anchors) == 0) == ("use_uwb" in off)
    assert "use_loops" not in off or result.closures == ()
