"""Clocks: where the words begin, and what stamps become."""

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from helpers import planted
from helpers.told import told

from uwblite import se2
from uwblite.errors import DataError
from uwblite.screening import clocks
from uwblite.screening.clocks import with_late_scans_placed
from uwblite.sensor_log import LaserScans, LogNotes, Odometry, SensorLog, UwbRanges, in_bursts


def moving(stamps):
    return Odometry(
        np.asarray(stamps, dtype=float), np.column_stack([np.arange(float(len(stamps))), np.zeros((len(stamps), 2))])
    )


def scans(stamps):
    return LaserScans(np.asarray(stamps, dtype=float), np.ones((len(stamps), 4), dtype=np.float32), 0.0, 0.1, 0.0, 0.1, 9.0)


def ranges(stamps):
    n = len(stamps)
    return UwbRanges(np.asarray(stamps, dtype=float), np.zeros(n, dtype=int), np.ones(n), np.full(n, 100.0), ("A",))


def test_only_a_moving_robot_needs_times():
    for odometry, refused in (
        (moving([3.0, 3.0, 3.0]), True), (moving([3.0, 3.0]), False), (moving([3.0, 3.0, 3.1]), False),
        (Odometry(np.full(3, 3.0), np.ones((3, 3))), False),
    ):  # fmt: skip
        with pytest.raises(DataError, match="all 3 of the odometry are of t = 3 s") if refused else nullcontext():
            clocks.refuse_without_stamps(SensorLog(odometry))


def test_stamps_of_receipt_are_named_with_their_sensors():
    queue, steady = 0.6 * (np.arange(200) // 6) + 0.001 * (np.arange(200) % 6), 0.1 * np.arange(200)
    cases = (queue, queue, ("odometry", "scans")), (queue, steady, ("odometry",)), (steady, queue, ("scans",))
    for odometry, lidar, named in (*cases, (steady, steady, ())):
        sensors, facts = clocks.in_bursts(SensorLog(moving(odometry), None, scans(lidar)))
        remarks = told(facts)
        assert sensors == named
        assert [(r.kind, r.severity) for r in remarks] == [("stamps-of-receipt", "warning")] * bool(named)
        assert all(" and ".join(named) in r.text for r in remarks)
    assert clocks.in_bursts(SensorLog(moving(queue)))[0] == ("odometry",)


def even(period, count, uneven=0.0):
    return period * np.arange(count) + uneven * (np.arange(count) == 5)


@pytest.mark.parametrize(
    ("odometry", "lidar", "period"),
    [
        (even(0.5, 20), even(0.5, 20), "0.5"), (even(0.5, 19), even(0.5, 20), None), (even(0.5, 20), even(0.5, 19), None),
        (even(0.39, 20), even(0.5, 20), None), (even(0.5, 20), even(0.39, 20), None), (even(0.4, 40), even(0.5, 40), "0.4"),
        (even(0.5, 20, 4e-5), even(0.5, 20, 4e-5), "0.5"), (even(0.5, 20, 6e-5), even(0.5, 20), None),
        (even(0.5, 20), even(0.5, 20, 6e-5), None),
    ],
)  # fmt: skip
def test_stamps_are_made_up_where_both_sensors_are_slow_and_even(odometry, lidar, period):
    found = told(clocks.made_up(SensorLog(moving(odometry), None, scans(lidar))))
    assert len(found) == (period is not None)
    assert all(f"every {period} s" in r.text for r in found)
    assert clocks.made_up(SensorLog(moving(odometry))) == []


def test_a_clock_set_back_by_more_than_a_second_is_named_with_its_sensor():
    log = SensorLog(moving([0.0, 1.0]), notes=LogNotes(set_back={"radio": 1.0, "lidar": 1.1, "odometry": 30.0}))
    found = told(clocks.set_back(log))
    assert [r.text.split(":")[0] for r in found] == [
        "the clock of the lidar was set back by up to 1.1 s", "the clock of the odometry was set back by up to 30.0 s",
    ]  # fmt: skip
    assert all(r.severity == "doubt" for r in found)


@pytest.mark.parametrize(
    ("by", "early", "undone"),
    [(10.1, 0.0, True), (9.9, 0.0, False), (30.0, 1.9, True), (30.0, 2.1, False), (30.0, -1.9, True), (30.0, -2.1, False)],
)
@pytest.mark.parametrize("which", ["scans", "ranges", "odometry"])
def test_a_jump_forward_is_undone_where_the_sensors_end_together_without_it(which, by, early, undone):
    """Ten seconds at least; the sensor that jumped ends earlier or later than the other by up to two seconds."""
    end = 100.0 - early if which == "odometry" else 100.0
    other = np.linspace(0.0, end, 401)
    own = np.linspace(0.0, 100.0 - early if which != "odometry" else 100.0, 201)
    if which == "odometry":
        jumping = other + by * (np.arange(401) > 100)
        log = SensorLog(moving(jumping), None, scans(own))
        done, facts = clocks.without_jumps(log)
        remarks = told(facts)
        at, moved, what = 25.0 * end / 100.0, by, "odometry"
        expected, found = own + by * (own > at), done.scans.stamps
    else:
        jumped = own + by * (np.arange(201) > 50)
        log = SensorLog(moving(other), **{which: (scans if which == "scans" else ranges)(jumped)})
        done, facts = clocks.without_jumps(log)
        remarks = told(facts)
        at, moved, what = own[50], -by, {"scans": "lidar", "ranges": "radio"}[which]
        expected, found = own, getattr(done, which).stamps
    if not undone:
        assert (done, remarks) == (log, [])
        return
    np.testing.assert_allclose(found, expected, atol=1e-9)
    (remark,) = told(remarks)
    assert f"the clock of the {what} was set forward by {by:.1f} s at t = {at:.0f} s" in remark.text
    assert f"moved by {moved:+.1f} s" in remark.text


def test_a_jump_between_two_bursts_is_undone_beside_the_usual_silence():
    """Eight ranges within 0.4 s and 7.6 s of silence, where a median over steps would move the rest by the silence too."""
    own = (8.0 * np.arange(13)[:, None] + 0.05 * np.arange(8)).ravel()
    jumped = own + 30.0 * (own > 45.0)
    done, facts = clocks.without_jumps(SensorLog(moving(np.linspace(0.0, 97.0, 401)), ranges(jumped)))
    (remark,) = told(facts)
    np.testing.assert_allclose(done.ranges.stamps, own, atol=1e-9)
    assert "set forward by 30.0 s" in remark.text


def test_a_few_stamps_show_no_jump():
    for count, undone in ((20, True), (19, False)):
        stamps = np.linspace(0.0, 100.0, count) + 50.0 * (np.arange(count) > 8)
        done, _ = clocks.without_jumps(SensorLog(moving(np.linspace(0.0, 100.0, 401)), None, scans(stamps)))
        assert (done.scans.stamps[-1] < 101.0) == undone


@pytest.mark.parametrize(
    ("outside", "said", "doubt"), [(0, False, False), (1, False, False), (2, True, False), (50, True, False), (51, True, True)]
)
def test_scans_outside_the_odometry_s_time_are_left_out_and_ranges_counted(outside, said, doubt):
    """From 2 % of the scans on, and one range; a half second beyond either end is the odometry's own period."""
    stamps = np.linspace(0.0, 10.0, 100 - outside)
    late = np.append(stamps, np.full(outside, 12.0))
    log = SensorLog(moving(np.linspace(0.0, 10.0, 50)), ranges(late), scans(late))
    done, facts = clocks.within_odometry(log)
    remarks = told(facts)
    assert done.ranges is log.ranges
    assert len(done.scans.stamps) == 100 - outside if said else done.scans is log.scans
    by_kind = {r.kind: r for r in remarks}
    assert set(by_kind) == ({"ranges-outside-odometry"} if outside else set()) | ({"scans-outside-odometry"} if said else set())
    for name, remark in by_kind.items():
        assert (remark.severity == "doubt") == doubt
        assert remark.text.startswith(f"{outside} of 100 {name.split('-')[0]} ")
        assert ("clocks differ by about 7 s" in remark.text) == doubt


def test_the_time_of_the_odometry_begins_and_ends_a_little_beyond_its_stamps():
    edge = clocks.OUTSIDE
    stamps = np.array([-1.01, -1.0, 0.0, 11.0, 11.01]) * [edge, edge, 1.0, 1.0, 1.0]
    stamps[3:] = [10.0 + edge, 10.0 + 1.01 * edge]
    done, facts = clocks.within_odometry(SensorLog(moving(np.linspace(0.0, 10.0, 50)), None, scans(stamps)))
    (remark,) = told(facts)
    np.testing.assert_array_equal(done.scans.stamps, stamps[1:4])
    assert remark.text.startswith("2 of 5 scans")
    late = replace(scans(stamps[1:4]), stamps=stamps[1:4])
    assert clocks.within_odometry(SensorLog(moving(np.linspace(0.0, 10.0, 50)), None, late))[1] == []


ROOM = np.concatenate([planted.box(9.0, 6.0), np.array([[1.0, 1.0, 2.0, 1.0], [-3.0, -1.0, -3.0, 0.5]])])
LATE = (20, 33, 60)


@pytest.fixture(scope="module")
def turning():
    """Return a recording of 125 scans of a robot that turns and drives, with three scans from 0.4 s before, and the true poses
    at the scans: of these as they were taken."""
    rng = np.random.default_rng(1)
    stamps, truth = planted.drive([(0.15, 0.0, 0.6), (0.3, 0.0, -0.4)], [12.0, 13.5])
    lidar = planted.scans(stamps, truth, ROOM, sweep=0.0, noise=0.01, rng=rng)
    seen, taken = lidar.ranges.copy(), lidar.stamps.copy()
    for k in LATE:
        seen[k], taken[k] = lidar.ranges[k - 2] + 0.01 * rng.standard_normal(180), lidar.stamps[k - 2]
    wheels = planted.odometry(stamps, truth, rng, noise=0.002, turn_noise=0.002)
    queue = np.ceil(lidar.stamps / 1.1) * 1.1 + 0.001 * (np.arange(len(taken)) % 7)
    wheels = replace(wheels, stamps=np.sort(queue), poses=wheels.at(lidar.stamps))
    log = planted.recording(wheels, lidar=replace(lidar, stamps=np.sort(queue), ranges=seen))
    return log, se2.interpolate_trajectory(stamps, truth, taken)


def test_late_scans_alone_get_the_poses_that_they_show(turning):
    log, taken = turning
    done, facts = with_late_scans_placed(log)
    remarks = told(facts)
    assert [r.kind for r in remarks] == ["late-scans"]
    assert f"{len(LATE)} of {len(taken)} scans" in remarks[0].text
    others = np.setdiff1d(np.arange(len(taken)), LATE)
    np.testing.assert_array_equal(done.odometry.poses[others], log.odometry.poses[others])
    np.testing.assert_array_equal(done.odometry.stamps, log.odometry.stamps)
    before, late = (done.odometry.poses[np.array(LATE) - back] for back in (1, 0))
    true = se2.between(taken[np.array(LATE) - 1], taken[np.array(LATE)])
    np.testing.assert_allclose(se2.between(before, late), true, atol=0.02)


def test_scans_that_all_came_in_time_are_left_alone(turning):
    log, _ = turning
    some = np.setdiff1d(np.arange(len(log.scans.stamps)), LATE)
    sound = replace(log, scans=log.scans.rows(some), odometry=log.odometry.rows(some))
    assert in_bursts(sound.scans.stamps)
    assert with_late_scans_placed(sound) == (sound, [])


def test_scans_with_times_are_left_alone(turning):
    log, _ = turning
    steady = np.arange(len(log.scans.stamps)) * 0.2
    even = replace(log, scans=replace(log.scans, stamps=steady), odometry=replace(log.odometry, stamps=steady))
    assert with_late_scans_placed(even) == (even, [])
    assert with_late_scans_placed(log.without(lidar=True))[1] == []


@pytest.mark.parametrize(("size", "bursts", "spread"), [(4, 5, True), (1, 5, False), (4, 4, False), (7, 30, True)])
def test_bursts_are_spread_over_the_time_since_the_one_before(size, bursts, spread):
    """The last of each keeps its stamp; after a pause they are spread over the usual time."""
    at = 10.0 + np.arange(bursts) * 2.0 + 30.0 * (np.arange(bursts) >= 3)
    late = np.repeat(at, size)
    found = clocks._spread(late)
    assert (found is not None) == spread
    if found:
        stamps, usual, between = found
        assert (usual, between) == (size, 2.0)
        np.testing.assert_allclose(stamps, (at[:, None] - 2.0 + 2.0 * np.arange(1, size + 1) / size).ravel())


def test_two_or_three_readings_of_a_coarse_clock_lie_about_their_stamp():
    """Whole seconds of readings that a robot gives by its way; where a clock stands still, stamps are no times."""
    true = np.cumsum(np.random.default_rng(3).uniform(0.4, 1.6, 300))
    stamps, usual, between = clocks._spread(np.floor(true))
    assert (usual, between) == (1.0, 1.0)
    assert np.diff(stamps).min() > 0.0
    assert np.abs(stamps - np.floor(true)).max() < 0.5
    assert np.abs(np.diff(stamps) - np.diff(true)).mean() < np.abs(np.diff(np.floor(true)) - np.diff(true)).mean()
    still = np.concatenate([np.arange(10.0), np.full(50, 9.0), np.arange(10.0, 100.0)])
    assert clocks._spread(still)[0].tolist() == still.tolist()


def test_bursts_of_both_sensors_are_named_and_single_stamps_stay():
    late = np.repeat(np.arange(1.0, 11.0), 5)
    scans = LaserScans(late, np.ones((50, 3), np.float32), 0.0, 0.01, 0.0, 0.05, 30.0)
    done, facts = clocks.without_bursts(SensorLog(Odometry(late, np.zeros((50, 3))), None, scans))
    remarks = told(facts)
    np.testing.assert_allclose(done.odometry.stamps, 0.2 * np.arange(1, 51))
    np.testing.assert_allclose(done.scans.stamps, 0.2 * np.arange(1, 51))
    assert [r.text.split(",")[0] for r in remarks] == [
        "odometry readings come in bursts of about 5 with one stamp", "scans come in bursts of about 5 with one stamp",
    ]  # fmt: skip
    assert "every 1.00 s" in remarks[0].text
    even = SensorLog(Odometry(np.arange(50.0), np.zeros((50, 3))), None, replace(done.scans, stamps=np.arange(50.0)))
    assert clocks.without_bursts(even) == (even, [])
