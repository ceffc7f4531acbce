"""A cut log along a smooth wall, where all scans match, shows in the ranges; what scans contradict does not."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.room_recording import recording, two_rounds
from helpers.told import told

from uwblite import se2
from uwblite.findings import Fact
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
    return [r.kind for r in told(log.screening.facts) if r.severity == "doubt"]


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
    assert [r.kind for r in told(done.screening.facts)] == ["odometry-breaks"]


def test_scans_of_a_room_contradict_ranges_that_all_jump():
    log = recording(two_rounds())
    middle = float(np.mean(log.odometry.stamps[[0, -1]]))
    late = log.ranges.stamps > middle
    log = replace(log, ranges=replace(log.ranges, ranges=log.ranges.ranges + 6.0 * late))
    assert len(cuts.found(log.without(lidar=True), np.zeros(0))) == 1
    assert len(cuts.found(log, np.zeros(0))) == 0


@pytest.mark.parametrize(("away", "cut"), [(-3.5, True), (-2.5, False), (2.5, False), (3.5, True)])
def test_cuts_near_other_breaks_are_those(away, cut):
    """Three seconds before one or behind the next reading."""
    log = wheels_go_on(tunnel(18.0), 18.0)
    alone, _ = cuts.cuts(log, np.zeros(0), np.zeros(0))
    assert alone.stamps.tolist() == [pytest.approx(CUT, abs=1.0)]
    breaks, facts = cuts.cuts(log, np.zeros(0), cuts.found(log, np.zeros(0)) + np.array([-30.0, away]))
    assert [r.severity for r in told(facts)] == ["doubt"] * cut
    assert breaks.stamps.tolist() == alone.stamps.tolist() * cut
    assert breaks.sigma.tolist() == [[20.0, 20.0, 3.0]] * cut


def test_of_many_cuts_five_are_said():
    times = [10.0, 47.0, 54.0, 100.0, 150.0, 200.0]
    many, few = (told([Fact.of("carried", at=times[:count], silent=0.0)])[0].text for count in (6, 5))
    assert "at t = 10, 47, 54, 100, 150 ... s the robot" in many
    assert " ... " not in few


def test_a_cut_is_the_moment_of_the_jump_that_is_nearest_to_it():
    jumps = np.array([10.0, 20.0, 24.0])
    assert [cuts._nearest(jumps, t) for t in (12.9, 13.1, 21.9, 22.1, 27.5)] == [10.0, 13.1, 20.0, 24.0, 27.5]
    assert cuts._nearest(np.zeros(0), 5.0) == 5.0


def test_scans_change_by_the_mean_difference_of_their_readings():
    """A metre at most each; what is not seen lies at the reach; a hundred beams or so of many."""
    readings = np.array([[1.0, 2.0, np.nan, np.inf], [1.5, 2.0, 9.5, 8.0], [9.0, 2.0, -np.inf, 10.0]], dtype=np.float32)
    log = SensorLog(
        Odometry(np.arange(3.0), np.zeros((3, 3))), None, LaserScans(np.arange(3.0), readings, 0.0, 0.1, 0.0, 0.1, 10.0)
    )
    np.testing.assert_allclose(cuts._changes(log), [(0.5 + 0.0 + 0.5 + 1.0) / 4, (1.0 + 0.0 + 1.0 + 1.0) / 4])
    far = replace(log, scans=replace(log.scans, range_max=80.0, ranges=np.where(np.isfinite(readings), 29.5, readings)))
    np.testing.assert_allclose(cuts._changes(far)[0], 0.25)
    wide = np.zeros((2, 360), dtype=np.float32)
    wide[1, ::3] = 0.5
    many = replace(log, scans=replace(log.scans, ranges=wide, stamps=np.arange(2.0)))
    np.testing.assert_allclose(cuts._changes(many), [0.5])


@pytest.mark.parametrize(("before", "after", "known"), [(49.0, 51.0, True), (-1.0, 51.0, False), (49.0, 500.0, False)])
def test_scans_beside_a_time_show_one_place_or_another_or_nothing(before, after, known):
    """Of a room: the robot on the spot, or elsewhere by the odometry's own count; no scan in time on either side."""
    poses = two_rounds()
    log = recording(poses)
    start = log.odometry.stamps[0]
    assert cuts.same_place(log, start + before, start + after) is (True if known else None)
    silent = replace(log, scans=log.scans.rows(np.abs(log.scans.stamps - start - 50.0) > 2.5))
    assert cuts.same_place(silent, start + 49.9, start + 50.1) is None
    assert cuts.same_place(log.without(lidar=True), start + 49.9, start + 50.1) is None


def carried_unseen(log, which):
    """Return a log some of whose scans, which (s,), are of a room that is smaller by half."""
    scale = np.where(which[:, None], 0.5, 1.0).astype(np.float32)
    return replace(log, scans=replace(log.scans, ranges=scale * log.scans.ranges))


def test_two_scans_are_of_one_place_of_two_or_along_a_smooth_wall():
    log, around = recording(two_rounds()), np.array([-0.1, 0.1])
    times = log.odometry.stamps[0] + np.array([30.0, 50.0, 70.0])
    assert all(cuts.same_place(log, *(time + around)) for time in times)
    elsewhere = [cuts.same_place(carried_unseen(log, log.scans.stamps > time), *(time + around)) for time in times]
    assert True not in elsewhere
    assert False in elsewhere
    for ahead in (0.0, 18.0):
        assert cuts.same_place(tunnel(ahead), *(CUT + around)) is None


@pytest.mark.parametrize(
    ("scans", "beams", "jump", "cut"),
    [(20, 30, 8, True), (20, 30, 1, True), (20, 30, 17, True), (20, 30, 0, False), (20, 30, 18, False), (19, 30, 8, False),
     (20, 29, 8, False)],
)  # fmt: skip
def test_a_cut_is_where_a_scan_and_those_beside_it_are_elsewhere(scans, beams, jump, cut):
    """A few scans or beams show none, nor does a change at either end, nor a scan that is wrong by itself."""
    whole = recording(two_rounds())
    number, every = np.arange(len(whole.scans.stamps)) - 250, whole.scans.ranges.shape[1] // beams
    for wrong, found in ((number > jump, cut), (number == jump, False)):
        few = carried_unseen(whole, wrong).scans.rows((number >= 0) & (number < scans))
        few = replace(few, ranges=few.ranges[:, : every * beams : every], angle_increment=every * few.angle_increment)
        times = cuts._by_lidar(replace(whole, scans=few))
        assert times.tolist() == ([pytest.approx(few.middles[jump : jump + 2].mean())] if found else [])
