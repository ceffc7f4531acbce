"""The ROS 2 node, against a stub of what it uses of ROS."""

import io
import json
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import ros2_localization as node

from uwblite import se2


def line(stamp, pose, odometry, lost=False):
    return json.dumps({"stamp": stamp, "pose": pose, "covariance": COVARIANCE, "odometry": odometry, "lost": lost}) + "\n"


COVARIANCE = [[0.01, 0.001, 0.002], [0.001, 0.02, 0.003], [0.002, 0.003, 0.04]]


def test_map_to_odom_takes_the_wheels_pose_to_the_maps():
    rng = np.random.default_rng(0)
    for pose, odometry in rng.uniform(-3, 3, (20, 2, 3)):
        np.testing.assert_allclose(se2.compose(node.map_odom(tuple(pose), tuple(odometry)), odometry), pose, atol=1e-12)


def test_a_pose_that_is_found_is_reported_once():
    lines = [line(0, [None] * 3, [0, 0, 0], True), line(1, [1, 2, 0], [0, 0, 0]), line(2, [1, 2, 0], [0, 0, 0]),
             line(3, [1, 2, 0], [0, 0, 0], True), line(4, [1, 2, 0], [0, 0, 0])]  # fmt: skip
    assert [(f.stamp, f.found) for f in node.fixes(lines)] == [(1, True), (2, False), (4, True)]


def test_lines_of_something_else_are_named_and_skipped(capsys):
    assert not list(node.fixes(["nonsense\n", "{}\n", "[1]\n"]))
    assert capsys.readouterr().err.count("is none of uwblite") == 3


NOW = 12_300_000_000
"""ns, of the node's clock."""


def message(*parts):
    """Return a class whose objects have these nested fields."""

    class Message:
        def __init__(self, **fields):
            for part in parts:
                place = self
                for name in part.split("."):
                    if not hasattr(place, name):
                        setattr(place, name, SimpleNamespace())
                    place = getattr(place, name)
            self.__dict__.update(fields)

    return Message


@pytest.fixture
def ros(monkeypatch):
    """Stand-ins for the modules of ROS 2; what was sent is noted."""
    sent = SimpleNamespace(transforms=[], poses=[], ended=[], arguments=[])
    names = ("rclpy", "rclpy.node", "rclpy.executors", "geometry_msgs", "geometry_msgs.msg", "tf2_ros")
    modules = {name: ModuleType(name) for name in (*names, "builtin_interfaces", "builtin_interfaces.msg")}

    class Node:
        def __init__(self, name):
            self.name = name

        def create_publisher(self, kind, topic, depth):
            assert topic == "initialpose"
            return SimpleNamespace(publish=sent.poses.append)

        def get_clock(self):
            return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=NOW))

        def destroy_node(self):
            sent.ended.append("node")

    modules["rclpy"].init = lambda args: sent.arguments.extend(args)
    modules["rclpy"].ok = lambda: True
    modules["rclpy"].spin = lambda _: None
    modules["rclpy"].try_shutdown = lambda: sent.ended.append("rclpy")
    modules["rclpy.executors"].ExternalShutdownException = type("ExternalShutdownException", (Exception,), {})
    modules["rclpy.node"].Node = Node
    modules["geometry_msgs.msg"].TransformStamped = message("header", "transform.translation", "transform.rotation")
    modules["geometry_msgs.msg"].PoseWithCovarianceStamped = message("header", "pose.pose.position", "pose.pose.orientation")
    modules["tf2_ros"].TransformBroadcaster = lambda _: SimpleNamespace(sendTransform=sent.transforms.append)
    modules["builtin_interfaces.msg"].Time = message()
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    return sent


def test_transforms_and_the_initial_pose_are_sent(ros, monkeypatch):
    text = line(1.5, [1.0, 2.0, 0.5], [0.5, 0.0, 0.1]) + line(2.0, [1.1, 2.0, 0.5], [0.6, 0.0, 0.1])
    monkeypatch.setattr("sys.stdin", io.StringIO(text))
    assert node.main(["--log-time"]) == 0
    assert len(ros.transforms) == 2
    first = ros.transforms[0]
    assert (first.header.frame_id, first.child_frame_id) == ("map", "odom")
    assert (first.header.stamp.sec, first.header.stamp.nanosec) == (2, 0)
    assert 2 * np.arctan2(first.transform.rotation.z, first.transform.rotation.w) == pytest.approx(0.4)
    (initial,) = ros.poses
    assert (initial.header.stamp.sec, initial.header.stamp.nanosec) == (1, 500_000_000)
    matrix = np.reshape(initial.pose.covariance, (6, 6))
    np.testing.assert_array_equal(matrix[np.ix_([0, 1, 5], [0, 1, 5])], COVARIANCE)
    assert not matrix[2:5].any()
    assert ros.ended == ["node", "rclpy"]


def test_stamps_are_ahead_of_the_nodes_clock_and_ros_gets_its_arguments(ros, monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO(line(1.5, [1.0, 2.0, 0.5], [0.5, 0.0, 0.1])))
    words = ["--ros-args", "-r", "__ns:=/robot1"]
    assert node.main(["--transform-tolerance", "0.8", *words]) == 0
    assert (ros.transforms[0].header.stamp.sec, ros.transforms[0].header.stamp.nanosec) == (13, 100_000_000)
    assert ros.arguments == words


def test_without_ros_it_reports_what_is_missing(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    assert node.main([]) == 1
    assert "source the setup of ROS 2" in capsys.readouterr().err
