"""Loop closures: planted ones are accepted, false ones rejected for a stated reason, contradicting ones dropped."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.laser_walks import drifted, scanned, walked
from helpers.planted import chain
from helpers.planted_graphs import relative_edges
from scipy.spatial import cKDTree

from uwblite import se2
from uwblite.graph.marginals import JointCovariance
from uwblite.graph.pose_edges import RelativePoseEdges
from uwblite.graph.robust import Kernel
from uwblite.graph.solver import SolverConfig, optimize
from uwblite.lidar.correlative_matching import CorrelativeConfig
from uwblite.lidar.submaps import SubmapConfig, build
from uwblite.loop_closure.candidates import Candidates, propose
from uwblite.loop_closure.closures import Closures, LoopClosureConfig, merged, no_closures
from uwblite.loop_closure.matching import ClosureMatches
from uwblite.loop_closure.verification import _judge, find, reconcile, without_look_alikes
from uwblite.map_result import LoopClosure

PERIOD = 1.2
TWINS = np.concatenate(
    [
        [[-26.0, -2.0, 26.0, -2.0], [26.0, 2.0, -26.0, 2.0]],
        *([[PERIOD * k, 2.0, PERIOD * k, 1.2], [PERIOD * k, -2.0, PERIOD * k, -1.2]] for k in range(-20, 21)),
    ]
)
"""A corridor with equal pillars all along."""
SOLVER, SEARCH = SolverConfig(), CorrelativeConfig()
CONFIG = LoopClosureConfig()


NOISE = np.array([0.01, 0.005, 0.006])


@pytest.fixture(scope="module")
def hall():
    """A walk of 60 m in the hall, its drifting chain, its sub-maps and what was proposed."""
    truth, path, clouds = walked(3)
    graph = drifted(np.random.default_rng(4), truth, NOISE)
    recording = np.zeros(len(truth), dtype=np.intp)
    pieces = build(clouds, graph.poses, path, recording, SubmapConfig(epsilon=4.0))
    covariances = JointCovariance(graph, pieces.reference)
    proposed = propose(graph, covariances, pieces, recording, set(), True, CONFIG)
    return truth, graph, covariances, pieces, recording, proposed


@pytest.fixture(scope="module")
def closures(hall):
    return find(hall[5], hall[3], CONFIG, SEARCH)


def test_candidates_are_pairs_of_different_places_in_time_with_the_graph_s_guess(hall):
    _, graph, covariances, pieces, _, candidates = hall
    assert len(candidates.target) > 5
    assert np.all(candidates.source - candidates.target > 1)
    i, j = pieces.reference[candidates.target], pieces.reference[candidates.source]
    np.testing.assert_allclose(candidates.guess, se2.between(graph.poses[i], graph.poses[j]))
    np.testing.assert_allclose(candidates.covariance, covariances.relative(i, j))
    longest = np.sqrt(np.linalg.norm(candidates.covariance[:, :2, :2], 2, axis=(1, 2)))
    np.testing.assert_allclose(candidates.spread, 3.0 * longest)
    pairs = list(zip(candidates.target.tolist(), candidates.source.tolist(), strict=True))
    assert len(set(pairs)) == len(pairs)
    assert len(pairs) <= 2 * CONFIG.partners * len(pieces)


def test_where_nothing_is_near_nothing_is_proposed(hall):
    _, graph, covariances, pieces, recording, _ = hall
    none = propose(graph, covariances, pieces, recording, set(), True, replace(CONFIG, reach=0.0, search_limit=0.0))
    assert [getattr(none, name).shape for name in ("target", "source", "guess", "covariance", "spread")] == [
        (0,), (0,), (0, 3), (0, 3, 3), (0,)
    ]  # fmt: skip


def test_what_was_tried_is_not_proposed_again(hall):
    _, graph, covariances, pieces, recording, candidates = hall
    tried = candidates.names(CONFIG)
    again = propose(graph, covariances, pieces, recording, tried, True, CONFIG)
    assert not tried & again.names(CONFIG)


def test_neighbours_in_time_are_candidates_only_across_recordings(hall):
    _, graph, covariances, pieces, recording, _ = hall
    half = (np.arange(len(recording)) >= pieces.first[len(pieces) // 2]).astype(np.intp)
    candidates = propose(graph, covariances, pieces, half, set(), True, replace(CONFIG, partners=99))
    close = candidates.source - candidates.target == 1
    assert np.all(half[pieces.reference[candidates.target[close]]] != half[pieces.reference[candidates.source[close]]])


GOOD = {"share": 0.9, "rms": 0.02, "found": True, "through": 0.0, "second": 0.3, "net": np.inf, "spread": 7.0, "off": 0.0,
        "constrained": True, "long": False, "along": 1e4, "strength": 1e4}  # fmt: skip
"""Figures of a match that no rule objects to, found by a search."""


@pytest.mark.parametrize(("figures", "outcome"), [
    ({}, "accepted"),
    ({"found": False}, "not-found"),
    ({"share": CONFIG.overlap_after_search - 0.001}, "few-matches"),
    ({"share": CONFIG.overlap - 0.001, "spread": 0.0}, "few-matches"),
    ({"share": CONFIG.overlap + 0.001, "spread": 0.0}, "accepted"),
    ({"rms": CONFIG.sigma + 1e-4}, "far-matches"),
    ({"through": CONFIG.through + 0.001}, "free-space-violation"),
    ({"along": 0.0}, "accepted"),
    ({"along": 0.0, "strength": 0.9}, "degenerate"),
    ({"along": 0.0, "strength": 1.1}, "accepted"),
    ({"second": CONFIG.uniqueness + 0.001}, "ambiguous"),
    ({"second": CONFIG.uniqueness + 0.001, "spread": 0.0}, "accepted"),
    ({"net": CONFIG.net_overlap - 0.001, "spread": 20.0}, "few-matches"),
    ({"net": CONFIG.net_overlap + 0.001, "share": 0.2, "spread": 20.0, "long": True}, "accepted"),
    ({"off": 0.1 * CONFIG.agrees * 1.01}, "contradicts-graph"),
    ({"off": 0.1 * CONFIG.agrees * 0.97}, "accepted"),
    ({"off": 5.0, "constrained": False}, "accepted"),
])  # fmt: skip
def test_each_rule_rejects_by_its_own_limit(figures, outcome):
    """A guess known to 0.1 m and 0.1 rad, a measurement to 0.01 where the matched surfaces see that."""
    f = {**GOOD, **figures}
    best = SimpleNamespace(share=np.array([f["share"]]), rms=np.array([f["rms"]]))
    fits = ClosureMatches(best, **{name: np.array([f[name]]) for name in ("found", "second", "through", "net")})
    guess, covariance = np.array([[f["off"], 0.0, 0.0]]), 0.01 * np.eye(3)[None]
    spread = np.array([f["spread"]])
    candidates = Candidates(np.array([0]), np.array([5]), guess, covariance, spread, f["constrained"], f["long"])
    root = np.sqrt(np.diag([f["along"], f["strength"], 1e4]))[None]
    ((found, reason),) = _judge(candidates, fits, np.zeros((1, 3)), root, CONFIG)
    assert found == outcome
    assert reason


def true_overlap(hall, candidates) -> np.ndarray:
    """Return the share (c,) of the source's points that lie within 0.15 m of the target's, both at their true poses."""
    pieces, share = hall[3], []
    for a, b, pose in zip(candidates.target, candidates.source, true_poses(hall, candidates), strict=True):
        target, source = pieces.clouds.cloud(a)[0], se2.transform(pose, pieces.clouds.cloud(b)[0])
        share.append(np.mean(cKDTree(target).query(source)[0] < 0.15))
    return np.array(share)


def test_true_closures_are_accepted_and_measure_the_truth(hall, closures):
    """Of the pairs that truly overlap most are found; nothing accepted is wrong, and errors are as large as stated."""
    truth, candidates = hall[0], hall[5]
    edges = closures.edges
    assert len(closures.candidates) == len(candidates.target)
    assert sum(c.accepted for c in closures.candidates) == len(edges)
    accepted = np.array([c.accepted for c in closures.candidates])
    share = true_overlap(hall, candidates)
    assert np.sum(share > 0.7) > 10
    assert accepted[share > 0.7].mean() > 0.7
    error = se2.between(se2.between(truth[edges.i], truth[edges.j]), edges.T_i_j)
    # A sub-map of 4 m bends with the chain: its ends lie off its middle by up to sqrt(2 m / 0.3 m) steps of noise.
    bent = np.sqrt(2.0 / 0.3) * (NOISE[:2].max() + 2.0 * NOISE[2])
    assert np.hypot(error[:, 0], error[:, 1]).max() < 3 * bent
    assert np.hypot(error[:, 0], error[:, 1]).max() < 0.3
    assert np.abs(error[:, 2]).max() < 3 * np.sqrt(2.0 / 0.3) * NOISE[2]


def test_every_candidate_has_its_record(closures):
    for c in closures.candidates:
        assert c.reason
        assert 0.0 <= c.overlap <= 1.0
        assert np.all(np.linalg.eigvalsh(c.information) >= -1e-6 * np.trace(c.information))
        if c.accepted:
            assert c.fitness <= CONFIG.sigma
            assert c.overlap >= CONFIG.overlap


def test_closures_take_the_drift_out(hall, closures):
    truth, graph = hall[0], hall[1]
    solved, left = reconcile(graph, closures, CONFIG, SOLVER)
    assert solved.edges == graph.edges
    before = np.hypot(*(graph.poses - truth)[:, :2].T)
    after = np.hypot(*(solved.poses - truth)[:, :2].T)
    assert np.sqrt(np.mean(after**2)) < 0.5 * np.sqrt(np.mean(before**2))
    assert len(left.edges) >= 0.8 * len(closures.edges)


def given(hall, pairs, guess, sigma) -> Candidates:
    """Return candidates for pairs (c, 2) of sub-maps with guesses (c, 3) stated to be right to sigma (3,)."""
    covariance = np.tile(np.diag(np.asarray(sigma) ** 2), (len(pairs), 1, 1))
    target, source = np.asarray(pairs).T
    return Candidates(target, source, guess, covariance, np.full(len(pairs), 3.0 * max(sigma[:2])))


def true_poses(hall, candidates) -> np.ndarray:
    truth, pieces = hall[0], hall[3]
    return se2.between(truth[pieces.reference[candidates.target]], truth[pieces.reference[candidates.source]])


def accepted_pairs(hall, closures) -> np.ndarray:
    candidates = hall[5]
    good = [k for k, c in enumerate(closures.candidates) if c.accepted]
    return np.column_stack([candidates.target, candidates.source])[good]


def test_a_match_that_the_graph_rules_out_is_rejected(hall, closures):
    """A guess that is off by 0.25 m but stated to 1 cm: the match is right, and one of the two must be wrong."""
    pairs = accepted_pairs(hall, closures)
    one = given(hall, pairs, np.zeros((len(pairs), 3)), [0.01, 0.01, 0.004])
    guess = true_poses(hall, one) + np.array([0.18, 0.18, 0.0])
    found = find(replace(one, guess=guess), hall[3], CONFIG, SEARCH)
    assert not any(c.accepted for c in found.candidates)
    assert sum("Mahalanobis" in c.reason for c in found.candidates) > 0.6 * len(pairs)


def test_sub_maps_of_different_places_are_rejected_with_a_reason(hall):
    """Pairs that have no surface in common, claimed to lie on top of each other and stated to 0.1 m."""
    truth, pieces = hall[0], hall[3]
    a, b = np.triu_indices(len(pieces), 2)
    apart = np.hypot(*(truth[pieces.reference[a], :2] - truth[pieces.reference[b], :2]).T) > 6.0
    pairs = np.column_stack([a, b])[apart]
    assert len(pairs) >= 5
    rng = np.random.default_rng(9)
    guess = np.column_stack([rng.normal(0, 0.3, (len(pairs), 2)), rng.uniform(-3, 3, len(pairs))])
    found = find(given(hall, pairs, guess, [0.1, 0.1, 0.05]), pieces, CONFIG, SEARCH)
    assert len(found.edges) == 0
    assert all(c.reason and not c.accepted for c in found.candidates)


@pytest.mark.parametrize("lost", [slice(None), slice(1, None)])
def test_where_the_search_finds_no_place_at_all_that_is_the_reason(hall, closures, lost):
    pairs = accepted_pairs(hall, closures)[:4]
    one = given(hall, pairs, np.zeros((len(pairs), 3)), [0.5, 0.5, 0.15])
    guess = true_poses(hall, one)
    guess[lost, 0] += 200.0
    found = find(replace(one, guess=guess), hall[3], CONFIG, SEARCH)
    assert [c.reason for c in found.candidates][lost] == ["the search found no place for it"] * len(pairs[lost])
    assert not any(c.accepted for c in found.candidates[lost])


def test_a_wide_uncertainty_is_searched(hall, closures):
    """Guesses off by up to 1 m and 0.3 rad, stated to 0.5 m: most are found again, none wrongly."""
    pairs = accepted_pairs(hall, closures)[:8]
    rng = np.random.default_rng(10)
    one = given(hall, pairs, np.zeros((len(pairs), 3)), [0.5, 0.5, 0.15])
    exact = true_poses(hall, one)
    off = np.column_stack([rng.uniform(-0.8, 0.8, (len(pairs), 2)), rng.uniform(-0.3, 0.3, len(pairs))])
    one = replace(one, guess=exact + off)
    reported = []
    found = find(one, hall[3], CONFIG, SEARCH, lambda done, total: reported.append((done, total)))
    assert reported == [(len(pairs), len(pairs))]
    assert len(found.edges) >= len(pairs) // 2
    good = [k for k, c in enumerate(found.candidates) if c.accepted]
    error = se2.between(exact[good], found.edges.T_i_j)
    assert np.hypot(error[:, 0], error[:, 1]).max() < 0.3


def test_equal_pillars_are_recognised_as_ambiguous():
    """The same stretch driven there and back: where every 1.2 m look the same, a search over 3 m may not choose."""
    truth = np.zeros((60, 3))
    truth[:30, 0], truth[30:, 0] = np.linspace(-7, 2, 30), np.linspace(2, -7, 30)
    truth[30:, 2] = np.pi
    path = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(truth[:, 0])))])
    clouds = scanned(truth, TWINS, 0.01, 5, beams=300, reach=8.0)
    pieces = build(clouds, truth, path, np.zeros(60, dtype=np.intp), SubmapConfig(epsilon=4.5))
    a, b = np.array([0, 1]), np.array([3, 2])
    poses = truth[pieces.reference]
    covariance = np.tile(np.diag([1.0**2, 0.3**2, 0.02**2]), (2, 1, 1))
    unsure = Candidates(a, b, se2.between(poses[a], poses[b]) + np.array([0.4, 0.0, 0.0]), covariance, np.full(2, 3.0))
    found = find(unsure, pieces, CONFIG, SEARCH)
    assert all("another place" in c.reason for c in found.candidates)
    sure = Candidates(a, b, se2.between(poses[a], poses[b]), covariance / 1e4, np.full(2, 0.03))
    assert all(c.accepted for c in find(sure, pieces, CONFIG, SEARCH).candidates)


def planted_closures(rng, truth, count, false_share) -> tuple[Closures, np.ndarray]:
    """Return closures between random poses with 1 cm of noise, some of them wrong by metres, and which are."""
    i = rng.integers(0, len(truth) // 2, count)
    j = i + rng.integers(len(truth) // 4, len(truth) // 2, count)
    pose = se2.between(truth[i], truth[j]) + rng.standard_normal((count, 3)) * [0.01, 0.01, 0.004]
    false = rng.random(count) < false_share
    pose[false] += rng.uniform(0.5, 2.0, (false.sum(), 3)) * [1.0, 1.0, 0.2]
    root = np.tile(np.diag([100.0, 100.0, 250.0]), (count, 1, 1))
    return recorded(RelativePoseEdges(i, j, pose, root)), false


def recorded(edges: RelativePoseEdges) -> Closures:
    """Return closures with the record of each."""
    information = np.swapaxes(edges.sqrt_information, 1, 2) @ edges.sqrt_information
    columns = zip(edges.i.tolist(), edges.j.tolist(), edges.T_i_j, information, strict=True)
    return Closures(edges, tuple(LoopClosure(*each, 0.01, 0.9, "accepted", "planted") for each in columns))


@pytest.mark.parametrize("seed", range(2))
def test_contradicting_closures_are_dropped_with_a_reason(seed):
    rng = np.random.default_rng(seed)
    truth, _, _ = walked(seed, metres=40.0)
    graph = drifted(rng, truth, NOISE)
    closures, false = planted_closures(rng, truth, 30, 0.3)
    solved, left = reconcile(graph, closures, CONFIG, SOLVER)
    kept = {(int(a), int(b)) for a, b in zip(left.edges.i, left.edges.j, strict=True)}
    pairs = list(zip(closures.edges.i.tolist(), closures.edges.j.tolist(), strict=True))
    assert not kept & {p for p, f in zip(pairs, false, strict=True) if f}
    assert len(kept) >= 0.9 * np.sum(~false)
    for c, f in zip(left.candidates, false, strict=True):
        assert c.accepted == ((c.i, c.j) in kept)
        assert not f or "contradicts" in c.reason
    clean = reconcile(graph, planted_closures(np.random.default_rng(seed), truth, 30, 0.0)[0], CONFIG, SOLVER)[0]
    error = [np.sqrt(np.mean(np.sum((g.poses - truth)[:, :2] ** 2, axis=1))) for g in (solved, clean)]
    assert error[0] < 1.2 * error[1] + 0.02


def test_a_pair_that_was_matched_twice_has_two_fates(hall):
    """Tried directly and later after a search: the right measurement stands, the wrong one goes, and each reports it."""
    rng = np.random.default_rng(1)
    truth = hall[0]
    graph = drifted(rng, truth, NOISE)
    closures, _ = planted_closures(rng, truth, 12, 0.0)
    wrong = closures.edges.T_i_j + np.array([1.0, -1.0, 0.0])
    again = Closures(
        replace(
            closures.edges,
            i=closures.edges.i[:2],
            j=closures.edges.j[:2],
            T_i_j=wrong[:2],
            sqrt_information=closures.edges.sqrt_information[:2],
        ),
        tuple(replace(c, T_i_j=z) for c, z in zip(closures.candidates[:2], wrong[:2], strict=True)),
    )
    _, left = reconcile(graph, merged(closures, again), CONFIG, SOLVER)
    assert [c.accepted for c in left.candidates] == [True] * 12 + [False] * 2
    np.testing.assert_array_equal(left.edges.T_i_j, closures.edges.T_i_j)


def test_no_closures_change_nothing(hall):
    graph = hall[1]
    solved, left = reconcile(graph, no_closures(), CONFIG, SOLVER)
    assert solved is graph
    assert len(left.edges) == 0
    assert left.candidates == ()
    none = np.zeros(0, dtype=np.intp)
    empty = Candidates(none, none, np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0))
    assert find(empty, hall[3], CONFIG, SEARCH).candidates == ()


def test_merged_collections_keep_their_order(closures):
    both = merged(closures, closures)
    assert both.candidates == closures.candidates * 2
    n = len(closures.edges)
    np.testing.assert_array_equal(both.edges.T_i_j[n:], closures.edges.T_i_j)
    np.testing.assert_array_equal(merged(no_closures(), closures).edges.i, closures.edges.i)


def test_a_robot_that_never_returns_has_no_candidates():
    truth = np.column_stack([np.arange(60) * 0.3, np.zeros(60), np.zeros(60)])
    walls = np.array([[-5.0, -2.0, 30.0, -2.0], [30.0, 3.0, -5.0, 3.0]])
    clouds = scanned(truth, walls, 0.01, 1, reach=5.6)
    graph = drifted(np.random.default_rng(1), truth, NOISE / 10)
    recording = np.zeros(60, dtype=np.intp)
    pieces = build(clouds, graph.poses, truth[:, 0], recording, SubmapConfig(epsilon=8.0))
    covariances, near = JointCovariance(graph, pieces.reference), replace(CONFIG, reach=6.0, search_limit=1.0)
    far = propose(graph, covariances, pieces, recording, set(), True, near)
    apart = np.hypot(*(truth[pieces.reference[far.target], :2] - truth[pieces.reference[far.source], :2]).T)
    assert np.all(apart < 7.0)
    assert optimize(graph, SOLVER)[1].converged


def test_places_that_look_alike_leave_and_those_that_are_right_stay():
    """Two laps of 250 m; at one place two closures of a copy, 8 m and a quarter of a turn away, agree with each other."""
    lap, first = 250, np.array([10, 50, 90, 130, 170, 180, 220])
    truth = chain(np.zeros(3), np.tile([1.0, 0.0, 2.0 * np.pi / lap], (2 * lap, 1)))
    path, copy = np.arange(2.0 * lap), np.isin(first, [170, 180])
    for seed in range(5):
        rng = np.random.default_rng(seed)
        graph = drifted(rng, truth, NOISE)
        graph = replace(graph, edges=(replace(graph.edges[0], kernel=Kernel("cauchy", 5.0)),))
        edges = relative_edges(truth, first, first + lap, [0.05, 0.05, 0.01], rng)
        away = edges.T_i_j + copy[:, None] * [8.0, 0.0, np.pi / 2.0]
        for planted, right in ((edges, np.full(len(first), True)), (replace(edges, T_i_j=away), ~copy)):
            solved, _ = optimize(graph.with_edges(planted), SOLVER)
            start = replace(solved, edges=graph.edges)
            _, left = without_look_alikes(start, recorded(planted), path, SOLVER)
            assert [c.accepted for c in left.candidates] == right.tolist()


@pytest.mark.parametrize(("shared", "believed"), [(10, False), (180, True)])
def test_a_slip_is_believed_where_a_long_way_shows_it(shared, believed):
    """The wheels slip between two laps; one place by itself may be a copy, a long way that both laps share is none."""
    lap, rng = 250, np.random.default_rng(2)
    truth = chain(np.zeros(3), np.tile([1.0, 0.0, 2.0 * np.pi / lap], (2 * lap, 1)))
    graph = drifted(rng, truth, NOISE)
    wheels = replace(graph.edges[0], kernel=Kernel("cauchy", 5.0))
    wheels.motion[lap] += [2.0, 1.0, 0.6]
    first = np.arange(lap - 10 - shared, lap - 9, 10)
    edges = relative_edges(truth, first, first + lap, [0.05, 0.05, 0.01], rng)
    solved, _ = optimize(replace(graph, poses=truth, edges=(wheels, edges)), SOLVER)
    _, left = without_look_alikes(replace(solved, edges=(wheels,)), recorded(edges), np.arange(2.0 * lap), SOLVER)
    assert [c.accepted for c in left.candidates] == [believed] * len(first)


def test_a_place_that_nothing_contradicts_stays():
    graph = drifted(np.random.default_rng(0), chain(np.zeros(3), np.tile([1.0, 0.0, 0.1], (63, 1))), NOISE)
    away = recorded(RelativePoseEdges(np.array([0]), np.array([62]), np.array([[0.0, 0.0, 1.0]]), 20.0 * np.eye(3)[None]))
    slack = replace(graph, edges=tuple(replace(e, sqrt_information=0.01 * e.sqrt_information) for e in graph.edges))
    assert without_look_alikes(slack, away, np.arange(64.0), SOLVER)[1].candidates[0].accepted
    assert without_look_alikes(graph, no_closures(), np.arange(64.0), SOLVER)[0] is graph
