"""LinkTrack and BU03 frames."""

import random

import pytest
from emulators.uwb_boards import BOARDS
from emulators.world import RoomWorld
from helpers.driver_harness import check_transcript, feed_whole, good

from uwblite.drivers.devices import open_device
from uwblite.drivers.events import Corrupt, Note
from uwblite.drivers.linktrack import Bu03Protocol, LinkTrackProtocol
from uwblite.drivers.uwb_line import MUCH

PROTOCOLS = {"linktrack": LinkTrackProtocol, "bu03": Bu03Protocol}
RNG = random.Random(4)
NOISES = [b"", b"\x55", b"\x55\x01", b"\x55\x04\x80\x00", b"\xaa", b"\xaa\x25", b"\xaa\x25\x01\x00",
          RNG.randbytes(7), RNG.randbytes(200)]  # fmt: skip


@pytest.mark.parametrize("name", PROTOCOLS)
def test_transcript_in_every_split_and_among_noise(name):
    epochs = RoomWorld().epochs()
    frames = [BOARDS[name](next(epochs), k, 100 * k) for k in range(12)]
    expected = good(feed_whole(PROTOCOLS[name], b"".join(frames)))
    assert len(expected) == 12
    check_transcript(PROTOCOLS[name], frames, expected, NOISES)


def test_bytes_that_a_user_shows():
    """A BU03 with two anchors in reach; the program beside these bytes reads 2.030 and 1.240 m."""
    ranges = bytes.fromhex("aa2501 ee070000 d8040000" + "00000000" * 6)
    for end in (b"\x5e\x55", ranges[:2]):  # firmware that ends a frame, and that begins the next one at once
        (event,) = feed_whole(Bu03Protocol, ranges + end)
        assert [(r.anchor_id, r.range) for r in event.content.readings] == [("0", 2.03), ("1", 1.24)]
    assert not good(feed_whole(Bu03Protocol, ranges + b"\x5e\x00"))


def test_negative_ranges_and_absent_anchors_are_none():
    frame = bytearray(BOARDS["linktrack"](next(RoomWorld().epochs()), 1, 5))
    frame[22:25], frame[25:28] = (-10).to_bytes(3, "little", signed=True), b"\0\0\0"
    frame[127] = sum(frame[:-1]) & 0xFF
    (event,) = feed_whole(LinkTrackProtocol, bytes(frame))
    assert "0" not in [r.anchor_id for r in event.content.readings]
    assert "1" not in [r.anchor_id for r in event.content.readings]


def test_every_single_damaged_byte_is_noticed():
    frame = BOARDS["linktrack"](next(RoomWorld().epochs()), 1, 5)
    for at in range(len(frame)):
        broken = bytearray(frame)
        broken[at] ^= 0x10
        assert all(isinstance(event, Corrupt) for event in feed_whole(LinkTrackProtocol, bytes(broken)))


def test_frames_without_ranges_are_reported():
    session = open_device("uwb", "linktrack:port")[0]
    session.start(0.0)
    frame = bytearray(128)
    frame[:2] = b"\x55\x01"
    notes = []
    for k in range(MUCH + 5):
        frame[108:112] = (20 * k).to_bytes(4, "little")
        frame[127] = sum(frame[:-1]) & 0xFF
        notes += [a for a in session.feed(bytes(frame), 0.02 * k) if isinstance(a, Note)]
    assert [note.name for note in notes] == ["uwb-no-ranges"]
