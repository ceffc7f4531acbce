"""The tools that measure: normalised errors of known covariances, recordings with fewer anchors, pages written in sections."""

import importlib
import inspect
from dataclasses import replace
from pathlib import Path

import ablation
import accuracy
import consistency
import numpy as np
import pytest
import reproduce_paper
import trials
from simulation.recording import Settings

from uwblite.config import override
from uwblite.evaluation.trajectory import evaluate_trajectory
from uwblite.mapping import MappingConfig, build_map
from uwblite.pipeline.mapping_config import preset

SHORT = Settings(world="room", seed=3, minutes=0.6, scan_rate=5.0)
COARSE = ("grid.resolution=0.2",)


@pytest.fixture(scope="module")
def trial():
    return trials.made(SHORT)


@pytest.fixture(scope="module")
def result(trial):
    return build_map(trial.log, override(MappingConfig(), COARSE))


def test_normalised_errors_of_true_covariances_are_chi_square():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(3, 3))
    errors = rng.standard_normal((4000, 3)) @ root.T
    values = consistency.nees(errors, np.tile(root @ root.T, (4000, 1, 1)))
    # The mean of 4,000 values of variance 6 is known to 0.04.
    assert values.mean() == pytest.approx(3.0, abs=0.16)


def test_errors_are_taken_in_the_frame_of_the_first_pose(trial, result):
    """The frame of the truth does not matter; an error of the first pose would show in all others."""
    one = consistency.compare("", result, trial)
    assert one.poses.shape == one.heading.shape == (len(result.keyframe_stamps) - 1,)
    assert len(one.anchors) == sum(a.status == "ok" for a in result.anchors)
    assert one.error > evaluate_trajectory(result.stamps, result.trajectory, trial.stamps, trial.poses).ate.mean * 0.5
    turned = replace(result, keyframe_covariances=4.0 * result.keyframe_covariances)
    np.testing.assert_allclose(consistency.compare("", turned, trial).poses, one.poses / 4.0)


def test_consistency_takes_any_world_with_other_sensors():
    both = consistency.settings_of("warehouse, one anchor, no lidar")
    assert (both.world, both.anchors, both.without, both.speed) == ("warehouse", 1, ("laser",), 0.4)
    assert consistency.settings_of("hall, bad wheels") is consistency.RECORDINGS["hall, bad wheels"]
    assert consistency.settings_of("hall, no lidar") == consistency.RECORDINGS["hall, no lidar"]
    assert consistency.settings_of("tunnel, no UWB").without == ("uwb",)
    with pytest.raises(KeyError):
        consistency.settings_of("hall, no wheels")


def test_consistency_goes_on_where_an_earlier_call_stopped(tmp_path, monkeypatch, capsys):
    """Each world and seed is mapped once; a world that needs it gets a longer recording."""
    asked = []

    def work(task):
        asked.append((task.name, task.settings.seed, task.settings.minutes))
        some = np.ones(3)
        return consistency.Consistency(task.name, some, some, some, some, 0.1, 0.1, 0, False)

    monkeypatch.setattr(consistency, "work", work)
    call = ["--only", "warehouse", "--first", "5", "--minutes", "2", "--keep", str(tmp_path / "rows"), "--jobs", "1", "--print"]
    for runs in ("1", "3"):
        assert consistency.main([*call, "--runs", runs]) == 0
    assert asked == [("warehouse", seed, 6.0) for seed in (5, 6, 7)]
    assert "| warehouse | 3 |" in capsys.readouterr().out


def test_a_trial_is_judged_by_all_figures(trial, result):
    found = trials.judged(result, trial)
    assert 0.0 < found.ate < 0.1
    assert found.closures[0] <= found.closures[1]
    assert {i for i, _ in found.anchor_errors} == set(trial.anchors)
    assert len(found.pairs) == 3
    assert found.drawn < 0.1


def test_fewer_anchors_are_as_if_the_others_had_not_been_there(trial):
    some = reproduce_paper.with_anchors(trial, (2, 4))
    ids = list(trial.anchors)
    assert set(some.anchors) == set(some.log.ranges.anchor_ids) == {ids[1], ids[3]}
    for name in some.anchors:
        kept, all_of_them = (
            t.log.ranges.ranges[t.log.ranges.anchor == t.log.ranges.anchor_ids.index(name)] for t in (some, trial)
        )
        np.testing.assert_array_equal(kept, all_of_them)
    assert reproduce_paper.with_anchors(trial, ()) is trial


def test_rays_can_be_given_as_of_one_time(trial):
    flat = ablation.flat(trial.log).scans
    middle = trial.log.scans.stamps + 0.5 * trial.log.scans.time_increment * (trial.log.scans.ranges.shape[1] - 1)
    np.testing.assert_allclose(flat.stamps, middle)
    assert flat.time_increment == 0.0


def test_every_setting_that_the_tools_change_exists():
    for row in accuracy.ROWS.values():
        override(MappingConfig(), row.changes)
    args = type("Args", (), {"quick": False, "seeds": 1})()
    for task in reproduce_paper.planned(args, Path()):
        for run in task.runs:
            override(preset(run.preset), run.changes)


def test_false_ranges_are_put_among_the_measurements(result):
    rng = np.random.default_rng(0)
    clean = accuracy.plain(result.graph)
    spoilt = accuracy.wronged(result.graph, rng)
    assert all(e.kernel.name == "none" for e in clean.edges)
    pairs = [(a, b) for a, b in zip(clean.edges, spoilt.edges, strict=True) if type(a).__name__ == "RangeEdges"]
    assert np.mean(pairs[0][0].ranges != pairs[0][1].ranges) == pytest.approx(0.3, abs=0.1)


def test_sections_of_a_page_are_replaced_and_the_rest_is_left(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# Title\n")
    trials.write_section(page, "one", "first")
    trials.write_section(page, "two", "second")
    whole = page.read_text()
    trials.write_section(page, "one", "first")
    assert page.read_text() == whole
    trials.write_section(page, "one", r"anew \1")
    assert r"anew \1" in page.read_text()
    assert "first" not in page.read_text()
    assert page.read_text().startswith("# Title")
    assert page.read_text().index("anew") < page.read_text().index("second")


def test_tables_report_what_is_not_known():
    assert trials.table(["a", "b"], [[1, float("nan")], ["x", 0.12345]]) == "| a | b |\n|---|---|\n| 1 | - |\n| x | 0.123 |\n"


@pytest.mark.parametrize("name", list(ablation.INGREDIENTS)[1:])
def test_every_ingredient_that_the_ablation_leaves_out_exists(name):
    """Its settings are settings, and its functions are functions, which stand again afterwards."""
    how = ablation.INGREDIENTS[name]
    override(MappingConfig(), how.settings)
    assert how.settings or how.patches or how.log is not None

    def present():
        found = []
        for where, _ in how.patches:
            module, _, function = where.rpartition(".")
            found.append(getattr(importlib.import_module(f"uwblite.{module}"), function))
        return found

    before = present()
    with ablation.left_out(name):
        assert not any(own is other for own, other in zip(present(), before, strict=True))
        for other, own in zip(present(), before, strict=True):
            inspect.signature(other).bind(*inspect.signature(own).parameters)
    assert all(own is other for own, other in zip(present(), before, strict=True))


def test_the_ablation_names_the_worst_tenth_and_new_doubts():
    base, other = list(ablation.INGREDIENTS)[:2]
    found = {
        (name, 1, without): ablation.Outcome(error * (1.0 if without == base else factor), nan, nan, doubts * (without != base))
        for name, error, factor, doubts in (("lab", 0.01, 1.0, ()), ("hall", 0.02, 4.0, ("uncertain",)))
        for without in (base, other)
        for nan in [float("nan")]
    }
    row = next(line for line in ablation.document(found).splitlines() if line.startswith(f"| {other} "))
    assert row.split("|")[2:6] == [" 2 ", " 2.00 ", " 4.00 ", " hall 0.020 -> 0.080 "]
    assert row.split("|")[-2] == " 1 "


def test_perturbed_runs_of_a_recording_are_one_row():
    """The worst and the mean are of the perturbed runs alone; a doubt names the run that has it."""
    runs = [(0.1, []), (0.2, []), (0.4, ["uncertain", "no-closure"])]
    row = accuracy.row_of_runs(runs, "0.3", [True, True, False])
    assert row == [0.1, "0.3", "yes", "1 of 2", pytest.approx(0.3), 0.4, "uncertain, no-closure (perturbed 2)"]
    assert accuracy.row_of_runs([(0.5, ["mirrored"])], "0.3", [False]) == [0.5, "0.3", "**no**", "-", "-", "-", "mirrored"]


def test_recordings_that_no_part_has_are_named(capsys):
    with pytest.raises(SystemExit):
        accuracy.main(["simulated", "--only", "hall,bungalow", "--print"])
    assert "bungalow" in capsys.readouterr().err
