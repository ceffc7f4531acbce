"""Two tags and two lidars in one recording, kept apart."""

import math
import socketserver
import threading
import time

import pytest
from emulators.kobuki_device import KobukiDevice
from emulators.spinning_device import LdLidarDevice, Lds01Device
from emulators.uwb_boards import BOARDS, UwbBoard
from emulators.world import RoomWorld, WorldClock
from helpers.virtual_recording import record

from uwblite.cli import main
from uwblite.drivers.devices import open_device
from uwblite.drivers.events import Note
from uwblite.drivers.link import Link
from uwblite.io.carmen import read_log


def test_messages_and_facts_are_numbered_and_the_first_of_a_kind_is_read_as_ever(tmp_path, capsys):
    world, clock = RoomWorld(), WorldClock()
    devices = [
        ("odometry", open_device("odometry", "kobuki:x")[0], KobukiDevice(world.poses(), clock)),
        ("lidar", open_device("lidar", "ld06:x")[0], LdLidarDevice(world, clock)),
        ("lidar", open_device("lidar", "lds01:x")[0], Lds01Device(world, clock)),
        ("uwb", open_device("uwb", "linktrack:x")[0], UwbBoard(world.epochs(), clock, BOARDS["linktrack"])),
        ("uwb", open_device("uwb", "bu03:x")[0], UwbBoard(world.epochs(), clock, BOARDS["bu03"])),
    ]
    recorder = record(
        tmp_path / "run.log", devices, 5.0, laser=(0.1, 0.0, 0.0), more_lasers=((-0.2, 0.0, 3.141593),),
        params=[("uwb2_tag_offset_x", "-0.3"), ("laser2_flipped", "on")], begin=clock.start,
    )  # fmt: skip
    assert [link.name for link in recorder.links] == ["odometry", "lidar", "lidar2", "uwb", "uwb2"]
    assert all(link.counts.messages > 15 for link in recorder.links)
    lines = [line.split() for line in (tmp_path / "run.log").read_text().splitlines()]
    beams = {name: {int(line[8]) for line in lines if line[0] == name} for name in ("ROBOTLASER1", "ROBOTLASER2")}
    assert beams == {"ROBOTLASER1": {450}, "ROBOTLASER2": {360}}
    stated = {line[1]: line[2] for line in lines if line[0] == "PARAM"}
    assert float(stated["laser_range_min"]) == 0.02
    assert float(stated["laser2_range_min"]) == 0.12
    log = read_log(tmp_path / "run.log")
    assert log.scans.ranges.shape[1] == 450
    unused = log.notes.skipped["ROBOTLASER2"]
    assert unused > 15
    (warning,) = (text for text in log.notes.warnings if "one lidar, here the first" in text)
    assert f"scans of others are left out ({unused} of ROBOTLASER2); `topics.scan=ROBOTLASER2`" in warning
    assert set(log.ranges.tag.tolist()) == {0, 1}
    assert log.mounting.tags[1].tolist() == [-0.3, 0.0, 0.0]
    assert not log.mounting.laser_flipped
    other = read_log(tmp_path / "run.log", scan_message="ROBOTLASER2")
    assert other.scans.ranges.shape == (unused, 360)
    assert other.scans.range_min == 0.12
    assert other.scans.time_increment == pytest.approx(float(stated["laser2_time_increment"]))
    assert other.mounting.T_base_laser[:2].tolist() == [-0.2, 0.0]
    assert abs(other.mounting.T_base_laser[2]) == pytest.approx(math.pi, abs=1e-5)
    assert other.mounting.laser_flipped
    assert "here ROBOTLASER2" in other.notes.warnings[0]
    assert main(["check", str(tmp_path / "run.log"), "--scan-topic", "ROBOTLASER3"]) == 1
    assert "no scans of ROBOTLASER3; it has ROBOTLASER1, ROBOTLASER2" in capsys.readouterr().err
    assert main(["check", str(tmp_path / "run.log"), "--scan-topic", "/scan"]) == 1
    assert "scans are not read from '/scan'" in capsys.readouterr().err


def test_a_drivers_note_names_the_device_of_its_number():
    session, url = open_device("lidar", "port")
    for number, name in ((1, "lidar"), (2, "lidar2")):
        note = Link("lidar", url, session, number).named(Note("error", "lidar-silent", "lidar: no answer from a lidar"))
        assert (note.name, note.text) == (f"{name}-silent", f"{name}: no answer from a lidar")


def test_more_than_a_log_keeps_apart_is_refused(tmp_path, capsys):
    out = str(tmp_path / "run.log")
    assert main(["record", "--odometry", "kobuki:a", "--odometry", "kobuki:b", "--out", out]) == 1
    assert "keeps 1 apart" in capsys.readouterr().err
    assert main(["record", *["--uwb", "tlv:a"] * 10, "--out", out]) == 1
    assert "keeps 9 apart" in capsys.readouterr().err
    assert pytest.approx(0) == len(list(tmp_path.iterdir()))


def test_one_port_for_two_devices_is_refused(tmp_path, capsys):
    (tmp_path / "again").symlink_to("/dev/null")
    ports = ["--uwb", "tlv:/dev/null", "--lidar", f"scip:{tmp_path / 'again'}"]
    assert main(["record", *ports, "--out", str(tmp_path / "run.log")]) == 1
    assert "lidar and uwb are given the same port" in capsys.readouterr().err


def test_one_client_of_a_server_is_one_device_of_a_kind(tmp_path, capsys):
    ports = ["--uwb", "tlv:socket://127.0.0.1:1"] * 2
    assert main(["record", *ports, "--out", str(tmp_path / "run.log")]) == 1
    assert "uwb and uwb2 are given the same port" in capsys.readouterr().err


class Robot(socketserver.StreamRequestHandler):
    """Send poses and ranges, in lines, to every client."""

    def handle(self):
        for k in range(40):
            try:
                self.wfile.write(f"ODO {20 * k},0.{k:02d},0.0,0.0\nUWB {20 * k},A1,2.{k:02d}\n".encode())
            except OSError:
                return
            time.sleep(0.02)


def test_two_devices_are_clients_of_one_server(tmp_path):
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Robot) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        place = f"line:socket://127.0.0.1:{server.server_address[1]}?time_unit=0.001&columns=t,"
        ports = ["--odometry", f"{place}x,y,theta&prefix=ODO", "--uwb", f"uwb-{place}id,range&prefix=UWB"]
        main(["record", *ports, "--out", str(tmp_path / "run.log"), "--duration", "0.6"])
        server.shutdown()
    kinds = [line.split()[0] for line in (tmp_path / "run.log").read_text().splitlines()]
    assert kinds.count("ODOM") >= 5
    assert kinds.count("UWB") >= 5
