"""Every spinning lidar: the same laws, on its emulator."""

import random

import pytest
from emulators.faults import FaultyLine, parse_fault
from emulators.spinning_device import FAR
from helpers.driver_harness import check_transcript, good
from helpers.lidar_bench import LIDARS, SPECS, LaserScan, emulator, frames, of_kind, range_errors, run, stamp_errors

from uwblite.drivers.devices import open_device
from uwblite.drivers.events import Corrupt, Lost, Note, Param, Reopen
from uwblite.drivers.spinning import Samples

RNG = random.Random(11)
NOISES = [b"", b"\x00", b"\xa5", b"\xa5\x5a", b"\xaa\x55", b"\xaa\x55\x00\x50", b"\x54\x2c", b"\xfa\xa0", b"\xfa\xdb\x00",
          b"\xa5\x5a\x54\x00\x00\x40", *(RNG.randbytes(n) for n in (1, 4, 33, 300))]  # fmt: skip

CORNER = 0.06
"""m; a ray between two readings on both sides of a corner: half a degree at 5 m, and as much again."""


def protocol_of(name):
    return open_device("lidar", SPECS[name])[0].driver.protocol


@pytest.mark.parametrize("name", LIDARS)
def test_transcript_in_every_split_and_among_noise(name):
    answers, groups = frames(name, 48)
    together = 16 if name == "rplidar-standard" else 1
    groups = [b"".join(groups[i : i + together]) for i in range(0, len(groups), together)]

    def make():
        protocol = protocol_of(name)
        for answer in answers:
            protocol.feed(answer, 0.0)
        return protocol

    expected = good(make().feed(b"".join(groups), 1.0))
    # A capsule is decoded when the next one has come, and the first two show how far apart they stand.
    assert len(expected) >= len(groups) - 2 * (name == "rplidar")
    assert all(isinstance(event, Samples) for event in expected)
    check_transcript(make, groups, expected, NOISES, splits=30)


@pytest.mark.parametrize("name", LIDARS)
def test_scans_are_right_in_range_and_time(name):
    """Turns of a length that varies by 2 %, jitter of 1 ms on the line; stamps within 2 ms, and readings within the
    1 mm that the lidars resolve."""
    rng = random.Random(3)
    actions, turns, _ = run(name, 3.5, device=emulator(name, wobble=0.02), jitter=lambda: rng.expovariate(1000.0))
    scans = of_kind(actions, LaserScan)
    assert len(scans) >= len(turns) - 3
    assert len({(len(s.ranges), s.angle_min, s.angle_increment, s.range_max) for s in scans}) == 1
    assert not of_kind(actions, Corrupt)
    assert not of_kind(actions, Lost)
    ahead = -FAR if name.startswith("ydlidar") else 0.0
    errors = stamp_errors(scans[5:], turns, ahead)
    assert sorted(map(abs, errors))[len(errors) // 2] < 0.001
    assert max(map(abs, errors)) < 0.002
    errors, unknown = range_errors(scans[5::12])
    assert max(errors) < CORNER
    assert sorted(errors)[len(errors) * 9 // 10] < 0.002
    assert unknown < 0.01


@pytest.mark.parametrize("name", LIDARS)
@pytest.mark.parametrize("fault", ["noise=0.0005", "drop=0.0005", "insert=0.0005", "garbage=300@2"])
def test_damage_costs_frames_but_invents_nothing(name, fault):
    actions, turns, _ = run(name, 2.5, line=FaultyLine([parse_fault(fault)], seed=5))
    scans = of_kind(actions, LaserScan)
    assert len(scans) > 0.6 * len(turns)
    assert of_kind(actions, Corrupt)
    errors, unknown = range_errors(scans, every=5)
    wrong = sum(error > CORNER for error in errors)
    # A node of a standard scan has no check of its range: each damaged byte may be a false reading.
    assert wrong <= (15 if name == "rplidar-standard" else 0)
    assert unknown < 0.25


@pytest.mark.parametrize("name", LIDARS)
def test_the_wrong_bit_rate_is_survived(name):
    actions, _, _ = run(name, 3.0, line=FaultyLine([parse_fault("baud")], seed=1))
    assert not of_kind(actions, LaserScan)


@pytest.mark.parametrize("name", LIDARS)
def test_a_silence_is_counted_and_the_stamps_hold(name):
    device, turns = emulator(name)
    line = FaultyLine([parse_fault("silent@2+1")])
    actions, turns, _ = run(name, 4.5, device=(device, turns), line=_Muted(line))
    scans = of_kind(actions, LaserScan)
    lost = sum(event.count for event in of_kind(actions, Lost))
    missing = sum(1 for turn in turns if 1002.0 < turn < 1003.0)
    assert abs(lost - missing) <= 2
    ahead = -FAR if name.startswith("ydlidar") else 0.0
    errors = stamp_errors([s for s in scans[5:] if abs(s.stamp - 1003.0) > 0.3], turns, ahead)
    assert max(map(abs, errors)) < 0.003


@pytest.mark.parametrize("name", LIDARS)
def test_a_silence_of_little_more_than_a_turn_is_no_part_of_one(name):
    """The motor stands as after a tenth of a turn: when it came there the readings do not tell."""
    _, turns, _ = run(name, 2.5)
    turn = turns[-1] - turns[-2]
    line = FaultyLine([parse_fault(f"silent@2+{1.1 * turn:.4f}")])
    actions, turns, _ = run(name, 4.0, line=_Muted(line))
    ahead = -FAR if name.startswith("ydlidar") else 0.0
    scans = [s for s in of_kind(actions, LaserScan)[5:] if not 1001.8 < s.stamp < 1002.5]
    assert max(map(abs, stamp_errors(scans, turns, ahead))) < 0.003
    assert 1 <= sum(event.count for event in of_kind(actions, Lost)) <= 3


class _Muted:
    """A line that lets nothing through while `silent` acts; what Plug does in tools/emulate.py."""

    def __init__(self, line):
        self._line = line

    def pass_on(self, data, time):
        return b"" if self._line.is_active("silent", time) else data


@pytest.mark.parametrize("name", LIDARS)
def test_replugged_it_goes_on_with_the_same_geometry(name):
    device, turns = emulator(name)
    session = open_device("lidar", SPECS[name])[0]
    first, _, _ = run(name, 4.0, device=(device, turns), session=session)
    second, _, _ = run(name, 4.0, device=(device, turns), session=session, start=1010.0)
    scans = [of_kind(actions, LaserScan) for actions in (first, second)]
    away = sum(scans[0][-1].stamp + 0.1 < turn < scans[1][0].stamp - 0.1 for turn in turns) + 6.0 / (turns[9] - turns[8])
    assert abs(sum(event.count for event in of_kind(second, Lost)) - away) < 12
    assert all(len(part) > 15 for part in scans)
    assert len({(len(s.ranges), s.angle_increment) for part in scans for s in part}) == 1
    ahead = -FAR if name.startswith("ydlidar") else 0.0
    assert max(map(abs, stamp_errors(scans[1][5:], turns, ahead))) < 0.002


@pytest.mark.parametrize("name", ["rplidar", "rplidar-standard", "ydlidar-x4"])
def test_a_stream_left_by_a_dead_host_is_stopped_first(name):
    device, turns = emulator(name)
    device.power_up(1000.0)
    device.receive({"ydlidar-x4": b"\xa5\x60"}.get(name, b"\xa5\x20"), 1000.0)
    device.power_up = lambda now: None  # it stayed on
    actions, _, _ = run(name, 5.0, device=(device, turns))
    scans = of_kind(actions, LaserScan)
    assert len(scans) > 20
    errors, _ = range_errors(scans[2:], every=7)
    assert max(errors) < CORNER


@pytest.mark.parametrize("name", ["rplidar", "ydlidar-x4"])
def test_model_and_health_are_reported(name):
    device, turns = emulator(name, health=b"\x02\x01\x00")
    session = open_device("lidar", SPECS[name])[0]
    actions, _, _ = run(name, 3.0, device=(device, turns), session=session)
    stated = {param.name: param.value for param in of_kind(actions, Param)}
    assert stated["laser_serial"] == bytes(range(16)).hex().upper()
    assert stated["laser_firmware"] == "1.29"
    assert [(note.level, note.name) for note in of_kind(actions, Note)] == [("error", "lidar-health")]
    assert session.driver.identity().findings


@pytest.mark.parametrize("name", ["rplidar", "ydlidar-x4"])
def test_who_does_not_answer_is_opened_again(name):
    device, turns = emulator(name)
    device.receive = lambda data, now: b""
    actions, _, reopens = run(name, 12.0, device=(device, turns))
    assert reopens >= 1
    assert not of_kind(actions, LaserScan)
    assert not of_kind(actions, Reopen)
