"""The point-to-line factor: derivatives, partners, what scatter feigns."""

import numpy as np
import pytest
import scipy.linalg
from helpers.registration_worlds import CORRIDOR, ROOM, pair, wall_points

from uwblite import se2
from uwblite.graph.robust import SQUARED, Kernel
from uwblite.lidar.line_factor import LineFactorConfig, line_rows, line_system, source_rows, trusted_part, trusted_step
from uwblite.lidar.point_cloud import make_cloud

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
    line_rows(target, raster, rows, TRUTH, config, False)
    return lambda p: line_rows(target, raster, rows, p, config, False)


def _factor(target, source, pose, config=None):
    """Match once and linearise."""
    config = config or LineFactorConfig()
    two_sided = not (target.oriented and source.oriented)
    rows = line_rows(
        target, target.raster(config.gate), source_rows(source.centers, source.normals), pose, config, two_sided
    )
    return line_system(rows, config)


@pytest.mark.parametrize("kernel", [SQUARED, Kernel("cauchy", 2.0), Kernel("tukey", 3.0)])
def test_gradient_and_jacobian_are_the_derivatives(kernel):
    rng = np.random.default_rng(0)
    config = LineFactorConfig(gate=0.5, kernel=kernel)
    target, source = pair(ROOM, TRUTH, rng, CENTRE)
    rows_at = _rows(target, source, TRUTH, config)
    pose, step = _off(0.01, -0.02, 0.005), 1e-6
    factor = line_system(rows_at(pose), config)
    for k in range(3):
        ahead, behind = (rows_at(pose + sign * step * np.eye(3)[k]) for sign in (1.0, -1.0))
        cost = [kernel.rho((rows.residual / config.sigma) ** 2).sum() for rows in (ahead, behind)]
        slope = (cost[0] - cost[1]) / (2.0 * step)
        assert 2.0 * factor.gradient[k] == pytest.approx(slope, rel=1e-5, abs=1e-3)
        both = ahead.matched & behind.matched
        numeric = (ahead.residual - behind.residual)[both] / (2.0 * step)
        np.testing.assert_allclose(rows_at(pose).jacobian[k][both], numeric, atol=1e-7)


def test_steps_of_the_factor_lead_to_the_truth():
    rng = np.random.default_rng(3)
    target, source = pair(ROOM, TRUTH, rng, CENTRE)
    pose = _off(0.05, -0.05, 0.02)
    for _ in range(8):
        factor = _factor(target, source, pose)
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
    matched = [_factor(target, s, np.zeros(3)).matched for s in (same, other, unknown)]
    assert matched[0] >= 0.95 * len(same)
    # An end of the wall may have no normal to object with.
    assert matched[1] <= 2
    assert matched[2] >= 0.95 * len(same)


def test_walls_at_right_angles_are_no_partners():
    rng = np.random.default_rng(5)
    across, along = np.array([[0.0, -0.5, 0.0, 0.5]]), np.array([[-0.5, 0.0, 0.5, 0.0]])
    target, source = (make_cloud(wall_points(w, rng, spacing=0.01), np.array([1.0, 1.0])) for w in (across, along))
    assert _factor(target, source, np.zeros(3), LineFactorConfig(gate=0.1)).matched <= 2


@pytest.mark.parametrize("noise", [0.005, 0.015, 0.03])
def test_trusted_part_keeps_rooms_and_drops_the_length_of_corridors(noise):
    along = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        for walls, centre in ((ROOM, CENTRE), (CORRIDOR, (0.0, 0.0))):
            target, source = pair(walls, np.zeros(3), rng, centre, noise=noise)
            factor = _factor(target, source, np.zeros(3))
            raw, trusted = factor.information, trusted_part(factor.information, factor.feigned, 2.0)
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
    trusted = trusted_part(information, feigned, 2.0)
    moved = trusted_part(change @ information @ change.T, change @ feigned @ change.T, 2.0)
    np.testing.assert_allclose(moved, change @ trusted @ change.T, rtol=1e-5, atol=1e-5)
    gradient = rng.normal(size=3)
    step = trusted_step(information, feigned, gradient, 2.0)
    values, vectors = scipy.linalg.eigh(information, feigned)
    kept = vectors[:, values > 2.0]
    np.testing.assert_allclose(step, -kept @ ((kept.T @ gradient) / values[values > 2.0]), rtol=1e-6, atol=1e-9)


def test_lines_without_scatter_are_fully_trusted():
    information = np.diag([4.0, 2.0, 1.0])
    np.testing.assert_allclose(trusted_part(information, np.zeros((3, 3)), 2.0), information, rtol=1e-6)


def test_nothing_matched_is_no_step():
    assert (trusted_step(np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3), 2.0) == 0.0).all()
    assert (trusted_part(np.zeros((3, 3)), np.zeros((3, 3)), 2.0) == 0.0).all()


def test_a_factor_moves_with_the_frame_of_the_target():
    rng = np.random.default_rng(8)
    target, source = pair(ROOM, TRUTH, rng, CENTRE)
    turn = np.array([0.0, 0.0, np.pi / 2])
    turned = make_cloud(se2.transform(turn, target.points), se2.transform(turn, np.asarray(CENTRE)))
    one = _factor(target, source, TRUTH)
    two = _factor(turned, source, se2.compose(turn, TRUTH))
    assert two.information[0, 0] == pytest.approx(one.information[1, 1], rel=0.02)
    assert two.information[2, 2] == pytest.approx(one.information[2, 2], rel=0.02)
