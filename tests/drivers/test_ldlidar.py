"""LD06 packets: the maker's example, and damage."""

import math
from dataclasses import replace

import pytest
from helpers.driver_harness import feed_whole

from uwblite.drivers.events import Corrupt, LaserScan
from uwblite.drivers.ldlidar import READINGS, LdLidarDriver, LdLidarProtocol, crc8
from uwblite.drivers.spinning import Samples

MANUAL = bytes.fromhex(
    "542c6808ab7e e000e4 dc00e2 d900e5 d500e3 d300e4 d000e9 cd00e4 ca00e2 c700e9 c500e5 c200e5 c000e5 be823a1a50"
)
"""Example of the LD19 development manual: 2152 degrees/s, 324.27 to 334.70 degrees, 224 mm first, 6714 ms."""


def test_the_manuals_example():
    (samples,) = feed_whole(LdLidarProtocol, MANUAL)
    assert crc8(MANUAL[:-1]) == 0x50
    assert samples.ranges == tuple(mm / 1000 for mm in (224, 220, 217, 213, 211, 208, 205, 202, 199, 197, 194, 192))
    assert samples.turned[0] * 360 == pytest.approx(324.27)
    assert samples.turned[-1] * 360 == pytest.approx(334.70)
    assert samples.clock == 6714
    assert samples.period == pytest.approx((334.70 - 324.27) / 11 / 2152)


def test_every_single_damaged_byte_is_noticed():
    for at in range(len(MANUAL)):
        for bit in (0x01, 0x10, 0x80):
            broken = bytearray(MANUAL)
            broken[at] ^= bit
            assert all(isinstance(event, Corrupt) for event in feed_whole(LdLidarProtocol, bytes(broken)))


def packets(count, speed=3600.0):
    """Return packets of a motor that turns ten times a second, 5 ms old when they arrive."""
    period, turned = 1 / 4500, speed / 360 / 4500
    for k in range(count):
        places = tuple((k * READINGS + i) * turned % 1.0 for i in range(READINGS))
        time = ((k + 1) * READINGS - 1) * period
        yield Samples(100.0 + time + 0.005, round(1000 * time) % 30000, period, places, places, (2.0,) * READINGS)


def of(kind, actions):
    return [action for action in actions if isinstance(action, kind)]


@pytest.mark.parametrize("milliseconds", [300, 7000, -300])
def test_one_false_time_moves_no_scan(milliseconds):
    """The CRC is right, as of one in 256 packets that are damaged; the clock's envelope would keep such a time for minutes."""
    driver, actions = LdLidarDriver(), []
    for k, packet in enumerate(packets(2000)):
        false = replace(packet, clock=(packet.clock + milliseconds) % 30000) if k == 400 else packet
        actions += driver.take(false)
    assert [item.why for item in of(Corrupt, actions)] == ["packet whose time leaps away and back"]
    scans = of(LaserScan, actions)
    assert len(scans) == math.floor(2000 * READINGS / 450) - 1
    for scan in scans:
        # A clock of 1 ms; what stands before the first byte, 5 ms, is the device's own delay.
        assert math.remainder(scan.stamp - 100.005, 0.1) == pytest.approx(0.0, abs=2e-3)


def test_a_lidar_that_was_switched_on_again_goes_on():
    driver, actions = LdLidarDriver(), []
    for k, packet in enumerate(packets(2000)):
        actions += driver.take(packet if k < 1000 else replace(packet, clock=(packet.clock + 4000) % 30000))
    assert not of(Corrupt, actions)
    stamps = [scan.stamp for scan in of(LaserScan, actions)]
    assert stamps == sorted(stamps)
    assert len(stamps) > 2000 * READINGS / 450 - 4
    assert all(math.remainder(stamp - 100.005, 0.1) == pytest.approx(0.0, abs=2e-3) for stamp in stamps)
