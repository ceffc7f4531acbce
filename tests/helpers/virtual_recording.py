"""`uwblite record` in simulated time: the real recorder and sessions against emulated devices, without ports or waiting."""

from contextlib import contextmanager
from dataclasses import replace
from unittest import mock

from uwblite.drivers import link as link_module
from uwblite.drivers.link import Host, Link, Mounting
from uwblite.drivers.log_file import LogFile
from uwblite.drivers.recorder import Recorder
from uwblite.errors import DeviceError

LATENCY = 0.0008
"""s from the host to a device."""


class VirtualTime:
    """A clock that moves when the recorder waits."""

    def __init__(self, start=1000.0):
        self.now = start

    def __call__(self):
        return self.now


PLUGGED = (float("inf"), float("inf"))


class VirtualPort:
    """A port with an emulated device at its other end, which is unplugged between two times."""

    def __init__(self, device, clock, away=PLUGGED):
        self.device, self._clock, self._away = device, clock, away
        self._answers, self._closed = [], False
        self._check_plugged()
        if clock.now >= away[1]:
            device.advance(clock.now)
        device.power_up(clock.now)

    def _check_plugged(self):
        if self._away[0] <= self._clock.now < self._away[1]:
            raise DeviceError("it was unplugged")

    def fileno(self):
        return None

    def read(self):
        self._check_plugged()
        now, data = self._clock.now, b""
        self._send(self.device.advance(now), now)
        while self._answers and self._answers[0][0] <= now:
            data += self._answers.pop(0)[1]
        return data

    def _send(self, data, due):
        """Let bytes arrive at a time, behind those that were sent before."""
        if data:
            self._answers.append((max(due, self._answers[-1][0]) if self._answers else due, data))

    def write(self, data):
        self._check_plugged()
        self._send(self.device.receive(data, self._clock.now), self._clock.now + LATENCY)

    def next_time(self):
        if self._closed:
            return float("inf")
        times = [self.device.next_time(self._clock.now), *(due for due, _ in self._answers[:1])]
        return min([*times, self._away[0]] if self._clock.now < self._away[0] else times)

    def set_baud(self, rate):
        pass

    def set_dtr(self, on):
        pass

    def close(self):
        self._closed = True


class OpenedAtOnce:
    """Instead of a thread that opens a port."""

    def __init__(self, open_port, url, baud):
        try:
            self._port = open_port(url, baud)
        except DeviceError as error:
            self._port = error

    def result(self):
        return self._port

    def give_up(self):
        pass


class VirtualSelector:
    """Instead of waiting, moves the clock to the next thing that happens."""

    def __init__(self, clock, ports):
        self._clock, self._ports = clock, ports

    def select(self, timeout):
        due = min((port.next_time() for port in self._ports.values()), default=float("inf"))
        self._clock.now = max(self._clock.now + 1e-4, min(self._clock.now + timeout, due))
        return []

    def register(self, *_):
        pass

    def unregister(self, *_):
        pass

    def close(self):
        pass


@contextmanager
def live_devices(devices, seconds, *, begin=None):
    """Let `uwblite localize --live` find emulated devices behind its ports, in simulated time.

    Parameters
    ----------
    devices : what stands behind each port, by its name.
    seconds : after which somebody stops it.
    begin : called with the clock's time at the start.
    """
    from uwblite.cli import record as module

    clock, ports = VirtualTime(), {}
    real = Recorder.run

    def open_port(url, _baud):
        ports[url] = VirtualPort(devices[url], clock)
        return ports[url]

    def recorder(links, log, host, *rest, **words):
        made = Recorder(links, log, replace(host, monotonic=clock, wall_offset=0.0, open_port=open_port), *rest, **words)
        made._selector = VirtualSelector(clock, ports)
        if begin:
            begin(clock.now)
        return made

    def run(self, *, duration, stopping, on_status=None):
        real(self, duration=seconds, stopping=stopping, on_status=on_status)

    with (
        mock.patch.object(module, "Recorder", recorder),
        mock.patch.object(Recorder, "run", run),
        mock.patch.object(link_module, "Opening", OpenedAtOnce),
    ):
        yield


def record(path, devices, seconds, *, laser=(0.0, 0.0, 0.0), more_lasers=(), params=(), begin=None, away=None):
    """Record emulated devices into a log.

    Parameters
    ----------
    path : of the log.
    devices : list of (sensor, session, device); several of a sensor are numbered in this order.
    seconds : how long.
    begin : called with the clock's time at the start.
    away : s from and until when a device is unplugged, by its sensor.

    Returns
    -------
    Recorder
    """
    clock, ports = VirtualTime(), {}
    by_url = {f"virtual{i}": device for i, (_, _, device) in enumerate(devices)}
    names = [name for name, _, _ in devices]
    links = [
        Link(name, f"virtual{i}", session, names[: i + 1].count(name)) for i, (name, session, _) in enumerate(devices)
    ]  # fmt: skip

    spans = {f"virtual{i}": tuple(clock.now + t for t in (away or {}).get(name, PLUGGED)) for i, name in enumerate(names)}

    def open_port(url, _baud):
        ports[url] = VirtualPort(by_url[url], clock, spans[url])
        return ports[url]

    log = LogFile(path)
    host = Host("virtual", clock, 0.0, open_port=open_port)
    recorder = Recorder(links, log, host, Mounting(laser, tuple(params), more_lasers))
    recorder._selector = VirtualSelector(clock, ports)
    if begin:
        begin(clock.now)
    try:
        recorder.begin(["recorded in simulated time"])
        with mock.patch.object(link_module, "Opening", OpenedAtOnce):
            recorder.run(duration=seconds, stopping=lambda: False)
    finally:
        log.close()
    return recorder
