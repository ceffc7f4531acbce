"""An attempt at starting values: how it begins, goes on piece by piece, and judges itself."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.laser_walks import chained
from helpers.planted_graphs import plain_ranges

from uwblite import se2
from uwblite.graph.graph import Graph
from uwblite.odometry.slips import EVERY, LASTS
from uwblite.radio.bootstrap_attempt import Attempt, BootstrapPolicy, Measured
from uwblite.radio.trilateration import AnchorHypothesis, TrilaterationConfig


class Scheduled(Attempt):
    """A bootstrap whose steps only write down that they were taken; each extension adds what `agrees` does not say."""

    def __init__(self, poses, agrees, found):
        self.path, self.assumed, self.hypotheses = np.arange(float(poses)), 0.15, {}
        self.placed, self.agrees, self.found = np.ones(1, dtype=bool), iter(agrees), iter(found)
        self.taken, self.low, self.high, self.tears_at = [], 0, 0, np.inf

    def _seed(self):
        self.low, self.high = 0, 20
        return 20.0

    def _extend(self, piece):
        self.taken.append(round(piece, 6))
        self.high = min(self.high + 4, len(self.path))
        return next(self.agrees)

    def _solve(self, schedule):
        self.taken.append((schedule[0], self.high))

    def _search(self, low, high, drift):
        assert (low, high, drift) == (self.low, self.high, 2.0 * self.assumed)
        return {}

    def _adopt(self, found):
        return next(self.found)

    def _is_torn(self):
        return self.high >= self.tears_at


def test_pieces_grow_while_the_ranges_agree_and_all_is_solved_from_time_to_time():
    """The first piece is 0.3 of the first stretch. It grows by half where the ranges agreed, shrinks by a fifth where they did
    not, never below 0.3 of the first; all is solved at 1.35 times the poses and at the end, twice where an anchor came. What
    is left at a distance goes on as if it had never been left."""
    one = Scheduled(32, [True, False, True], [True, False])
    one.run()
    assert one.taken == [(6.0, 20), 6.0, 9.0, (6.0, 28), (6.0, 28), 7.2, (6.0, 32)]
    slow = Scheduled(56, [False] * 9, [False] * 9)
    slow.run(21.0)
    assert slow.high == 24
    slow.run()
    pieces = [t for t in slow.taken if isinstance(t, float)]
    assert pieces == [6.0, 4.8, 3.84, 3.072, 2.4576, 1.96608, 1.8, 1.8, 1.8]
    assert [t[1] for t in slow.taken if isinstance(t, tuple)] == [20, 28, 40, 56]


def test_an_attempt_that_is_torn_once_all_was_solved_goes_on_only_where_asked_to():
    """A tear in the pieces just laid on may be mended when all is solved; before that nothing ends."""
    for tears_at, high in ((24, 28), (29, 40), (np.inf, 56)):
        tried = Scheduled(56, [True] * 9, [False] * 3)
        tried.tears_at = tears_at
        tried.run(100.0, torn=False)
        assert tried.high == high
        tried.run(100.0)
        assert tried.high == 56


def along_a_line(poses=12, sigma=0.1):
    """Return an attempt over poses one metre apart whose odometry is exact, with ranges to two placed anchors."""
    truth = np.column_stack([np.arange(float(poses)), np.zeros((poses, 2))])
    anchors = np.array([[4.0, 3.0], [6.0, -3.0]])
    pose, anchor = np.repeat(np.arange(poses), 2), np.tile([0, 1], poses)
    distance = np.hypot(*(truth[pose, :2] - anchors[anchor]).T)
    graph = Graph(truth, anchors)
    wheels, radio = chained(truth, (0.05, 0.05, 0.05)), plain_ranges(pose, anchor, distance, sigma)
    measured = Measured(wheels, radio, np.arange(float(poses)), sigma)
    attempt = Attempt(graph, measured, TrilaterationConfig())
    attempt.placed[:] = True
    return attempt, truth


@pytest.mark.parametrize(("piece", "low", "high"), [(2.0, 3, 9), (2.5, 3, 9), (0.1, 4, 8), (30.0, 0, 12)])
def test_a_piece_is_laid_on_at_either_end_by_the_odometry(piece, low, high):
    """As far as the piece reaches, one pose at least; where the ranges agree nothing else is moved."""
    attempt, truth = along_a_line()
    attempt.low, attempt.high = 5, 7
    attempt.poses = np.where(np.arange(12)[:, None] // 5 == 1, truth, 99.0)
    attempt.poses[7:] = 99.0
    assert attempt._extend(piece)
    assert (attempt.low, attempt.high) == (low, high)
    np.testing.assert_allclose(attempt.poses[low:high], truth[low:high], atol=1e-12)
    assert np.all(attempt.poses[:low] == 99.0)
    assert np.all(attempt.poses[high:] == 99.0)


def test_a_piece_that_the_ranges_contradict_is_optimised_from_its_first_pose():
    attempt, truth = along_a_line()
    attempt.poses[8:, 1] += 0.8
    assert not attempt._agree_or_mend(7, 12, 7, 4.0)
    np.testing.assert_array_equal(attempt.poses[:8], truth[:8])
    assert np.abs(attempt.poses - truth)[:, :2].max() < 0.1
    near, _ = along_a_line()
    near.poses[8:, 1] += 0.1
    before = near.poses.copy()
    assert near._agree_or_mend(7, 12, 7, 4.0)
    np.testing.assert_array_equal(near.poses, before)


def test_the_misfit_is_a_median_in_standard_deviations_unless_the_path_is_torn():
    attempt, truth = along_a_line()
    assert attempt.misfit() == 0.0
    attempt.ranges = replace(attempt.ranges, ranges=attempt.ranges.ranges + np.tile([0.3, -0.3], 12))
    assert attempt.misfit() == pytest.approx(0.3 / (0.6745 * 0.1), rel=1e-4)
    for tear, torn in ((0.99, False), (1.01, True)):
        attempt, truth = along_a_line()
        attempt.placed[:] = False
        attempt.poses = truth + tear * (np.arange(12) >= 6)[:, None] * [0.0, 1.0, 0.0]
        assert attempt.misfit() == (BootstrapPolicy.agreement if torn else 0.0)


def test_the_first_stretch_is_the_one_whose_anchors_are_clearest():
    """By 1 / (1 + sigma / range_sigma + position_sigma) of each clear anchor; lengths are tried until it is enough."""
    tried = []

    class Seeded(Attempt):
        def _search(self, low, high, drift):
            tried.append((low, high, drift))
            # The surer anchor scatters three times as much: 1 / (1 + 1 + 1) is less than 1 / (1 + 3 + 0.5) twice.
            one = AnchorHypothesis(np.ones(2), 0.0, 0.1, 1.0, 1.0)
            two = AnchorHypothesis(np.ones(2), 0.0, 0.3, 1.0, 0.5)
            return {0: [one]} if low == 0 else ({0: [two], 1: [two]} if low == 15 else {0: []})

    truth = np.column_stack([np.arange(41.0), np.zeros((41, 2))])
    ranges_to = plain_ranges(np.arange(41), np.arange(41) % 2, np.ones(41), 0.1)
    measured = Measured(chained(truth, (0.1, 0.1, 0.1)), ranges_to, np.arange(41.0), 0.1)
    attempt = Seeded(Graph(truth, np.zeros((2, 2))), measured, TrilaterationConfig())
    length = attempt._seed()
    # 25 m at both ends and between, then 10 and 4 m, then all: none is worth 0.35 for each of two anchors.
    assert [(low, high) for low, high, _ in tried[:2]] == [(0, 26), (15, 41)]
    assert tried[-1][:2] == (0, 41)
    assert all(abs(drift / 0.015 - (high - low)) <= 1.0 + 1e-9 for low, high, drift in tried)
    assert (attempt.low, attempt.high, length) == (15, 41, 25.0)
    assert attempt.placed.tolist() == [True, True]


@pytest.mark.parametrize("answers", [(True, True), (True, False), (False, True)])
@pytest.mark.parametrize(("low", "high", "piece"), [(15, 25, 2.6), (15, 25, 0.1), (0, 25, 2.6), (15, 40, 2.6), (2, 38, 99.0)])
def test_a_piece_is_laid_on_at_each_open_end_and_must_agree_at_both(answers, low, high, piece):
    """One pose at least; those known stay, the others continue them as the wheels count."""
    truth = se2.chain(np.array([3.0, -1.0, 0.4]), np.tile([0.5, 0.0, 0.1], (39, 1)))
    attempt = object.__new__(Attempt)
    attempt.graph, attempt.path = Graph(np.zeros((40, 3))), 0.5 * np.arange(40.0)
    attempt.odometry, attempt.calibration = chained(truth, np.full(3, 0.01)), attempt.graph.calibration
    attempt.low, attempt.high, attempt.poses = low, high, np.zeros((40, 3))
    attempt.poses[low:high] = truth[low:high]
    calls = []

    def fits(first, last, end, length):
        assert length == piece
        calls.append((first, last, end))
        return answers[0 if end == high - 1 else 1]

    attempt._agree_or_mend = fits
    agreed = attempt._extend(piece)
    further, asked = max(int(piece / 0.5), 1), []
    if high < 40:
        asked.append((high - 1, min(high + further, 40), high - 1))
    if low > 0:
        asked.append((max(low - further, 0), low + 1, low))
    assert calls == asked
    assert agreed == all(answers[0 if fixed == high - 1 else 1] for *_, fixed in asked)
    first, last = min(c[0] for c in asked), max(c[1] for c in asked)
    assert (attempt.low, attempt.high) == (min(low, first), max(high, last))
    known = slice(attempt.low, attempt.high)
    np.testing.assert_allclose(se2.between(truth[known], attempt.poses[known]), 0.0, atol=1e-9)


@pytest.mark.parametrize(("end", "slip", "span"), [(8, None, (5, 11)), (8, 6, (7, 11)), (3, None, (1, 7)), (3, 4, (1, 5))])
def test_a_slip_is_sought_in_a_piece_that_disagrees_and_as_far_again_in_what_is_known(end, slip, span):
    """Up to the slip before; poses 3 to 8 are known."""
    attempt, _ = along_a_line()
    low, high = (end, 11) if end == 8 else (1, end + 1)
    attempt.low, attempt.high, attempt.seeks, sought = min(low, 3), max(high, 9), True, []
    attempt.poses[slice(9, None) if end == 8 else slice(0, 3), 1] += 3.0
    attempt.slips[[] if slip is None else slip] = 1.0
    attempt._with_slip = lambda first, last, forward: sought.append((first, last, forward))
    assert not attempt._agree_or_mend(low, high, end, 3.0)
    assert sought == [(*span, end == 8)]


def with_measured(attempt, change):
    """Return the attempt, all of it known, with other ranges (m,)."""
    attempt.low, attempt.high = 0, len(attempt.path)
    attempt.ranges = replace(attempt.ranges, ranges=change(attempt.ranges.ranges))
    return attempt


def test_false_ranges_cost_an_attempt_no_more_than_that_they_are_false():
    """However false they are: the distribution of an anchor's errors has a uniform rest, whose width they set."""
    rng = np.random.default_rng(4)
    noise, false = 0.1 * rng.standard_normal(80), np.arange(80) % 8 == 0
    evidence = [
        with_measured(along_a_line(poses=40)[0], lambda r, off=off: np.abs(r + noise - off * false)).evidence()
        for off in (0.0, 1.5, 3.0)
    ]
    # A false range of a tenth of them, within metres: log(0.1 / W) in place of about log(1 / 0.25 m).
    assert evidence[0] - evidence[1] < 6.0 * false.sum()
    assert abs(evidence[1] - evidence[2]) < 1.0 * false.sum()


def test_neighbouring_ranges_count_once_in_the_evidence_and_every_slip_has_its_prior():
    attempt = with_measured(along_a_line(poses=40)[0], lambda r: r + 0.05)
    once, every = attempt.evidence(), np.repeat(np.arange(len(attempt.ranges)), 10)
    attempt.ranges, attempt.live = attempt.ranges.rows(every), np.repeat(attempt.live, 10)
    assert abs(attempt.evidence() - once) < 1.1 * abs(once)
    before = attempt.evidence()
    attempt.slips[[5, 20]] = 1.0
    assert attempt.evidence() < before - 2.0 * np.log(EVERY / LASTS)


def test_an_attempt_from_the_middle_goes_on_until_it_has_the_way_that_is_asked_for():
    class FromTheMiddle(Scheduled):
        def _seed(self):
            self.low, self.high = 30, 50
            return 20.0

    one = FromTheMiddle(100, [True] * 20, [False] * 20)
    one.run(30.0)
    assert one.path[one.high - 1] - one.path[one.low] >= 30.0 > one.path[one.high - 5] - one.path[one.low]
