"""Rounds take a tenth of one core at most, whatever the machine, and never starve."""

from itertools import pairwise

import pytest

from uwblite.server.rounds import FIRST_AFTER, LEAST_PAUSE, PATIENCE, SHARE, Round, expected_cost, next_thinning


def simulated(cost_of, seconds, step=1.0, rest=0.0):
    """Return the rounds of a recording of so many seconds and a machine whose rounds cost cost_of(recorded, nth)."""
    rounds, last, now, busy = [], None, 0.0, 0.0
    while now < seconds + rest:
        recorded = min(now, seconds)
        if now >= busy:
            nth = next_thinning(last, recorded, now, max(now - seconds, 0.0))
            if nth is not None:
                cost = cost_of(recorded, nth)
                rounds.append((now, recorded, nth, cost))
                busy = now + cost
                last = Round(busy, cost, recorded, nth)
        now += step
    return rounds


@pytest.mark.parametrize("speed", [0.3, 1.0, 5.0, 15.0])
def test_a_tenth_of_the_time_at_most_on_every_machine(speed):
    rounds = simulated(lambda t, n: speed * 0.0086 * (200 + t) * min(1.0, (8 / n) ** 0.4), 1800.0)
    assert rounds[0][0] == FIRST_AFTER
    for (before, _, _, took), (begin, _, _, cost) in pairwise(rounds):
        assert cost <= SHARE * (begin - before - took) * 1.02
    assert len(rounds) >= 2
    if speed <= 1.0:
        assert len(rounds) > 15
        assert max(b[0] - a[0] for a, b in pairwise(rounds)) < 150.0


def test_costs_far_from_the_law_are_learnt():
    rounds = simulated(lambda t, n: 1e-5 * t**2 + 1.0, 1800.0)
    spent = sum(r[3] for r in rounds[1:])
    assert spent < 1.2 * SHARE * 1800.0
    assert len(rounds) > 5


def test_nothing_new_is_no_reason_and_too_little_neither():
    last = Round(ended=100.0, cost=1.0, recorded=90.0, every_nth_scan=8)
    assert next_thinning(last, 90.0, 500.0) is None
    assert next_thinning(last, 90.0 + 0.9 * LEAST_PAUSE, 500.0) is None
    assert next_thinning(last, 90.0 + LEAST_PAUSE, 500.0) == 1
    assert next_thinning(None, 0.9 * FIRST_AFTER, 1e9) is None


def test_a_round_that_failed_is_tried_again_but_not_at_once():
    last = Round(ended=100.0, cost=0.1, recorded=90.0, every_nth_scan=8, failed=True)
    assert next_thinning(last, 500.0, 100.0 + 0.9 * LEAST_PAUSE) is None
    assert next_thinning(last, 500.0, 100.0 + LEAST_PAUSE) is not None


def test_a_recording_at_rest_is_mapped_from_all_scans_once():
    rounds = simulated(lambda t, n: 40.0 / n**0.5, 600.0, rest=500.0)
    assert rounds[-1][2] == 1
    assert rounds[-1][1] == 600.0
    assert rounds[-1][0] >= 600.0 + PATIENCE
    assert sum(r[0] >= 600.0 + PATIENCE for r in rounds) == 1


def test_expected_cost_grows_with_the_recording_and_falls_with_thinning():
    last = Round(0.0, 10.0, 900.0, 8)
    assert expected_cost(last, 900.0, 8) == pytest.approx(10.0)
    assert expected_cost(last, 900.0, 30) == pytest.approx(5.8, rel=0.05)
    assert expected_cost(last, 1800.0, 8) < 20.0
