"""Ports: those that do not open say how to mend that, those that do are held alone and hold up nobody."""

import os
import select
import socket
import time
from contextlib import closing
from types import SimpleNamespace

import pytest

from uwblite.drivers import transport
from uwblite.drivers.devices import open_device
from uwblite.drivers.link import BACK_OFF, HANG, Link
from uwblite.drivers.transport import PluggedIn, _explain, open_port, plugged_in, stable_name
from uwblite.errors import DeviceError


@pytest.mark.parametrize(("url", "error", "words"), [
    ("socket://10.0.0.9:4000", OSError("timed out"), "socket://10.0.0.9:4000: cannot open (timed out)"),
    ("{own}", OSError(13, "denied"), "{own}: no permission; run `sudo usermod -aG dialout $USER`, log out and in again"),
    ("{own}", OSError("Permission denied: /dev/x"), "{own}: no permission; run `sudo"),
    ("{own}", OSError(16, "busy"), "{own}: another program has it open (ModemManager"),
    ("{own}", OSError("Could not exclusively lock port"), "{own}: another program has it open (ModemManager"),
    ("/dev/null", OSError("Could not configure port: (25, 'ioctl')"), "/dev/null: not a serial port"),
    ("{own}", OSError("Could not configure port"), "{own}: cannot open (Could not configure port)"),
])  # fmt: skip
def test_a_port_that_does_not_open_is_explained(tmp_path, url, error, words):
    own = tmp_path / "port"
    own.touch()
    assert _explain(url.format(own=own), error).startswith(words.format(own=own))


@pytest.mark.parametrize("name", ["clock", "Permission", "configure port"])
def test_words_of_a_ports_own_path_explain_nothing(tmp_path, name):
    own = tmp_path / name
    own.touch()
    text = f"could not open port {own}: input/output error"
    assert _explain(str(own), OSError(5, text)).startswith(f"{own}: cannot open ([Errno 5] could not open")


def test_a_port_that_is_not_there_names_those_that_are(tmp_path, monkeypatch):
    monkeypatch.setattr(transport, "BY_ID", tmp_path / "none")
    assert _explain(f"{tmp_path}/ttyUSB7", OSError("no such file")).endswith("ttyUSB7: no such port; nothing is plugged in")
    for name in ("usb-b", "usb-a"):
        (tmp_path / name).touch()
    monkeypatch.setattr(transport, "BY_ID", tmp_path)
    assert _explain(f"{tmp_path}/ttyUSB7", OSError("no such file")).endswith(f"in {tmp_path} there are: usb-a, usb-b")


@pytest.fixture
def line():
    """The device's end of a serial line, and the name of ours."""
    device, ours = os.openpty()
    name = os.ttyname(ours)
    os.close(ours)
    yield device, name
    os.close(device)


def test_a_port_is_open_once(line):
    port = open_port(line[1], 115200)
    with pytest.raises(DeviceError, match="another program has it open"):
        open_port(line[1], 115200)
    port.close()
    open_port(line[1], 115200).close()


def test_a_device_that_takes_no_bytes_does_not_hold_up_the_others(line):
    """Nobody reads at its end: what is sent is refused once the line is full, not waited for."""
    with closing(open_port(line[1], 115200)) as port, pytest.raises(DeviceError, match="takes no bytes"):
        port.write(bytes(1 << 20))


def test_a_line_on_which_bytes_wait_is_not_gone(line):
    """As where they come between a read that found none and the look whether the device is still there."""
    with closing(open_port(line[1], 115200)) as port:
        assert not port._hung_up()
        os.write(line[0], b"here\n")
        assert not port._hung_up()
        assert port.read() == b"here\n"


@pytest.mark.parametrize("end", [lambda link: link.disconnect(1.0), Link.finish])
def test_a_link_that_ends_leaves_the_port_to_others(line, end):
    session, _ = open_device("lidar", line[1])
    link = Link("lidar", line[1], session)
    port = link.port = open_port(line[1], 115200)
    end(link)
    assert link.port is None
    open_port(port.url, 115200).close()


def test_a_device_that_is_gone_is_looked_for_after_pauses_that_grow(line, tmp_path):
    def connected(url, now):
        link.url = url
        while (port := link.connect(now, open_port)) is None:
            time.sleep(1e-3)
        return port

    session, _ = open_device("lidar", line[1])
    link = Link("lidar", line[1], session)
    connected(line[1], 5.0)
    link.disconnect(10.0)
    waits = [link.retry_at - 10.0]
    for now in range(20, 80, 10):
        assert isinstance(connected(f"{tmp_path}/none", now), DeviceError)
        waits.append(link.retry_at - now)
    assert waits == pytest.approx([*BACK_OFF, *[BACK_OFF[-1]] * (7 - len(BACK_OFF))])
    connected(line[1], 80.0)
    link.disconnect(90.0)
    assert link.retry_at == 90.0 + BACK_OFF[0]


@pytest.mark.parametrize(
    ("message", "event", "data", "words"),
    [
        (0.0, 0.0, 0.0, "check power and cable"),
        (0.0, 0.0, HANG, "bytes come, but no good frame"),
        (0.0, HANG, HANG, "it answers, but measures nothing"),
        (HANG, HANG, HANG, None),
    ],
)
def test_a_port_is_opened_again_where_no_byte_comes_and_a_device_that_is_silent_is_said_with_the_cause(
    line, message, event, data, words
):
    session, _ = open_device("lidar", line[1])
    for later, hangs in ((0.0, False), (1.0, data < HANG)):
        link = Link("lidar", line[1], session)
        link.last_message, link.last_data, session.last_event = 50.0 + message, 50.0 + data, 50.0 + event
        note, again = link.watch(50.0 + HANG + later)
        assert again is hangs
        assert note is None if words is None else words in note.text


@pytest.fixture
def bridge():
    """A server's end of a TCP bridge, and the port on ours."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(20.0)
        with closing(open_port(f"socket://127.0.0.1:{server.getsockname()[1]}", 115200)) as port, server.accept()[0] as far:
            far.settimeout(20.0)
            yield far, port


def test_a_bridge_gives_what_has_come_takes_what_is_sent_and_says_that_it_is_closed(bridge):
    far, port = bridge
    assert port.read() == b""
    far.sendall(b"here\n")
    assert select.select([port.fileno()], [], [], 20.0)[0]
    assert port.read() == b"here\n"
    port.set_baud(9600), port.set_dtr(True)
    port.write(b"there")
    assert far.recv(100) == b"there"
    with pytest.raises(DeviceError, match=f"{port.url}: it takes no bytes"):
        [port.write(bytes(1 << 20)) for _ in range(100)]
    far.close()
    assert select.select([port.fileno()], [], [], 20.0)[0]
    with pytest.raises(DeviceError, match=rf"{port.url}: (the other side closed the connection|unplugged or gone \(.+\))"):
        port.read()
    port.close()
    with pytest.raises(DeviceError, match=rf"{port.url}: unplugged or gone \(.*Bad file descriptor"):
        port.read()
    with pytest.raises(DeviceError, match=rf"{port.url}: cannot write \(.*Bad file descriptor"):
        port.write(b"x")


def test_a_bridge_that_ends_in_peace_is_said_to_be_closed(bridge):
    far, port = bridge
    far.shutdown(socket.SHUT_WR)
    assert select.select([port.fileno()], [], [], 20.0)[0]
    with pytest.raises(DeviceError, match="the other side closed the connection"):
        port.read()


def test_a_line_whose_other_end_is_gone_is_unplugged(line):
    port = open_port(line[1], 115200)
    device, spare = os.openpty()
    os.close(spare)
    os.dup2(device, line[0])
    os.close(device)
    for act, words in ((port.read, r"unplugged or gone \("), (lambda: port.write(b"x"), r"cannot write \(")):
        with pytest.raises(DeviceError, match=f"{line[1]}: {words}"):
            act()
    port.close()


def test_speed_and_dtr_go_to_the_port_and_ports_without_them_pass_them_over():
    with closing(open_port("loop://", 9600)) as port:
        port.set_baud(57600)
        port.set_dtr(False)
        assert (port._serial.baudrate, port._serial.dtr) == (57600, False)
        port.set_dtr(True)
        assert port._serial.dtr
        port.set_baud(-1)
        port.write(b"round")
        assert port.read() == b"round"
        assert port.read() == b""


def test_ports_of_this_computer_have_lasting_names_and_what_is_no_device_is_left_out(tmp_path, monkeypatch):
    class Found(SimpleNamespace):
        def __lt__(self, other):
            return self.device < other.device

    def found(device, vid, pid, *words):
        named = zip(("manufacturer", "product", "description"), words, strict=True)
        return Found(device=str(device), vid=vid, pid=pid, **dict(named))

    names = tmp_path / "by-id"
    names.mkdir()
    for name in ("ttyACM0", "ttyUSB3"):
        (tmp_path / name).touch()
    (names / "usb-SEGGER").symlink_to(tmp_path / "ttyACM0")
    monkeypatch.setattr(transport, "BY_ID", names)
    ports = [
        found("/dev/ttyS7", None, None, None, None, "ttyS7"),
        found(tmp_path / "ttyUSB3", 0x10C4, 0xEA60, None, None, "CP2102"),
        found(tmp_path / "ttyACM0", 0x1366, 0x0105, "SEGGER", "J-Link", "J-Link CDC"),
        found("/dev/ttyS0", None, None, None, None, "ttyS0"),
    ]
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: ports)
    assert plugged_in() == [
        PluggedIn("/dev/ttyS0", "ttyS0", ""),
        PluggedIn(str(names / "usb-SEGGER"), "SEGGER J-Link", "1366:0105"),
        PluggedIn(str(tmp_path / "ttyUSB3"), "CP2102", "10c4:ea60"),
    ]
    assert stable_name(str(tmp_path / "ttyACM0")) == str(names / "usb-SEGGER")
    assert stable_name(str(tmp_path / "ttyUSB3")) is None
    assert stable_name(f"socket://{tmp_path}/ttyACM0") is None
    assert stable_name(str(names / "usb-SEGGER")) == str(names / "usb-SEGGER")
