"""A map as a bag: what RViz and Foxglove get is what the map says, in their frames."""

import numpy as np
import pytest

from uwblite import se2
from uwblite.errors import ConfigError
from uwblite.io.carmen import read_log
from uwblite.io.ros_results import write_result_bag
from uwblite.io.rosbag import read_bag
from uwblite.io.stored_result import read_result

AnyReader = pytest.importorskip("rosbags.highlevel", reason="rosbags is absent").AnyReader


@pytest.fixture(scope="module")
def mapped(minute_map):
    """A map of a minute of the sample recording, and the recording."""
    return read_result(minute_map), read_log(minute_map.parent / "run.log.gz")


def messages(path):
    """Return {topic: [(time in s, message)]} and the latched topics of a bag."""
    from rosbags.interfaces import QosDurability

    found, latched = {}, set()
    with AnyReader([path]) as reader:
        for connection, recorded, raw in reader.messages():
            found.setdefault(connection.topic, []).append((recorded / 1e9, reader.deserialize(raw, connection.msgtype)))
        for c in reader.connections:
            if c.ext.offered_qos_profiles[0].durability == QosDurability.TRANSIENT_LOCAL:
                latched.add(c.topic)
    return found, latched


def planar(transform):
    t, q = transform.transform.translation, transform.transform.rotation
    return np.array([t.x, t.y, 2 * np.arctan2(q.z, q.w)])


def test_the_transforms_lead_the_wheels_to_the_corrected_path(mapped, tmp_path):
    result, log = mapped
    write_result_bag(tmp_path / "x.mcap", result, [log])
    found, latched = messages(tmp_path / "x.mcap")
    assert latched == {"/tf_static", "/map", "/path", "/anchors", "/closures"}
    by_child = {}
    for stamp, message in found["/tf"]:
        for t in message.transforms:
            by_child.setdefault((t.header.frame_id, t.child_frame_id), {})[round(stamp, 6)] = planar(t)
    odom, correction = by_child[("odom", "base_link")], by_child[("map", "odom")]
    assert odom.keys() == correction.keys()
    stamps = np.array(sorted(odom))
    made = np.array([se2.compose(correction[s], odom[s]) for s in stamps.tolist()])
    np.testing.assert_allclose(made[:, :2], result.pose_at(1, stamps)[:, :2], atol=1e-5)
    np.testing.assert_allclose(se2.wrap_angle(made[:, 2] - result.pose_at(1, stamps)[:, 2]), 0.0, atol=1e-6)
    assert len(found["/scan"]) == len(log.scans.stamps)
    # What was recorded comes out of it again.
    back = read_bag(tmp_path / "x.mcap")
    np.testing.assert_allclose(back.odometry.poses, log.odometry.poses, atol=1e-6)
    np.testing.assert_array_equal(back.scans.ranges, log.scans.ranges)


def test_map_markers_and_covariances_are_those_of_the_result(mapped, tmp_path):
    result, _ = mapped
    write_result_bag(tmp_path / "x.mcap", result)
    found, _ = messages(tmp_path / "x.mcap")
    ((_, grid),) = found["/map"]
    np.testing.assert_array_equal(grid.data.reshape(grid.info.height, grid.info.width), result.grid.states())
    np.testing.assert_allclose([grid.info.origin.position.x, grid.info.origin.position.y], result.grid.geometry.origin)
    ((_, anchors),) = found["/anchors"]
    names = {m.text: (m.pose.position.x, m.pose.position.y) for m in anchors.markers if m.text}
    assert names == {a.id: pytest.approx(tuple(a.position)) for a in result.anchors if np.isfinite(a.position).all()}
    ellipse = next(m for m in anchors.markers if m.ns == "two sigma")
    sigmas = np.sqrt(np.linalg.eigvalsh(result.anchors[0].covariance))
    assert sorted([ellipse.scale.x, ellipse.scale.y]) == pytest.approx(list(4 * sigmas), rel=1e-6)
    lines = {m.ns: len(m.points) // 2 for _, a in found.get("/closures", []) for m in a.markers}
    accepted = sum(c.accepted for c in result.closures)
    assert lines == {k: v for k, v in (("accepted", accepted), ("rejected", len(result.closures) - accepted)) if v}
    assert len(found["/pose"]) == len(result.keyframe_stamps)
    first = found["/pose"][0][1].pose.covariance.reshape(6, 6)
    np.testing.assert_allclose(first[np.ix_([0, 1, 5], [0, 1, 5])], result.keyframe_covariances[0])
    # Without the recording the robot moves in odom, which lies on map.
    assert {(t.header.frame_id, t.child_frame_id) for _, m in found["/tf_static"] for t in m.transforms} == {("map", "odom")}


def test_another_recording_is_refused(mapped, tmp_path):
    import dataclasses

    result, log = mapped
    with pytest.raises(ConfigError, match="made of 1 recordings, not 2"):
        write_result_bag(tmp_path / "x.mcap", result, [log, log])
    later = dataclasses.replace(log, odometry=dataclasses.replace(log.odometry, stamps=log.odometry.stamps + 1e6))
    with pytest.raises(ConfigError, match="the map's recording"):
        write_result_bag(tmp_path / "x.mcap", result, [later])
    assert list(tmp_path.iterdir()) == []


def test_the_graph_carries_the_scan_of_each_keyframe(mapped, tmp_path):
    from uwblite.io.corrected_log import write_graph_with_scans
    from uwblite.io.g2o import read_g2o

    result, log = mapped
    count = write_graph_with_scans(tmp_path / "x.g2o", result, [log])
    assert count == len(result.keyframe_stamps)
    lines = (tmp_path / "x.g2o").read_text().splitlines()
    plain = (result.folder / "graph.g2o").read_text().splitlines()
    assert [line for line in lines if not line.startswith("ROBOTLASER1")] == plain
    k = next(i for i, line in enumerate(lines) if line.startswith("VERTEX_SE2 5 "))
    readings = lines[k + 1].split()
    assert readings[0] == "ROBOTLASER1"
    scan = int(np.argmin(np.abs(log.scans.stamps - result.keyframe_stamps[5])))
    seen = log.scans.ranges[scan]
    hit = np.isfinite(seen)
    np.testing.assert_allclose(np.array(readings[9 : 9 + len(seen)], float)[hit], seen[hit], atol=6e-4)
    back, plain = read_g2o(tmp_path / "x.g2o"), read_g2o(result.folder / "graph.g2o")
    assert back.graph.chi2() == plain.graph.chi2()
    assert write_graph_with_scans(tmp_path / "y.g2o", result, []) == 0


def test_how_many_keyframes_have_a_scan_is_said(mapped, tmp_path, capsys):
    from uwblite.cli import main

    result, _ = mapped
    words = ["convert", str(result.folder), str(tmp_path / "x.g2o")]
    many = len(result.keyframe_stamps)
    assert main([*words, "--recording", str(result.folder.parent / "run.log.gz")]) == 0
    assert main([*words, "--force"]) == 0
    first, second = (line for line in capsys.readouterr().out.splitlines() if "with a scan" in line)
    assert f"{many} poses, {many} poses with a scan" in first
    assert f"{many} poses, 0 poses with a scan" in second


def test_trajectories_go_where_evo_reads_them(mapped, tmp_path, capsys):
    from uwblite.cli import main
    from uwblite.io.tum import read_tum

    result, _ = mapped
    for target in ("a.tum", "a.kitti"):
        assert main(["convert", str(result.folder), str(tmp_path / target)]) == 0
    poses = result.trajectories[0][1]
    np.testing.assert_allclose(read_tum(tmp_path / "a.tum")[1], poses, atol=1e-8)
    matrices = np.loadtxt(tmp_path / "a.kitti").reshape(-1, 3, 4)
    np.testing.assert_allclose(matrices[:, :2, 3], poses[:, :2], atol=1e-6)
    np.testing.assert_allclose(np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0]), poses[:, 2], atol=1e-6)
    assert main(["convert", str(tmp_path / "a.kitti"), str(tmp_path / "b.tum")]) == 1
    assert "no times" in capsys.readouterr().err
    assert main(["convert", str(result.folder), str(tmp_path / "x.csv")]) == 1
    assert "not a format for a map" in capsys.readouterr().err
