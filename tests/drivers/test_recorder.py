"""The recorder with ports of its own making: ports that hang, come and go, and say nothing."""

import itertools
import random
import re
import threading
import time
from unittest import mock

import pytest
from fuzzing.device_words import WORDS
from helpers.virtual_recording import VirtualTime

from uwblite.drivers import link as link_module
from uwblite.drivers.devices import DEVICES, open_device
from uwblite.drivers.events import Corrupt
from uwblite.drivers.link import Host, Link
from uwblite.drivers.log_file import LogFile
from uwblite.drivers.recorder import Recorder
from uwblite.drivers.transport import open_port
from uwblite.drivers.uwb_line import BOARDS
from uwblite.errors import DeviceError

LINES = 0.02
"""s between the lines of the fake base."""


class TalkingPort:
    """A base that prints ``t,x,y,theta`` fifty times a second; without a descriptor, so that it is polled."""

    def __init__(self, clock, gone_after=None):
        self._clock, self._began, self._sent, self._gone_after = clock, clock(), 0, gone_after

    def fileno(self):
        return None

    def read(self):
        elapsed = self._clock() - self._began
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


class Waiting:
    """Instead of waiting for bytes, moves the clock on; `stops` are (when, how long), s, the process does not run."""

    def __init__(self, clock, stops=()):
        self._clock, self._stops = clock, [(clock() + begin, seconds) for begin, seconds in stops]

    def select(self, timeout):
        self._clock.now += max(1e-4, timeout)
        while self._stops and self._stops[0][0] <= self._clock.now:
            self._clock.now += self._stops.pop(0)[1]
        return []

    def close(self):
        pass


class OpenedAtOnce:
    """Instead of a thread that opens a port: at once, or, where that says None, never."""

    def __init__(self, open_port, url, baud):
        try:
            self._port = open_port(url, baud)
        except DeviceError as error:
            self._port = error

    def result(self):
        return self._port

    def give_up(self):
        pass


def record(tmp_path, ports, seconds, open_one, wall=None, stops=()):
    """Record in simulated time and return the recorder and the notes; `open_one` and `wall` get (URL and) the clock."""
    links = [Link(name, spec, open_device(sensor, spec)[0]) for name, (sensor, spec) in ports.items()]
    log, notes, clock = LogFile(tmp_path / "run.log", sync=60.0), [], VirtualTime()
    host = Host("h", clock, 0.0, wall and (lambda: wall(clock())), lambda url, baud: open_one(url, clock))
    recorder = Recorder(links, log, host, on_note=lambda t, n: notes.append((t, n)))
    recorder._selector = Waiting(clock, stops)
    recorder.begin([])
    with mock.patch.object(link_module, "Opening", OpenedAtOnce):
        recorder.run(duration=seconds, stopping=lambda: False)
    log.close()
    return recorder, notes


def stamps_of(path):
    return [float(line.split()[-3]) for line in path.read_text().splitlines() if line.startswith("ODOM")]


BASE = ("odometry", "line:/dev/base?columns=t,x,y,theta")


def test_ports_that_hang_while_they_are_opened_hold_up_nobody(tmp_path):
    """Two TCP bridges whose hosts are dead. The base loses no line."""
    ports = {"uwb": ("uwb", "tlv:socket://10.0.0.1:1"), "odometry": BASE, "lidar": ("lidar", "socket://10.0.0.2:2")}
    recorder, _ = record(tmp_path, ports, 20.0, lambda url, clock: TalkingPort(clock) if "base" in url else None)
    assert recorder.end - recorder.start < 20.1
    stamps = stamps_of(tmp_path / "run.log")
    assert len(stamps) >= 20.0 / LINES - 3
    assert all(before < after for before, after in itertools.pairwise(stamps))
    counts = recorder.links[1].counts
    assert counts.messages == len(stamps)
    assert counts.lost == 0
    assert any("no data at all" in doubt for doubt in recorder.doubts())


@pytest.mark.parametrize("step", [7.0, -7200.0])
def test_a_clock_that_is_set_meanwhile_moves_no_stamp_and_is_reported_once(tmp_path, step):
    """A Raspberry Pi finds the network after five seconds."""
    wall = lambda now: now + (step if now > 1005.0 else 0.0)  # noqa: E731
    _, notes = record(tmp_path, {"odometry": BASE}, 12.0, lambda url, clock: TalkingPort(clock), wall)
    stamps = stamps_of(tmp_path / "run.log")
    assert max(b - a for a, b in itertools.pairwise(stamps)) < 3 * LINES
    assert min(b - a for a, b in itertools.pairwise(stamps)) > 0.0
    (said,) = (note for _, note in notes if note.name == "clock-set")
    assert f"{step:+.1f} s" in said.text


@pytest.mark.parametrize(
    "stops", [[(0.3, 1.0)], [(0.5, 0.06), (5.0, 0.09), (6.0, 3.0)], [(0.02 * k, 0.05) for k in range(1, 200)]]
)
@pytest.mark.parametrize("columns", ["t,x,y,theta", "-,x,y,theta"])
def test_stamps_rise_though_the_process_was_stopped(tmp_path, stops, columns):
    """All lines of a pause are read at once, perhaps before anything is known of the base's clock or rhythm."""
    ports = {"odometry": ("odometry", f"line:/dev/base?columns={columns}")}
    recorder, _ = record(tmp_path, ports, 12.0, lambda url, clock: TalkingPort(clock), stops=stops)
    stamps = stamps_of(tmp_path / "run.log")
    assert len(stamps) == recorder.links[0].counts.messages > 12.0 / LINES - 5
    assert all(before < after for before, after in itertools.pairwise(stamps))


def test_a_computer_that_stood_still_blames_no_device(tmp_path):
    ports = {"odometry": ("odometry", "line:/dev/base?columns=-,x,y,theta")}
    recorder, notes = record(tmp_path, ports, 16.0, lambda url, clock: TalkingPort(clock), stops=[(5.0, 6.0)])
    assert [note.name for _, note in notes] == ["odometry-connected"]
    assert not recorder.doubts()


def test_what_a_link_held_back_is_no_silence_once_it_has_come(tmp_path):
    class HeldBack(TalkingPort):
        def read(self):
            return super().read() if not 1005.0 < self._clock() < 1011.0 else b""

    ports = {"odometry": ("odometry", "line:/dev/base?columns=-,x,y,theta")}
    recorder, notes = record(tmp_path, ports, 16.0, lambda url, clock: HeldBack(clock))
    assert [note.name for _, note in notes] == ["odometry-connected", "odometry-no-data", "odometry-data-again"]
    assert re.fullmatch(r"odometry: what was late by 6\.\d s has come", notes[-1][1].text)
    assert not recorder.doubts()


def test_a_log_that_is_deleted_meanwhile_keeps_every_line(tmp_path):
    deleted = []

    class Deleting(TalkingPort):
        def read(self):
            if self._sent > 200 and not deleted:
                deleted.append((tmp_path / "run.log").read_text())
                (tmp_path / "run.log").unlink()
            return super().read()

    recorder, notes = record(tmp_path, {"odometry": BASE}, 10.0, lambda url, clock: Deleting(clock))
    assert [note.name for _, note in notes].count("log-deleted") == 1
    assert (tmp_path / "run.log").read_text().startswith(deleted[0])
    assert len(stamps_of(tmp_path / "run.log")) == recorder.links[0].counts.messages > 450


FOREIGN = {
    "kobuki": b"54\x2c\x68" * 20, "line": b"\xaa\x55\x4d\x01\x0f" * 20, "gyro-line": b"UWB 1;2;3\n" * 10,
    "tlv": b"1.0,2.0,3.0,4.0\n" * 8, "makerfabs": b"\x55\x01" * 60, "bu03": b"from: 1782\t Range: 3.21 m\r\n" * 4,
    "linktrack": b"an0:1.23m\r\n" * 10, "ld06": b"\xfa\xa0" * 60, "lds01": b"\x54\x2c" * 60, "ydlidar-x2": bytes(100),
}  # fmt: skip
"""What another device, or NULs, would send."""


@pytest.mark.parametrize("name", FOREIGN)
def test_another_device_at_the_port_gives_no_data_and_that_is_reported(tmp_path, name):
    class Other(TalkingPort):
        def read(self):
            return FOREIGN[name] if super().read() else b""

    columns = {"line": "?columns=t,x,y,theta", "gyro-line": "?columns=t,turn_rate"}.get(name, "")
    sensor = DEVICES[name].sensor
    recorder, notes = record(
        tmp_path, {sensor: (sensor, f"{name}:/dev/x{columns}")}, 6.0, lambda url, clock: Other(clock)
    )  # fmt: skip
    assert recorder.links[0].counts.messages == 0
    assert {f"{sensor}-{what}" for what in ("no-data", "silent", "unreadable")} & {note.name for _, note in notes}
    assert any("no data at all" in doubt for doubt in recorder.doubts())


def test_a_tag_that_answers_and_ranges_to_nobody_is_not_called_another_device(tmp_path):
    """Its line and its bit rate are right: it is out of the anchors' reach."""

    class OutOfReach(TalkingPort):
        def read(self):
            return b"DIST,0\r\n" if super().read() else b""

    _, notes = record(tmp_path, {"uwb": ("uwb", "shell:/dev/x")}, 8.0, lambda url, clock: OutOfReach(clock))
    (text,) = [note.text for _, note in notes if note.name == "uwb-no-data"]
    assert text.endswith("it answers, but measures nothing")


def test_what_came_last_before_a_silence_is_not_its_cause(tmp_path):
    """A damaged line 0.2 s after the last good one, and nothing any more."""

    class FallsSilent(TalkingPort):
        def read(self):
            lines, elapsed = super().read(), self._clock() - self._began
            return lines if elapsed < 3.0 else b"damaged\n" if lines and elapsed < 3.2 else b""

    _, notes = record(tmp_path, {"odometry": BASE}, 8.0, lambda url, clock: FallsSilent(clock))
    (text,) = [note.text for _, note in notes if note.name == "odometry-no-data"]
    assert "check power and cable" in text


@pytest.mark.parametrize("name", ["line", "gyro-line", "shell", "makerfabs", "scip", "kobuki"])
def test_a_line_that_never_ends_is_kept_in_part_and_counted(name):
    columns = {"line": "?columns=t,x,y,theta", "gyro-line": "?columns=t,turn_rate"}.get(name, "")
    session = open_device(DEVICES[name].sensor, f"{name}:/dev/x{columns}")[0]
    actions = session.start(0.0)
    for k in range(200):
        actions += session.feed(b"1" * 8192, 0.01 * k)
    damaged = [a for a in actions if isinstance(a, Corrupt)]
    assert damaged or name == "shell"  # its start-up does not know yet what the module speaks
    assert len(damaged) < 10_000


def test_what_waited_in_a_port_has_no_time_and_is_dropped(tmp_path):
    """A bridge hands out what it kept for a second before it was asked."""

    def open_one(url, clock):
        port = TalkingPort(clock)
        port._began -= 1.0
        return port

    record(tmp_path, {"odometry": BASE}, 3.0, open_one)
    rows = [line.split() for line in (tmp_path / "run.log").read_text().splitlines() if line.startswith("ODOM")]
    lateness = [float(row[-3]) - float(row[1]) / 0.5 for row in rows]  # the base runs 0.01 m each 0.02 s
    assert max(lateness) - min(lateness) < 0.03


def test_a_port_is_opened_by_a_thread_of_its_own_and_closed_when_it_comes_too_late():
    """Nobody waits for a bridge that takes seconds."""
    closed, release = threading.Event(), threading.Event()

    class Closing(TalkingPort):
        def close(self):
            closed.set()

    def open_one(url, baud):
        release.wait(5.0)
        return Closing(time.monotonic)

    began = time.monotonic()
    opening = link_module.Opening(open_one, "socket://far:1", 115200)
    assert opening.result() is None
    opening.give_up()
    assert time.monotonic() - began < 4.0
    release.set()
    assert closed.wait(5.0)


def test_a_device_that_comes_and_goes_without_data_is_reported_once(tmp_path):
    recorder, notes = record(tmp_path, {"odometry": BASE}, 2.5, lambda url, clock: _Flapping(clock))
    assert recorder.links[0].counts.connects > 3
    names = [note.name for _, note in notes]
    assert len(names) == len(set(names))
    text = (tmp_path / "run.log").read_text()
    assert len(re.findall("odometry-gone", text)) == 1


class _Flapping(TalkingPort):
    """Open for a moment, then gone."""

    def read(self):
        if self._clock() - self._began > 0.1:
            raise DeviceError("unplugged")
        return b""


def test_data_makes_a_reconnect_worth_reporting_again(tmp_path):
    recorder, notes = record(tmp_path, {"odometry": BASE}, 2.5, lambda url, clock: TalkingPort(clock, gone_after=0.7))
    assert recorder.links[0].counts.connects > 2
    assert sum(note.name == "odometry-gone" for _, note in notes) > 1
    assert recorder.links[0].counts.lost > 0 or recorder.links[0].counts.messages > 50


def test_a_base_with_a_wrong_unit_of_time_is_stamped_with_arrivals_and_reported(tmp_path):
    spec = BASE[0], BASE[1] + "&time_unit=0.001"
    _, notes = record(tmp_path, {"odometry": spec}, 6.0, lambda url, clock: TalkingPort(clock))
    (note,) = [note for _, note in notes if note.name == "odometry-time-unit"]
    assert "time_unit=1" in note.text
    stamps = stamps_of(tmp_path / "run.log")
    assert stamps[-1] - stamps[0] == pytest.approx(6.0, abs=0.4)


class HostilePort:
    """Noise, half frames of its own answers, floods, nothing, and a cable that comes and goes."""

    def __init__(self, clock, rng, words):
        self._clock, self._rng, self._words = clock, rng, words
        self._until = clock() + rng.expovariate(0.5)

    def fileno(self):
        return None

    def _fail(self, share):
        if self._clock() > self._until or self._rng.random() < share:
            raise DeviceError("unplugged")

    def read(self):
        self._fail(0.0005)
        kind = self._rng.random()
        if kind < 0.5:
            return b""
        if kind < 0.51:
            return self._rng.randbytes(20_000)
        word = self._rng.choice(self._words)
        return word[: self._rng.randrange(len(word) + 1)] if kind < 0.8 else word

    def write(self, data):
        self._fail(0.02)

    def set_baud(self, rate):
        self._fail(0.01)

    def set_dtr(self, on):
        self._fail(0.01)

    def close(self):
        pass


@pytest.mark.parametrize("name", DEVICES)
def test_nothing_that_a_port_does_ends_a_recording(tmp_path, name):
    """Everything becomes an event: the run lasts as long as asked, the log is whole, and what it lacks is said."""
    rng = random.Random(name)
    words = [*WORDS.get(name, WORDS["line"]), b"\n", rng.randbytes(40)]

    def open_one(url, clock):
        if rng.random() < 0.3:
            raise DeviceError("cannot open")
        return HostilePort(clock, rng, words)

    options = "?columns=t,x,y,theta" if name == "line" else ""
    recorder, _ = record(tmp_path, {"it": (DEVICES[name].sensor, f"{name}:/dev/x{options}")}, 8.0, open_one)
    assert recorder.end - recorder.start < 8.1
    counts = recorder.links[0].counts
    assert counts.connects > 1
    assert sum(counts.corrupt.values()) > 10 or name in BOARDS  # boards print other lines too: these are ignored
    text = (tmp_path / "run.log").read_text()
    assert text.endswith("\n")
    assert "corrupt" in text.splitlines()[-1]
    lines = [line for line in text.splitlines() if line.startswith(("UWB ", "ODOM ", "GYRO ", "ROBOTLASER1 "))]
    stamps = [float(line.split()[-3]) for line in lines]
    assert all(recorder.start - 1.0 < stamp < recorder.end + 0.2 for stamp in stamps)


def test_a_bridge_that_is_not_there_is_one_clear_error():
    with pytest.raises(DeviceError, match="cannot open"):
        open_port("socket://127.0.0.1:1", 115200)


@pytest.mark.parametrize(("lost", "silent", "said"), [(5, 0.0, 0), (11, 0.0, 1), (5, 7.0, 1), (5, 5.0, 0)])
def test_a_tenth_of_the_messages_or_of_the_time_may_be_missing(lost, silent, said):
    """Of a hundred messages within a minute."""
    link = Link("lidar", "", None)
    link.counts = link_module.Counts(messages=100 - lost, lost=lost, silent_time=silent)
    assert len(link_module.doubts([link], 0.0, 60.0)) == said
