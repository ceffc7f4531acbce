"""Places of the ranges in published kinds of ROS messages, tried where the user gives no mapping.

Each line was written from the message's published definition, which is named beside it; a test makes bags from these
definitions. A kind whose fields were renamed has a line for each form.
"""

from .uwb_mapping import UwbMapping

_ANCHOR, _TAG, _UNKNOWN = ord("A"), ord("T"), ord("U")
"""How uwb_msgs/TwoWayRangeStamped calls the ends of a range."""


def _two_way(source: int, target: int) -> UwbMapping:
    """Return the mapping of a range between such ends: the anchor is the end that is not the tag."""
    anchor, tag = ("uwb_id1", "uwb_id2") if target == _TAG else ("uwb_id2", "uwb_id1")
    only = {"type_id1": source, "type_id2": target}
    return UwbMapping(type="uwb_msgs/TwoWayRangeStamped", anchor=anchor, tag=tag, range="range_raw", only=only)


KNOWN = (
    # What `uwblite convert` itself writes.
    UwbMapping(topic="/uwb/anchor_*/range", type="sensor_msgs/Range", anchor="header.frame_id"),
    # mrpt_msgs, msg-common: ObservationRangeBeacon, SingleRangeBeaconObservation.
    UwbMapping(type="mrpt_msgs/ObservationRangeBeacon", readings="sensed_data"),
    # GTEC-UDC/rosmsgs: msg (ROS 1) and msg-ros2; ranges in mm, no header.
    UwbMapping(type="gtec_msgs/PozyxRanging*", anchor="destinationId", unit=0.001, stamp=""),
    UwbMapping(type="gtec_msgs/PozyxRanging*", anchor="destination_id", unit=0.001, stamp=""),
    UwbMapping(type="gtec_msgs/*Ranging", anchor="anchorId", unit=0.001, stamp=""),
    UwbMapping(type="gtec_msgs/*Ranging", anchor="anchor_id", unit=0.001, stamp=""),
    # nooploop-dev/nlink_parser: LinktrackNodeframe2, LinktrackNodeframe3, LinktrackNode2, LinktrackTagframe0;
    # a header came later.
    UwbMapping(type="nlink_parser*/LinktrackNodeframe[23]", readings="nodes", tag="id", range="dis"),
    UwbMapping(type="nlink_parser*/LinktrackTagframe0", anchor="index", tag="id", range="dis_arr"),
    # uwb_msgs: TwoWayRangeStamped; the names were in capitals first.
    *(_two_way(*ends) for ends in ((_TAG, _ANCHOR), (_ANCHOR, _TAG), (_UNKNOWN, _ANCHOR), (_UNKNOWN, _UNKNOWN))),
    UwbMapping(type="uwb_msgs/TwoWayRangeStamped", anchor="UWB_ID2", tag="UWB_ID1", range="range_raw"),
    # ntu-aris/uwb_driver, wang-chen/uwb_driver (Time Domain P4xx), and its kin in lps-ros.
    UwbMapping(type="*/UwbRange", anchor="responder_id", range="distance"),
    # Pozyx: ruvu/common pozyx_ros/DeviceRanges and pozyx_msgs/Ranges in m, utahrobotics/pozyx_ros DeviceRange in mm.
    UwbMapping(type="pozyx_ros/DeviceRanges", readings="ranges", anchor="remote_device_id", range="distance"),
    UwbMapping(type="pozyx_msgs/Ranges", readings="ranges", anchor="remote_network_id", range="distance"),
    UwbMapping(type="pozyx*/DeviceRange", anchor="deviceId", range="distance", unit=0.001, anchor_format="{:04x}"),
    # bitcraze/lps-ros: RangeArray (Crazyflie Loco Positioning System).
    UwbMapping(type="bitcraze_lps_estimator/RangeArray", anchor="index", range="ranges", stamp="", only={"valid": 1}),
    # brozb/dwm1001_ros and ctu-vras/dwm1001_ros: UWBMeas, Anchor; joeyjyyang/ros_dwm1001: Anchor.
    UwbMapping(type="dwm1001*_ros*/UWBMeas", readings="measurements", range="dist", stamp=""),
    UwbMapping(type="*dwm1001*/Anchor", range="distance"),
    # aau-cns: mdek_uwb_driver/Uwb, as its users read it.
    UwbMapping(type="mdek_uwb_driver/Uwb", readings="ranges", range="distance"),
    # ctu-mrs/mrs_msgs: RangeWithCovarianceArrayStamped.
    UwbMapping(type="mrs_msgs/RangeWithCovarianceArrayStamped", readings="ranges", range="range.range"),
    # PX4: SensorUwb; its time counts from the start of the flight controller.
    UwbMapping(type="px4_msgs/SensorUwb", anchor="mac_dest", range="distance", stamp="", anchor_format="{:04X}"),
    # TIERS data sets: one topic for each pair of nodes.
    UwbMapping(
        topic="/uwb/*/distance", type="sensor_msgs/Range", anchor="topic:([^/]+)/distance$", tag="topic:([^/]+)/[^/]+/distance$"
    ),
)
