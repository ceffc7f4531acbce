"""The heading of a robot from an IMU in a bag, however it is mounted and whatever its messages leave out."""

import numpy as np
import pytest
from helpers import bags
from helpers.told import told

from uwblite import se2
from uwblite.errors import ConfigError
from uwblite.io.bag_topics import BagTopics, plan_topics
from uwblite.io.rosbag import plan_bag, read_bag
from uwblite.odometry.gyro import heading_from_gyro

pytest.importorskip("rosbags.highlevel", reason="rosbags is absent")

BIAS, SECONDS = 0.01, 40.0
STAMPS = 100.0 + np.arange(0.0, SECONDS, 0.1)
RATES = np.where(STAMPS < 110.0, 0.0, 0.5 * np.sin(0.3 * (STAMPS - 110.0)))
HEADING = np.concatenate([[0.0], np.cumsum(0.5 * (RATES[1:] + RATES[:-1]) * np.diff(STAMPS))])
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
OVER = (1.0, 0.0, 0.0, 0.0)
SIDEWAYS = (0.5, -0.5, 0.5, 0.5)
"""Turns of the sensor on the base, quaternions x y z w: as it should be, half a turn about x, one axis made another."""


def matrix(q):
    x, y, z, w = q
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def product(a, b):
    """Return the quaternion of turn b, then turn a."""
    (ax, ay, az, aw), (bx, by, bz, bw) = a, b
    return (
        aw * bx + ax * bw + ay * bz - az * by, aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw, aw * bw - ax * bx - ay * by - az * bz,
    )  # fmt: skip


def xyz(values, names="xyz"):
    return dict(zip(names, map(float, values), strict=True))


def imu(k, mount, leave_out=(), unit=1.0, gravity=9.81):
    """Return the message of an IMU that is mounted so on a robot at HEADING[k]."""
    to_sensor = matrix(mount).T
    world = product((0.0, 0.0, np.sin(HEADING[k] / 2), np.cos(HEADING[k] / 2)), mount)
    fields = {
        "angular_velocity": xyz(to_sensor @ [0.0, 0.0, unit * (RATES[k] + BIAS)]),
        "linear_acceleration": xyz(to_sensor @ [0.0, 0.1 * np.sin(k), gravity]),
        "orientation": xyz(world, "xyzw"),
    }
    absent = {f"{name}_covariance": np.array([-1.0, *[0.0] * 8]) for name in leave_out}
    header = {"header": bags.stamped(STAMPS[k], "imu_link")}
    return STAMPS[k], "/imu/data", "sensor_msgs/msg/Imu", {**header, **fields, **absent}


def wheels(k, slip=0.8):
    """Return wheels that turn too little."""
    theta = slip * HEADING[k] / 2
    place = {"x": 0.2 * max(STAMPS[k] - 110.0, 0.0)}
    pose = {"position": place, "orientation": xyz((np.sin(theta), np.cos(theta)), "zw")}
    fields = {"header": bags.stamped(STAMPS[k], "odom"), "child_frame_id": "base_link", "pose": {"pose": pose}}
    return STAMPS[k], "/odom", "nav_msgs/msg/Odometry", fields


def mounted(mount):
    turned = {"translation": {}, "rotation": xyz(mount, "xyzw")}
    step = {"header": bags.stamped(1.0, "base_link"), "child_frame_id": "imu_link", "transform": turned}
    return STAMPS[0], "/tf_static", "tf2_msgs/msg/TFMessage", {"transforms": [step]}


def bag(path, mount=UPRIGHT, ros=2, tf=None, **options):
    first = [mounted(tf)] if tf else []
    rows = [message for k in range(len(STAMPS)) for message in (wheels(k), imu(k, mount, **options))]
    definitions = {first[0][2]: "geometry_msgs/TransformStamped[] transforms"} if tf and ros == 1 else {}
    bags.write_bag_of(path, first + rows, definitions, ros)
    return path


def worst(log):
    """Return the largest error of the heading that the odometry has with the gyro, rad, and the remark."""
    turned, (remark,) = heading_from_gyro(log)
    off = se2.wrap_angle(turned.odometry.poses[:, 2] - turned.odometry.poses[0, 2] - HEADING)
    return float(np.abs(off).max()), told([remark])[0].text


@pytest.mark.parametrize("mount", [UPRIGHT, OVER, SIDEWAYS])
def test_gravity_says_which_way_is_up(tmp_path, mount):
    log = read_bag(bag(tmp_path / "bag", mount))
    off, remark = worst(log)
    assert off < 2e-3
    assert f"{BIAS:+.5f} rad/s by the robot's rests" in remark
    assert not log.notes.warnings


@pytest.mark.parametrize("mount", [OVER, SIDEWAYS])
def test_without_gravity_the_transforms_do(tmp_path, mount):
    assert worst(read_bag(bag(tmp_path / "bag", mount, tf=mount, leave_out=("linear_acceleration",))))[0] < 2e-3


def test_ros1_bags_and_acceleration_that_points_down(tmp_path):
    assert worst(read_bag(bag(tmp_path / "run.bag", SIDEWAYS, ros=1, tf=SIDEWAYS, gravity=-9.81)))[0] < 2e-3


@pytest.mark.parametrize("mount", [UPRIGHT, OVER, SIDEWAYS])
def test_orientations_do_where_there_are_no_rates(tmp_path, mount):
    log = read_bag(bag(tmp_path / "bag", mount, leave_out=("angular_velocity", "linear_acceleration")))
    assert log.gyro.heading == pytest.approx(HEADING, abs=1e-6)


def test_what_only_the_wheels_show_is_set_right_and_said(tmp_path):
    log = read_bag(bag(tmp_path / "over", OVER, leave_out=("linear_acceleration",)))
    assert any("no transform from base_link to imu_link" in warning for warning in log.notes.warnings)
    off, remark = worst(log)
    assert off < 2e-3
    assert "turned over" in remark
    off, remark = worst(read_bag(bag(tmp_path / "degrees", unit=np.degrees(1.0))))
    assert off < 2e-3
    assert "degrees" in remark


def test_a_mounting_that_gravity_contradicts_is_named(tmp_path):
    log = read_bag(bag(tmp_path / "bag", SIDEWAYS, tf=UPRIGHT))
    assert any("imu_link is tilted otherwise" in warning for warning in log.notes.warnings)


def test_messages_that_no_gyro_sends_are_left_out_and_counted(tmp_path):
    rows = [message for k in range(len(STAMPS)) for message in (wheels(k), imu(k, UPRIGHT))]
    for at, value in ((101, np.nan), (201, 1e300), (301, 1.7e308)):
        rows[at][3]["angular_velocity"] = xyz([0.0, 0.0, value])
    bags.write_bag_of(tmp_path / "bag", rows, {}, 2)
    log = read_bag(tmp_path / "bag")
    assert worst(log)[0] < 0.02
    assert any("3 messages of the IMU" in warning for warning in log.notes.warnings)


def test_messages_without_a_measurement_are_not_used(tmp_path):
    log = read_bag(bag(tmp_path / "bag", leave_out=("angular_velocity", "orientation")))
    assert log.gyro is None
    assert any("neither angular velocities nor orientations" in warning for warning in log.notes.warnings)


def test_an_imu_is_listed_chosen_and_left_out(tmp_path):
    path = bag(tmp_path / "bag")
    topics, plan = plan_bag(path)
    assert plan.role("/imu/data") == "heading"
    assert read_bag(path, BagTopics(imu="none")).gyro is None
    with pytest.raises(ConfigError, match=r"/odom is of type nav_msgs/Odometry; headings are read from sensor_msgs/Imu"):
        read_bag(path, BagTopics(imu="/odom"))
    camera = [*topics, topics[0].__class__("/camera/imu", "sensor_msgs/msg/Imu", 99999)]
    assert plan_topics(tuple(camera), lambda _name: ()).imu == "/imu/data"
    assert "/camera/imu" in plan_topics(tuple(camera), lambda _name: ()).passed_over
