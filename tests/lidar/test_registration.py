"""Registration: evidence by numerical integration, slips that show, objects that move, clouds that say nothing."""

import numpy as np
import pytest
import registration_law
from helpers.laser_walks import HALL, ROOM, scanned, walked

from uwblite import se2
from uwblite.lidar.cloud_rasters import rasterize
from uwblite.lidar.clouds import Clouds, joined
from uwblite.lidar.object_likelihood import ObjectLikelihood, matched_by_chance, objects
from uwblite.lidar.registration import (
    Gaussian,
    Prior,
    RegistrationConfig,
    odds_by_views,
    of_fallible,
    register,
    search,
    with_neighbours,
)
from uwblite.lidar.scan_matching import pairs_of
from uwblite.odometry.slips import FalseMotions

SIGMA = 0.02
SOUND, SLIPPED = np.array([0.01, 0.01, 0.01]), np.array([0.4, 0.4, 0.3])


def compared(clouds, mean):
    """Return the likelihood of two clouds, and their pair."""
    pairs, raster = pairs_of(clouds, np.array([0]), np.array([1])), rasterize(clouds, 0.1, 0.5)
    return ObjectLikelihood.of(raster, SIGMA, pairs, np.array([mean])), pairs


def registered(clouds, mean, sound=SOUND, slipped=SLIPPED):
    """Register cloud 1 in cloud 0 where the odometry counts a motion."""
    (seen, pairs), covariance = compared(clouds, mean), np.diag(sound**2)[None]
    prior = Prior.about(np.array([mean]), covariance, slipped[None], slipped[None])
    return seen, pairs, prior, register(seen, pairs, prior, prior.sound.mean)


def after_slip(found):
    """Return where the source lies if the wheels slipped."""
    return found.likeliest(found.prior.slipped)[0].pose[0]


@pytest.fixture(scope="module")
def room():
    truth = np.array([[-1.0, 0.5, 0.2], [-0.8, 0.55, 0.3]])
    return truth, scanned(truth, ROOM, 0.01, 3)


@pytest.mark.parametrize(("slip", "sign"), [((0.0, 0.0, 0.0), -1.0), ((0.25, 0.0, 0.2), 1.0), ((-0.2, 0.05, -0.25), 1.0)])
def test_clouds_tell_a_slip_from_none(room, slip, sign):
    truth, clouds = room
    step = se2.between(truth[0], truth[1])
    *_, found = registered(clouds, step + slip)
    # As sure as a pair of clouds can be: it is wrong with the probability `useless`.
    assert sign * found.log_odds()[0] == pytest.approx(np.log(1.0 / RegistrationConfig.useless - 1.0), rel=1e-3)
    pose = after_slip(found) if sign > 0 else found.sound.pose[0]
    assert np.abs(se2.between(step, pose)).max() < 0.015


@pytest.mark.parametrize("missed", [(0.0, 0.0, 0.7), (0.6, -0.3, -0.5)])
def test_a_place_far_from_the_prior_s_mean_is_found(room, missed):
    truth, clouds = room
    step = se2.between(truth[0], truth[1])
    mean = se2.compose(step, np.array(missed))
    (pose,) = search(*compared(clouds, mean), Gaussian(mean[None], np.eye(3)[None])).pose
    assert np.abs(se2.between(step, pose)).max() < 0.015


def test_a_search_is_no_wider_than_clouds_can_overlap(room):
    """Wheels that count 24 m over one step: the window of two such slips would have a billion poses."""
    truth, clouds = room
    step = se2.between(truth[0], truth[1])
    *_, found = registered(clouds, np.array([24.0, -3.0, 0.4]), slipped=np.array([24.5, 24.5, 0.6]))
    assert found.log_odds()[0] > 0.0
    assert np.abs(se2.between(step, after_slip(found))).max() < 0.015


def test_what_is_measured_leaves_the_prior_out(room):
    """A prior of a millimetre holds the pose 2 cm beside the truth; the matches still say where they would be."""
    truth, clouds = room
    step = se2.between(truth[0], truth[1])
    *_, found = registered(clouds, step + np.array([0.02, 0.0, 0.0]), np.full(3, 0.001))
    assert found.sound.pose[0, 0] - step[0] > 0.01
    z, root = found.sound.measured(SIGMA**2)
    assert np.abs(se2.between(step, z[0])).max() < 0.01
    assert np.linalg.matrix_rank(root[0]) == 3


def test_the_evidence_is_that_of_numerical_integration(room):
    """Laplace's approximation, within half a unit of the sum over a grid; the likelihood's constant cancels in neither."""
    truth, clouds = room
    seen, pairs, prior, found = registered(clouds, se2.between(truth[0], truth[1]))
    mode, covariance = found.sound.pose[0], registration_law.covariance(found.sound, prior.sound)[0]
    axis = np.linspace(-5.0, 5.0, 13)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    shifts = grid @ np.linalg.cholesky(covariance).T
    log = seen.log_likelihood(pairs.rows(np.zeros(len(grid), dtype=np.intp)), mode + shifts)
    off = mode + shifts - prior.sound.mean
    information = np.linalg.inv(prior.sound.covariance[0])
    log -= 0.5 * np.einsum("gi,ij,gj->g", off, information, off) + 1.5 * np.log(2.0 * np.pi)
    log -= 0.5 * np.linalg.slogdet(prior.sound.covariance[0])[1]
    cell = (axis[1] - axis[0]) ** 3 * np.sqrt(np.linalg.det(covariance))
    whole = np.log(np.sum(np.exp(log - log.max())) * cell) + log.max()
    assert found.sound.evidence(prior.sound)[0] == pytest.approx(whole, abs=0.7)
    assert np.sqrt(np.diag(covariance)).max() < SOUND.max()


def test_a_near_thing_that_moves_does_not_take_the_step_with_it():
    """It fills a third of the view and moves 6 cm a step; the walls behind it stand."""
    truth = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0]])
    thing = np.array([[1.2, -0.9, 1.2, 0.9], [1.2, 0.9, 1.3, 0.9]])
    walls = np.array([[-3.0, -2.5, 3.5, -2.5], [3.5, -2.5, 3.5, 2.5], [3.5, 2.5, -3.0, 2.5], [-3.0, 2.5, -3.0, -2.5]])
    before = scanned(truth[:1], np.concatenate([walls, thing]), 0.005, 1)
    after = scanned(truth[1:], np.concatenate([walls, thing + np.array([0.06, 0.0, 0.06, 0.0])]), 0.005, 2)
    clouds = joined([before, after])
    *_, found = registered(clouds, truth[1])
    assert found.log_odds()[0] < 0.0
    assert np.abs(se2.between(truth[1], found.sound.pose[0])).max() < 0.01


def crowd(moving, seed):
    """Return clouds of a standing robot among 12 posts, a share of which is elsewhere in each scan."""
    rng = np.random.default_rng(seed)
    bearing = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    parts = []
    for _ in range(60):
        away = np.where(rng.random(12) < moving, rng.uniform(1.5, 4.5, 12), 3.0)
        turn = np.linspace(-0.06, 0.06, 9)
        angle = (bearing[:, None] + turn).ravel()
        normals = -np.column_stack([np.cos(angle), np.sin(angle)])
        points = -normals * np.repeat(away, 9)[:, None] + 0.005 * rng.standard_normal((len(angle), 2))
        owner, scatter = np.zeros(len(angle), np.int32), np.full(len(angle), 1e-4)
        parts.append(Clouds(np.array([0, len(angle)]), points, normals, owner, scatter))
    return joined(parts)


@pytest.mark.parametrize(("moving", "seen"), [(0.0, 0.0), (0.2, 0.2)])
def test_how_often_things_move_is_learnt(moving, seen):
    """Of the posts that are elsewhere in one of two scans, 0.32 of all, half are nearer than what hides them from the other.

    They are 0.16 of all and, with those of both, 0.18 of 0.82 that say anything; one in ten is by chance where it was before.
    """
    clouds = crowd(moving, 4)
    i, still = np.arange(59), np.zeros((59, 3))
    pairs = pairs_of(clouds, i, i + 1)
    judge = ObjectLikelihood.of(rasterize(clouds, 0.1, 0.5), SIGMA, pairs, still).learnt(pairs, still)
    # Three standard deviations of a share of 580 posts, and what is expected beforehand.
    assert judge.moves == pytest.approx(seen, abs=3.0 * np.sqrt(max(seen, 1e-3) / 580))


def test_the_other_steps_of_a_slip_place_a_cloud_where_its_surfaces_do_not():
    """Along a wall nothing shows the way: it is what the wheels count, or what they counted too much just before and after."""
    wall = np.array([[-50.0, 1.0, 50.0, 1.0]])
    clouds = scanned(np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]), wall)
    seen, pairs, prior, found = registered(clouds, np.array([0.4, 0.0, 0.2]))
    assert after_slip(found)[0] == pytest.approx(0.4, abs=0.05)
    sigma = np.sqrt(np.diag(prior.slipped.covariance[0]))
    matrix = 400.0 * np.eye(3)[None]
    expected = FalseMotions(matrix @ (np.array([-0.3, 0.0, -0.2]) / sigma), matrix)
    again = with_neighbours(seen, pairs, found, expected)
    assert np.abs(after_slip(again) - [0.1, 0.0, 0.0]).max() < 0.02


def test_clouds_without_surfaces_leave_the_prior_as_it_is():
    truth = np.zeros((2, 3))
    *_, prior, found = registered(scanned(truth, ROOM + 100.0), [0.3, 0.0, 0.1])
    assert found.log_odds().tolist() == [0.0]
    np.testing.assert_allclose(found.sound.pose, [[0.3, 0.0, 0.1]])
    np.testing.assert_allclose(registration_law.covariance(found.sound, prior.sound)[0], np.diag(SOUND**2), rtol=1e-9)
    assert not found.sound.measured(SIGMA**2)[1].any()


def test_objects_end_at_gaps_and_at_the_end_of_a_cloud(room):
    _, clouds = room
    number, length = objects(clouds, 0.4)
    for k in range(2):
        rows = slice(clouds.offsets[k], clouds.offsets[k + 1])
        away = np.hypot(*np.diff(clouds.points[rows].astype(float), axis=0).T)
        np.testing.assert_array_equal(number[rows], np.concatenate([[0], np.cumsum(away > 0.4)]))
        for n in np.unique(number[rows]):
            own = np.flatnonzero(number[rows] == n)
            np.testing.assert_allclose(length[rows][own], away[own[:-1]].sum())


def test_points_match_by_chance_in_clutter_and_hardly_in_a_room(room):
    """Shelves each 0.4 m along both axes match wherever they are laid; the walls of a room do not."""
    truth, clouds = room
    shelves = [[x, y, x + 0.15, y] for x in np.arange(-2.8, 2.8, 0.4) for y in np.arange(-2.6, 2.6, 0.4)]
    full = scanned(truth, np.array(shelves), 0.005, 4)
    one, step = np.array([0]), se2.between(truth[:1], truth[1:])
    shares = [matched_by_chance(rasterize(c, 0.1, 0.5), pairs_of(c, one, one + 1), step)[0] for c in (clouds, full)]
    assert shares[0] < 0.2
    assert shares[1] > shares[0] + 0.1


def test_what_never_matched_by_chance_has_the_share_of_the_rule_of_succession(room):
    """One match of three is known beforehand; then none of so many points, laid at four places."""
    truth, clouds = room
    one, far = np.array([0]), se2.between(truth[:1], truth[1:]) + np.array([50.0, 0.0, 0.0])
    pairs = pairs_of(clouds, one, one + 1)
    shares = matched_by_chance(rasterize(clouds, 0.1, 0.5), pairs, far)
    assert shares.tolist() == pytest.approx([1.0 / (4.0 * np.sum(pairs.points >= 0) + 3.0), 1.0 / 3.0])


def test_of_placements_called_right_with_a_probability_that_share_is_right():
    """Pairs of a walk through a hall, a fifth of them with wheels that slipped by half a metre."""
    truth, _, clouds = walked(7, HALL, 60.0)
    law = registration_law.placements(clouds, truth, 1, np.random.default_rng(1), 0.005)
    for limit in (0.5, 0.9):
        sure = law.probability > limit
        assert sure.sum() > 0.5 * len(sure)
        # Three standard deviations of a share.
        expected = law.probability[sure].mean()
        assert law.right[sure].mean() > expected - 3.0 * np.sqrt(expected * (1.0 - expected) / sure.sum())
    assert law.log_score > np.log(0.8)
    assert registration_law.report([("walk", law)]).count("walk |") >= 2


def test_the_likelier_place_has_the_probability_of_its_evidence(room):
    """No more than one pair of clouds can be trusted; where clouds show nothing, that of the prior."""
    truth, clouds = room
    step, certain = se2.between(truth[0], truth[1]), 1.0 - RegistrationConfig.useless
    for slip in (np.zeros(3), np.array([0.25, 0.0, 0.2])):
        *_, found = registered(clouds, step + slip)
        place, _, probability = registration_law.likelier_places(found, 0.01)
        assert np.abs(se2.between(step, place.pose[0])).max() < 0.015
        assert probability[0] == pytest.approx(certain, abs=0.01)
    *_, found = registered(scanned(np.zeros((2, 3)), ROOM + 100.0), step)
    place, _, probability = registration_law.likelier_places(found, 0.2)
    assert not place.shown[0]
    assert probability[0] == pytest.approx(0.8 * certain**2, abs=0.01)


def test_along_a_wall_of_scattered_normals_no_place_is_certain():
    """The scatter feigns information along it, by which a place half a metre off the truth would be certain to centimetres."""
    clouds = scanned(np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]), np.array([[-50.0, 1.0, 50.0, 1.0]]), 0.02, 3)
    *_, found = registered(clouds, np.array([0.4, 0.0, 0.1]))
    place, _ = found.likeliest(found.prior.slipped)
    sigma = np.sqrt(np.diag(registration_law.covariance(place, found.prior.slipped)[0]))
    assert sigma[0] > 0.9 * np.hypot(SLIPPED[0], SOUND[0])
    assert sigma[1:].max() < 0.02
    assert place.pose[0, 0] == pytest.approx(0.4, abs=0.05)


def test_views_outweigh_the_prior_each_by_itself():
    """A place that fits by chance in all of them loses; a false view counts as one; they say no more than the best of them."""
    here, bound = np.full((6, 1), -5.0), np.log(1.0 / RegistrationConfig.useless - 1.0)
    chance, place, one = np.full(6, -8.0), np.full(6, 30.0), np.array([30.0, -8.0, -8.0, -8.0, -8.0, -8.0])
    odds = odds_by_views(here, np.stack([chance, place, one], axis=1))
    assert odds[0] < 0.0
    assert odds[1] == pytest.approx(6.0 * bound, rel=1e-3)
    assert odds[2] < bound
    # Six views that each tell the places apart by one unit see the same.
    assert odds_by_views(np.full((6, 1), 1.0), np.full((6, 1), 2.0))[0] == pytest.approx(1.0, abs=0.05)


def test_evidence_that_may_be_wrong_is_bounded_and_keeps_its_sign():
    odds = np.array([-400.0, -2.0, 0.0, 2.0, 400.0])
    bounded = of_fallible(odds, 0.05)
    np.testing.assert_allclose(bounded, -bounded[::-1], atol=1e-12)
    np.testing.assert_allclose(bounded[[0, 2, 4]], [-np.log(19.0), 0.0, np.log(19.0)], atol=1e-9)
    assert np.all(np.diff(bounded) > 0.0)
    np.testing.assert_allclose(of_fallible(odds[1:4], 0.0), odds[1:4])
