"""The table of devices: a name that users type, what talks to it, and how it shows on USB.

A new device is one file with its protocol and its `Driver`, one row here, an emulator and a page in firmware_notes.
Rows of one sensor stand in the order in which an unknown port is looked at: first what talks unasked.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from urllib.parse import parse_qsl, urlencode

from ..clocks.device_clock import DeviceClock
from ..errors import ConfigError
from .create2 import Create2Driver
from .device_options import BAUD, Options, Setup
from .dwm1001_driver import Dwm1001Driver
from .gyro_line import GyroLineDriver, gyro_format
from .kobuki import KobukiDriver
from .ldlidar import LdLidarDriver
from .lds01 import Lds01Driver
from .linktrack import BU03_BAUD, LINKTRACK_BAUD, Bu03Protocol, LinkTrackProtocol
from .odometry_line import OdometryLineDriver, parse_format
from .rplidar import RpLidarDriver
from .scip_driver import ScipDriver
from .session import Driver, Session
from .text_lines import LineProtocol
from .uwb_driver import UwbDriver
from .uwb_line import BOARDS, Parse, by_columns, parse_columns, within_reach
from .ydlidar import YdLidarX2Driver, YdLidarX4Driver

CP2102 = ("10c4:ea60",)
"""A USB-serial chip that the adapters of many lidars have."""
SENSORS = ("uwb", "lidar", "gyro", "odometry")


@dataclass(frozen=True, slots=True)
class DeviceKind:
    """One row."""

    name: str
    """What users type before the port."""
    sensor: str
    """One of SENSORS."""
    title: str
    make: Callable[[Options, Setup], Driver]
    baud: int = 115200
    """bit/s that it is looked for with first."""
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
    options: str = ""
    """Its options, for the help."""


def _scip(options: Options, setup: Setup) -> Driver:
    steps = options.text("steps")
    first, _, last = steps.partition(":")
    if steps and not (first.isdecimal() and last.isdecimal() and int(first) <= int(last) <= 9999):
        raise ConfigError(f"{options.device}: steps={steps} is not two steps such as 128:640")
    return ScipDriver(
        int(first) if steps else None, int(last) if steps else None, cluster=options.whole("cluster", 1, 1, 99),
        skip=options.whole("skip", 0, 0, 9), wide=not options.whole("narrow", 0, 0, 1),
        baud=options.whole("baud", ScipDriver.baud, *BAUD), stream=setup.stream,
    )  # fmt: skip


def _line(options: Options, setup: Setup) -> Driver:
    baud = options.whole("baud", OdometryLineDriver.baud, *BAUD)
    options.known += options.values
    return OdometryLineDriver(parse_format({k: v for k, v in options.values.items() if k != "baud"}), baud, setup.start)


def _uwb_line(options: Options, _setup: Setup) -> Driver:
    form = parse_columns(
        options.text("columns", "id,range"), options.number("unit", 1.0, 1e-6, 1e3), options.text("prefix")
    )  # fmt: skip
    return _board(by_columns(form), "UWB tag that prints lines", options)


def _gyro_line(options: Options, _setup: Setup) -> Driver:
    form = gyro_format(
        options.text("columns", "turn_rate"), options.number("time_unit", 1.0, 1e-12, 1e6),
        options.number("angle_unit", 1.0, -1e3, 1e3), options.text("prefix"),
    )  # fmt: skip
    return GyroLineDriver(form, options.whole("baud", GyroLineDriver.baud, *BAUD))


def _board(parse: Parse, title: str, options: Options) -> Driver:
    baud, unit = options.whole("baud", 115200, *BAUD), options.number("time_unit", 1.0, 1e-12, 1e6)
    clock = DeviceClock(unit, proven=False)
    return UwbDriver(LineProtocol(within_reach(parse)), title, baud, clock, unit, options.text("tag"))


def _tag_frames(protocol: type[LinkTrackProtocol | Bu03Protocol], title: str, usual: int) -> Callable[[Options, Setup], Driver]:
    return lambda options, _setup: UwbDriver(
        protocol(), title, options.whole("baud", usual, *BAUD), DeviceClock(1e-3, 1 << 32), 1e-3
    )  # fmt: skip


def _printing_board(name: str, title: str) -> DeviceKind:
    make = partial(lambda parse, options, _setup: _board(parse, title, options), BOARDS[name])
    return DeviceKind(name, "uwb", title, make, talks=True, probe=False, options="baud, tag (where it prints several)")


def _rplidar(options: Options, _setup: Setup) -> Driver:
    return RpLidarDriver(not options.whole("standard", 0, 0, 1), options.whole("baud", RpLidarDriver.baud, *BAUD))


DEVICES = {
    kind.name: kind
    for kind in (
        DeviceKind(
            "kobuki", "odometry", "Kobuki base", lambda _o, setup: KobukiDriver(setup.start), product="kobuki", talks=True,
            silent="the base is silent: switch it on (its USB chip is powered by this computer, the base is not)",
        ),
        DeviceKind(
            "create2", "odometry", "iRobot Create 2, Roomba 500 to 900",
            lambda options, setup: Create2Driver(setup.start, options.whole("baud", 115200, *BAUD)), options="baud",
            silent="the base is silent: press its power button, check the cable (115200 bit/s, 5 V levels)",
        ),
        DeviceKind(
            "line", "odometry", "base that prints text lines", _line, talks=True, probe=False,
            options="columns (t,x,y,theta | t,left,right | speed, turn_rate, - to skip), tick (m), wheel_base (m),"
            " tick_modulus, time_unit (s), length_unit (m), angle_unit (rad), prefix, baud",
        ),
        DeviceKind(
            "gyro-line", "gyro", "gyro or IMU that prints its yaw rate or yaw (also line:PORT)", _gyro_line, talks=True,
            probe=False, options="columns (turn_rate | theta, t, - to skip), angle_unit (rad), time_unit (s), prefix, baud",
        ),
        DeviceKind(
            "tlv", "uwb", "DWM1001 tag with PANS R2, 1 mm", lambda _o, setup: Dwm1001Driver(stream=setup.stream),
            usb=("1366:0105", "1366:1015"),
            silent="the tag is silent: unplug and replug it (the USB bridge of the DEV board can hang)",
        ),
        DeviceKind(
            "shell", "uwb", "DWM1001 tag with PANS R2 by its text shell, 1 cm",
            lambda _o, setup: Dwm1001Driver(shell=True, stream=setup.stream), probe=False,
        ),
        DeviceKind(
            "uwb-line", "uwb", "UWB tag that prints lines (also line:PORT)", _uwb_line, talks=True, probe=False,
            options="columns (id,range | range:NAME,... | t, quality, tag, - to skip), unit (m), time_unit (s), prefix,"
            " tag, baud",
        ),
        _printing_board("makerfabs", "Makerfabs ESP32 UWB (DW1000 example)"),
        _printing_board("makerfabs-at", "Makerfabs ESP32 UWB DW3000 (AT firmware)"),
        _printing_board("bu01", "Ai-Thinker BU01"),
        _printing_board("dwm3001", "Qorvo DWM3001CDK (CLI firmware, INITF)"),
        DeviceKind(
            "bu03", "uwb", "Ai-Thinker BU03", _tag_frames(Bu03Protocol, "Ai-Thinker BU03", BU03_BAUD), talks=True,
            probe=False, options="baud",
        ),
        DeviceKind(
            "linktrack", "uwb", "Nooploop LinkTrack (Tag_Frame0)",
            _tag_frames(LinkTrackProtocol, "Nooploop LinkTrack", LINKTRACK_BAUD), talks=True, options="baud",
        ),
        DeviceKind(
            "scip", "lidar", "Hokuyo URG-04LX and others that speak SCIP", _scip, usb=("15d1:0000",),
            silent="the lidar is silent: unplug and replug it, check its 5 V supply (it draws up to 0.8 A at start)",
            options="steps (first:last), cluster, skip, narrow (1: 2-character readings), baud",
        ),
        DeviceKind(
            "ld06", "lidar", "LDROBOT LD06, LD19, STL-19P", lambda _o, _s: LdLidarDriver(), LdLidarDriver.baud, CP2102,
            talks=True, silent="the lidar is silent: its motor must turn, and its PWM wire must lie on ground or hang free",
        ),
        DeviceKind(
            "ydlidar-x2", "lidar", "YDLIDAR X2", lambda _o, _s: YdLidarX2Driver(), YdLidarX2Driver.baud, CP2102, talks=True,
        ),
        DeviceKind("ydlidar-x4", "lidar", "YDLIDAR X4", lambda _o, _s: YdLidarX4Driver(), YdLidarX4Driver.baud, CP2102),
        DeviceKind(
            "rplidar", "lidar", "Slamtec RPLIDAR A1, A2, A3", _rplidar, usb=CP2102,
            options="standard (1: standard instead of express scan), baud (found by itself)",
        ),
        DeviceKind("lds01", "lidar", "Hitachi-LG LDS-01 (HLS-LFCD2)", lambda _o, _s: Lds01Driver(), Lds01Driver.baud, CP2102),
    )
}  # fmt: skip
"""By name. The first kind of a sensor that has no name of its own in what the user wrote is DEFAULT's."""
DEFAULT = {"uwb": "tlv", "lidar": "scip"}
ALIASES = {("uwb", "dwm1001"): "tlv", ("uwb", "line"): "uwb-line", ("gyro", "line"): "gyro-line"}


def open_device(sensor: str, spec: str, setup: Setup | None = None, more: dict[str, str] | None = None) -> tuple[Session, str]:
    """Return the session for what a user wrote, and the URL of its port.

    Parameters
    ----------
    sensor : one of SENSORS.
    spec : ``[NAME:]PORT[?option=value&...]``.
    setup : what the driver gets besides its options.
    more : options from elsewhere; those of `spec` win.

    Returns
    -------
    session, url

    Raises
    ------
    ConfigError : no such device, no port, or an option that it does not have.
    """
    name, separator, rest = spec.partition(":")
    name = ALIASES.get((sensor, name), name)
    kind = DEVICES.get(name)
    if not separator or kind is None:
        if sensor not in DEFAULT:
            raise ConfigError(f"--{sensor} {spec}: say {' or '.join(f'{name}:PORT' for name in _names(sensor))}")
        kind, rest = DEVICES[DEFAULT[sensor]], spec
    if kind.sensor != sensor:
        raise ConfigError(f"--{sensor} {spec}: {kind.name} is no {sensor}; known are {', '.join(_names(sensor))}")
    port, _, query = rest.partition("?")
    try:
        # The command line hands over bytes that are no text as surrogates, which no URL takes.
        pairs = dict(parse_qsl(query.encode().decode(), keep_blank_values=True))
    except UnicodeError as error:
        raise ConfigError(f"--{sensor} {spec}: its options are no text in UTF-8") from error
    options = Options(f"--{sensor} {kind.name}", {**(more or {}), **pairs})
    driver = kind.make(options, setup or Setup())
    if "://" in port:
        # What the device does not know may be meant for the port: rfc2217://host:port?ign_set_control
        port_options = {key: value for key, value in pairs.items() if key not in options.known}
        options.known += port_options
        port += "?" + urlencode(port_options) if port_options else ""
    options.finish()
    if not port:
        raise ConfigError(f"--{sensor} {spec}: it names no port, as {kind.name}:/dev/ttyUSB0 does")
    return Session(driver), port


def _names(sensor: str) -> list[str]:
    return [kind.name for kind in DEVICES.values() if kind.sensor == sensor]


def kinds_on_usb(usb_id: str, text: str) -> list[DeviceKind]:
    """Return the devices that a USB port may belong to.

    Parameters
    ----------
    usb_id : "vvvv:pppp" in lower-case hexadecimal.
    text : manufacturer and product.

    Returns
    -------
    list of DeviceKind
    """
    return [
        kind for kind in DEVICES.values()
        if kind.probe and (usb_id in kind.usb or (kind.product and kind.product in text.lower()))
    ]  # fmt: skip
