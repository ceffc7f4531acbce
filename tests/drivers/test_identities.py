"""Who answers at a port says what it is, and what about it needs mending; what devices did is told in figures."""

import math
from pathlib import Path
from types import SimpleNamespace

import pytest

from uwblite.cli.record import LinesTo, mounting_params, status_text
from uwblite.drivers.create2 import Create2Driver, Encoders
from uwblite.drivers.devices import DEVICES, Setup, open_device
from uwblite.drivers.events import Corrupt, GyroHeading, LaserScan, OdometryPose, RangeEpoch, RangeReading
from uwblite.drivers.kobuki import Feedback, KobukiDriver
from uwblite.drivers.link import Host, Link, Mounting, doubts, summary_lines
from uwblite.drivers.log_file import LogText
from uwblite.drivers.odometry_line import LineFormat, OdometryLineDriver
from uwblite.drivers.scip_driver import ScipDriver
from uwblite.drivers.text_lines import Line
from uwblite.drivers.uwb_line import by_columns, sound_lines


@pytest.mark.parametrize("name", DEVICES)
def test_before_anybody_has_answered_a_driver_says_what_it_is_for(name):
    driver = DEVICES[name].driver({}, Setup())
    identity = driver.identity()
    assert identity.title
    assert identity.title.split()[0] in f"{DEVICES[name].title} laser UWB base gyro"
    assert all(note.level in ("info", "warning", "error") and note.text for note in identity.findings)


@pytest.mark.parametrize(
    ("drop", "voltage", "named"),
    [
        (0, 15.0, []),
        (1, 15.0, ["wheel-drop"]),
        (2, 12.9, ["wheel-drop", "low-battery"]),
        (0, 12.9, ["low-battery"]),
        (0, 0.0, []),
    ],
)
@pytest.mark.parametrize("kind", ["kobuki", "create2"])
def test_a_base_says_its_battery_and_wheels_in_the_air(kind, drop, voltage, named):
    if kind == "kobuki":
        driver = KobukiDriver()
        for k in range(4):
            driver.now = 1.0 + 0.02 * k
            actions = driver.take(Feedback(driver.now, 20 * k, 0, 0, 0.0, 0.0, drop, voltage))
    else:
        driver = Create2Driver()
        actions = driver.take(Encoders(1.0, 0, 0, drop, voltage))
    identity = driver.identity()
    assert identity.details == (("battery", f"{voltage:.1f} V"),)
    assert [note.name for note in identity.findings] == named
    assert all(f"{voltage:.1f} V" in note.text for note in identity.findings if note.name == "low-battery")
    assert {note.level for note in identity.findings} <= {"warning"}
    if kind == "create2":
        assert [note.name for note in actions if hasattr(note, "name")] == (["wheel-drop"] if drop else [])


def test_the_limit_of_a_low_battery_is_the_bases_own():
    for driver, low in ((KobukiDriver(), 13.5), (Create2Driver(), 13.0)):
        for voltage, many in ((low, 0), (low - 0.1, 1)):
            driver.state(0, voltage)
            assert len(driver.identity().findings) == many


def test_wheels_in_the_air_are_told_when_they_are_lifted_and_again_after_they_stood():
    driver = Create2Driver()
    assert [bool(driver.state(drop, 15.0)) for drop in (0, 1, 1, 3, 0, 2)] == [False, True, False, False, False, True]


@pytest.mark.parametrize(
    ("facts", "named"),
    [
        ({"STAT": "Sensor works well.", "LASR": "OFF", "FIRM": "3.1", "SERI": "H1", "MODL": "URG-04LX(Hokuyo)"}, ["laser-off"]),
        ({"STAT": "Stable 000 no error.", "LASR": "ON"}, []),
        ({"STAT": "Error 12"}, ["lidar-state"]),
        ({}, ["lidar-state"]),
    ],
)
def test_a_lidar_says_its_state_range_and_steps(facts, named):
    driver = ScipDriver()
    driver.facts = dict(facts)
    identity = driver.identity()
    assert [note.name for note in identity.findings] == named
    assert [note.level for note in identity.findings if note.name == "lidar-state"] == (
        [] if "lidar-state" not in named else ["error" if facts else "warning"]
    )
    details = dict(identity.details)
    assert (details["range"], details["steps"]) == ("0.02 to 5.60 m", "44 to 725, 600 rev/min")
    assert {name for name in ("firmware", "serial", "laser", "state") if name in details} == {
        {"FIRM": "firmware", "SERI": "serial", "LASR": "laser", "STAT": "state"}[key] for key in facts if key != "MODL"
    }
    assert identity.title == "laser scanner URG-04LX"


def test_a_line_that_comes_twice_is_one_pose():
    driver = OdometryLineDriver(LineFormat())
    driver.clock.proven = True
    lines = [Line(10.0 + 0.02 * k, {"t": 0.02 * k, "x": 0.01 * k, "y": 0.0, "theta": 0.0}) for k in range(5)]
    assert all(isinstance(driver.measured(line)[-1], OdometryPose) for line in lines)
    assert driver.measured(Line(10.1, lines[-1].content)) == [Corrupt("line sent twice")]


@pytest.mark.parametrize(("metres", "taken"), [("1000", True), ("-1000", True), ("1000.5", False), ("-1000.5", False)])
def test_a_range_that_no_radio_has_is_damage(metres, taken):
    content = sound_lines(by_columns("id,range"))(f"A1,{metres}")
    if taken:
        assert [(r.anchor_id, r.range) for r in content.readings] == [("A1", float(metres))]
    else:
        assert content == "a range beyond 1000 m"
    assert sound_lines(by_columns("range:A,range:B"))("1,2").readings[1].range == 2.0
    assert sound_lines(by_columns("range:A,range:a"))("1,2") == "line of ranges cut or garbled"


def links():
    """Two devices of ten seconds, the figures of which are all different."""
    base = Link("odometry", "/dev/base", open_device("odometry", "kobuki:/dev/base")[0])
    tag = Link("uwb", "/dev/tag", open_device("uwb", "/dev/tag")[0], 2)
    base.counts.messages, base.counts.lost, base.counts.connects = 480, 21, 3
    base.counts.corrupt.update({"packet with a wrong sum": 5, "no packet": 4})
    base.counts.silent_time, base.counts.spread, base.counts.widest = 0.75, 0.96, 0.0055
    tag.counts.messages, tag.counts.connects = 90, 1
    tag.counts.anchors.update({"B2": 70, "A1": 60})
    return base, tag


def test_what_each_device_did_is_told_in_figures():
    base, tag = links()
    assert summary_lines([base, tag], 100.0, 110.0) == [
        "odometry: 480 messages (48.00/s), lost 21, corrupt 9, connected 3 times, silent 0.8 s; stamps within 2.0 ms on"
        " average, 5.5 ms at worst",
        "odometry: corrupt 5 times: packet with a wrong sum",
        "odometry: corrupt 4 times: no packet",
        "uwb2: 90 messages (9.00/s), lost 0, corrupt 0, connected 1 times, silent 0.0 s; anchors A1 60, B2 70",
    ]
    base.quiet, base.last_message = True, 107.0
    assert base.silent_time(100.0, 110.0) == 3.75
    assert doubts([base, tag], 100.0, 110.0) == ["odometry: silent for 4 s of 10 s"]
    assert Link("gyro", "", base.session).silent_time(100.0, 110.0) == 10.0


def test_the_status_line_names_rates_losses_and_the_disk():
    base, tag = links()
    base.port, base.rate = object(), 49.96
    log = SimpleNamespace(bytes=1_250_000, free_bytes=lambda: 2_340_000_000)
    assert status_text(SimpleNamespace(links=[base, tag], log=log)) == (
        "1.2 MB | odometry 50.0/s lost 21 corrupt 9 | uwb2 SILENT (2 anchors) | disk 2.3 GB left"
    )
    base.quiet, tag.port = True, object()
    assert "odometry SILENT" in status_text(SimpleNamespace(links=[base, tag], log=log))


def test_rates_are_those_of_the_last_two_seconds():
    base, _ = links()
    base.update_rate(0.0)
    for now, messages, rate in ((10.0, 480, 48.0), (11.9, 580, 48.0), (12.0, 581, 50.5)):
        base.counts.messages = messages
        base.update_rate(now)
        assert base.rate == pytest.approx(rate)


def test_the_mounting_of_the_command_line_stands_in_the_log():
    args = SimpleNamespace(tag=[(0.1, -0.2, 0.6), (1.0, 2.0, 3.0)], anchor_height=2.5, laser_flipped=[1, 3])
    assert mounting_params(args, 12.5) == [
        ("host_monotonic_zero", "12.500000"),
        ("uwb_tag_offset_x", "0.100000"), ("uwb_tag_offset_y", "-0.200000"), ("uwb_tag_height", "0.600000"),
        ("uwb2_tag_offset_x", "1.000000"), ("uwb2_tag_offset_y", "2.000000"), ("uwb2_tag_height", "3.000000"),
        ("uwb_anchor_height", "2.500000"),
        ("laser_flipped", "on"), ("laser3_flipped", "on"),
    ]  # fmt: skip
    none = SimpleNamespace(tag=None, anchor_height=None, laser_flipped=None)
    assert mounting_params(none, 0.0) == [("host_monotonic_zero", "0.000000")]


def test_every_kind_of_measurement_has_its_line_with_the_stamp_of_the_wall_clock():
    taken = []
    log = LinesTo(taken.append)
    now = [5.0]
    mounting = Mounting((0.2, 0.0, 0.5), (("uwb_tag_height", "0.6"),), ((-0.2, 0.1, 0.0),))
    text = LogText(log, mounting, Host("h", lambda: now[0], 1000.0))
    text.head(["recorded by  a\ntest"])
    now[0] = 7.5
    base, tag = links()
    lidar = Link("lidar", "", base.session, 2)
    text.write(OdometryPose(7.0, 1.0, 2.0, math.pi / 2, 0.3, 0.1), base)
    text.write(GyroHeading(7.1, 0.25, -0.125), base)
    text.write(RangeEpoch(7.2, (RangeReading("B2", 3.25, 98),), 0.004), tag)
    text.write(LaserScan(7.3, (1.0, math.inf), -0.5, 0.25, 0.001, 5.6, 0.02), lidar)
    text.write(LaserScan(7.4, (1.0, math.nan), -0.5, 0.25, 0.001, 5.6, 0.02), lidar)
    text.flush()
    lines = b"".join(taken).decode().splitlines()
    assert lines == [
        "# CARMEN Logfile",
        "COMMENT 0.000 recorded by a test",
        "PARAM uwb_tag_height 0.6 1005.000000 h 0.000000",
        "ODOM 1.000000 2.000000 1.570796 0.300000 0.100000 0.000000 1007.000000 h 2.500000",
        "GYRO 0.250000 -0.125000 1007.100000 h 2.500000",
        "UWB2 B2 3.250 98 1007.200000 h 2.500000",
        "PARAM laser2_time_increment 0.001000000 1007.500000 h 2.500000",
        "PARAM laser2_range_min 0.020 1007.500000 h 2.500000",
        "ROBOTLASER2 0 -0.500000000 0.250000000 0.250000000 5.600 0.010 0 2 1.000 5.600 0 0.900000 1.800000 1.570796 1.000000"
        " 2.000000 1.570796 0.300000 0.100000 0.0 0.0 0.0 1007.300000 h 2.500000",
        "ROBOTLASER2 0 -0.500000000 0.250000000 0.250000000 5.600 0.010 0 2 1.000 0.000 0 0.900000 1.800000 1.570796 1.000000"
        " 2.000000 1.570796 0.300000 0.100000 0.0 0.0 0.0 1007.400000 h 2.500000",
    ]
    assert log.bytes == sum(map(len, taken))
    assert log.head == [lines[0], lines[2], lines[6], lines[7]]
    assert (log.path, log.part, log.restore()) == (Path("-"), 1, False)
    assert tag.counts.anchors["B2"] == 71
    assert (tag.counts.spread, tag.counts.widest) == (0.004, 0.004)
