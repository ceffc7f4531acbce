"""LDS-01 packets: both sums that are documented, and units that use another one."""

import struct

import pytest
from helpers.driver_harness import feed_whole

from uwblite.drivers.events import Corrupt, LaserScan
from uwblite.drivers.lds01 import TRUST, Lds01Driver, Lds01Protocol
from uwblite.drivers.spinning import Samples


def packet(number, rule, mm=1500):
    body = struct.pack("<BBH", 0xFA, 0xA0 + number, 3000) + struct.pack("<HHH", 700, mm, 0) * 6
    return body + bytes([rule(sum(body)) & 0xFF]) * 2


@pytest.mark.parametrize("rule", [lambda total: ~total, lambda total: total + 1])
def test_both_known_sums_are_taken_and_damage_is_not(rule):
    (samples,) = feed_whole(Lds01Protocol, packet(7, rule))
    assert samples.ranges == (1.5,) * 6
    assert [t * 360 for t in samples.turned] == pytest.approx(range(42, 48))
    assert samples.period == pytest.approx(0.2 / 360)
    broken = bytearray(packet(7, rule))
    broken[8] ^= 0x40
    assert all(isinstance(event, Corrupt) for event in feed_whole(Lds01Protocol, bytes(broken)))


def test_a_unit_with_another_sum_is_accepted_after_two_turns():
    protocol, taken = Lds01Protocol(), []
    for k in range(3 * TRUST):
        taken += [k for event in protocol.feed(packet(k % 60, lambda total: total + 77), 1.0) if isinstance(event, Samples)]
    assert taken == list(range(TRUST, 3 * TRUST))


def test_a_packet_before_a_gap_does_not_count():
    """Its end may be that of a later one: the sum of eight bits finds 127 of 128."""
    driver, scans, corrupt = Lds01Driver(), [], 0
    for k in range(4 * 60):
        if k % 60 == 31:
            continue
        mm = 900 if k % 60 == 30 else 1500
        for event in driver.protocol.feed(packet(k % 60, lambda total: ~total, mm), k / 300):
            actions = driver.take(event)
            scans += [action for action in actions if isinstance(action, LaserScan)]
            corrupt += sum(isinstance(action, Corrupt) for action in actions)
    assert (len(scans) >= 2, corrupt) == (True, 4)
    assert not any(reach == pytest.approx(0.9) for scan in scans for reach in scan.ranges)
