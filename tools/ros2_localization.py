#!/usr/bin/env python3
"""ROS 2 node: the transform map -> odom and /initialpose, from the lines of `uwblite localize --live` on standard input.

    uwblite localize run.log --live --map map | python3 tools/ros2_localization.py
    ... | python3 tools/ros2_localization.py --map-frame map --odom-frame odom --log-time

The transform is sent with every line while the pose is not lost, and stands otherwise; /initialpose (geometry_msgs/
PoseWithCovarianceStamped) is sent when the pose is found, and when it is found again. Stamps are the node's time, or with
--log-time those of the log. rclpy, tf2_ros and geometry_msgs come with ROS 2 and are imported by the node alone.
"""

import argparse
import json
import math
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

Pose = tuple[float, float, float]


@dataclass(frozen=True)
class Fix:
    """A pose that is not lost."""

    stamp: float
    """s."""
    pose: Pose
    """T_map_base; m, m, rad."""
    covariance: list[list[float]]
    """(3, 3) m, m, rad; map frame."""
    T_map_odom: Pose
    found: bool
    """The line before was lost, or there was none."""


def map_odom(pose: Pose, odometry: Pose) -> Pose:
    """Return T_map_odom = T_map_base T_odom_base^-1."""
    theta = pose[2] - odometry[2]
    c, s = math.cos(theta), math.sin(theta)
    x, y = odometry[0], odometry[1]
    return pose[0] - c * x + s * y, pose[1] - s * x - c * y, math.remainder(theta, 2.0 * math.pi)


def fixes(lines: Iterable[str]) -> Iterable[Fix]:
    """Yield the poses that are not lost; a line that is none is skipped and named on stderr."""
    lost = True
    for number, line in enumerate(lines, 1):
        try:
            record = json.loads(line)
            was, lost = lost, bool(record["lost"])
            if not lost:
                pose, odometry = (tuple(float(v) for v in record[name]) for name in ("pose", "odometry"))
                yield Fix(float(record["stamp"]), pose, record["covariance"], map_odom(pose, odometry), was)
        except (ValueError, KeyError, TypeError) as error:
            print(f"ros2_localization: line {number} is none of uwblite localize --live ({error})", file=sys.stderr)


def covariance36(three: list[list[float]]) -> list[float]:
    """Return the (6, 6) covariance of x, y, z, roll, pitch, yaw, row by row; what does not move has none."""
    full = [0.0] * 36
    for i, a in enumerate((0, 1, 5)):
        for j, b in enumerate((0, 1, 5)):
            full[6 * a + b] = float(three[i][j])
    return full


class Publisher:
    """The node; its modules are ROS 2's."""

    def __init__(self, map_frame: str, odom_frame: str, log_time: bool) -> None:
        import rclpy
        from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
        from rclpy.node import Node
        from tf2_ros import TransformBroadcaster

        rclpy.init()
        self.node = Node("uwblite_localization")
        self._transform, self._pose = TransformStamped, PoseWithCovarianceStamped
        self._broadcaster = TransformBroadcaster(self.node)
        self._initial = self.node.create_publisher(PoseWithCovarianceStamped, "/initialpose", 10)
        self._frames, self._log_time = (map_frame, odom_frame), log_time

    def take(self, fix: Fix) -> None:
        """Send what a line says."""
        message = self._transform()
        message.header.stamp = self._stamp(fix)
        message.header.frame_id, message.child_frame_id = self._frames
        x, y, theta = fix.T_map_odom
        message.transform.translation.x, message.transform.translation.y = x, y
        _turn(message.transform.rotation, theta)
        self._broadcaster.sendTransform(message)
        if fix.found:
            initial = self._pose()
            initial.header.stamp, initial.header.frame_id = message.header.stamp, self._frames[0]
            initial.pose.pose.position.x, initial.pose.pose.position.y = fix.pose[:2]
            _turn(initial.pose.pose.orientation, fix.pose[2])
            initial.pose.covariance = covariance36(fix.covariance)
            self._initial.publish(initial)

    def _stamp(self, fix: Fix) -> Any:
        if not self._log_time:
            return self.node.get_clock().now().to_msg()
        from builtin_interfaces.msg import Time

        seconds = math.floor(fix.stamp)
        return Time(sec=int(seconds), nanosec=int((fix.stamp - seconds) * 1e9))

    def close(self) -> None:
        """End the node."""
        import rclpy

        self.node.destroy_node()
        rclpy.shutdown()


def _turn(rotation: Any, theta: float) -> None:
    rotation.z, rotation.w = math.sin(0.5 * theta), math.cos(0.5 * theta)


def main(argv: list[str] | None = None) -> int:
    """Run the node until standard input ends."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--map-frame", default="map")
    parser.add_argument("--odom-frame", default="odom")
    parser.add_argument("--log-time", action="store_true", help="stamp messages with the log's time, for simulated time")
    args = parser.parse_args(argv)
    try:
        publisher = Publisher(args.map_frame, args.odom_frame, args.log_time)
    except ImportError as error:
        print(f"ros2_localization: {error}; source the setup of ROS 2 first", file=sys.stderr)
        return 1
    try:
        for fix in fixes(sys.stdin):
            publisher.take(fix)
    except KeyboardInterrupt:
        return 130
    finally:
        publisher.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
