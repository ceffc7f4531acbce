"""`uwblite watch`: rounds that come, fail and are forgotten, by a clock of the test's own; then as a user starts it."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import urllib.request
from contextlib import nullcontext

import numpy as np
import pytest
from helpers.browser import CHROMIUM, Browser
from helpers.results import small_folder
from helpers.served import PATIENCE, Served

from uwblite.cli import main, watch
from uwblite.server.live import LivePage


def odom_lines(begin, end):
    times = np.arange(begin, end, 0.1)
    return "".join(f"ODOM {t - 1000:.6f} 0.0 0.0 0.0 0.0 0.0 {t:.6f} host {t:.6f}\n" for t in times)


class FakeChild:
    """Stands for `uwblite map`: its test says what became of it."""

    made: list

    def __init__(self, words, niceness=0):
        self.words, self.niceness, self.result, self.stopped = words, niceness, None, False
        FakeChild.made.append(self)

    def code(self):
        return self.result

    def output(self):
        return "uwblite: error: the disk is full"

    def stop(self):
        self.stopped = True


@pytest.fixture
def watched(tmp_path, monkeypatch):
    """A watch of a log with fake rounds: (watch, log, folder, states)."""
    monkeypatch.setattr("uwblite.cli.watch.Child", FakeChild)
    monkeypatch.setattr(watch, "_spent_on_rounds", lambda now: now)
    FakeChild.made = []
    log, folder, page = tmp_path / "run.log", tmp_path / "run_watch", LivePage("watch")
    made = watch.Watch(str(log), str(folder), page, ["--laser-flipped"])

    def state(name="status"):
        events = page.feed.events(patience=0.01)
        next(events)
        found = re.search(rf"event: {name}\ndata: (.*)\n", next(events).decode())
        return json.loads(found[1]) if found else None

    return made, log, folder, state


def make_map(folder):
    shutil.rmtree(folder, ignore_errors=True)
    small_folder(folder)


def test_a_round_is_begun_shown_and_followed_by_the_next(watched):
    made, log, folder, state = watched
    made.step(0.0)
    assert state()["advice"][0].startswith("nothing is recorded yet")
    log.write_text(odom_lines(1000.0, 1010.0))
    made.step(1.0)
    assert not FakeChild.made
    with open(log, "a") as file:
        file.write(odom_lines(1010.0, 1030.0))
    made.step(2.0)
    job = FakeChild.made[0]
    assert job.words[:4] == ["map", str(log), "--out", str(folder)]
    assert "--laser-flipped" in job.words
    assert job.niceness == 19
    assert "mapping ..." in state()["rounds"]
    make_map(folder)
    job.result = 3
    made.step(5.0)
    assert len(state("map")["anchors"]) == 2
    assert "map of 12 s, made 0 s ago" in state()["rounds"]
    with open(log, "a") as file:
        file.write(odom_lines(1030.0, 1060.0))
    made.step(20.0)
    assert len(FakeChild.made) == 1  # the round took three seconds
    made.step(50.0)
    assert len(FakeChild.made) == 2
    made.close()
    assert FakeChild.made[1].stopped


def test_ten_minutes_of_polling_follow_a_log_and_take_a_tenth_of_the_time(watched):
    """A log of two parts, whose radio falls silent for a minute; a round takes 4 s at first and more as the log grows."""
    made, log, folder, state = watched
    make_map(folder)
    part, written, rounds, silent = log, 0, [], []
    for second in range(600):
        if second == 300:
            with part.open("a") as out:
                written += out.write("COMMENT continued in run.2.log\n")
            part = log.with_name("run.2.log")
        with part.open("a") as out:
            begin = 1000.0 + second
            written += out.write(odom_lines(begin, begin + 1.0))
            if not 400 <= second < 460:
                written += out.write(f"UWB 5C0B 3.210 90 {begin + 0.5:.6f} host {begin + 0.5:.6f}\n")
        now = 50.0 + second
        if made._job is not None and now - made._job_began >= 4.0 + 0.01 * second:
            rounds.append(now - made._job_began)
            made._job.result = 0
        made.step(now)
        shown = state()
        assert made.tail.bytes == written or second == 300  # the next part is found a step later
        assert made.tail.last == pytest.approx(1000.9 + second, abs=0.11) or second == 300
        assert sum(not job.stopped and job.result is None for job in FakeChild.made) <= 1
        silent += [second] * any(s["late"] for s in shown["sensors"] if s["name"] == "radio")
    assert len(rounds) >= 5
    assert sum(rounds) <= 0.1 * 600 + max(rounds)
    assert made.last is not None
    assert not made.last.failed
    assert made.last.recorded > 450
    assert min(silent) in range(402, 440)
    assert max(silent) in range(458, 462)
    made.close()


def test_a_round_that_fails_leaves_the_page_and_the_map(watched):
    made, log, folder, state = watched
    make_map(folder)
    log.write_text(odom_lines(1000.0, 1030.0))
    made.step(0.0)
    FakeChild.made[0].result = 0
    made.step(1.0)
    with open(log, "a") as file:
        file.write(odom_lines(1030.0, 1100.0))
    made.step(60.0)
    FakeChild.made[1].result = 1
    made.step(61.0)
    assert "the last round failed: the disk is full" in state()["rounds"]
    assert "map of 12 s" in state()["rounds"]
    assert len(state("map")["anchors"]) == 2
    made.step(70.0)
    assert len(FakeChild.made) == 2
    made.step(100.0)
    assert len(FakeChild.made) == 3
    (folder / "anchors.csv").write_text("\0 broken")
    FakeChild.made[2].result = 0
    made.step(101.0)
    assert "the last round failed" in state()["rounds"]
    assert "anchors.csv" in state()["rounds"]


def test_a_round_without_end_is_ended(watched):
    made, log, _, state = watched
    log.write_text(odom_lines(1000.0, 1030.0))
    made.step(0.0)
    made.step(2000.0)
    assert FakeChild.made[0].stopped
    assert "more than 30 minutes" in state()["rounds"]


def test_another_log_in_its_place_is_another_recording(watched):
    made, log, folder, state = watched
    make_map(folder)
    log.write_text(odom_lines(1000.0, 1050.0))
    made.step(0.0)
    assert len(FakeChild.made) == 1
    os.truncate(log, 0)
    made.step(1.0)
    log.write_text(odom_lines(5000.0, 5010.0))
    made.step(2.0)
    assert FakeChild.made[0].stopped
    assert state("map")["anchors"] == []
    assert "begun again" in state()["summary"]
    assert "map of" not in state()["rounds"]


def test_an_earlier_watch_left_a_map(watched):
    made, log, folder, _ = watched
    make_map(folder)
    again = watch.Watch(str(log), str(folder), LivePage("again"), [])
    assert again.result is not None
    again.step(0.0)
    assert made.result is None


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["-"], "name the plain log"), (["run.log.gz"], "name the plain log"), (["."], "is a folder"),
        (["run.log", "--out", "map"], "already holds a result"), (["run.log", "--set", "grid.none=1"], "grid.none"),
        (["pipe"], "only a file"),
        (["run.log", "--host", "256.1.1.1"], ""),
    ],
)  # fmt: skip
def test_what_cannot_be_watched_is_one_clear_line(tmp_path, monkeypatch, capsys, words, message):
    monkeypatch.chdir(tmp_path)
    make_map(tmp_path / "map")
    os.mkfifo(tmp_path / "pipe")
    assert main(["watch", "--port", "0", *words]) in (1, 2)
    output = capsys.readouterr().err
    assert message in output
    assert "internal" not in output


def served_watch(log, *words):
    """The page of a log."""
    return Served("watch", str(log), "--port", "0", *words)


@pytest.mark.slow
def test_ctrl_c_at_the_moment_of_the_address_ends_it_as_well(tmp_path):
    with served_watch(tmp_path / "run.log") as served:
        pass
    assert served.code == 0


@pytest.mark.slow
def test_it_reports_its_address_serves_and_ends_with_ctrl_c(tmp_path):
    with served_watch(tmp_path / "run.log") as served, urllib.request.urlopen(served.address, timeout=PATIENCE) as answer:
        assert b"uwblite watch run.log" in answer.read()
    assert served.code == 0


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
@pytest.mark.parametrize(("width", "dark"), [(1280, False), (390, True)])
def test_the_page_shows_a_log_that_grows(tmp_path, room_log, width, dark):
    log = tmp_path / "run.log"
    assert main(["convert", str(room_log), str(tmp_path / "whole.log"), "--end", "60"]) == 0
    lines = (tmp_path / "whole.log").read_bytes().splitlines(keepends=True)
    log.write_bytes(b"".join(lines[: len(lines) // 2]))
    with served_watch(log) as served, Browser(tmp_path / "profile", width=width, dark=dark) as browser:
        browser.open(served.address)
        browser.until("document.querySelector('#map image')", patience=120)
        browser.until("document.querySelector('#robot path')")
        before = browser.run("document.querySelector('#robot g').getAttribute('transform')")
        with open(log, "ab") as file:
            file.write(b"".join(lines[len(lines) // 2 :]) + b"ODOM half a li")
        browser.until(f"document.querySelector('#robot g').getAttribute('transform') !== {json.dumps(before)}")
        assert browser.run("document.querySelectorAll('#sensors tr').length") == 4
        assert browser.run("document.documentElement.scrollWidth") <= width
        assert browser.complaints == []
        time.sleep(0.1)


def test_a_watch_that_is_told_to_end_does_so_as_by_ctrl_c(tmp_path, monkeypatch, capsys):
    """A service manager sends SIGTERM: the page ends, and the round that runs is stopped."""
    before, asked, closed = signal.getsignal(signal.SIGTERM), [], []

    def told(self, now):
        asked.append(now)
        assert len(asked) == 1, "it goes on"
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(watch.Watch, "step", told)
    monkeypatch.setattr(watch.Watch, "close", lambda self: closed.append(self))
    monkeypatch.setattr(watch, "serving", lambda page, *_: nullcontext("http://127.0.0.1:1/"))
    monkeypatch.setattr(os, "nice", lambda by: 0)
    (tmp_path / "run.log").write_text(odom_lines(1000.0, 1010.0))
    try:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        assert main(["watch", str(tmp_path / "run.log")]) == 0
    finally:
        signal.signal(signal.SIGTERM, before)
    output = capsys.readouterr()
    assert "open http://127.0.0.1:1/" in output.out
    assert "the page has ended" in output.err
    assert len(closed) == 1


def test_time_of_rounds_is_that_of_the_processes_that_have_ended_and_a_log_is_as_old_as_its_last_byte(tmp_path):
    before = watch._spent_on_rounds(1e9)
    subprocess.run([sys.executable, "-c", "sum(range(3_000_000))"], check=True)
    assert 0.0 < watch._spent_on_rounds(1e9) - before < 60.0
    log = tmp_path / "run.log"
    log.touch()
    os.utime(log, (time.time() - 100.0, time.time() - 100.0))
    assert watch._age(str(log)) == pytest.approx(100.0, abs=30.0)
    os.utime(log, (time.time() + 100.0, time.time() + 100.0))
    assert watch._age(str(log)) == watch._age(str(tmp_path / "none")) == 0.0


def test_a_round_that_cannot_begin_has_failed(watched, monkeypatch):
    made, log, _, state = watched

    def refuse(*_):
        raise OSError(11, "no more processes")

    monkeypatch.setattr(watch, "Child", refuse)
    log.write_text(odom_lines(1000.0, 1030.0))
    made.step(0.0)
    assert "the last round failed: [Errno 11] no more processes" in state()["rounds"]
    assert (made.last.failed, made.last.ended) == (True, 0.0)
