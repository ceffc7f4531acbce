from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.planted_graphs import at_random, lawn, plain_ranges, relative_edges

from uwblite import se2
from uwblite.graph.graph import Calibration, Graph, PriorEdges, UnknownKey
from uwblite.graph.point_edges import LandmarkEdges
from uwblite.graph.pose_edges import RelativePoseEdges
from uwblite.graph.solver import optimize
from uwblite.radio import incremental
from uwblite.radio.incremental import _by_time, _Incremental, optimize_incrementally


def rms(a, b):
    return np.sqrt(np.mean(np.sum((a[:, :2] - b[:, :2]) ** 2, axis=1)))


@pytest.mark.parametrize("seed", range(2))
def test_a_bent_guess_ends_at_the_minimum(seed):
    graph, truth, anchors = lawn(seed)
    best, _ = optimize(replace(graph, poses=truth, anchors=anchors))
    found, summary = optimize_incrementally(graph)
    assert rms(graph.poses, truth) > 5.0
    np.testing.assert_allclose(found.poses[:, :2], best.poses[:, :2], atol=0.02)
    often = np.bincount(graph.edges[1].anchor, minlength=16) > 20
    assert often.sum() >= 10
    np.testing.assert_allclose(found.anchors[often], best.anchors[often], atol=0.02)
    assert summary.converged
    # dof is about 4,500: chi2 over dof scatters by 0.02.
    assert summary.chi2_per_dof == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(("fits_from", "everything"), [(890, False), (300, False), (0, False), (-1, False), (0, True)])
def test_a_part_that_does_not_fit_is_solved_with_ever_more_of_the_path(fits_from, everything):
    """Until it fits, or reaches back to the start."""
    lows: list[int] = []

    def solve(low, now):
        lows.append(low)
        assert len(lows) < 10
        return SimpleNamespace(fits=low <= fits_from, low=low)

    stand_in = SimpleNamespace(_solve=solve, _without_outliers=lambda part, low, now: part)
    part = _Incremental._fit(stand_in, 900, everything)
    assert part.low == lows[-1]
    assert [low <= fits_from or low == 0 for low in lows] == [False] * (len(lows) - 1) + [True]
    assert lows[0] == (0 if everything else 900 - incremental.IncrementalPolicy.window)
    assert np.all(np.diff(900 - np.array([low for low in lows if low]), prepend=0) > 0)


def test_a_part_moves_the_poses_from_its_first_on_and_no_earlier_one():
    """Exact steps from a pose, the tenth of fourteen, that is held by a prior elsewhere than where it stands."""
    truth = np.column_stack([np.arange(20.0), np.zeros((20, 2))])
    each = np.arange(19)
    steps = relative_edges(truth, each, each + 1, [0.05, 0.05, 0.05], None)
    prior = PriorEdges("poses", np.array([10]), truth[[10]] + [0.0, 0.3, 0.0], np.eye(3)[None] / 0.001)
    incremental_graph = _Incremental(Graph(truth, edges=(steps, prior)))
    moved = np.abs(incremental_graph._solve(10, 14).graph.poses - truth[:14]).max(axis=1) > 1e-3
    assert np.flatnonzero(moved).tolist() == [10, 11, 12, 13]


def test_all_at_once_the_same_guess_is_lost():
    graph, _, anchors = lawn(0)
    assert optimize(replace(graph, anchors=anchors))[1].chi2_per_dof > 2.0


def test_pose_graphs_need_no_ranges():
    graph, truth, _ = lawn(2, n=600)
    close = np.array([(i, j) for i in range(600) for j in range(i + 50, 600) if np.hypot(*(truth[i] - truth[j])[:2]) < 1.0])[
        ::10
    ]
    closures = relative_edges(truth, close[:, 0], close[:, 1], [0.03, 0.03, 0.01], np.random.default_rng(0))
    graph = Graph(graph.poses, edges=(graph.edges[0], closures))
    found, summary = optimize_incrementally(graph)
    assert summary.chi2 == pytest.approx(optimize(replace(graph, poses=truth))[1].chi2, rel=1e-6)
    assert found.anchors.shape == (0, 2)


def test_surveyed_anchors_hold_the_path_from_the_start():
    graph, truth, anchors = lawn(3, n=400)
    fixed = replace(graph, anchors=anchors, fixed_anchors=np.ones(16, dtype=bool))
    found, _ = optimize_incrementally(fixed)
    np.testing.assert_array_equal(found.anchors, anchors)
    assert rms(found.poses, truth) < 0.15
    prior = PriorEdges("anchors", np.arange(16), anchors, np.tile(np.eye(2) / 0.05, (16, 1, 1)))
    found, _ = optimize_incrementally(replace(graph, anchors=anchors).with_edges(prior))
    assert rms(found.poses, truth) < 0.15


def test_landmarks_without_ranges_are_carried_along():
    graph, truth, _ = lawn(4, n=400)
    rng = np.random.default_rng(4)
    marks = rng.uniform(10.0, 50.0, size=(30, 2))
    pose, mark = np.nonzero(np.hypot(*(truth[:, None, :2] - marks).transpose(2, 0, 1)) < 6.0)
    seen = se2.transform(se2.inverse(truth[pose]), marks[mark]) + rng.normal(scale=0.05, size=(len(pose), 2))
    edges = LandmarkEdges(pose, mark, seen, np.tile(np.eye(2) / 0.05, (len(pose), 1, 1)))
    first = np.array([pose[mark == m].min() if np.any(mark == m) else 0 for m in range(30)])
    guess = se2.transform(graph.poses[first], se2.transform(se2.inverse(truth[first]), marks))
    graph = Graph(graph.poses, guess, (graph.edges[0], edges))
    _, summary = optimize_incrementally(graph)
    assert summary.chi2 == pytest.approx(optimize(replace(graph, poses=truth, anchors=marks))[1].chi2, rel=1e-5)


def test_calibration_is_found_on_the_way():
    graph, truth, anchors = lawn(5)
    odometry, ranges = graph.edges
    ranges = replace(ranges, ranges=1.05 * ranges.ranges + 0.2, calibration=np.tile([0, 1, -1, -1, -1, -1], (len(ranges), 1)))
    prior = PriorEdges("calibration", np.arange(2), np.zeros((2, 1)), np.array([[[20.0]], [[2.0]]]))
    graph = replace(
        graph, edges=(odometry, ranges, prior), calibration=Calibration((UnknownKey("scale"), UnknownKey("bias")), np.zeros(2))
    )
    found, summary = optimize_incrementally(graph)
    # Hundreds of ranges per anchor: the scale is known to about 0.1 %, the bias to about 1 cm.
    np.testing.assert_array_less(np.abs(found.calibration.values - [0.05, 0.2]), [4e-3, 4e-2])
    best, at_best = optimize(replace(graph, poses=truth, anchors=anchors))
    assert rms(found.poses, best.poses) < 0.02
    assert summary.chi2 == pytest.approx(at_best.chi2, rel=1e-5)


def test_short_and_trivial_graphs_are_one_piece():
    truth = np.cumsum(np.full((5, 3), 0.3), axis=0)
    edges = relative_edges(truth, range(4), range(1, 5), [0.1, 0.1, 0.1], np.random.default_rng(0))
    found, summary = optimize_incrementally(Graph(truth, edges=(edges,)))
    np.testing.assert_allclose(RelativePoseEdges.residuals(edges, found), 0.0, atol=1e-6)
    assert summary.chi2 == pytest.approx(0.0, abs=1e-9)


def test_progress_is_reported_in_poses():
    graph, _, _ = lawn(6, n=350)
    calls = []
    optimize_incrementally(graph, progress=lambda done, most: calls.append((done, most)))
    assert calls == [(100, 350), (200, 350), (300, 350), (350, 350)]


def test_results_are_the_same_every_time():
    graph, _, _ = lawn(7, n=300)
    first, second = (optimize_incrementally(graph)[0] for _ in range(2))
    assert first.poses.tobytes() == second.poses.tobytes()


@pytest.fixture
def short_probation(monkeypatch):
    monkeypatch.setattr(incremental.IncrementalPolicy, "window", 250)


def _with_wrong_anchor(joined_at, wrong=5, n=400):
    """Return the state of a path driven so far, all anchors joined at pose 0 but for some, and one of them in a wrong place."""
    graph, truth, anchors = lawn(1, n=n)
    state = _Incremental(graph)
    places = anchors.copy()
    if wrong is not None:
        places[wrong] += [6.0, -4.0]
    state.graph = replace(graph, poses=truth, anchors=places)
    state.joined[:], state.joined_at[:] = True, 0
    for anchor, when in joined_at.items():
        state.joined_at[anchor] = when
    return state


@pytest.mark.usefixtures("short_probation")
@pytest.mark.parametrize(
    ("joined_at", "left"),
    [({}, {5}), ({5: 160, 9: 390}, {5, 9}), ({9: 390}, {5})],
    ids=["an old one, by its outliers", "those that joined last", "an old one, where those that joined last are sound"],
)
def test_an_anchor_in_a_wrong_place_leaves(joined_at, left):
    state = _with_wrong_anchor(joined_at)
    part = state._solve(200, 400)
    assert not part.fits
    # One that has no place yet does not join because others leave; one that is given is never accused of having come late.
    state.joined[12], state.joined_at[12] = False, len(state.guess)
    state.ranged[2], state.joined_at[2] = False, 399
    found = state._without_outliers(part, 200, 400)
    assert found.fits
    assert set(np.flatnonzero(~state.joined)) == left | {12}
    assert set(np.flatnonzero(state.joined_at == len(state.guess))) == left | {12}


@pytest.mark.usefixtures("short_probation")
def test_nobody_leaves_where_that_does_not_help():
    state = _with_wrong_anchor({})
    state.usual = 1e-3
    part = state._solve(200, 400)
    assert state._without_outliers(part, 200, 400) is part
    assert state.joined.all()


def _one_anchor(curved, ranged=60, n=100):
    """Return the state of a path, straight or curved, with ranges to one anchor from its first poses."""
    turn = np.full(n - 1, 0.02 if curved else 0.0)
    truth = se2.chain(np.zeros(3), np.column_stack([np.full(n - 1, 0.5), np.zeros(n - 1), turn]))
    anchor, each = np.array([[14.0, 6.0]]), np.arange(n - 1)
    odometry = relative_edges(truth, each, each + 1, [0.02, 0.01, 0.01], np.random.default_rng(0))
    distance = np.hypot(*(truth[:ranged, :2] - anchor).T)
    ranges = plain_ranges(np.arange(ranged), np.zeros(ranged, dtype=int), distance, 0.1)
    return _Incremental(Graph(truth, np.zeros((1, 2)), (odometry, ranges)))


def test_an_anchor_with_a_mirror_image_joins_at_the_end_only():
    straight, curved = _one_anchor(False), _one_anchor(True)
    for state in (straight, curved):
        state._search(60)
    assert (straight.joined[0], curved.joined[0]) == (False, True)
    assert curved.joined_at[0] == 60
    np.testing.assert_allclose(curved.graph.anchors[0], [14.0, 6.0], atol=0.05)
    straight._search(100)
    assert straight.joined[0]
    np.testing.assert_allclose(np.abs(straight.graph.anchors[0]), [14.0, 6.0], atol=0.05)


def test_an_anchor_is_searched_once_there_are_ranges_and_again_with_half_more():
    state = _one_anchor(False)
    tried = []
    for now in (19, 20, 29, 30, 44, 45):
        state._search(now)
        tried.append(int(state.tried[0]))
    assert tried == [0, 20, 20, 30, 30, 45]


def test_a_place_that_is_not_certain_does_not_join_yet(monkeypatch):
    monkeypatch.setattr(incremental.IncrementalPolicy, "position_sigma", 1e-6)
    state = _one_anchor(True)
    state._search(60)
    assert state.tried[0] == 60
    assert not state.joined[0]


def test_who_is_outlying_is_a_matter_of_the_share_over_all_kinds_of_ranges():
    state = _with_wrong_anchor({}, wrong=None)
    odometry, ranges = state.graph.edges
    own = np.flatnonzero((ranges.anchor == 5) & (ranges.pose >= 200) & (ranges.pose < 400))
    for share, outlying in ((0.1, set()), (0.5, {5})):
        bent = ranges.ranges.copy()
        bent[own[: int(share * len(own))]] += 3.0
        part = replace(ranges, ranges=bent)
        # Sound ranges of a second kind to the others: of anchor 5 all stand in the first.
        halves = [part.rows(np.flatnonzero((part.anchor == 5) | (part.pose % 2 == k))) for k in (0, 1)]
        halves[1] = halves[1].rows(np.flatnonzero(halves[1].anchor != 5))
        state.kinds = [_by_time(edges, state.graph) for edges in (odometry, *halves)]
        assert set(np.flatnonzero(state._outlying(200, 400))) == outlying


def test_the_work_allowed_ends_the_search_where_it_is():
    """Closures at random fit nowhere, and every piece would be tried with all poses before it."""
    graph, calls = at_random(120, 240), []
    batch = optimize(graph)[1]
    allowed = 10.0 * batch.work / batch.iterations
    found, summary = optimize_incrementally(graph, progress=lambda done, _: calls.append(done), allowed=allowed)
    assert calls[-1] < 120
    assert not summary.converged
    assert allowed <= summary.work
    assert np.isfinite(found.poses).all()
