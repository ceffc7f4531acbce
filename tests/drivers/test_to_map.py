"""Every device from its emulator through record, check and map to a map: in simulated time, as good as the URG-04LX's."""

import math

import numpy as np
import pytest
from emulators.dwm_device import DwmDevice
from emulators.kobuki_device import Create2Device, GyroLineDevice, KobukiDevice, TickLineDevice
from emulators.simulated_world import SimulatedWorld
from emulators.spinning_device import LIDARS
from emulators.uwb_boards import BOARDS, UwbBoard
from emulators.world import WorldClock
from helpers.virtual_recording import record
from simulation.recording import Settings, simulate

from uwblite.cli import main
from uwblite.drivers.devices import open_device

MINUTES, LEAD = 0.5, 2.0
"""min of driving, s of standing before."""
BASES = {"kobuki": KobukiDevice, "create2": Create2Device, "line": TickLineDevice}
OPTIONS = {
    "rplidar-standard": "?standard=1",
    "line": "?columns=t,left,right&time_unit=0.001&tick=0.0001&wheel_base=0.30",
    "uwb-line": "?columns=t,id,range,quality&prefix=UWB&unit=0.001&time_unit=0.001",
}
TOGETHER = [
    ("ld06", "linktrack", "create2"), ("lds01", "makerfabs", "line"), ("rplidar", "makerfabs-at", "kobuki"),
    ("ydlidar-x2", "dwm3001", "line"), ("ydlidar-x4", "bu03", "kobuki"), ("rplidar-standard", "uwb-line", "kobuki"),
    ("lds01", "bu01", "create2"),
]  # fmt: skip


def session(sensor, name):
    return open_device(sensor, f"{name.removesuffix('-standard')}:port{OPTIONS.get(name, '')}")[0]


@pytest.mark.slow
@pytest.mark.parametrize(("lidar", "uwb", "base"), TOGETHER)
def test_from_emulator_to_map(tmp_path, lidar, uwb, base):
    settings = Settings(world="room", seed=3, minutes=MINUTES, uwb_rate=5.0, without=("laser",), write_heights=True)
    recording = simulate(settings)
    world, clock = SimulatedWorld(recording), WorldClock()
    write = BOARDS.get({"uwb-line": "line"}.get(uwb, uwb))
    tag = UwbBoard(world.epochs(), clock, write) if write else DwmDevice(world.epochs(), clock)
    devices = [
        ("lidar", session("lidar", lidar), LIDARS[lidar](world, clock, wobble=0.01)),
        ("odometry", session("odometry", base), BASES[base](world.poses(), clock)),
        ("uwb", session("uwb", uwb), tag),
    ]
    if base != "kobuki":  # which has a gyro of its own
        lines = "line:port?columns=t,turn_rate&time_unit=0.001&angle_unit=0.017453292519943295"
        devices.append(("gyro", open_device("gyro", lines)[0], GyroLineDevice(world.true_poses(), clock)))
    params = [("uwb_tag_offset_x", f"{settings.tag[0]}"), ("uwb_tag_offset_y", f"{settings.tag[1]}"),
              ("uwb_tag_height", "0.6"), ("uwb_anchor_height", "0.6")]  # fmt: skip
    recorder = record(
        tmp_path / "run.log", devices, 60.0 * MINUTES + LEAD, laser=settings.laser_pose, params=params,
        begin=lambda now: clock.start(now + LEAD),
    )  # fmt: skip
    assert recorder.doubts() == []
    for link in recorder.links:
        assert link.counts.messages > 100
        assert sum(link.counts.corrupt.values()) == 0
    assert main(["check", str(tmp_path / "run.log")]) == 0
    assert main(["map", str(tmp_path / "run.log"), "--out", str(tmp_path / "map"), "-q"]) in (0, 3)
    assert absolute_error(tmp_path / "map" / "trajectory.tum", recording, 1000.0 + LEAD) < 0.05


def absolute_error(path, recording, zero):
    """Return the RMS distance of a trajectory to the truth after the best rigid alignment, m."""
    rows = np.loadtxt(path)
    inside = (rows[:, 0] > zero + 0.1) & (rows[:, 0] < zero + recording.stamps[-1] - 0.1)
    stated = rows[inside, 1:3]
    true = np.stack([np.interp(rows[inside, 0] - zero, recording.stamps, recording.truth[:, k]) for k in range(2)], axis=1)
    a, b = stated - stated.mean(axis=0), true - true.mean(axis=0)
    angle = math.atan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b))
    turned = a @ np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    return float(np.sqrt(np.mean(np.sum((turned - b) ** 2, axis=1))))
