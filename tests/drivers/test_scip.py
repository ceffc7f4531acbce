"""SCIP: frames in every shape, codes, sums, commands."""

import gzip
import math
import random
import struct

import pytest
from emulators.scip_device import ScipDevice, ScipOptions, data_lines, encode
from emulators.world import RoomWorld, WorldClock
from helpers.driver_harness import check_transcript, feed_whole, good

from uwblite.drivers import scip, scip_commands
from uwblite.drivers.events import Corrupt
from uwblite.drivers.scip import Distances, Reply, ScipProtocol
from uwblite.drivers.scip_commands import Geometry, ScanRequest, parse_geometry
from uwblite.errors import ProtocolError

RNG = random.Random(1)
NOISES = [b"", b"\x00", b"\xff\xfe\n", b"\n", b"\r\n\r\n", b"MD0044", b"GD00440725\n", b"VV\n", b"0099b\n", b"00P\n\n", b"QT",
          b"MD0044072501000\n99b\n", *(RNG.randbytes(n) for n in (1, 3, 30, 200, 700))]  # fmt: skip
NOISES = [noise for noise in NOISES if not noise.endswith((b"QT",))]


def frame(command, status, *lines):
    head = status.encode() + bytes([scip.checksum(status.encode())])
    return b"\n".join([command.encode(), head, *lines, b"", b""])


def scan_frame(values, time=513, command="MD0044072501000", status="99", width=3):
    stamp = encode(time, 4)
    data = b"".join(encode(v, width) for v in values)
    return frame(command, status, stamp + bytes([scip.checksum(stamp)]), *data_lines(data))


def scan_values(seed=0, count=682):
    rng = random.Random(seed)
    return tuple(rng.choice([0, 6, 7, rng.randrange(20, 5600)]) for _ in range(count))


def transcript():
    values = [scan_values(i) for i in range(3)]
    frames = [
        b"SCIP2.0\n0\n\n",
        b"QT\nE\n\n",
        frame("QT", "00"),
        frame("VV", "00", b"VEND:Hokuyo Automatic Co.,Ltd.;[", b"PROT:SCIP 2.0;N"),
        frame("BM", "02"),
        frame("TM1", "00", encode(16000000, 4) + bytes([scip.checksum(encode(16000000, 4))])),
        frame("MD0044072501000", "00"),
        *(scan_frame(v, 100 * i) for i, v in enumerate(values)),
        scan_frame(values[0], 5, "GD0044072501", "00"),
        scan_frame([min(v, 4095) for v in values[1]], 6, "MS0044072501003", "99", 2),
    ]
    expected = [
        Reply(1.0, "SCIP2.0", "0"),
        Reply(1.0, "QT", "E"),
        Reply(1.0, "QT", "00"),
        Reply(1.0, "VV", "00", ("VEND:Hokuyo Automatic Co.,Ltd.", "PROT:SCIP 2.0")),
        Reply(1.0, "BM", "02"),
        Reply(1.0, "TM1", "00", ("16000000",)),
        Reply(1.0, "MD0044072501000", "00"),
        *(Distances(1.0, "MD", 100 * i, v, 44, 725, 1, 0) for i, v in enumerate(values)),
        Distances(1.0, "GD", 5, values[0], 44, 725, 1, 0),
        Distances(1.0, "MS", 6, tuple(min(v, 4095) for v in values[1]), 44, 725, 1, 3),
    ]
    return frames, expected


def test_transcript_in_every_split_and_among_noise():
    frames, expected = transcript()
    check_transcript(ScipProtocol, frames, expected, NOISES)


def test_numbers_of_the_specification():
    assert scip.decode_number(b"CB") == 1234
    assert scip.decode_number(b"m2@0") == 16000000


@pytest.mark.parametrize("status", ["00P", "99b", "02R", "0Ee", "0Bb", "10Q", "01Q"])
def test_status_sums_of_the_specification(status):
    assert chr(scip.checksum(status[:2].encode())) == status[2]


@pytest.mark.parametrize(
    ("name", "time", "zeros", "sixes", "sevens", "largest"),
    [("A", 513, 215, 140, 3, 5540), ("B", 4106836, 0, 0, 0, 178), ("C_ug01_fw3403", 11149560, 53, 24, 8, 5461)],
)
def test_captured_scans(shared_data, name, time, zeros, sixes, sevens, largest):
    data = (shared_data / "captures" / f"scip_gd_scan{name}.bin").read_bytes()
    assert len(data) == 2134
    (event,) = feed_whole(ScipProtocol, data)
    assert (event.time, len(event.values), max(event.values)) == (time, 682, largest)
    assert tuple(event.values.count(code) for code in (0, 6, 7)) == (zeros, sixes, sevens)
    assert min(v for v in event.values if v >= 20) >= 20
    noises = [b"", b"\xff\x00", b"MD0044\n", RNG.randbytes(300)]
    check_transcript(ScipProtocol, [data, data], [event, event], noises)


def test_captured_text_lines(shared_data):
    lines = (shared_data / "captures" / "scip_text_lines.txt").read_bytes().splitlines()
    lines = [line for line in lines if not line.startswith(b"#")]
    assert len(lines) == 24
    for line in lines:
        body, sum_char = line[:-2], line[-1]
        assert line[-2:-1] == b";"
        assert scip.checksum(body) == sum_char
    (vv,) = feed_whole(ScipProtocol, frame("VV", "00", *lines[5:10]))
    assert vv.fields()["PROD"] == "SOKUIKI Sensor URG-04LX"
    (pp,) = feed_whole(ScipProtocol, frame("PP", "00", *lines[10:18]))
    assert scip_commands.parse_geometry(pp) == Geometry()


def test_text_sums_are_never_fatal_and_an_extra_line_end_in_vv_is_taken():
    data = b"VV\n00P\nVEND:x;?\n\nSERI:H07;!\n\n"
    replies = good(feed_whole(ScipProtocol, data))
    fields = {key: value for reply in replies for key, value in reply.fields().items()}
    assert fields == {"VEND": "x", "SERI": "H07"}


@pytest.mark.parametrize(("command", "width", "values"), [
    ("GD0300030001", 3, (1234,)), ("GS0300030001", 2, (1234,)), ("GD0300032001", 3, tuple(range(100, 121))),
])  # fmt: skip
def test_a_scan_of_one_data_line_is_a_scan(command, width, values):
    data = scan_frame(values, 77, command, "00", width)
    assert len(data.split(b"\n")) == 4 + 2
    assert feed_whole(ScipProtocol, data) == [Distances(1.0, command[:2], 77, values, 300, 299 + len(values), 1, 0)]
    for clustered in (command, command[:-2] + "99"):
        without = frame(clustered, "00", data.split(b"\n")[2])
        assert all(isinstance(e, Corrupt) for e in feed_whole(ScipProtocol, without))


@pytest.mark.parametrize(("cluster", "counts"), [(10, (68, 69)), (11, (62,)), (68, (10, 11)), (99, (6, 7))])
def test_clusters_of_two_digits(cluster, counts):
    """682 steps; units send one value for the rest of the steps, or none."""
    for count in counts:
        values = scan_values(3, count)
        (event,) = feed_whole(ScipProtocol, scan_frame(values, 5, f"MD00440725{cluster}000"))
        assert event == Distances(1.0, "MD", 5, values, 44, 725, cluster, 0)
    for count in (min(counts) - 1, max(counts) + 1):
        events = feed_whole(ScipProtocol, scan_frame(scan_values(3, count), 5, f"MD00440725{cluster}000"))
        assert all(isinstance(e, Corrupt) for e in events)


def test_a_good_scan_may_hold_what_looks_like_another_reply():
    """A line of data that ends like the request QT, before a last line that is spelled like its status."""
    for filler in range(0x30, 0x70):
        line = bytes([filler]) + b"0" * 60 + b"QT;"
        if chr(scip.checksum(line)).isalnum():
            break
    data = line + b"00"
    assert scip._TEXT_ECHO.search(data_lines(data)[0])
    assert data_lines(data)[1] == b"00P"
    stamp = encode(9, 4)
    reply = frame("GD0300032101", "00", stamp + bytes([scip.checksum(stamp)]), *data_lines(data))
    (event,) = feed_whole(ScipProtocol, reply)
    assert event == Distances(1.0, "GD", 9, scip.decode_values(data, 3), 300, 321, 1, 0)


def test_text_that_ends_like_a_request_belongs_to_its_reply():
    lines = (b"VEND:Hokuyo;x", b"SERI:H07VV;B", b"00P", b"PROT:SCIP 2.0;N")
    (reply,) = feed_whole(ScipProtocol, frame("VV", "00", *lines))
    assert reply == Reply(1.0, "VV", "00", ("VEND:Hokuyo", "SERI:H07VV", "00P", "PROT:SCIP 2.0"))


@pytest.mark.parametrize("line", range(2, 35))
def test_one_damaged_line_costs_one_scan_and_no_more(line):
    first, second = scan_values(1), scan_values(2)
    lines = scan_frame(first).split(b"\n")
    lines[line] = lines[line][:-1] + bytes([lines[line][-1] ^ 1])
    events = feed_whole(ScipProtocol, b"\n".join(lines) + scan_frame(second, 600))
    assert good(events) == [Distances(1.0, "MD", 600, second, 44, 725, 1, 0)]


@pytest.mark.parametrize("cut", [5, 16, 20, 25, 100, 1000, 2100, 2132, 2133])
@pytest.mark.parametrize("next_frame", ["scan", "QT"])
def test_a_frame_cut_off_does_not_take_the_next_one_with_it(cut, next_frame):
    follower = scan_frame(scan_values(2), 600) if next_frame == "scan" else frame("QT", "00")
    events = good(feed_whole(ScipProtocol, scan_frame(scan_values(1))[:cut] + follower))
    assert events[-1] == feed_whole(ScipProtocol, follower)[0]


def test_the_arrival_of_noise_is_not_the_arrival_of_the_scan():
    protocol = ScipProtocol()
    protocol.feed(b"\xff\xff", 1.0)
    (event,) = good(protocol.feed(scan_frame(scan_values()), 5.0))
    assert event.stamp == 5.0


def test_memory_is_bounded():
    protocol = ScipProtocol()
    for _ in range(2000):
        protocol.feed(b"x" * 1000, 0.0)
        protocol.feed(b"MD0044072501000\n" if _ % 7 == 0 else b"abc\n", 0.0)
    assert protocol._lines.pending <= scip.MAX_LINE
    assert len(protocol._frame) <= scip.MAX_LINES + 1
    assert len(protocol._lines._pending._marks) <= scip.MAX_LINE + 2


def test_range_codes_become_rep_117():
    ranges = scip_commands.to_ranges((0, 6, 1, 7, 18, 19, 20, 1234, 5599, 5600, 9000), Geometry())
    assert ranges[:2] == (math.inf, math.inf)
    assert all(math.isnan(r) for r in ranges[2:6])
    assert ranges[6:] == (0.02, 1.234, 5.599, math.inf, math.inf)
    assert scip_commands.to_ranges((4094, 4095), Geometry(), 4095) == (4.094, math.inf)


def test_geometry_of_the_urg_04lx():
    unit = Geometry()
    assert unit.step_angle == pytest.approx(0.00613592, abs=1e-8)
    assert unit.step_time == pytest.approx(97.66e-6, abs=1e-8)
    assert (unit.first - unit.front) * unit.step_angle == pytest.approx(-2.0862, abs=1e-4)
    assert (unit.last - unit.front) * unit.step_angle == pytest.approx(2.0924, abs=1e-4)


def test_commands():
    assert ScanRequest().command(Geometry()) == b"MD0044072501000\n"
    assert ScanRequest(128, 640, 3, 2, wide=False).command(Geometry()) == b"MS0128064003200\n"
    for bad in ({"start": 0}, {"end": 800}, {"start": 300, "end": 200}, {"cluster": 100}, {"cluster": 0}, {"skip": 10}):
        with pytest.raises(ProtocolError):
            ScanRequest(**bad).command(Geometry())


@pytest.mark.parametrize(
    ("command", "status", "kind"),
    [
        ("MD0044072501000", "99", "ok"),
        ("MD0044072501000", "21", "paused"),
        ("MD0044072501000", "49", "paused"),
        ("MD0044072501000", "50", "hardware-fault"),
        ("MD0044072501000", "97", "hardware-fault"),
        ("MD0044072501000", "98", "resumed"),
        ("MD0044072501000", "04", "refused"),
        ("GD0044072501", "10", "refused"),
        ("QT", "0E", "refused"),
        ("QT", "E", "scip1"),
        ("TM0", "02", "ok"),
        ("SS115200", "02", "refused"),
        ("XX", "7Z", "refused"),
    ],
)
def test_status_codes_have_names(command, status, kind):
    got, text = scip_commands.status_meaning(command, status)
    assert got == kind
    assert text


def test_absurd_parameters_are_refused():
    lines = tuple(f"{k}:{v}" for k, v in (("DMIN", 20), ("DMAX", 10), ("ARES", 1024), ("AMIN", 44), ("AMAX", 725),
                                          ("AFRT", 384), ("SCAN", 600)))  # fmt: skip
    with pytest.raises(ProtocolError):
        scip_commands.parse_geometry(Reply(0.0, "PP", "00", lines))
    with pytest.raises(ProtocolError):
        scip_commands.parse_geometry(Reply(0.0, "PP", "00", lines[:3]))


# ---- the emulator, against the specification


@pytest.fixture
def unit():
    clock = WorldClock()
    device = ScipDevice(RoomWorld().scans(), clock, ScipOptions())
    device.power_up(0.0)
    clock.start(0.0)
    device.advance(0.5)
    return device


def status_of(answer):
    return answer.split(b"\n")[1]


@pytest.mark.parametrize(
    ("command", "status"),
    [
        (b"VV", b"00P"), (b"PP", b"00P"), (b"II", b"00P"), (b"BM", b"00P"), (b"QT", b"00P"), (b"RS", b"00P"),
        (b"TM0", b"00P"), (b"TM1", b"04T"), (b"TM2", b"03S"), (b"TM7", b"01Q"), (b"SS019200", b"03S"), (b"SS115200", b"00P"),
        (b"SS012345", b"02R"), (b"SSabcdef", b"01Q"), (b"CR00", b"03S"), (b"CR05", b"00P"), (b"CR44", b"02R"),
        (b"GD0044072501", b"10Q"), (b"MD0044072501000", b"00P"), (b"MDxx44072501000", b"01Q"), (b"MD00440xx501000", b"02R"),
        (b"MD004407250x000", b"03S"), (b"MD0044099901000", b"04T"), (b"MD0300020001000", b"05U"), (b"MD0044072501x00", b"06V"),
        (b"MD00440725010xx", b"07W"), (b"MD0044", b"0Cc"), (b"XX", b"0Ee"), (b"%ST", b"0Ee"), (b"SCIP2.0", b"0Ee"),
        (b"VV;toolongtoolongtoolong", b"0Gg"), (b"VV;bad!", b"0Hh"), (b"VV;good string", b"00P"),
    ],
)  # fmt: skip
def test_emulator_answers_each_command_as_the_manual_reports(unit, command, status):
    answer = unit.receive(command + b"\n", 1.0)
    assert answer.startswith(command + b"\n")
    assert status_of(answer) == status
    assert answer.endswith(b"\n\n")


def test_emulator_wakes_in_scip_1(unit):
    unit.options.scip1 = True
    unit.power_up(1.0)
    assert unit.receive(b"QT\n", 1.0) == b"QT\nE\n\n"
    assert unit.receive(b"SCIP2.0\n", 1.1) == b"SCIP2.0\n0\n\n"
    assert unit.receive(b"SCIP2.0\n", 1.2) == b"SCIP2.0\n0Ee\n\n"
    assert unit.receive(b"QT\n", 1.3) == b"QT\n00P\n\n"


def test_emulator_scan_is_2134_bytes_in_36_lines(unit):
    unit.receive(b"BM\n", 1.0)
    answer = unit.receive(b"GD0044072501\n", 1.1)
    assert len(answer) == 2134
    lines = answer.split(b"\n")[:-1]
    assert len(lines) == 36
    assert {len(line) for line in lines[3:34]} == {65}
    assert len(lines[34]) == 63


def test_emulator_counts_down_and_switches_the_laser_off(unit):
    unit.receive(b"MD0044072501003\n", 1.0)
    protocol = ScipProtocol()
    scans = [e for k in range(20) for e in protocol.feed(unit.advance(1.0 + 0.1 * k), 0.0) if isinstance(e, Distances)]
    assert [scan.remaining for scan in scans] == [2, 1, 0]
    assert status_of(unit.receive(b"GD0044072501\n", 4.0)) == b"10Q"


def test_emulator_refuses_the_second_of_equal_commands_in_a_batch(unit):
    assert unit.receive(b"VV\nVV\n", 1.0).count(b"0Bb") == 1


def test_emulator_in_time_adjust_mode_takes_nothing_else(unit):
    unit.receive(b"TM0\n", 1.0)
    assert status_of(unit.receive(b"QT\n", 1.1)) == b"0Ee"
    assert status_of(unit.receive(b"TM1\n", 1.2)) == b"00P"
    assert status_of(unit.receive(b"TM2\n", 1.3)) == b"00P"


def test_what_is_too_long_for_a_line_is_damage():
    events = feed_whole(ScipProtocol, b"z" * 5000 + b"\n")
    assert all(isinstance(e, Corrupt) for e in events)


def test_timed_capture_of_a_real_unit(shared_data):
    """A URG-04LX, firmware 3.1.04: chunks with their arrival. II tells the clock, and GD is stamped with it.

    The clock was read before the first byte of II's answer, so host time minus device time is at most the difference of
    these two, and the stamp of the scan lies at least 101 ms before its first byte.
    """
    data = gzip.decompress((shared_data / "captures" / "urg04lx_timed_fw3104.logr.gz").read_bytes())
    protocol, events, at = ScipProtocol(), [], 0
    while at < len(data):
        seconds, micros, size = struct.unpack_from(">III", data, at)
        events += protocol.feed(data[at + 12 : at + 12 + size], seconds + 1e-6 * micros)
        at += 12 + size
    assert not [event for event in events if isinstance(event, Corrupt)]
    assert [event.command for event in events] == ["VV", "VV", "PP", "II", "BM", "CR00", "VV", "PP", "II", "GD"]
    assert parse_geometry(events[2]) == Geometry()
    scan, info = events[-1], events[-2]
    assert 10 in scan.values
    offset = info.stamp - int(info.fields()["TIME"], 16) / 1000
    late = scan.stamp - (scan.time / 1000 + offset)
    assert 0.100 < late < 0.110


def test_emulator_measures_once_after_bm_without_a_stream():
    """BM answers 00 and switches the laser on; GD gives a scan then, as hokuyolx asks for it."""
    clock = WorldClock()
    device = ScipDevice(RoomWorld().scans(), clock)
    device.power_up(0.0)
    assert device.receive(b"GD0044072501\n", 0.5).split(b"\n")[1] == b"10Q"
    assert device.receive(b"BM\n", 0.6) == b"BM\n00P\n\n"
    (scan,) = good(ScipProtocol().feed(device.receive(b"GD0044072501\n", 0.7), 0.7))
    assert len(scan.values) == 682


@pytest.mark.parametrize("line", [b"m2@0x", b"m2@\x01k", b"m2@k"])
def test_a_time_that_is_damaged_is_none(line):
    good_line = encode(16000000, 4) + bytes([scip.checksum(encode(16000000, 4))])
    assert feed_whole(ScipProtocol, frame("TM1", "00", good_line)) == [Reply(1.0, "TM1", "00", ("16000000",))]
    assert feed_whole(ScipProtocol, frame("TM1", "00", line)) == [Corrupt("time with a wrong sum")]


def test_bytes_that_are_no_text_are_replaced_wherever_a_unit_prints_text():
    """Also behind an empty line in the middle of its answer."""
    data = frame("VV", "00", b"VEND:Hok\xffuyo;x") + b"SERI:H\xfe12;x\n\n"
    assert feed_whole(ScipProtocol, data) == [
        Reply(1.0, "VV", "00", ("VEND:Hok\ufffduyo",)), Reply(1.0, "VV", "00", ("SERI:H\ufffd12",)),
    ]  # fmt: skip
