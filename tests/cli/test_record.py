"""What `uwblite record` and `uwblite devices` say to mistakes: one clear line, at once, and no log is begun."""

import json
import re
import socket
import subprocess
import sys
import time
import urllib.request

import pytest
from conftest import ROOT

from uwblite import __version__
from uwblite.cli import main
from uwblite.drivers.devices import DEVICES
from uwblite.drivers.transport import PluggedIn, check_url
from uwblite.errors import ConfigError

REFUSED = {
    "no device": [],
    "no duration": ["--lidar", "/dev/null", "--duration", "nan"],
    "over before it begins": ["--lidar", "/dev/null", "--duration", "-1"],
    "sync": ["--lidar", "/dev/null", "--sync", "-1"],
    "part size": ["--lidar", "/dev/null", "--rotate", "5X"],
    "steps backwards": ["--lidar", "/dev/null?steps=700:100"],
    "steps that are none": ["--lidar", "/dev/null?steps=a:b"],
    "cluster": ["--lidar", "/dev/null?cluster=0"],
    "skip": ["--lidar", "/dev/null?skip=10"],
    "lidar baud": ["--lidar", "/dev/null?baud=7"],
    "mounting": ["--lidar", "/dev/null", "--laser-pose", "nan,0,0"],
    "tag": ["--uwb", "/dev/null", "--tag", "1,2"],
    "height": ["--uwb", "/dev/null", "--anchor-height", "inf"],
    "a folder as port": ["--lidar", "."],
    "a file as port": ["--uwb", "taken.log"],
    "URL": ["--lidar", "carrier-pigeon://x"],
    "socket without port": ["--lidar", "socket://localhost"],
    "socket port": ["--lidar", "socket://localhost:99999"],
    "odometry kind": ["--odometry", "/dev/null"],
    "column": ["--odometry", "line:/dev/null?columns=t,up"],
    "option": ["--odometry", "line:/dev/null?colums=t,x,y,theta"],
    "no tick": ["--odometry", "line:/dev/null?columns=t,left,right"],
    "tick": ["--odometry", "line:/dev/null?columns=t,left,right&tick=nan&wheel_base=0.3"],
    "unit": ["--odometry", "line:/dev/null?columns=t,x,y,theta&length_unit=0"],
    "no speed": ["--odometry", "line:/dev/null?columns=t,x,y,theta&baud=0"],
    "speed beyond all ports": ["--odometry", "line:/dev/null?columns=t,x,y,theta&baud=10000000000"],
    "modulus": ["--odometry", f"line:/dev/null?columns=t,left,right&tick=1e-4&wheel_base=0.3&tick_modulus=1{'0' * 400}"],
    "a tag as lidar": ["--lidar", "tlv:/dev/null"],
    "an option that it does not have": ["--lidar", "/dev/null?colour=3"],
    "no port": ["--uwb", "shell:"],
    "a packed log": ["--lidar", "/dev/null", "--out", "run.log.gz"],
    "page without a port": ["--lidar", "/dev/null", "--watch", "robot"],
    "page beyond all ports": ["--lidar", "/dev/null", "--watch", "0.0.0.0:70000"],
    "steps of no laser": ["--lidar", "/dev/null?steps=5000:99999"],
}


@pytest.mark.parametrize("mistake", REFUSED)
def test_a_mistake_is_reported_before_anything_is_written(mistake, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken.log").write_text("not a port")
    assert main(["record", "--out", "new.log", *REFUSED[mistake]]) in (1, 2)
    output = capfd.readouterr().err
    assert "error: " in output
    assert "Traceback" not in output
    assert [p.name for p in tmp_path.iterdir()] == ["taken.log"]


def test_an_earlier_log_is_not_touched(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken.log").write_text("precious")
    assert main(["record", "--lidar", "/dev/null", "--out", "taken.log", "--duration", "1"]) == 1
    assert (tmp_path / "taken.log").read_text() == "precious"


def test_a_port_that_is_not_there_yet_is_waited_for_where_that_is_wanted(tmp_path, capfd):
    out = tmp_path / "run.log"
    words = ["record", "--lidar", str(tmp_path / "ttyLATER"), "--out", str(out), "--duration", "0.3"]
    assert main(words) == 1
    said = capfd.readouterr().err
    assert "ttyLATER: no such port" in said
    assert "--wait" in said
    assert said.count("\n") == 1
    assert not out.exists()
    assert main([*words, "--wait"]) == 3
    assert "no such port" in out.read_text()


class FakeChild:
    """Stands for `uwblite watch`."""

    made = ()

    def __init__(self, words, niceness=0):
        if not FakeChild.made:
            FakeChild.made = (self,)
        self.words, self.niceness, self.stopped = words, niceness, False

    def code(self):
        return 1

    def output(self):
        return "uwblite: error: Address already in use"

    def stop(self):
        self.stopped = True


@pytest.mark.parametrize(
    ("value", "address"), [([], "127.0.0.1:8000"), (["8001"], "127.0.0.1:8001"), (["0.0.0.0:8002"], "0.0.0.0:8002")]
)
def test_a_page_that_ends_does_not_end_the_recording(tmp_path, monkeypatch, capfd, value, address):
    monkeypatch.setattr("uwblite.cli.record.Child", FakeChild)
    monkeypatch.setattr(FakeChild, "made", ())
    out = tmp_path / "run.log"
    port = str(tmp_path / "ttyLATER")
    assert main(["record", "--lidar", port, "--out", str(out), "--duration", "0.3", "--wait", "--watch", *value]) == 3
    output = capfd.readouterr().err
    assert f"http://{address}/" in output
    assert "the page has ended: Address already in use; the recording goes on" in output
    assert "no such port" in out.read_text()
    words = FakeChild.made[0].words
    assert words[:2] == ["watch", str(out)]
    assert ":".join((words[words.index("--host") + 1], words[words.index("--port") + 1])) == address
    assert FakeChild.made[0].niceness > 0


def test_without_processes_the_recording_goes_on(tmp_path, monkeypatch, capfd):
    def refuse(*_):
        raise OSError(11, "Resource temporarily unavailable")

    monkeypatch.setattr("uwblite.cli.record.Child", refuse)
    out = tmp_path / "run.log"
    assert main(["record", "--lidar", str(tmp_path / "no"), "--out", str(out), "--duration", "0.3", "--wait", "--watch"]) == 3
    assert "no page" in capfd.readouterr().err


@pytest.mark.slow
def test_a_recorder_with_its_page_ends_both(tmp_path):
    out = tmp_path / "run.log"
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    words = ["record", "--lidar", str(tmp_path / "no"), "--wait", "--out", str(out), "--watch", str(port)]
    process = subprocess.Popen([sys.executable, "-m", "uwblite", *words], cwd=ROOT, stderr=subprocess.PIPE)
    try:
        for _ in range(600):
            try:
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=10) as answer:
                    page = answer.read()
                break
            except OSError:
                time.sleep(0.2)
        assert b"uwblite watch run.log" in page
    finally:
        process.terminate()
    process.wait(timeout=30)
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=10)


@pytest.mark.parametrize("url", ["/dev/ttyACM9", "socket://robot.local:2001", "LOOP://", "rfc2217://host:7000", "/dev/null"])
def test_ports_that_may_open_pass(url):
    check_url(url)


@pytest.mark.parametrize("url", ["", "bogus://x", "socket://:1", "socket://host:0", "socket://host:x", "socket://[::1"])
def test_ports_that_never_will_do_not(url):
    with pytest.raises(ConfigError, match="port"):
        check_url(url)


def test_devices_refuses_what_is_no_port_and_reports_what_does_not_answer(tmp_path, capfd):
    plain = tmp_path / "notes.txt"
    plain.write_text("")
    assert main(["devices", str(plain)]) == 1
    assert "not a serial port" in capfd.readouterr().err
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        assert main(["devices", f"socket://127.0.0.1:{free.getsockname()[1]}"]) == 3
    assert "cannot open" in capfd.readouterr().out


@pytest.mark.parametrize("words", [["map", "x.log", "--out", "y", "--jobs"], ["plan-anchors", "--map", "y", "--count"]])
def test_numbers_beyond_all_measure_are_usage_errors(words, capfd):
    assert main([*words, "1" + "0" * 400]) == 2
    assert "is not a whole number" in capfd.readouterr().err


def test_without_pyserial_nothing_is_tried_for_ever(tmp_path, monkeypatch, capfd):
    monkeypatch.setitem(sys.modules, "serial", None)
    for words in (["devices"], ["record", "--lidar", "/dev/null", "--out", str(tmp_path / "run.log")]):
        assert main(words) == 1
        assert "pyserial is missing" in capfd.readouterr().err
    assert not list(tmp_path.iterdir())


def test_ports_of_which_none_was_found_are_not_all_well(monkeypatch, capfd):
    """A Raspberry Pi's header has a UART, whether something hangs on it or not."""
    monkeypatch.setattr("uwblite.cli.devices.plugged_in", lambda: [PluggedIn("/dev/ttyS0", "ttyS0", "")])
    assert main(["devices"]) == 1
    output = capfd.readouterr()
    assert "all is well" not in output.err + output.out
    assert "devices /dev/ttyS0" in output.out
    assert "no USB device is plugged in" in output.err


def test_with_a_usb_device_nothing_is_said_to_be_missing(monkeypatch, capfd):
    monkeypatch.setattr("uwblite.cli.devices.plugged_in", lambda: [PluggedIn("/dev/ttyUSB7", "a bridge", "1234:5678")])
    assert main(["devices", "--list"]) == 0
    assert "no USB device" not in capfd.readouterr().err


def test_every_kind_of_device_is_listed_with_its_options(capfd):
    assert main(["devices", "--kinds"]) == 0
    listed = capfd.readouterr().out
    assert all(f"--{kind.sensor} {kind.name}:PORT" in listed for kind in DEVICES.values())
    assert "time_unit" in listed


def test_a_log_is_gone_on_with_from_its_last_pose_and_a_clock_behind_it_is_moved(tmp_path, capsys):
    out = tmp_path / "run.log"
    ahead = time.time() + 3600.0
    out.write_text(f"ODOM 1 2 0.5 0 0 0 {ahead:.6f} h 0.0\n")
    base = f"kobuki:{tmp_path / 'none'}"
    words = ["record", "--odometry", base, "--out", str(out), "--duration", "0.1", "--wait", "--append"]
    assert main(words) == 3
    (told,) = [line for line in out.read_text().splitlines() if "goes on with a log" in line]
    behind = float(re.search(r"this computer's clock is (\d+) s behind the log and was moved", told)[1])
    assert behind == pytest.approx(3600.0, abs=5.0)
    (params,) = [line.split() for line in out.read_text().splitlines() if line.startswith("PARAM host_monotonic_zero")]
    assert float(params[3]) == pytest.approx(ahead + 1.0, abs=5.0)
    assert float(params[2]) == pytest.approx(ahead + 1.0 - time.monotonic(), abs=5.0)
    out.write_text("ODOM 1 2 0.5 0 0 0 10.0 h 0.0\n")
    assert main(words) == 3
    assert "was moved" not in out.read_text()


def test_what_was_recorded_is_summed_up_for_programs(tmp_path, capsys):
    out = tmp_path / "run.log"
    words = ["record", "--uwb", str(tmp_path / "none"), "--out", str(out), "--duration", "0.1", "--wait", "--json"]
    assert main(words) == 3
    summary = json.loads(capsys.readouterr().out)
    assert summary["log"] == str(out)
    assert (summary["parts"], summary["bytes"]) == (1, out.stat().st_size)
    assert 0.1 <= summary["seconds"] < 5.0
    assert summary["doubts"] == ["uwb: no data at all"]
    assert summary["devices"] == {
        "uwb": {"messages": 0, "lost": 0, "corrupt": {}, "connects": 0, "silent_seconds": 0.0, "anchors": {}}
    }
    head = out.read_text().splitlines()[:2]
    assert head[0] == "# CARMEN Logfile"
    assert head[1].endswith(f"recorded by uwblite {__version__}: uwb {tmp_path / 'none'}")
