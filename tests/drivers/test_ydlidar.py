"""YDLIDAR packets: the maker's examples."""

import math

import pytest
from helpers.driver_harness import feed_whole

from uwblite.drivers.events import Corrupt
from uwblite.drivers.sweep import Samples
from uwblite.drivers.ydlidar import YdLidarProtocol, _correction

MANUAL = bytes.fromhex("aa55010153ae53aeab540000")
"""Example of the communication protocol: first packet of a turn, one reading, at 0xAE53, no range."""


def make():
    return YdLidarProtocol(5000.0)


def test_the_protocols_example():
    (samples,) = feed_whole(make, MANUAL)
    assert isinstance(samples, Samples)
    assert math.isnan(samples.ranges[0])
    for at in range(len(MANUAL)):
        broken = bytearray(MANUAL)
        broken[at] ^= 0x04
        assert all(isinstance(event, Corrupt) for event in feed_whole(make, bytes(broken)))


@pytest.mark.parametrize(("mm", "degrees"), [(1000.0, -6.7622), (8000.0, -7.8374)])
def test_the_corrections_that_the_protocol_computes(mm, degrees):
    assert _correction(mm) * 360 == pytest.approx(degrees, abs=1e-3)
