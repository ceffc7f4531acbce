"""What noise cannot explain is a doubt; a sound recording has none."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.laser_walks import chained
from helpers.planted_graphs import plain_ranges
from helpers.planted_tasks import estimate_of, recordings_of, task_of
from helpers.room_recording import recording, two_rounds

from uwblite import se2
from uwblite.assessment.residual_tests import (
    check_odometry,
    check_range_scatter,
    check_support,
)
from uwblite.graph.calibration import LASER, indices
from uwblite.graph.graph import Calibration, Graph
from uwblite.graph.pose_edges import RelativePoseEdges, ScanEdges
from uwblite.grid.geometry import GridGeometry
from uwblite.grid.occupancy_grid import OccupancyGrid
from uwblite.mapping import build_map


@pytest.fixture(scope="module")
def sound():
    """A round and a half."""
    return recording(two_rounds()[:2400])


def doubts(log):
    return {n.kind for n in build_map(log).doubts}


@pytest.mark.parametrize("without", [{}, {"uwb": True}, {"lidar": True}])
def test_a_sound_recording_has_no_doubts(sound, without):
    assert doubts(sound.without(**without)) == set()


@pytest.mark.parametrize("lidar", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_ranges_that_are_no_distances(lidar):
    log = recording(two_rounds())
    wild = np.random.default_rng(1).uniform(0.5, 15.0, len(log.ranges.stamps))
    result = build_map(replace(log, ranges=replace(log.ranges, ranges=wild)).without(lidar=not lidar))
    assert "range-scatter" in {n.kind for n in result.doubts}
    assert all(a.status != "ok" for a in result.anchors)


@pytest.mark.slow
def test_a_radio_whose_clock_is_seconds_late(sound):
    late = replace(sound.ranges, stamps=sound.ranges.stamps + 6.0)
    assert doubts(replace(sound, ranges=late)) == {"late-ranges"}


@pytest.mark.parametrize("without", [{}, {"uwb": True}])
def test_a_lidar_of_another_scale_contradicts_wheels_and_radio(sound, without):
    """The wheels, whose distances are those of the map at another scale, are not at fault themselves."""
    scans = replace(sound.scans, ranges=sound.scans.ranges * np.float32(1.25), range_max=7.0)
    causes = {f.kind: f.explained_by for f in build_map(replace(sound, scans=scans).without(**without)).findings}
    assert causes["scales"] == ()
    assert causes["unusual-calibration"] == ("scales",)


def test_odometry_alone_drifts(sound):
    assert doubts(sound.without(uwb=True, lidar=True)) == {"odometry-alone", "uncertain"}


def judged(slip, scans=(), lidar=True, root=(100.0, 100.0, 1000.0), loop=False):
    """Judge a chain of 80 keyframes on its true places, whose wheels slip: {step: m, m, rad} beyond the motion.

    Parameters
    ----------
    scans : keyframes between which scan edges stand, from the 20th to the 60th. root : of their information, 1/m, 1/m, 1/rad.
    loop : whether the robot stands at the 79th where it began, and a scan edge says so.
    """
    truth = np.column_stack([np.arange(80) * 0.3, np.zeros(80), np.zeros(80)])
    wheels = chained(truth, np.array([0.01, 0.01, 0.003]))
    for step, by in slip.items():
        wheels.motion[step] += by
    pairs = [(k - span, k) for span in scans for k in range(20, 60)] + [(0, 79)] * loop
    i, j = np.array(pairs, dtype=int).reshape(-1, 2).T
    none = np.zeros((len(i), 3))
    information, names = np.tile(np.diag(root), (len(i), 1, 1)), indices(Calibration(), *LASER)
    ties = ScanEdges(i, j, se2.between(truth[i], truth[j]), information, none, none, names)
    graph = Graph(truth, np.zeros((1, 2)), edges=(ties,) if len(i) else ())
    estimate = estimate_of(graph, odometry=wheels, placed=[not lidar])
    return list(check_odometry(estimate, task_of(recordings_of(truth, 50.0 + np.arange(80.0), lidar=lidar))))


LONG = dict.fromkeys(range(30, 45), (0.0, 0.0, 0.15))


@pytest.mark.parametrize(("options", "kinds"), [
    ({"scans": (1,)}, []), ({"scans": (1, 2)}, []), ({"scans": (1, 2), "root": (0.0, 100.0, 1000.0)}, ["loose-links"]),
])  # fmt: skip
def test_many_steps_that_no_scan_fixes_are_a_doubt(options, kinds):
    assert [n.kind for n in judged(LONG, **options)] == kinds


@pytest.mark.parametrize(("way", "found"), [(3.0, "doubt"), (0.4, "warning"), (0.05, None)])
def test_a_single_step_far_off_is_named_where_ranges_alone_show_it(way, found):
    notices = judged({20: (way, 0.0, 0.0)}, lidar=False)
    assert [(n.kind, n.severity) for n in notices] == ([] if found is None else [("odometry-slips", found)])
    assert all(n.figures["way"] == pytest.approx(way, abs=0.05) and abs(n.figures["turn"]) < 1e-9 for n in notices)


@pytest.mark.parametrize(("noise", "way", "found"), [
    (0.5, 3.0, ["odometry-slips"]), (0.5, 0.0, []), (20.0, 3.0, []),
])  # fmt: skip
def test_a_step_that_probably_slipped_is_compared_with_the_noise_of_the_others(noise, way, found):
    """A robot that was carried by 3 m moved farther than its wheels count; those that slip count 3 m too much.

    Where the odometry was silent it may be anywhere.
    """
    poses = np.column_stack([0.3 * np.arange(80.0), np.zeros((80, 2))])
    sigmas = np.tile([0.01, 0.01, 0.003], (79, 1))
    sigmas[40, :2] = noise
    wheels = replace(chained(poses, np.ones(3)), sqrt_information=np.eye(3) / sigmas[:, None])
    wheels.motion[40, 0] += 3.0 - way
    poses[41:, 0] += way
    estimate = estimate_of(Graph(poses, np.zeros((1, 2))), odometry=wheels)
    assert [n.kind for n in check_odometry(estimate, task_of(recordings_of(poses)))] == found


@pytest.mark.parametrize(("options", "found"), [
    ({"scans": (1,)}, []), ({"loop": True}, []), ({}, ["loose-links"]),
    ({"scans": (1,), "root": (0.0, 100.0, 100.0)}, ["loose-links"]),
])  # fmt: skip
def test_a_single_slip_is_a_doubt_beside_a_lidar_where_no_scans_tie_its_sides(options, found):
    """A scan of the step itself ties them, and so does one that ties the end to the beginning."""
    assert [n.kind for n in judged({40: (3.0, 0.0, 0.0)}, **options) if n.severity == "doubt"] == found


def test_a_slip_is_the_longest_way_and_turn_of_all_steps_that_slipped():
    (notice,) = judged({10: (0.0, 0.3, 0.1), 20: (0.4, 0.3, 0.05)}, lidar=False)
    assert notice.figures["way"] == pytest.approx(0.5, abs=0.01)
    assert notice.figures["turn"] == pytest.approx(0.1, abs=0.001)
    assert "at t = 10, 20 s" in notice.text


@pytest.mark.parametrize(("poses", "edges", "alive", "doubted"), [
    (3, (), None, True), (2, (), None, False), (3, (), False, True), (3, (), True, False), (3, ("ties",), None, False),
])  # fmt: skip
def test_a_trajectory_that_only_the_odometry_counts_is_a_doubt(poses, edges, alive, doubted):
    """From three poses on, unless a range that counts, a scan or a closure says more."""
    none = np.zeros((0, 3))
    ties = RelativePoseEdges(np.zeros(0, int), np.zeros(0, int), none, np.zeros((0, 3, 3)))
    ranges, two = None, np.zeros(2, dtype=int)
    if alive is not None:
        ranges = replace(plain_ranges(two, two, np.ones(2), 0.1), weights=np.array([0.0, float(alive)]))
    graph = Graph(np.zeros((poses, 3)), np.zeros((1, 2)), edges=(ties,) * len(edges))
    found = check_support(estimate_of(graph, ranges=ranges), task_of())
    assert [n.kind for n in found if n.severity == "doubt"] == (["odometry-alone"] if doubted else [])


@pytest.mark.parametrize(("off", "steps", "said"), [
    (0.29, 0.0, None), (0.31, 0.0, "the ranges differ from the map by 0.31 m (median), but from one to the next by 0.0"),
    (0.31, 0.2, None), (1.6, 0.6, "the ranges scatter by 1.6 m about the map: they are not distances"), (1.4, 0.6, None),
])  # fmt: skip
def test_ranges_scatter_more_than_from_one_to_the_next(off, steps, said):
    """Three anchors whose residuals, of either sign for a whole half, are off by so much; the typical one counts."""
    stamps, anchor = np.arange(600.0), np.arange(600) % 3
    rng = np.random.default_rng(0)
    # The median absolute deviation of two values, one each half, is half their distance: in sigmas 1.4826 times that.
    residuals = np.where(stamps < 300.0, -1.0, 1.0) * off / 1.4826 * np.array([1.0, 0.2, 5.0])[anchor]
    values = 10.0 + residuals + steps * rng.standard_normal(600)
    ranges = plain_ranges(np.arange(600), anchor, values, 0.1)
    doubts = scattered(replace(ranges, weights=np.where(stamps == 7.0, 0.0, 1.0), stamps=stamps), residuals)
    assert len(doubts) == (said is not None)
    assert all(said in n.text for n in doubts)


def scattered(ranges, residuals, poses=None, recording=None, grid=None):
    """Return the doubts about the scatter of ranges from poses (k, 3) of recordings (k,) on a map."""
    poses = np.zeros((len(ranges.pose), 3)) if poses is None else poses
    estimate = estimate_of(Graph(poses, np.zeros((3, 2))), ranges=ranges)
    task = task_of(recordings_of(poses, None, recording))
    return [found for found in check_range_scatter(estimate, residuals, grid, task) if found.severity == "doubt"]


def test_ranges_of_two_recordings_whose_clocks_show_the_same_do_not_scatter_from_one_to_the_next():
    """Each sees one anchor from its own place, 10 and 20 m away; the residuals are of one half a metre off."""
    stamps, recording = np.tile(np.arange(300.0), 2), np.repeat([0, 1], 300)
    off = np.where(stamps < 150.0, -0.5, 0.5)
    ranges = plain_ranges(np.arange(600), np.zeros(600, dtype=int), 10.0 + 10.0 * recording + off, 0.1)
    (doubt,) = scattered(replace(ranges, stamps=stamps), off, recording=recording)
    assert doubt.figures["short_term"] < 0.1


@pytest.mark.parametrize(("walled", "late", "free", "said"), [
    (True, 0.5, 0.0, 0), (False, 0.5, 0.0, 1), (True, 0.5, 0.5, 1), (False, 0.1, 0.0, 0),
    (True, -0.5, 0.0, 1), (True, 1.5, 0.0, 1),
])  # fmt: skip
def test_ranges_through_walls_may_be_late_where_the_map_shows_the_walls(walled, late, free, said):
    """Most of the poses stand behind a wall; ranges from there are late (or early), those in free sight are wrong or not."""
    behind = np.arange(600) >= 150
    away = np.where(behind, 8.0, 4.0)
    poses = np.column_stack([away, np.linspace(-1.0, 1.0, 600), np.zeros(600)])
    rng = np.random.default_rng(0)
    wrong = np.where(np.arange(600) % 2, free, -free)
    residuals = np.where(behind, late * np.linspace(-1.0, 3.0, 600), wrong) + 0.05 * rng.standard_normal(600)
    ranges = replace(plain_ranges(np.arange(600), np.zeros(600, dtype=int), away + residuals, 0.1), stamps=np.arange(600.0))
    geometry = GridGeometry(0.05, np.array([0.0, -5.0]), 200, 200)
    log_odds = np.zeros((200, 200), dtype=np.float32)
    log_odds[:, 120] = 5.0 * walled
    assert len(scattered(ranges, residuals, poses, grid=OccupancyGrid(geometry, log_odds))) == said
