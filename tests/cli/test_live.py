"""`uwblite localize --live`: lines of JSON on stdout, warnings on stderr, and usage errors."""

import argparse
import dataclasses
import json
import os
import re
import socket

import numpy as np
import pytest
from emulators.dwm_device import DwmDevice, DwmOptions
from emulators.kobuki_device import GyroLineDevice, KobukiDevice
from emulators.scip_device import ScipDevice, ScipOptions
from emulators.world import RoomWorld, WorldClock
from helpers.localization_room import ANCHORS, ROUND, SCANNER, cast, grid_of, known, path
from helpers.virtual_recording import live_devices

from uwblite import se2
from uwblite.cli import live, main
from uwblite.cli.live import line_of
from uwblite.grid.occupancy_grid import OccupancyGrid
from uwblite.io.map_server import write_map
from uwblite.localization import LocalizerState
from uwblite.localization.live_feed import LiveFeed


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A map folder, a log of a path through it, and where the robot was."""
    folder = tmp_path_factory.mktemp("live")
    rows = "".join(f"{name},{x},{y},0.01,0.01,0.0,0.05,ok\n" for name, (x, y) in ANCHORS.items())
    (folder / "anchors.csv").write_text("id,x,y,sigma_x,sigma_y,bias,residual_rms,status\n" + rows)
    (folder / "trajectory.tum").write_text("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n")
    from helpers.localization_room import ODD

    write_map(folder, grid_of(ODD))
    poses, lines = path(ROUND)[:40], []
    odom = se2.compose(np.array([3.0, 1.0, 0.5]), se2.between(poses[0], poses))
    for k, (pose, output) in enumerate(zip(poses, odom, strict=True)):
        t = f"{100 + 0.2 * k:.3f} h {0.2 * k:.3f}"
        lines.append(f"ODOM {output[0]:.6f} {output[1]:.6f} {output[2]:.6f} 0 0 0 {t}")
        readings = " ".join(f"{min(r, 8.0):.3f}" for r in cast(pose))
        head = f"ROBOTLASER1 0 {SCANNER.angle_min:.9f} 3.141592654 {SCANNER.angle_increment:.9f} 8.0 0.01 0 181"
        lines.append(f"{head} {readings} 0 0 0 0 0 0 0 0 0 0 0 0 {t}")
        if k % 5 == 0:
            lines += [f"UWB {n} {np.hypot(*(np.array(p) - pose[:2])):.3f} 100 {t}" for n, p in ANCHORS.items()]
            lines.append(f"UWB STRANGER 3.000 100 {t}")
    log = folder / "run.log"
    log.write_text("\n".join(lines) + "\n")
    return folder, log, poses


def test_ranges_of_a_tag_that_the_log_named_too_late_are_left_out_and_reported_once(room):
    text, said = room[1].read_text(), []
    feed = LiveFeed(known(), lambda mounting: mounting, said.append)
    states = list(feed.take(text.encode()))
    late = [re.sub("^UWB ", "UWB2 ", line) for line in text.splitlines(keepends=True) if line.startswith("UWB A ")]
    list(feed.take("".join(late[-3:]).encode()))
    assert said == ["left out: tag 1 is none of the robot's 1 tags; they count from 0"]
    assert not states[-1].lost


def test_a_pose_that_is_not_known_is_null():
    unknown = LocalizerState(1.0, np.full(3, np.nan), np.full((3, 3), np.nan), 0.0, np.zeros(3), True)
    assert json.loads(line_of(unknown))["pose"] is None
    known = dataclasses.replace(unknown, pose=np.array([1.0, 2.0, 0.5]))
    assert json.loads(line_of(known))["pose"] == [1.0, 2.0, 0.5]


def test_ages_are_said_to_a_tenth_of_a_second():
    none = np.zeros(3)
    state = LocalizerState(1.0, none, np.eye(3), 1.0, none, False, age=0.123, silent={"lidar": 6.04})
    said = json.loads(line_of(state))
    assert (said["age"], said["silent"]) == (0.1, {"lidar": 6.0})


def test_what_else_is_known_of_a_pose_is_in_its_line_and_nothing_where_nothing_is():
    none = np.zeros(3)
    state = LocalizerState(1.0, none, np.eye(3), 1.0, none, False)
    assert set(json.loads(line_of(state))) == {"stamp", "pose", "covariance", "quality", "lost", "age", "odometry"}
    others = np.arange(30.0).reshape(10, 3)
    more = dataclasses.replace(state, reason="two places", alternatives=others, moved_anchors=("A", "B"))
    said = json.loads(line_of(more))
    assert (said["reason"], said["moved_anchors"]) == ("two places", ["A", "B"])
    assert said["alternatives"] == others[: len(said["alternatives"])].tolist()


def test_a_map_without_anchors_or_walls_is_said_to_be_one(capsys):
    room = known()
    live._tell_map(dataclasses.replace(room, anchors=room.anchors.only(())))
    assert "by the walls alone" in capsys.readouterr().err
    live._tell_map(dataclasses.replace(room, walls=None))
    assert "by the anchors alone" in capsys.readouterr().err


def test_a_log_without_measurements_is_said_to_have_none(room, tmp_path, capsys):
    (tmp_path / "empty.log").write_text("# CARMEN Logfile\n")
    assert main(["localize", str(tmp_path / "empty.log"), "--live", "--map", str(room[0]), "--idle", "0.2"]) == 3
    assert "the log holds no measurement" in capsys.readouterr().err


@pytest.fixture
def circle(tmp_path):
    """A map of the emulated room, and the devices of a robot that drives a circle in it."""
    x1, y1, x2, y2 = RoomWorld.WALLS
    grid = grid_of([(x + 4.0, y + 3.0, u + 4.0, v + 3.0) for x, y, u, v in
                    ((x1, y1, x2, y1), (x2, y1, x2, y2), (x2, y2, x1, y2), (x1, y2, x1, y1))])  # fmt: skip
    geometry = dataclasses.replace(grid.geometry, origin=grid.geometry.origin - [4.0, 3.0])
    write_map(tmp_path, OccupancyGrid(geometry, grid.log_odds))
    rows = "".join(f"{name:04X},{x},{y},0.01,0.01,0.0,0.05,ok\n" for name, x, y in RoomWorld.ANCHORS)
    (tmp_path / "anchors.csv").write_text("id,x,y,sigma_x,sigma_y,bias,residual_rms,status\n" + rows)
    (tmp_path / "trajectory.tum").write_text("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n")
    world, clock = RoomWorld(), WorldClock()
    devices = {
        "base": KobukiDevice(world.poses(), clock),
        "lidar": ScipDevice(world.scans(), clock, ScipOptions()),
        "uwb": DwmDevice(world.epochs(), clock, DwmOptions()),
        "gyro": GyroLineDevice(world.poses(), clock),
    }
    return tmp_path, devices, world, clock


GYRO = "line:gyro?columns=t,turn_rate&time_unit=0.001&angle_unit=0.017453292519943295"
PORTS = {
    "base": ["--odometry", "kobuki:base"],
    "lidar": ["--lidar", "lidar"],
    "uwb": ["--uwb", "uwb"],
    "gyro": ["--gyro", GYRO],
}


def driven(circle, seconds, names, capsys):
    """Return the exit code, the lines, stderr and where the robot was at the time of each line, with devices by name."""
    folder, devices, world, clock = circle
    words = [word for name in names for word in PORTS[name]]
    with live_devices({name: devices[name] for name in names}, seconds, begin=lambda now: clock.start(now + 0.5)):
        code = main(["localize", "--live", "--map", str(folder), "--rate", "2", *words])
    out, err = capsys.readouterr()
    found = lines_of(out)
    truth = [world.pose(line["stamp"] - 1000.5) for line in found]
    return code, found, err, np.array([[p.x, p.y, p.theta] for p in truth])


@pytest.mark.slow
def test_devices_on_serial_ports_say_where_the_robot_is(circle, capsys):
    """The recorder, the drivers and the localiser together, in simulated time."""
    code, found, err, truth = driven(circle, 20.0, ("base", "lidar", "uwb", "gyro"), capsys)
    assert code == 0, err
    assert found[0]["lost"]
    sure = [k for k, line in enumerate(found) if not line["lost"]]
    assert found[sure[0]]["stamp"] < 1015.0
    assert sure == list(range(sure[0], len(found)))
    off = np.array([found[k]["pose"] for k in sure]) - truth[sure]
    # Walls one cell thick, and 20 ms of the base.
    assert np.hypot(*off[:, :2].T).max() < 0.06
    assert np.abs(se2.wrap_angle(off[:, 2])).max() < 0.03
    assert "nothing from" not in err


@pytest.mark.slow
def test_a_silent_lidar_is_named_and_ranges_go_on(circle, capsys):
    circle[1]["lidar"] = Mute()
    code, found, err, truth = driven(circle, 45.0, ("base", "lidar", "uwb"), capsys)
    assert "nothing from lidar for 6 s; the pose rests on ranges and odometry" in err
    assert "Traceback" not in err
    assert code == 0, found[-1]
    assert np.hypot(*(np.array(found[-1]["pose"]) - truth[-1])[:2]) < 0.3


class Mute:
    """A device that is plugged in and says nothing."""

    def power_up(self, now):
        pass

    def advance(self, now):
        return b""

    def receive(self, data, now):
        return b""

    def next_time(self, now):
        return float("inf")


def lines_of(text):
    return [json.loads(line) for line in text.splitlines()]


def test_a_log_is_followed_and_the_pose_is_reported(room, capsys):
    folder, log, poses = room
    assert main(["localize", str(log), "--live", "--map", str(folder), "--idle", "0.1"]) == 0
    out, err = capsys.readouterr()
    found = lines_of(out)
    assert [line["stamp"] for line in found] == sorted(line["stamp"] for line in found)
    assert not found[-1]["lost"]
    np.testing.assert_allclose(found[-1]["pose"], poses[-1], atol=0.05)
    assert np.linalg.eigvalsh(found[-1]["covariance"]).min() > 0
    assert 0.9 < found[-1]["quality"] <= 1.0
    assert found[0]["lost"]
    assert found[0]["reason"]
    assert "STRANGER (8)" in err


def test_standard_input_is_followed_to_its_end(room, capsys, monkeypatch):
    folder, log, poses = room
    descriptor = os.open(log, os.O_RDONLY)
    with os.fdopen(descriptor) as stream:
        monkeypatch.setattr("sys.stdin", stream)
        assert main(["localize", "-", "--live", "--map", str(folder), "--rate", "1"]) == 0
    found = lines_of(capsys.readouterr().out)
    np.testing.assert_allclose(found[-1]["pose"][:2], poses[-1][:2], atol=0.5)


def test_a_robot_that_is_not_found_is_exit_code_3(room, tmp_path, capsys):
    folder, log, _ = room
    short = tmp_path / "short.log"
    short.write_text("".join(log.read_text().splitlines(keepends=True)[:2]))
    assert main(["localize", str(short), "--live", "--map", str(folder), "--idle", "0.1"]) == 3
    assert all(line["lost"] for line in lines_of(capsys.readouterr().out))


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ([], "--live needs either a log"),
        (["x.log", "--odometry", "kobuki:/dev/none"], "--live needs either a log"),
        (["x.log", "--out", "a.tum"], "--out belongs to a recording"),
        (["none.log"], "cannot be followed"),
    ],
)
def test_wrong_usage_is_one_line(room, capsys, words, text):
    assert main(["localize", "--live", "--map", str(room[0]), *words]) in (1, 2)
    err = capsys.readouterr().err
    assert text in err
    assert "Traceback" not in err


def test_a_recording_without_out_is_a_usage_error(room, capsys):
    assert main(["localize", str(room[1]), "--map", str(room[0])]) == 2
    assert "--out" in capsys.readouterr().err


def test_a_room_is_known_from_its_folder_as_from_its_parts(room):
    from uwblite.io.stored_result import read_result
    from uwblite.localization.known_map import from_result

    read, made = from_result(read_result(room[0])), known()
    np.testing.assert_allclose(read.anchors.positions, made.anchors.positions)
    np.testing.assert_allclose(read.walls.points, made.walls.points, atol=1e-9)


def test_a_log_that_no_longer_grows_makes_the_pose_old_and_then_lost(room, capsys):
    folder, log, _ = room
    words = ["localize", str(log), "--live", "--map", str(folder), "--idle", "3.2", "--late", "0.2", "--lost-after", "1.5"]
    assert main(words) == 3
    out, err = capsys.readouterr()
    found = lines_of(out)
    old = [line for line in found if line["age"]]
    assert not old[0]["lost"]
    assert old[-1]["lost"]
    assert old[-1]["reason"].startswith("no data for")
    assert old[-1]["quality"] == 0.0
    assert old[-1]["covariance"][0][0] > old[0]["covariance"][0][0] > found[-len(old) - 1]["covariance"][0][0]
    assert err.count("warning: no data for") == 1


def test_a_map_that_was_doubted_is_used_with_that_word(room, capsys):
    folder, log, _ = room
    report = folder / "report.json"
    report.write_text(json.dumps({"doubts": [{"kind": "drift", "text": "the ranges disagree", "figures": {}}]}))
    try:
        assert main(["localize", str(log), "--live", "--map", str(folder), "--idle", "0.1"]) == 0
    finally:
        report.unlink()
    assert "warning: the map is doubted: the ranges disagree" in capsys.readouterr().err


def test_the_page_shows_the_map_and_the_robot_on_it(room, capsys, monkeypatch):
    """What is published is what a browser would get."""
    from uwblite.server.live import Feed

    folder, log, poses = room
    published = []
    monkeypatch.setattr(Feed, "publish", lambda _, name, value: published.append((name, value)))
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    words = ["localize", str(log), "--live", "--map", str(folder), "--idle", "0.1", "--serve", str(port)]
    assert main(words) == 0
    assert f"open http://127.0.0.1:{port}/" in capsys.readouterr().err
    names = [name for name, _ in published]
    assert names[0] == "map"
    assert "<image" in published[0][1]["svg"]
    first, last = published[1][1], published[-1][1]
    assert first["pose"] is None
    assert first["advice"][0].startswith("the pose is not known: ")
    np.testing.assert_allclose(last["pose"], poses[-1], atol=0.06)
    assert last["advice"] == []
    assert len(last["trail"]) > 5
    json.dumps([value for _, value in published], allow_nan=False)


def test_a_base_alone_is_read_until_it_is_stopped_and_leaves_the_pose_unknown(circle, capsys):
    code, found, err, _ = driven(circle, 4.0, ("base",), capsys)
    assert code == 3
    assert len(found) > 4
    assert all(line["lost"] for line in found)
    assert np.all(np.diff([line["stamp"] for line in found]) > 0.0)
    # Two lines a second, of a base that sends fifty.
    assert np.median(np.diff([line["stamp"] for line in found])) == pytest.approx(0.5, abs=0.03)
    assert "s] info: odometry: base open" in err


def test_lines_come_as_often_as_is_asked_for_and_at_once_where_the_pose_is_lost_or_found(room, capsys):
    def state(stamp, lost=False, age=0.0):
        none = np.zeros(3)
        return LocalizerState(stamp, none, np.eye(3), 1.0, none, lost, age=age)

    args = argparse.Namespace(late=2.0, lost_after=10.0, rate=5.0)
    tracker, shown = live.Tracker(known(), args), []
    tracker.on_state = lambda each: shown.append(each.stamp)
    for each in [state(-np.inf, True), state(1.0), state(1.1), state(1.19), state(1.2), state(1.3, True), state(1.35, True),
                 state(1.36), state(1.37, age=0.5), state(0.5)]:  # fmt: skip
        tracker._say(each)
    assert [line["stamp"] for line in lines_of(capsys.readouterr().out)] == [1.0, 1.2, 1.3, 1.36, 1.37, 0.5]
    assert shown == [1.0, 1.1, 1.19, 1.2, 1.3, 1.35, 1.36, 1.37, 0.5]
    assert tracker.ended(True) == 130
    assert tracker.ended(False) == 0
    tracker._say(state(2.0, True))
    assert tracker.ended(False) == 3


@pytest.mark.parametrize("more", [["--picture", "a.png"], ["--covariance", "a.csv"], ["--out", "a.tum"]])
def test_files_belong_to_a_recording_that_has_ended(room, capsys, more):
    assert main(["localize", str(room[1]), "--live", "--map", str(room[0]), *more]) == 2
    assert f"{more[0]} belongs to a recording that has ended; --live writes lines to stdout" in capsys.readouterr().err


def test_numbers_in_a_line_have_as_many_digits_as_mean_something():
    pose, sigma = np.array([1.23456789, -2.0, 0.5]), np.full((3, 3), 0.123456789)
    state = LocalizerState(1.23456789, pose, sigma, 0.98765, 2.0 * pose, False)
    said = json.loads(line_of(dataclasses.replace(state, alternatives=np.array([[1.23456, 2.0, 3.0]] * 20))))
    assert (said["stamp"], said["quality"]) == (1.234568, 0.988)
    assert (said["pose"], said["odometry"]) == ([1.23457, -2.0, 0.5], [2.46914, -4.0, 1.0])
    assert said["covariance"] == [[0.1235] * 3] * 3
    assert said["alternatives"] == [[1.235, 2.0, 3.0]] * live.MOST_ALTERNATIVES


def test_the_part_of_a_long_log_that_is_not_read_is_told(tmp_path, monkeypatch, capsys):
    log = tmp_path / "run.log"
    log.write_bytes(b"ODOM 0 0 0 0 0 0 1.0 h 1.0\n" * 200_000)
    pieces = live._growing(str(log), 0.01, lambda: False)
    skipped = log.stat().st_size - sum(map(len, pieces))
    told = re.fullmatch(rf"uwblite: (\d+\.\d) MB of {log} lie further back and are not read\n", capsys.readouterr().err)
    assert float(told[1]) == pytest.approx(skipped / 1e6, abs=0.2)
    assert skipped > 1e6
    assert list(live._growing(str(log), None, lambda: True)) == []
