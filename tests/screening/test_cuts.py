"""A cut log along a smooth wall, where all scans match, shows in the ranges; what scans contradict does not."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.room_recording import recording, two_rounds

from uwblite import se2
from uwblite.screening import cuts
from uwblite.screening.screen import screen
from uwblite.sensor_log import LaserScans, Odometry, SensorLog, UwbRanges

SPEED, CUT = 0.3, 60.0
NEAR = ((3.0, 1.0), (12.0, 1.0), (25.0, 1.0), (40.0, 1.0))
FAR = tuple((100.0 + 10.0 * k, 1.0) for k in range(12))
"""Heard at the very beginning alone: by reflections, say."""


def tunnel(ahead, anchors=NEAR, gap=0.0):
    """Two minutes along a tunnel without ends; `ahead` m are cut out after one minute, which took so long by the stamps."""
    rng = np.random.default_rng(3)

    def along(stamps):
        return SPEED * stamps + np.where(stamps > CUT, ahead, 0.0)

    stamps = np.arange(0.0, 120.0, 0.1)
    poses = np.column_stack([along(stamps), np.zeros((len(stamps), 2))])
    scan_stamps = np.arange(0.05, 119.0, 0.5)
    bearings = np.linspace(-3.0, 3.0, 121)
    with np.errstate(divide="ignore"):
        walls = np.abs(1.2 / np.sin(bearings))
    readings = walls + rng.normal(0.0, 0.01, (len(scan_stamps), len(bearings)))
    readings[:, walls > 6.0] = np.inf
    scans = LaserScans(scan_stamps, readings.astype(np.float32), -3.0, 0.05, 0.0, 0.02, 6.0)
    anchor = np.tile(np.arange(len(anchors)), 240)
    when = np.arange(len(anchor)) * 0.5 / len(anchors)
    heard = (anchor < len(NEAR)) | (when < 20.0)
    anchor, when = anchor[heard], when[heard]
    x, y = np.array(anchors)[anchor].T
    ranges = np.hypot(along(when) - x, y) + rng.normal(0.0, 0.05, len(when))
    ids = tuple(f"A{k:02d}" for k in range(len(anchors)))
    uwb = UwbRanges(when + np.where(when > CUT, gap, 0.0), anchor, ranges, np.full(len(when), 100.0), ids)
    scans = replace(scans, stamps=scan_stamps + np.where(scan_stamps > CUT, gap, 0.0))
    return SensorLog(Odometry(stamps + np.where(stamps > CUT, gap, 0.0), poses), uwb, scans)


def wheels_go_on(log, ahead):
    """The robot was carried: the wheels did not count the way."""
    late = log.odometry.poses[:, 0] > SPEED * CUT + 1e-6
    return replace(log, odometry=Odometry(log.odometry.stamps, log.odometry.poses - np.outer(late, [ahead, 0.0, 0.0])))


def carried(log):
    return [r.kind for r in log.screening.remarks if r.doubt]


@pytest.mark.parametrize("anchors", [NEAR, NEAR + FAR, NEAR[1:2]])
def test_a_log_of_a_tunnel_with_a_minute_cut_out(anchors):
    done = screen(tunnel(18.0, anchors))
    assert carried(done) == ["carried"]
    sigma = done.screening.breaks.sigma[np.abs(done.screening.breaks.stamps - CUT) < 0.15]
    assert sigma.max() >= 18.0, "the ranges alone show how the sides lie"


def test_a_robot_carried_along_a_tunnel_while_the_wheels_go_on():
    done = screen(wheels_go_on(tunnel(18.0), 18.0))
    assert carried(done) == ["carried"]
    assert np.abs(done.screening.breaks.stamps - CUT).min() < 1.0


@pytest.mark.parametrize("ahead", [0.0, 18.0])
def test_a_pause_in_a_tunnel(ahead):
    done = screen(wheels_go_on(tunnel(ahead, gap=40.0), ahead))
    assert carried(done) == ["carried"] * bool(ahead)


def test_a_reset_of_the_wheels_in_a_tunnel_is_no_cut():
    log = tunnel(0.0)
    late = log.odometry.stamps > CUT
    poses = np.where(late[:, None], se2.between(np.array([30.0, 2.0, 0.4]), log.odometry.poses), log.odometry.poses)
    done = screen(replace(log, odometry=Odometry(log.odometry.stamps, poses)))
    assert carried(done) == []
    assert [r.kind for r in done.screening.remarks] == ["odometry-breaks"]


def test_scans_of_a_room_contradict_ranges_that_all_jump():
    log = recording(two_rounds())
    middle = float(np.mean(log.odometry.stamps[[0, -1]]))
    late = log.ranges.stamps > middle
    log = replace(log, ranges=replace(log.ranges, ranges=log.ranges.ranges + 6.0 * late))
    assert len(cuts.found(log.without(lidar=True), np.zeros(0))) == 1
    assert len(cuts.found(log, np.zeros(0))) == 0
