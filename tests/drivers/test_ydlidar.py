"""YDLIDAR packets: the maker's examples."""

import math

import pytest
from helpers.driver_harness import feed_whole, good

from uwblite.drivers.devices import open_device
from uwblite.drivers.events import Corrupt
from uwblite.drivers.slamtec import Reply
from uwblite.drivers.spinning import Samples
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


def test_a_reply_that_breaks_off_does_not_swallow_the_next_one():
    """Replies have no check: whole or byte by byte, the second one counts."""
    stream = bytes.fromhex("a55a1400000004 a55a0500004081") + bytes(20)
    whole, single = make(), make()
    events = [event for k in range(len(stream)) for event in single.feed(stream[k : k + 1], 1.0)]
    assert good(whole.feed(stream, 1.0)) == good(events) == [Reply(0x81, b"")]


@pytest.mark.parametrize("head", ["a55a1400004004", "a55a0300004006", "a55a1400008004"])
def test_an_answer_that_claims_to_be_a_stream_is_none(head):
    """One bit has turned over; what was asked for is not there, and the script goes on waiting for it."""
    whole = make()
    events = whole.feed(bytes.fromhex(head) + bytes(20), 1.0)
    assert good(events) == []
    session = open_device("lidar", "ydlidar-x4:/dev/null")[0]
    session.start(0.0)
    for k in range(40):
        session.feed(bytes.fromhex(head), 0.1 * k)
        session.tick(0.1 * k)
