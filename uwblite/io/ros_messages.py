"""ROS 2 messages from arrays, common to a bag of a recording and a bag of a map."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..arrays import Floats
from ..grid.occupancy_grid import OccupancyGrid
from ..sensor_log import SensorLog, SensorMounting

BASE, ODOM, MAP, LASER, TAG = "base_link", "odom", "map", "laser", "uwb_tag"
"""Frames, as REP-105 names them."""


class Messages:
    """Makes messages of one type store; fields that are not given are zero or empty."""

    def __init__(self, store: Any) -> None:
        self._store = store

    def make(self, kind: str, **values: Any) -> Any:
        """Return a message; ``kind`` is such as ``nav_msgs/Path``."""
        name = kind.replace("/", "/msg/")
        fields = self._store.fielddefs[name][1]
        return self._store.types[name](**{f: values[f] if f in values else self._empty(how) for f, how in fields})

    def _empty(self, how: Any) -> Any:
        node, detail = how
        if node.name == "BASE":
            return "" if detail[0] == "string" else False if detail[0] == "bool" else 0
        if node.name == "NAME":
            return self.make(detail.replace("/msg/", "/"))
        (inner, name), length = detail
        plain = inner.name == "BASE" and name[0] != "string"
        return np.zeros(length, dtype=name[0]) if plain else []

    def header(self, stamp: float, frame: str) -> Any:
        """Return a std_msgs/Header."""
        seconds, rest = divmod(nanoseconds(stamp), 1_000_000_000)
        time = self.make("builtin_interfaces/Time", sec=seconds, nanosec=rest)
        return self.make("std_msgs/Header", stamp=time, frame_id=frame)

    def point(self, x: float, y: float, z: float = 0.0) -> Any:
        """Return a geometry_msgs/Point."""
        return self.make("geometry_msgs/Point", x=float(x), y=float(y), z=float(z))

    def vector(self, x: float, y: float, z: float = 0.0) -> Any:
        """Return a geometry_msgs/Vector3."""
        return self.make("geometry_msgs/Vector3", x=float(x), y=float(y), z=float(z))

    def turn(self, theta: float, flipped: bool = False) -> Any:
        """Return the quaternion of a turn about z, after half a turn about x where the sensor is upside down."""
        c, s = float(np.cos(theta / 2)), float(np.sin(theta / 2))
        x, y, z, w = (c, s, 0.0, 0.0) if flipped else (0.0, 0.0, s, c)
        return self.make("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w)

    def pose(self, pose: Floats) -> Any:
        """Return a geometry_msgs/Pose of x, y, theta."""
        x, y, theta = pose.tolist()
        return self.make("geometry_msgs/Pose", position=self.point(x, y), orientation=self.turn(theta))

    def transform(self, stamp: float, parent: str, child: str, xyz: Sequence[float], turn: Any) -> Any:
        """Return a geometry_msgs/TransformStamped."""
        moved = self.make("geometry_msgs/Transform", translation=self.vector(*xyz), rotation=turn)
        return self.make(
            "geometry_msgs/TransformStamped", header=self.header(stamp, parent), child_frame_id=child, transform=moved
        )

    def tf(self, stamp: float, parent: str, child: str, pose: Floats) -> Any:
        """Return a tf2_msgs/TFMessage with one planar transform T_parent_child."""
        x, y, theta = pose.tolist()
        return self.make("tf2_msgs/TFMessage", transforms=[self.transform(stamp, parent, child, (x, y, 0.0), self.turn(theta))])

    def mounting(self, stamp: float, mounting: SensorMounting, prefix: str = "") -> Any:
        """Return the mounting of laser and tag on the base, as a tf2_msgs/TFMessage."""
        x, y, theta = mounting.T_base_laser.tolist()
        laser = self.transform(stamp, prefix + BASE, prefix + LASER, (x, y, 0.0), self.turn(theta, mounting.laser_flipped))
        tag = self.transform(stamp, prefix + BASE, prefix + TAG, mounting.tag_position.tolist(), self.turn(0.0))
        return self.make("tf2_msgs/TFMessage", transforms=[laser, tag])

    def odometry(self, log: SensorLog, k: int, prefix: str = "") -> Any:
        """Return reading k of the wheels as nav_msgs/Odometry; covariances are zero, that is not known."""
        pose = self.make("geometry_msgs/PoseWithCovariance", pose=self.pose(log.odometry.poses[k]))
        header = self.header(float(log.odometry.stamps[k]), prefix + ODOM)
        return self.make("nav_msgs/Odometry", header=header, child_frame_id=prefix + BASE, pose=pose)

    def gyro(self, log: SensorLog, k: int, prefix: str = "") -> Any:
        """Return heading k of the gyro as sensor_msgs/Imu; rate and acceleration are marked as not there (-1)."""
        assert log.gyro is not None
        absent = np.array([-1.0, *[0.0] * 8])
        return self.make(
            "sensor_msgs/Imu", header=self.header(float(log.gyro.stamps[k]), prefix + BASE),
            orientation=self.turn(float(log.gyro.heading[k])), angular_velocity_covariance=absent,
            linear_acceleration_covariance=absent,
        )  # fmt: skip

    def range(self, log: SensorLog, k: int) -> Any:
        """Return range k as sensor_msgs/Range, with the anchor's id as its frame."""
        assert log.ranges is not None
        header = self.header(float(log.ranges.stamps[k]), log.ranges.anchor_ids[log.ranges.anchor[k]])
        value = float(log.ranges.ranges[k])
        return self.make("sensor_msgs/Range", header=header, field_of_view=6.2832, max_range=200.0, range=value)

    def scan(self, log: SensorLog, k: int, prefix: str = "") -> Any:
        """Return scan k as sensor_msgs/LaserScan."""
        scans = log.scans
        assert scans is not None
        return self.make(
            "sensor_msgs/LaserScan",
            header=self.header(float(scans.stamps[k]), prefix + LASER),
            angle_min=scans.angle_min,
            angle_max=scans.angle_min + scans.angle_increment * (scans.ranges.shape[1] - 1),
            angle_increment=scans.angle_increment,
            time_increment=scans.time_increment,
            range_min=scans.range_min,
            range_max=scans.range_max,
            ranges=scans.ranges[k].astype(np.float32),
        )

    def path(self, stamps: Floats, poses: Floats) -> Any:
        """Return a nav_msgs/Path in the map frame."""
        steps = [
            self.make("geometry_msgs/PoseStamped", header=self.header(stamp, MAP), pose=self.pose(pose))
            for stamp, pose in zip(stamps.tolist(), poses, strict=True)
        ]
        return self.make("nav_msgs/Path", header=self.header(float(stamps[0]), MAP), poses=steps)

    def grid(self, stamp: float, grid: OccupancyGrid) -> Any:
        """Return a nav_msgs/OccupancyGrid."""
        g = grid.geometry
        origin = self.pose(np.array([*g.origin, 0.0]))
        info = self.make("nav_msgs/MapMetaData", resolution=g.resolution, width=g.cols, height=g.rows, origin=origin)
        data = grid.states().astype(np.int8).reshape(-1)
        return self.make("nav_msgs/OccupancyGrid", header=self.header(stamp, MAP), info=info, data=data)

    def pose_with_covariance(self, stamp: float, pose: Floats, covariance: Floats) -> Any:
        """Return a geometry_msgs/PoseWithCovarianceStamped of a planar pose and its covariance (3, 3)."""
        full = np.zeros((6, 6))
        planar = [0, 1, 5]
        full[np.ix_(planar, planar)] = covariance
        estimate = self.make("geometry_msgs/PoseWithCovariance", pose=self.pose(pose), covariance=full.reshape(-1))
        return self.make("geometry_msgs/PoseWithCovarianceStamped", header=self.header(stamp, MAP), pose=estimate)

    def marker(self, stamp: float, group: str, number: int, kind: int, colour: Sequence[float], **values: Any) -> Any:
        """Return a visualization_msgs/Marker in the map frame; colour is red, green, blue, alpha, 0..1."""
        r, g, b, a = (float(v) for v in colour)
        return self.make(
            "visualization_msgs/Marker",
            header=self.header(stamp, MAP),
            ns=group,
            id=number,
            type=kind,
            color=self.make("std_msgs/ColorRGBA", r=r, g=g, b=b, a=a),
            **({"pose": self.pose(np.zeros(3))} | values),
        )


def nanoseconds(stamp: float) -> int:
    """Return a time as ROS counts it."""
    return round(stamp * 1e9)
