# ruff: noqa: E501 (published definitions)
"""Ranges in published kinds of ROS messages: bags made from the published definitions, read without a mapping.

The definitions are those of the repositories named with them, comments left out.
"""

import pytest
from helpers.bags import odometry, stamped, write_bag_of

from uwblite.io.rosbag import read_bag

pytest.importorskip("rosbags.highlevel", reason="rosbags is absent")

NODE2 = "uint8 role\nuint8 id\nfloat32 dis\nfloat32 fp_rssi\nfloat32 rx_rssi"
NODEFRAME3 = "uint8 role\nuint8 id\nuint32 local_time\nuint32 system_time\nfloat32 voltage\n{package}/LinktrackNode2[] nodes"
NODEFRAME2 = (
    "{header}uint8 role\nuint8 id\nuint32 local_time\nuint32 system_time\nfloat32 voltage\nfloat32[3] pos_3d\nfloat32[3] eop_3d\n"
    "float32[3] vel_3d\nfloat32[3] angle_3d\nfloat32[4] quaternion\nfloat32[3] imu_gyro_3d\nfloat32[3] imu_acc_3d\n"
    "{package}/LinktrackNode2[] nodes"
)
TAGFRAME0 = (
    "uint8 role\nuint8 id\nuint32 local_time\nuint32 system_time\nfloat32 voltage\nfloat32[3] pos_3d\nfloat32[3] eop_3d\n"
    "float32[3] vel_3d\nfloat32[8] dis_arr\nfloat32[3] angle_3d\nfloat32[4] quaternion\nfloat32[3] imu_gyro_3d\nfloat32[3] imu_acc_3d"
)
NODES = {"nodes": [{"id": 3, "dis": 4.5}, {"id": 12, "dis": 7.25}]}
TWO_WAY = (
    "std_msgs/Header header\nfloat64 range_raw\nfloat64 range_corr\nfloat32 rr\nuint32 uwb_id1\nuint32 uwb_id2\n"
    "char type_id1\nchar type_id2\nbool los"
)
NTU = (
    "std_msgs/Header header\nuint16 msgId\nuint8 requester_id\nuint8 responder_id\nint8 requester_idx\nint8 responder_idx\n"
    "uint8 range_status\nuint8 antenna\nuint16 stopwatch_time\nfloat32 distance\nfloat32 coarse_range\nfloat32 filtered_range\n"
    "float32 distance_err\nfloat32 coarse_range_err\nfloat32 filtered_range_err\nfloat32 distance_dot\nfloat32 distance_dot_err\n"
    "uint8 range_meas_type\nuint16 requester_LED_flag\nuint16 responder_LED_flag\nuint16 noise\nuint16 vPeak\n"
    "int32 coarse_tof_in_bins\nuint32 uwb_time\ngeometry_msgs/Point requester_location\ngeometry_msgs/Point responder_location\n"
    "geometry_msgs/Point rqst_antenna_offset\ngeometry_msgs/Point rspd_antenna_offset"
)
POZYX_GTEC = (
    "int32 originId\nint16 originType\nint32 destinationId\nint16 destinationType\nint32 range\nint32 ts\nint32 seq\n"
    "float64 rxPower\nfloat64 channel\nfloat64 datarate\nint32 prf\nint32 preambleLength\nfloat64 txGain"
)
POZYX_GTEC2 = (
    "int32 origin_id\nint16 origin_type\nint32 destination_id\nint16 destination_type\nint32 range\nint32 ts\nint32 seq\n"
    "float64 rx_power\nfloat64 channel\nfloat64 datarate\nint32 prf\nint32 preamble_length\nfloat64 tx_gain\nfloat64 angle"
)
PX4 = (
    "uint64 timestamp\nuint32 sessionid\nuint32 time_offset\nuint32 counter\nuint16 mac\nuint16 mac_dest\nuint16 status\nuint8 nlos\n"
    "float32 distance\nfloat32 aoa_azimuth_dev\nfloat32 aoa_elevation_dev\nfloat32 aoa_azimuth_resp\nfloat32 aoa_elevation_resp\n"
    "uint8 aoa_azimuth_fom\nuint8 aoa_elevation_fom\nuint8 aoa_dest_azimuth_fom\nuint8 aoa_dest_elevation_fom\nuint8 orientation\n"
    "float32 offset_x\nfloat32 offset_y\nfloat32 offset_z"
)
BEACON = (
    "std_msgs/Header header\ngeometry_msgs/Pose sensor_pose_on_robot\nfloat64 min_sensor_distance\nfloat64 max_sensor_distance\n"
    "float64 sensor_std_range\nmrpt_msgs/SingleRangeBeaconObservation[] sensed_data"
)
DWM_ANCHOR = "string id\ngeometry_msgs/Point location\nfloat64 dist"
HEADED = stamped(7.25, "uwb_tag")


def nodeframe(package, header=""):
    return {
        f"{package}/msg/LinktrackNode2": NODE2,
        f"{package}/msg/LinktrackNodeframe2": NODEFRAME2.format(package=package, header=header),
        f"{package}/msg/LinktrackNodeframe3": NODEFRAME3.format(package=package),
        f"{package}/msg/LinktrackTagframe0": TAGFRAME0,
    }


CASES = {
    # name: (ROS, definitions, type, fields, expected readings, stamp of the header or None = of the recording)
    "GTEC Ranging, ROS 1": (
        1, {"gtec_msgs/msg/Ranging": "int16 anchorId\nint16 tagId\nint32 range\nint32 seq\nfloat64 errorEstimation"},
        "gtec_msgs/msg/Ranging", {"anchorId": 7, "tagId": 2, "range": 3456}, [("7", 3.456)], None,
    ),
    "GTEC Ranging, ROS 2": (
        2, {"gtec_msgs/msg/Ranging": "int16 anchor_id\nint16 tag_id\nint32 range\nint32 seq\nfloat64 rss\nfloat64 error_estimation"},
        "gtec_msgs/msg/Ranging", {"anchor_id": 7, "tag_id": 2, "range": 3456}, [("7", 3.456)], None,
    ),
    "GTEC GenericRanging": (
        2, {"gtec_msgs/msg/GenericRanging": "int16 anchor_id\nint16 tag_id\nint32 range\nint32 seq\nfloat64 rx_power"},
        "gtec_msgs/msg/GenericRanging", {"anchor_id": 1, "range": 900}, [("1", 0.9)], None,
    ),
    "GTEC PozyxRanging, ROS 1": (
        1, {"gtec_msgs/msg/PozyxRanging": POZYX_GTEC}, "gtec_msgs/msg/PozyxRanging",
        {"originId": 1, "destinationId": 26971, "range": 5120}, [("26971", 5.12)], None,
    ),
    "GTEC PozyxRanging, ROS 2": (
        2, {"gtec_msgs/msg/PozyxRanging": POZYX_GTEC2}, "gtec_msgs/msg/PozyxRanging",
        {"origin_id": 1, "destination_id": 26971, "range": 5120}, [("26971", 5.12)], None,
    ),
    "LinkTrack Nodeframe2": (
        1, nodeframe("nlink_parser"), "nlink_parser/msg/LinktrackNodeframe2", NODES, [("3", 4.5), ("12", 7.25)], None,
    ),
    "LinkTrack Nodeframe2 with header": (
        2, nodeframe("nlink_parser_ros2_interfaces", "std_msgs/Header header\nint64 unix_timestamp\n"),
        "nlink_parser_ros2_interfaces/msg/LinktrackNodeframe2", {**NODES, "header": HEADED}, [("3", 4.5), ("12", 7.25)], 7.25,
    ),
    "LinkTrack Nodeframe3": (
        1, nodeframe("nlink_parser"), "nlink_parser/msg/LinktrackNodeframe3", NODES, [("3", 4.5), ("12", 7.25)], None,
    ),
    "LinkTrack Tagframe0": (
        1, nodeframe("nlink_parser"), "nlink_parser/msg/LinktrackTagframe0", {"dis_arr": [2.5, 0, 3.75, 0, 0, 0, 0, 0]},
        [("0", 2.5), ("2", 3.75)], None,
    ),
    "TwoWayRangeStamped, tag to anchor": (
        1, {"uwb_msgs/msg/TwoWayRangeStamped": TWO_WAY}, "uwb_msgs/msg/TwoWayRangeStamped",
        {"header": HEADED, "range_raw": 6.5, "range_corr": 6.1, "uwb_id1": 99, "uwb_id2": 4, "type_id1": 84, "type_id2": 65},
        [("4", 6.5)], 7.25,
    ),
    "TwoWayRangeStamped, anchor to tag": (
        1, {"uwb_msgs/msg/TwoWayRangeStamped": TWO_WAY}, "uwb_msgs/msg/TwoWayRangeStamped",
        {"header": HEADED, "range_raw": 6.5, "uwb_id1": 4, "uwb_id2": 99, "type_id1": 65, "type_id2": 84}, [("4", 6.5)], 7.25,
    ),
    "TwoWayRangeStamped, anchor to anchor": (
        1, {"uwb_msgs/msg/TwoWayRangeStamped": TWO_WAY}, "uwb_msgs/msg/TwoWayRangeStamped",
        {"header": HEADED, "range_raw": 6.5, "uwb_id1": 4, "uwb_id2": 5, "type_id1": 65, "type_id2": 65}, [], 7.25,
    ),
    "TwoWayRangeStamped in capitals": (
        1, {"uwb_msgs/msg/TwoWayRangeStamped": "std_msgs/Header header\nuint32 UWB_ID1\nuint32 UWB_ID2\nfloat64 range_raw"},
        "uwb_msgs/msg/TwoWayRangeStamped", {"header": HEADED, "range_raw": 6.5, "UWB_ID1": 9, "UWB_ID2": 4}, [("4", 6.5)], 7.25,
    ),
    "NTU UwbRange": (
        1, {"uwb_driver/msg/UwbRange": NTU}, "uwb_driver/msg/UwbRange",
        {"header": HEADED, "requester_id": 200, "responder_id": 102, "distance": 8.5}, [("102", 8.5)], 7.25,
    ),
    "Pozyx DeviceRanges": (
        1, {"pozyx_ros/msg/DeviceRange": "string remote_device_id\ntime stamp\nfloat64 distance\nint16 RSS",
            "pozyx_ros/msg/DeviceRanges": "std_msgs/Header header\npozyx_ros/DeviceRange[] ranges"},
        "pozyx_ros/msg/DeviceRanges", {"header": HEADED, "ranges": [{"remote_device_id": "0x6958", "distance": 2.25}]},
        [("0x6958", 2.25)], 7.25,
    ),
    "Pozyx DeviceRange": (
        1, {"pozyx_ros/msg/DeviceRange": "std_msgs/Header header\nuint16 deviceId\nuint32 distance\nint16 RSS"},
        "pozyx_ros/msg/DeviceRange", {"header": HEADED, "deviceId": 0x6958, "distance": 2250}, [("6958", 2.25)], 7.25,
    ),
    "Crazyflie RangeArray": (
        1, {"bitcraze_lps_estimator/msg/RangeArray": "float32[] ranges\nbool[] valid\nbool[] los"},
        "bitcraze_lps_estimator/msg/RangeArray", {"ranges": [1.5, 2.5, 3.5], "valid": [1, 0, 1], "los": [1, 1, 1]},
        [("0", 1.5), ("2", 3.5)], None,
    ),
    "MRPT ObservationRangeBeacon": (
        1, {"mrpt_msgs/msg/SingleRangeBeaconObservation": "float64 range\nint32 id", "mrpt_msgs/msg/ObservationRangeBeacon": BEACON},
        "mrpt_msgs/msg/ObservationRangeBeacon", {"header": HEADED, "sensed_data": [{"range": 5.5, "id": 1}]}, [("1", 5.5)], 7.25,
    ),
    "PX4 SensorUwb": (
        2, {"px4_msgs/msg/SensorUwb": PX4}, "px4_msgs/msg/SensorUwb",
        {"timestamp": 123, "mac": 1, "mac_dest": 0x5C0B, "distance": 2.5}, [("5C0B", 2.5)], None,
    ),
    "dwm1001_ros UWBMeas": (
        1, {"dwm1001c_ros/msg/Anchor": DWM_ANCHOR, "dwm1001_ros/msg/UWBMeas": "dwm1001c_ros/Anchor[] measurements"},
        "dwm1001_ros/msg/UWBMeas", {"measurements": [{"id": "1151", "dist": 6.5}]}, [("1151", 6.5)], None,
    ),
    "dwm1001_ros_interfaces UWBMeas": (
        2, {"dwm1001_ros_interfaces/msg/Anchor": DWM_ANCHOR,
            "dwm1001_ros_interfaces/msg/UWBMeas": "dwm1001_ros_interfaces/Anchor[] measurements"},
        "dwm1001_ros_interfaces/msg/UWBMeas", {"measurements": [{"id": "1151", "dist": 6.5}]}, [("1151", 6.5)], None,
    ),
    "ros_dwm1001 Anchor": (
        1, {"ros_dwm1001/msg/Anchor": "std_msgs/Header header\nstring id\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 distance"},
        "ros_dwm1001/msg/Anchor", {"header": HEADED, "id": "1151", "distance": 6.5}, [("1151", 6.5)], 7.25,
    ),
    "mdek_uwb_driver Uwb": (
        1, {"mdek_uwb_driver/msg/Range": "string id\nfloat64 distance",
            "mdek_uwb_driver/msg/Uwb": "std_msgs/Header header\nmdek_uwb_driver/Range[] ranges"},
        "mdek_uwb_driver/msg/Uwb", {"header": HEADED, "ranges": [{"id": "5", "distance": 6.5}]}, [("5", 6.5)], 7.25,
    ),
    "MRS RangeWithCovarianceArrayStamped": (
        1, {"mrs_msgs/msg/RangeWithCovarianceIdentified": "uint64 id\nsensor_msgs/Range range\nfloat64 variance",
            "mrs_msgs/msg/RangeWithCovarianceArrayStamped":
            "std_msgs/Header header\nmrs_msgs/RangeWithCovarianceIdentified[] ranges"},
        "mrs_msgs/msg/RangeWithCovarianceArrayStamped", {"header": HEADED, "ranges": [{"id": 5, "range": {"range": 6.5}}]},
        [("5", 6.5)], 7.25,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_a_published_message_is_read(tmp_path, name):
    ros, definitions, kind, fields, expected, stamp = CASES[name]
    messages = [odometry(5.0), odometry(9.0), (7.5, "/radio", kind, fields)]
    path = tmp_path / ("x.bag" if ros == 1 else "x")
    write_bag_of(path, messages, definitions, ros)
    log = read_bag(path)
    if not expected:
        assert log.ranges is None
        return
    read = [(log.ranges.anchor_ids[a], r) for a, r in zip(log.ranges.anchor, log.ranges.ranges, strict=True)]
    assert read == [(anchor, pytest.approx(distance, rel=1e-6)) for anchor, distance in expected]
    assert set(log.ranges.stamps) == {7.5 if stamp is None else stamp}
    assert not [w for w in log.notes.warnings if "not read" in w]
