"""Where the laser looks, from how it sees the robot drive."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.told import told

from uwblite import se2
from uwblite.screening import directions
from uwblite.screening.directions import heading_with_the_path, laser_ahead
from uwblite.screening.wheel_motion import Pairs
from uwblite.sensor_log import Odometry, SensorLog, SensorMounting


def pairs_of_a_laser_turned_by(angle: float, stuck: float) -> Pairs:
    """Ways of 0.12 m and small turns; of a share of the pairs, along bare walls, the lidar repeats what the wheels said."""
    rng, count = np.random.default_rng(3), 200
    wheels = np.column_stack([np.full(count, 0.12), np.zeros(count), rng.normal(0.0, 0.05, count)])
    lidar = np.column_stack([se2.rotate(np.full(count, -angle), wheels[:, :2]), wheels[:, 2]])
    lidar[:, :2] += rng.normal(0.0, 0.004, (count, 2))
    kept = rng.permutation(count) < stuck * count
    lidar[kept] = wheels[kept]
    return Pairs(np.arange(count) * 1.0, np.arange(count) + 0.3, lidar, wheels, np.ones(count))


@pytest.mark.parametrize("angle", [np.pi, np.pi / 2, -np.pi / 2, 0.5])
@pytest.mark.parametrize("stuck", [0.0, 0.2])
def test_pairs_along_bare_walls_do_not_hide_the_direction_of_the_laser(angle, stuck):
    log = SensorLog(Odometry(np.arange(3.0), np.zeros((3, 3))), None, None)
    turned, facts = laser_ahead(log, pairs_of_a_laser_turned_by(angle, stuck))
    remarks = told(facts)
    assert [r.kind for r in remarks] == ["laser-turned-away"]
    assert abs(se2.wrap_angle(turned.mounting.T_base_laser[2] - angle)) < 0.1


@pytest.mark.parametrize(("seen", "changed", "open_sign"), [
    ({"heading": 1.0, "y": -1.0}, "the sign of its heading", False), ({"heading": -1.0, "y": 1.0}, "the sign of its y", False),
    ({"heading": 0.0, "y": 0.0}, "the sign of its heading", True),
])  # fmt: skip
def test_a_heading_against_its_path_is_mended_as_the_laser_shows(monkeypatch, seen, changed, open_sign):
    """The heading counts the wrong way, or y does; without a laser nothing shows which."""
    stamps = 0.1 * np.arange(400)
    odometry = Odometry(stamps, se2.chain(np.zeros(3), np.tile([0.05, 0.0, 0.02], (399, 1))) * [1.0, 1.0, -1.0])

    def fits(log):
        return seen["heading" if np.array_equal(log.odometry.poses[:, 1], odometry.poses[:, 1]) else "y"]

    monkeypatch.setattr(directions, "_fits_laser", fits)
    done, facts = heading_with_the_path(SensorLog(odometry))
    (remark,) = told(facts)
    sign = [1.0, 1.0, -1.0] if "heading" in changed else [1.0, -1.0, 1.0]
    np.testing.assert_array_equal(done.odometry.poses, odometry.poses * sign)
    assert (remark.kind, f"path: {changed} was inverted" in remark.text) == ("heading-against-path", True)
    assert ("whether the map is mirrored" in remark.text) == open_sign
    assert heading_with_the_path(done) == (done, [])


def test_directions_that_do_not_agree_leave_the_laser_as_given():
    log = SensorLog(Odometry(np.arange(3.0), np.zeros((3, 3))), None, None)
    pairs = pairs_of_a_laser_turned_by(np.pi, 0.4)
    assert laser_ahead(log, pairs) == (log, [])
    anyhow = replace(pairs, lidar=np.random.default_rng(1).normal(0.0, 0.1, pairs.lidar.shape))
    assert laser_ahead(log, anyhow) == (log, [])


@pytest.mark.parametrize("angle", [np.pi, np.pi / 2, -0.6])
@pytest.mark.parametrize("around", [False, True])
def test_turns_show_whether_the_laser_or_the_way_of_driving_is_turned(angle, around):
    """The laser's lever arm swings otherwise: where the wheels drive another way, sensors are carried elsewhere on the base."""
    rng, count = np.random.default_rng(5), 60
    given, tag = np.array([0.2, 0.1, 0.3]), np.array([-0.1, 0.05, 0.6])
    turn = np.array([0.0, 0.0, angle])
    mount = se2.compose(turn, given) if around else given + turn
    wheels = np.column_stack([np.full(count, 0.2), np.zeros(count), rng.uniform(-0.25, 0.25, count)])
    laser = se2.compose(se2.compose(se2.inverse(mount), wheels), mount)
    lidar = se2.compose(se2.compose(given, laser), se2.inverse(given))
    log = SensorLog(Odometry(np.arange(3.0), np.zeros((3, 3))), mounting=SensorMounting(given, tag_position=tag))
    done, facts = laser_ahead(log, Pairs(np.arange(count) * 1.0, np.arange(count) + 0.3, lidar, wheels, np.ones(count)))
    (remark,) = told(facts)
    # The median direction over turns, at which the lever arm shows itself, is known to some hundredths.
    np.testing.assert_allclose(done.mounting.T_base_laser[:2], mount[:2], atol=0.02)
    assert abs(se2.wrap_angle(done.mounting.T_base_laser[2] - mount[2])) < 0.05
    moved = np.append(se2.rotate(angle, tag[:2]), 0.6) if around else tag
    np.testing.assert_allclose(done.mounting.tag_position, moved, atol=0.01)
    assert f"differs by {np.degrees(angle):+.0f}"[:13] in remark.text
