"""What makers state of their devices: speed of the line, clocks, ticks, angles, reach; in the makers' own units.

Sources: kobuki_core 1.4.0; Create 2 Open Interface specification; C-42-03320B and PP of a URG-04LX; LD19 manual 2.3;
YDLidar-SDK; RPLIDAR interface protocol and data sheets; hls_lfcd_lds_driver; nlink_unpack; DWM1001 firmware API guide.
"""

import math
import re

import pytest

from uwblite.drivers import create2, dwm1001_tlv, kobuki, ldlidar, lds01, rplidar, ydlidar
from uwblite.drivers.devices import DEVICES, Setup, kinds_on_usb
from uwblite.drivers.scip_commands import BAUD_RATES, NOTHING_SEEN, Geometry, ScanRequest
from uwblite.errors import ConfigError

BAUDS = {
    "kobuki": 115200, "create2": 115200, "line": 115200, "gyro-line": 115200, "tlv": 115200, "shell": 115200,
    "uwb-line": 115200, "makerfabs": 115200, "makerfabs-at": 115200, "bu01": 115200, "dwm3001": 115200, "bu03": 115200,
    "linktrack": 921600, "scip": 115200, "ld06": 230400, "ydlidar-x2": 115200, "ydlidar-x4": 128000, "rplidar": 115200,
    "lds01": 230400,
}  # fmt: skip
"""bit/s."""


@pytest.mark.parametrize("name", DEVICES)
def test_a_device_is_opened_at_the_makers_speed_unless_another_is_given(name):
    kind = DEVICES[name]
    assert kind.driver({}, Setup()).baud == BAUDS[name]
    if "baud" in kind.options:
        assert kind.driver({"baud": "9600"}, Setup()).baud == 9600
        assert kind.options["baud"].bounds == (1200, 4_000_000)


def test_ticks_wheels_and_clocks_of_bases():
    # 2578.33 ticks a turn of a wheel of 35 mm radius make 11724.41658029856 ticks a metre (kobuki_core's header).
    ticks = 1.0 / kobuki.TICK
    assert ticks == pytest.approx(11724.41658029856)
    assert 2 * math.pi * 0.035 / kobuki.TICK == pytest.approx(2578.33, abs=0.01)
    assert (kobuki.WHEEL_BASE, 1.0 / kobuki.PERIOD) == (0.230, 50.0)
    assert kobuki.ENCODER_MODULUS == kobuki.STAMP_MODULUS == create2.MODULUS == 65536
    assert math.pi * 72.0 / create2.TICK == pytest.approx(508.8 * 1000.0)
    assert (create2.WHEEL_BASE, create2.PERIOD) == (0.235, 0.015)
    # It may say it is low between what a full battery has and where the base switches off.
    assert 13.2 < kobuki.LOW_BATTERY < 16.5
    assert 12.0 < create2.LOW_VOLTAGE < 14.4
    # Bases of 0.7 m/s and 0.5 m/s.
    assert 0.7 < kobuki.MAX_SPEED < 0.8
    assert 0.5 < create2.MAX_SPEED < 0.7


def test_reach_and_readings_of_a_turn():
    reach = {"ld06": (0.02, 12.0), "ydlidar-x2": (0.12, 8.0), "ydlidar-x4": (0.12, 10.0), "rplidar": (0.15, 12.0),
             "lds01": (0.12, 3.5)}  # fmt: skip
    fans = {"ld06": ldlidar.FAN, "ydlidar-x2": ydlidar.FAN_X2, "ydlidar-x4": ydlidar.FAN_X4, "rplidar": rplidar.FAN,
            "lds01": lds01.FAN}  # fmt: skip
    assert {name: (fan.range_min, fan.range_max) for name, fan in fans.items()} == reach
    # Readings a second over turns a second, at the usual speed of each motor.
    turns = {"ld06": 4500 / 10, "ydlidar-x2": 3000 / 6.25, "ydlidar-x4": 5000 / 7, "rplidar": 4000 / 5.5, "lds01": 360}
    assert {name: fan.rays for name, fan in fans.items()} == pytest.approx(turns, rel=0.02)
    assert (ldlidar.RATE, ydlidar.RATE_X2, ydlidar.RATE_X4) == (4500.0, 3000.0, 5000.0)
    assert (ldlidar.CLOCK_MODULUS * ldlidar.CLOCK_TICK, ldlidar.READINGS, ldlidar.SIZE) == (30.0, 12, 47)
    assert [1.0 / period for period in rplidar.USUAL_PERIODS] == pytest.approx([2100.0, 4200.0], rel=0.01)
    assert (rplidar.BAUDS, rplidar.USUAL_SPEED) == ((115200, 256000), 660)
    assert rplidar.motor(rplidar.USUAL_SPEED) == bytes.fromhex("a5f0029402c1")


def test_the_geometry_of_a_urg_04lx():
    unit = Geometry()
    assert (unit.distance_min, unit.distance_max, unit.resolution) == (20, 5600, 1024)
    assert (unit.first, unit.last, unit.front, unit.speed) == (44, 725, 384, 600)
    assert math.degrees(unit.step_angle) == pytest.approx(0.3516, abs=1e-4)
    assert unit.step_time == pytest.approx(97.66e-6, abs=1e-8)
    assert unit.period == pytest.approx(0.1)
    assert ScanRequest().command(unit) == b"MD0044072501000\n"
    assert ScanRequest(128, 640, 2, 3, wide=False).command(unit) == b"MS0128064002300\n"
    assert set(BAUD_RATES) == {19200, 57600, 115200, 250000, 500000, 750000}
    assert {model: NOTHING_SEEN[model] for model in ("URG", "UTM")} == {"URG": (0, 6), "UTM": (1,)}


def test_who_sits_at_a_usb_port():
    found = {usb: {kind.name for kind in kinds_on_usb(usb, "")} for usb in ("15d1:0000", "1366:0105", "1366:1015", "10c4:ea60")}
    assert found == {
        "15d1:0000": {"scip"},
        "1366:0105": {"tlv"},
        "1366:1015": {"tlv"},
        "10c4:ea60": {"ld06", "ydlidar-x2", "ydlidar-x4", "rplidar", "lds01"},
    }
    assert [kind.name for kind in kinds_on_usb("0403:6001", "Yujin Robot iClebo KOBUKI")] == ["kobuki"]
    assert kinds_on_usb("0403:6001", "FT232R USB UART") == []


def test_a_module_is_asked_in_the_words_of_its_guide():
    words = {
        "LOC_GET": "0c00", "STATUS_GET": "3200", "VER_GET": "1500", "NODEID_GET": "3000", "PANID_GET": "2f00",
        "CFG_GET": "0800", "UPD_RATE_GET": "0400",
    }  # fmt: skip
    assert {name: getattr(dwm1001_tlv, name).hex() for name in words} == words
    assert [dwm1001_tlv.ERRORS[k].split()[0] for k in range(6)] == ["ok", "unknown", "internal", "invalid", "busy", "not"]


SILENT = {
    "kobuki": "switch it on", "create2": "press its power button", "tlv": "the USB bridge of the DEV board can hang",
    "scip": "check its 5 V supply", "ld06": "PWM wire must lie on ground",
}  # fmt: skip
"""What makers and users found to be the cause."""


@pytest.mark.parametrize("name", DEVICES)
def test_a_device_that_is_silent_is_mended_as_its_maker_says_or_by_its_power_and_cable(name):
    assert SILENT.get(name, "check its power and its cable") in DEVICES[name].silent


def test_options_that_are_not_given_change_nothing():
    """Scans all and whole, texts as they are, units of metres, radians and seconds; a number has limits that hold it."""
    defaults = {
        "steps": "", "cluster": 1, "skip": 0, "narrow": 0, "standard": 0, "tick": 0.0, "wheel_base": 0.0, "tick_modulus": 0,
        "time_unit": 1.0, "length_unit": 1.0, "angle_unit": 1.0, "unit": 1.0, "prefix": "", "tag": "",
    }  # fmt: skip
    for kind in DEVICES.values():
        for name, option in kind.options.items():
            assert name in ("columns", "baud") or option.default == defaults[name], f"{kind.name} {name}"
            assert option.bounds is None or option.bounds[0] <= option.default <= option.bounds[1]
    columns = {name: kind.options["columns"].default for name, kind in DEVICES.items() if "columns" in kind.options}
    assert columns == {"line": "t,x,y,theta", "gyro-line": "turn_rate", "uwb-line": "id,range"}
    scip = DEVICES["scip"].driver
    assert scip({}, Setup())._scans == ScanRequest()
    given = scip({"steps": "128:640", "cluster": "2", "skip": "3", "narrow": "1"}, Setup())._scans
    assert given == ScanRequest(128, 640, 2, 3, wide=False)


@pytest.mark.parametrize(
    ("name", "option", "taken", "refused"),
    [
        ("scip", "cluster", ["1", "99"], ["0", "100", "1.5"]),
        ("scip", "skip", ["0", "9"], ["-1", "10"]),
        ("scip", "narrow", ["0", "1"], ["2"]),
        ("scip", "steps", ["", "0:9999", "7:7"], ["8:7", "0:10000", "7", "a:b"]),
        ("scip", "baud", ["1200", "4000000"], ["1199", "4000001"]),
        ("uwb-line", "unit", ["1e-6", "1e3"], ["0", "1e-7", "1001", "-1"]),
        ("line", "time_unit", ["1e-12"], ["0", "-1"]),
        ("line", "length_unit", ["1e-12", "-0.5"], ["0"]),
        ("gyro-line", "angle_unit", ["-0.0175"], ["0", "nan"]),
        ("rplidar", "standard", ["0", "1"], ["2"]),
    ],
)
def test_options_are_taken_up_to_their_limits(name, option, taken, refused):
    for value in taken:
        DEVICES[name].driver({option: value}, Setup())
    for value in refused:
        with pytest.raises(ConfigError, match=f"{option}={re.escape(value)} is not "):
            DEVICES[name].driver({option: value}, Setup())
