"""The live page without a socket: what it shows of a map and a growing log, and that it serves nothing else."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from helpers.results import EVIL, small_folder

from uwblite.io.carmen_live import LogTail
from uwblite.io.stored_result import read_result
from uwblite.server.live import LivePage, watch_status

HOST = {"host": "127.0.0.1:8000"}


@pytest.fixture
def stored(tmp_path):
    small_folder(tmp_path / "map")
    return read_result(tmp_path / "map")


@pytest.fixture
def page():
    page = LivePage(f"watch {EVIL}")
    page.host = HOST["host"]
    return page


def states(page):
    """Return the latest state of every value."""
    events = page.feed.events(patience=0.01)
    next(events)
    pairs = [m.split("\n")[:2] for m in next(events).decode().strip().split("\n\n") if m.startswith("event")]
    return {name.removeprefix("event: "): json.loads(data.removeprefix("data: ")) for name, data in pairs}


def test_a_map_with_its_picture_anchors_and_path(page, stored):
    assert page.handle("GET", "/grid.png", HOST).status == 404
    page.show_map(stored)
    shown = states(page)["map"]
    assert [a["id"] for a in shown["anchors"]] == [a.id for a in stored.anchors]
    x, y = stored.trajectories[0][1][0, :2]
    assert f'class="path path0" points="{x:.3f},{-y:.3f} ' in shown["svg"]
    assert "data-closure" not in shown["svg"]
    address = re.search('href="([^"]*)"', shown["svg"])[1]
    assert page.handle("GET", address, HOST).body.startswith(b"\x89PNG")
    page.show_map(stored)
    assert address not in states(page)["map"]["svg"]
    page.show_map(stored, paths=False)
    assert 'class="path' not in states(page)["map"]["svg"]
    page.show_map(replace(stored, grid=None))
    assert "<image" not in states(page)["map"]["svg"]
    page.show_map(None)
    assert states(page)["map"]["svg"] == ""
    assert page.handle("GET", "/grid.png", HOST).status == 404


def test_the_page_itself_holds_no_markup_out_of_names(page):
    answer = page.handle("GET", "/", HOST)
    assert answer.status == 200
    assert b"<script>alert" not in answer.body
    assert b"&lt;script&gt;alert" in answer.body


@pytest.mark.parametrize(
    "path", ["/../../etc/passwd", "/%2e%2e/etc/passwd", "//etc/passwd", "/map/report.json", "/grid.png/x", "http://x/", "/\0"]
)
def test_nothing_else_is_served(page, stored, path):
    page.show_map(stored)
    assert page.handle("GET", path, HOST).status == 404
    assert page.handle("GET", "/", {"host": "evil.example"}).status == 403
    assert page.handle("POST", "/", HOST).status == 403


def odom(t, x, y=0.0, theta=0.0):
    return f"ODOM {x:.6f} {y:.6f} {theta:.6f} 0.0 0.0 0.0 {t:.6f} host {t:.6f}\n"


def test_the_status_of_a_growing_log(tmp_path, stored):
    log = tmp_path / "run.log"
    stamps, poses = stored.trajectories[0]
    # The wheels' frame is turned by a right angle and shifted; the robot goes on straight for two metres after the map's end.
    times = np.arange(stamps[-1] - 20.0, stamps[-1] + 10.0, 0.1)
    log.write_text("".join(odom(t, 5.0, 0.2 * (t - stamps[-1]), np.pi / 2) for t in times))
    with open(log, "a") as file:
        file.writelines(f"UWB {a} 3.2 90 {times[k]:.6f} h {times[k]:.6f}\n" for k in range(0, 250, 5) for a in ("5C0B",))
    tail = LogTail(str(log))
    while tail.poll():
        pass
    status = watch_status(tail, stored, 0.0, "map of 30 s")
    sensors = {s["name"]: s for s in status["sensors"]}
    assert sensors["odometry"]["rate"] == pytest.approx(10.0, abs=0.2)
    assert sensors["radio"]["late"]
    assert sensors["radio"]["rate"] == 0.0
    assert status["advice"][0] == "no message from the radio for 5 s: check its cable and power"
    x, y, theta = poses[-1]
    ahead = 0.2 * (times[-1] - stamps[-1])
    assert status["pose"] == pytest.approx([x + ahead * np.cos(theta), y + ahead * np.sin(theta), theta], abs=0.02)
    assert status["trail"][0] == pytest.approx([x, y], abs=0.01)
    assert "run.log: 30 s" in status["summary"]
    json.dumps(status, allow_nan=False)


def test_without_a_map_or_a_log_the_status_reports_so(tmp_path, stored):
    status = watch_status(LogTail(str(tmp_path / "none.log")), None, 3.0, "")
    assert status["advice"] == ["nothing is recorded yet: is the recorder running, and is this its log?"]
    assert status["pose"] is None
    json.dumps(status, allow_nan=False)
    (tmp_path / "run.log").write_text(odom(5000.0, 0.0))
    tail = LogTail(str(tmp_path / "run.log"))
    tail.poll()
    other = watch_status(tail, stored, 0.0, "")
    assert other["pose"] == pytest.approx(stored.trajectories[0][1][-1], abs=1e-3)
