"""Whatever comes down a wire: no exception, bounded memory, bounded work per byte. 300,000 bytes a case with --slow."""

import random
import sys

import pytest
from fuzzing.device_words import WORDS
from helpers.driver_harness import ROOT  # noqa: F401
from hypothesis import given, settings
from hypothesis import strategies as st

from uwblite.drivers.create2 import Create2Protocol
from uwblite.drivers.devices import DEVICES, open_device
from uwblite.drivers.dwm1001_shell import ShellProtocol
from uwblite.drivers.dwm1001_tlv import TlvProtocol
from uwblite.drivers.kobuki import KobukiProtocol
from uwblite.drivers.ldlidar import LdLidarProtocol
from uwblite.drivers.lds01 import Lds01Protocol
from uwblite.drivers.linktrack import Bu03Protocol, LinkTrackProtocol
from uwblite.drivers.odometry_line import LineFormat, gyro_format, values_by
from uwblite.drivers.rplidar import RpLidarProtocol
from uwblite.drivers.scip import ScipProtocol
from uwblite.drivers.text_lines import LineProtocol
from uwblite.drivers.uwb_line import BOARDS, by_columns
from uwblite.drivers.ydlidar import YdLidarProtocol
from uwblite.errors import ConfigError

PROTOCOLS = {
    "scip": (ScipProtocol, WORDS["scip"]),
    "tlv": (TlvProtocol, WORDS["tlv"]),
    "shell": (ShellProtocol, WORDS["shell"]),
    "kobuki": (KobukiProtocol, WORDS["kobuki"]),
    "line": (lambda: LineProtocol(values_by(LineFormat())), WORDS["line"]),
    "create2": (Create2Protocol, WORDS["create2"]),
    "gyro-line": (lambda: LineProtocol(values_by(gyro_format("turn_rate", 1.0, 1.0, ""))), WORDS["line"]),
    "uwb-line": (lambda: LineProtocol(by_columns("id,range")), WORDS["uwb-line"]),
    **{name: (lambda parse=parse: LineProtocol(parse), WORDS[name]) for name, parse in BOARDS.items()},
    "linktrack": (LinkTrackProtocol, WORDS["linktrack"]),
    "bu03": (Bu03Protocol, WORDS["bu03"]),
    "ld06": (LdLidarProtocol, WORDS["ld06"]),
    "ydlidar-x2": (lambda: YdLidarProtocol(3000.0), WORDS["ydlidar-x2"]),
    "ydlidar-x4": (lambda: YdLidarProtocol(5000.0), WORDS["ydlidar-x4"]),
    "rplidar": (RpLidarProtocol, WORDS["rplidar"]),
    "lds01": (Lds01Protocol, WORDS["lds01"]),
}
SESSIONS = tuple(DEVICES)
LINE_OPTIONS = "?columns=t,x,y,theta"


def session_of(name):
    return open_device(DEVICES[name].sensor, f"{name}:/dev/null" + LINE_OPTIONS * (name == "line"))[0]


@pytest.mark.parametrize("query", ["baud=\udcff", "\udcc5=1", "baud=9600&id=\ud800"])
def test_options_that_are_no_text_are_wrong_options(query):
    """As the command line hands over bytes that are no UTF-8."""
    with pytest.raises(ConfigError, match="no text in UTF-8"):
        open_device("uwb", f"tlv:/dev/null?{query}")


@pytest.mark.parametrize(
    ("option", "why"),
    [("time_unit=0.5", None), ("time_unit=", "not a number"), ("baud=9600.5", "not a whole"), ("baud=", "not a number")],
)
def test_an_option_is_a_number_a_fraction_only_where_it_may_be_one(option, why):
    """And one without a value is none that was not given."""
    url = f"line:/dev/null?columns=t,x,y,theta&{option}"
    if why is None:
        assert open_device("odometry", url)
    else:
        with pytest.raises(ConfigError, match=why):
            open_device("odometry", url)


def memory(value):
    """Return the bytes that a protocol holds, in whatever it is made of."""
    if isinstance(value, bytearray | bytes):
        return len(value)
    if isinstance(value, list | tuple):
        return 16 + sum(map(memory, value))
    return sum(map(memory, vars(value).values())) if hasattr(value, "__dict__") and not callable(value) else 0


def pieces(words):
    return st.lists(st.one_of(st.sampled_from(words), st.binary(max_size=40)), max_size=40)


@pytest.mark.parametrize("name", PROTOCOLS)
@settings(max_examples=25)
@given(data=st.data())
def test_protocols_take_anything(name, data):
    make, words = PROTOCOLS[name]
    protocol = make()
    for piece in data.draw(pieces(words)):
        protocol.feed(piece, 1.0)
        assert memory(protocol) < 120_000


@pytest.mark.parametrize("name", PROTOCOLS)
@settings(max_examples=15)
@given(data=st.data())
def test_splits_do_not_matter_for_any_input(name, data):
    """The good events of any bytes are the same whole and byte by byte."""
    from helpers.driver_harness import good

    make, words = PROTOCOLS[name]
    stream = b"".join(data.draw(pieces(words)))
    whole, single = make(), make()
    bytewise = [event for i in range(len(stream)) for event in single.feed(stream[i : i + 1], 1.0)]
    assert good(whole.feed(stream, 1.0)) == good(bytewise)


@pytest.mark.parametrize("name", SESSIONS)
@settings(max_examples=15)
@given(data=st.data())
def test_sessions_take_anything_at_any_time(name, data):
    words = PROTOCOLS[name][1]
    session, now = session_of(name), 0.0
    session.start(now)
    for piece in data.draw(pieces(words)):
        now += data.draw(st.sampled_from([0.0, 0.001, 0.1, 0.3, 1.2, 5.0]))
        session.feed(piece, now)
        session.tick(now)
    session.stop()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["noise", "words", "mutated"])
@pytest.mark.parametrize("name", PROTOCOLS)
def test_many_bytes(name, kind):
    """Work per byte is bounded: counted in Python calls, so that the machine's load does not matter."""
    make, words = PROTOCOLS[name]
    rng = random.Random(f"{name} {kind}")
    protocol, session, fed, largest, now = make(), session_of(name), 0, 0, 0.0
    session.start(now)
    calls = [0]

    def count(_frame, event, _arg):
        calls[0] += event in ("call", "c_call")

    while fed < 100_000:
        if kind == "noise":
            piece = rng.randbytes(rng.randrange(1, 2000))
        else:
            piece = b"".join(rng.choice([*words, rng.randbytes(3)]) for _ in range(rng.randrange(1, 100)))
            if kind == "mutated":
                piece = bytes(b if rng.random() > 0.02 else rng.randrange(256) for b in piece)
        fed += len(piece)
        now += 0.01
        sys.setprofile(count)
        protocol.feed(piece, now)
        sys.setprofile(None)
        session.feed(piece, now)
        session.tick(now)
        largest = max(largest, memory(protocol))
    assert largest < 120_000
    assert calls[0] < 60 * fed
