"""Slips: probabilities of sequences by brute force, and steps that slipped give way to what was measured."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from helpers.laser_walks import chained
from scipy.linalg import block_diag, expm
from scipy.stats import multivariate_normal, t

from uwblite import se2
from uwblite.graph.graph import Graph
from uwblite.graph.pose_edges import RelativePoseEdges
from uwblite.graph.solver import optimize
from uwblite.odometry.slips import (
    EVERY,
    LASTS,
    SPEED,
    STEADY,
    TURN_RATE,
    FalseMotions,
    SlipChain,
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
    both = np.zeros(8)
    for states in itertools.product([0, 1], repeat=8):
        weight, before = 0.0, None
        for k, state in enumerate(states):
            change = expm(duration[k] * rates)
            share = RARE if before is None else change[before]
            weight, before = weight + np.log(share[state]) + state * log_odds[k], state
        total += np.exp(weight)
        slips += np.exp(weight) * np.array(states)
        both[1:] += np.exp(weight) * np.array(states)[1:] * np.array(states)[:-1]
    chain = posterior(log_odds, duration)
    np.testing.assert_allclose(chain.probability, slips / total, rtol=1e-9)
    np.testing.assert_allclose(chain.after[:-1], both[1:] / slips[:-1], rtol=1e-9)
    np.testing.assert_allclose(chain.before[1:], both[1:] / slips[1:], rtol=1e-9)


def _false_motions(count, seed):
    """Return measurements (e, 3) of a slip's false motions, their covariances (e, 3, 3), and both as information."""
    rng = np.random.default_rng(seed)
    root = rng.normal(0.0, 1.0, (count, 3, 3)) + 3.0 * np.eye(3)
    matrix, value = np.swapaxes(root, 1, 2) @ root, rng.normal(0.0, 1.0, (count, 3))
    return value, np.linalg.inv(matrix), FalseMotions(np.einsum("eij,ej->ei", matrix, value), matrix)


def test_steps_of_one_slip_tell_of_each_other_as_a_gauss_markov_process():
    """Prediction and evidence are those of dense Gaussian conditioning on all other steps."""
    value, noise, measured = _false_motions(6, 3)
    duration = np.random.default_rng(4).uniform(0.1, 2.0, 6)
    together = SlipChain(np.ones(6), np.ones(6), np.ones(6))
    by_others = measured.by_neighbours(together, duration)
    gain = measured.log_marginal(by_others)
    middle = np.cumsum(duration) - 0.5 * duration
    process = np.kron(np.exp(-np.abs(middle[:, None] - middle) / STEADY), np.eye(3))
    for k in range(6):
        own, others = np.arange(3 * k, 3 * k + 3), np.setdiff1d(np.arange(18), np.arange(3 * k, 3 * k + 3))
        total = process[np.ix_(others, others)] + block_diag(*np.delete(noise, k, axis=0))
        weights = np.linalg.solve(total, process[np.ix_(others, own)]).T
        mean, covariance = weights @ np.delete(value, k, axis=0).ravel(), np.eye(3) - weights @ process[np.ix_(others, own)]
        np.testing.assert_allclose(np.linalg.inv(by_others.matrix[k]), covariance, rtol=1e-8, atol=1e-12)
        np.testing.assert_allclose(np.linalg.solve(by_others.matrix[k], by_others.vector[k]), mean, rtol=1e-8)
        told, alone = multivariate_normal(mean, covariance + noise[k]), multivariate_normal(np.zeros(3), np.eye(3) + noise[k])
        assert gain[k] == pytest.approx(told.logpdf(value[k]) - alone.logpdf(value[k]), rel=1e-8)


def test_steps_that_belong_to_no_slip_tell_nothing():
    *_, measured = _false_motions(5, 5)
    alone = measured.by_neighbours(SlipChain(np.full(5, 0.5), np.zeros(5), np.zeros(5)), np.ones(5))
    np.testing.assert_allclose(alone.matrix, np.tile(np.eye(3), (5, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(measured.log_marginal(alone), 0.0, atol=1e-12)


@pytest.mark.parametrize(("steady", "slipped"), [(True, True), (False, False)])
def test_a_slip_that_no_step_shows_by_itself_shows_in_all_of_them(steady, slipped):
    """Each step of ten pays for its unknown motion more than it gains; together they pay once, if they count the same."""
    duration, sign = np.full(60, 0.2), np.ones(60) if steady else (-1.0) ** np.arange(60)
    motion = sign[:, None] * np.array([-0.3, 0.02, -0.3])
    inside = (np.arange(60) >= 25) & (np.arange(60) < 35)
    matrix = np.where(inside, 400.0, 0.0)[:, None, None] * np.eye(3)
    measured = FalseMotions(np.einsum("eij,ej->ei", matrix, motion), matrix)
    alone = np.where(inside, -0.5, -2.9)
    assert posterior(alone, duration).probability.max() < 0.01
    chain = posterior(np.zeros(60), duration)
    for _ in range(4):
        chain = posterior(alone + measured.log_marginal(measured.by_neighbours(chain, duration)), duration)
    assert np.all((chain.probability[inside] > 0.5) == slipped)
    assert chain.probability[~inside].max() < 0.3


def test_without_evidence_slips_are_as_rare_as_beforehand():
    share = posterior(np.zeros(500), np.full(500, 0.5)).probability
    np.testing.assert_allclose(share, RARE[1], rtol=1e-9)


def test_a_step_that_nothing_measured_slipped_where_its_neighbours_did():
    log_odds = np.zeros(21)
    log_odds[8:10] = log_odds[11:13] = 9.0
    log_odds[:7] = log_odds[14:] = -9.0
    share = posterior(log_odds, np.full(21, 0.5)).probability
    assert share[10] > 0.95
    assert share[[2, 18]].max() < 1e-4


def test_evidence_beyond_all_doubt_does_not_overflow():
    np.testing.assert_allclose(posterior(np.array([900.0, -900.0]), np.ones(2)).probability, [1.0, 0.0], atol=1e-9)


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
