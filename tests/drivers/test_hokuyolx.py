"""The emulated URG-04LX against an independent client, PyPI hokuyolx, over TCP.

hokuyolx is written for the UST-xxLX: its time synchronisation and laser_state use ``%ST``, which a URG-04LX does not have
(it answers 0E), and its intensity calls use GE and ME, likewise. Everything else of it works.
"""

import subprocess
import sys
import time

import pytest
from helpers.driver_harness import ROOT

hokuyolx = pytest.importorskip("hokuyolx", reason="hokuyolx is not installed (a development dependency)")
from hokuyolx.exceptions import HokuyoException  # noqa: E402


@pytest.fixture
def laser():
    command = [sys.executable, str(ROOT / "tools" / "emulate.py"), "--lidar", "tcp:0", "--no-wait"]
    emulator = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        host, port = emulator.stdout.readline().rpartition("//")[2].split(":")
        yield hokuyolx.HokuyoLX(addr=(host, int(port)), tsync=False, activate=False, convert_time=False)
    finally:
        emulator.terminate()
        emulator.wait()
        emulator.stdout.close()


def test_information_calls(laser):
    assert laser.model.startswith("URG-04LX")
    assert (laser.dmin, laser.dmax, laser.ares, laser.amin, laser.amax, laser.aforw) == (20, 5600, 1024, 44, 725, 384)
    assert laser.scan_freq == 10
    assert laser.version()["PROT"] == "SCIP 2.0"
    assert laser.sensor_state()["LASR"] == "OFF"
    assert laser.sensor_parameters()["SCAN"] == 600


def test_time_synchronisation_mode(laser):
    assert laser.tsync_enter()[0] == "00"
    first = laser.tsync_get()
    time.sleep(0.1)
    assert 80 < laser.tsync_get() - first < 1000
    assert laser.tsync_exit()[0] == "00"
    assert laser.tsync_exit()[0] == "03"


def test_single_and_continuous_measurement(laser):
    assert laser.activate()[0] == 0
    assert laser.activate()[0] == 2
    time.sleep(0.3)
    _, scan = laser.get_dist()
    assert scan.shape == (682,)
    assert scan.max() < 5600
    _, grouped = laser.get_dist(grouping=2)
    assert len(grouped) == 341
    _, narrow = laser.get_dist(start=300, end=400)
    assert len(narrow) == 101
    scans = list(laser.iter_dist(scans=5))
    assert [pending for *_, pending in scans] == [4, 3, 2, 1, 0]
    assert all(scan.shape == (682,) for scan, *_ in scans)
    laser.activate()
    laser.standby()
    laser.reset()


@pytest.mark.parametrize("call", ["laser_state", "sleep", "partial_reset", "reboot", "get_intens"])
def test_what_a_urg_04lx_cannot_answer_is_refused_at_once(laser, call):
    laser.activate()
    with pytest.raises(HokuyoException):
        getattr(laser, call)()
