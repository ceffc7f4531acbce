"""Topics that may hold ranges and are not read are named, with a mapping that reads them when it is pasted."""

import numpy as np
import pytest
from helpers.bags import odometry, stamped, write_bag_of
from helpers.results import small_folder

from uwblite.errors import ConfigError
from uwblite.io.bag_topics import BagTopics, _is_ids, as_toml, plan_topics, suggested
from uwblite.io.rosbag import plan_bag, read_bag
from uwblite.io.uwb_mapping import UwbMapping, parse_mappings

pytest.importorskip("rosbags.highlevel", reason="rosbags is absent")

UNKNOWN = {
    # definitions, type, fields, anchor and range in m that the suggested mapping gives
    "header, id and millimetres": (
        {"x_msgs/msg/Radio": "std_msgs/Header header\nuint16 tag_id\nuint16 anchor_id\nuint32 distance_mm"},
        "x_msgs/msg/Radio", {"header": stamped(7.0), "tag_id": 1, "anchor_id": 77, "distance_mm": 4500}, [("77", 4.5)],
    ),
    "a list of readings": (
        {"x_msgs/msg/Node": "string address\nfloat32 dist", "x_msgs/msg/Nodes": "x_msgs/Node[] nodes"},
        "x_msgs/msg/Nodes", {"nodes": [{"address": "a1", "dist": 3.5}, {"address": "b2", "dist": 1.5}]},
        [("a1", 3.5), ("b2", 1.5)],
    ),
    "an array with a place for each anchor": (
        {"x_msgs/msg/All": "float32[4] distances"}, "x_msgs/msg/All", {"distances": [1.5, 0, 2.5, 0]}, [("0", 1.5), ("2", 2.5)],
    ),
    "an array of the standard messages": (
        {}, "std_msgs/msg/Float32MultiArray", {"data": [1.5, 2.5]}, [("0", 1.5), ("1", 2.5)],
    ),
    "one number": ({}, "std_msgs/msg/Float64", {"data": 2.5}, [("uwb_ranges", 2.5)]),
    "sensor_msgs/Range": ({}, "sensor_msgs/msg/Range", {"range": 3.5}, [("uwb_ranges", 3.5)]),
}  # fmt: skip


def bag_with(path, kind, fields, definitions, topic="/uwb_ranges"):
    write_bag_of(path, [odometry(5.0), odometry(9.0), (7.0, topic, kind, fields)], definitions)
    return path


@pytest.mark.parametrize("name", UNKNOWN)
def test_the_line_of_the_warning_reads_the_topic(tmp_path, name):
    definitions, kind, fields, expected = UNKNOWN[name]
    path = bag_with(tmp_path / "x.bag", kind, fields, definitions)
    log = read_bag(path)
    assert log.ranges is None
    (warning,) = (w for w in log.notes.warnings if w.startswith("not read"))
    assert "/uwb_ranges" in warning
    again = read_bag(path, mappings=parse_mappings(warning[warning.index("uwb = ") :]))
    read = [(again.ranges.anchor_ids[a], r) for a, r in zip(again.ranges.anchor, again.ranges.ranges, strict=True)]
    assert read == [(anchor, pytest.approx(distance, rel=1e-6)) for anchor, distance in expected]
    assert not [w for w in again.notes.warnings if w.startswith("not read")]


@pytest.mark.parametrize(
    ("topic", "kind"),
    [
        ("/sonar_front", "sensor_msgs/msg/Range"),
        ("/cmd_vel", "geometry_msgs/msg/Twist"),
        ("/uwb/pose", "geometry_msgs/msg/PoseStamped"),
        ("/battery", "std_msgs/msg/Float32"),
        ("/imu", "sensor_msgs/msg/Imu"),
    ],
)
def test_what_is_no_range_is_left_in_peace(tmp_path, topic, kind):
    log = read_bag(bag_with(tmp_path / "x.bag", kind, {}, {}, topic))
    assert not [w for w in log.notes.warnings if "ranges" in w]


def test_a_topic_that_reports_uwb_is_named_even_where_its_fields_report_nothing(tmp_path):
    definitions = {"x_msgs/msg/Blob": "uint8[] data"}
    log = read_bag(bag_with(tmp_path / "x.bag", "x_msgs/msg/Blob", {"data": [1, 2]}, definitions, "/uwb/raw"))
    (warning,) = log.notes.warnings[:1]
    assert "/uwb/raw" in warning
    assert 'anchor = "?"' in warning


def test_no_sample_is_no_error():
    assert suggested("/uwb", "x_msgs/msg/Gone", lambda name: []) == UwbMapping("/uwb", "x_msgs/Gone", anchor="?", range="?")
    assert suggested("/x", "x_msgs/msg/Gone", lambda name: []) is None


def test_a_mapping_that_matches_nothing_is_an_error_with_the_nearest(tmp_path):
    definitions, kind, fields, _ = UNKNOWN["header, id and millimetres"]
    path = bag_with(tmp_path / "x.bag", kind, fields, definitions)
    for mapping, shown in (
        (UwbMapping(topic="/uwb_range"), "topic '/uwb_range'.*the bag has /uwb_ranges of type x_msgs/Radio"),
        (UwbMapping(type="x_msgs/Radios"), "type 'x_msgs/Radios'.*the bag has /uwb_ranges of type x_msgs/Radio"),
        (UwbMapping(topic="/odom"), "the bag has /uwb_ranges"),
    ):
        with pytest.raises(ConfigError, match=f"mapping number 1 matches nothing.*{shown}"):
            read_bag(path, mappings=(mapping,))
    with pytest.raises(ConfigError, match=r"no uwb mapping reads /uwb_ranges of type x_msgs/Radio.*uwb = \[.*anchor_id"):
        read_bag(path, BagTopics(uwb=("/uwb_ranges",)))


@pytest.mark.parametrize("kind", ["x_msgs/Radio", "x_msgs/msg/Radio", "x_msgs/*", "*"])
def test_both_ways_to_write_a_type_are_one(tmp_path, kind):
    definitions, name, fields, expected = UNKNOWN["header, id and millimetres"]
    path = bag_with(tmp_path / "x.bag", name, fields, definitions)
    mapping = UwbMapping(type=kind, anchor="anchor_id", range="distance_mm", unit=0.001)
    assert read_bag(path, mappings=(mapping,)).ranges.anchor_ids == (expected[0][0],)


def test_a_wrong_field_names_the_nearest(tmp_path):
    definitions, name, fields, _ = UNKNOWN["header, id and millimetres"]
    path = bag_with(tmp_path / "x.bag", name, fields, definitions)
    with pytest.raises(ConfigError, match=r"no field 'anchr_id'; it has .* did you mean anchor_id"):
        read_bag(path, mappings=(UwbMapping(topic="/uwb_ranges", anchor="anchr_id", range="distance_mm"),))


def test_a_known_type_with_other_fields_is_named_not_fatal(tmp_path):
    """Two packages of one name: what the known mapping cannot read is suggested like any other."""
    definitions = {"gtec_msgs/msg/Ranging": "uint8 node_id\nfloat32 dist"}
    log = read_bag(bag_with(tmp_path / "x.bag", "gtec_msgs/msg/Ranging", {"node_id": 3, "dist": 2.0}, definitions))
    assert log.ranges is None
    assert 'anchor = "node_id", range = "dist"' in log.notes.warnings[0]


def test_the_plan_reports_what_each_topic_is_for(tmp_path):
    definitions, kind, fields, _ = UNKNOWN["a list of readings"]
    topics, plan = plan_bag(bag_with(tmp_path / "x.bag", kind, fields, definitions))
    assert [plan.role(t.name) for t in topics] == ["odometry", ""]
    assert as_toml(plan.unread.values()) == (
        'uwb = [{ topic = "/uwb_ranges", type = "x_msgs/Nodes", readings = "nodes", anchor = "address", range = "dist",'
        ' stamp = "" }]'
    )
    assert plan_topics((), lambda name: ()).uwb == {}


def test_check_reports_where_the_ranges_may_be(tmp_path, capsys):
    """One command from a bag of an unknown kind to the mapping, and one with it to findings about the ranges."""
    from uwblite.cli import main

    definitions, kind, fields, _ = UNKNOWN["header, id and millimetres"]
    path = bag_with(tmp_path / "x.bag", kind, fields, definitions)
    main(["check", str(path)])
    output = capsys.readouterr().out
    assert "-> there may be some in what was not read: /uwb_ranges" in output
    assert "check the tag" not in output
    assert "order of their stamps" not in output
    (line,) = (line for line in output.splitlines() if "uwb = [" in line)
    (tmp_path / "uwb.toml").write_text(line[line.index("uwb = [") :])
    main(["check", str(path), "--uwb-mapping", str(tmp_path / "uwb.toml")])
    assert "anchor 77: 1 ranges" in capsys.readouterr().out
    assert main(["convert", str(path), "--list"]) == 0
    listed = capsys.readouterr().out
    assert "/uwb_ranges  x_msgs/msg/Radio  <- ranges?" in listed
    assert "uwb = [" in listed


@pytest.mark.parametrize("verb", ["map", "check", "localize", "convert"])
def test_topics_of_what_is_no_bag_are_refused(tmp_path, capsys, verb, room_log):
    from uwblite.cli import main

    small_folder(tmp_path / "map", command="uwblite map run.log")
    more = {"map": ["--out", f"{tmp_path}/m"], "localize": ["--map", f"{tmp_path}/map", "--out", f"{tmp_path}/l"], "check": []}
    words = more.get(verb, [f"{tmp_path}/x.log"])
    for option, why in (("--odometry-topic", "is no ROS bag"), ("--scan-topic", "scans are not read from '/scan'; choose")):
        assert main([verb, str(room_log), *words, option, "/scan"]) == 1
        assert why in capsys.readouterr().err


@pytest.mark.parametrize(("value", "ids"), [
    (["A", "B"], True), (("A", "B"), True), (np.array([3, 4]), True), (["A"], False), ([1.5, 2.5], False), ("AB", False),
    (np.array([1.5, 2.5]), False),
])  # fmt: skip
def test_ids_are_texts_or_whole_numbers_as_many_as_ranges(value, ids):
    assert _is_ids(value, 2) is ids
