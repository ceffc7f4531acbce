"""The point-to-line factor: derivatives, batches, what scatter feigns."""

import dataclasses

import numpy as np
import pytest
from registration_worlds import CORRIDOR, ROOM, pair, wall_points

from uwblite import se2
from uwblite.line_factor import (
    LineFactorConfig,
    line_rows,
    line_system,
    pair_factor,
    pair_factors,
    source_rows,
    trusted_part,
    trusted_step,
)
from uwblite.point_cloud import make_cloud
from uwblite.robust import SQUARED, Kernel

TRUTH = np.array([0.4, -0.3, 0.2])
CENTRE = (3.0, 1.5)


def _off(x, y, theta):
    """Return the truth put out by so much."""
    return TRUTH + np.array([x, y, theta])


def _rows(target, source, pose, config):
    """Rows with the association of TRUTH held fixed, so that chi2 is a smooth function of the pose."""

    class Fixed:
        index = None

        def lookup(self, x, y):
            if self.index is None:
                self.index = target.raster(config.gate).lookup(x, y)
            return self.index

    raster = Fixed()
    rows = source_rows(source.centers, source.normals)
    line_rows(target, raster, rows, (np.cos(TRUTH[2]), np.sin(TRUTH[2]), TRUTH[0], TRUTH[1]), config, False)
    return lambda p: line_rows(target, raster, rows, (np.cos(p[2]), np.sin(p[2]), p[0], p[1]), config, False)


@pytest.mark.parametrize("kernel", [SQUARED, Kernel("cauchy", 2.0), Kernel("tukey", 3.0)])
def test_gradient_and_jacobian_are_the_derivatives(kernel):
    rng = np.random.default_rng(0)
    config = LineFactorConfig(gate=0.5, kernel=kernel)
    target, source = pair(ROOM, TRUTH, rng, CENTRE)
    rows_at = _rows(target, source, TRUTH, config)
    pose, step = _off(0.01, -0.02, 0.005), 1e-6
    factor, _ = line_system(rows_at(pose), config)
    for k in range(3):
        ahead, behind = (rows_at(pose + sign * step * np.eye(3)[k]) for sign in (1.0, -1.0))
        slope = (ahead.cost.sum() - behind.cost.sum()) / (2.0 * step)
        assert 2.0 * factor.gradient[k] == pytest.approx(slope, rel=1e-5, abs=1e-3)
        both = ahead.matched & behind.matched
        numeric = (ahead.residual - behind.residual)[both] / (2.0 * step)
        np.testing.assert_allclose(rows_at(pose).jacobian[k][both], numeric, atol=1e-7)


def test_a_batch_is_its_pairs_one_by_one():
    rng = np.random.default_rng(1)
    config = LineFactorConfig()
    target, one = pair(ROOM, TRUTH, rng, CENTRE)
    sources = [one, make_cloud(one.points[:40], one.points[0]), make_cloud(np.zeros((0, 2))), make_cloud(one.points + 50.0)]
    transforms = TRUTH + rng.normal(0.0, 0.02, (4, 3))
    counts = np.array([len(s) for s in sources])
    points, normals = (np.vstack([getattr(s, name) for s in sources]) for name in ("centers", "normals"))
    batch = pair_factors(target, points, normals, counts, transforms, config)
    assert batch.matched[0] > 300
    assert batch.matched[2] == batch.matched[3] == 0
    assert (batch.information[2:] == 0.0).all()
    for k in (0, 1, 3):
        single = pair_factor(target, dataclasses.replace(sources[k], oriented=True), transforms[k], config)
        for name in ("information", "gradient", "chi2", "matched"):
            np.testing.assert_allclose(getattr(batch, name)[k], getattr(single, name), rtol=1e-6, atol=1e-6)


def test_an_empty_batch_is_empty():
    target = make_cloud(wall_points(ROOM, np.random.default_rng(2)))
    factor = pair_factors(target, np.zeros((0, 2)), None, np.zeros(0, int), np.zeros((0, 3)), LineFactorConfig())
    assert factor.information.shape == (0, 3, 3)


def test_steps_of_the_factor_lead_to_the_truth():
    rng = np.random.default_rng(3)
    target, source = pair(ROOM, TRUTH, rng, CENTRE)
    pose = _off(0.05, -0.05, 0.02)
    for _ in range(8):
        factor = pair_factor(target, source, pose, LineFactorConfig())
        pose = pose - np.linalg.solve(factor.information, factor.gradient)
    # Residuals of some 400 points at 0.02 m: the pose is known to 2 mm and 1 mrad.
    assert np.hypot(*(pose - TRUTH)[:2]) < 0.008
    assert abs(pose[2] - TRUTH[2]) < 0.004


def test_the_other_side_of_a_wall_is_no_partner():
    rng = np.random.default_rng(4)
    wall = np.array([[0.0, 0.0, 4.0, 0.0]])
    target = make_cloud(wall_points(wall, rng), np.array([2.0, 2.0]))
    same, other = (make_cloud(wall_points(wall, rng), np.array([2.0, y])) for y in (1.0, -1.0))
    unknown = make_cloud(same.points)
    matched = [int(pair_factor(target, s, np.zeros(3), LineFactorConfig()).matched) for s in (same, other, unknown)]
    assert matched[0] >= 0.95 * len(same)
    # An end of the wall may have no normal to object with.
    assert matched[1] <= 2
    assert matched[2] >= 0.95 * len(same)


def test_walls_at_right_angles_are_no_partners():
    rng = np.random.default_rng(5)
    across, along = np.array([[0.0, -0.5, 0.0, 0.5]]), np.array([[-0.5, 0.0, 0.5, 0.0]])
    target, source = (make_cloud(wall_points(w, rng, spacing=0.01), np.array([1.0, 1.0])) for w in (across, along))
    assert pair_factor(target, source, np.zeros(3), LineFactorConfig(gate=0.1)).matched <= 2


@pytest.mark.parametrize("noise", [0.005, 0.015, 0.03])
def test_trusted_part_keeps_rooms_and_drops_the_length_of_corridors(noise):
    everything = LineFactorConfig(degeneracy=0.0)
    along = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        for walls, centre in ((ROOM, CENTRE), (CORRIDOR, (0.0, 0.0))):
            target, source = pair(walls, np.zeros(3), rng, centre, noise=noise)
            raw = pair_factor(target, source, np.zeros(3), everything).information
            trusted = pair_factor(target, source, np.zeros(3), LineFactorConfig()).information
            assert raw[0, 0] > 10.0
            assert trusted[1, 1] > 0.9 * raw[1, 1]
            assert (np.linalg.eigvalsh(raw - trusted) > -1e-6 * raw[1, 1]).all()
            assert (np.linalg.eigvalsh(trusted) > -1e-6 * raw[1, 1]).all()
            if walls is ROOM:
                assert trusted[0, 0] > 0.9 * raw[0, 0]
            else:
                # What is known of x when y and theta are free, too.
                known = [1.0 / np.linalg.inv(h + 1e-9 * raw[1, 1] * np.eye(3))[0, 0] for h in (trusted, raw)]
                along.append(known[0] / known[1])
    assert np.median(along) < 1e-3
    assert np.max(along) < 0.5


def test_trusted_part_does_not_depend_on_units_or_frame():
    rng = np.random.default_rng(7)
    half, other, change = rng.normal(size=(3, 3, 3))
    information, feigned = half @ half.T * [10.0], 0.3 * other @ other.T
    trusted, projector = trusted_part(information, feigned, 2.0)
    moved, _ = trusted_part(change @ information @ change.T, change @ feigned @ change.T, 2.0)
    np.testing.assert_allclose(moved, change @ trusted @ change.T, rtol=1e-5, atol=1e-5)
    gradient = rng.normal(size=3)
    step = trusted_step(information, feigned, gradient, 2.0)
    np.testing.assert_allclose(trusted @ step, -projector @ gradient, rtol=1e-6, atol=1e-7)


def test_lines_without_scatter_are_fully_trusted():
    information = np.diag([4.0, 2.0, 1.0])
    np.testing.assert_allclose(trusted_part(information, np.zeros((3, 3)), 2.0)[0], information, rtol=1e-6)


def test_nothing_matched_is_no_step():
    assert (trusted_step(np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3), 2.0) == 0.0).all()
    assert (trusted_part(np.zeros((3, 3)), np.zeros((3, 3)), 2.0)[0] == 0.0).all()


def test_a_factor_moves_with_the_frame_of_the_target():
    rng = np.random.default_rng(8)
    target, source = pair(ROOM, TRUTH, rng, CENTRE)
    turn = np.array([0.0, 0.0, np.pi / 2])
    turned = make_cloud(se2.transform(turn, target.points), se2.transform(turn, np.asarray(CENTRE)))
    one = pair_factor(target, source, TRUTH, LineFactorConfig())
    two = pair_factor(turned, source, se2.compose(turn, TRUTH), LineFactorConfig())
    assert two.information[0, 0] == pytest.approx(one.information[1, 1], rel=0.02)
    assert two.information[2, 2] == pytest.approx(one.information[2, 2], rel=0.02)
