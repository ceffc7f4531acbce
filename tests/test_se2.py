import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from uwblite import se2

ANGLES = np.concatenate([[0.0], np.logspace(-16, np.log10(np.pi), 300)[:-1], [np.pi]])
"""Log grid of angles, exact 0, and pi itself."""
SIGNED = np.concatenate([-ANGLES[::-1], ANGLES])

lengths = st.floats(-1e3, 1e3)
angles = st.one_of(st.sampled_from(list(SIGNED)), st.floats(-np.pi, np.pi))
poses = st.builds(lambda *v: np.array(v), lengths, lengths, angles)
points = st.builds(lambda *v: np.array(v), lengths, lengths)


def assert_same(a, b, atol=1e-9):
    """Compare poses, angles modulo 2 pi."""
    np.testing.assert_allclose(a[..., :2], b[..., :2], atol=atol)
    turn = np.remainder(a[..., 2] - b[..., 2] + np.pi, 2 * np.pi) - np.pi
    np.testing.assert_allclose(turn, 0.0, atol=atol)


def matrix(pose):
    x, y, theta = pose
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, -s, x], [s, c, y], [0.0, 0.0, 1.0]])


@given(st.lists(angles, min_size=1))
def test_a_rotation_is_a_pose_at_the_origin_as_a_matrix(turns):
    expected = [matrix((0.0, 0.0, theta)) for theta in turns]
    np.testing.assert_array_equal(se2.rotation(turns), expected)
    np.testing.assert_array_equal(se2.rotation(turns[0]), expected[0])


@given(poses, poses, poses)
def test_compose_is_associative(a, b, c):
    assert_same(se2.compose(a, se2.compose(b, c)), se2.compose(se2.compose(a, b), c))


@given(poses)
def test_inverse_undoes(a):
    assert_same(se2.compose(a, se2.inverse(a)), np.zeros(3))
    assert_same(se2.compose(se2.inverse(a), a), np.zeros(3))


@given(poses, poses)
def test_between_is_the_inverse_composed(a, b):
    assert_same(se2.between(a, b), se2.compose(se2.inverse(a), b))
    assert_same(se2.compose(a, se2.between(a, b)), b)


@given(poses, poses, points)
def test_transform_follows_compose(a, b, p):
    np.testing.assert_allclose(se2.transform(se2.compose(a, b), p), se2.transform(a, se2.transform(b, p)), atol=1e-9)


@pytest.mark.parametrize("count", [0, 50, 40_000])
def test_points_of_several_poses_are_transformed_as_one_by_one(count):
    rng = np.random.default_rng(0)
    poses, owner, points = rng.normal(size=(7, 3)) * 4.0, rng.integers(7, size=count), rng.normal(size=(count, 2))
    found = se2.transform_each(poses, owner, points)
    for k, pose in enumerate(poses):
        np.testing.assert_allclose(found[owner == k], se2.transform(pose, points[owner == k]), rtol=1e-13, atol=1e-13)


@given(poses, poses)
def test_compose_is_the_product_of_matrices(a, b):
    np.testing.assert_allclose(matrix(se2.compose(a, b)), matrix(a) @ matrix(b), atol=1e-9)


@given(poses)
def test_exp_undoes_log(a):
    # At a half turn log divides by sin(theta/2)/(theta/2) = 2/pi, never by less.
    assert_same(se2.exp(se2.log(a)), a)


@given(poses)
def test_log_undoes_exp(xi):
    assume(xi[2] > -np.pi)  # the other half turn ends in the same pose
    np.testing.assert_allclose(se2.log(se2.exp(xi)), [*xi[:2], se2.wrap_angle(xi[2])], atol=1e-9)


@pytest.mark.parametrize("v", [(1.0, 0.0), (0.0, 1.0), (3.0, -2.0)])
def test_exp_agrees_with_a_matrix_series_on_the_log_grid_of_angles(v):
    """The generator's exponential by scaling and squaring of its Taylor series: no division by the angle anywhere."""
    for theta in SIGNED:
        generator = np.array([[0.0, -theta, v[0]], [theta, 0.0, v[1]], [0.0, 0.0, 0.0]]) / 2.0**6
        term, total = np.eye(3), np.eye(3)
        for k in range(1, 16):
            term = term @ generator / k
            total = total + term
        for _ in range(6):
            total = total @ total
        np.testing.assert_allclose(matrix(se2.exp([*v, theta])), total, atol=3e-14)


def test_exp_and_log_are_inverse_to_rounding_on_the_log_grid_of_angles():
    theta = SIGNED[1:]
    xi = np.stack([np.full_like(theta, 2.0), np.full_like(theta, -1.0), theta], axis=1)
    back = se2.log(se2.exp(xi))
    np.testing.assert_allclose(back[:, :2], xi[:, :2], atol=1e-14)
    np.testing.assert_array_equal(back[:, 2], theta)
    assert se2.log(se2.exp([2.0, -1.0, -np.pi]))[2] == np.pi


def test_series_and_closed_form_agree_where_they_meet():
    edge = 1e-2
    below, above = np.nextafter(edge, 0.0), np.nextafter(edge, 1.0)
    np.testing.assert_allclose(se2.exp([1.0, 1.0, below]), se2.exp([1.0, 1.0, above]), atol=1e-15)


def test_exact_zero_turn_is_a_straight_line():
    np.testing.assert_array_equal(se2.exp([1.5, -2.5, 0.0]), [1.5, -2.5, 0.0])
    np.testing.assert_array_equal(se2.log([1.5, -2.5, 0.0]), [1.5, -2.5, 0.0])


@pytest.mark.parametrize(
    ("angle", "expected"),
    [
        (np.pi, np.pi),
        (-np.pi, np.pi),
        (3 * np.pi, np.pi),
        (-3 * np.pi, np.pi),
        (0.0, 0.0),
        (2 * np.pi, 0.0),
        (np.pi + 1e-9, -np.pi + 1e-9),
        (-np.pi + 1e-9, -np.pi + 1e-9),
        (-np.pi - 1e-9, np.pi - 1e-9),
    ],
)
def test_wrap_at_half_turns(angle, expected):
    assert se2.wrap_angle(angle) == pytest.approx(expected, abs=1e-15)


@given(st.floats(-1e6, 1e6))
def test_wrapped_angles_lie_in_the_half_open_interval_and_keep_their_direction(angle):
    wrapped = float(se2.wrap_angle(angle))
    assert -np.pi < wrapped <= np.pi
    # The remainder of an angle of 1e6 is exact to 1e6 eps.
    assert np.cos(wrapped - angle) == pytest.approx(1.0, abs=1e-9)


@given(poses, poses)
def test_interpolation_meets_its_ends(a, b):
    assert_same(se2.interpolate(a, b, 0.0), a)
    assert_same(se2.interpolate(a, b, 1.0), b, atol=1e-8)


def test_interpolation_follows_the_arc():
    quarter = se2.interpolate(np.zeros(3), np.array([1.0, 1.0, np.pi / 2]), 0.5)
    np.testing.assert_allclose(quarter, [np.sin(np.pi / 4), 1 - np.cos(np.pi / 4), np.pi / 4], atol=1e-15)


def test_trajectories_are_interpolated_in_time_and_fixed_at_their_ends():
    stamps = np.array([0.0, 1.0, 1.0, 3.0])
    path = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [5.0, 0.0, 0.0], [7.0, 0.0, 0.0]])
    at = se2.interpolate_trajectory(stamps, path, np.array([-1.0, 0.5, 1.0, 2.0, 9.0]))
    np.testing.assert_allclose(at[:, 0], [0.0, 0.5, 5.0, 6.0, 7.0])
    np.testing.assert_array_equal(se2.interpolate_trajectory(stamps[:1], path[:1], np.array([4.0])), path[:1])
    ends = se2.interpolate_trajectory(np.array([2.0, 2.0, 4.0, 4.0]), path, np.array([1.0, 2.0, 4.0, 5.0]))
    np.testing.assert_allclose(ends[:, 0], [0.0, 1.0, 7.0, 7.0])


@given(poses, poses)
def test_jacobians_equal_differences(a, b):
    by_a, by_b = se2.between_jacobians(a, b)
    step = 1e-6
    for k in range(3):
        d = np.zeros(3)
        d[k] = step
        for analytic, ahead, behind in (
            (by_a, se2.between(a + d, b), se2.between(a - d, b)),
            (by_b, se2.between(a, b + d), se2.between(a, b - d)),
        ):
            slope = ahead - behind
            slope[2] = se2.wrap_angle(slope[2])
            # Lengths of 1e3: rounding 1e-13 over 1e-6, and the third derivative times step^2.
            np.testing.assert_allclose(analytic[:, k], slope / (2 * step), atol=1e-6)


@pytest.mark.parametrize("query", [0.0, np.array([-1.0, 5.0, 9.0]), np.zeros((2, 3)), np.zeros(0)])
def test_a_trajectory_of_one_pose_holds_everywhere(query):
    pose = np.array([[1.0, -2.0, 0.5]])
    found = se2.interpolate_trajectory(np.array([5.0]), pose, query)
    assert found.shape == (*np.shape(query), 3)
    np.testing.assert_array_equal(found, np.broadcast_to(pose[0], found.shape))
    found += 1.0
    np.testing.assert_array_equal(pose[0], [1.0, -2.0, 0.5])


def test_bits_do_not_depend_on_where_angles_lie_in_memory():
    rng = np.random.default_rng(1)
    table = rng.uniform(-3.0, 3.0, size=(199, 3))
    columns = np.ascontiguousarray(table.T)
    for shift in range(8):
        elsewhere = np.concatenate([np.zeros(shift), table.ravel()])[shift:].reshape(-1, 3)
        for ours, theirs in zip(se2.cos_sin(elsewhere[:, 2]), se2.cos_sin(columns[2]), strict=True):
            assert ours.tobytes() == theirs.tobytes()
        assert se2.exp(elsewhere).tobytes() == se2.exp(columns.T.copy()).tobytes()
        assert se2.compose(elsewhere, elsewhere[::-1]).tobytes() == se2.compose(table, table[::-1].copy()).tobytes()


def test_functions_broadcast_over_leading_axes():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(4, 1, 3)), rng.normal(size=(5, 3))
    for function in (se2.compose, se2.between):
        both = function(a, b)
        assert both.shape == (4, 5, 3)
        np.testing.assert_array_equal(both[2, 3], function(a[2, 0], b[3]))
    assert se2.exp(a).shape == se2.log(a).shape == se2.inverse(a).shape == (4, 1, 3)
    assert se2.transform(a, b[:, :2]).shape == (4, 5, 2)
    assert se2.between_jacobians(a, b)[1].shape == (4, 5, 3, 3)


@given(st.floats(-50, 50), st.floats(-50, 50), st.floats(-3.1, 3.1))
def test_alignment_undoes_any_rigid_motion(x, y, theta):
    points = np.random.default_rng(0).normal(scale=5.0, size=(50, 2))
    moved = se2.transform(np.array([x, y, theta]), points)
    np.testing.assert_allclose(se2.transform(se2.align(points, moved), points), moved, atol=1e-9)


def test_alignment_is_the_least_squares_one():
    rng = np.random.default_rng(1)
    source, target = rng.normal(size=(2, 30, 2))
    best = se2.align(source, target)

    def cost(motion):
        return np.sum((se2.transform(motion, source) - target) ** 2)

    for k in range(3):
        for step in (-1e-3, 1e-3):
            nudge = np.zeros(3)
            nudge[k] = step
            assert cost(best + nudge) > cost(best)


def test_a_bearing_is_the_angle_of_each_vector():
    angle = np.linspace(-3.1, 3.1, 24).reshape(2, 3, 4)
    vectors = np.stack([2.0 * np.cos(angle), 2.0 * np.sin(angle)], axis=-1)
    np.testing.assert_allclose(se2.bearing(vectors), angle, atol=1e-12)
    assert se2.bearing([-1.0, 0.0]) == np.pi


def test_a_single_value_of_a_pose_is_copied_before_its_cosine_is_taken(monkeypatch):
    """numpy 1.24 rounds otherwise where the output begins within one stride of the input, as a single value with the stride of
    a pose has it by chance."""
    seen, cosine = [], np.cos
    monkeypatch.setattr(np, "cos", lambda angle: seen.append(angle) or cosine(angle))
    pose = np.array([[1.0, 2.0, 3.0]])
    se2.cos_sin(pose[:, 2])
    assert seen[0].strides == (8,)
    assert not np.shares_memory(seen[0], pose)
