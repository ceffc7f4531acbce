"""Frames that a link held back get the arrivals that they would have had."""

import itertools
import random
from dataclasses import dataclass

import numpy as np
import pytest
from device_trials import trial
from emulators.kobuki_device import Create2Device, KobukiDevice
from emulators.uwb_boards import BOARDS, UwbBoard
from emulators.world import RoomWorld, WorldClock
from helpers.driver_harness import of_kind, simulate

from uwblite.drivers.backlog import Backlog
from uwblite.drivers.create2 import Create2Driver
from uwblite.drivers.devices import open_device
from uwblite.drivers.events import Corrupt, Lost, Note, OdometryPose, RangeEpoch
from uwblite.drivers.kobuki import KobukiDriver


@dataclass(frozen=True)
class Frame:
    stamp: float
    number: int


CUT = Corrupt("cut")


def passed(arrivals, spacing, others=(), members=lambda number: (), other=CUT):
    """Return the frames, in the order in which they pass, of these arrivals, s; and when each passed.

    `others` : numbers of the frames behind which an `other` event comes.
    """
    backlog, out, times = Backlog(), [], []
    for number, now in enumerate(arrivals):
        while (due := backlog.deadline()) is not None and due < now:
            out += (ready := backlog.due(due))
            times += [due] * len(ready)
        ready = backlog.take(Frame(now, number), now, spacing, members(number))
        if number in others:
            ready += backlog.take(other, now, None)
        out, times = out + ready, times + [now] * len(ready)
    ready = backlog.release()
    return out + ready, times + [arrivals[-1]] * len(ready)


def held(sent, begin, end):
    """Return when frames arrive that are held back from `begin` to `end`, s."""
    return [end if begin < time < end else time for time in sent]


@pytest.mark.parametrize("spacing", [0.02, 0.0])
@pytest.mark.parametrize("pause", [0.3, 6.0, 60.0])
def test_frames_that_fill_a_pause_stand_on_their_rhythm(pause, spacing):
    rng = random.Random(0)
    sent = [0.02 * k for k in range(100 + round(pause / 0.02) + 100)]
    arrivals = [time + rng.uniform(0.0, 0.004) for time in held(sent, 2.0, 2.0 + pause)]
    out, _ = passed(sorted(arrivals), spacing)
    assert [frame.number for frame in out] == list(range(len(sent)))
    assert all(a.stamp <= b.stamp for a, b in itertools.pairwise(out))
    most = 0.025 if spacing else 0.01 * pause + 0.025
    assert max(abs(frame.stamp - time) for frame, time in zip(out, sent, strict=True)) < most


def test_a_link_that_drains_slowly_is_waited_for():
    """Ten times as fast as the device sends, as by a bit rate; a lump that comes in two halves, the second soon or later."""
    sent = [0.015 * k for k in range(800)]
    for drain in (lambda k: 4.5 + 0.0015 * (k - 101), lambda k: 4.5 + 0.03 * (k > 300), lambda k: 4.5 + 0.09 * (k > 200)):
        arrivals = [time if time < 1.5 else max(time, drain(k)) for k, time in enumerate(sent)]
        out, _ = passed(arrivals, 0.015)
        assert max(abs(frame.stamp - time) for frame, time in zip(out, sent, strict=True)) < 0.02


@pytest.mark.parametrize("spacing", [0.1, 0.0])
def test_silence_stays_silence(spacing):
    """The device sent nothing: every frame keeps its arrival, and waits for half a second at most."""
    arrivals = [0.1 * k for k in (*range(50), *range(90, 140))]
    out, times = passed(arrivals, spacing)
    assert [frame.stamp for frame in out] == pytest.approx(arrivals)
    assert max(time - frame.stamp for frame, time in zip(out, times, strict=True)) <= 0.5


def test_a_pause_that_is_filled_in_part_ends_with_its_frames():
    sent = [0.1 * k for k in (*range(50), *range(80, 140))]
    out, _ = passed(held(sent, 5.0, 11.0), 0.1)
    assert max(abs(frame.stamp - time) for frame, time in zip(out, sent, strict=True)) < 0.101


@pytest.mark.parametrize("spacing", [0.1, 0.0])
@pytest.mark.parametrize("other", [CUT, "an answer"])
def test_frames_of_a_pause_before_a_break_go_on_from_those_before_it(spacing, other):
    """A buffer overflows and keeps the first ones, or the stream is begun anew; without that nothing shows which were lost."""
    sent = [0.1 * k for k in (*range(80), *range(115, 170))]
    arrivals = held(sent, 4.95, 11.45)
    out = [frame for frame in passed(arrivals, spacing, (79,), other=other)[0] if isinstance(frame, Frame)]
    assert max(abs(frame.stamp - time) for frame, time in zip(out, sent, strict=True)) < 0.11
    out, _ = passed(arrivals, spacing)
    assert out[79].stamp > 11.3


def test_rounds_that_come_as_several_lines_are_no_pause_and_fill_one():
    """A board prints four lines in every round of 0.1 s."""
    sent = [0.1 * (k // 4) for k in range(1200)]
    out, _ = passed(sent, 0.0)
    assert [frame.stamp for frame in out] == pytest.approx(sent)
    out, _ = passed(held(sent, 20.05, 22.05), 0.0)
    assert max(abs(frame.stamp - time) for frame, time in zip(out, sent, strict=True)) < 0.11
    # With the anchors of the lines each stands in its round; that one of them is missing now and then changes nothing.
    for lines in (range(1200), [k for k in range(1200) if k % 4 or k % 12]):
        times = [sent[k] + 0.01 * (k % 4) for k in lines]
        out, _ = passed(held(times, 20.05, 26.05), 0.0, members=lambda number, lines=lines: (f"A{lines[number] % 4}",))
        assert max(abs(frame.stamp - time) for frame, time in zip(out, times, strict=True)) < 0.015


def test_what_is_no_frame_keeps_its_place_and_waits_only_behind_frames():
    out, _ = passed([0.0, 0.1, 0.2, 2.0, 2.0, 2.1, 2.2, 2.3, 2.4], 0.1, others=(1, 3))
    assert [getattr(item, "number", "other") for item in out] == [0, 1, "other", 2, 3, "other", 4, 5, 6, 7, 8]
    assert Backlog().take("other", 1.0, None) == ["other"]


def test_a_frame_before_bytes_that_are_all_damaged_does_not_wait_for_ever():
    backlog, out = Backlog(), []
    for time in (0.0, 0.1, 9.0):
        out += backlog.take(Frame(time, 0), time, 0.1)
    assert [frame.stamp for frame in out] == [0.0, 0.1]
    for k in range(300):
        out += backlog.take(CUT, 9.0 + 0.01 * k, None)
    assert [event.stamp for event in out if isinstance(event, Frame)] == [0.0, 0.1, 9.0]
    assert (out.count(CUT), backlog.deadline()) == (300, None)


def test_many_frames_do_not_wait_for_ever(monkeypatch):
    monkeypatch.setattr("uwblite.drivers.backlog.MOST", 4096)
    backlog, count = Backlog(), 0
    for k in range(5000):
        count += len(backlog.take(Frame(0.0 if k == 0 else 5.0, k), 5.0, 0.02))
    assert count > 4000


@pytest.mark.parametrize("what", ["pause", "stop"])
@pytest.mark.parametrize("seconds", [0.3, 6.0, 20.0])
@pytest.mark.parametrize("kind", [Create2Device, KobukiDevice])
def test_a_base_loses_nothing_in_a_pause_and_did_not_restart(kind, seconds, what):
    """A link that holds the bytes back for long makes a Create 2 be asked for its stream again, which costs nothing."""
    rng, sent, clock = random.Random(1), [], WorldClock()
    clock.start(1000.0)
    device = kind(RoomWorld().poses(), clock, on_packet=lambda *pose: sent.append(pose))
    driver = Create2Driver((0.0, -1.5, 0.0)) if kind is Create2Device else KobukiDriver((0.0, -1.5, 0.0))
    actions, _ = simulate(driver, device, 15.0 + seconds, jitter=lambda: rng.expovariate(1000.0), **{what: (8.0, seconds)})
    assert not [action for _, action in actions if isinstance(action, Lost | Note | Corrupt)]
    poses = of_kind(actions, OdometryPose)
    assert len(poses) >= len(sent) - 10
    measured, true = np.array([(pose.stamp, pose.x, pose.y) for pose in poses]), np.array(sent)[:, :3]
    after = np.searchsorted(true[:, 0], measured[:, 0]).clip(1, len(true) - 1)
    nearest = after - (measured[:, 0] - true[after - 1, 0] < true[after, 0] - measured[:, 0])
    off = np.abs(measured - true[nearest])
    assert off[:, 0].max() < 0.008
    assert off[:, 1:].sum(axis=1).max() < 0.03


@pytest.mark.parametrize("name", ["scip", "shell", "rplidar", "ydlidar-x4", "lds01"])
def test_what_comes_while_a_device_is_started_again_counts(name):
    """A link that holds the bytes back for long makes it be started again, and then hands on all that it had sent."""
    row = trial(name, "pause-6", 16.0)
    assert row["false"] == 0
    assert row["missing"] <= row["lost"] <= (10 if name == "shell" else 1)  # rounds during which its stream was off
    assert row["worst ms"] < 8.0


@pytest.mark.parametrize(("name", "turns"), [("lds01", 3), ("ydlidar-x4", 4)])
def test_whole_turns_that_are_lost_move_no_scan(name, turns):
    """The motor stands where it would stand had none been lost."""
    row = trial(name, "mute-0.6", 12.0)
    assert row["false"] == 0
    assert row["lost"] == turns
    assert row["worst ms"] < 2.0


@pytest.mark.parametrize("board", ["makerfabs", "bu01", "makerfabs-at", "bu03"])
def test_rounds_of_a_board_without_a_clock_stand_at_their_times(board):
    clock, sent = WorldClock(), []
    clock.start(1000.0)
    device = UwbBoard(RoomWorld().epochs(), clock, BOARDS[board], lambda t, rows: sent.append(t))
    actions, _ = simulate(open_device("uwb", f"{board}:port")[0].driver, device, 30.0, stop=(15.0, 6.0))
    stamps = [epoch.stamp for epoch in of_kind(actions, RangeEpoch)]
    assert len(set(stamps)) >= len(sent) - 2
    assert max(min(abs(stamp - time) for time in sent) for stamp in stamps) < 0.02
    if board in ("makerfabs-at", "bu03"):  # one line a round
        assert min(b - a for a, b in itertools.pairwise(stamps)) > 0.05
