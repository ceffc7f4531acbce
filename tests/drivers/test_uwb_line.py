"""UWB boards that print lines: what they say, what is refused, and ranges from their emulators."""

import random

import pytest
from emulators.uwb_boards import BOARDS, UwbBoard, slots
from emulators.world import Epoch, RoomWorld, WorldClock
from helpers.driver_harness import check_transcript, good, of_kind, simulate

from uwblite.drivers.devices import open_device
from uwblite.drivers.events import Corrupt, Lost, Note, RangeEpoch
from uwblite.drivers.text_lines import LineProtocol
from uwblite.drivers.uwb_line import BOARDS as FORMS
from uwblite.drivers.uwb_line import by_columns, sound_lines
from uwblite.errors import ConfigError

SPECS = {name: f"{name}:port" for name in BOARDS} | {
    "line": "line:port?columns=t,id,range,quality&prefix=UWB&unit=0.001&time_unit=0.001"
}
NUMBERED = ("makerfabs-at", "bu01", "bu03", "linktrack")
"""Boards that number their anchors."""
STEP = {"makerfabs": 0.01, "makerfabs-at": 0.01, "bu01": 0.01, "dwm3001": 0.01}
"""m in which they speak; the others in mm."""

REAL_LINES = {
    "makerfabs": ("from: 1782\t Range: 3.21 m\t RX power: -65.10 dBm", [("1782", 3.21)]),
    "makerfabs-at": (
        "AT+RANGE=tid:7,mask:0F,seq:128,range:(997,1321,911,738,0,0,0,0),ancid:(0,1,2,3,-1,-1,-1,-1)",
        [("0", 9.97), ("1", 13.21), ("2", 9.11), ("3", 7.38)],
    ),
    "bu01": ("an1:1.24m", [("1", 1.24)]),
    "dwm3001": (
        '{"Block":3948, "results":[{"Addr":"0x0001","Status":"Ok","D_cm":71,"LPDoA_deg":0.00,"LAoA_deg":0.00,"LFoM":0,'
        '"RAoA_deg":0.00,"CFO_100ppm":622},{"Addr":"0x0002","Status":"Err"},{"Addr":"0x0003","Status":"Ok","D_cm":-4}]}',
        [("0001", 0.71), ("0003", -0.04)],
    ),
    "dwm3001 later": (
        'SESSION_INFO_NTF: {session_handle=1, sequence_number=39, block_index=39, n_measurements=1 '
        '[mac_address=0x0001, status="SUCCESS", distance[cm]=71]}',
        [("0001", 0.71)],
    ),
    "dwm3001 with diagnosis": (
        'SESSION_INFO_NTF: {session_handle=1, sequence_number=0, block_index=0, n_measurements=1 [mac_address=0x0001, '
        'status="SUCCESS", distance[cm]=91, loc_az_pdoa=65.35, loc_az=24.90, rmt_el=13.59, RSSI[dBm]=-66.5]}',
        [("0001", 0.91)],
    ),
    "dwm3001 first row": (' [mac_address=0x0001, status="SUCCESS", distance[cm]=245];', [("0001", 2.45)]),
    "dwm3001 last row": (' [mac_address=0x0004, status="RX_TIMEOUT"]}', []),
    "dwm3001 head": ("SESSION_INFO_NTF: {session_handle=1, sequence_number=1, block_index=1, n_measurements=4", []),
    "bu01 in one line": ("an1:1.24m an3:2.50m", [("1", 1.24), ("3", 2.5)]),
    "makerfabs on ESP32 in colour": ("\x1b[0;32mfrom: 84\t Range: 0.55 m\t RX power: -inf dBm\x1b[0m", [("84", 0.55)]),
}  # fmt: skip
"""As users show them (sources in firmware_notes)."""


@pytest.mark.parametrize("name", REAL_LINES)
def test_lines_that_users_show(name):
    text, expected = REAL_LINES[name]
    (line,) = LineProtocol(FORMS[name.split()[0]]).feed(text.encode() + b"\r\n", 1.0)
    assert [(r.anchor_id, pytest.approx(r.range)) for r in line.content.readings] == expected


def test_older_at_firmware_reports_rssi_and_no_ids():
    text = "AT+RANGE=tid:1,mask:04,seq:63,range:(0,0,30,0,0,0,0,0),rssi:(0.00,0.00,-77.93,0.00,0.00,0.00,0.00,0.00)"
    (line,) = LineProtocol(FORMS["makerfabs-at"]).feed(text.encode() + b"\n", 1.0)
    assert [(r.anchor_id, r.range) for r in line.content.readings] == [("2", 0.3)]
    assert line.content.tag == "1"


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("makerfabs", "from: 1782 Range: 3.2"),
        ("makerfabs", "from: 1782\t Range: 3.21 m\t RX powor: -65.10 dBm"),
        ("makerfabs-at", "AT+RANGE=tid:7,mask:0F,seq:128,range:(997,1321"),
        ("bu01", "am1:1.24m"),
        ("bu01", "an1:1.24"),
        ("dwm3001", '{"Block":3948, "results":[{"Addr":"0x0001","Status":"Ok","D_cm":7 1}]}'),
        ("dwm3001", '{"Block":3948, "results":[{"Addr":"0x00G1","Status":"Ok","D_cm":71}]}'),
        ("dwm3001", '[mac_address=0x0001, status="SUCCESS", distance[cm]=2'),
    ],
)
def test_lines_that_are_not_whole_are_damage(name, line):
    assert isinstance(FORMS[name](line), str)


def test_a_line_that_names_an_anchor_twice_is_the_beginning_of_one_and_the_end_of_another():
    row = '{"Addr":"0x000%d","Status":"Ok","D_cm":%d}'
    line = '{"Block":3948, "results":[' + ",".join(row % pair for pair in ((1, 382), (2, 372), (1, 383))) + "]}"
    assert isinstance(sound_lines(FORMS["dwm3001"])(line), str)


@pytest.mark.parametrize("name", FORMS)
def test_transcript_in_every_split_and_among_noise(name):
    epochs = RoomWorld().epochs()
    lines = [line + b"\n" for k in range(12) for line in BOARDS[name](next(epochs), k, 100 * k).split(b"\n") if line.strip()]
    expected = good(LineProtocol(FORMS[name]).feed(b"".join(lines), 1.0))
    assert len(expected) >= 12
    noises = [b"", b"\n", b"\xff\xfe\n", b"from: 12\n", b"an1\n", b"boot: ok\r\n", random.Random(3).randbytes(40) + b"\n"]
    check_transcript(lambda: LineProtocol(FORMS[name]), lines, expected, noises)


def board(name):
    clock, fixes = WorldClock(), []
    clock.start(1000.0)
    write = BOARDS[name]
    return UwbBoard(RoomWorld().epochs(), clock, write, lambda at, readings: fixes.append((at, readings))), fixes


@pytest.mark.parametrize("name", SPECS)
def test_ranges_come_out_as_they_were_measured(name):
    device, fixes = board(name)
    session = open_device("uwb", SPECS[name])[0]
    rng = random.Random(1)
    actions, _ = simulate(session, device, 8.0, jitter=lambda: rng.expovariate(1000.0))
    assert not of_kind(actions, Corrupt)
    assert not of_kind(actions, Lost)
    got = {}
    for epoch in of_kind(actions, RangeEpoch):
        for reading in epoch.readings:
            got.setdefault(round((epoch.stamp - 1000.0) * 10), {})[reading.anchor_id] = (epoch.stamp, reading.range)
    fixes = fixes[1:-1]  # the first line is passed over
    for at, readings in fixes:
        row = got.get(round((at - 1000.0) * 10), {})
        expected = {f"{a:X}" if name == "makerfabs" else f"{a:04X}": mm for a, mm, _ in readings}
        if name in NUMBERED:
            expected = {str(i): mm for i, mm in enumerate(slots(Epoch(0.0, readings))) if mm}
        assert row.keys() == expected.keys()
        for anchor, (stamp, metres) in row.items():
            assert metres == pytest.approx(expected[anchor] / 1000, abs=STEP.get(name, 0.001) * 0.501)
            assert -0.0011 < stamp - at < 0.008  # clocks of 1 ms, 1 ms of jitter


@pytest.mark.parametrize(
    ("options", "line", "expected"),
    [
        ("id,range", "A1 2.5", [("A1", 2.5)]),
        ("-,range,id", "x;1.25;7", [("7", 1.25)]),
        ("t,range:N,range:S", "100,1.5,2.5", [("N", 1.5), ("S", 2.5)]),
        ("tag,id,range,quality", "0 9 3.0 250", [("9", 3.0)]),
    ],
)
def test_columns(options, line, expected):
    ranges = by_columns(options)(line)
    assert [(r.anchor_id, r.range) for r in ranges.readings] == expected
    assert all(r.quality == 100 for r in ranges.readings)


@pytest.mark.parametrize("line", ["A1", "A1 x", "A1 2.5 9", "A/1 2.5", "A1 nan", "A1 1e999"])
def test_lines_that_do_not_fit_are_damage(line):
    protocol = LineProtocol(by_columns("id,range"))
    (event,) = protocol.feed(line.encode() + b"\n", 1.0)
    assert isinstance(event, Corrupt)


@pytest.mark.parametrize("columns", ["range", "id", "id,range,range", "x,y", "t,range:"])
def test_columns_that_make_no_range_are_refused(columns):
    with pytest.raises(ConfigError, match="uwb line"):
        open_device("uwb", f"line:port?columns={columns}")


def test_what_is_no_range_is_refused_in_words_and_once():
    session = open_device("uwb", "makerfabs:port")[0]
    session.start(0.0)
    actions = session.feed(b"POS 0 0 0\n" + b"POS 1.0 2.0 3.0\n" * 5, 1.0)
    notes = [action for action in actions if isinstance(action, Note)]
    assert [note.name for note in notes] == ["uwb-no-ranges"]
    assert "two-way ranging" in notes[0].text
    assert not any(isinstance(action, RangeEpoch) for action in actions)


def test_ranges_of_other_tags_are_left_out_and_that_is_reported():
    session = open_device("uwb", "makerfabs-at:port")[0]
    session.start(0.0)
    line = "AT+RANGE=tid:{},mask:01,seq:1,range:({},0,0,0,0,0,0,0)\n"
    rounds = [(3, 50), (4, 200), (3, 100), (3, 101), (4, 201), (13, 300), (3, 102), (4, 203), (3, 104)]
    actions = [action for k, row in enumerate(rounds) for action in session.feed(line.format(*row).encode(), 0.1 * k)]
    assert [r.range for a in actions if isinstance(a, RangeEpoch) for r in a.readings] == [1.0, 1.01, 1.02, 1.04]
    assert [a.name for a in actions if isinstance(a, Note)] == ["uwb-other-tag"]
    assert [a.why for a in actions if isinstance(a, Corrupt)] == ["line of a tag that was seen once"] * 2  # the first 4, and 13


@pytest.mark.parametrize("name", ["dwm3001", "makerfabs-at"])
def test_rounds_that_are_numbered_are_missed(name):
    """Seven rounds lost in the middle; a digit damaged; the board switched off and on."""
    epoch = next(RoomWorld().epochs())
    times = [0, 1, 2, 3, 11, 12, 13, 14, 15, 16, 20, 21, 22]
    numbers = [0, 1, 2, 3, 11, 12, 13, 74, 15, 16, 0, 1, 2]
    if name == "makerfabs-at":  # its numbers wrap
        numbers = [248, 249, 250, 251, 3, 4, 5, 6, 7, 8, 0, 1, 2]
    session = open_device("uwb", f"{name}:port")[0]
    session.start(0.0)
    sent = zip(times, numbers, strict=True)
    actions = [a for t, n in sent for a in session.feed(BOARDS[name](epoch, n, 0), 0.1 * t)]
    assert [a.count for a in actions if isinstance(a, Lost)] == [7]


@pytest.mark.parametrize(("every", "off"), [(1, 36000), (3, 0)])
def test_rounds_are_missed_after_a_long_pause_and_on_a_link_that_loses_most(every, off):
    """The board was off for an hour, or two of three lines are lost: it counts no slower for that."""
    epoch = next(RoomWorld().epochs())
    times = [*range(0, 360, every), *range(378, 420, every)]
    later = [off * (t >= 180) for t in times]
    session = open_device("uwb", "makerfabs-at:port")[0]
    session.start(0.0)
    sent = ((t + by, (t - 180 * (by > 0)) % 256) for t, by in zip(times, later, strict=True))
    actions = [a for t, n in sent for a in session.feed(BOARDS["makerfabs-at"](epoch, n, 0), 0.1 * t)]
    assert 18 + every - 1 in [a.count for a in actions if isinstance(a, Lost)]
