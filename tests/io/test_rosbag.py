"""Bags: round trips through both storages, a real one against its published log, messages of all kinds, broken files."""

import dataclasses
import os
import sqlite3
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.results import small_log

from uwblite.errors import ConfigError, FormatError, UwbliteError
from uwblite.io.bag_reading import open_bag
from uwblite.io.bag_topics import TopicPlan
from uwblite.io.carmen import read_log
from uwblite.io.rosbag import BagTopics, Collector, plan_bag, read_bag
from uwblite.io.rosbag_writer import write_bag
from uwblite.io.uwb_mapping import UwbMapping, parse_mappings
from uwblite.sensor_log import Gyro, LaserScans, Odometry, SensorLog, SensorMounting, UwbRanges

rosbags = pytest.importorskip("rosbags.highlevel", reason="rosbags is absent")


def recording(*, flipped=False):
    rng = np.random.default_rng(5)
    stamps = 1.6e9 + 0.1 * np.arange(40)
    poses = np.column_stack([np.linspace(0, 3, 40), np.sin(np.linspace(0, 3, 40)), np.linspace(-3, 3, 40)])
    when = np.sort(rng.uniform(stamps[0], stamps[-1], 60)).round(6)
    ids = ("5C0B", "9.1/A", "tag-3")
    ranges = UwbRanges(when, np.arange(60) % 3, rng.uniform(1, 9, 60), np.full(60, 100.0), ids)
    readings = rng.uniform(0.5, 5.0, (20, 30)).astype(np.float32)
    readings[3, 4], readings[5, 6] = np.inf, np.nan
    scans = LaserScans(stamps[::2] + 0.01, readings, -1.5, 0.1, 1e-4, 0.02, 5.6)
    mounting = SensorMounting(np.array([0.1, -0.05, 0.3]), flipped, np.array([0.02, 0.03, 0.4]))
    return SensorLog(Odometry(stamps, poses), ranges, scans, mounting)


def assert_same(one, two):
    np.testing.assert_allclose(one.odometry.stamps, two.odometry.stamps, atol=1e-6)
    np.testing.assert_allclose(one.odometry.poses, two.odometry.poses, atol=1e-9)
    assert one.ranges.anchor_ids == two.ranges.anchor_ids
    assert np.array_equal(one.ranges.anchor, two.ranges.anchor)
    np.testing.assert_allclose(one.ranges.ranges, two.ranges.ranges, atol=1e-5)
    np.testing.assert_allclose(one.scans.stamps, two.scans.stamps, atol=1e-6)
    np.testing.assert_array_equal(one.scans.ranges, two.scans.ranges)
    for name in ("angle_min", "angle_increment", "time_increment", "range_min", "range_max"):
        assert getattr(one.scans, name) == pytest.approx(getattr(two.scans, name), rel=1e-6)
    np.testing.assert_allclose(one.mounting.T_base_laser, two.mounting.T_base_laser, atol=1e-9)
    np.testing.assert_allclose(one.mounting.tag_position, two.mounting.tag_position, atol=1e-9)
    assert one.mounting.laser_flipped == two.mounting.laser_flipped


def test_the_heading_of_a_gyro_is_an_imu(tmp_path):
    log = replace(recording(), gyro=Gyro(np.array([1.6e9, 1.6e9 + 0.5]), np.array([0.25, 4.0])))
    write_bag(tmp_path / "bag", log)
    with rosbags.AnyReader([tmp_path / "bag"]) as reader:
        (topic,) = [c for c in reader.connections if c.topic == "/imu"]
        found = [reader.deserialize(raw, topic.msgtype) for _, _, raw in reader.messages([topic])]
    turns = [2 * np.arctan2(m.orientation.z, m.orientation.w) for m in found]
    assert turns == pytest.approx([0.25, 4.0])
    assert [m.angular_velocity_covariance[0] for m in found] == [-1.0, -1.0]


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("flipped", [False, True])
def test_a_recording_survives_a_bag(tmp_path, storage, flipped):
    write_bag(tmp_path / "bag", recording(flipped=flipped), storage=storage)
    read = read_bag(tmp_path / "bag")
    assert_same(read, recording(flipped=flipped))
    assert len(read.notes.sha256) == 64
    assert [p.name for p in tmp_path.iterdir()] == ["bag"]
    with pytest.raises(ConfigError, match="exists"):
        write_bag(tmp_path / "bag", recording())


def test_a_recording_whose_clock_begins_at_0_carries_its_times(tmp_path):
    stamps, log = 0.1 * np.arange(40), recording()
    write_bag(tmp_path / "bag", SensorLog(replace(log.odometry, stamps=stamps)))
    read = read_bag(tmp_path / "bag")
    assert not read.notes.warnings
    np.testing.assert_allclose(read.odometry.stamps, stamps, atol=1e-9)


def test_topics_are_listed_and_wrong_ones_refused(tmp_path):
    write_bag(tmp_path / "bag", recording())
    topics = {t.name: t for t in plan_bag(tmp_path / "bag")[0]}
    assert topics["/odom"].count == 40
    assert topics["/uwb/anchor_9_1_A/range"].type == "sensor_msgs/msg/Range"
    with pytest.raises(ConfigError, match=r"no topic /odo; did you mean /odom\? it has .*/odom"):
        read_bag(tmp_path / "bag", BagTopics(odometry="/odo"))
    with pytest.raises(ConfigError, match="no uwb mapping reads /odom"):
        read_bag(tmp_path / "bag", BagTopics(uwb=("/odom",)))
    with pytest.raises(ConfigError, match=r"/scan is of type sensor_msgs/LaserScan; odometry .* nav_msgs/Odometry.*: /odom"):
        read_bag(tmp_path / "bag", BagTopics(odometry="/scan"))
    with pytest.raises(ConfigError, match=r"no frame base_lnk; did you mean base_link\? they know .*, odom, uwb_tag"):
        read_bag(tmp_path / "bag", BagTopics(base_frame="base_lnk"))
    one = read_bag(tmp_path / "bag", BagTopics(uwb=("/uwb/anchor_5C0B/range",)))
    assert one.ranges.anchor_ids == ("5C0B",)


def test_a_mapping_of_ones_own_wins(tmp_path):
    write_bag(tmp_path / "bag", recording())
    mapping = UwbMapping(topic="/uwb/anchor_5*", anchor="topic:anchor_(.*)/", range="range", unit=2.0)
    read = read_bag(tmp_path / "bag", BagTopics(uwb=("/uwb/anchor_5C0B/range",)), (mapping,))
    assert read.ranges.anchor_ids == ("5C0B",)
    np.testing.assert_allclose(read.ranges.ranges, 2 * recording().ranges.ranges[::3], atol=1e-5)
    with pytest.raises(ConfigError, match="has no field 'rnge'; it has header"):
        read_bag(tmp_path / "bag", mappings=(UwbMapping(topic="/uwb/*", type="*", range="rnge"),))


@pytest.mark.parametrize(
    ("name", "definition", "fields", "mapping", "expected"),
    [
        ("gtec_msgs/msg/Ranging", "int16 anchorId\nint32 range", (7, 3456), None, [("7", 3.456)]),
        (
            "px4_msgs/msg/SensorUwb", "uint16 mac_dest\nfloat32 distance", (0x5C0B, 2.5), None, [("5C0B", 2.5)],
        ),
        (
            "x_msgs/msg/Distances", "uint16[3] anchor_distance", (np.array([120, 250, 399], dtype=np.uint16),),
            UwbMapping(type="x_msgs/*", anchor="index", range="anchor_distance", unit=0.01, stamp=""),
            [("0", 1.2), ("1", 2.5), ("2", 3.99)],
        ),
        (
            "x_msgs/msg/Two", "int16 tagId\nint16 anchorId\nfloat32 range", (2, 9, 1.5),
            UwbMapping(type="x_msgs/*", anchor="anchorId", stamp="", only={"tagId": 3}), [],
        ),
    ],
)  # fmt: skip
def test_foreign_messages_are_understood(tmp_path, name, definition, fields, mapping, expected):
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(definition, name))
    t = store.types
    header = t["std_msgs/msg/Header"](seq=0, stamp=t["builtin_interfaces/msg/Time"](5, 0), frame_id="odom")
    point, turn = t["geometry_msgs/msg/Point"](1, 2, 0), t["geometry_msgs/msg/Quaternion"](0, 0, 1, 0)
    pose = t["geometry_msgs/msg/PoseWithCovariance"](t["geometry_msgs/msg/Pose"](point, turn), np.zeros(36))
    still = t["geometry_msgs/msg/Vector3"](0, 0, 0)
    twist = t["geometry_msgs/msg/TwistWithCovariance"](t["geometry_msgs/msg/Twist"](still, still), np.zeros(36))
    odometry = t["nav_msgs/msg/Odometry"](header, "base_link", pose, twist)
    with Writer(tmp_path / "x.bag") as writer:
        wheels = writer.add_connection("/odom", "nav_msgs/msg/Odometry", typestore=store)
        radio = writer.add_connection("/uwb", name, typestore=store)
        writer.write(wheels, 5_000_000_000, store.serialize_ros1(odometry, "nav_msgs/msg/Odometry"))
        writer.write(radio, 6_500_000_000, store.serialize_ros1(t[name](*fields), name))
    log = read_bag(tmp_path / "x.bag", mappings=(mapping,) if mapping else ())
    assert log.odometry.poses[0].tolist() == pytest.approx([1, 2, np.pi])
    if not expected:
        assert log.ranges is None
        return
    assert [(log.ranges.anchor_ids[a], r) for a, r in zip(log.ranges.anchor, log.ranges.ranges, strict=True)] == [
        (anchor, pytest.approx(distance, rel=1e-6)) for anchor, distance in expected
    ]
    assert set(log.ranges.stamps) == {6.5}


def test_the_real_bag_gives_the_measurements_of_its_log(shared_data):
    folder = shared_data / "kasdorf_2017-11-17-12-31-28"
    bag, log = read_bag(folder / "record.bag"), read_log(folder / "run.log.gz")
    start = bag.odometry.stamps[0]
    # The log holds six decimals and counts time from the first odometry.
    for one, two in ((bag.odometry, log.odometry), (bag.ranges, log.ranges), (bag.scans, log.scans)):
        np.testing.assert_allclose(one.stamps - start, two.stamps, atol=1e-6)
    np.testing.assert_allclose(bag.odometry.poses, log.odometry.poses, atol=1e-6)
    np.testing.assert_array_equal(bag.ranges.ranges, log.ranges.ranges)
    assert bag.ranges.anchor_ids == log.ranges.anchor_ids
    assert np.array_equal(bag.ranges.anchor, log.ranges.anchor)
    np.testing.assert_allclose(bag.scans.ranges, log.scans.ranges, atol=6e-4)
    np.testing.assert_allclose(bag.mounting.T_base_laser, log.mounting.T_base_laser, atol=1e-6)
    np.testing.assert_allclose(bag.mounting.tag_position, log.mounting.tag_position, atol=1e-6)
    assert bag.notes.warnings[0] == "the scans are read from /scan; `topics.scan` takes another (/sonar_scan)"
    assert "not used: /beacon" in bag.notes.warnings[1]


@pytest.mark.parametrize("content", [b"", b"#ROSBAG V2.0\n", b"#ROSBAG V2.0\n" + bytes(range(256)) * 20, b"\x89MCAP0\r\n"])
@pytest.mark.parametrize("ending", [".bag", ".mcap", ".db3"])
def test_a_broken_bag_is_one_clear_error(tmp_path, content, ending):
    file = tmp_path / f"x{ending}"
    file.write_bytes(content)
    with pytest.raises(FormatError, match="cannot be read as a ROS bag"):
        read_bag(file)


def test_a_missing_bag_and_an_empty_folder(tmp_path):
    with pytest.raises(FormatError, match="no such file"):
        read_bag(tmp_path / "none.bag")
    with pytest.raises(FormatError):
        read_bag(tmp_path)


def test_mappings_are_read_strictly():
    text = '[[uwb]]\ntopic = "/beacon_raw"\nreadings = "sensed_data"\nunit = 0.001\nonly = { tagId = 3 }\n'
    (mapping,) = parse_mappings(text)
    assert (mapping.topic, mapping.readings, mapping.unit, mapping.only) == ("/beacon_raw", "sensed_data", 0.001, {"tagId": 3})
    for wrong, message in (
        ("[[uwb]]\ntopc = 1", "did you mean 'topic'"),
        ("[uwb]\ntopic = 'x'", "uwb"),
        ("x = 1", "uwb"),
        ("uwb = [1]", "must hold"),
        ('[[uwb]]\nanchor_format = "{:q}"', "not valid"),
        ('[[uwb]]\nanchor_format = "{:09999}"', "is not text around one"),
        ('[[uwb]]\nanchor_format = "{0.real}"', "is not text around one"),
        ('[[uwb]]\nanchor = "topic:("', "not valid"),
        ("[[uwb]", "not valid TOML"),
    ):
        for path, named in (("", "uwb mapping"), ("u.toml", "u.toml")):
            with pytest.raises(ConfigError, match=f"^{named}: .*{message}"):
                parse_mappings(wrong, path)


def test_an_id_with_blanks_stays_one_word():
    @dataclasses.dataclass
    class Message:
        id: str = " a b\n"
        range: float = 1.0

    assert UwbMapping(stamp="").extract(Message(), "/uwb") == [("a_b", 1.0, 100.0, "")]


@pytest.mark.slow
def test_the_real_bag_gives_the_map_of_its_log(shared_data):
    from scipy.spatial import cKDTree

    from uwblite import se2
    from uwblite.mapping import build_map

    folder = shared_data / "kasdorf_2017-11-17-12-31-28"
    both = read_bag(folder / "record.bag"), read_log(folder / "run.log.gz")
    bag, log = (build_map(one.crop(end=float(one.odometry.stamps[0]) + 120.0)) for one in both)
    poses = se2.interpolate_trajectory(bag.stamps - bag.stamps[0], bag.trajectory, log.stamps)
    # The log leaves out the time within a sweep: at 0.2 m/s a sweep of 50 ms is a centimetre.
    assert np.sqrt(np.mean(np.sum((poses - log.trajectory)[:, :2] ** 2, axis=1))) < 0.02
    one, two = bag.grid.occupied_points(), log.grid.occupied_points()
    near = 1.01 * log.grid.geometry.resolution
    assert np.mean(cKDTree(one).query(two)[0] < near) > 0.9
    assert np.mean(cKDTree(two).query(one)[0] < near) > 0.9


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("first", [-5.0, 3e9, 1e15])
def test_a_time_that_ros_cannot_count_is_named(tmp_path, storage, first):
    whole = small_log()
    moved = replace(whole.odometry, stamps=whole.odometry.stamps - whole.odometry.stamps[0] + first)
    late = replace(whole, odometry=moved, ranges=None, scans=None)
    with pytest.raises(FormatError, match="has no place in a ROS message"):
        write_bag(tmp_path / "bag", late, storage=storage)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_full_disk_is_one_line_and_leaves_nothing(tmp_path, storage):
    """A limit on the size of files stands for the disk."""
    resource = pytest.importorskip("resource")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        with pytest.raises((FormatError, OSError)) as caught:
            write_bag(tmp_path / "bag", small_log(), storage=storage)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_a_database_that_is_no_bag(tmp_path):
    connection = sqlite3.connect(tmp_path / "x.db3")
    connection.execute("create table topics(id)")
    connection.commit()
    connection.close()
    with pytest.raises(UwbliteError):
        read_bag(tmp_path / "x.db3")
    assert [p.name for p in tmp_path.iterdir()] == ["x.db3"]


def test_scans_of_another_number_of_beams_are_resampled():
    """A spinning lidar in a round room; scans that look elsewhere are of another one."""

    def message(stamp, beams, first=-np.pi):
        time = SimpleNamespace(sec=stamp, nanosec=0)
        return SimpleNamespace(
            header=SimpleNamespace(stamp=time, frame_id="laser"), angle_min=first, angle_increment=2 * np.pi / beams,
            time_increment=0.0, range_min=0.1, range_max=8.0, ranges=np.full(beams, 3.0, dtype=np.float32),
        )  # fmt: skip

    found = Collector(TopicPlan("/odom", "/scan", "", {}, (), (), {}))
    for stamp, beams in enumerate([672, 679, 0, 682, 672], start=1):
        found.take("/scan", float(stamp), message(stamp, beams) if beams else replace_ranges(message(stamp, 672)))
    found.take("/scan", 6.0, message(6, 400, first=0.0))
    warnings = []
    scans = found.scans.scans(0.0, warnings)
    assert scans.ranges.shape == (4, 672)
    assert (scans.ranges == 3.0).all()
    assert warnings == [
        "2 scans of another geometry, or without readings, were skipped",
        "2 of 4 scans have other beams than most; they were resampled to 672 beams",
    ]


def replace_ranges(message):
    """The message without readings."""
    return SimpleNamespace(**{**vars(message), "ranges": np.zeros(0, dtype=np.float32)})


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="needs a file system in which nothing can be made")
def test_an_error_names_the_bag_that_was_asked_for():
    with pytest.raises(OSError, match="uwblite") as refused:
        write_bag("/proc/uwblite.mcap", recording())
    assert refused.value.filename == "/proc/uwblite.mcap"


def test_messages_whose_definition_the_bag_does_not_hold_are_named(tmp_path):
    import sqlite3

    from rosbags.rosbag2 import Writer

    with Writer(tmp_path / "bag", version=9) as writer:
        connection = writer.add_connection("/odd", "my_msgs/msg/Odd", msgdef="float64 x\n", rihs01="RIHS01_00")
        writer.write(connection, 10**9, b"\0\1\0\0" + bytes(8))
    with sqlite3.connect(next((tmp_path / "bag").glob("*.db3"))) as database:
        database.execute("DELETE FROM message_definitions")
    with (
        pytest.raises(FormatError, match="definition of my_msgs/msg/Odd, on /odd, cannot be read: the bag does not hold it"),
        open_bag(tmp_path / "bag") as bag,
    ):
        list(bag.messages(["/odd"]))
