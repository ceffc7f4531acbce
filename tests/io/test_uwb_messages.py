# ruff: noqa: E501 (published definitions)
"""Ranges in published kinds of ROS messages: bags of ROS 1 and ROS 2 made from the published definitions.

The definitions are those of the repositories named with them, comments left out.
"""

import re
from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np
import pytest
from conftest import ROOT
from helpers.bags import odometry, stamped, write_bag_of

from uwblite.io.rosbag import read_bag
from uwblite.io.uwb_mapping import KNOWN, fitting, parse_mappings, short_type

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
DW_GTEC = (
    "int16 anchor_id\nint16 tag_id\nint32 range\nint32 rawrange\nint32 seq\nint32 max_noise\nint32 std_noise\n"
    "int32 first_path_amp1\nint32 first_path_amp2\nint32 first_path_amp3\nint32 max_growth_cir\nint32 rx_pream_count\n"
    "int32 first_path\nfloat64 channel\nint32 prf\nfloat64 datarate\nint32 preamble_length\nint32 pac_size"
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


def nodeframe(package, header=""):
    return {
        f"{package}/msg/LinktrackNode2": NODE2,
        f"{package}/msg/LinktrackNodeframe2": NODEFRAME2.format(package=package, header=header),
        f"{package}/msg/LinktrackNodeframe3": NODEFRAME3.format(package=package),
        f"{package}/msg/LinktrackTagframe0": TAGFRAME0,
    }


def documented(topic):
    """Return the mapping of docs/formats.md that fits this topic, as a user would paste it."""
    blocks = re.findall(r"^```toml\n(.*?)^```", (ROOT / "docs" / "formats.md").read_text(), re.M | re.S)
    kind = "std_msgs/Float32MultiArray" if topic == "/uwb_distances" else "sensor_msgs/Range"
    return tuple(m for block in blocks for m in parse_mappings(block) if m.fits(topic, kind))


@dataclass(frozen=True)
class Case:
    """A message as its publisher fills it, and what is read of it."""

    source: str
    """Repository of the definition."""
    definitions: dict
    kind: str
    fields: dict
    expected: list
    """(anchor, range in m)."""
    headed: bool = False
    """Whether a header gives the stamp; otherwise the time of recording counts."""
    topic: str = ""
    mappings: tuple = ()


CASES = {
    "what uwblite writes": Case(
        "ros/common_msgs", {}, "sensor_msgs/msg/Range", {"header": {"frame_id": "5C0B"}, "range": 4.25}, [("5C0B", 4.25)],
        headed=True, topic="/uwb/anchor_5C0B/range",
    ),
    "GTEC Ranging, first form": Case(
        "GTEC-UDC/rosmsgs",
        {"gtec_msgs/msg/Ranging": "int16 anchorId\nint16 tagId\nint32 range\nint32 seq\nfloat64 errorEstimation"},
        "gtec_msgs/msg/Ranging", {"anchorId": 7, "tagId": 2, "range": 3456}, [("7", 3.456)],
    ),
    "GTEC Ranging, second form": Case(
        "GTEC-UDC/rosmsgs",
        {"gtec_msgs/msg/Ranging": "int16 anchor_id\nint16 tag_id\nint32 range\nint32 seq\nfloat64 rss\nfloat64 error_estimation"},
        "gtec_msgs/msg/Ranging", {"anchor_id": 7, "tag_id": 2, "range": 3456}, [("7", 3.456)],
    ),
    "GTEC GenericRanging": Case(
        "GTEC-UDC/rosmsgs",
        {"gtec_msgs/msg/GenericRanging": "int16 anchor_id\nint16 tag_id\nint32 range\nint32 seq\nfloat64 rx_power"},
        "gtec_msgs/msg/GenericRanging", {"anchor_id": 1, "range": 900}, [("1", 0.9)],
    ),
    "GTEC DWRanging": Case(
        "GTEC-UDC/rosmsgs", {"gtec_msgs/msg/DWRanging": DW_GTEC}, "gtec_msgs/msg/DWRanging",
        {"anchor_id": 3, "tag_id": 2, "range": 7250, "rawrange": 7300}, [("3", 7.25)],
    ),
    "GTEC PozyxRanging, first form": Case(
        "GTEC-UDC/rosmsgs", {"gtec_msgs/msg/PozyxRanging": POZYX_GTEC}, "gtec_msgs/msg/PozyxRanging",
        {"originId": 1, "destinationId": 26971, "range": 5120}, [("26971", 5.12)],
    ),
    "GTEC PozyxRanging, second form": Case(
        "GTEC-UDC/rosmsgs", {"gtec_msgs/msg/PozyxRanging": POZYX_GTEC2}, "gtec_msgs/msg/PozyxRanging",
        {"origin_id": 1, "destination_id": 26971, "range": 5120}, [("26971", 5.12)],
    ),
    "GTEC PozyxRangingWithCir": Case(
        "GTEC-UDC/rosmsgs", {"gtec_msgs/msg/PozyxRangingWithCir": f"{POZYX_GTEC2}\nint16[] cir"},
        "gtec_msgs/msg/PozyxRangingWithCir", {"origin_id": 1, "destination_id": 26971, "range": 5120, "cir": [4, 5]},
        [("26971", 5.12)],
    ),
    "LinkTrack Nodeframe2": Case(
        "nooploop-dev/nlink_parser", nodeframe("nlink_parser"), "nlink_parser/msg/LinktrackNodeframe2", NODES,
        [("3", 4.5), ("12", 7.25)],
    ),
    "LinkTrack Nodeframe2 with header": Case(
        "nooploop-dev/nlink_parser_ros2_interfaces",
        nodeframe("nlink_parser_ros2_interfaces", "std_msgs/Header header\nint64 unix_timestamp\n"),
        "nlink_parser_ros2_interfaces/msg/LinktrackNodeframe2", NODES, [("3", 4.5), ("12", 7.25)], headed=True,
    ),
    "LinkTrack Nodeframe3": Case(
        "nooploop-dev/nlink_parser", nodeframe("nlink_parser"), "nlink_parser/msg/LinktrackNodeframe3", NODES,
        [("3", 4.5), ("12", 7.25)],
    ),
    "LinkTrack Tagframe0": Case(
        "nooploop-dev/nlink_parser", nodeframe("nlink_parser"), "nlink_parser/msg/LinktrackTagframe0",
        {"dis_arr": [2.5, 0, 3.75, 0, 0, 0, 0, 0]}, [("0", 2.5), ("2", 3.75)],
    ),
    "TwoWayRangeStamped, tag to anchor": Case(
        "aau-cns/uwb_msgs", {"uwb_msgs/msg/TwoWayRangeStamped": TWO_WAY}, "uwb_msgs/msg/TwoWayRangeStamped",
        {"range_raw": 6.5, "range_corr": 6.1, "uwb_id1": 99, "uwb_id2": 4, "type_id1": 84, "type_id2": 65},
        [("4", 6.5)], headed=True,
    ),
    "TwoWayRangeStamped, anchor to tag": Case(
        "aau-cns/uwb_msgs", {"uwb_msgs/msg/TwoWayRangeStamped": TWO_WAY}, "uwb_msgs/msg/TwoWayRangeStamped",
        {"range_raw": 6.5, "uwb_id1": 4, "uwb_id2": 99, "type_id1": 65, "type_id2": 84}, [("4", 6.5)], headed=True,
    ),
    "TwoWayRangeStamped, anchor to anchor": Case(
        "aau-cns/uwb_msgs", {"uwb_msgs/msg/TwoWayRangeStamped": TWO_WAY}, "uwb_msgs/msg/TwoWayRangeStamped",
        {"range_raw": 6.5, "uwb_id1": 4, "uwb_id2": 5, "type_id1": 65, "type_id2": 65}, [], headed=True,
    ),
    "TwoWayRangeStamped in capitals": Case(
        "aau-cns/uwb_msgs",
        {"uwb_msgs/msg/TwoWayRangeStamped": "std_msgs/Header header\nuint32 UWB_ID1\nuint32 UWB_ID2\nfloat64 range_raw"},
        "uwb_msgs/msg/TwoWayRangeStamped", {"range_raw": 6.5, "UWB_ID1": 9, "UWB_ID2": 4}, [("4", 6.5)], headed=True,
    ),
    "NTU UwbRange": Case(
        "ntu-aris/uwb_driver", {"uwb_driver/msg/UwbRange": NTU}, "uwb_driver/msg/UwbRange",
        {"requester_id": 200, "responder_id": 102, "distance": 8.5}, [("102", 8.5)], headed=True,
    ),
    "Pozyx DeviceRanges": Case(
        "ruvu/common",
        {"pozyx_ros/msg/DeviceRange": "string remote_device_id\ntime stamp\nfloat64 distance\nint16 RSS",
         "pozyx_ros/msg/DeviceRanges": "std_msgs/Header header\npozyx_ros/DeviceRange[] ranges"},
        "pozyx_ros/msg/DeviceRanges", {"ranges": [{"remote_device_id": "0x6958", "distance": 2.25}]},
        [("0x6958", 2.25)], headed=True,
    ),
    "Pozyx Ranges": Case(
        "ruvu/common",
        {"pozyx_msgs/msg/Range": "std_msgs/Header header\nint32 network_id\nint32 remote_network_id\nfloat64 distance\nint16 RSS",
         "pozyx_msgs/msg/Ranges": "std_msgs/Header header\npozyx_msgs/Range[] ranges"},
        "pozyx_msgs/msg/Ranges", {"ranges": [{"network_id": 9, "remote_network_id": 26971, "distance": 2.25}]},
        [("26971", 2.25)], headed=True,
    ),
    "Pozyx DeviceRange": Case(
        "utahrobotics/pozyx_ros",
        {"pozyx_ros/msg/DeviceRange": "std_msgs/Header header\nuint16 deviceId\nuint32 distance\nint16 RSS"},
        "pozyx_ros/msg/DeviceRange", {"deviceId": 0x6958, "distance": 2250}, [("6958", 2.25)], headed=True,
    ),
    "Crazyflie RangeArray": Case(
        "bitcraze/lps-ros", {"bitcraze_lps_estimator/msg/RangeArray": "float32[] ranges\nbool[] valid\nbool[] los"},
        "bitcraze_lps_estimator/msg/RangeArray", {"ranges": [1.5, 2.5, 3.5], "valid": [1, 0, 1], "los": [1, 1, 1]},
        [("0", 1.5), ("2", 3.5)],
    ),
    "MRPT ObservationRangeBeacon": Case(
        "mrpt-ros-pkg/mrpt_msgs",
        {"mrpt_msgs/msg/SingleRangeBeaconObservation": "float64 range\nint32 id", "mrpt_msgs/msg/ObservationRangeBeacon": BEACON},
        "mrpt_msgs/msg/ObservationRangeBeacon", {"sensed_data": [{"range": 5.5, "id": 1}]}, [("1", 5.5)], headed=True,
    ),
    "PX4 SensorUwb": Case(
        "PX4/px4_msgs", {"px4_msgs/msg/SensorUwb": PX4}, "px4_msgs/msg/SensorUwb",
        {"timestamp": 123, "mac": 1, "mac_dest": 0x5C0B, "distance": 2.5}, [("5C0B", 2.5)],
    ),
    "dwm1001_ros UWBMeas": Case(
        "brozb/dwm1001_ros",
        {"dwm1001c_ros/msg/Anchor": DWM_ANCHOR, "dwm1001_ros/msg/UWBMeas": "dwm1001c_ros/Anchor[] measurements"},
        "dwm1001_ros/msg/UWBMeas", {"measurements": [{"id": "1151", "dist": 6.5}]}, [("1151", 6.5)],
    ),
    "dwm1001_ros_interfaces UWBMeas": Case(
        "ctu-vras/dwm1001_ros",
        {"dwm1001_ros_interfaces/msg/Anchor": DWM_ANCHOR,
         "dwm1001_ros_interfaces/msg/UWBMeas": "dwm1001_ros_interfaces/Anchor[] measurements"},
        "dwm1001_ros_interfaces/msg/UWBMeas", {"measurements": [{"id": "1151", "dist": 6.5}]}, [("1151", 6.5)],
    ),
    "ros_dwm1001 Anchor": Case(
        "joeyjyyang/ros_dwm1001",
        {"ros_dwm1001/msg/Anchor": "std_msgs/Header header\nstring id\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 distance"},
        "ros_dwm1001/msg/Anchor", {"id": "1151", "distance": 6.5}, [("1151", 6.5)], headed=True,
    ),
    "mdek_uwb_driver Uwb": Case(
        "aau-cns/mdek_uwb_driver",
        {"mdek_uwb_driver/msg/Range": "string id\nfloat64 distance",
         "mdek_uwb_driver/msg/Uwb": "std_msgs/Header header\nmdek_uwb_driver/Range[] ranges"},
        "mdek_uwb_driver/msg/Uwb", {"ranges": [{"id": "5", "distance": 6.5}]}, [("5", 6.5)], headed=True,
    ),
    "MRS RangeWithCovarianceArrayStamped": Case(
        "ctu-mrs/mrs_msgs",
        {"mrs_msgs/msg/RangeWithCovarianceIdentified": "uint64 id\nsensor_msgs/Range range\nfloat64 variance",
         "mrs_msgs/msg/RangeWithCovarianceArrayStamped":
         "std_msgs/Header header\nmrs_msgs/RangeWithCovarianceIdentified[] ranges"},
        "mrs_msgs/msg/RangeWithCovarianceArrayStamped", {"ranges": [{"id": 5, "range": {"range": 6.5}}]},
        [("5", 6.5)], headed=True,
    ),
    "TIERS": Case(
        "TIERS data sets", {}, "sensor_msgs/msg/Range", {"range": 3.5}, [("tof_3", 3.5)], headed=True, topic="/uwb/tof_3/distance",
    ),
    "an array, with the mapping of the documents": Case(
        "ros/common_msgs", {}, "std_msgs/msg/Float32MultiArray", {"data": [1.5, 0, 2.5]}, [("0", 1.5), ("2", 2.5)],
        topic="/uwb_distances", mappings=documented("/uwb_distances"),
    ),
    "sensor_msgs/Range, with the mapping of the documents": Case(
        "ros/common_msgs", {}, "sensor_msgs/msg/Range", {"range": 3.5}, [("7", 3.5)], headed=True, topic="/anchor_7/range",
        mappings=documented("/anchor_7/range"),
    ),
}  # fmt: skip
ROS = (1, 2)
SPACING = 100.0
"""s between the messages of two cases, by which their ranges are distinguished in one recording."""


def bags_of(cases):
    """Return the cases in lists without two definitions of one name; those with mappings of their own stand alone."""
    bags = []
    for name, case in cases.items():
        fits = (b for b in bags if not case.mappings and not any(cases[n].mappings or clash(cases[n], case) for n in b))
        if (bag := next(fits, None)) is not None:
            bag.append(name)
        else:
            bags.append([name])
    return bags


def clash(a, b):
    return any(a.definitions[name] != b.definitions[name] for name in a.definitions.keys() & b.definitions.keys())


def message_of(case, number):
    """Return time of recording, topic, type and fields of a case's message."""
    recorded = SPACING * number + 7.5
    frame = case.fields.get("header", {}).get("frame_id", "uwb_tag")
    header = {"header": stamped(recorded - 0.25, frame)} if case.headed else {}
    return recorded, case.topic or f"/radio_{number}", case.kind, case.fields | header


@pytest.fixture(scope="module")
def read(tmp_path_factory):
    """What is read from bags of both versions: {(ROS, name): [(anchor, range in m, stamp - time of recording)]}."""
    found = {}
    for ros in ROS:
        for names in bags_of(CASES):
            path = tmp_path_factory.mktemp("bag") / ("x.bag" if ros == 1 else "x")
            definitions = {kind: text for name in names for kind, text in CASES[name].definitions.items()}
            messages = [message_of(CASES[name], k) for k, name in enumerate(names)]
            write_bag_of(path, [odometry(5.0), *messages, odometry(SPACING * len(names))], definitions, ros)
            log = read_bag(path, mappings=CASES[names[0]].mappings)
            assert not [w for w in log.notes.warnings if "not read" in w]
            number, since = np.divmod(log.ranges.stamps, SPACING)
            readings = zip([log.ranges.anchor_ids[a] for a in log.ranges.anchor], log.ranges.ranges, since - 7.5, strict=True)
            found |= {(ros, name): [] for name in names}
            for n, reading in zip(number.astype(int), readings, strict=True):
                found[ros, names[n]].append(reading)
    return found


@pytest.mark.parametrize("ros", ROS)
@pytest.mark.parametrize("name", CASES)
def test_a_published_message_is_read(read, name, ros):
    case = CASES[name]
    late = pytest.approx(-0.25 if case.headed else 0.0, abs=1e-6)
    assert read[ros, name] == [(anchor, pytest.approx(distance, rel=1e-6), late) for anchor, distance in case.expected]


def test_every_built_in_mapping_is_tried():
    tried = [m for c in CASES.values() if c.expected for m in fitting(c.topic, c.kind, KNOWN)]
    assert not [m for m in KNOWN if m not in tried]


def test_the_table_of_the_documents_says_what_is_read():
    """Every case without a mapping of its own stands in a row of the table, with the repository of its definition."""
    text = (ROOT / "docs" / "formats.md").read_text()
    rows = re.findall(r"^\| `([^`]+/[^`]+)`.*\| ([^|]+) \|$", text[text.index("### Ranges in ROS messages") :], re.M)
    for name, case in CASES.items():
        sources = [source for pattern, source in rows if fnmatchcase(short_type(case.kind), pattern)]
        assert case.mappings or any(case.source in source for source in sources), name
    assert {pattern for pattern, _ in rows} == {m.type for m in KNOWN}
