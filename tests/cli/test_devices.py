"""`uwblite devices`: who is at a port, on an emulator and a clock of the test's own."""

import json
from types import SimpleNamespace

import pytest
from emulators.dwm_device import DwmDevice, DwmOptions
from emulators.world import WorldClock

from uwblite.cli import devices, main
from uwblite.drivers.devices import DEVICES
from uwblite.errors import DeviceError

KINDS = {kind.name: kind for kind in DEVICES.values()}


class Clock:
    """Time passes while it is slept."""

    def __init__(self):
        self.now = 100.0

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


class Wire:
    """A port at whose other end a device sits; None = nothing does."""

    def __init__(self, clock, device=None):
        self.clock, self.device, self.waiting, self.closed, self.bauds = clock, device, b"", False, []

    def read(self):
        arrived = self.waiting + (self.device.advance(self.clock.now) if self.device else b"")
        self.waiting = b""
        return arrived

    def write(self, data):
        self.waiting += self.device.receive(data, self.clock.now) if self.device else b""

    def set_baud(self, rate):
        self.bauds.append(rate)

    def set_dtr(self, on):
        pass

    def close(self):
        self.closed = True


class Talker:
    """A base that prints where it is ten times a second."""

    def __init__(self, since):
        self.since, self.said = since, 0

    def advance(self, now):
        many = int((now - self.since) / 0.1)
        lines = [f"{0.1 * k:.1f},{0.02 * k:.2f},0,0\n" for k in range(self.said, many)]
        self.said = many
        return "".join(lines).encode()

    def receive(self, data, now):
        return b""


@pytest.fixture
def plug(monkeypatch):
    """Return a function that puts a device at the port of a name, and gives the wire."""
    clock, wires = Clock(), {}
    monkeypatch.setattr(devices, "time", clock)

    def opened(path, baud):
        if path not in wires:
            raise DeviceError(f"{path}: no such port")
        return wires[path]

    monkeypatch.setattr(devices, "open_port", opened)
    monkeypatch.setattr(devices, "check_url", lambda path: None)

    def put(path, device=None):
        wires[path] = Wire(clock, device)
        return wires[path]

    put.clock = clock
    return put


def module(**options):
    clock = WorldClock()
    device = DwmDevice(iter(()), clock, DwmOptions(**options))
    device.power_up(0.0)
    clock.start(0.0)
    device.advance(100.0)
    return device


def test_a_device_that_talks_is_found_while_it_is_listened_to(plug):
    wire = plug("/dev/base", Talker(100.0))
    seen = devices.look("/dev/base", [KINDS["line"]], None)
    assert (seen.found, seen.kind) == (True, "base that prints lines")
    assert wire.closed
    assert wire.bauds == [115200]
    assert plug.clock.now - 100.0 < devices.LISTEN


def test_where_nobody_answers_that_is_said_when_the_time_for_it_is_over(plug):
    wire = plug("/dev/none")
    seen = devices.look("/dev/none", [KINDS["kobuki"], KINDS["tlv"]], None)
    assert not seen.found
    assert seen.findings == [("error", KINDS["kobuki"].silent)]
    assert wire.closed
    assert devices.ASK < plug.clock.now - 100.0 < devices.LISTEN + devices.ASK + 0.1


def test_a_module_says_who_it_is_and_whether_it_is_in_the_right_network(plug):
    for pan_id, wrong in ((None, False), (0xBACA, False), (0xC0DE, True)):
        plug("/dev/tag", module())
        seen = devices.look("/dev/tag", [KINDS["tlv"]], pan_id)
        assert (seen.found, seen.kind) == (True, "DWM1001 tag")
        assert seen.details["network"] == "0xBACA"
        assert any("nis 0xC0DE" in text for _, text in seen.findings) is wrong


def test_ports_are_reported_one_after_another_in_words_and_as_json(plug, capsys):
    plug("/dev/base", Talker(100.0))
    assert main(["devices", "/dev/none", "--json"]) == 3
    assert json.loads(capsys.readouterr().out)["devices"] == [
        {"port": "/dev/none", "kind": "unknown", "findings": [{"level": "error", "text": "/dev/none: no such port"}]}
    ]
    assert main(["devices", "/dev/none"]) == 3
    assert "/dev/none: unknown\n    error: /dev/none: no such port" in capsys.readouterr().out


def test_what_is_sound_at_every_port_is_all_well(capsys):
    sound, odd = (devices.PortReport(path, "tag", True, {"network": "0xBACA"}) for path in "ab")
    devices._report([sound], False)
    assert capsys.readouterr().err == "all is well\n"
    odd.details = {"network": "0x1234"}
    both = [sound, odd]
    devices._compare_networks(both)
    assert [seen.findings for seen in both] == [[("warning", "nodes differ in network id (0x1234, 0xBACA)")]] * 2
    devices._report(both, False)
    assert capsys.readouterr().err == ""


def test_without_any_device_plugged_in_the_cables_are_named(monkeypatch, capsys):
    monkeypatch.setattr(devices, "plugged_in", list)
    assert main(["devices"]) == 1
    assert "no serial device is plugged in; check cables and power" in capsys.readouterr().err
    port = SimpleNamespace(path="/dev/ttyUSB0", usb_id="1234:5678", description="some chip")
    monkeypatch.setattr(devices, "plugged_in", lambda: [port])
    assert main(["devices"]) == 1
    assert "kind not known; `uwblite devices /dev/ttyUSB0` looks at it" in capsys.readouterr().out
