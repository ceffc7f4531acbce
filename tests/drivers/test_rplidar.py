"""RPLIDAR: requests, replies, capsules and nodes by hand."""

import math
import struct
from functools import reduce
from operator import xor

import pytest
from helpers.driver_harness import feed_whole
from helpers.lidar_bench import LaserScan, emulator, of_kind, run

from uwblite.drivers.events import Corrupt
from uwblite.drivers.rplidar import EXPRESS, EXPRESS_REPLY, HEALTH, STANDARD_REPLY, STOP, RpLidarProtocol, motor
from uwblite.drivers.slamtec import Reply


def test_requests_are_those_of_the_manual():
    assert STOP == b"\xa5\x25"
    assert HEALTH == b"\xa5\x52"
    assert bytes.fromhex("a58205000000000022") == EXPRESS
    assert motor(660) == bytes.fromhex("a5f0029402c1")


def test_the_health_reply_of_the_manual():
    (reply,) = feed_whole(RpLidarProtocol, bytes.fromhex("a55a0300000006000000"))
    assert (reply.kind, reply.payload) == (6, b"\0\0\0")


def capsule(first, ranges, offsets=(0,) * 32):
    body = struct.pack("<H", first)
    for k in range(0, 32, 2):
        words = [ranges[k + j] << 2 | offsets[k + j] >> 4 for j in (0, 1)]
        body += struct.pack("<HHB", *words, (offsets[k] & 15) | (offsets[k + 1] & 15) << 4)
    total = reduce(xor, body)
    return bytes((0xA0 | total & 15, 0x50 | total >> 4)) + body


def express():
    protocol = RpLidarProtocol()
    protocol.feed(bytes.fromhex("a55a5400004082"), 0.0)
    return protocol


def test_a_capsule_lies_between_its_angle_and_the_next_less_the_offsets():
    """Readings every half degree from 10 degrees on; the third one is offset by 2.5 degrees, 20/8."""
    offsets = [0, 0, 20] + [0] * 29
    stream = [capsule((10 + 16 * k) * 64, [1000 + i for i in range(32)], offsets) for k in range(4)]
    events = express().feed(b"".join(stream), 1.0)
    assert len(events) == 2  # the first two say how far apart capsules stand, the last one waits
    samples = events[0]
    assert [b * 360 for b in samples.turned] == pytest.approx([26 + 0.5 * i for i in range(32)])
    assert samples.bearings[2] * 360 == pytest.approx(26 + 1.0 - 2.5)
    assert samples.ranges == pytest.approx([1.0 + i / 1000 for i in range(32)])


def test_a_lost_capsule_is_not_stretched_over_its_gap():
    stream = [capsule((16 * k) % 360 * 64, [2000] * 32) for k in range(12)]
    del stream[6]
    spans = [(s.turned[-1] - s.turned[0]) % 1.0 * 360 for s in express().feed(b"".join(stream), 1.0)]
    assert len(spans) == 11 - 1 - 1 - 1
    assert spans == pytest.approx([15.5] * len(spans))


def test_every_single_damaged_byte_of_a_capsule_is_noticed():
    whole = [capsule(16 * k * 64, [2000] * 32) for k in range(5)]
    expected = express().feed(b"".join(whole), 1.0)
    for at in range(84):
        broken = bytearray(whole[2])
        broken[at] ^= 0x20
        events = express().feed(b"".join([*whole[:2], bytes(broken), *whole[3:]]), 1.0)
        assert any(isinstance(event, Corrupt) for event in events)
        assert all(isinstance(event, Corrupt) or event in expected for event in events)


def test_nodes_are_accepted_sixteen_in_a_row():
    protocol = RpLidarProtocol()
    protocol.feed(bytes.fromhex("a55a0500004081"), 0.0)
    nodes = [struct.pack("<BHH", 0x3E, (64 * k) << 1 | 1, 4 * 1500 if k else 0) for k in range(16)]
    assert protocol.feed(b"".join(nodes[:15]), 1.0) == []
    (samples,) = protocol.feed(nodes[15], 1.0)
    assert [t * 360 for t in samples.turned] == pytest.approx(list(range(16)))
    assert math.isnan(samples.ranges[0])
    assert samples.ranges[1:] == (1.5,) * 15


def test_replies_report_which_stream_comes():
    for text, kind in (("a55a5400004082", EXPRESS_REPLY), ("a55a0500004081", STANDARD_REPLY)):
        (reply,) = feed_whole(RpLidarProtocol, bytes.fromhex(text))
        assert reply == Reply(kind, b"")


def test_firmware_without_express_scan_is_read_in_standard_scan():
    device, turns = emulator("rplidar")
    device.COMMANDS = {code: reply for code, reply in device.COMMANDS.items() if code != 0x82}
    actions, turns, reopens = run("rplidar", 4.0, device=(device, turns))
    assert not reopens
    assert len(of_kind(actions, LaserScan)) > 5


def test_the_emulator_reports_its_scan_modes_to_hosts_that_ask():
    """The maker's SDK asks units from firmware 1.24 on (GET_LIDAR_CONF) and does not scan without an answer."""
    device, _ = emulator("rplidar")
    device.power_up(0.0)

    def ask(entry, mode=None):
        body = struct.pack("<I", entry) + (b"" if mode is None else struct.pack("<H", mode))
        whole = b"\xa5\x84" + bytes([len(body)]) + body
        reply = device.receive(whole + bytes([reduce(xor, whole)]), 0.0)
        assert reply[:7] == b"\xa5\x5a" + struct.pack("<IB", len(reply) - 7, 0x20)
        assert reply[7:11] == body[:4]
        return reply[11:]

    assert (ask(0x70), ask(0x7C)) == (b"\2\0", b"\1\0")
    assert [ask(0x75, mode) for mode in (0, 1)] == [bytes([STANDARD_REPLY]), bytes([EXPRESS_REPLY])]
    assert [ask(0x7F, mode) for mode in (0, 1)] == [b"Standard\0", b"Express\0"]
    assert struct.unpack("<I", ask(0x71, 1)) == (250 * 256,)
