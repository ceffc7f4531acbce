"""A growing log is followed byte by byte, over parts, replacement and damage; nothing is reported before its line is whole."""

import os

import numpy as np
import pytest

from uwblite.drivers.log_file import LogFile
from uwblite.io.carmen_live import LogTail
from uwblite.server.live import watch_status


def odom(t, x=0.0):
    return f"ODOM {x:.6f} 0.000000 0.100000 0.0 0.0 0.0 {t:.6f} host {t:.6f}"


def uwb(t, anchor="5C0B", number=""):
    return f"UWB{number} {anchor} 3.210 90 {t:.6f} host {t:.6f}"


def scan(t):
    return f"ROBOTLASER1 0 -1 2 1 4.0 0.01 0 3 1 2 3 0 0 0 0 0 0 0 0 0 0 0 0 {t:.6f} host {t:.6f}"


def write(path, *lines, end="\n"):
    with open(path, "a") as file:
        file.write("\n".join(lines) + end)


def drain(tail):
    while tail.poll():
        pass
    return tail


def test_sensors_are_counted_with_their_rates(tmp_path):
    log = tmp_path / "run.log"
    tail = LogTail(str(log))
    assert not tail.poll()
    times = np.arange(0.0, 30.0, 0.05)
    write(log, "PARAM laser_flipped off 0 host 0", *(odom(t, x=t) for t in times), *(scan(t) for t in times[::2]))
    write(log, *(uwb(t, "A1") for t in times[::10]), *(uwb(t, "B2", "2") for t in times[:100:10]))
    drain(tail)
    assert {name: s.count for name, s in tail.sensors.items()} == {"odometry": 600, "lidar": 300, "radio": 70}
    assert tail.sensors["odometry"].rate(tail.last) == pytest.approx(20.0, rel=0.02)
    assert tail.sensors["lidar"].rate(tail.last) == pytest.approx(10.0, rel=0.02)
    assert tail.anchors["A1"].rate(tail.last) == pytest.approx(2.0, rel=0.06)
    assert tail.anchors["B2"].rate(tail.last) == 0.0
    assert tail.seconds == pytest.approx(29.95)
    stamps, poses = tail.odometry()
    assert np.all(np.diff(stamps)[:-1] >= 0.2 - 1e-9)
    assert stamps[-1] == pytest.approx(29.95)
    assert poses[:, 0] == pytest.approx(stamps)


def test_bytes_may_come_one_by_one(tmp_path):
    log, lines = tmp_path / "run.log", [odom(0.0), uwb(0.5), scan(1.0), odom(1.5)]
    tail = LogTail(str(log))
    seen = []
    for byte in "\n".join(lines) + "\n":
        with open(log, "a") as file:
            file.write(byte)
        tail.poll()
        seen.append(sum(s.count for s in tail.sensors.values()))
    ends = np.cumsum([len(line) + 1 for line in lines]) - 1
    assert seen == [int(np.sum(k >= ends)) for k in range(len(seen))]
    assert tail.broken == 0


def test_parts_are_followed_in_their_order(tmp_path):
    log = LogFile(tmp_path / "run.log", rotate=400, sync=60.0)
    tail = LogTail(str(tmp_path / "run.log"))
    for k in range(40):
        log.write([odom(0.1 * k)])
        if k % 7 == 0:
            tail.poll()
    log.close()
    drain(tail)
    assert log.part > 3
    assert tail.sensors["odometry"].count == 40
    assert tail.restarts == 0


@pytest.mark.parametrize("how", ["shrinks", "replaced", "removed"])
def test_another_log_in_its_place_begins_again(tmp_path, how):
    log = tmp_path / "run.log"
    write(log, *(odom(t) for t in range(100)), uwb(3.0, "OLD"))
    tail = drain(LogTail(str(log)))
    if how == "shrinks":
        os.truncate(log, 0)
        tail.poll()
    elif how == "replaced":
        write(tmp_path / "new.log", *(odom(t) for t in range(1000, 1200)))
        os.replace(tmp_path / "new.log", log)
    else:
        log.rename(tmp_path / "old.log")
        assert not tail.poll()
    if how != "replaced":
        write(log, *(odom(t) for t in range(1000, 1200)))
    drain(tail)
    assert tail.restarts == 1
    assert tail.sensors["odometry"].count == 200
    assert tail.first == 1000.0
    assert not tail.anchors


def test_damage_is_counted_and_passed_over(tmp_path):
    log = tmp_path / "run.log"
    bad = ["ODOM 1 2", "ODOM nan 0 0 0 0 0 5.0 host 5.0", "UWB", "ODOM 0 0 0 0 0 0 inf host inf", "\udcff", "what is this"]
    with open(log, "w", errors="surrogateescape") as file:
        file.write("\n".join([odom(0.0), *bad, odom(1.0)]) + "\n")
    tail = drain(LogTail(str(log)))
    assert tail.broken == len(bad)
    assert tail.seconds == pytest.approx(1.0)
    assert len(tail.odometry()[0]) == 2


def test_a_file_that_may_not_be_read_is_one_that_does_not_grow(tmp_path, monkeypatch):
    log = tmp_path / "run.log"
    write(log, odom(0.0))
    tail = LogTail(str(log))

    def refuse(*_, **__):
        raise PermissionError(13, "no")

    monkeypatch.setattr("builtins.open", refuse)
    assert not tail.poll()
    monkeypatch.undo()
    assert tail.poll()


def test_a_pipe_in_the_place_of_the_log_is_said_and_does_not_hold_anything_up(tmp_path):
    log = tmp_path / "run.log"
    write(log, odom(0.0))
    tail = LogTail(str(log))
    assert tail.poll()
    log.unlink()
    assert tail.is_file
    os.mkfifo(log)
    assert not tail.poll()
    assert not tail.is_file
    assert "only a file can be followed" in watch_status(tail, None, 0.0, "")["summary"]
    log.unlink()
    write(log, odom(1.0))
    assert tail.poll()
    assert (tail.is_file, tail.restarts) == (True, 1)
