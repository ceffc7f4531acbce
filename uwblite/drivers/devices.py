"""The table of devices: a name that users type, its options, what talks to it, and how it shows on USB.

A new device is one file with its protocol and its `Driver`, one row here, an emulator and a page in firmware_notes.
Rows of one sensor stand in the order in which an unknown port is looked at: first what talks unasked.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any
from urllib.parse import parse_qsl, urlencode

from ..clocks.device_clock import DeviceClock
from ..errors import ConfigError
from .create2 import Create2Driver
from .dwm1001_driver import Dwm1001Driver
from .events import Pose
from .kobuki import KobukiDriver
from .ldlidar import LdLidarDriver
from .lds01 import Lds01Driver
from .linktrack import BU03_BAUD, LINKTRACK_BAUD, Bu03Protocol, LinkTrackProtocol
from .odometry_line import GyroLineDriver, OdometryLineDriver, gyro_format, odometry_format
from .rplidar import RpLidarDriver
from .scip_commands import ScanRequest
from .scip_driver import ScipDriver
from .session import Driver, Session
from .text_lines import LineProtocol
from .uwb_line import BOARDS, Parse, UwbDriver, by_columns, sound_lines
from .ydlidar import YdLidarX2Driver, YdLidarX4Driver

CP2102 = ("10c4:ea60",)
"""A USB-serial chip that the adapters of many lidars have."""
SENSORS = ("uwb", "lidar", "gyro", "odometry")


@dataclass(frozen=True, slots=True)
class Setup:
    """What a driver gets besides its options."""

    start: Pose = (0.0, 0.0, 0.0)
    """Pose of the base with which odometry goes on."""
    stream: bool = True
    """Measure; False: only find out who answers."""


@dataclass(frozen=True, slots=True)
class Option:
    """What a user may write behind a port, ``?name=value&...``: a number within bounds, or a text."""

    default: Any = ""
    bounds: tuple[float, float] | None = None
    """Of a number, or of its size where it may be negative; None = a text."""
    about: str = ""
    """Unit or form, for the help."""
    whole: bool = False
    signed: bool = False
    """It may be negative."""

    def read(self, text: str, where: str) -> Any:
        """Return the value of a text; where : device and name, for the ConfigError of one that is none."""
        if self.bounds is None:
            return text
        least, most = self.bounds
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not least <= (abs(value) if self.signed else value) <= most:
            raise ConfigError(f"{where}={text} is not a number from {least:g} to {most:g}")
        if self.whole and value != int(value):
            raise ConfigError(f"{where}={text} is not a whole number")
        return int(value) if self.whole else value


def _baud(usual: int, about: str = "") -> Option:
    """Return the option for bit/s, from the least to the most that a serial port is opened with."""
    return Option(usual, (1200, 4_000_000), about, whole=True)


_TIME_UNIT = Option(1.0, (1e-12, 1e18), "s")
_SIGNED_UNIT = partial(Option, 1.0, (1e-12, 1e18), signed=True)
"""A factor, which is below 0 for an axis or a heading that counts the other way."""

Values = Mapping[str, Any]
"""Options by name, those that were not given at their defaults."""


@dataclass(frozen=True, slots=True)
class DeviceKind:
    """One row."""

    name: str
    """What users type before the port."""
    sensor: str
    """One of SENSORS."""
    title: str
    make: Callable[[Values, Setup], Driver]
    usb: tuple[str, ...] = ()
    """"vvvv:pppp" in lower-case hexadecimal."""
    product: str = ""
    """A word of its USB product name, lower case, where its USB chip is a stock one."""
    talks: bool = False
    """It talks unasked, so that listening finds it."""
    probe: bool = True
    """`uwblite devices` can distinguish it from others."""
    silent: str = "it does not answer: check its power and its cable, unplug it and plug it in again"
    """What to do when it does not answer."""
    options: Mapping[str, Option] = field(default_factory=dict)
    """By name."""

    def driver(self, texts: Mapping[str, str], setup: Setup) -> Driver:
        """Return the driver with the options that were given.

        Raises
        ------
        ConfigError : an option that it does not have, or a value that the option cannot have.
        """
        where = f"--{self.sensor} {self.name}"
        if unknown := [name for name in texts if name not in self.options]:
            known = f"known are {', '.join(self.options)}" if self.options else "it has none"
            raise ConfigError(f"{where}: unknown option {unknown[0]!r}; {known}")
        values = {name: option.default for name, option in self.options.items()}
        values |= {name: self.options[name].read(text, f"{where}: {name}") for name, text in texts.items()}
        return self.make(values, setup)

    def options_text(self) -> str:
        """Return its options for the help."""
        return ", ".join(f"{name} ({o.about})" if o.about else name for name, o in self.options.items())


def _scip(options: Values, setup: Setup) -> Driver:
    steps = options["steps"]
    first, _, last = steps.partition(":")
    if steps and not (first.isdecimal() and last.isdecimal() and int(first) <= int(last) <= 9999):
        raise ConfigError(f"scip: steps={steps} is not two steps such as 128:640")
    start, end = (int(first), int(last)) if steps else (None, None)
    request = ScanRequest(start, end, options["cluster"], options["skip"], wide=not options["narrow"])
    return ScipDriver(request, options["baud"], stream=setup.stream)


def _odometry_line(options: Values, setup: Setup) -> Driver:
    form = odometry_format(**{name: value for name, value in options.items() if name != "baud"})
    return OdometryLineDriver(form, options["baud"], setup.start)


def _gyro_line(options: Values, _setup: Setup) -> Driver:
    form = gyro_format(options["columns"], options["time_unit"], options["angle_unit"], options["prefix"])
    return GyroLineDriver(form, options["baud"])


def _board(parse: Parse, title: str, options: Values) -> Driver:
    clock = DeviceClock(options.get("time_unit", 1.0), proven=False)
    return UwbDriver(LineProtocol(sound_lines(parse)), title, options["baud"], clock, options["tag"])


def _uwb_line(options: Values, _setup: Setup) -> Driver:
    return _board(by_columns(options["columns"], options["unit"], options["prefix"]), "UWB tag that prints lines", options)


def _tag_frames(name: str, title: str, protocol: type[LinkTrackProtocol | Bu03Protocol], usual: int) -> DeviceKind:
    def make(options: Values, _setup: Setup) -> Driver:
        return UwbDriver(protocol(), title.partition(" (")[0], options["baud"], DeviceClock(1e-3, 1 << 32))

    return DeviceKind(name, "uwb", title, make, talks=True, probe=name == "linktrack", options={"baud": _baud(usual)})


def _printing_board(name: str, title: str) -> DeviceKind:
    options = {"baud": _baud(115200), "tag": Option(about="where it prints several")}
    make = partial(lambda parse, values, _setup: _board(parse, title, values), BOARDS[name])
    return DeviceKind(name, "uwb", title, make, talks=True, probe=False, options=options)


_ROWS = (
    DeviceKind(
        "kobuki",
        "odometry",
        "Kobuki base",
        lambda _, setup: KobukiDriver(setup.start),
        product="kobuki",
        talks=True,
        silent="the base is silent: switch it on (its USB chip is powered by this computer, the base is not)",
    ),
    DeviceKind(
        "create2",
        "odometry",
        "iRobot Create 2, Roomba 500 to 900",
        lambda options, setup: Create2Driver(setup.start, options["baud"]),
        silent="the base is silent: press its power button, check the cable (115200 bit/s, 5 V levels)",
        options={"baud": _baud(115200)},
    ),
    DeviceKind(
        "line",
        "odometry",
        "base that prints text lines",
        _odometry_line,
        talks=True,
        probe=False,
        options={
            "columns": Option("t,x,y,theta", about="t,x,y,theta | t,left,right | speed, turn_rate, - to skip"),
            "tick": Option(0.0, (0.0, 1e18), "m"),
            "wheel_base": Option(0.0, (0.0, 1e18), "m"),
            "tick_modulus": Option(0, (0, 1e18), whole=True),
            "time_unit": _TIME_UNIT,
            "length_unit": _SIGNED_UNIT(about="m"),
            "angle_unit": _SIGNED_UNIT(about="rad"),
            "prefix": Option(),
            "baud": _baud(115200),
        },
    ),
    DeviceKind(
        "gyro-line",
        "gyro",
        "gyro or IMU that prints its yaw rate or yaw (also line:PORT)",
        _gyro_line,
        talks=True,
        probe=False,
        options={
            "columns": Option("turn_rate", about="turn_rate | theta, t, - to skip"),
            "angle_unit": _SIGNED_UNIT(about="rad"),
            "time_unit": _TIME_UNIT,
            "prefix": Option(),
            "baud": _baud(115200),
        },
    ),
    DeviceKind(
        "tlv",
        "uwb",
        "DWM1001 tag with PANS R2, 1 mm",
        lambda _, setup: Dwm1001Driver(stream=setup.stream),
        usb=("1366:0105", "1366:1015"),
        silent="the tag is silent: unplug and replug it (the USB bridge of the DEV board can hang)",
    ),
    DeviceKind(
        "shell",
        "uwb",
        "DWM1001 tag with PANS R2 by its text shell, 1 cm",
        lambda _, setup: Dwm1001Driver(shell=True, stream=setup.stream),
        probe=False,
    ),
    DeviceKind(
        "uwb-line",
        "uwb",
        "UWB tag that prints lines (also line:PORT)",
        _uwb_line,
        talks=True,
        probe=False,
        options={
            "columns": Option("id,range", about="id,range | range:NAME,... | t, quality, tag, - to skip"),
            "unit": Option(1.0, (1e-6, 1e3), "m"),
            "time_unit": _TIME_UNIT,
            "prefix": Option(),
            "tag": Option(),
            "baud": _baud(115200),
        },
    ),
    _printing_board("makerfabs", "Makerfabs ESP32 UWB (DW1000 example)"),
    _printing_board("makerfabs-at", "Makerfabs ESP32 UWB DW3000 (AT firmware)"),
    _printing_board("bu01", "Ai-Thinker BU01"),
    _printing_board("dwm3001", "Qorvo DWM3001CDK (CLI firmware, INITF)"),
    _tag_frames("bu03", "Ai-Thinker BU03", Bu03Protocol, BU03_BAUD),
    _tag_frames("linktrack", "Nooploop LinkTrack (Tag_Frame0)", LinkTrackProtocol, LINKTRACK_BAUD),
    DeviceKind(
        "scip",
        "lidar",
        "Hokuyo URG-04LX and others that speak SCIP",
        _scip,
        usb=("15d1:0000",),
        silent="the lidar is silent: unplug and replug it, check its 5 V supply (it draws up to 0.8 A at start)",
        options={
            "steps": Option(about="first:last"),
            "cluster": Option(1, (1, 99), whole=True),
            "skip": Option(0, (0, 9), whole=True),
            "narrow": Option(0, (0, 1), "1: 2-character readings", whole=True),
            "baud": _baud(ScipDriver.baud),
        },
    ),
    DeviceKind(
        "ld06",
        "lidar",
        "LDROBOT LD06, LD19, STL-19P",
        lambda *_: LdLidarDriver(),
        CP2102,
        talks=True,
        silent="the lidar is silent: its motor must turn, and its PWM wire must lie on ground or hang free",
    ),
    DeviceKind("ydlidar-x2", "lidar", "YDLIDAR X2", lambda *_: YdLidarX2Driver(), CP2102, talks=True),
    DeviceKind("ydlidar-x4", "lidar", "YDLIDAR X4", lambda *_: YdLidarX4Driver(), CP2102),
    DeviceKind(
        "rplidar",
        "lidar",
        "Slamtec RPLIDAR A1, A2, A3",
        lambda options, _setup: RpLidarDriver(not options["standard"], options["baud"]),
        usb=CP2102,
        options={
            "standard": Option(0, (0, 1), "1: standard instead of express scan", whole=True),
            "baud": _baud(RpLidarDriver.baud, "found by itself"),
        },
    ),
    DeviceKind("lds01", "lidar", "Hitachi-LG LDS-01 (HLS-LFCD2)", lambda *_: Lds01Driver(), CP2102),
)
DEVICES = {kind.name: kind for kind in _ROWS}
"""By name. The first kind of a sensor that has no name of its own in what the user wrote is DEFAULT's."""
DEFAULT = {"uwb": "tlv", "lidar": "scip"}
ALIASES = {("uwb", "dwm1001"): "tlv", ("uwb", "line"): "uwb-line", ("gyro", "line"): "gyro-line"}


def open_device(sensor: str, spec: str, setup: Setup = Setup()) -> tuple[Session, str]:
    """Return the session for what a user wrote, ``[NAME:]PORT[?option=value&...]``, and the URL of its port.

    Raises
    ------
    ConfigError : no such device, no port, or an option that it does not have.
    """
    name, separator, rest = spec.partition(":")
    kind = DEVICES.get(ALIASES.get((sensor, name), name))
    if not separator or kind is None:
        if sensor not in DEFAULT:
            raise ConfigError(f"--{sensor} {spec}: say {' or '.join(f'{name}:PORT' for name in _names(sensor))}")
        kind, rest = DEVICES[DEFAULT[sensor]], spec
    if kind.sensor != sensor:
        raise ConfigError(f"--{sensor} {spec}: {kind.name} is no {sensor}; known are {', '.join(_names(sensor))}")
    port, _, query = rest.partition("?")
    try:
        # The command line hands over bytes that are no text as surrogates, which no URL takes.
        texts = dict(parse_qsl(query.encode().decode(), keep_blank_values=True))
    except UnicodeError as error:
        raise ConfigError(f"--{sensor} {spec}: its options are no text in UTF-8") from error
    if "://" in port:
        # What the device does not know may be meant for the port: rfc2217://host:port?ign_set_control
        of_port = {name: texts.pop(name) for name in list(texts) if name not in kind.options}
        port += "?" + urlencode(of_port) if of_port else ""
    driver = kind.driver(texts, setup)
    if not port:
        raise ConfigError(f"--{sensor} {spec}: it names no port, as {kind.name}:/dev/ttyUSB0 does")
    return Session(driver), port


def _names(sensor: str) -> list[str]:
    return [kind.name for kind in DEVICES.values() if kind.sensor == sensor]


def kinds_on_usb(usb_id: str, text: str) -> list[DeviceKind]:
    """Return the devices that a USB port may belong to, by its "vvvv:pppp" in hexadecimal, and manufacturer and product."""
    of_usb = (kind for kind in DEVICES.values() if usb_id in kind.usb or (kind.product and kind.product in text.lower()))
    return [kind for kind in of_usb if kind.probe]
