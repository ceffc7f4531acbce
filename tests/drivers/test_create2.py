"""Create 2: frames of the stream, and odometry from them."""

import math
import random
from itertools import pairwise

import pytest
from emulators.kobuki_device import Create2Device
from emulators.world import Pose, RoomWorld, WorldClock
from helpers.driver_harness import check_transcript, feed_whole, of_kind, simulate

from uwblite.drivers.create2 import MODULUS, TICK, WHEEL_BASE, Create2Driver, Create2Protocol, Encoders, WheelOdometer
from uwblite.drivers.devices import open_device
from uwblite.drivers.events import Corrupt, Lost, Note, OdometryPose

RNG = random.Random(2)
NOISES = [b"", b"\x13", b"\x13\x0b", b"\x13\x0b\x07\x00\x2b", b"\x2b\x00\x00", RNG.randbytes(3), RNG.randbytes(90)]


def emulated(world=None, **options):
    clock, sent = WorldClock(), []
    clock.start(1000.0)
    poses = (world or RoomWorld()).poses()
    return Create2Device(poses, clock, on_packet=lambda *pose: sent.append(pose), **options), sent


def frames(count):
    device, _ = emulated()
    device.power_up(1000.0)
    device.receive(b"\x80", 1000.0)
    device.receive(bytes((148, 4, 7, 43, 44, 22)), 1000.0)
    return [device.advance(device.next_time(1000.0)) for _ in range(count)]


def test_transcript_in_every_split_and_among_noise():
    transcript = frames(20)
    assert {len(frame) for frame in transcript} == {14}
    expected = feed_whole(Create2Protocol, b"".join(transcript))
    assert len(expected) == 20
    check_transcript(Create2Protocol, transcript, expected, NOISES)


def test_a_frame_by_hand():
    """13h, 11 bytes: no bumps, left 513, right 65534, 15.8 V; all bytes together are 0 modulo 256."""
    body = bytes((0x13, 11, 7, 0x08, 43, 2, 1, 44, 255, 254, 22, 0x3D, 0xB8))
    (event,) = feed_whole(Create2Protocol, body + bytes([-sum(body) & 0xFF]))
    assert (event.left, event.right, event.wheel_drop, event.voltage) == (513, 65534, 2, 15.8)


def test_every_single_damaged_byte_is_noticed():
    (frame,) = frames(1)
    for at in range(len(frame)):
        for bit in (0x01, 0x80):
            broken = bytearray(frame)
            broken[at] ^= bit
            assert all(isinstance(event, Corrupt) for event in feed_whole(Create2Protocol, bytes(broken)))


def test_wheels_wrap_both_ways_and_turn():
    odometer = WheelOdometer(TICK, WHEEL_BASE, MODULUS, (0.0, 0.0, 0.0))
    for tick in (65000, 200, 65400):
        odometer.update(tick, tick)
    assert odometer.pose[0] == pytest.approx(400 * TICK)
    quarter = math.pi / 2 * WHEEL_BASE / 2 / TICK
    odometer = WheelOdometer(TICK, WHEEL_BASE, MODULUS, (0.0, 0.0, 0.0))
    odometer.update(0, 0)
    odometer.update(-round(quarter) % MODULUS, round(quarter))
    assert odometer.pose[2] == pytest.approx(math.pi / 2, abs=0.005)
    assert math.hypot(*odometer.pose[:2]) < 1e-3


def test_it_asks_for_the_stream_and_follows_the_circle():
    """Ticks of 0.44 mm, heading by the wheels alone: within 3 mm of the emulated circle in a minute.

    Besides the 12 mm that the robot drove before its stream began.
    """
    rng = random.Random(0)
    device, sent = emulated()
    actions, _ = simulate(Create2Driver((0.0, -1.5, 0.0)), device, 60.0, jitter=lambda: rng.expovariate(500.0))
    poses = of_kind(actions, OdometryPose)
    assert len(poses) > 3900
    assert not of_kind(actions, Corrupt)
    assert not of_kind(actions, Lost)
    truth = {round(at, 3): (x, y, theta) for at, x, y, theta in sent}
    errors, late = [], []
    for pose in poses[200:]:
        at = round(1000.0 + 0.015 * round((pose.stamp - 1000.0) / 0.015), 3)
        x, y, theta = truth[at]
        errors.append(max(math.hypot(pose.x - x, pose.y - y), abs(math.remainder(pose.theta - theta, 2 * math.pi))))
        late.append(abs(pose.stamp - at))
    assert max(errors) < 0.2 * 0.06 + 0.003
    assert max(late) < 0.003
    # Speeds, over the time from frame to frame, which comes 2 ms of 15 late, are the way and the turn.
    steps = [(math.dist((a.x, a.y), (b.x, b.y)), math.remainder(b.theta - a.theta, 2 * math.pi)) for a, b in pairwise(poses)]
    way, turn = map(sum, zip(*steps, strict=True))
    assert 0.015 * sum(pose.speed for pose in poses) == pytest.approx(way, rel=0.1)
    assert 0.015 * sum(pose.turn_rate for pose in poses) == pytest.approx(turn, rel=0.1)


def test_a_robot_that_fell_asleep_is_woken_and_its_gap_reported():
    class Still:
        def poses(self):
            yield Pose(0.0, 0.0, 0.0, 0.0)
            yield Pose(1e6, 0.0, 0.0, 0.0)

    device, _ = emulated(Still())
    receive, received = device.receive, []

    def sleepy(data, now):
        received.append((now, data))
        return receive(data, now) if not 1005.0 < now < 1012.0 else b""

    device.receive = sleepy
    session_actions, _ = simulate(Create2Driver(), _Asleep(device), 20.0)
    assert sum(data == b"\x80" for _, data in received) > 3
    assert sum(event.count for event in of_kind(session_actions, Lost)) == pytest.approx(7 / 0.015, rel=0.2)
    assert not of_kind(session_actions, Note)  # shorter than an encoder may take to turn by half its range


class _Asleep:
    """A robot that stops to stream by itself at 1005 s."""

    def __init__(self, device):
        self._device, self._slept = device, False

    def __getattr__(self, name):
        return getattr(self._device, name)

    def advance(self, now):
        if now > 1005.0 and not self._slept:
            self._slept, self._device.streaming, self._device.awake = True, False, False
        return self._device.advance(now)


def test_counts_that_begin_again_are_no_motion():
    """The robot was switched off and on: its counts are zero, and 3.7 m backwards in 3 s are more than it can drive."""
    driver = Create2Driver()
    driver.take(Encoders(1000.0, 8000, 8400, 0, 15.8))
    (before,) = of_kind([(0.0, action) for action in driver.take(Encoders(1000.015, 8464, 8900, 0, 15.8))], OdometryPose)
    actions = driver.take(Encoders(1003.0, 0, 0, 0, 15.8))
    assert [type(action) for action in actions] == [Lost, Note, OdometryPose]
    assert (actions[-1].x, actions[-1].y) == (before.x, before.y)
    *_, after = driver.take(Encoders(1003.015, 10, 10, 0, 15.8))
    assert math.hypot(after.x - before.x, after.y - before.y) == pytest.approx(10 * TICK)


def test_it_streams_whatever_packets_a_host_asks_for():
    """As libcreate does: sensors of one and of two bytes, 29 packets a frame."""
    words = (22, 23, 25, 26, 43, 44, *range(46, 52))
    packets = bytes((7, 8, 9, 10, 11, 12, 13, 15, 17, 18, 21, 22, 23, 24, 25, 26, 35, 43, 44, 45, *range(46, 54), 58))
    device, _ = emulated()
    device.power_up(1000.0)
    device.receive(b"\x80" + bytes((148, len(packets))) + packets, 1000.0)
    frame = device.advance(device.next_time(1000.0))
    sizes = [2 if packet in words else 1 for packet in packets]
    assert (frame[0], frame[1], len(frame)) == (19, len(packets) + sum(sizes), len(packets) + sum(sizes) + 3)
    assert sum(frame) % 256 == 0
    places = [2 + sum(sizes[:k]) + k for k in range(len(packets))]
    assert bytes(frame[place] for place in places) == packets


def test_the_bit_rate_can_be_said():
    assert [open_device("odometry", f"create2:port{more}")[0].baud for more in ("", "?baud=19200")] == [115200, 19200]
