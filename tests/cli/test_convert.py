"""`uwblite convert` and `uwblite optimize` as a user calls them."""

import json

import numpy as np
import pytest

from uwblite.cli import main
from uwblite.io.carmen import read_log, write_log
from uwblite.io.formats import read_graph
from uwblite.io.result_text import RunRecord
from uwblite.io.results import write_result
from uwblite.io.tum import read_tum


def test_a_log_goes_to_tables_and_back(short_log, tmp_path, capsys):
    tables, back = tmp_path / "tables", tmp_path / "back.log.gz"
    assert main(["convert", str(short_log), str(tables) + "/"]) == 0
    one = read_log(short_log)
    counts = f"361 odometry readings, {len(one.ranges.stamps)} ranges, {len(one.scans.stamps)} scans"
    assert counts in capsys.readouterr().out
    assert main(["convert", str(tables), str(back)]) == 0
    assert "next: uwblite check" in capsys.readouterr().out
    two = read_log(back)
    np.testing.assert_array_equal(one.ranges.ranges, two.ranges.ranges)
    np.testing.assert_array_equal(one.scans.ranges, two.scans.ranges)
    np.testing.assert_allclose(one.odometry.poses, two.odometry.poses, atol=2e-6)
    assert main(["convert", str(tables), str(back)]) == 1
    assert "--force" in capsys.readouterr().err


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_log_goes_to_a_bag_and_back(short_log, tmp_path, capsys, storage):
    pytest.importorskip("rosbags.highlevel", reason="rosbags is absent")
    bag, back = tmp_path / "bag", tmp_path / "back.log"
    assert main(["convert", str(short_log), str(bag), "--to", storage, "--end", "15"]) == 0
    assert main(["convert", str(bag), "--list"]) == 0
    listed = capsys.readouterr().out
    assert "/scan" in listed
    assert "<- ranges" in listed
    assert main(["convert", str(bag), "--list", "--json"]) == json.loads(capsys.readouterr().out)["exit_code"] == 0
    assert main(["convert", str(bag), str(back)]) == 0
    one, two = read_log(short_log), read_log(back)
    one = one.crop(end=one.odometry.stamps[0] + 15.0)
    np.testing.assert_allclose(one.ranges.ranges, two.ranges.ranges, atol=1e-4)
    np.testing.assert_array_equal(one.scans.ranges, two.scans.ranges)
    np.testing.assert_allclose(one.mounting.T_base_laser, two.mounting.T_base_laser, atol=1e-6)


def test_units_and_parts(room_log, tmp_path, capsys):
    units = ["--odometry-unit", "2", "--range-unit", "10", "--laser-unit", "0.5", "--time-unit", "2"]
    words = [*units, "--start", "20", "--end", "40"]
    assert main(["convert", str(room_log), str(tmp_path / "x.log"), *words, "--laser-flipped"]) == 0
    one, two = read_log(room_log), read_log(tmp_path / "x.log")
    assert len(two.odometry.stamps) == 201
    np.testing.assert_allclose(two.odometry.stamps, 2 * one.odometry.stamps[200:401])
    np.testing.assert_allclose(two.odometry.poses[:, :2], 2 * one.odometry.poses[200:401, :2], atol=2e-6)
    assert two.scans.range_max == pytest.approx(0.5 * one.scans.range_max)
    assert two.mounting.laser_flipped


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["{log}"], "name a target"),
        (["{log}", "x.bag"], "--to mcap"),
        (["{log}", "x.unknown"], "--to log"),
        (["{log}", "--list"], "not a bag"),
        (["{log}", "x.g2o"], "not a format for a recording"),
        (["missing.bag", "x.log"], "no such file"),
        (["nothing", "x.log"], "holds no odometry.csv and no ROS 2 bag"),
    ],
)
def test_what_cannot_be_converted_is_reported(room_log, tmp_path, capsys, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "nothing").mkdir()
    assert main(["convert", *(w.format(log=room_log) for w in words)]) == 1
    assert message in capsys.readouterr().err


G2O = """VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 1.1 0 0
VERTEX_SE2 2 2.3 0.1 0
EDGE_SE2 0 1 1 0 0 100 0 0 100 0 100
EDGE_SE2 1 2 1 0 0 100 0 0 100 0 100
EDGE_SE2 0 2 2 0 0 100 0 0 100 0 100
"""


def test_a_graph_is_optimised_and_written_in_both_formats(tmp_path, capsys):
    graph = tmp_path / "graph.g2o"
    graph.write_text(G2O)
    words = ["--out", str(tmp_path / "out.pyfg"), "--trajectory", str(tmp_path / "t.tum")]
    assert main(["optimize", str(graph), *words]) == 0
    assert "chi2" in capsys.readouterr().out
    _, poses = read_tum(tmp_path / "t.tum")
    np.testing.assert_allclose(poses[:, 0], [0, 1, 2], atol=1e-6)
    assert main(["convert", str(tmp_path / "out.pyfg"), str(tmp_path / "again.g2o")]) == 0
    capsys.readouterr()
    assert main(["optimize", str(tmp_path / "again.g2o"), "--json", "--kernel", "huber"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["chi2"] == pytest.approx(0.0, abs=1e-9)
    assert figures["poses"] == 3
    assert main(["optimize", str(graph), "--out", str(tmp_path / "out.pyfg")]) == 1
    assert main(["optimize", str(graph), "--out", str(tmp_path / "out.txt")]) == 1
    assert main(["optimize", str(graph), "--kernel", "hubert"]) == 1
    assert main(["optimize", str(graph), "--set", "max_iteration=3"]) == 1
    assert "did you mean 'max_iterations'" in capsys.readouterr().err


def test_a_converted_graph_keeps_its_places(tmp_path):
    """Those of the file, which the edges contradict."""
    (tmp_path / "graph.g2o").write_text(G2O)
    assert main(["convert", str(tmp_path / "graph.g2o"), str(tmp_path / "out.pyfg")]) == 0
    one, other = (read_graph(str(tmp_path / name)).graph for name in ("graph.g2o", "out.pyfg"))
    assert np.abs(one.edges[0].residuals(one)).max() > 0.1
    np.testing.assert_allclose(other.poses, one.poses)


def test_an_anchor_without_a_position_is_found_from_its_ranges(tmp_path, capsys):
    rng = np.random.default_rng(1)
    turn = np.linspace(0, 2 * np.pi, 60)
    poses = np.column_stack([3 * np.cos(turn), 2 * np.sin(turn), turn + np.pi / 2])
    lines = [f"VERTEX_SE2 {k} A{k} {x:.6f} {y:.6f} {a:.6f}" for k, (x, y, a) in enumerate(poses)]
    for k in range(59):
        c, s = np.cos(poses[k, 2]), np.sin(poses[k, 2])
        dx, dy = poses[k + 1, :2] - poses[k, :2]
        lines.append(
            f"EDGE_SE2 {k} A{k} A{k + 1} {c * dx + s * dy:.6f} {c * dy - s * dx:.6f} {turn[1]:.6f} 1e-4 0 0 1e-4 0 1e-4"
        )
    distance = np.hypot(*(poses[:, :2] - (4.0, 3.0)).T) + rng.normal(0, 0.05, 60)
    lines += [f"EDGE_RANGE {k} A{k} L0 {d:.4f} 0.0025" for k, d in enumerate(distance)]
    (tmp_path / "g.pyfg").write_text("\n".join(lines) + "\n")
    assert main(["optimize", str(tmp_path / "g.pyfg"), "--out", str(tmp_path / "out.g2o"), "--json"]) == 0
    vertex = next(line for line in (tmp_path / "out.g2o").read_text().splitlines() if line.startswith("VERTEX_XY"))
    # Sixty ranges with 0.05 m each, from around: a few centimetres.
    assert np.hypot(*(np.array(vertex.split()[2:], dtype=float) - (4.0, 3.0))) < 0.05
    assert json.loads(capsys.readouterr().out)["unplaced_anchors"] == []


def test_a_public_graph_reaches_its_optimum_from_its_odometry(shared_data, capsys):
    assert main(["optimize", str(shared_data / "pose_graphs" / "sesync_CSAIL.g2o.gz"), "--json", "--from-odometry"]) == 0
    assert json.loads(capsys.readouterr().out)["chi2"] == pytest.approx(40.555129, rel=1e-6)


def test_plaza_from_odometry(shared_data, tmp_path, capsys):
    words = ["--from-odometry", "--trajectory", str(tmp_path / "t.tum"), "--json"]
    assert main(["optimize", str(shared_data / "plaza1" / "plaza1.pyfg.gz"), *words]) == 0
    figures = json.loads(capsys.readouterr().out)
    # The measurements in this file are calibrated; an independent solver says chi2 2660.5.
    assert figures["chi2"] == pytest.approx(2660.5, rel=1e-3)


@pytest.mark.parametrize("target", ["a.log", "tables/", "a.tum"])
def test_json_is_one_object(tmp_path, room_log, target, capsys):
    assert main(["convert", str(room_log), str(tmp_path / target) + "/" * target.endswith("/"), "--json", "--end", "20"]) == 0
    output = json.loads(capsys.readouterr().out)
    assert output["exit_code"] == 0
    assert output["counts"]["odometry readings"] == 401
    assert output["out"].startswith(str(tmp_path))


def test_a_map_becomes_a_bundle_for_nav2(tmp_path, capsys):
    from helpers.results import small_folder

    from uwblite.io.ros_results import FILES

    small_folder(tmp_path / "map")
    words = ["convert", str(tmp_path / "map"), str(tmp_path / "nav2"), "--to", "nav2"]
    assert main(words) == 0
    assert {p.name for p in (tmp_path / "nav2").iterdir()} == set(FILES)
    assert main(words) == 1
    assert "exists" in capsys.readouterr().err
    assert main([*words, "--force"]) == 0
    (tmp_path / "nav2" / "nav2_params.yaml").write_text("mine: 1\n")
    assert main([*words, "--force"]) == 1
    assert "was not written by uwblite" in capsys.readouterr().err
    assert (tmp_path / "nav2" / "nav2_params.yaml").read_text() == "mine: 1\n"
    assert main(["convert", str(tmp_path / "map"), str(tmp_path / "map"), "--to", "nav2", "--force"]) == 1
    assert "is the map itself" in capsys.readouterr().err
    assert main(["convert", str(tmp_path / "map"), str(tmp_path / "map" / "map.pgm"), "--to", "nav2", "--force"]) == 1
    assert "is a file" in capsys.readouterr().err


def test_a_map_becomes_a_graph_with_the_scans_of_its_recording_and_a_trajectory(tmp_path, capsys):
    from helpers.results import small_folder, small_log

    small_folder(tmp_path / "map")
    write_log(tmp_path / "run.log", small_log())
    source, target = str(tmp_path / "map"), tmp_path / "graph.g2o"
    assert main(["convert", source, str(target), "--recording", str(tmp_path / "run.log")]) == 0
    assert f"{target}: 24 poses, 24 poses with a scan" in capsys.readouterr().out
    assert target.read_text().count("ROBOTLASER1 ") == 24
    assert len(read_graph(str(target)).graph.poses) == 24
    for to, words in (("tum", 8), ("kitti", 12)):
        assert main(["convert", source, str(tmp_path / "path.txt"), "--to", to, "--force"]) == 0
        assert f"{tmp_path / 'path.txt'}: 24 poses" in capsys.readouterr().out
        assert [len(line.split()) for line in (tmp_path / "path.txt").read_text().splitlines()] == [words] * 24
    assert main(["convert", source, str(tmp_path / "path.log")]) == 1
    assert "not a format for a map; use --to nav2, mcap" in capsys.readouterr().err
    assert main(["convert", str(tmp_path / "run.log"), "x.csv", "--recording", "run.log"]) == 1
    assert "--recording goes with a map" in capsys.readouterr().err


@pytest.mark.parametrize("recorded", [False, True])
def test_a_map_becomes_a_bag_with_or_without_its_recording(tmp_path, capsys, recorded):
    pytest.importorskip("rosbags.highlevel", reason="rosbags is absent")
    from helpers.results import small_folder, small_log

    small_folder(tmp_path / "map")
    write_log(tmp_path / "run.log", small_log())
    words = ["--recording", str(tmp_path / "run.log")] if recorded else []
    assert main(["convert", str(tmp_path / "map"), str(tmp_path / "bag"), "--to", "mcap", *words, "--json"]) == 0
    output = json.loads(capsys.readouterr().out)
    assert output["counts"] == {"anchors": 2, "closures": 3}
    assert ("without scans and odometry" in output["note"]) is not recorded
    assert main(["convert", str(tmp_path / "bag"), "--list"]) == 0
    assert ("/scan" in capsys.readouterr().out) is recorded


def test_of_a_map_of_several_recordings_the_first_trajectory_is_written_and_that_said(tmp_path, capsys):
    from helpers.results import small_log, small_result

    record = RunRecord("uwblite map run.log again.log", "")
    write_result(tmp_path / "map", [small_log(), small_log(name="again.log")], small_result(each=2), record)
    assert main(["convert", str(tmp_path / "map"), str(tmp_path / "path.tum")]) == 0
    assert "holds 2 trajectories; this is the first of them" in capsys.readouterr().err
    np.testing.assert_allclose(read_tum(tmp_path / "path.tum")[0], read_tum(tmp_path / "map" / "trajectory.tum")[0])


def test_a_trajectory_becomes_the_odometry_of_a_recording(tmp_path, capsys):
    stamps, turn = np.array([3.0, 1.0, 2.0]), np.array([0.3, 0.1, 0.2])
    rows = np.column_stack([stamps, stamps, 2.0 * stamps, 0.0 * stamps, 0.0 * stamps, 0.0 * stamps, np.sin(turn), np.cos(turn)])
    np.savetxt(tmp_path / "path.tum", rows)
    source = str(tmp_path / "path.tum")
    assert main(["convert", source, str(tmp_path / "run.log")]) == 0
    assert "run.log: 3 odometry readings" in capsys.readouterr().out
    odometry = read_log(tmp_path / "run.log").odometry
    np.testing.assert_allclose(odometry.poses, np.outer([1.0, 2.0, 3.0], [1.0, 2.0, 0.2]), atol=1e-6)
    assert main(["convert", source, str(tmp_path / "tables") + "/"]) == 0
    assert "ranges.csv and scans.csv may be added" in capsys.readouterr().out
    assert main(["convert", source, str(tmp_path / "poses.kitti"), "--to", "kitti"]) == 0
    assert main(["convert", str(tmp_path / "poses.kitti"), str(tmp_path / "again.log")]) == 1
    assert "KITTI poses have no times" in capsys.readouterr().err
    assert main(["convert", source, str(tmp_path / "graph.g2o")]) == 1
    assert "not a format for a trajectory" in capsys.readouterr().err
