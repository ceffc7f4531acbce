#!/usr/bin/env python3
"""ROS 2 node: the transform map -> odom and /initialpose, from the lines of `uwblite localize --live` on standard input.

    uwblite localize run.log --live --map map | python3 tools/ros2_localization.py
    ... | python3 tools/ros2_localization.py --map-frame map --odom-frame odom --log-time
    ... | python3 tools/ros2_localization.py --ros-args -r __ns:=/robot1 -p use_sim_time:=true

The log's odometry must be what ROS has as odom -> base. The transform is sent with every line while the pose is not lost,
dated --transform-tolerance ahead, so that it serves measurements until the next line comes; once the pose is lost, none is
sent any more, and whoever needs it waits. The topic initialpose (geometry_msgs/PoseWithCovarianceStamped) is sent when the
pose is found, and when it is found again. Stamps are the node's time, or with --log-time those of the log. rclpy, tf2_ros and
geometry_msgs come with ROS 2 and are imported by the node alone.
"""

import argparse
import json
import math
import sys
import threading
from collections.abc import Iterable
from contextlib import suppress
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

    def __init__(self, map_frame: str, odom_frame: str, log_time: bool, ahead: float, ros_args: list[str]) -> None:
        import rclpy
        from builtin_interfaces.msg import Time
        from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
        from rclpy.node import Node
        from tf2_ros import TransformBroadcaster

        rclpy.init(args=ros_args)
        self.node = Node("uwblite_localization")
        self._transform, self._pose, self._time = TransformStamped, PoseWithCovarianceStamped, Time
        self._broadcaster = TransformBroadcaster(self.node)
        self._initial = self.node.create_publisher(PoseWithCovarianceStamped, "initialpose", 10)
        self._frames, self._log_time, self._ahead = (map_frame, odom_frame), log_time, round(1e9 * ahead)
        # It answers questions about its parameters, and follows /clock where time is simulated.
        threading.Thread(target=_spin, args=(self.node,), daemon=True).start()

    def take(self, fix: Fix) -> None:
        """Send what a line says."""
        message = self._transform()
        now = self._now(fix)
        message.header.stamp = self._stamp(now + self._ahead)
        message.header.frame_id, message.child_frame_id = self._frames
        x, y, theta = fix.T_map_odom
        message.transform.translation.x, message.transform.translation.y = x, y
        _turn(message.transform.rotation, theta)
        self._broadcaster.sendTransform(message)
        if fix.found:
            initial = self._pose()
            initial.header.stamp, initial.header.frame_id = self._stamp(now), self._frames[0]
            initial.pose.pose.position.x, initial.pose.pose.position.y = fix.pose[:2]
            _turn(initial.pose.pose.orientation, fix.pose[2])
            initial.pose.covariance = covariance36(fix.covariance)
            self._initial.publish(initial)

    def _now(self, fix: Fix) -> int:
        """Return the time of a line, ns."""
        return round(1e9 * fix.stamp) if self._log_time else int(self.node.get_clock().now().nanoseconds)

    def _stamp(self, nanoseconds: int) -> Any:
        return self._time(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)

    def close(self) -> None:
        """End the node, also where Ctrl-C has ended ROS before."""
        import rclpy

        if rclpy.ok():
            self.node.destroy_node()
        rclpy.try_shutdown()


def _spin(node: Any) -> None:
    """Serve a node until ROS ends."""
    import rclpy
    from rclpy.executors import ExternalShutdownException

    with suppress(ExternalShutdownException, KeyboardInterrupt):
        rclpy.spin(node)


def _turn(rotation: Any, theta: float) -> None:
    rotation.z, rotation.w = math.sin(0.5 * theta), math.cos(0.5 * theta)


def main(argv: list[str] | None = None) -> int:
    """Run the node until standard input ends."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--map-frame", default="map")
    parser.add_argument("--odom-frame", default="odom")
    parser.add_argument("--log-time", action="store_true", help="stamp messages with the log's time, for simulated time")
    text = "s by which the transform is dated ahead (0.5)"
    parser.add_argument("--transform-tolerance", type=float, default=0.5, metavar="S", help=text)
    words = sys.argv[1:] if argv is None else argv
    own = words.index("--ros-args") if "--ros-args" in words else len(words)
    args = parser.parse_args(words[:own])
    try:
        publisher = Publisher(args.map_frame, args.odom_frame, args.log_time, args.transform_tolerance, words[own:])
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
