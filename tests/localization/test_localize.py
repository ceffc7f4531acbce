"""Localisation: a part of a recording finds its place in the map of the whole, whatever frame that has."""

import dataclasses
import importlib.util

import numpy as np
import pytest
from conftest import ROOT
from helpers.localization_room import known_map

from uwblite import se2
from uwblite.constraints import Constraints
from uwblite.errors import Cancelled, DataError
from uwblite.io.carmen import read_log
from uwblite.io.stored_result import StoredAnchor
from uwblite.localization.localize import localize
from uwblite.mapping import build_map


@pytest.fixture(scope="module")
def earlier(room_result):
    """A map of the room; the recordings that are to be found in it have a frame of their own."""
    return room_result


def map_of(result, grid=True, **moved):
    """Return the map as a localisation knows it, with some anchors elsewhere."""
    stored = tuple(
        StoredAnchor(a.id, a.position + moved.get(f"a{a.id}", (0, 0)), a.covariance, "ok", a.bias, a.residual_rms)
        for a in result.anchors
    )
    return known_map(stored, result.grid if grid is True else grid)


def part(log, seconds=20.0):
    """Twenty seconds of it: where they begin is not said, and their odometry starts elsewhere."""
    start = float(log.odometry.stamps[0]) + 120.0
    later = log.crop(start, start + seconds)
    away = se2.compose(np.array([20.0, 7.0, -1.0]), later.odometry.poses)
    return dataclasses.replace(later, odometry=dataclasses.replace(later.odometry, poses=away))


def errors(found, earlier):
    there = se2.interpolate_trajectory(earlier.stamps, earlier.trajectory, found.stamps)
    return np.hypot(*(found.trajectory[:, :2] - there[:, :2]).T)


def test_a_part_finds_its_place_in_the_whole(log, earlier):
    found = localize(part(log), map_of(earlier))
    # Lidar noise 0.01 m, cells 0.05 m: walls lie on walls to a fraction of a cell.
    assert np.sqrt(np.mean(errors(found, earlier) ** 2)) < 0.025
    assert found.overlap > 0.9
    assert not found.doubts
    # Each pass knows the metres that the other one needs for its start.
    assert found.localized == 1.0


def test_among_people_the_walls_are_those_of_the_map(log, earlier):
    """They stand before a fifth of the rays, others at every look."""
    few = part(log)
    rng = np.random.default_rng(2)
    people = np.repeat(rng.uniform(size=(len(few.scans.ranges), few.scans.ranges.shape[1] // 10 + 1)) < 0.2, 10, axis=1)
    people = people[:, : few.scans.ranges.shape[1]]
    seen = np.where(people, rng.uniform(0.5, 0.9, people.shape) * few.scans.ranges, few.scans.ranges)
    found = localize(dataclasses.replace(few, scans=dataclasses.replace(few.scans, ranges=seen)), map_of(earlier))
    assert np.sqrt(np.mean(errors(found, earlier) ** 2)) < 0.025
    assert found.overlap == pytest.approx(1.0 - people.mean(), abs=0.03)
    assert not found.doubts


def test_without_walls_the_anchors_fix_the_place(log, earlier):
    found = localize(part(log).without(lidar=True), map_of(earlier))
    assert np.isnan(found.overlap)
    # Ranges of 0.06 m with slow errors, 244 of them: a decimetre or two.
    assert np.sqrt(np.mean(errors(found, earlier) ** 2)) < 0.25


@pytest.mark.slow
def test_anchors_of_the_map_that_are_not_heard_change_nothing(log, earlier):
    known = map_of(earlier)
    more = [StoredAnchor(f"far {k}", np.array([9.0 * k, 5.0]), np.eye(2) * 1e-4, "ok", 0.0, 0.1) for k in range(20)]
    heard = known_map(tuple(more), None).anchors
    wide = dataclasses.replace(
        known.anchors, ids=heard.ids + known.anchors.ids,
        **{
            name: np.concatenate([getattr(heard, name), getattr(known.anchors, name)])
            for name in ("positions", "bias", "rise", "sigma", "bias_sigma")
        },
    )  # fmt: skip
    few = part(log).crop(end=float(log.odometry.stamps[0]) + 140.0)
    one, other = (localize(few, dataclasses.replace(known, anchors=some)) for some in (known.anchors, wide))
    np.testing.assert_array_equal(one.trajectory, other.trajectory)


def test_a_moved_anchor_is_named_and_does_not_pull(log, earlier):
    found = localize(part(log, 45.0), map_of(earlier, aDD07=(2.0, 1.0)))
    assert any("DD07" in w.text and "moved" in w.text for w in found.warnings)
    assert np.sqrt(np.mean(errors(found, earlier) ** 2)) < 0.025


@pytest.mark.slow
def test_a_changed_place_is_doubted(log, earlier):
    rng = np.random.default_rng(1)
    other = dataclasses.replace(earlier.grid, log_odds=np.where(rng.uniform(size=earlier.grid.log_odds.shape) < 0.01, 5, -5.0))
    found = localize(part(log).crop(end=float(log.odometry.stamps[0]) + 145.0), map_of(earlier, other))
    assert any("walls do not lie" in d.text for d in found.doubts)
    # The anchors alone fix it then.
    assert np.sqrt(np.mean(errors(found, earlier) ** 2)) < 0.25


def test_a_recording_with_neither_an_anchor_of_the_map_nor_walls_is_refused(log, earlier):
    strangers = known_map((), earlier.grid)
    blind, bare = log.without(lidar=True), log.without(uwb=True, lidar=True)
    for alone, known in ((blind, strangers), (log, known_map((), None)), (bare, map_of(earlier))):
        with pytest.raises(DataError, match="has ranges to 0 of the map's anchors"):
            localize(alone, known)


@pytest.mark.slow
def test_walls_alone_find_the_place_and_it_is_reported(log, earlier):
    found = localize(part(log).without(uwb=True), map_of(earlier))
    assert np.sqrt(np.mean(errors(found, earlier) ** 2)) < 0.025
    assert any("walls alone" in w.text for w in found.warnings)
    assert not found.doubts


@pytest.mark.slow
def test_a_place_with_two_equal_halves_is_refused(log, earlier):
    """The map and a second copy of it beside it: the walls fit both."""
    grid = earlier.grid
    twice = np.concatenate([grid.log_odds, np.zeros((40, grid.log_odds.shape[1]), np.float32), grid.log_odds])
    both = dataclasses.replace(grid, geometry=dataclasses.replace(grid.geometry, rows=len(twice)), log_odds=twice)
    with pytest.raises(DataError, match="nowhere in the map for certain: "):
        localize(part(log).without(uwb=True), map_of(earlier, both))


@pytest.mark.slow
def test_covariances_are_symmetric_positive_and_the_ends_as_sure_as_the_middle(log, earlier):
    found = localize(part(log).crop(end=float(log.odometry.stamps[0]) + 150.0), map_of(earlier))
    np.testing.assert_array_equal(found.covariances, found.covariances.transpose(0, 2, 1))
    assert np.linalg.eigvalsh(found.covariances).min() > 0
    sigma = np.sqrt(np.trace(found.covariances[:, :2, :2], axis1=1, axis2=2))
    assert sigma[[0, -1]].max() < 2.0 * np.median(sigma)


def test_the_caller_may_stop_it(log, earlier):
    with pytest.raises(Cancelled, match="forwards"):
        localize(part(log), map_of(earlier), progress=lambda *_: False)


@pytest.mark.slow
def test_another_recording_through_the_same_room(tmp_path):
    spec = importlib.util.spec_from_file_location("simulate", ROOT / "tools" / "simulate.py")
    simulate = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(simulate)
    for seed in (5, 6):
        simulate.main(["lab", "--out", str(tmp_path / str(seed)), "--seed", str(seed), "--minutes", "2", "--scan-rate", "4"])
    from uwblite.io.tum import read_tum

    first = read_log(tmp_path / "5" / "run.log")
    stamps, poses = read_tum(tmp_path / "5" / "truth.tum")
    from uwblite.constraints import GivenPose

    start = GivenPose(float(first.odometry.stamps[0]), tuple(poses[0].tolist()), (1e-4, 1e-4, 1e-4))
    known = build_map(first, constraints=Constraints(poses=(start,)))
    # The map's own frame, found from its trajectory, is what the other recording is judged in.
    truth = se2.interpolate_trajectory(stamps, poses, known.stamps)
    a, b = known.trajectory[:, :2], truth[:, :2]
    p, q = a - a.mean(axis=0), b - b.mean(axis=0)
    theta = np.arctan2(np.sum(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]), np.sum(p * q))
    T = np.array([*(b.mean(axis=0) - se2.rotate(theta, a.mean(axis=0))), theta])
    found = localize(read_log(tmp_path / "6" / "run.log"), map_of(known))
    stamps, poses = read_tum(tmp_path / "6" / "truth.tum")
    there = se2.interpolate_trajectory(stamps, poses, found.stamps)[:, :2]
    error = np.hypot(*(se2.transform(T, found.trajectory[:, :2]) - there).T)
    assert np.sqrt(np.mean(error**2)) < 0.08
