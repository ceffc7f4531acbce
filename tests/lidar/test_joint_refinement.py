"""Joint refinement: pairs that see the same surfaces, noise-free rooms to a millimetre, noise stated as it is."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.laser_walks import CORRIDOR, ROOM, chained, drifted, in_map, scanned, walked
from helpers.planted import aligned_error, box
from scipy import sparse

from uwblite import se2
from uwblite.arrays import rms_length
from uwblite.graph.calibration import LASER, indices
from uwblite.graph.graph import Calibration, Graph
from uwblite.graph.marginals import marginals
from uwblite.graph.pose_edges import ScanEdges
from uwblite.graph.solver import SolverConfig
from uwblite.lidar import joint_refinement
from uwblite.lidar.cloud_rasters import ScanClouds, rasterize
from uwblite.lidar.joint_refinement import (
    RefinementConfig,
    _best_views,
    _surfaces_moved,
    choose_pairs,
    measured_again,
    refine,
    unmeasured,
    with_fewer_pairs,
)
from uwblite.lidar.scan_matching import PairFactors, match, measured, pairs_of
from uwblite.lidar.visibility import surface_cells

CONFIG = RefinementConfig()
NOISE = np.array([0.01, 0.005, 0.006])


def refined(graph, clouds, path, config=CONFIG, selections=2):
    """Return the result of choosing pairs and refining, twice as the walk does."""
    recording = np.zeros(len(clouds), dtype=np.intp)
    scans, result = ScanClouds(clouds, rasterize(clouds, 0.2 * config.first_gate, config.first_gate), 0.0), None
    for _ in range(selections):
        i, j = choose_pairs(clouds, graph.poses, path, recording, config)
        pairs = unmeasured(graph, i, j, np.zeros((len(clouds), 3)), 0.0)
        result = refine(graph, scans, pairs, config, SolverConfig())
        graph = graph.updated(result.graph.poses, graph.anchors, graph.calibration.values)
    return result


def room(seed, noise=0.0, metres=25.0):
    """Return true key poses, travelled distance and clouds of a walk in a room."""
    truth, path, _ = walked(seed, ROOM, metres, half_width=1.8, spacing=8)
    return truth, path, scanned(truth, ROOM, noise, seed, beams=400)


def test_a_noise_free_room_is_found_to_a_millimetre():
    """The wheels are exact but stated to 1 cm a step; the start is off by drift of that size. Asked to go on
    until nothing moves, the rounds end at the truth."""
    truth, path, clouds = room(1)
    start = drifted(np.random.default_rng(2), truth, NOISE)
    before = aligned_error(start.poses[:, :2], truth[:, :2])
    exact = Graph(start.poses).with_edges(chained(truth, NOISE * 10))
    result = refined(exact, clouds, path, replace(CONFIG, rounds=40, convergence=1e-5))
    after = aligned_error(result.graph.poses[:, :2], truth[:, :2])
    assert before > 0.03
    assert after < 1e-3
    heading = se2.wrap_angle(result.graph.poses[:, 2] - truth[:, 2])
    assert np.abs(heading - heading.mean()).max() < 1e-3
    assert result.sigma < 0.01
    assert result.rounds < 40


def test_noisy_clouds_and_wheels_reach_what_their_matches_allow():
    """A pose is seen by some ten pairs of a hundred points; with 1 cm of noise and a fourth of them independent that is
    0.01 sqrt(2) / sqrt(10 * 100 / 4) = 1 mm, and what loops leave over a room of 8 m is a few times that."""
    errors = []
    for seed in range(3):
        truth, path, clouds = room(10 + seed, 0.01)
        start = drifted(np.random.default_rng(seed), truth, NOISE)
        result = refined(start, clouds, path)
        errors.append(aligned_error(result.graph.poses[:, :2], truth[:, :2]))
        assert result.sigma < 0.02
        assert result.used.mean() > 0.8
    assert np.median(errors) < 0.005
    assert max(errors) < 0.01


def test_a_corridor_leaves_the_way_along_it_to_the_wheels():
    """Wheels that are 5 % long along a corridor stay so; across it and in heading the lidar has its say."""
    n = 40
    truth = np.column_stack([np.linspace(-6, 6, n), 0.2 * np.sin(np.arange(n) / 4), 0.1 * np.cos(np.arange(n) / 4)])
    clouds = scanned(truth, CORRIDOR, 0.005, 3, beams=300, reach=5.0)
    wheels = truth * [1.05, 1.0, 1.0]
    bent = wheels + np.column_stack([np.zeros(n), np.linspace(0, 0.2, n), np.linspace(0, 0.03, n)])
    graph = Graph(bent).with_edges(chained(wheels, NOISE))
    result = refined(graph, clouds, wheels[:, 0] - wheels[0, 0])
    solved = result.graph.poses
    line = np.polyfit(truth[:, 0], solved[:, 1] - truth[:, 1], 1)
    crooked = solved[:, 1] - truth[:, 1] - np.polyval(line, truth[:, 0])
    assert np.abs(crooked).max() < 0.02
    assert np.ptp(solved[:, 0]) == pytest.approx(1.05 * 12, rel=0.005)


def test_poses_that_creep_along_a_wall_move_no_surface():
    """One pair that sees a wall along x: 3 mm along it count for nothing, 3 mm across it are 3 mm; a whole turn is none."""
    hessian = np.diag([0.0, 40.0, 10.0])[None]
    factors = PairFactors(hessian, 0 * hessian, np.zeros((1, 3)), *(np.array([40]) for _ in range(4)))
    yes = np.ones(1, dtype=bool)
    for change, moved in (([0.003, 0.0, 0.0], 0.0), ([0.0, 0.003, 2 * np.pi], 0.003), ([0.0, 0.0, 0.004], 0.002)):
        assert _surfaces_moved(factors, np.array([change])) == pytest.approx(moved, abs=1e-12)
    assert _surfaces_moved(factors.rows(~yes), np.ones((0, 3))) == 0.0


def test_pairs_are_ordered_unique_and_overlap():
    truth, path, clouds = room(4)
    recording = np.zeros(len(truth), dtype=np.intp)
    i, j = choose_pairs(clouds, truth, path, recording, CONFIG)
    assert np.all(i < j)
    assert len(np.unique(i * len(truth) + j)) == len(i)
    seen = surface_cells(clouds, truth)
    common = np.asarray((seen @ seen.T).todense())
    size = np.diff(seen.indptr)
    near = np.isin(j - i, CONFIG.neighbours)
    share = common[i, j] / np.minimum(size[i], size[j])
    assert np.all(share[~near] > CONFIG.min_share)
    assert np.all(np.abs(path[i] - path[j])[~near] > CONFIG.epoch)
    for n in CONFIG.neighbours:
        assert {(a, a + n) for a in range(len(truth) - n)} <= set(zip(i.tolist(), j.tolist(), strict=True))


@pytest.mark.parametrize("partners", [0, 1, 3])
def test_the_best_views_are_those_of_a_loop(partners):
    """Of each epoch and recording the one that shares most; of these the best few, ties by number."""
    rng = np.random.default_rng(partners)
    clouds, epoch = 60, CONFIG.epoch
    seen = (rng.random((clouds, 40)) < rng.uniform(0.05, 0.5, clouds)[:, None]).astype(float)
    path, recording = np.sort(rng.uniform(0.0, 30.0, clouds)), np.repeat([0, 1], clouds // 2)
    size, expected = seen.sum(axis=1), []
    for i in range(clouds):
        best = {}
        for j in range(clouds):
            common = (seen[i] * seen[j]).sum()
            share = common / max(min(size[i], size[j]), 1)
            if abs(path[i] - path[j]) > epoch and share > CONFIG.min_share and common >= 4:
                key = path[j] // epoch, recording[j]
                best[key] = min(best.get(key, (0.0, j)), (-share, j))
        expected += [(i, j) for _, j in sorted(best.values())[:partners]]
    found = _best_views(sparse.csr_matrix(seen), path, recording, replace(CONFIG, partners=partners))
    assert list(zip(*(part.tolist() for part in found), strict=True)) == expected
    assert len(expected) > 10 * partners or not partners


def test_a_single_cloud_has_no_pair():
    pairs = choose_pairs(scanned(np.zeros((1, 3)), ROOM), np.zeros((1, 3)), np.zeros(1), np.zeros(1, dtype=np.intp), CONFIG)
    assert [part.tolist() for part in pairs] == [[], []]


def test_clouds_take_turns_at_giving_the_lines():
    """One way round only, what lines seen obliquely lean would add up over a path."""
    truth, path, clouds = room(6)
    start = Graph(truth).with_edges(chained(truth, NOISE))
    edges = refined(start, clouds, path, selections=1).edges
    for gap in CONFIG.neighbours:
        apart = np.abs(edges.i - edges.j) == gap
        assert 0.4 < np.mean(edges.i[apart] < edges.j[apart]) < 0.6


def test_no_partners_are_only_neighbours():
    truth, path, clouds = room(5)
    recording = np.zeros(len(truth), dtype=np.intp)
    i, j = choose_pairs(clouds, truth, path, recording, replace(CONFIG, partners=0))
    assert set((j - i).tolist()) == set(CONFIG.neighbours)


def test_neighbours_are_of_one_recording():
    truth, path, clouds = room(6)
    recording = (np.arange(len(truth)) >= 20).astype(np.intp)
    i, j = choose_pairs(clouds, truth, path, recording, replace(CONFIG, partners=0))
    assert np.all(recording[i] == recording[j])


def test_surface_cells_and_listed_points_do_not_depend_on_how_many_others_there_are():
    truth, _, clouds = room(4)
    own, times = np.arange(len(clouds)), 50_000 // len(clouds.points)
    few, many = surface_cells(clouds, truth), surface_cells(clouds.chosen(np.tile(own, times)), np.tile(truth, (times, 1)))
    assert few.nnz == few.sum() > 200
    assert (many != sparse.vstack([few] * times)).nnz == 0
    j = np.tile(own[::-1], 1000)
    listed = pairs_of(clouds, j, j, 7).points
    assert len(listed) > 20_000
    np.testing.assert_array_equal(listed, np.tile(pairs_of(clouds, own[::-1], own[::-1], 7).points, (1000, 1)))


def test_surface_cells_distinguish_the_sides_of_a_wall():
    walls = np.array([[-3.0, 0.0, 3.0, 0.0]])
    truth = np.array([[0.0, -1.5, 0.0], [0.0, 1.5, 0.0], [0.3, -1.4, 1.0]])
    clouds = scanned(truth, walls)
    seen = surface_cells(clouds, truth)
    common = np.asarray((seen @ seen.T).todense())
    assert common[0, 1] == 0
    assert common[0, 2] > 5
    assert seen.data.min() == seen.data.max() == 1.0
    points, _ = in_map(clouds, truth)
    assert seen.shape[0] == 3
    assert len(points) == len(clouds.points)


def test_keyframes_without_any_return_are_fixed_by_the_wheels():
    truth = np.column_stack([np.arange(10) * 0.3, np.zeros(10), np.zeros(10)])
    clouds = scanned(truth, box(400, 400))
    graph = Graph(truth).with_edges(chained(truth, NOISE))
    result = refined(graph, clouds, truth[:, 0])
    assert not result.used.any()
    np.testing.assert_allclose(result.graph.poses, truth, atol=1e-9)


def test_rounds_are_reported_and_bounded():
    truth, path, clouds = room(7, 0.01, 8.0)
    graph = drifted(np.random.default_rng(1), truth, NOISE)
    recording, reported = np.zeros(len(truth), dtype=np.intp), []
    i, j = choose_pairs(clouds, graph.poses, path, recording, CONFIG)
    config = replace(CONFIG, rounds=3)
    scans = ScanClouds(clouds, rasterize(clouds, 0.1, 0.5), 0.0)
    pairs = unmeasured(graph, i, j, np.zeros((len(truth), 3)), 0.0)
    result = refine(graph, scans, pairs, config, SolverConfig(), lambda *a: reported.append(a))
    assert result.rounds == 3
    assert reported == [(1, 3), (2, 3), (3, 3)]
    assert len(result.edges) == result.used.sum()
    again = refine(graph, scans, pairs, config, SolverConfig())
    assert again.graph.poses.tobytes() == result.graph.poses.tobytes()


def test_a_cloud_in_many_pairs_informs_each_of_them_less():
    """Its matches err alike in all of them: the variance of a match grows with half the mean number of pairs of both clouds."""
    truth, path, clouds = room(6, 0.01, 8.0)
    result = refined(Graph(truth).with_edges(chained(truth, NOISE)), clouds, path, replace(CONFIG, rounds=3), selections=1)
    pairs = [(a, b) for a, b, used in zip(result.i.tolist(), result.j.tolist(), result.used, strict=True) if used]
    number = [sum(k in pair for pair in pairs) for k in range(len(truth))]
    alike = np.array([max(0.5 * (number[a] + number[b]) / 2.0, 1.0) for a, b in zip(result.i, result.j, strict=True)])
    assert alike.max() > 1.5
    _, root = measured(result.factors, np.zeros((len(alike), 3)), result.sigma**2 * CONFIG.correlation * alike)
    sizes = [np.linalg.svd(r, compute_uv=False) for r in (root[result.used], result.edges.sqrt_information)]
    np.testing.assert_allclose(sizes[1], sizes[0], rtol=1e-6, atol=1e-6 * sizes[0].max())


def test_pairs_measured_again_say_the_same_and_less_where_points_weigh_less():
    truth, path, clouds = room(6, 0.01, 8.0)
    result = refined(Graph(truth).with_edges(chained(truth, NOISE)), clouds, path)
    scans = ScanClouds(clouds, rasterize(clouds, 0.2 * CONFIG.first_gate, CONFIG.first_gate), 0.0)
    again = [
        measured_again(result.edges, result.graph, scans, CONFIG, np.full(len(clouds.points), w)) for w in (1.0, 0.25)
    ]
    sizes = [np.linalg.norm(e.sqrt_information, axis=(1, 2)) for e in (result.edges, *again)]
    # The width of the kernel is that of the noise assumed beforehand, not of the noise learnt.
    np.testing.assert_allclose(np.median(sizes[1] / sizes[0]), 1.0, atol=0.1)
    np.testing.assert_allclose(np.median(sizes[2] / sizes[1]), 0.5, atol=0.05)
    assert rms_length(se2.between(result.edges.T_i_j, again[0].T_i_j)) < 0.002


@pytest.mark.parametrize(("convergence", "better", "rounds"), [(1e9, -np.inf, 2), (0.0, 0.9, 3), (0.0, -np.inf, 8)])
def test_rounds_end_at_the_last_gate_where_nothing_moves_or_fits_better(monkeypatch, convergence, better, rounds):
    """From the truth the first round moves no cloud by 0.04 m, so the second has the last gate; else as often as allowed."""
    monkeypatch.setattr(RefinementConfig, "creep", better)
    truth, path, clouds = room(7, 0.01, 6.0)
    config = replace(CONFIG, rounds=8, convergence=convergence)
    result = refined(Graph(truth).with_edges(chained(truth, NOISE)), clouds, path, config, selections=1)
    assert result.rounds == rounds


@pytest.mark.parametrize(("better", "gates"), [(True, [0.5, 0.12, 0.12, 0.12]), (False, [0.5, 0.35, 0.245, 0.1715]),
                                               (None, [0.5, 0.35, 0.245, 0.1715])])  # fmt: skip
def test_the_gate_shrinks_at_its_own_pace_where_a_step_failed(monkeypatch, better, gates):
    """A step that moves nothing because it failed leaves as much as before; one that was right leaves little. None: no step was
    made, for the gradient is below its tolerance."""
    truth, path, clouds = room(7, 0.0, 4.0)
    asked = []

    def recorded(raster, pairs, T_i_j, gate, *more):
        asked.append(gate)
        return match(raster, pairs, T_i_j, gate, *more)

    summary = SimpleNamespace(chi2_initial=1.0, chi2_history=[] if better is None else [0.5 if better else 1.0])
    monkeypatch.setattr(joint_refinement, "match", recorded)
    monkeypatch.setattr(RefinementConfig, "creep", -np.inf)
    monkeypatch.setattr(joint_refinement.Optimizer, "optimize", lambda self, problem, config: (problem, summary))
    graph, config = Graph(truth).with_edges(chained(truth, NOISE)), replace(CONFIG, rounds=4, convergence=0.0)
    assert refined(graph, clouds, path, config, selections=1).rounds == 4
    np.testing.assert_allclose(asked, gates)


def test_fewer_pairs_inform_nearly_as_much():
    """With a fourth of the pairs every pose has some ties still; what lies between them is a little less sure."""
    truth, path, clouds = room(5, 0.01)
    graph = Graph(truth).with_edges(chained(truth, NOISE))
    result = refined(graph, clouds, path, selections=1)
    whole = result.graph.with_edges(result.edges)
    far = np.abs(result.edges.i - result.edges.j) > 4
    fewer = with_fewer_pairs(whole, int(far.sum()) // 4)
    assert np.sum(np.abs(fewer.edges[-1].i - fewer.edges[-1].j) > 4) <= far.sum() // 4
    assert with_fewer_pairs(whole, int(far.sum())).edges[-1] is result.edges
    few, all_ = (marginals(graph).covariances.poses[1:, [0, 1, 2], [0, 1, 2]] for graph in (fewer, whole))
    ratio = np.sqrt(few / all_)
    assert np.all(np.median(ratio, axis=0) > 0.9)
    assert np.all(np.median(ratio, axis=0) < 1.7)


def test_fewer_pairs_are_every_nth_from_the_middle_of_the_first_and_weigh_as_all():
    """Steps of one keyframe for those of up to four; of 30 pairs far apart every fourth, where 8 are allowed."""
    near = [(k, k + d) for k in range(10) for d in (1, 2, 3, 4)]
    far = [(k, k + 40) for k in range(30)]
    i, j = np.array(near + far).T
    still, root = np.zeros((len(i), 3)), np.tile(np.eye(3), (len(i), 1, 1))
    edges = ScanEdges(i, j, still, root, still, still, indices(Calibration(), *LASER))
    (kept,) = with_fewer_pairs(Graph(np.zeros((80, 3)), edges=(edges,)), 8).edges
    gap = kept.j - kept.i
    assert kept.i[gap == 1].tolist() == list(range(10))
    assert kept.i[gap == 40].tolist() == [2, 6, 10, 14, 18, 22, 26]
    assert set(gap.tolist()) == {1, 40}
    assert kept.own_weights[gap == 1].sum() == pytest.approx(40.0)
    assert kept.own_weights[gap == 40].sum() == pytest.approx(30.0)


@pytest.mark.parametrize("steps", [0, 1])
def test_a_single_step_or_none_weighs_as_all_pairs_near_it(steps):
    near = [(k, k + 3) for k in range(5)] + [(20, 21)] * steps
    i, j = np.array(near + [(k, k + 40) for k in range(30)]).T
    still, root = np.zeros((len(i), 3)), np.tile(np.eye(3), (len(i), 1, 1))
    edges = ScanEdges(i, j, still, root, still, still, indices(Calibration(), *LASER))
    (kept,) = with_fewer_pairs(Graph(np.zeros((80, 3)), edges=(edges,)), 8).edges
    assert kept.own_weights[kept.j - kept.i == 1].tolist() == [6.0] * steps
