"""DWM1001, shell: real and constructed lines, glued prompts, cut lines."""

import random

import pytest
from emulators.dwm_device import DwmDevice, DwmOptions
from emulators.world import WorldClock
from helpers.driver_harness import check_transcript, feed_split, feed_whole, good

from uwblite.drivers import dwm1001_shell
from uwblite.drivers.dwm1001_shell import (
    PositionLine,
    Prompt,
    RangeLine,
    ShellProtocol,
    TextLine,
    node_facts,
)
from uwblite.drivers.dwm1001_tlv import NodeConfig, Status, UpdateRate, Value
from uwblite.drivers.events import Corrupt, RangeReading

RNG = random.Random(5)
NOISES = [b"", b"\x00", b"\xff\r\n", b"\x1b[1H", b"le", b"1H", b"DIST,4,AN0,12", b"POS,1.0", b"garbage\r\n", b"=[,]", b"\r\n",
          b"CD37[0.00,0.00,", *(bytes(b for b in RNG.randbytes(n)) for n in (1, 5, 40, 600))]  # fmt: skip

LES = b"0A1B[0.00,0.00,0.00]=2.80 C0DE[-1.00,3.99,0.00]=10.74 le_us=3387 est[1.90,-1.96,0.15,91] \r\n"
LES_BARE = b"0A1B[0.00,0.00,0.00]=2.80 C0DE[-1.00,3.99,0.00]=10.74\r\n"
ROWS = b"AN0,0A1B,0.00,0.00,0.00,2.80,AN1,C0DE,-1.00,3.99,0.00,10.74,AN2,F00D,1.00,2.00,3.00,4.56"
LEC = b"DIST,3," + ROWS + b",POS,1.90,-1.96,0.15,91\r\n"
LEC_BARE = b"DIST,1,AN0,0A1B,0.00,0.00,0.00,2.80\r\n"
TWO = (RangeReading("0A1B", 2.8, 100), RangeReading("C0DE", 10.74, 100))


def transcript():
    frames = [
        b"dwm> ", b"lec\r\n", b"dwm> ", LEC, LEC_BARE, LES, LES_BARE, b"POS,2.57,2.00,-1.67,97\r\n",
        b"POS,0,4D18,-1.31,0.17,0.39,47,x01\r\n", b"[000044.950 INF] uwb0: panid=xBACA addr=xDECADDF048951512\r\n",
    ]  # fmt: skip
    expected = [
        Prompt(), TextLine("lec"), Prompt(),
        RangeLine(1.0, (*TWO, RangeReading("F00D", 4.56, 100)), "lec"),
        RangeLine(1.0, TWO[:1], "lec"),
        RangeLine(1.0, TWO, "les"),
        RangeLine(1.0, TWO, "les"),
        PositionLine(),
        PositionLine(),
        TextLine("[000044.950 INF] uwb0: panid=xBACA addr=xDECADDF048951512"),
    ]  # fmt: skip
    return frames, expected


def test_transcript_in_every_split():
    frames, expected = transcript()
    check_transcript(ShellProtocol, frames, expected, [b""])


def test_transcript_among_noise():
    """Noise may eat an echo (it is only text), never a measurement or a prompt."""
    frames, expected = transcript()
    rng = random.Random(6)
    kinds = (RangeLine, PositionLine, Prompt)
    for _ in range(200):
        noisy = b"".join(part for f in frames for part in (rng.choice(NOISES), f)) + rng.choice(NOISES)
        events = [e for e in feed_split(ShellProtocol, noisy, rng) if isinstance(e, kinds)]
        assert events == [e for e in expected if isinstance(e, kinds)], noisy


@pytest.mark.parametrize(
    ("file", "good_lines", "bad_lines"), [("dwm_lec_lines.txt", 7, 2), ("dwm_les_lines.txt", 2, 0),
                                          ("dwm_les_seamk_static_5x4m.txt", 70, 0), ("dwm_lep_lines.txt", 3, 0)]
)  # fmt: skip
def test_captured_lines(shared_data, file, good_lines, bad_lines):
    lines = [line for line in (shared_data / "captures" / file).read_bytes().splitlines() if line[:1] != b"#"]
    assert len(lines) == good_lines + bad_lines
    events = [feed_whole(ShellProtocol, line + b"\r\n") for line in lines]
    assert sum(1 for got in events if good(got)) == good_lines
    assert sum(1 for got in events if not good(got) and isinstance(got[0], Corrupt)) == bad_lines
    frames = [line + b"\r\n" for line, got in zip(lines, events, strict=True) if good(got)]
    expected = [event for got in events for event in good(got)]
    check_transcript(ShellProtocol, frames, expected, [b"", b"\r\n", b"\xff\x00\r\n", b"1H"], splits=60)


def test_captured_static_ranges_have_the_stated_spread(shared_data):
    """Standard deviations 1.8 / 2.7 / 3.4 / 3.9 cm, lines of four anchors with changing order."""
    data = (shared_data / "captures" / "dwm_les_seamk_static_5x4m.txt").read_bytes()
    lines = feed_whole(ShellProtocol, data)
    by_anchor = {}
    for line in lines:
        assert len(line.readings) == 4
        for reading in line.readings:
            by_anchor.setdefault(reading.anchor_id, []).append(reading.range)
    spreads = []
    for values in by_anchor.values():
        mean = sum(values) / len(values)
        spreads.append((sum((v - mean) ** 2 for v in values) / len(values)) ** 0.5)
    assert sorted(100 * s for s in spreads) == pytest.approx([1.8, 2.7, 3.4, 3.9], abs=0.06)


def test_captured_node_info(shared_data):
    """What the shell says of a node is what the binary interface would have answered."""
    facts = node_facts((shared_data / "captures" / "dwm_shell_misc.txt").read_text().splitlines())
    assert [event for event in facts if isinstance(event, Value)][1:] == [
        Value("pan_id", 0xBACA), Value("firmware", 0x01030001)
    ]  # fmt: skip
    assert facts[0].value & 0xFFFF == 0x1512
    assert facts[3:] == [Status(0), NodeConfig(False, False, False, 0), UpdateRate(0.1, 0.1)]


@pytest.mark.parametrize(
    "line",
    [
        b"DIST,4,AN0,0090,0.00,0.00,0.00,3.25,AN1,D91E,0.00,0.00,0.00,3.33,AN3,15BA,0.00,0,AN3,15BA,0.00,0.00,0.00,0.00",
        b"1HDIST,1,AN0,5004,1.00,1.00,1.00,", b"DIST,0,AN0", b"DIST,1,AN0,5004,1.00,1.00,1.00,nan",
        b"DIST,5,AN0,5004,1.00,1.00,1.00,1.00",
        b"DIST,1,AN1,5004,1.00,1.00,1.00,1.00", b"DIST,2,AN0,5004,1.00,1.00,1.00,1.00,AN1,5004,1.00,1.00,1.00,1.00",
        b"DIST,1,AN0,5004,1.00,1.00,1.00,900.00", b"DIST,1,AN0,5004,1.00,1.00,1.00,1.00,POS,1.00,1.00,1.00,101",
        b"DIST,1,AN0,5004,1.00,1.00,1.00,1.00,POS,1.00,1.00", b"POS,nan,nan,nan,0", b"POS,1.00,2.00,3.00,400",
        b"0A1B[0.00,0.00,0.00]=2.8", b"0A1B[0.00,0.00,0.00]=nan",
    ],
)  # fmt: skip
def test_garbled_lines_are_rejected(line):
    assert [type(e) for e in feed_whole(ShellProtocol, line + b"\r\n")] == [Corrupt]


@pytest.mark.parametrize("nan", ["nan", "-nan"])
def test_ranges_beside_an_estimate_that_is_no_number_are_kept(nan):
    """The location engine does not converge where anchors are not surveyed; what was measured does not depend on it."""
    for line, source in ((LEC, "lec"), (LES, "les")):
        bad = line.decode().replace("1.90,-1.96,0.15,91", f"{nan},{nan},{nan},0").encode()
        (event,) = feed_whole(ShellProtocol, bad)
        (whole,) = feed_whole(ShellProtocol, line)
        assert (event.readings, event.source) == (whole.readings, source)


@pytest.mark.parametrize("line", [b"DIST,0\r\n", b"DIST,0,\r\n"])
def test_a_line_without_anchors_is_a_line(line):
    """A tag out of reach reports it; nothing was lost and nothing damaged."""
    assert feed_whole(ShellProtocol, line) == [RangeLine(1.0, (), "lec")]


def test_a_line_that_broke_off_does_not_take_the_next_one_with_it():
    for whole in (LES, LEC):
        for cut in range(1, len(whole) - 3):
            last = good(feed_whole(ShellProtocol, whole[:cut] + whole))[-1]
            assert isinstance(last, RangeLine)
            assert last == feed_whole(ShellProtocol, whole)[0]


def test_memory_is_bounded():
    protocol = ShellProtocol()
    for _ in range(3000):
        protocol.feed(b"DIST,4,AN0," * 100, 0.0)
        assert protocol._lines.pending <= dwm1001_shell.MAX_LINE


def test_the_emulated_shell_takes_lf_and_cr_lf_as_one_line_end():
    """RevEng_pydwm1001 sends LF alone; CR LF is one line end, not two (an empty line repeats the last command)."""
    for ending in (b"\r", b"\n", b"\r\n"):
        device = DwmDevice(iter(()), WorldClock(), DwmOptions(shell=True))
        device.power_up(0.0)
        answer = device.receive(b"apg" + ending, 1.0)
        assert answer.count(b"x:0 y:0") == 1
        assert answer.count(b"dwm> ") == 1
