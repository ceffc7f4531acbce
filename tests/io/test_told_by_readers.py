"""What readers say: of files that they refuse, with name and line, and of what they left out, with its number."""

import struct
import zlib
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.results import small_folder, small_log

from uwblite.errors import ConfigError, FormatError
from uwblite.io.bag_motion import no_odometry
from uwblite.io.bag_sensors import RangeReadings, ScanReadings
from uwblite.io.carmen import read_log
from uwblite.io.carmen_words import Params, is_message_name, kinds_of, parse_head, places_behind
from uwblite.io.corrected_log import write_graph_with_scans
from uwblite.io.csv_table import read_csv
from uwblite.io.formats import read_graph, refuse_existing
from uwblite.io.librsf import read_librsf
from uwblite.io.map_server import read_map
from uwblite.io.png import SIGNATURE, _chunk, decode_png, png_shape
from uwblite.io.rosbag_writer import header, pose, turn
from uwblite.io.stored_result import read_result
from uwblite.io.uwb_mapping import Reading, UwbMapping, parse_mappings, readings_of


def picture(*, depth=8, colour=0, interlaced=0, rows=b"\0\1\0\2", width=1, height=2):
    head = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, interlaced)
    return SIGNATURE + _chunk(b"IHDR", head) + _chunk(b"IDAT", zlib.compress(rows)) + _chunk(b"IEND", b"")


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (picture(depth=16), "only PNG with 8 bits per channel, without palette and interlacing, is read"),
        (picture(colour=3), "without palette"),
        (picture(interlaced=1), "without palette and interlacing"),
        (picture(rows=b"\0\1\5\2"), "the PNG's row 1 names an unknown filter"),
        (picture(rows=b"\0\1"), "the PNG is cut off"),
        (picture().replace(_chunk(b"IDAT", zlib.compress(b"\0\1\0\2")), _chunk(b"IDAT", b"none")), "pixels are damaged"),
        (picture(width=0), "a PNG of 0 x 2 pixels is not read"),
        (b"GIF89a", "this is not a PNG picture"),
        (SIGNATURE + b"\0" * 8, "the PNG has no header"),
        (SIGNATURE + _chunk(b"tEXt", b"x" * 20), "the PNG has no header"),
    ],
)
def test_pictures_that_are_not_read(data, words):
    with pytest.raises(FormatError, match=f"^a.png: .*{words}"):
        decode_png(data, "a.png")


@pytest.mark.parametrize(("colour", "channels"), [(0, 1), (2, 3), (4, 2), (6, 4)])
def test_the_shape_of_a_picture(colour, channels):
    assert png_shape(picture(colour=colour, width=5, height=3), "") == (3, 5, channels)
    assert decode_png(picture()).tolist() == [[[1]], [[2]]]


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("map.yaml", "image: a.pgm\nresolution: 0.1\n- 1\n", ":3: a list item without a key"),
        ("map.yaml", "- 1\n", ":1: a list item without a key"),
        ("map.yaml", "image a.pgm\n", ":1: is not 'key: value'"),
        ("map.yaml", "resolution: 0.1\n", "image is missing; needed are image, resolution, origin"),
        ("a.librsf", "odom2 1 2 3\n", ":1: odom2 has 4 words, expected 5"),
        ("a.librsf", "odom2 1 2 3 4\nrange2 1 2 3 4 5\n", ":2: range2 has 6 words, expected 7"),
        ("a.librsf", "odom2diff 1 2 3 4 5 6\n", ":1: odom2diff has 7 words, expected 8"),
        ("a.librsf", "odom2 1 2 x 4\n", ":1: b'x' is no finite number"),
        ("a.librsf", f"odom2 1 2 3 4\nrange2 1 2 3 4 5 {'A' * 200}\n", ":2: the anchor's id "),
        ("a.librsf", "range2 1 2 3 4 5 6\n", "holds no odometry"),
        ("a.g2o", "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 2e9 0 0\n", ":2: a number is beyond anything that is measured"),
        ("a.g2o", "VERTEX_SE2 0 0 0\n", ":1: VERTEX_SE2 has 3 fields, expected 4"),
        ("a.csv", f"a,b\n1,{'x' * 200_000}\n", "is no comma-separated table"),
    ],
)
def test_files_that_are_refused_are_named_with_the_line(tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    readers = {"yaml": read_map, "librsf": read_librsf, "g2o": read_graph, "csv": lambda path: read_csv(path).texts("a")}
    with pytest.raises(FormatError) as error:
        readers[name.rpartition(".")[2]](str(tmp_path / name))
    assert str(error.value).startswith(f"{tmp_path / name}")
    assert words in str(error.value)


def test_words_of_librsf_beyond_those_that_are_read():
    """The distance from the middle to a wheel is the fourth word, or the fifth behind a speed to the left."""
    from uwblite.io.librsf import _motion

    assert _motion("odom2diff", [0.0, 1.0, 2.0, 0.25, 9.0], 8) == (1.5, 0.0, 2.0)
    assert _motion("odom2diff", [0.0, 1.0, 2.0, 0.5, 0.25], 9) == (1.5, 0.5, 2.0)
    assert _motion("odom2diff", [0.0, 1.0, 2.0, 0.0, 9.0], 8) == (1.5, 0.0, 0.0)
    assert _motion("odom2", [0.0, 1.0, 2.0, 0.5, 9.0], 5) == (1.0, 2.0, 0.5)


def test_kinds_of_lines_beyond_a_hundred_are_counted_together(tmp_path):
    kinds = [f"KIND{k}" for k in range(103)]
    (tmp_path / "a.g2o").write_text("VERTEX_SE2 0 0 0 0\n" + "".join(f"{kind} 1\n{kind} 2\n" for kind in kinds))
    skipped = read_graph(str(tmp_path / "a.g2o")).skipped
    assert len(skipped) == 101
    assert skipped["others"] == 6
    assert {skipped[kind] for kind in kinds[:100]} == {2}
    lines = [f"ODOM {0.1 * k} 0 0 0 0 0 {k}.0 h {k}.0" for k in range(5)]
    lines += [f"MESSAGE{chr(65 + k // 26)}{chr(65 + k % 26)} 1 1.0 h 1.0" for k in range(103) for _ in range(2)]
    (tmp_path / "a.log").write_text("\n".join(lines) + "\n")
    skipped = read_log(tmp_path / "a.log").notes.skipped
    assert (len(skipped), skipped["others"]) == (101, 6)


def test_a_trajectory_and_a_result_are_no_pose_graphs(tmp_path):
    (tmp_path / "path.tum").write_text("0 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n")
    with pytest.raises(FormatError, match=r"path\.tum: is a trajectory, no pose graph"):
        read_graph(str(tmp_path / "path.tum"))
    small_folder(tmp_path / "map")
    with pytest.raises(FormatError, match=f"map: is a result; its pose graph is {tmp_path / 'map' / 'graph.g2o'}"):
        read_graph(str(tmp_path / "map"))
    (tmp_path / "map" / "graph.g2o").unlink()
    with pytest.raises(FormatError, match=r"map: has no graph\.g2o"):
        write_graph_with_scans(tmp_path / "out.g2o", read_result(tmp_path / "map"), [small_log()])
    refuse_existing(True, str(tmp_path / "path.tum"))
    refuse_existing(False, None, "", str(tmp_path), str(tmp_path / "none"))
    with pytest.raises(ConfigError, match=r"path\.tum exists; use `force` to replace it, or another name"):
        refuse_existing(False, None, str(tmp_path / "path.tum"))


@pytest.mark.parametrize(
    ("form", "good"),
    [("{}", True), ("{:04X}", True), ("a{:d}", True), *((form, False) for form in ("{:99999999d}", "{0.real}", "x", "{}{}"))],
)
def test_forms_of_anchors_names(form, good):
    text = f"[[uwb]]\nanchor_format = '{form}'\n"
    if good:
        (mapping,) = parse_mappings(text)
        assert mapping._name(0xAB) == form.format(0xAB)
    else:
        words = r"anchor_format .* is not text around one '\{\}' or such as '\{:04X\}'"
        with pytest.raises(ConfigError, match=rf"^uwb\.toml: {words}$"):
            parse_mappings(text, "uwb.toml")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", r"it must hold \[\[uwb\]\] tables and nothing else"),
        ("x = 1\n[[uwb]]\n", r"it must hold \[\[uwb\]\] tables and nothing else"),
        ("[[uwb]]\nanchor = 'topic:('\n", "anchor or anchor_format of a uwb mapping is not valid"),
        ("[[uwb]]\nrage = 'x'\n", "did you mean 'range'"),
    ],
)
def test_mappings_that_are_refused_name_their_file(text, words):
    with pytest.raises(ConfigError, match=f"^uwb mapping: .*{words}"):
        parse_mappings(text)
    with pytest.raises(ConfigError, match=f"^a.toml: .*{words}"):
        parse_mappings(text, "a.toml")


def message(**fields):
    return SimpleNamespace(**fields)


def test_readings_of_a_message_in_its_unit_with_the_names_that_it_gives():
    millimetres = UwbMapping(anchor="dest", range="mm", unit=0.001, quality="q", anchor_format="{:04X}")
    of_seven = message(dest=0xAB, mm=1500, q=70, tag_id=7)
    assert readings_of(of_seven, "/uwb", [millimetres]) == [Reading("00AB", 1.5, 70.0, "0007")]
    by_topic = UwbMapping(anchor="topic:/uwb/([^/]+)/", tag="topic:^/([^/]+)/")
    assert readings_of(message(range=2.0), "/uwb/A 1/range", [by_topic]) == [Reading("A_1", 2.0, 100.0, "uwb")]
    with pytest.raises(ConfigError, match=r"'topic:/uwb/.*' finds no anchor id in the topic /other"):
        readings_of(message(range=2.0), "/other", [by_topic])
    array = UwbMapping(anchor="index", range="ranges", only={"valid": 1})
    many = message(ranges=np.array([1.0, 0.0, np.nan, 4.0, 5.0]), valid=[1, 1, 1, 0, 1])
    assert readings_of(many, "/uwb", [array]) == [Reading("0", 1.0, 100.0), Reading("4", 5.0, 100.0)]
    assert readings_of(message(ranges=[1.0], valid=[0]), "/uwb", [array]) == []
    missing = UwbMapping(range="rnge")
    assert readings_of(message(id="A", range=3.0), "/uwb", [missing, UwbMapping()]) == [Reading("A", 3.0, 100.0)]
    with pytest.raises(ConfigError, match="a message has no field 'rnge'"):
        readings_of(message(id="A", range=3.0), "/uwb", [missing])


def test_ranges_that_are_left_out_are_counted_and_named():
    ranges, warnings = RangeReadings(), []
    for k in range(6):
        ranges.take(float(k), [Reading("A", 1.0 + k, 100.0, "T"), Reading("B", 2.0, 90.0, "T")], message())
    ranges.take(6.0, [Reading("X" * 200, 1.0, 100.0, "T"), Reading("A", np.inf, 100.0, "T")], message())
    ranges.take(7.0, [Reading(f"N{k}", 1.0, 100.0, "A") for k in range(5)], message())
    found, tags = ranges.ranges(0.25, warnings)
    assert (tags, len(found.stamps), found.anchor_ids) == (("T",), 12, ("A", "B"))
    np.testing.assert_allclose(found.stamps, np.repeat(np.arange(6), 2) + 0.25)
    np.testing.assert_allclose(found.ranges[::2], 1.0 + np.arange(6))
    np.testing.assert_allclose(found.quality, np.tile([100.0, 90.0], 6))
    left_out, others = warnings
    assert left_out.startswith("1 ranges were left out: the anchor's id ")
    assert others == (
        "5 ranges between other nodes (A to N0, A to N1, A to N2 ...) were left out: the tag on the robot is taken to be T"
    )


def test_tags_of_a_robot_are_kept_apart_and_placed_by_their_frames():
    ranges, warnings = RangeReadings(), []
    for k in range(4):
        frame = message(header=message(frame_id="front"))
        ranges.take(float(k), [Reading("A", 1.0, 100.0, "T1")], frame)
        ranges.take(k + 0.5, [Reading("A", 2.0, 100.0, "T2")], message())
    found, tags = ranges.ranges(0.0, warnings)
    assert tags == ("T1", "T2")
    np.testing.assert_array_equal(found.tag, np.tile([0, 1], 4))
    assert warnings == ["2 tags measured (T1, T2); the ranges of each are kept apart (UWB, UWB2 ...)"]
    at = np.eye(4)
    at[:3, 3] = 0.1, 0.2, 0.3
    poses = {"front": at, "tag_T2": 2.0 * at}
    frames = SimpleNamespace(pose=lambda base, name: poses.get(name) if base == "base" else None)
    np.testing.assert_allclose(ranges.places(tags, frames, "base", warnings), [[0.1, 0.2, 0.3], [0.2, 0.4, 0.6]])
    assert len(warnings) == 1
    np.testing.assert_allclose(ranges.places(tags, frames, "other", warnings), np.zeros((2, 3)))
    assert warnings[1].startswith("no transform to the tags T1, T2: they are taken to sit in the middle of the robot")


def scan(readings, first=-0.5, last=0.5, step=0.25, frame="laser", **changed):
    fields = {"angle_min": first, "angle_max": last, "angle_increment": step, "time_increment": 0.001, "range_min": 0.1,
              "range_max": 8.0, "ranges": readings, "header": message(frame_id=frame)}  # fmt: skip
    return message(**(fields | changed))


def test_scans_keep_their_geometry_and_those_of_other_frames_are_counted():
    scans, warnings = ScanReadings(), []
    for k in (3, 1, 2):
        scans.take(float(k), scan([1.0 + k, 9.0, 0.05, 0.0, np.nan]))
    scans.take(4.0, scan([1.0, 2.0, 3.0, 4.0, 5.0], frame="/back"))
    scans.take(5.0, scan([]))
    scans.take(6.0, scan([1.0] * 5, first=np.nan))
    found = scans.scans(0.5, warnings)
    np.testing.assert_allclose(found.stamps, [1.5, 2.5, 3.5])
    assert (found.angle_min, found.angle_increment, found.time_increment) == (-0.5, 0.25, 0.001)
    assert (found.range_min, found.range_max) == (0.1, 8.0)
    np.testing.assert_array_equal(found.ranges[0], np.array([2.0, np.inf, np.nan, np.inf, np.nan], dtype=np.float32))
    assert warnings[0] == "2 scans of another geometry, or without readings, were skipped"
    assert warnings[1].startswith("the scans' topic bears scans of several frames, as of two lidars: those of laser are used")
    assert "others left out (1 of back)" in warnings[1]


@pytest.mark.parametrize(
    ("changes", "step", "words"),
    [
        ({"step": 0.0}, 0.25, "angle_increment is no angle in 1 scans: angle_min and angle_max give it"),
        ({"step": np.inf}, 0.25, "angle_increment is no angle in 1 scans"),
        ({"last": 3.0}, 0.25, "contradict each other in 1 scans (the increment 14.3 degrees, by the ends 50.1)"),
        ({"last": np.nan}, 0.25, None),
        ({"last": 0.9}, 0.25, None),
        ({"step": 0.0, "last": -0.5}, None, None),
        ({"step": 0.0, "last": 9.0}, None, None),
    ],
)
def test_angles_that_contradict_each_other(changes, step, words):
    scans, warnings = ScanReadings(), []
    scans.take(1.0, scan([1.0] * 5, **changes))
    found = scans.scans(0.0, warnings)
    assert (found.angle_increment if found else None) == (pytest.approx(step) if step else None)
    assert bool(warnings) is (words is not None or step is None)
    assert words is None or words in warnings[0]


def test_a_bag_without_odometry_is_told_what_it_holds():
    topics = [(f"/t{k}", "std_msgs/String") for k in range(14)]
    assert no_odometry([], [], []).endswith("a transform from odom to the base; it holds: nothing")
    text = no_odometry(topics, ["/gt", "/truth"], ["a to b", "c to d", "e to f", "g to h", "i to j"])
    assert "; /gt, /truth is the truth by its name, and `topics.odometry=/gt` takes it nevertheless" in text
    assert "; tf moves a to b, c to d, e to f, g to h;" in text
    assert text.endswith("/t10 (std_msgs/String), /t11 (std_msgs/String) and 2 more")


def test_times_and_turns_of_ros_messages():
    assert header(12.0000000009, "map") == {"stamp": {"sec": 12, "nanosec": 1}, "frame_id": "map"}
    assert header(11.9999999999, "map")["stamp"] == {"sec": 12, "nanosec": 0}
    half = 0.5**0.5
    assert turn(np.pi / 2) == pytest.approx({"x": 0.0, "y": 0.0, "z": half, "w": half})
    assert turn(np.pi / 2, flipped=True) == pytest.approx({"x": half, "y": half, "z": 0.0, "w": 0.0})
    placed = pose(np.array([1.0, 2.0, np.pi]))
    assert placed["position"] == {"x": 1.0, "y": 2.0, "z": 0.0}
    assert placed["orientation"] == pytest.approx({"x": 0.0, "y": 0.0, "z": 1.0, "w": 0.0})


def words(text):
    return text.encode().split()


@pytest.mark.parametrize(
    ("name", "tail", "ipc_left_out", "place"),
    [
        ("FLASER", "1 2 3 4 5 6 9.5 h 9.6", False, (0, 6)),
        ("FLASER", "1 2 3 4 5 6 h 9.6", False, (0, 7)),
        ("RAWLASER1", "0 9.5 h 9.6", False, (1, 1)),
        ("RAWLASER1", "2 7 8 9.5 h 9.6", False, (3, 3)),
        ("RAWLASER1", "0 h 9.6", False, (1, 2)),
        ("ROBOTLASER1", "0 1 2 3 4 5 6 .1 .2 .3 .4 1 9.5 h 9.6", False, (1, 12)),
        ("ROBOTLASER1", "1 7 1 2 3 4 5 6 .1 .2 .3 .4 9.5 h 9.6", False, (2, 12)),
        ("ROBOTLASER1", "0 1 2 3 4 5 6 .1 .2 .3 .4 1 h 9.6", True, (1, 13)),
        ("ROBOTLASER1", "0 1 2 3 4 5 6 .1 .2 .3 .4 h 9.6", True, (1, 12)),
    ],
)
def test_poses_and_stamp_stand_behind_the_readings(name, tail, ipc_left_out, place):
    assert places_behind(name.encode(), words(tail), ipc_left_out) == place


def test_geometry_in_the_head_of_laser_messages():
    layout = parse_head(b"ROBOTLASER1", words("ROBOTLASER1 0 -1.5 3 0 8 0.01 0 7"))
    assert (layout.beams, layout.angle_min, layout.range_max) == (7, -1.5, 8.0)
    assert layout.angle_increment == pytest.approx(0.5)
    assert parse_head(b"ROBOTLASER1", words("ROBOTLASER1 0 -1.5 3 0.25 inf 0.01 0 7")).range_max == 0.0
    assert parse_head(b"ROBOTLASER1", words("ROBOTLASER1 0 0 3 0 8 0.01 0 1")).angle_increment == 3.0
    for text, why in (
        ("FLASER 0", "FLASER announces 0 readings"),
        ("FLASER 100001", "FLASER announces 100001 readings"),
        ("ROBOTLASER1 0 -1.5 3 1.0 8 0.01 0 8", "ROBOTLASER1: 8 readings 1 rad apart are more than a turn"),
        ("ROBOTLASER1 0 -9.5 3 0.1 8 0.01 0 8", "are more than a turn"),
    ):
        with pytest.raises(ValueError, match=why):
            parse_head(words(text)[0], words(text))
    assert kinds_of("") == {b"RAWLASER1": b"RAWLASER1", b"FLASER": b"FLASER", b"ROBOTLASER1": b"ROBOTLASER1"}
    assert kinds_of("ROBOTLASER2") == {b"ROBOTLASER2": b"ROBOTLASER1"}
    assert kinds_of("RLASER") == {b"RLASER": b"FLASER"}
    with pytest.raises(ConfigError, match="scans are not read from 'ROBOTLASER6'"):
        kinds_of("ROBOTLASER6")


@pytest.mark.parametrize(
    ("beams", "degrees", "first"),
    [(180, 1.0, -90.0), (181, 1.0, -90.0), (360, 0.5, -90.0), (361, 0.5, -90.0), (541, 0.5, -135.0), (400, 0.25, -50.0),
     (401, 0.25, -50.0), (720, 0.25, -90.0), (721, 0.25, -90.0), (1081, 0.25, -135.0), (682, 360 / 1024, -119.707),
     (683, 360 / 1024, -119.883), (91, 2.0, -90.0), (1, 180.0, 0.0)],
)  # fmt: skip
def test_usual_scanners_are_known_by_their_number_of_readings(beams, degrees, first):
    angle_min, increment = np.degrees(Params().guess_scanner(beams))
    assert (angle_min, increment) == pytest.approx((first, degrees), abs=1e-3)


def test_parameters_of_a_log():
    params = Params()
    for line in ("uwb_anchor_height 2.5", "uwb_anchor_height_A1 1.5", "uwb_tag_height 0.6", "uwb2_tag_offset_x -0.3",
                 "robot_frontlaser_offset 0.1", "robot_frontlaser_side_offset 0.2", "robot_frontlaser_angular_offset 0.3",
                 "laser_flipped ON", "laser_front_laser_resolution 0.5", "nothing 7", "laser_time_increment 1e-4",
                 "laser_time_increment 2e-4"):  # fmt: skip
        params.take(words(f"PARAM {line} 0 h 0"))
    mounting = params.mounting(None, 2)
    assert (mounting.anchor_height, mounting.anchor_heights, mounting.laser_flipped) == (2.5, {"A1": 1.5}, True)
    assert mounting.T_base_laser.tolist() == [0.1, 0.2, 0.3]
    assert mounting.tag_position.tolist() == [0.0, 0.0, 0.6]
    assert mounting.more_tags.tolist() == [[-0.3, 0.0, 0.0]]
    assert [params.gives_tag(k) for k in (2, 3)] == [True, False]
    assert params.get("none", "laser_time_increment") == 2e-4
    assert params.get("none") is None
    assert np.degrees(params.guess_scanner(181)) == pytest.approx([-45.0, 0.5])
    assert params.mounting(np.array([1.0, 2.0, 3.0]), 1).T_base_laser.tolist() == [1.0, 2.0, 3.0]
    assert not params.mounting(None, 1).laser_is_base
    params.take(words("PARAM laser_is_base on 0 h 0"))
    assert params.mounting(None, 1).laser_is_base
    for line, why in (
        ("uwb_tag_height", "PARAM needs a name and a value"),
        ("laser_flipped maybe", "must be on or off"),
        ("uwb_tag_height x", "could not convert"),
        (f"uwb_anchor_height_{'A' * 200} 1", "the anchor's id"),
    ):
        with pytest.raises(ValueError, match=why):
            params.take(words(f"PARAM {line}"))
    second = Params(2)
    for line in ("laser_time_increment 1e-4", "laser2_time_increment 3e-4", "laser2_flipped on", "laser_range_min 0.5"):
        second.take(words(f"PARAM {line} 0 h 0"))
    assert (second.get("laser_time_increment"), second.get("laser_range_min")) == (3e-4, None)
    assert second.mounting(None, 1).laser_flipped


@pytest.mark.parametrize(
    ("name", "could_be"),
    [("A", False), ("AB", True), ("A1", True), ("1A", False), ("A_B-2", True), ("_", False), ("Ab", False), ("A.B", False),
     (40 * "A", True), (41 * "A", False)],
)  # fmt: skip
def test_names_of_messages_are_capitals_of_two_to_forty(name, could_be):
    assert is_message_name(name.encode()) == could_be
