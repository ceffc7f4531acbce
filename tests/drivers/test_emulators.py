"""The emulators' world and faults: what is played is what the log holds, and damage is what was asked for."""

import math

import numpy as np
import pytest
from emulators.faults import FaultyLine, parse_fault
from emulators.simulated_world import nearest
from emulators.wires import PtyWire
from emulators.world import LogWorld, RoomWorld, WorldClock
from helpers.driver_harness import ROOT
from simulation import laser

from uwblite.drivers.scip_commands import ScanRequest
from uwblite.drivers.scip_driver import ScipDriver
from uwblite.drivers.session import Session
from uwblite.drivers.transport import open_port
from uwblite.errors import DeviceError, ProtocolError

ROOM = ROOT / "tests" / "data" / "room.log.gz"


def test_played_log_is_the_log():
    from uwblite.io.carmen import read_log

    log, world = read_log(ROOM), LogWorld(ROOM)
    zero = min(log.odometry.stamps[0], log.scans.stamps[0], log.ranges.stamps[0])
    poses = list(world.poses())
    assert len(poses) == len(log.odometry.stamps)
    assert [p.x for p in poses[:50]] == log.odometry.poses[:50, 0].tolist()
    assert poses[7].time == pytest.approx(log.odometry.stamps[7] - zero)
    scans = world.scans()
    for index in range(20):
        scan = next(scans)
        assert scan.time == pytest.approx(log.scans.stamps[index] - zero, abs=1e-6)
        for value, metres in zip(scan.values, log.scans.ranges[index].tolist(), strict=True):
            if math.isinf(metres):
                assert value == 0
            elif metres >= 0.02:
                assert value == round(1000 * metres)
            else:
                assert value == 7
    ranges = [reading for epoch in world.epochs() for reading in epoch.readings]
    assert len(ranges) == len(log.ranges.stamps)
    assert sum(r[1] for r in ranges) == pytest.approx(1000 * log.ranges.ranges.sum(), rel=1e-4)


def test_the_room_is_measured_from_where_the_robot_stands():
    world = RoomWorld()
    epoch = next(iter(world.epochs()))
    pose = world.pose(0.0)
    for (_, mm, _), (_, x, y) in zip(epoch.readings, world.ANCHORS, strict=True):
        assert mm == round(1000 * math.hypot(x - pose.x, y - pose.y))
    scan = next(iter(world.scans()))
    assert scan.values[384 - 44] == pytest.approx(4000, abs=10)


def test_world_clock_stands_still_until_started():
    clock = WorldClock(2.0)
    assert clock.world(10.0) < 0
    assert clock.host(1.0) == math.inf
    clock.start(10.0)
    clock.start(99.0)
    assert clock.world(11.0) == 2.0
    assert clock.host(4.0) == 12.0


@pytest.mark.parametrize("kind", ["noise", "drop", "insert"])
def test_damage_is_as_frequent_as_asked_for(kind):
    line = FaultyLine([parse_fault(f"{kind}=0.02@5+10")], 1)
    data = bytes(1000) * 100
    assert line.pass_on(data, 4.9) == data
    assert line.pass_on(data, 15.1) == data
    line.pass_on(data, 6.0)
    assert line.damaged == pytest.approx(2000, abs=5 * math.sqrt(2000))


def test_faults_have_a_grammar():
    fault = parse_fault("unplug@20+3")
    assert (fault.kind, fault.start, fault.seconds) == ("unplug", 20.0, 3.0)
    assert fault.active(21.0)
    assert not fault.active(23.5)
    for bad in ("explode", "noise=", "noise=x", "unplug@", ""):
        with pytest.raises(ValueError, match="KIND=VALUE"):
            parse_fault(bad)


def test_a_wire_that_is_pulled_fails_at_the_other_end(tmp_path):
    wire = PtyWire(tmp_path / "port")
    wire.plug_in()
    port = open_port(str(tmp_path / "port"), 115200)
    assert wire.connected()
    wire.write(b"hello")
    assert port.read() == b"hello"
    assert port.read() == b""
    port.write(b"there")
    assert wire.read() == b"there"
    wire.unplug()
    with pytest.raises(DeviceError, match="unplugged"):
        port.read()
    port.close()
    with pytest.raises(DeviceError, match="no such port"):
        open_port(str(tmp_path / "port"), 115200)


def test_a_port_without_a_descriptor_is_read_too():
    port = open_port("loop://", 115200)
    assert port.fileno() is None
    assert port.read() == b""
    port.write(b"echo")
    assert port.read() == b"echo"
    port.set_baud(19200)
    port.close()


@pytest.mark.parametrize("url", ["socket://127.0.0.1:1", "nonsense://x", "spy:///dev/none"])
def test_urls_that_do_not_open_are_one_clear_error(url):
    with pytest.raises(DeviceError, match="cannot open"):
        open_port(url, 115200)


def test_steps_that_the_unit_does_not_have_are_refused_at_once():
    session = Session(ScipDriver(ScanRequest(0, 900)))
    session.start(0.0)
    session.tick(1.0)
    session.feed(b"QT\n00P\n\n", 1.1)
    session.feed(b"VV\n00P\n\n", 1.2)
    asked_again = b"PP\n00P\nAMIN:44;7\n\n" * 6  # the answer is not complete
    session.feed(asked_again, 1.4)
    with pytest.raises(ProtocolError, match=r"44\.\.725"):
        session.feed(b"II\n00P\n\n", 1.5)


def test_rays_end_where_the_simulators_do():
    rng = np.random.default_rng(1)
    walls, columns = rng.uniform(-5.0, 5.0, (9, 4)), np.column_stack([rng.uniform(-5.0, 5.0, (4, 2)), rng.uniform(0.1, 0.5, 4)])
    origins, angles = rng.uniform(-1.0, 1.0, (200, 2)), rng.uniform(-4.0, 4.0, 200)
    assert nearest(origins, angles, walls, columns) == pytest.approx(laser.cast(origins, angles, walls, columns, np.inf)[0])
    assert np.isinf(nearest(origins, angles, walls[:0], columns[:0])).all()
