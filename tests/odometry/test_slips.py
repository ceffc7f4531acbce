"""Slips: probabilities of sequences by brute force, and steps that slipped give way to what was measured."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from helpers.laser_walks import chained
from scipy.linalg import expm
from scipy.stats import t

from uwblite import se2
from uwblite.graph.graph import Graph
from uwblite.graph.pose_edges import RelativePoseEdges
from uwblite.graph.solver import optimize
from uwblite.odometry.slips import (
    EVERY,
    LASTS,
    SPEED,
    TURN_RATE,
    covariance_of,
    expected,
    log_densities,
    posterior,
    slip_sigma,
    with_slips,
)

NOISE = np.array([0.01, 0.005, 0.006])
RARE = np.array([EVERY, LASTS]) / (EVERY + LASTS)


def test_probabilities_are_those_over_all_sequences():
    rng = np.random.default_rng(0)
    log_odds, duration = rng.normal(0.0, 4.0, 8), rng.uniform(0.1, 3.0, 8)
    total, slips, rates = 0.0, np.zeros(8), np.array([[-1.0 / EVERY, 1.0 / EVERY], [1.0 / LASTS, -1.0 / LASTS]])
    for states in itertools.product([0, 1], repeat=8):
        weight, before = 0.0, None
        for k, state in enumerate(states):
            change = expm(duration[k] * rates)
            share = RARE if before is None else change[before]
            weight, before = weight + np.log(share[state]) + state * log_odds[k], state
        total += np.exp(weight)
        slips += np.exp(weight) * np.array(states)
    np.testing.assert_allclose(posterior(log_odds, duration), slips / total, rtol=1e-9)


def test_without_evidence_slips_are_as_rare_as_beforehand():
    share = posterior(np.zeros(500), np.full(500, 0.5))
    np.testing.assert_allclose(share, RARE[1], rtol=1e-9)


def test_a_step_that_nothing_measured_slipped_where_its_neighbours_did():
    log_odds = np.zeros(21)
    log_odds[8:10] = log_odds[11:13] = 9.0
    log_odds[:7] = log_odds[14:] = -9.0
    share = posterior(log_odds, np.full(21, 0.5))
    assert share[10] > 0.95
    assert share[[2, 18]].max() < 1e-4


def test_evidence_beyond_all_doubt_does_not_overflow():
    np.testing.assert_allclose(posterior(np.array([900.0, -900.0]), np.ones(2)), [1.0, 0.0], atol=1e-9)


def test_the_covariance_is_that_of_drawn_steps():
    wheels, rng = chained(np.array([[0.0, 0.0, 0.0], [0.3, 0.05, 0.4]]), NOISE), np.random.default_rng(1)
    # An error in the middle of a step turns its second half.
    root = wheels.end_sqrt_information[0]
    errors = np.linalg.solve(root, rng.standard_normal((3, 100_000))).T
    ends = se2.compose(wheels.motion[0], errors)
    np.testing.assert_allclose(covariance_of(wheels, Graph(np.zeros((2, 3))))[0], np.cov(ends.T), rtol=0.05, atol=2e-6)


@pytest.mark.parametrize(("duration", "lasts"), [(0.01, 0.01), (600.0, LASTS)])
def test_wheels_count_at_most_all_of_their_motion_too_much(duration, lasts):
    """And miss what a push moves the robot while they slip, which they do for seconds and not for minutes."""
    wheels = replace(chained(np.array([[0.0, 0.0, 0.0], [0.3, 0.4, -0.2]]), NOISE), duration=np.array([duration]))
    np.testing.assert_allclose(
        slip_sigma(wheels), [[0.5 + SPEED * lasts, 0.5 + SPEED * lasts, 0.2 + TURN_RATE * lasts]], rtol=1e-3
    )


def test_wheels_that_stand_still_while_they_slip_do_not_hold_a_measured_step():
    """Half a millimetre of a standing robot, against two centimetres of the clouds."""
    truth = np.column_stack([np.arange(9) * 0.15, np.zeros(9), np.arange(9) * 0.15])
    wheels = chained(truth, np.full(3, 0.0005))
    wheels.motion[4] = 0.0
    measured = se2.between(truth[:-1], truth[1:])
    steps = RelativePoseEdges(wheels.i, wheels.j, measured, np.tile(np.diag([40.0, 40.0, 100.0]), (8, 1, 1)))
    start = Graph(se2.chain(truth[0], wheels.motion))
    loose = with_slips(wheels, np.where(np.arange(8) == 4, 1.0, 0.0))
    solved, _ = optimize(start.with_edges(loose, steps))
    step = se2.between(solved.poses[4], solved.poses[5])
    assert np.all(np.abs(step - measured[4]) < np.array([0.025, 0.025, 0.01]))
    others = np.arange(8) != 4
    np.testing.assert_allclose(loose.sqrt_information[others], wheels.sqrt_information[others])
    noted = expected(replace(wheels, slips=1.0 - others))
    np.testing.assert_array_equal(noted.sqrt_information, loose.sqrt_information)
    assert noted.slips is None
    assert expected(wheels) is wheels


def test_densities_of_steps_are_those_of_the_mixture():
    """About a step that wheels counted, sound and slipping add up; the density integrates to one."""
    truth = np.array([[0.0, 0.0, 0.3], [0.2, 0.05, 0.4]])
    wheels = chained(truth, NOISE)
    rng, count = np.random.default_rng(2), 200_000
    scales = np.array([np.sqrt(np.diag(covariance_of(wheels, Graph(np.zeros((2, 3))))[0])), slip_sigma(wheels)[0]])
    drawn = scales[rng.integers(0, 2, count)] * t.rvs(3, size=(count, 3), random_state=rng)
    drawn_density = np.mean([np.prod(t.pdf(drawn / scale, 3) / scale, axis=1) for scale in scales], axis=0)
    step = se2.between(truth[0], truth[1]) + drawn
    poses = np.concatenate([truth[:1], se2.compose(truth[:1], step)])
    ends = np.arange(1, len(poses))
    many = wheels.rows(np.zeros(len(ends), dtype=np.intp))
    density = np.exp(log_densities(replace(many, i=np.zeros(len(ends), dtype=np.intp), j=ends), Graph(poses)))
    density[np.abs(drawn[:, 2]) > np.pi] = 0.0  # the same heading has been counted
    assert np.mean(density / drawn_density) == pytest.approx(1.0, abs=0.02)
