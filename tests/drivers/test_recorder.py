"""The recorder with ports of its own making: ports that hang, come and go, and say nothing."""

import itertools
import re
import threading
import time

import pytest

from uwblite.drivers.devices import open_device
from uwblite.drivers.link import Link
from uwblite.drivers.log_file import LogFile
from uwblite.drivers.recorder import Recorder
from uwblite.drivers.transport import open_port
from uwblite.errors import DeviceError

LINES = 0.02
"""s between the lines of the fake base."""


class TalkingPort:
    """A base that prints ``t,x,y,theta`` fifty times a second; without a descriptor, so that it is polled."""

    def __init__(self, gone_after=None):
        self._began, self._sent, self._gone_after = time.monotonic(), 0, gone_after

    def fileno(self):
        return None

    def read(self):
        elapsed = time.monotonic() - self._began
        if self._gone_after is not None and elapsed > self._gone_after:
            raise DeviceError("unplugged")
        out = b""
        while self._sent * LINES < elapsed:
            out += f"{self._sent * LINES:.3f},{0.01 * self._sent:.3f},0,0\n".encode()
            self._sent += 1
        return out

    def write(self, data):
        pass

    set_baud = set_dtr = write

    def close(self):
        pass


def record(tmp_path, ports, seconds, open_one):
    """Record and return the recorder and the notes."""
    links = [Link(name, spec, open_device(sensor, spec)[0]) for name, (sensor, spec) in ports.items()]
    log, notes = LogFile(tmp_path / "run.log", sync=60.0), []
    recorder = Recorder(
        links, log, monotonic=time.monotonic, wall_offset=0.0, host="h", on_note=lambda t, n: notes.append((t, n)),
        open_port=open_one,
    )  # fmt: skip
    recorder.begin([])
    recorder.run(duration=seconds, stopping=lambda: False)
    log.close()
    return recorder, notes


def stamps_of(path):
    return [float(line.split()[-3]) for line in path.read_text().splitlines() if line.startswith("ODOM")]


BASE = ("odometry", "line:/dev/base?columns=t,x,y,theta")


def test_ports_that_hang_while_they_are_opened_hold_up_nobody(tmp_path):
    """Two TCP bridges whose hosts are dead: each attempt takes five seconds. The base loses no line."""
    release = threading.Event()

    def open_one(url, baud):
        if "base" in url:
            return TalkingPort()
        release.wait(5.0)
        raise DeviceError(f"{url}: timed out")

    ports = {"uwb": ("uwb", "tlv:socket://10.0.0.1:1"), "odometry": BASE, "lidar": ("lidar", "socket://10.0.0.2:2")}
    recorder, _ = record(tmp_path, ports, 2.0, open_one)
    release.set()
    assert recorder.end - recorder.start < 2.5
    stamps = stamps_of(tmp_path / "run.log")
    assert len(stamps) > 0.9 * 2.0 / LINES
    gaps = [b - a for a, b in itertools.pairwise(stamps)]
    assert sum(g == 0 for g in gaps) < 3
    counts = recorder.links[1].counts
    assert counts.messages == len(stamps)
    assert counts.lost == 0
    assert any("no data at all" in doubt for doubt in recorder.doubts())


def test_a_port_that_opens_after_the_end_is_closed_again(tmp_path):
    opened, release = [], threading.Event()

    class Closing(TalkingPort):
        def close(self):
            opened.append("closed")

    def open_one(url, baud):
        release.wait(5.0)
        return Closing()

    record(tmp_path, {"odometry": BASE}, 0.3, open_one)
    release.set()
    for _ in range(200):
        if opened:
            break
        time.sleep(0.01)
    assert opened == ["closed"]


def test_a_device_that_comes_and_goes_without_data_is_reported_once(tmp_path):
    recorder, notes = record(tmp_path, {"odometry": BASE}, 2.5, lambda url, baud: _Flapping())
    assert recorder.links[0].counts.connects > 3
    names = [note.name for _, note in notes]
    assert len(names) == len(set(names))
    text = (tmp_path / "run.log").read_text()
    assert len(re.findall("odometry-gone", text)) == 1


class _Flapping(TalkingPort):
    """Open for a moment, then gone."""

    def read(self):
        if time.monotonic() - self._began > 0.1:
            raise DeviceError("unplugged")
        return b""


def test_data_makes_a_reconnect_worth_reporting_again(tmp_path):
    recorder, notes = record(tmp_path, {"odometry": BASE}, 2.5, lambda url, baud: TalkingPort(gone_after=0.7))
    assert recorder.links[0].counts.connects > 2
    assert sum(note.name == "odometry-gone" for _, note in notes) > 1
    assert recorder.links[0].counts.lost > 0 or recorder.links[0].counts.messages > 50


def test_a_base_with_a_wrong_unit_of_time_is_stamped_with_arrivals_and_reported(tmp_path):
    spec = BASE[0], BASE[1] + "&time_unit=0.001"
    _, notes = record(tmp_path, {"odometry": spec}, 6.0, lambda url, baud: TalkingPort())
    (note,) = [note for _, note in notes if note.name == "odometry-time-unit"]
    assert "time_unit=1" in note.text
    stamps = stamps_of(tmp_path / "run.log")
    assert stamps[-1] - stamps[0] == pytest.approx(6.0, abs=0.4)


def test_a_bridge_that_is_not_there_is_one_clear_error():
    with pytest.raises(DeviceError, match="cannot open"):
        open_port("socket://127.0.0.1:1", 115200)
