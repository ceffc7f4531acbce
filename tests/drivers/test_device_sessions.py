"""Sessions against emulated devices in simulated time: start-up from every state, recovery, clocks, damage."""

import itertools
import math
import random

import pytest
from emulators.dwm_device import DwmDevice, DwmOptions
from emulators.faults import FaultyLine, parse_fault
from emulators.hokuyo import MODELS, Unit, captured, model
from emulators.scip_device import ScipDevice, ScipOptions
from emulators.world import Epoch, Scan, WorldClock
from helpers.driver_harness import of_kind, simulate

from uwblite.drivers.dwm1001_driver import Dwm1001Driver
from uwblite.drivers.events import Corrupt, LaserScan, Lost, Note, Param, RangeEpoch, Reopen, Send, SetBaud
from uwblite.drivers.scip import Reply
from uwblite.drivers.scip_commands import BAUD_RATES, Geometry, ScanRequest
from uwblite.drivers.scip_driver import ScipDriver
from uwblite.drivers.session import Session

START = 1000.0


def plain_scans():
    values = [[1000 + (7 * i + k) % 4000 for i in range(682)] for k in range(50)]
    return (Scan(0.1 * k, values[k % 50]) for k in itertools.count())


def lidar(options=None, start=START + 0.05):
    clock, sent = WorldClock(), []
    device = ScipDevice(plain_scans(), clock, options or ScipOptions(), lambda t, v: sent.append((t, v)))
    clock.start(start)
    return device, sent


def names(actions):
    return {note.name for note in of_kind(actions, Note)}


@pytest.mark.parametrize(
    "state", ["plain", "scip1", "streaming", "adjusting", "laser on", "half a command", "wrong clock"]
)  # fmt: skip
def test_lidar_starts_from_every_state(state):
    options = ScipOptions(scip1=state == "scip1", streaming=state == "streaming")
    device, sent = lidar(options)
    power_up = device.power_up

    def prepared(now):
        power_up(now)
        words = {"adjusting": b"TM0\n", "laser on": b"BM\n", "half a command": b"MD0044"}
        device.receive(words.get(state, b""), now - 1.0)

    device.power_up = prepared
    session = ScipDriver()
    actions, reopens = simulate(session, device, 5.0)
    scans = of_kind(actions, LaserScan)
    assert reopens == 0
    assert len(scans) > 25
    assert not of_kind(actions, Lost)
    truth = {tuple(v): t for t, v in sent}
    for scan in scans:
        true = truth[tuple(round(1000 * r) for r in scan.ranges)]
        assert scan.stamp == pytest.approx(true, abs=0.002)


def test_lidar_reports_who_it_is_and_its_geometry():
    device, _ = lidar()
    session = ScipDriver()
    actions, _ = simulate(session, device, 2.0)
    assert {p.name for p in of_kind(actions, Param)} == {"laser_product", "laser_firmware", "laser_serial"}
    (scan, *_) = of_kind(actions, LaserScan)
    assert scan.angle_min == pytest.approx((44 - 384) * 2 * math.pi / 1024)
    assert scan.angle_increment == pytest.approx(2 * math.pi / 1024)
    assert scan.time_increment == pytest.approx(97.656e-6, rel=1e-4)
    assert (scan.range_max, scan.range_min) == (5.6, 0.02)


@pytest.mark.parametrize("options", [{"cluster": 3}, {"skip": 1}, {"wide": False}, {"start": 128, "end": 640}])
def test_lidar_sub_sampled(options):
    device, sent = lidar()
    actions, _ = simulate(ScipDriver(ScanRequest(**options)), device, 4.0)
    scans = of_kind(actions, LaserScan)
    assert len(scans) > (12 if "skip" in options else 20)
    assert not of_kind(actions, Lost)
    first = options.get("start", 44)
    for scan, (true, values) in zip(scans, sent, strict=False):
        assert len(scan.ranges) == len(values)
        assert scan.stamp == pytest.approx(true, abs=0.002)
        cluster = options.get("cluster", 1)
        assert scan.angle_min == pytest.approx((first + (cluster - 1) / 2 - 384) * 2 * math.pi / 1024)
        assert scan.angle_increment == pytest.approx(cluster * 2 * math.pi / 1024)
        # One turn of the mirror takes 0.1 s.
        assert scan.time_increment == pytest.approx(cluster * 0.1 / 1024)


@pytest.mark.parametrize("skew", [-2e-4, 0.0, 2e-4])
def test_lidar_stamps_stay_within_2_ms_through_a_clock_wrap(skew):
    """Two minutes across the wrap of the 24-bit counter, with transport delays of 1 ms and rare ones of 40 ms."""
    device, sent = lidar(ScipOptions(clock_start=(1 << 24) - 30_000, clock_skew=skew))
    rng = random.Random(0)
    delay = lambda: 0.04 if rng.random() < 0.02 else rng.expovariate(1000)  # noqa: E731
    actions, _ = simulate(ScipDriver(ScanRequest(44, 107)), device, 60.0, jitter=delay)
    scans = of_kind(actions, LaserScan)
    assert len(scans) > 580
    assert not names(actions) & {"lidar-clock-reset", "lidar-restart"}
    offset = len(sent) - len(scans)
    errors = [scan.stamp - t for scan, (t, _) in zip(scans, sent[offset if offset > 0 else 0 :], strict=False)]
    assert max(map(abs, errors)) < 0.002
    assert max(map(abs, errors[200:])) < 0.0015


def test_lidar_pause_and_hardware_fault_are_named_and_survived():
    device, _ = lidar()
    session, advance = ScipDriver(), device.advance

    def scripted(now):
        device.fault = 22 if 3 < now - START < 4 else 55 if 6 < now - START < 7 else None
        return advance(now)

    device.advance = scripted
    actions, _ = simulate(session, device, 15.0)
    assert {"lidar-paused", "lidar-resumed", "lidar-hardware-fault"} <= names(actions)
    assert of_kind(actions, LaserScan)[-1].stamp > START + 14.5


def test_status_that_ends_a_stream_is_named():
    device, _ = lidar()
    advance, done = device.advance, []

    def scripted(now):
        if now > START + 3 and not done:
            done.append(device._stream.echo)
            device._stream = None
            return device._block(done[0], "0M")
        return advance(now)

    device.advance = scripted
    actions, _ = simulate(ScipDriver(), device, 10.0)
    (restart,) = [note for note in of_kind(actions, Note) if note.name == "lidar-restart"]
    assert "status 0M: unstable" in restart.text
    assert of_kind(actions, LaserScan)[-1].stamp > START + 9.5


def test_lidar_on_a_slow_line_begins_in_a_few_seconds():
    """Over a round trip of 0.2 s more readings of the clock show nothing more."""
    device, _ = lidar()
    actions, _ = simulate(ScipDriver(), device, 10.0, latency=0.2)
    scans = of_kind(actions, LaserScan)
    assert scans[0].stamp < START + 6.0
    assert len(scans) > 40


def test_lidar_that_is_silent_asks_for_the_port_to_be_opened_again():
    device, _ = lidar()
    device.receive = lambda data, now: b""
    actions, reopens = simulate(ScipDriver(), device, 20.0)
    assert reopens >= 1
    assert "lidar-silent" in names(actions)
    assert {a.rate for a in of_kind(actions, SetBaud)} == {19200, 57600, 250000, 500000, 750000}


def test_a_lidar_at_the_last_bit_rate_is_asked_twice_at_each():
    """The second time behind the end of a line: half a command of another program may stand there."""
    driver, asked = ScipDriver(), []
    session, now = Session(driver), START
    actions = session.start(now)
    while not any(isinstance(action, Reopen) for action in actions):
        asked += [action.data for action in actions if isinstance(action, Send)]
        now += 0.05
        actions = session.tick(now)
    assert asked == [b"QT\n", b"\n", b"QT\n"] * len(BAUD_RATES)


def test_lidar_with_scip_1_only_is_named():
    device, _ = lidar(ScipOptions(scip1=True))
    receive = device.receive
    device.receive = lambda data, now: b"SCIP2.0\nE\n\n" if data.startswith(b"SCIP2.0") else receive(data, now)
    actions, reopens = simulate(ScipDriver(), device, 3.0)
    assert "lidar-scip1-only" in names(actions)
    assert reopens


def test_lidar_damage_costs_the_scans_that_were_damaged():
    """Noise at one byte in 20,000 hits about every tenth scan; all others arrive with the right ranges."""
    device, sent = lidar()
    line = FaultyLine([parse_fault("noise=0.00005@3")], 1)
    actions, _ = simulate(ScipDriver(), device, 40.0, line=line)
    scans = of_kind(actions, LaserScan)
    lost = sum(item.count for item in of_kind(actions, Lost))
    assert len(scans) + lost >= len(sent) - 3
    assert 13 < lost < 87
    true = {tuple(v) for _, v in sent}
    wrong = sum(tuple(round(1000 * r) for r in scan.ranges) not in true for scan in scans)
    assert wrong == 0


def test_lidar_with_one_false_time_keeps_all_other_stamps():
    """The sum is right, as of one in 64 lines that are damaged."""
    device, sent = lidar()
    device_ms = device.device_ms
    device.device_ms = lambda now: device_ms(now) + (700 if START + 10.02 < now < START + 10.12 else 0)
    actions, _ = simulate(ScipDriver(), device, 30.0)
    assert "scan whose time leaps away and back" in {c.why for c in of_kind(actions, Corrupt)}
    assert "lidar-clock-reset" not in names(actions)
    scans, truth = of_kind(actions, LaserScan), {}
    for true, values in sent:
        truth.setdefault(tuple(values), []).append(true)
    errors = [min(abs(scan.stamp - t) for t in truth[tuple(round(1000 * r) for r in scan.ranges)]) for scan in scans]
    assert len(scans) > 270
    assert max(errors) < 0.002


def test_lidar_scans_sent_twice_are_dropped():
    device, _ = lidar(ScipOptions(duplicates=0.2, random=random.Random(1)))
    actions, _ = simulate(ScipDriver(), device, 20.0)
    stamps = [scan.stamp for scan in of_kind(actions, LaserScan)]
    assert min(b - a for a, b in itertools.pairwise(stamps)) > 0.09
    assert "scan sent twice" in {c.why for c in of_kind(actions, Corrupt)}


# ---- the tag


def rounds(rng, dropouts=0.0):
    for k in itertools.count():
        if rng.random() >= dropouts:
            readings = [(0x1000 + i, 2000 + rng.randrange(5000), 100) for i in range(4)]
            yield Epoch(0.1 * k + 0.033, readings)


def tag(options=None, seed=0, dropouts=0.0):
    clock, sent = WorldClock(), []
    epochs = rounds(random.Random(seed), dropouts)
    device = DwmDevice(epochs, clock, options or DwmOptions(), lambda t, r: sent.append((t, r)))
    clock.start(START + 0.05)
    return device, sent


def check_ranges(actions, sent, resolution, tolerance):
    """Every fix from the first one on arrives, once, with its ranges and its time."""
    epochs = of_kind(actions, RangeEpoch)
    digits = 3 if resolution == 1 else 2
    fixes = {tuple((a, f"{d / 1000:.{digits}f}") for a, d, _ in readings): t for t, readings in sent}
    seen = []
    for epoch in epochs:
        key = tuple((int(r.anchor_id, 16), f"{r.range:.{digits}f}") for r in epoch.readings)
        assert key in fixes
        seen.append(fixes[key])
        assert epoch.stamp == pytest.approx(fixes[key], abs=tolerance)
    assert len(set(seen)) == len(seen)
    expected = [t for t, _ in sent if seen[0] <= t <= seen[-1]]
    assert len(seen) == len(expected)


@pytest.mark.parametrize(
    "options",
    [{}, {"shell": True}, {"stream": "lec"}, {"stream": "les"}, {"stream": "lep"}, {"without_position": True}],
    ids=str,
)
def test_tag_by_tlv_from_every_state(options):
    device, sent = tag(DwmOptions(**options))
    session = Dwm1001Driver()
    actions, reopens = simulate(session, device, 20.0)
    assert reopens == 0
    assert len(of_kind(actions, RangeEpoch)) > 150
    check_ranges(actions, sent, 1, 0.005)
    assert not of_kind(actions, Lost)
    assert len(of_kind(actions, Corrupt)) <= 2 * bool(options.get("stream"))
    assert ("uwb-stream-left" in names(actions)) == ("stream" in options)
    assert {p.name: p.value for p in of_kind(actions, Param)}["uwb_tag_id"] == "1512"


@pytest.mark.parametrize("options", [{}, {"shell": True}, {"stream": "lec"}, {"stream": "les"}], ids=str)
def test_tag_by_shell_from_every_state(options):
    device, sent = tag(DwmOptions(**options))
    actions, reopens = simulate(Dwm1001Driver(shell=True), device, 20.0)
    assert reopens == 0
    assert len(of_kind(actions, RangeEpoch)) > 120
    assert len(of_kind(actions, Corrupt)) <= 2 * bool(options.get("stream"))
    check_ranges(actions, sent, 10, 0.01)


@pytest.mark.parametrize("dropouts", [0.2, 0.9])
def test_tag_with_rounds_missing(dropouts):
    device, sent = tag(dropouts=dropouts)
    actions, _ = simulate(Dwm1001Driver(), device, 40.0)
    check_ranges(actions, sent, 1, 0.006)
    assert not of_kind(actions, Lost)


@pytest.mark.parametrize("seconds", [0.3, 0.6, 6.0])
def test_tag_fixes_that_came_while_the_link_was_held_are_counted(seconds):
    device, sent = tag(seed=3)
    jitter = random.Random(3)
    actions, _ = simulate(Dwm1001Driver(), device, 24.0, jitter=lambda: jitter.expovariate(1000.0), pause=(15.0, seconds))
    stamps = [epoch.stamp for epoch in of_kind(actions, RangeEpoch)]
    made = sum(stamps[0] - 0.01 <= time <= stamps[-1] + 0.01 for time, _ in sent)
    assert abs(made - len(stamps) - sum(lost.count for lost in of_kind(actions, Lost))) <= 1


def test_tag_half_a_request_of_a_dead_host_is_closed_by_the_gap():
    device, sent = tag()
    power_up = device.power_up

    def prepared(now):
        power_up(now)
        device.receive(b"\x0c", now - 0.5)

    device.power_up = prepared
    actions, _ = simulate(Dwm1001Driver(), device, 5.0)
    check_ranges(actions, sent, 1, 0.005)


def test_tag_settings_that_hurt_are_named():
    device, _ = tag(DwmOptions(stationary_detection=True, update=[10, 100], joined=False))
    actions, _ = simulate(Dwm1001Driver(), device, 8.0)
    assert {"stationary-detection", "slow-update-rate", "not-joined"} <= names(actions)
    device, _ = tag(DwmOptions(anchor=True))
    actions, _ = simulate(Dwm1001Driver(), device, 3.0)
    assert "not-a-tag" in names(actions)
    device, _ = tag(DwmOptions(stationary_detection=True, joined=False))
    actions, _ = simulate(Dwm1001Driver(shell=True), device, 6.0)
    assert {"stationary-detection", "not-joined"} <= names(actions)


def test_tag_on_a_bad_cable_logs_nothing_wrong():
    """One byte in a hundred is changed and TLV has no sum: reading twice keeps wrong ranges out of the log."""
    device, sent = tag(seed=1)
    line = FaultyLine([parse_fault("noise=0.01@3")], 1)
    actions, _ = simulate(Dwm1001Driver(), device, 40.0, line=line)
    epochs = of_kind(actions, RangeEpoch)
    true = {tuple((a, d) for a, d, _ in readings) for _, readings in sent}
    wrong = [e for e in epochs if tuple((int(r.anchor_id, 16), round(1000 * r.range)) for r in e.readings) not in true]
    assert len(wrong) <= 1
    lost = sum(item.count for item in of_kind(actions, Lost))
    assert len(epochs) > 0.5 * len(sent)
    assert abs(len(epochs) + lost - len(sent)) < 0.05 * len(sent) + 10


def test_tag_that_falls_silent_asks_for_the_port_to_be_opened_again():
    device, _ = tag()
    device.silent = True
    actions, reopens = simulate(Dwm1001Driver(), device, 15.0)
    assert reopens >= 1
    assert "uwb-silent" in names(actions)


def test_bytes_that_no_tag_sends_are_told_from_silence():
    session = Session(Dwm1001Driver())
    actions, now = session.start(START), START
    while now < START + 10:
        now = round(now + 0.1, 1)
        actions += [*session.feed(b"\xf8\x00\x86\xfe\x1e", now), *session.tick(now)]
    assert [action.name for action in actions if isinstance(action, Note)] == ["uwb-unreadable"]


@pytest.mark.parametrize("shell", [False, True])
@pytest.mark.parametrize("seconds", [1.0, 10.0])
def test_random_bytes_count_as_corrupt_in_either_mode_known_or_not(shell, seconds):
    rng, session = random.Random(0), Session(Dwm1001Driver(shell=shell))
    actions, now = session.start(START), START
    while now < START + seconds:
        now = round(now + 0.05, 2)
        actions += [*session.feed(rng.randbytes(200), now), *session.tick(now)]
    actions += session.stop()
    assert sum(isinstance(action, Corrupt) for action in actions) >= 20 * seconds
    assert not [action for action in actions if isinstance(action, RangeEpoch)]


def test_tag_that_leaves_its_shell_in_mid_run_is_started_again_soon():
    device, _ = tag()
    session = Session(Dwm1001Driver(shell=True))
    feed, done = session.feed, []

    def scripted(data, now):
        if now > START + 8 and not done:
            done.append(now)
            device._reboot_at = now
        return feed(data, now)

    session.feed = scripted
    actions, _ = simulate(session, device, 20.0)
    stamps = [epoch.stamp for epoch in of_kind(actions, RangeEpoch) if epoch.stamp > START + 6]
    assert stamps[-1] > START + 19
    # 3 s without a line, and the start.
    assert max(after - before for before, after in itertools.pairwise(stamps)) < 6.0
    assert [note.text for note in of_kind(actions, Note)] == [
        "uwb: it restarted and left its shell; starting the module again"
    ]


def test_tag_that_restarts_in_mid_run_comes_back():
    device, _ = tag()
    session = Session(Dwm1001Driver())
    feed, done = session.feed, []

    def scripted(data, now):
        if now > START + 5 and not done:
            done.append(now)
            device._reboot_at = now + 3.0
        return feed(data, now)

    session.feed = scripted
    actions, _ = simulate(session, device, 30.0)
    assert of_kind(actions, RangeEpoch)[-1].stamp > START + 29


# ---- what field reports and other people's fakes have shown


@pytest.mark.parametrize("before", [b"AT", b"TM0\n", b"AT+GCAP\r2", b"2\x00", b"MD00440", b"\x00\xff~x"], ids=repr)
def test_lidar_is_asked_everything_whatever_stood_in_its_input_line(before):
    """ModemManager's AT, a tag's probe, a time-adjust mode: geometry, name and latency are still asked for."""
    device, sent = lidar(ScipOptions(unit=Unit("UST-30LC")))
    power_up = device.power_up
    device.power_up = lambda now: (power_up(now), device.receive(before, now))
    driver = ScipDriver()
    actions, reopens = simulate(driver, device, 4.5)
    assert not reopens
    assert driver.geometry.model == "UST-30LC"
    assert "UST-30LC" in driver.identity().title
    assert {p.name for p in of_kind(actions, Param)} == {"laser_product", "laser_firmware", "laser_serial"}
    scans = of_kind(actions, LaserScan)
    assert len(scans) > 25
    truth = {tuple(v): t for t, v in sent}
    for scan in scans:
        assert scan.stamp == pytest.approx(truth[tuple(round(1000 * r) for r in scan.ranges)], abs=0.002)


def test_lidar_with_a_fault_is_not_called_well():
    device, _ = lidar()
    device.fault = 70
    driver = ScipDriver(stream=False)
    simulate(driver, device, 3.0)
    assert driver.ready
    assert [(note.level, "70" in note.text) for note in driver.identity().findings if note.name == "lidar-state"] == [
        ("error", True)
    ]


def test_lidar_clock_that_is_reset_in_mid_stream_keeps_its_latency():
    """The counter starts at 0 again after 20 s; the delay of the frames, 101.5 ms, was measured before."""
    device, sent = lidar()
    device_ms = device.device_ms
    device.device_ms = lambda now: device_ms(now) if now < START + 20 else int(1000 * (now - START - 20))
    actions, _ = simulate(ScipDriver(), device, 40.0)
    assert "lidar-clock-reset" in names(actions)
    scans, truth = of_kind(actions, LaserScan), {}
    for true, values in sent:
        truth.setdefault(tuple(values), []).append(true)
    errors = [min(abs(scan.stamp - t) for t in truth[tuple(round(1000 * r) for r in scan.ranges)]) for scan in scans]
    assert len(scans) > 360
    assert max(errors) < 0.002


def test_lidar_that_gives_no_time_is_late_by_no_more_than_a_turn_is_long():
    """Without TM the delay cannot be measured: the nominal one is that of the timed capture of a real unit."""
    device, sent = lidar()
    device._do_TM = lambda line, rest, now: device._block(line, "0E")
    actions, _ = simulate(ScipDriver(), device, 5.0)
    truth = {tuple(v): t for t, v in sent}
    for scan in of_kind(actions, LaserScan):
        assert scan.stamp == pytest.approx(truth[tuple(round(1000 * r) for r in scan.ranges)], abs=0.003)
        assert 0.035 < scan.spread < 0.040


@pytest.mark.parametrize(
    ("rates", "expected"),
    [
        ((19200, 57600, 115200, 250000, 500000, 750000), (9.9, 1.0)),
        ((19200, 57600, 115200), (5.0, 0.5)),
        ((19200,), (1.2, 0.125)),
    ],
)
def test_lidar_on_a_slow_line_is_made_faster_or_asked_for_fewer_scans(rates, expected):
    """RS-232 at 19200 bit/s carries 0.8 scans a second. What is left out is said; nothing that was sent is lost."""
    device, sent = lidar(ScipOptions(serial=True, rates=rates))
    driver = ScipDriver()
    actions, reopens = simulate(driver, device, 40.0)
    scans = of_kind(actions, LaserScan)
    assert not reopens
    assert len(scans) / 40 > 0.85 * expected[0]
    assert ("lidar-slow-line" in names(actions)) == (expected[1] < 1)
    settled = [scan for when, scan in actions if isinstance(scan, LaserScan) and when > START + 20]
    lost = sum(a.count for when, a in actions if isinstance(a, Lost) and when > START + 20)
    assert lost == 0
    assert len(settled) == pytest.approx(200 * expected[1], rel=0.12)
    truth = {}
    for true, values in sent:
        truth.setdefault(tuple(v if v < 4095 or rates[1:] else 5600 for v in values), []).append(true)
    for scan in settled:
        key = tuple(5600 if math.isinf(r) else round(1000 * r) for r in scan.ranges)
        # An answer to TM1 takes 8 ms at 19200 bit/s: the clock is known to half of that.
        assert min(abs(scan.stamp - t) for t in truth[key]) < scan.spread
        assert scan.spread < (0.006 if rates[1:] else 0.009)


def test_lidar_scans_that_a_restart_cost_are_counted():
    device, _ = lidar()
    advance = device.advance

    def scripted(now):
        device.hung = 10 < now - START < 12
        return advance(now)

    device.advance = scripted
    actions, _ = simulate(ScipDriver(), device, 30.0)
    assert "lidar-restart" in names(actions)
    stamps = [scan.stamp for scan in of_kind(actions, LaserScan)]
    assert sum(a.count for a in of_kind(actions, Lost)) == round((stamps[-1] - stamps[0]) / 0.1) + 1 - len(stamps)
    assert len(stamps) < 280


def test_lidar_that_does_not_say_its_steps_again_after_a_restart_keeps_them():
    """Half of a recording with other steps than the rest would not be used."""
    facts = {"DMIN": 20, "DMAX": 5600, "ARES": 1024, "AMIN": 0, "AMAX": 768, "AFRT": 384, "SCAN": 600}
    answer = Reply(0.0, "PP", "00", tuple(f"{key}:{value}" for key, value in facts.items()))
    driver, answers = ScipDriver(), [answer]

    def request(command, tries=2):
        return answers[0]
        yield

    driver._request = request
    assert not list(driver._take_geometry(answer))
    answers[0] = Reply(1.0, "PP", "0E")
    [note] = driver._take_geometry(answers[0])
    assert driver.geometry.last == 768
    assert note.text.endswith("going on with the last answer")
    fresh = ScipDriver()
    fresh._request = request
    [note] = fresh._take_geometry(None)
    assert fresh.geometry == Geometry()
    assert note.text.endswith("the limits of a URG-04LX")


def test_tag_with_status_bits_that_the_guide_does_not_name():
    device, sent = tag(DwmOptions(status_bits=16 | 0x0200))
    actions, reopens = simulate(Dwm1001Driver(), device, 20.0)
    assert not reopens
    check_ranges(actions, sent, 1, 0.005)


@pytest.mark.parametrize(
    ("latency", "tick", "spread"), [(0.0008, 0.0, 0.005), (0.002, 0.016, 0.018), (0.018, 0.0, 0.024), (0.050, 0.0, 0.055)]
)
def test_tag_on_a_slow_link_is_stamped_within_what_is_stated(latency, tick, spread):
    """FTDI adapters deliver every 16 ms; a bridge in a network takes 18 or 50 ms. No fix vanishes without being counted."""
    device, sent = tag()
    actions, reopens = simulate(Dwm1001Driver(), device, 40.0, latency=latency, tick=tick)
    assert not reopens
    fixes = {tuple((f"{a:04X}", d) for a, d, _ in readings): t for t, readings in sent}
    epochs = of_kind(actions, RangeEpoch)
    errors = []
    for epoch in epochs:
        true = fixes.pop(tuple((r.anchor_id, round(1000 * r.range)) for r in epoch.readings))
        errors.append(abs(epoch.stamp - true))
        assert errors[-1] <= epoch.spread + 1e-9
    assert sorted(e.spread for e in epochs)[int(0.95 * len(epochs))] < spread
    lost = sum(a.count for a in of_kind(actions, Lost))
    begun = sum(t >= epochs[0].stamp - 0.05 for t, _ in sent)
    assert len(epochs) + lost == pytest.approx(begun, abs=2)
    assert len(epochs) > 0.97 * begun


def test_tag_on_a_link_whose_delay_comes_and_goes():
    """A busy computer: for seconds every answer takes up to 70 ms. No fix is logged twice, each lies within its bracket."""
    device, sent = tag()
    rng, calls = random.Random(0), itertools.count()
    jitter = lambda: rng.uniform(0, 0.07) if (next(calls) // 150) % 2 else 0.001  # noqa: E731
    actions, reopens = simulate(Dwm1001Driver(), device, 80.0, jitter=jitter)
    assert not reopens
    fixes = {tuple((f"{a:04X}", d) for a, d, _ in readings): t for t, readings in sent}
    epochs = of_kind(actions, RangeEpoch)
    for epoch in epochs:
        true = fixes.pop(tuple((r.anchor_id, round(1000 * r.range)) for r in epoch.readings))
        assert abs(epoch.stamp - true) <= epoch.spread + 1e-9
    lost = sum(a.count for a in of_kind(actions, Lost))
    begun = sum(t >= epochs[0].stamp - 0.05 for t, _ in sent)
    assert len(epochs) + lost == pytest.approx(begun, abs=0.05 * begun)


@pytest.mark.parametrize(("least", "most", "share"), [(0.1, 0.15, 0.7), (0.15, 0.45, 0.25), (0.5, 0.9, 0.0)])
def test_tag_whose_answers_take_longer_than_a_fix_lasts(least, most, share):
    """No fix can be read twice then. What is known to 0.6 s is logged, within its bracket, the rest counted, and both said."""
    device, sent = tag()
    rng = random.Random(0)
    actions, _ = simulate(Dwm1001Driver(), device, 40.0, jitter=lambda: rng.uniform(least, most))
    fixes = {tuple((f"{a:04X}", d) for a, d, _ in readings): t for t, readings in sent}
    epochs = of_kind(actions, RangeEpoch)
    for epoch in epochs:
        true = fixes.pop(tuple((r.anchor_id, round(1000 * r.range)) for r in epoch.readings))
        assert abs(epoch.stamp - true) <= epoch.spread + 1e-9
    assert len(epochs) >= share * len(sent)
    assert sum(a.count for a in of_kind(actions, Lost)) > 0 or share > 0.5
    assert "uwb-slow" in names(actions)


def test_lidar_on_a_busy_computer_is_tied_as_well_as_is_stated():
    """Answers and scans take 0 to 25 ms: more readings of the clock are asked for, and what is left is stated."""
    device, sent = lidar()
    rng = random.Random(1)
    actions, _ = simulate(ScipDriver(), device, 40.0, jitter=lambda: rng.uniform(0, 0.025))
    truth = {}
    for true, values in sent:
        truth.setdefault(tuple(values), []).append(true)
    scans = of_kind(actions, LaserScan)
    errors = [min(abs(scan.stamp - t) for t in truth[tuple(round(1000 * r) for r in scan.ranges)]) for scan in scans]
    assert all(error < scan.spread for error, scan in zip(errors, scans, strict=True))
    # The smallest of ten delays, and so each point of the envelope, is 2.3 ms late on average.
    assert sorted(scan.spread for scan in scans)[len(scans) // 2] < 0.010
    assert sorted(errors)[int(0.95 * len(errors))] < 0.005


@pytest.mark.parametrize("name", MODELS)
def test_every_hokuyo_is_named_and_read_as_what_it_is(name):
    """Angles, times, reach and what is no distance are the model's own."""
    unit = model(name)
    clock, sent = WorldClock(), []
    count = unit.last - unit.first + 1
    values = [1, 6, *(1000 + (7 * i) % 3000 for i in range(count - 3)), 70000]
    scans = (Scan(unit.turn * k, values) for k in itertools.count())
    device = ScipDevice(scans, clock, ScipOptions(unit=unit), lambda t, v: sent.append(t))
    clock.start(START + 0.05)
    driver = ScipDriver()
    actions, _ = simulate(driver, device, 3.0)
    found = of_kind(actions, LaserScan)
    assert driver.identity().title == f"laser scanner {name}"
    assert name in {p.value.removeprefix("SOKUIKI_Sensor_") for p in of_kind(actions, Param)}
    assert len(found) > 1.5 / unit.turn
    assert not of_kind(actions, Lost)
    scan = found[-1]
    assert len(scan.ranges) == count
    assert scan.angle_min == pytest.approx((unit.first - unit.numbers[5]) * 2 * math.pi / unit.numbers[2])
    assert scan.time_increment == pytest.approx(unit.turn / unit.numbers[2])
    assert scan.range_max == unit.numbers[1] / 1000
    # 1 is "no object in the range" of a UTM, "low intensity" of an 04LX; 6 is the other way round.
    assert [math.isinf(r) for r in (*scan.ranges[:2], scan.ranges[-1])] == [name[:3] == "UTM", name[2] == "G", True]
    assert scan.ranges[5] == 1.021
    assert min(abs(scan.stamp - t) for t in sent) < scan.spread


def test_the_captured_unit_is_emulated(shared_data):
    """Its own answers to VV and PP, its scan, and its delay: the driver measures the delay and reads the scan."""
    unit = captured(shared_data / "captures" / "urg04lx_timed_fw3104.logr.gz")
    assert unit.model == "URG-04LX"
    assert dict(unit.version)["FIRM"].startswith("3.1.04")
    assert 0.0 < unit.latency < 0.010
    clock, sent = WorldClock(), []
    device = ScipDevice(
        (Scan(0.1 * k, []) for k in itertools.count()), clock, ScipOptions(unit=unit), lambda t, v: sent.append(t)
    )  # fmt: skip
    clock.start(START + 0.05)
    driver = ScipDriver()
    actions, _ = simulate(driver, device, 6.0)
    assert driver.facts["FIRM"] == dict(unit.version)["FIRM"]
    scans = of_kind(actions, LaserScan)
    assert len(scans) > 35
    assert driver._clock.latency == pytest.approx(0.1 + unit.latency, abs=0.002)
    assert max(min(abs(scan.stamp - t) for t in sent) for scan in scans) < 0.002
    far = sum(math.isinf(r) for r in scans[0].ranges)
    assert far == sum(v in (0, 6) or v >= 5600 for v in unit.values) > 0


def test_tag_that_answers_an_error_is_named_once_and_asked_on():
    device, sent = tag()
    receive = device.receive
    device.receive = lambda data, now: b"\x40\x01\x04" if 4.0 < now - START < 5.0 and data else receive(data, now)
    actions, _ = simulate(Dwm1001Driver(), device, 8.0)
    (note,) = [note for note in of_kind(actions, Note) if note.name.startswith("uwb-error")]
    assert (note.level, note.name) == ("warning", "uwb-error-4")
    assert "the module answers error 4, busy" in note.text
    assert of_kind(actions, RangeEpoch)[-1].stamp > START + 7.5
    assert len(of_kind(actions, RangeEpoch)) > 0.7 * len(sent)


@pytest.mark.parametrize("refuses", [False, True])
def test_lidar_whose_laser_does_not_start_is_tried_a_few_times_and_its_port_then_opened_again(refuses):
    """It takes the order and sends nothing, or refuses it."""
    device, _ = lidar()
    receive, asked = device.receive, []

    def deaf(data, now):
        if data.startswith(b"MD"):
            asked.append(now)
            return b"MD0044072501000\n" + (b"01Q\n\n" if refuses else b"00P\n\n")
        return receive(data, now)

    device.receive = deaf
    actions, reopens = simulate(ScipDriver(), device, 60.0)
    assert not of_kind(actions, LaserScan)
    assert reopens
    restarts = [note.text for note in of_kind(actions, Note) if note.name == "lidar-restart"]
    words = "MD refused, status 01: a bad first step" if refuses else "no scan for too long"
    assert restarts
    assert all(text.startswith(f"lidar: {words}") and text.endswith("; starting it again") for text in restarts)
    assert 4 * reopens <= len(asked) < 4 * (reopens + 1)


def test_lidar_that_does_not_answer_the_order_to_measure_is_said_so():
    device, _ = lidar()
    receive = device.receive
    device.receive = lambda data, now: b"" if data.startswith(b"MD") else receive(data, now)
    actions, _ = simulate(ScipDriver(), device, 10.0)
    restarts = [note.text for note in of_kind(actions, Note) if note.name == "lidar-restart"]
    assert restarts
    assert set(restarts) == {"lidar: no answer to MD; starting it again"}
