"""LD06 packets: the maker's example, and damage."""

import pytest
from helpers.driver_harness import feed_whole

from uwblite.drivers.events import Corrupt
from uwblite.drivers.ldlidar import LdLidarProtocol, crc8

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
