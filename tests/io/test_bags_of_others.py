"""Bags as others record them: without an odometry topic, not closed, with several tags or lidars, with invalid fields."""

import shutil

import numpy as np
import pytest
from helpers.bags import HEADER, made, odometry, stamped, store_with, write_bag_of
from helpers.results import small_log

from uwblite.errors import FormatError
from uwblite.io.bag_topics import BagTopics
from uwblite.io.rosbag import plan_bag, read_bag
from uwblite.io.rosbag_writer import write_bag

pytest.importorskip("rosbags.highlevel", reason="rosbags is absent")

ODOMETRY, SCAN, TF = "nav_msgs/msg/Odometry", "sensor_msgs/msg/LaserScan", "tf2_msgs/msg/TFMessage"
TWIST = "geometry_msgs/msg/Twist"


def pose(seconds, x=0.0, turn=None, topic="/odom", recorded=None):
    body = {"position": {"x": x}, "orientation": turn or {"w": 1.0}}
    fields = {"header": stamped(seconds, "odom"), "child_frame_id": "base_link", "pose": {"pose": body}}
    return seconds if recorded is None else recorded, topic, ODOMETRY, fields


def transform(seconds, parent, child, x=0.0, turn=None):
    moved = {"translation": {"x": x}, "rotation": turn or {"w": 1.0}}
    fields = {"transforms": [{"header": stamped(seconds, parent), "child_frame_id": child, "transform": moved}]}
    return seconds, "/tf", TF, fields


def scan(seconds, readings=(1.0, 2.0, 3.0), frame="laser", recorded=None, **changes):
    count = len(readings)
    angles = {"angle_min": -0.1, "angle_max": -0.1 + 0.1 * (count - 1), "angle_increment": 0.1}
    angles |= {"range_min": 0.1, "range_max": 8.0}
    fields = {"header": stamped(seconds, frame), **angles, "ranges": list(readings)} | changes
    return seconds if recorded is None else recorded, "/scan", SCAN, fields


def bag(tmp_path, messages, definitions=None, ros=2):
    path = tmp_path / ("bag.bag" if ros == 1 else "bag")
    tf = {TF: "geometry_msgs/TransformStamped[] transforms"} if ros == 1 else {}
    write_bag_of(path, sorted(messages, key=lambda row: row[0]), tf | (definitions or {}), ros)
    return path


def warned(log, text):
    return any(text in w for w in log.notes.warnings)


@pytest.mark.parametrize("ros", [1, 2])
def test_tf_is_the_odometry_where_no_topic_is(tmp_path, ros):
    rows = [transform(1.0 + 0.1 * k, "odom", "base_footprint", 0.05 * k) for k in range(20)]
    rows += [transform(1.0 + 0.1 * k, "map", "odom", 9.0) for k in range(30)]
    rows += [transform(1.0, "base_footprint", "laser", 0.2), *(scan(1.0 + 0.1 * k) for k in range(20))]
    log = read_bag(bag(tmp_path, rows, ros=ros))
    np.testing.assert_allclose(log.odometry.stamps, 1.0 + 0.1 * np.arange(20))
    np.testing.assert_allclose(log.odometry.poses[:, 0], 0.05 * np.arange(20))
    np.testing.assert_allclose(log.mounting.T_base_laser, [0.2, 0.0, 0.0])
    assert warned(log, "the odometry is read from tf, odom -> base_footprint: no topic of nav_msgs/Odometry is there")


def test_tf_can_be_asked_for(tmp_path):
    rows = [pose(1.0 + 0.1 * k, 5.0) for k in range(20)]
    rows += [transform(1.0 + 0.1 * k, "odom", "base_link", 0.05 * k) for k in range(20)]
    path = bag(tmp_path, rows)
    assert np.all(read_bag(path).odometry.poses[:, 0] == 5.0)
    log = read_bag(path, BagTopics(odometry="/tf"))
    np.testing.assert_allclose(log.odometry.poses[:, 0], 0.05 * np.arange(20))


def test_the_truth_is_no_odometry(tmp_path):
    """Not by itself; whoever names it gets it. Of other topics one is chosen, and the choice is said."""
    rows = [pose(1.0 + 0.01 * k, topic="/robot/ground_truth/odom") for k in range(200)]
    path = bag(tmp_path, [*rows, pose(1.0, 1.0, topic="/wheels"), pose(2.0, 1.0, topic="/wheels"), pose(2.0, topic="/other")])
    log = read_bag(path)
    assert len(log.odometry.stamps) == 2
    assert warned(log, "the odometry is read from /wheels; `topics.odometry` takes another (/other, /robot/ground_truth/odom)")
    assert len(read_bag(path, BagTopics(odometry="/robot/ground_truth/odom")).odometry.stamps) == 200
    (tmp_path / "alone").mkdir()
    with pytest.raises(FormatError, match=r"no odometry.*; /gt/pose is the truth by its name, and `topics.odometry=/gt/pose`"):
        read_bag(bag(tmp_path / "alone", [pose(1.0, topic="/gt/pose")]))


def test_a_bag_without_sensors_says_what_it_holds(tmp_path):
    path = bag(tmp_path, [(1.0, "/cmd_vel", TWIST, {}), transform(1.0, "map", "base_link")])
    with pytest.raises(FormatError, match=r"no odometry.*tf moves map -> base_link; it holds: /cmd_vel \(geometry_msgs/Twist"):
        read_bag(path)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The bytes of a bag of 1000 poses, of ROS 2 and of ROS 1, by the ends of their names."""
    rows, folder = [odometry(1.0 + 0.02 * k, 0.01 * k) for k in range(1000)], tmp_path_factory.mktemp("whole")
    parts = next(bag(folder, rows).glob("*.mcap"))
    return {"mcap": parts.read_bytes(), "bag": bag(folder, rows, ros=1).read_bytes()}


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
@pytest.mark.parametrize("kind", ["mcap", "bag"])
@pytest.mark.parametrize("name", ["run{}", "run{}.active", "recording"])
def test_of_a_recording_that_was_not_closed_what_is_complete_is_read(tmp_path, whole, kind, share, name):
    """Whatever the file is called: up to the cut the readings are those of the whole bag."""
    data = whole[kind]
    cut = tmp_path / name.format(f".{kind}")
    cut.write_bytes(data[: int(share * len(data))])
    log = read_bag(cut)
    count = len(log.odometry.stamps)
    assert (share - 0.25) * 1000 < count <= 1000
    np.testing.assert_allclose(log.odometry.stamps, 1.0 + 0.02 * np.arange(count), atol=1e-6)
    assert warned(log, "the recording was not closed")
    assert warned(log, f"what is complete, {0.02 * (count - 1):.0f} s, was read")


@pytest.mark.parametrize("compression", ["lz4", "zstd"])
def test_packed_blocks_that_are_complete_are_read(tmp_path, compression):
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    store, kind = store_with({}, 2), ODOMETRY
    writer = Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP)
    if compression == "zstd":
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer as out:
        connection = out.add_connection("/odom", kind, typestore=store)
        for k in range(3000):
            _, _, _, fields = odometry(1.0 + 0.02 * k, 0.01 * k)
            out.write(connection, round((1.0 + 0.02 * k) * 1e9), store.serialize_cdr(made(store, kind, fields), kind))
    whole = next((tmp_path / "bag").glob("*.mcap"))
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[: int(0.8 * whole.stat().st_size)])
    log = read_bag(cut)
    assert len(log.odometry.stamps) > 300


@pytest.fixture(scope="module")
def store_and_poses():
    """What ROS 1 knows, and 6000 poses that do not pack too well, as bytes, each with its time in ns."""
    store, poses = store_with({}, 1), []
    for k in range(6000):
        _, _, _, fields = odometry(1.0 + 0.02 * k, 0.01 * k + 1e-4 * ((k * 7919) % 101))
        poses.append((round((1.0 + 0.02 * k) * 1e9), store.serialize_ros1(made(store, ODOMETRY, fields), ODOMETRY)))
    return store, poses


@pytest.mark.parametrize("compression", ["BZ2", "LZ4"])
def test_of_packed_blocks_of_ros1_the_beginning_is_read(tmp_path, store_and_poses, compression):
    """A block that is cut off keeps what its packer had finished."""
    from rosbags.rosbag1 import Writer

    store, poses = store_and_poses
    writer = Writer(tmp_path / "run.bag")
    writer.set_compression(getattr(Writer.CompressionFormat, compression))
    with writer as out:
        connection = out.add_connection("/odom", ODOMETRY, typestore=store)
        for time, data in poses:
            out.write(connection, time, data)
    data = (tmp_path / "run.bag").read_bytes()
    (tmp_path / "cut.bag").write_bytes(data[: int(0.8 * len(data))])
    log = read_bag(tmp_path / "cut.bag")
    count = len(log.odometry.stamps)
    assert 2000 < count < 6000
    np.testing.assert_allclose(log.odometry.stamps, 1.0 + 0.02 * np.arange(count), atol=1e-6)


def test_ros1_blocks_without_an_index_at_the_end(tmp_path):
    """The header of an active bag names no index, and its last block states no length."""
    path = bag(tmp_path, [odometry(1.0 + 0.02 * k, 0.01 * k) for k in range(500)], ros=1)
    data = bytearray(path.read_bytes())
    place = data.index(b"index_pos=") + len(b"index_pos=")
    index = int.from_bytes(data[place : place + 8], "little")
    data[place : place + 8] = bytes(8)
    (tmp_path / "run.bag.active").write_bytes(data[:index])
    assert len(read_bag(tmp_path / "run.bag.active").odometry.stamps) == 500


def test_a_file_of_which_nothing_is_complete_names_the_cure(tmp_path):
    path = bag(tmp_path, [odometry(1.0 + 0.02 * k) for k in range(100)])
    data = next(path.glob("*.mcap")).read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[:100])
    with pytest.raises(FormatError, match=r"not closed, or is damaged .*no message of it is complete; mcap recover cut.mcap"):
        read_bag(tmp_path / "cut.mcap")
    (tmp_path / "zeros.mcap").write_bytes(bytes(4096))
    with pytest.raises(FormatError, match="zeros alone, as after a power failure"):
        read_bag(tmp_path / "zeros.mcap")


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_folder_without_metadata_is_its_parts(tmp_path, storage):
    log = small_log()
    half = float(np.median(log.odometry.stamps))
    for k, part in enumerate((log.crop(-np.inf, half), log.crop(half + 1e-9, np.inf))):
        write_bag(tmp_path / f"part{k}", part, storage=storage)
    folder = tmp_path / "run"
    folder.mkdir()
    for k, number in enumerate((2, 10)):
        file = next(p for p in (tmp_path / f"part{k}").iterdir() if p.suffix in (".mcap", ".db3"))
        shutil.copy(file, folder / f"run_{number}{file.suffix}")
    read = read_bag(folder)
    np.testing.assert_allclose(read.odometry.stamps, log.odometry.stamps, atol=1e-6)
    assert warned(read, "its folder has no metadata.yaml (ros2 bag reindex run writes it)")
    shutil.copy(tmp_path / "part0" / "metadata.yaml", folder)  # names files that are not there
    assert warned(read_bag(folder), "has a metadata.yaml that does not fit")
    (folder / f"run_11{file.suffix}").write_bytes(b"no bag at all")
    assert warned(read_bag(folder), "not read: run_11")


def test_a_definition_that_nobody_needs_may_be_broken(tmp_path):
    kind = "x_msgs/msg/Thing"
    path = bag(tmp_path, [odometry(1.0), odometry(2.0, 1.0), (1.5, "/thing", kind, {"value": 1})], {kind: "int32 value"})
    file = next(path.glob("*.mcap"))
    data = file.read_bytes()
    assert data.count(b"int32 value") >= 1
    file.write_bytes(data.replace(b"int32 value", b"int32 v@lue"))
    (path / "metadata.yaml").unlink()
    assert len(read_bag(path).odometry.stamps) == 2
    assert [t.name for t in plan_bag(path)[0]] == ["/odom", "/thing"]


GTEC = {"gtec_msgs/msg/Ranging": "int32 anchorId\nint32 tagId\nint32 range"}


def test_tags_are_kept_apart_by_the_field_that_names_them(tmp_path):
    rows = [odometry(1.0 + 0.1 * k, 0.1 * k) for k in range(40)]
    rows += [(1.0 + 0.1 * k, "/gtec/toa", "gtec_msgs/msg/Ranging",
              {"anchorId": k % 4, "tagId": 20 + k % 2, "range": 3000 + 300 * (k % 2)}) for k in range(40)]  # fmt: skip
    rows += [transform(1.0, "base_link", "uwb_21", 0.3), transform(1.0, "base_link", "uwb_20", -0.1)]
    log = read_bag(bag(tmp_path, rows, GTEC))
    assert log.ranges.tag.tolist() == [0, 1] * 20
    np.testing.assert_allclose(log.ranges.ranges, [3.0, 3.3] * 20)
    np.testing.assert_allclose(log.mounting.tags[:, 0], [-0.1, 0.3])
    assert warned(log, "2 tags measured (20, 21)")


def test_ranges_between_other_nodes_are_none_of_ours(tmp_path):
    pairs = [("n_3", "n_7"), ("n_3", "n_4"), ("n_3", "n_5"), ("n_4", "n_7"), ("n_5", "n_7")]
    rows = [odometry(1.0 + 0.1 * k, 0.1 * k) for k in range(40)]
    rows += [(t, f"/uwb/tof/{a}/{b}/distance", "sensor_msgs/msg/Range", {"header": stamped(t), "range": 2.0})
             for t in 1.0 + 0.1 * np.arange(40) for a, b in pairs]  # fmt: skip
    log = read_bag(bag(tmp_path, rows))
    assert log.ranges.anchor_ids == ("n_4", "n_5", "n_7")
    assert len(log.ranges.stamps) == 120
    assert warned(log, "80 ranges between other nodes (n_4 to n_7, n_5 to n_7) were left out: the tag on the robot is taken")


def test_of_many_other_nodes_three_are_named(tmp_path):
    pairs = [("n_3", "n_7"), *(("n_3", f"n_{k}") for k in (4, 5, 6, 8)), *((f"n_{k}", "n_7") for k in (4, 5, 6, 8))]
    rows = [odometry(1.0 + 0.1 * k, 0.1 * k) for k in range(40)]
    rows += [(t, f"/uwb/tof/{a}/{b}/distance", "sensor_msgs/msg/Range", {"header": stamped(t), "range": 2.0})
             for t in 1.0 + 0.1 * np.arange(40) for a, b in pairs]  # fmt: skip
    log = read_bag(bag(tmp_path, rows))
    assert warned(log, "160 ranges between other nodes (n_4 to n_7, n_5 to n_7, n_6 to n_7 ...) were left out")


def test_arrays_beside_each_other_are_guessed(tmp_path):
    definitions = {"x_msgs/msg/UwbRanges": f"{HEADER} header\nint32[] destination_id\nfloat64[] distance"}
    message = {"header": stamped(1.0), "destination_id": [7, 9], "distance": [1500.0, 3250.0]}
    path = bag(tmp_path, [odometry(1.0), odometry(2.0, 1.0), (1.0, "/uwb", "x_msgs/msg/UwbRanges", message)], definitions)
    (mapping,) = plan_bag(path)[1].unread.values()
    assert (mapping.anchor, mapping.range, mapping.unit) == ("destination_id", "distance", 0.001)
    log = read_bag(path, mappings=(mapping,))
    assert log.ranges.anchor_ids == ("7", "9")
    np.testing.assert_allclose(log.ranges.ranges, [1.5, 3.25])


def test_scans_of_two_frames_on_one_topic_are_of_two_lidars(tmp_path):
    rows = [odometry(1.0 + 0.1 * k, 0.1 * k) for k in range(10)]
    rows += [scan(1.0 + 0.1 * k) for k in range(10)] + [scan(1.05 + 0.1 * k, (5.0, 5.0, 5.0), "rear") for k in range(9)]
    log = read_bag(bag(tmp_path, rows))
    assert log.scans.ranges.shape == (10, 3)
    assert float(log.scans.ranges.max()) == 3.0
    assert warned(log, "scans of several frames, as of two lidars: those of laser are used, others left out (9 of rear)")


def test_an_orientation_that_is_none_is_no_heading(tmp_path):
    """Zeros state nothing; a quaternion of another length states its direction."""
    half = np.sqrt(0.5)
    rows = [pose(1.0, 0.0, {"z": 2 * half, "w": 2 * half}), pose(1.1, 0.1, {"x": 0.0}), pose(1.2, 0.2, {"z": half, "w": half})]
    rows += [transform(1.0, "base_link", "laser", 0.2, {"x": 0.0}), scan(1.1)]
    log = read_bag(bag(tmp_path, rows))
    np.testing.assert_allclose(log.odometry.poses[:, 2], np.pi / 2)
    assert warned(log, "1 of 3 odometry messages have an orientation without length")
    assert warned(log, "orientations of 1 odometry messages are no unit quaternions")
    assert warned(log, "transforms without a rotation (a quaternion of zeros, or no number) were left out: laser")
    (tmp_path / "none").mkdir()
    with pytest.raises(FormatError, match=r"no message on /odom can be used: 2 of 2 .*no heading.*`topics.odometry=/tf`"):
        read_bag(bag(tmp_path / "none", [pose(1.0, 0.0, {"x": 0.0}), pose(1.1, 0.0, {"x": 0.0})]))


@pytest.mark.parametrize(
    ("changes", "increment", "said"),
    [
        ({"angle_increment": 0.0}, 0.1, "angle_increment is no angle in 1 scans"),
        ({"angle_increment": float("nan")}, 0.1, "angle_increment is no angle in 1 scans"),
        ({"angle_max": 3.0}, 0.1, "contradict each other in 1 scans (the increment 5.73 degrees"),
        ({"angle_max": 0.1 + 0.1}, 0.1, ""),
        ({"angle_max": float("nan")}, 0.1, ""),
    ],
)
def test_angles_that_contradict_each_other(tmp_path, changes, increment, said):
    log = read_bag(bag(tmp_path, [odometry(1.0), odometry(2.0, 1.0), scan(1.5, **changes)]))
    assert log.scans.angle_increment == pytest.approx(increment)
    assert warned(log, said) if said else not warned(log, "angle")


@pytest.mark.parametrize("most", [float("inf"), float("nan"), 0.0, -1.0, 0.05])
def test_a_reach_that_is_not_stated_is_the_largest_reading(tmp_path, most):
    """pointcloud_to_laserscan writes the largest double, which is infinite in the field."""
    readings = (1.0, float("inf"), 3.0, 3.4e38)
    log = read_bag(bag(tmp_path, [odometry(1.0), odometry(2.0, 1.0), scan(1.5, readings, range_max=most)]))
    assert log.scans.range_max == pytest.approx(3.01)
    np.testing.assert_array_equal(log.scans.ranges, [[1.0, np.inf, 3.0, np.inf]])
    assert sum("the scans state no reach" in w for w in log.notes.warnings) == 1


def test_stamps_of_another_clock_are_named_and_moved(tmp_path):
    """One sensor's computer has another clock: the time of recording tells by how much."""
    rows = [pose(1e9 + 0.1 * k, 0.1 * k) for k in range(20)]
    rows += [scan(5e8 + 0.1 * k, recorded=1e9 + 0.1 * k) for k in range(20)]
    log = read_bag(bag(tmp_path, rows))
    np.testing.assert_allclose(log.scans.stamps, log.odometry.stamps, atol=1e-3)
    assert warned(log, "the stamps of the scans are of another clock than the odometry's, 500000000.0 s behind")


def test_the_clock_of_a_simulation_is_named(tmp_path):
    rows = [pose(10.0 + 0.1 * k, 0.1 * k, recorded=1.7e9 + 0.1 * k) for k in range(20)]
    log = read_bag(bag(tmp_path, rows))
    np.testing.assert_allclose(log.odometry.stamps, 10.0 + 0.1 * np.arange(20))
    assert warned(log, "the stamps are of a simulation, or count since a computer was started")
