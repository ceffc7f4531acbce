"""DWM1001, binary interface: blocks in every shape, the vendor's examples, requests."""

import random
import struct

import pytest
from emulators.dwm_device import BANNER, DwmDevice, DwmOptions
from emulators.world import Epoch, WorldClock
from helpers.driver_harness import check_transcript, feed_whole, good

from uwblite.drivers.dwm1001_driver import Dwm1001Driver
from uwblite.drivers.dwm1001_tlv import Answer, Distances, NodeConfig, Status, TlvProtocol, UpdateRate, Value
from uwblite.drivers.events import RangeReading

POSITION = "4b0a00001f0400009c0e000064"
RNG = random.Random(2)
NOISES = [b"", b"\x00", b"\x40", b"\x40\x01", b"\x41\x0d", b"\x49\x51\x04", b"\x5a\x02", b"\r", b"app_error_print()\r\n",
          b"\x40\x01\x07", bytes.fromhex("400100410d4b0a"), *(RNG.randbytes(n) for n in (1, 3, 30, 300))]  # fmt: skip


def tag_block(readings):
    rows = b"".join(struct.pack("<HIBiiiB", a, d, q, 0, 3990, 0, 100) for a, d, q in readings)
    return bytes((0x49, 1 + len(rows), len(readings))) + rows


READINGS = [(0xCD37, 2801, 100), (0x1495, 2742, 98), (0x592F, 3600, 100), (0x5B01, 3700, 77)]
RANGES = tuple(RangeReading(f"{a:04X}", d / 1000, q) for a, d, q in READINGS)


def transcript():
    ok = bytes.fromhex("400100")
    frames = [
        ok + bytes.fromhex("5a020300"),
        ok + bytes.fromhex("410d" + POSITION) + tag_block(READINGS),
        ok + tag_block(READINGS[:1]),
        ok + bytes.fromhex("410d" + POSITION) + b"\x49\x01\x00",
        ok + b"\x48\x0e\x01" + struct.pack("<QIB", 0xDECA3F1A00001495, 12345, 90),
        ok + bytes.fromhex("450401006400"),
        ok + bytes.fromhex("46020704"),
        ok + bytes.fromhex("5004010003015104000701005204 2a00cade"),
        ok + bytes.fromhex("4d02caba"),
        ok + bytes.fromhex("4e081215950448f0cade"),
        bytes.fromhex("400101"),
    ]
    position = Value("position quality", 100)
    expected = [
        Answer(0), Status(3),
        Answer(0), position, Distances(RANGES),
        Answer(0), Distances(RANGES[:1]),
        Answer(0), position, Distances(()),
        Answer(0), Distances((RangeReading("1495", 12.345, 90),)),
        Answer(0), UpdateRate(0.1, 10.0),
        Answer(0), NodeConfig(anchor=False, stationary_detection=True, low_power=False, uwb_mode=3),
        Answer(0), Value("firmware", 0x01030001), Value("configuration", 0x00010700),
        Value("hardware", 0xDECA002A),
        Answer(0), Value("pan_id", 0xBACA),
        Answer(0), Value("node_id", 0xDECAF04804951512),
        Answer(1),
    ]  # fmt: skip
    return frames, expected


def blocks(events):
    """Noise may hold the head of an answer; what counts are the blocks."""
    return [event for event in good(events) if not isinstance(event, Answer)]


def test_transcript_whole_and_in_every_split():
    frames, expected = transcript()
    check_transcript(TlvProtocol, frames, expected, [b""])


def test_transcript_among_noise():
    frames, expected = transcript()
    rng = random.Random(3)
    for _ in range(200):
        noisy = b"".join(part for f in frames for part in (rng.choice(NOISES), f)) + rng.choice(NOISES)
        protocol, events, at = TlvProtocol(), [], 0
        while at < len(noisy):
            size = rng.choice([1, 2, 5, 30, 500])
            events += protocol.feed(noisy[at : at + size], 1.0)
            at += size
        assert blocks(events) == blocks(expected), noisy.hex()


def test_a_frame_cut_anywhere_does_not_take_the_next_one_with_it():
    long = bytes.fromhex("400100410d" + POSITION) + tag_block(READINGS)
    assert len(long) == 101
    follower = bytes.fromhex("4001005a020200")
    for cut in range(1, len(long)):
        events = blocks(feed_whole(TlvProtocol, long[:cut] + follower))
        assert events[-1] == Status(2), cut


def test_after_a_reset_nothing_that_was_half_received_counts():
    half, whole = b"\x40\x01\x00" + tag_block(READINGS)[:40], bytes.fromhex("4001005a020300")
    protocol = TlvProtocol()
    protocol.feed(half, 1.0)
    protocol.reset()
    assert protocol.feed(whole, 1.1) == feed_whole(TlvProtocol, whole)
    assert protocol.feed(tag_block(READINGS)[40:], 1.2) == TlvProtocol().feed(tag_block(READINGS)[40:], 1.2)


def test_position_may_be_missing_and_so_may_anchors():
    (_, event) = good(feed_whole(TlvProtocol, b"\x40\x01\x00" + tag_block(READINGS)))
    assert event.readings == RANGES
    (_, event) = good(feed_whole(TlvProtocol, b"\x40\x01\x00\x49\x01\x00"))
    assert event.readings == ()


@pytest.mark.parametrize("value", ["1300", "1000", "00ff", "0302"])
def test_status_bits_that_the_guide_does_not_name_are_no_damage(value):
    """Bit 4 is API_STATUS_FLAG_BH_INITIALIZED in the vendor's header; others may follow."""
    (status,) = blocks(feed_whole(TlvProtocol, bytes.fromhex("4001005a02" + value)))
    assert status.bits == int.from_bytes(bytes.fromhex(value), "little")


def test_the_head_of_an_answer_is_no_status():
    events = feed_whole(TlvProtocol, bytes.fromhex("4001005a02" + "4001"))
    assert not [event for event in events if isinstance(event, Status)]


@pytest.mark.parametrize("readings", [[(1, 300_000, 100)], [(1, 1000, 101)], [(7, 1000, 100), (7, 1000, 100)]])
def test_distances_that_no_module_sends_are_damage(readings):
    events = feed_whole(TlvProtocol, b"\x40\x01\x00" + tag_block(readings))
    assert not [event for event in events if isinstance(event, Distances)]


def test_memory_is_bounded():
    protocol = TlvProtocol()
    for k in range(900):
        protocol.feed(RNG.randbytes(997) if k % 3 else b"\x40\x01\x00\x49\xf1\x0c" * 100, 0.0)
        assert len(protocol.pending.data) < 800
        assert len(protocol.pending._marks) < 800


# ---- the emulator, against the guide


@pytest.fixture
def module():
    clock = WorldClock()
    device = DwmDevice(iter([Epoch(0.1, READINGS)]), clock, DwmOptions())
    device.power_up(0.0)
    clock.start(0.0)
    device.advance(1.0)
    return device


@pytest.mark.parametrize(
    ("request_bytes", "answer"),
    [
        ("3200", "4001005a020300"), ("0400", "400100450401000100"), ("2f00", "4001004d02caba"),
        ("0200", "400100410d" + "00" * 13),
        ("1500", "4001005004010003015104000701005204 2a00cade"), ("3000", "4001004e08121595 48f0ddcade"),
        ("ff00", "400101"), ("0c0101", "400103"), ("030401000000", "400103"), ("030401006400", "400100"), ("0b0100", "400105"),
    ],
)  # fmt: skip
def test_emulator_answers_as_the_guide_reports(module, request_bytes, answer):
    got = module.receive(bytes.fromhex(request_bytes), 2.0)
    assert got == bytes.fromhex(answer)


def test_emulator_clears_ready_by_reading_it_and_sends_101_bytes(module):
    assert module.receive(b"\x32\x00", 2.0)[5] & 1 == 1
    assert module.receive(b"\x32\x00", 2.1)[5] & 1 == 0
    answer = module.receive(b"\x0c\x00", 2.2)
    assert len(answer) == 101
    assert answer[:5] == bytes.fromhex("400100410d")
    assert answer[18:21] == bytes.fromhex("495104")


def test_emulator_answers_a_request_cut_by_the_gap_with_error_1(module):
    assert module.receive(b"\x32", 2.0) == b""
    assert module.advance(2.002) == b"\x40\x01\x01"
    assert module.receive(b"\r", 3.0) == b""
    assert module.advance(3.002) == b"\x40\x01\x01"


def test_emulator_opens_the_shell_by_two_returns(module):
    assert module.receive(b"\r\r", 2.0) == (BANNER + "dwm> ").encode()
    assert module.receive(b"quit\r", 3.0) == b"quit\r\n"
    assert module.receive(b"\r", 4.0) == b""
    assert module.advance(4.01) == b"\x40\x01\x01"
    assert b"dwm> " in module.receive(b"\r", 4.5)


def test_emulator_repeats_the_last_command_on_an_empty_line(module):
    module.receive(b"\r\r", 2.0)
    first = module.receive(b"nmg\r", 3.0)
    assert module.receive(b"\r", 4.0)[2:] == first[5:]


@pytest.mark.parametrize(("network", "shown", "said"), [(0, "0x0000", True), (0xBACA, "0xBACA", False), (None, None, False)])
def test_a_network_without_an_id_is_an_error(network, shown, said):
    driver = Dwm1001Driver()
    if network is not None:
        driver.values["pan_id"] = network
    identity = driver.identity()
    assert dict(identity.details).get("network") == shown
    assert ("no-network-id" in {note.name for note in identity.findings}) is said
