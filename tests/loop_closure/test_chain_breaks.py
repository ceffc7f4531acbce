"""Closures of places that look alike do not slide a stretch of a corridor; a wheel that slips once is believed."""

import numpy as np
import pytest
from helpers.laser_walks import chained

from uwblite import se2
from uwblite.graph.calibration import LASER, indices
from uwblite.graph.graph import Calibration, Graph
from uwblite.graph.pose_edges import RelativePoseEdges, ScanEdges
from uwblite.graph.solver import SolverConfig
from uwblite.loop_closure.chain_breaks import TiePolicy, jumps, moved_by, slid, steps_fixed
from uwblite.loop_closure.closures import Closures, LoopClosureConfig
from uwblite.loop_closure.verification import _tightened, reconcile
from uwblite.map_result import LoopClosure
from uwblite.odometry.wheels import OdometryNoiseConfig

KEYFRAMES, SLIDE = 60, 2.9
NOISE = np.array([0.02, 0.02, 0.01])


def chain():
    """Return poses (60, 3) along a corridor and back, and what the wheels count, with the robust kernel they have."""
    out = np.column_stack([np.arange(30) * 0.8, np.zeros(30), np.zeros(30)])
    truth = np.concatenate([out, np.add(out[::-1], [0.0, 0.2, np.pi])])
    wheels = chained(truth, NOISE)
    object.__setattr__(wheels, "kernel", OdometryNoiseConfig().kernel)
    return truth, wheels


def closures(pairs, truth, error):
    """Return closures between pairs of keyframes whose second pose is wrong by an error (3,) in the map."""
    i, j = np.array(pairs).T
    z = se2.between(truth[i], truth[j] + error)
    root = np.zeros((len(i), 3, 3)) + np.diag([40.0, 40.0, 200.0])
    records = tuple(LoopClosure(int(a), int(b), t, root[0], 0.01, 0.8, "accepted", "") for a, b, t in zip(i, j, z, strict=True))
    return RelativePoseEdges(i, j, z, root), records


def scans(i, truth, along):
    """Return scan edges from keyframes i to the next with a standard deviation along the corridor, m; inf: none."""
    none, i = np.zeros((len(i), 3)), np.array(i)
    root = np.zeros((len(i), 3, 3)) + np.diag([1.0 / along, 50.0, 500.0])
    return ScanEdges(i, i + 1, se2.between(truth[i], truth[i + 1]), root, none, none, indices(Calibration(), *LASER))


def moved(first, last):
    truth, wheels = chain()
    poses = truth.copy()
    poses[first : last + 1, 0] += SLIDE
    return Graph(poses, edges=(wheels,)), wheels, poses


def test_a_stretch_between_a_jump_and_the_one_back_slid():
    graph, wheels, _ = moved(35, 50)
    rows, by = jumps(wheels, graph)
    assert rows.tolist() == [34, 50]
    np.testing.assert_allclose(by, [[SLIDE, 0.0], [-SLIDE, 0.0]], atol=1e-9)
    ((first, last, size),) = slid(graph)
    assert (first, last, size) == (35, 50, pytest.approx(SLIDE))
    edges, _ = closures([(5, 40), (36, 49), (2, 57)], graph.poses, np.zeros(3))
    np.testing.assert_allclose(moved_by(edges, graph), [SLIDE, 0.0, 0.0], atol=1e-9)


def test_a_wheel_that_slips_once_slides_nothing():
    graph, wheels, _ = moved(35, KEYFRAMES)
    assert jumps(wheels, graph)[0].tolist() == [34]
    assert slid(graph) == []


def test_jumps_that_scans_measure_are_the_odometry_s():
    graph, wheels, poses = moved(35, 50)
    for along, fixing in ((0.02, True), (np.inf, False)):
        measured = graph.with_edges(wheels, scans([34, 50], poses, along))
        assert steps_fixed(measured)[[34, 50]].tolist() == [fixing] * 2
        assert len(jumps(wheels, measured)[0]) == (0 if fixing else 2)


def test_many_closures_of_a_place_that_looks_alike_are_overruled_by_the_odometry():
    truth, wheels = chain()
    true, true_records = closures([(k, 59 - k) for k in (0, 1, 2, 3, 26, 27, 28)], truth, np.zeros(3))
    false, false_records = closures([(k, 59 - k) for k in range(8, 20)], truth, np.array([SLIDE, 0.0, 0.0]))
    columns = ("i", "j", "T_i_j", "sqrt_information")
    edges = RelativePoseEdges(*(np.concatenate([getattr(true, n), getattr(false, n)]) for n in columns))
    found = Closures(edges, true_records + false_records)
    graph = Graph(truth, edges=(wheels,))
    solver, config = SolverConfig(), LoopClosureConfig()
    torn, _ = _tightened(graph, found, config, solver)
    assert np.abs(torn.poses[:, 0] - truth[:, 0]).max() > 0.8 * SLIDE
    solved, left = reconcile(graph, found, config, solver)
    assert np.hypot(*(solved.poses - truth)[:, :2].T).max() < 3.0 * 0.02 * np.sqrt(15.0)
    assert [c.outcome for c in left.candidates] == ["accepted"] * len(true_records) + ["contradicts-graph"] * len(false_records)
    assert len(left.edges) == len(true_records)


def test_closures_at_the_end_of_a_long_drift_have_weight_from_the_start():
    """A way of 400 m out and back whose turns are biased by a tenth of a sigma: closures are off by hundreds of sigmas."""
    out = np.column_stack([np.arange(500) * 0.8, np.zeros(500), np.zeros(500)])
    truth = np.concatenate([out, np.add(out[::-1], [0.0, 0.2, np.pi])])
    wheels = chained(truth, np.array([0.02, 0.02, 0.003]))
    object.__setattr__(wheels, "kernel", OdometryNoiseConfig().kernel)
    wheels.motion[:, 2] += 0.0003
    poses = [truth[0]]
    for step in wheels.motion:
        poses.append(se2.compose(poses[-1], step))
    true, records = closures([(k, 999 - k) for k in (0, 4, 8, 30)], truth, np.zeros(3))
    false, false_records = closures([(60, 930)], truth, np.array([0.0, 5.0, 0.3]))
    columns = ("i", "j", "T_i_j", "sqrt_information")
    edges = RelativePoseEdges(*(np.concatenate([getattr(true, n), getattr(false, n)]) for n in columns))
    graph = Graph(np.array(poses), edges=(wheels,))
    assert np.linalg.norm(true.residuals(graph), axis=1).min() > 300.0
    _, left = reconcile(graph, Closures(edges, records + false_records), LoopClosureConfig(), SolverConfig())
    assert [c.outcome for c in left.candidates] == ["accepted"] * 4 + ["contradicts-closures"]


@pytest.mark.parametrize(("left", "slides"), [(0.28, True), (0.32, False)])
def test_the_jump_back_leaves_less_than_a_third(left, slides):
    """Part of the first jump that is left behind the second; the size stated is the first jump's."""
    truth, wheels = chain()
    poses = truth.copy()
    poses[35:51, 0] += SLIDE
    poses[51:, 0] += left * SLIDE
    found = slid(Graph(poses, edges=(wheels,)))
    assert [(a, b) for a, b, _ in found] == ([(35, 50)] if slides else [])
    assert all(size == pytest.approx(SLIDE) for *_, size in found)


@pytest.mark.parametrize("seed", range(3))
def test_what_scan_edges_fix_is_told_step_by_step(seed):
    """By edges over up to so many keyframes that agree with the map and whose sigma is within the limit in all directions.

    Parts are tied by such edges of any length and by sound steps.
    """
    rng = np.random.default_rng(seed)
    truth, wheels = chain()
    size = 80
    i, j = rng.integers(0, KEYFRAMES, (2, size), dtype=np.intp)
    near = rng.random(size) < 0.8
    step = rng.integers(-TiePolicy.near - 1, TiePolicy.near + 2, size, dtype=np.intp)
    j = np.where(near, np.clip(i + step, 0, KEYFRAMES - 1), j)
    i, j = i[i != j], j[i != j]
    size = len(i)
    wide = rng.random((size, 3)) < 0.2
    root = np.eye(3) / (np.array(TiePolicy.clear) * np.where(wide, 1.01, 0.99))[:, None, :]
    off = np.where(rng.random(size) < 0.2, 1.05, 0.95) * LoopClosureConfig.agrees
    T = se2.between(truth[i], truth[j])
    T[:, 0] += off / root[:, 0, 0]
    none = np.zeros((size, 3))
    edges = ScanEdges(i, j, T, root, none, none, indices(Calibration(), *LASER))
    graph = Graph(truth, edges=(wheels, edges))
    agrees = np.abs(edges.residuals(graph)).max(axis=1) < LoopClosureConfig.agrees
    fixing = agrees & ~wide.any(axis=1)
    fixed = np.zeros(KEYFRAMES, dtype=bool)
    for a, b in zip(np.minimum(i, j)[fixing], np.maximum(i, j)[fixing], strict=True):
        if b - a <= TiePolicy.near:
            fixed[a:b] = True
    assert 0 < fixing.sum() < agrees.sum() < size
    np.testing.assert_array_equal(steps_fixed(graph), fixed)
