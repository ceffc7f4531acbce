"""Localisation: a part of a recording finds its place in the map of the whole, whatever frame that has."""

import dataclasses
import importlib.util

import numpy as np
import pytest
from conftest import ROOT

from uwblite import se2
from uwblite.constraints import Constraints, GivenAnchor
from uwblite.errors import DataError
from uwblite.io.carmen import read_log
from uwblite.localization.localize import localize
from uwblite.mapping import MappingConfig, build_map


@pytest.fixture(scope="module")
def earlier(log):
    """A map of the room in a frame of its own."""
    start = float(log.odometry.stamps[0])
    from uwblite.constraints import GivenPose

    return build_map(log, constraints=Constraints(poses=(GivenPose(start, (5.0, -3.0, 2.0), (1e-3, 1e-3, 1e-3)),)))


def anchors_of(result, **moved):
    known = (
        GivenAnchor(a.id, tuple(np.add(a.position, moved.get(f"a{a.id}", (0, 0))).tolist()), 0.1, movable=True)
        for a in result.anchors
    )
    return Constraints(anchors=tuple(known))


def part(log):
    """Seventy seconds of it: where they begin is not said, and their odometry starts elsewhere."""
    start = float(log.odometry.stamps[0]) + 120.0
    later = log.crop(start, start + 70.0)
    away = se2.compose(np.array([20.0, 7.0, -1.0]), later.odometry.poses)
    return dataclasses.replace(later, odometry=dataclasses.replace(later.odometry, poses=away))


def errors(found, earlier):
    there = se2.interpolate_trajectory(earlier.stamps, earlier.trajectory, found.result.stamps)
    return np.hypot(*(found.result.trajectory[:, :2] - there[:, :2]).T)


def test_a_part_finds_its_place_in_the_whole(log, earlier):
    found = localize(part(log), anchors_of(earlier), earlier.grid)
    # Lidar noise 0.01 m, cells 0.05 m: walls lie on walls to a fraction of a cell.
    assert np.sqrt(np.mean(errors(found, earlier) ** 2)) < 0.025
    assert found.overlap > 0.9
    assert not found.result.doubts
    assert found.result.stages[-1].name == "walls"


def test_without_walls_the_anchors_fix_the_place(log, earlier):
    found = localize(part(log).without(lidar=True), anchors_of(earlier), earlier.grid)
    assert np.isnan(found.overlap)
    # Ranges of 0.06 m with slow errors, 366 of them: a decimetre or two.
    assert np.sqrt(np.mean(errors(found, earlier) ** 2)) < 0.25


def test_a_moved_anchor_is_named_and_does_not_pull(log, earlier):
    found = localize(part(log), anchors_of(earlier, aDD07=(2.0, 1.0)), earlier.grid)
    assert any("DD07" in w.text and "moved" in w.text for w in found.result.warnings)
    assert np.sqrt(np.mean(errors(found, earlier) ** 2)) < 0.025


def test_a_changed_place_is_doubted(log, earlier):
    rng = np.random.default_rng(1)
    other = dataclasses.replace(earlier.grid, log_odds=np.where(rng.uniform(size=earlier.grid.log_odds.shape) < 0.01, 5, -5.0))
    found = localize(part(log), anchors_of(earlier), other)
    assert any("walls do not lie" in d.text for d in found.result.doubts)
    np.testing.assert_array_equal(found.correction, 0)


def test_a_recording_with_neither_an_anchor_of_the_map_nor_walls_is_refused(log, earlier):
    strangers = Constraints(anchors=(GivenAnchor("X", (0, 0)), GivenAnchor("Y", (1, 1))))
    blind, bare = log.without(lidar=True), log.without(uwb=True, lidar=True)
    for alone, grid in ((blind, earlier.grid), (log, None), (bare, earlier.grid)):
        with pytest.raises(DataError, match="has ranges to 0 of the map's anchors"):
            localize(alone, strangers, grid)


def test_walls_alone_find_the_place_and_it_is_reported(log, earlier):
    found = localize(part(log).without(uwb=True), anchors_of(earlier), earlier.grid)
    assert np.sqrt(np.mean(errors(found, earlier) ** 2)) < 0.025
    assert any("walls alone" in w.text for w in found.result.warnings)
    assert not found.result.doubts


@pytest.mark.slow
def test_a_place_with_two_equal_halves_is_doubted(log, earlier):
    """The map and a second copy of it beside it: the walls fit both."""
    grid = earlier.grid
    twice = np.concatenate([grid.log_odds, np.zeros((40, grid.log_odds.shape[1]), np.float32), grid.log_odds])
    both = dataclasses.replace(grid, geometry=dataclasses.replace(grid.geometry, rows=len(twice)), log_odds=twice)
    found = localize(part(log).without(uwb=True), anchors_of(earlier), both)
    assert any("elsewhere" in d.text for d in found.result.doubts)


@pytest.mark.slow
def test_covariances_and_anchors_move_along(log, earlier):
    found = localize(part(log), anchors_of(earlier), earlier.grid, MappingConfig())
    assert np.all(np.linalg.eigvalsh(found.result.keyframe_covariances) > -1e-12)
    here = {a.id: a.position for a in found.result.anchors}
    for anchor in earlier.anchors:
        assert np.hypot(*(here[anchor.id] - anchor.position)) < 0.35
    assert found.result.grid is None


@pytest.mark.slow
def test_another_recording_through_the_same_room(tmp_path):
    spec = importlib.util.spec_from_file_location("simulate", ROOT / "tools" / "simulate.py")
    simulate = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(simulate)
    for seed in (5, 6):
        simulate.main(["lab", "--out", str(tmp_path / str(seed)), "--seed", str(seed), "--minutes", "6", "--scan-rate", "5"])
    from uwblite.io.tum import read_tum

    first = read_log(tmp_path / "5" / "run.log")
    stamps, poses = read_tum(tmp_path / "5" / "truth.tum")
    from uwblite.constraints import GivenPose

    start = GivenPose(float(first.odometry.stamps[0]), tuple(poses[0].tolist()), (1e-4, 1e-4, 1e-4))
    known = build_map(first, constraints=Constraints(poses=(start,)))
    # The map's own frame, found from its trajectory, is what the other drive is judged in.
    truth = se2.interpolate_trajectory(stamps, poses, known.stamps)
    a, b = known.trajectory[:, :2], truth[:, :2]
    p, q = a - a.mean(axis=0), b - b.mean(axis=0)
    theta = np.arctan2(np.sum(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]), np.sum(p * q))
    T = np.array([*(b.mean(axis=0) - se2.rotate(theta, a.mean(axis=0))), theta])
    found = localize(read_log(tmp_path / "6" / "run.log"), anchors_of(known), known.grid)
    stamps, poses = read_tum(tmp_path / "6" / "truth.tum")
    there = se2.interpolate_trajectory(stamps, poses, found.result.stamps)[:, :2]
    error = np.hypot(*(se2.transform(T, found.result.trajectory[:, :2]) - there).T)
    assert np.sqrt(np.mean(error**2)) < 0.08
