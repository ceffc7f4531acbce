"""Kobuki packets, resynchronisation, and odometry from them."""

import math
import random
from dataclasses import astuple, replace
from functools import reduce
from operator import xor

import pytest
from emulators.kobuki_device import KobukiDevice, encode_packet
from emulators.world import Pose, RoomWorld, WorldClock
from helpers.driver_harness import check_transcript, feed_whole, good

from uwblite.drivers import kobuki
from uwblite.drivers.events import Corrupt, Lost, Note, OdometryPose
from uwblite.drivers.kobuki import Feedback, KobukiDriver, KobukiProtocol

RNG = random.Random(7)
NOISES = [b"", b"\x00", b"\xaa", b"\xaa\x55", b"\xaa\x55\x4d", b"\xaa\x55\xff\x01\x0f", b"\xaa\x55\x4d\x01\x0f" + bytes(20),
          b"\x2d\xaa\x55\x4d\x01\x0f", *(RNG.randbytes(n) for n in (1, 5, 50, 400))]  # fmt: skip


def packets(count, seconds_before=0.0):
    device = KobukiDevice(iter([Pose(0.0, 0.0, 0.0, 0.0), Pose(10.0, 2.0, 0.0, 0.0)]), clock := WorldClock())
    clock.start(0.0)
    device.next_time(0.0)
    data = device.advance(seconds_before + 0.02 * count - 0.001)
    return [data[i : i + 81] for i in range(0, len(data), 81)]


def test_a_packet_is_81_bytes_and_begins_as_real_ones_do():
    (packet,) = packets(1)
    assert packet[:5] == bytes.fromhex("aa554d010f")
    assert len(packet) == 81


def test_transcript_in_every_split_and_among_noise():
    frames = packets(20)
    expected = feed_whole(KobukiProtocol, b"".join(frames))
    assert len(expected) == 20
    assert [event.time for event in expected] == [20 * k for k in range(20)]
    check_transcript(KobukiProtocol, frames, expected, NOISES)


def test_a_packet_cut_anywhere_does_not_take_the_next_one_with_it():
    for seed in range(40):
        rng = random.Random(seed)
        subs = [(0x01, rng.randbytes(15)), (0x04, rng.randbytes(7)), (0x10, rng.randbytes(16))]
        first, second = encode_packet(subs), packets(3)[2]
        for cut in range(1, len(first)):
            events = good(feed_whole(KobukiProtocol, first[:cut] + second))
            assert events[-1] == feed_whole(KobukiProtocol, second)[0], (seed, cut)


def test_the_sum_covers_the_length():
    (packet,) = packets(1)
    broken = bytearray(packet)
    broken[-1] ^= broken[2]  # what a driver that leaves the length out would expect
    assert all(isinstance(e, Corrupt) for e in feed_whole(KobukiProtocol, bytes(broken)))


BASIC = "010f34120502000201feff10200000a500"
"""4660 ms; bumpers right and left; left wheel dropped; encoders 258 and 65534; ... 16.5 V; currents."""
INERTIA = "0407d8dcd204000000"
"""-90.00 degrees, 12.34 degrees per second, three bytes that mean nothing."""
OTHERS = ["0303112233", "0506010203040506", "06020102", "0d0e0006" + "00" * 12, "1010" + "00" * 16]
"""Docking infra-red, cliff voltages, motor currents, raw gyro, inputs and outputs: the rest of what the base streams."""


@pytest.mark.parametrize("others", [[], OTHERS, OTHERS[::-1], *([other] for other in OTHERS)])
def test_a_packet_byte_by_byte_of_the_protocol_description(others):
    payload = bytes.fromhex("".join([BASIC, INERTIA, *others]))
    packet = b"\xaa\x55" + bytes([len(payload)]) + payload
    (event,) = feed_whole(KobukiProtocol, packet + bytes([reduce(xor, packet[2:])]), 7.0)
    assert (event.stamp, event.time, event.left, event.right) == (7.0, 4660, 258, 65534)
    assert (event.wheel_drop, event.battery) == (2, 16.5)
    assert event.heading == pytest.approx(-math.pi / 2)
    assert event.turn_rate == pytest.approx(math.radians(12.34))


@pytest.mark.parametrize("damage", ["shorter", "longer", "cut"])
def test_parts_that_do_not_fill_the_packet_exactly_are_no_packet(damage):
    """The sum is right, the length of the last part is not."""
    last = {"shorter": "0301112233", "longer": "0305112233", "cut": "03"}[damage]
    payload = bytes.fromhex(BASIC + INERTIA + last)
    packet = b"\xaa\x55" + bytes([len(payload)]) + payload
    events = feed_whole(KobukiProtocol, packet + bytes([reduce(xor, packet[2:])]))
    assert not good(events)


def test_gyro_of_any_length_and_packets_without_inertia_are_taken():
    basic = (1).to_bytes(2, "little") + bytes(3) + (7).to_bytes(2, "little") + (9).to_bytes(2, "little") + bytes(6)
    data = encode_packet([(0x01, basic), (0x0D, bytes(2 + 8))]) + encode_packet([(0x01, basic), (0x77, b"xyz")])
    events = feed_whole(KobukiProtocol, data)
    assert [(e.left, e.right, e.heading) for e in events] == [(7, 9, None)] * 2


def feedback(k, left, right, heading=0.0, stamp=None):
    return Feedback(k * 0.02 if stamp is None else stamp, 20 * k % 65536, left % 65536, right % 65536, heading, 0.0, 0, 16.0)


def drive(packets, start=(0.0, 0.0, 0.0)):
    """Return what a driver makes of packets."""
    driver = KobukiDriver(start)
    return [action for packet in packets for action in driver.take(packet)]


def poses(actions):
    return [action for action in actions if isinstance(action, OdometryPose)]


def test_encoders_wrap_both_ways():
    pose = poses(drive(feedback(k, tick, tick) for k, tick in enumerate([65000, 65500, 300, 900, 100, 65200])))[-1]
    assert pose.x == pytest.approx((65200 - 65000) * kobuki.TICK)
    assert pose.y == 0.0


def test_speed_is_the_way_by_the_time_that_it_took():
    """A packet every 20 ms, one of them lost: the way of two is of 40 ms."""
    speeds = [pose.speed for pose in poses(drive(feedback(k, 50 * k, 50 * k) for k in (0, 1, 2, 4, 5)))]
    assert speeds[1:] == pytest.approx([50 * kobuki.TICK / 0.02] * 4)


def test_gyro_heading_is_relative_to_the_first_and_wraps():
    pose = poses(drive((feedback(k, 0, 0, h) for k, h in enumerate((3.0, 3.1, -3.1, -3.0))), (1.0, 2.0, 0.5)))[-1]
    assert pose.theta == pytest.approx(0.5 + (2 * math.pi - 6.0))
    assert (pose.x, pose.y) == (1.0, 2.0)


def test_without_gyro_the_encoders_turn():
    quarter = math.pi / 2 * kobuki.WHEEL_BASE / 2 / kobuki.TICK
    ticks = [round(quarter * k / 20) for k in range(21)]
    pose = poses(drive(feedback(k, -tick, tick, None) for k, tick in enumerate(ticks)))[-1]
    assert pose.theta == pytest.approx(math.pi / 2, abs=1e-3)
    assert pose.x == pytest.approx(0.0, abs=1e-4)


def test_lost_packets_are_counted_and_repeated_ones_dropped():
    actions = drive([feedback(0, 0, 0), feedback(1, 10, 10), feedback(1, 10, 10), feedback(5, 50, 50)])
    assert [action.count for action in actions if isinstance(action, Lost)] == [3]
    assert [action.why for action in actions if isinstance(action, Corrupt)] == ["packet sent twice"]
    assert len(poses(actions)) == 3


@pytest.mark.parametrize("seconds", [3.0, 5.0, 20.0])
def test_over_a_gap_the_heading_holds_and_the_travel_is_reported_to_be_unknown(seconds):
    """The gyro's angle is absolute. A gap of 5 s at 0.2 m/s is 1.0 m: the smaller of the travels that fit the counters."""
    k, ticks = round(seconds / 0.02), round(0.2 * seconds / kobuki.TICK)
    actions = drive([feedback(0, 65000, 65000, 0.3), feedback(k, 65000 + ticks, 65000 + ticks, 1.1)])
    pose = poses(actions)[-1]
    assert pose.theta == pytest.approx(0.8)
    assert math.hypot(pose.x, pose.y) == pytest.approx(0.2 * seconds if seconds < kobuki.MAX_GUESS else 0.0, abs=1e-3)
    assert [note.name for note in actions if isinstance(note, Note)] == ["odometry-gap"] * (seconds > kobuki.MAX_BLIND)
    assert sum(action.count for action in actions if isinstance(action, Lost)) == k - 1


def test_a_base_that_was_switched_on_again_holds_its_pose():
    actions = drive([feedback(100, 700, 700, 1.0), feedback(101, 900, 900, 1.0), feedback(0, 5, 5, 0.0, stamp=9.0),
                     feedback(1, 105, 105, 0.0, stamp=9.02)])  # fmt: skip
    last, again, pose = poses(actions)[-3:]
    assert (again.x, again.y, again.theta) == (last.x, last.y, last.theta)
    assert pose.x - again.x == pytest.approx(100 * kobuki.TICK)
    assert [note.name for note in actions if isinstance(note, Note)] == ["odometry-gap"]
    assert pose.stamp == pytest.approx(9.02)


def test_a_base_whose_counts_leap_further_than_wheels_turn_holds_its_pose():
    """Its clock and its counts begin again, from no zero."""
    actions = drive([feedback(500, 20000, 20000), feedback(501, 20040, 20040), feedback(0, 4000, 4000, stamp=10.04),
                     feedback(1, 4040, 4040, stamp=10.06)])  # fmt: skip
    last, again, pose = poses(actions)[-3:]
    assert (again.x, again.y, again.theta) == (last.x, last.y, last.theta)
    assert pose.x - again.x == pytest.approx(40 * kobuki.TICK)
    assert [note.name for note in actions if isinstance(note, Note)] == ["odometry-gap"]


def test_a_base_whose_clock_leaps_while_its_wheels_count_on_did_not_restart():
    """20 s of packets are lost, after 20 s in which the link held back those before: the base drives on at 0.2 m/s."""
    step = 0.2 * 0.02 / kobuki.TICK
    first = [feedback(k, 9000 + round(step * k), 9000 + round(step * k), 0.0) for k in range(50)]
    late = [feedback(k, 9000 + round(step * k), 9000 + round(step * k), 0.0, stamp=1 + 1e-3 * k) for k in range(1000, 1050)]
    actions = drive([*first, *late])
    assert not [note for note in actions if isinstance(note, Note) and "restarted" in note.text]
    assert poses(actions)[-1].x - poses(actions)[50].x == pytest.approx(0.2 * 0.02 * 49, abs=0.01)


def test_a_part_that_comes_twice_counts_once():
    """Damage whose sum is right by chance makes another part out of two; the basic data have their length by the head."""
    (packet,) = packets(1)
    for size in (0, 5, 15):
        (event,) = feed_whole(KobukiProtocol, encode_packet([(0x01, packet[5:20]), (0x01, bytes(range(100, 100 + size)))]))
        assert (event.left, event.right) == (0, 0)


FALSE = {
    "wheels": lambda p: replace(p, left=(p.left + 20000) % 65536),
    "gyro": lambda p: replace(p, heading=p.heading + 2.0),
    "clock ahead": lambda p: replace(p, time=(p.time + 3000) % 65536),
    "clock behind": lambda p: replace(p, time=(p.time - 500) % 65536),
}


@pytest.mark.parametrize("at", [0, 30])
@pytest.mark.parametrize("what", FALSE)
def test_one_false_packet_changes_no_pose_and_no_stamp(what, at):
    """Its sum is right, as of one in 256 that are damaged."""
    sound = [feedback(k, 100 * k, 90 * k, 0.01 * k) for k in range(60)]
    false = [*sound[:at], FALSE[what](sound[at]), *sound[at + 1 :]]
    expected, actions = poses(drive(sound)), drive(false)
    if at:
        del expected[at]
        for pose, true in zip(poses(actions), expected, strict=True):
            assert astuple(pose)[:4] == pytest.approx(astuple(true)[:4], abs=1e-6)
    assert [action.why for action in actions if isinstance(action, Corrupt)] == ["packet that leaps away and back"]
    assert [action.count for action in actions if isinstance(action, Lost)] == [1] * (at > 0)


def test_parts_of_any_length_are_skipped_by_their_length():
    """Controller info (15) has 13 bytes in kobuki_core, 21 in the protocol description; both are passed over."""
    (packet,) = packets(1)
    subs = [(0x01, packet[5:20])]
    for extra in ([(0x15, bytes(13))], [(0x15, bytes(21))], [(0x10, bytes(4))], [(0x7E, b"")], [(0x04, b"\1")]):
        (event,) = feed_whole(KobukiProtocol, encode_packet([*subs, *extra]))
        assert (event.left, event.heading) == (0, None)


@pytest.mark.parametrize("skew", [0.0, 1e-4])
def test_odometer_follows_the_emulated_circle(skew):
    """Two minutes of circling: encoders and gyro are rounded to 0.09 mm and 0.01 degrees, the path is 24 m."""
    world, clock = RoomWorld(), WorldClock()
    truth = []
    device = KobukiDevice(
        world.poses(), clock, clock_start=65000, clock_skew=skew, on_packet=lambda t, x, y, a: truth.append((t, x, y, a))
    )
    clock.start(100.0)
    driver, errors, stamps = KobukiDriver((0.0, -1.5, 0.0)), [], []
    now, rng = 100.0, random.Random(0)
    while now < 220.0:
        for event in driver.parse(device.advance(now), now + rng.expovariate(1000.0)):
            for pose in driver.take(event):
                true = truth.pop(0)
                errors.append(math.hypot(pose.x - true[1], pose.y - true[2]))
                stamps.append(abs(pose.stamp - true[0]))
        now = device.next_time(now)
    assert max(errors) < 0.01
    assert max(stamps[1000:]) < 0.002


def test_the_emulator_reports_versions_and_gains_once_to_hosts_that_ask():
    """Requests 09 (flags 1 hardware, 2 firmware, 8 serial number) and 0E, as kobuki_core sends them, in two pieces."""
    device = KobukiDevice(iter([Pose(0.0, 0.0, 0.0, 0.0), Pose(10.0, 2.0, 0.0, 0.0)]), clock := WorldClock())
    clock.start(0.0)
    device.next_time(0.0)
    wanted = encode_packet([(0x09, b"\x0b\x00")]) + encode_packet([(0x0E, b"\x00")])
    for piece in (wanted[:5], wanted[5:]):
        assert device.receive(piece, 0.0) == b""
    sizes = {}
    packet = device.advance(0.0)
    at = 3
    while at < len(packet) - 1:
        sizes[packet[at]] = packet[at + 1]
        at += 2 + packet[at + 1]
    assert {0x0A: 4, 0x0B: 4, 0x13: 12, 0x15: 13}.items() <= sizes.items()
    (event,) = feed_whole(KobukiProtocol, packet)
    assert isinstance(event, Feedback)
    assert len(device.advance(0.021)) == 81
