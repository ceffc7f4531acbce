"""Wheels against lidar: where wheels stand, which pairs are compared, and what a sustained disagreement is."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.laser_walks import CORRIDOR
from helpers.planted import box, scans
from helpers.room_recording import recording as room
from helpers.room_recording import two_rounds
from helpers.told import told

from uwblite import se2
from uwblite.problem.alternatives import EvidencePolicy
from uwblite.screening import wheel_motion
from uwblite.screening.wheel_motion import (
    PairPolicy,
    Pairs,
    _chosen,
    _smooth_steps,
    _span,
    compare,
    disagreeing,
    lidar_by_wheels,
    replaced,
    standing,
    times_as_large,
    unmatched,
)
from uwblite.sensor_log import LaserScans, Odometry, SensorLog


def driven(speed, turn_rate, period=0.1):
    """Return an odometry with these speeds (n,), m/s, and turn rates (n,), rad/s, one per period."""
    steps = period * np.column_stack([speed, np.zeros(len(speed)), turn_rate])
    return Odometry(period * np.arange(len(speed) + 1), se2.chain(np.zeros(3), steps))


@pytest.mark.parametrize(
    ("speed", "turn_rate", "stands"),
    [(0.0, 0.0, True), (0.0049, 0.0, True), (0.0051, 0.0, False), (0.0, 0.0099, True), (0.0, -0.0101, False)],
)
def test_wheels_stand_where_they_count_less_within_a_second(speed, turn_rate, stands):
    """From 5 to 9 s. Half a second on either side sees the motion around; nearly all of it belongs to the stand."""
    time = 0.1 * np.arange(150)
    rests = (time >= 4.95) & (time < 8.95)
    found = standing(driven(np.where(rests, speed, 0.3), np.where(rests, turn_rate, 0.3)))
    assert len(found) == stands
    if stands:
        np.testing.assert_allclose(found, [(5.0, 9.0)], atol=1e-9)


def test_stands_at_the_ends_are_within_the_recording_and_short_ones_none():
    time = 0.1 * np.arange(100)
    rests = (time < 2.95) | (time > 7.95)
    np.testing.assert_allclose(standing(driven(np.where(rests, 0.0, 0.3), 0.0 * time)), [(0.0, 3.0), (8.0, 10.0)], atol=1e-9)
    for last, count in ((6.35, 1), (6.25, 0)):
        rests = (time > 4.85) & (time < last)
        assert len(standing(driven(np.where(rests, 0.0, 0.3), 0.0 * time))) == count
    assert standing(driven(0.0 * time, 0.0 * time), 10.0) == [(0.0, 10.0)]
    assert standing(driven(0.0 * time, 0.0 * time), 10.1) == []


@pytest.mark.parametrize(("speed", "span"), [(0.4, 0.25), (0.05, 1.0), (5.0, 0.1), (0.0, 1.0)])
def test_the_scans_of_a_pair_are_a_tenth_of_a_metre_apart(speed, span):
    """As the robot usually drives when it moves; a whole second where it never does, a tenth at least."""
    speeds = np.where(np.arange(600) % 300 < 100, 0.0, speed)
    assert _span(driven(speeds, 0.0 * speeds)) == pytest.approx(span)


def test_rounded_odometry_drives_no_faster():
    """0.2 m/s in steps of 0.05 m, each within one of 20 readings a second."""
    exact = driven(np.full(2000, 0.2), np.zeros(2000), 0.05)
    rounded = Odometry(exact.stamps, np.round(exact.poses / 0.05) * 0.05)
    assert _span(rounded) == pytest.approx(_span(exact), rel=0.05)


def test_a_false_stamp_years_away_takes_no_memory():
    """Speeds at every second until then are 8 GB; those of the real seconds stay."""
    usual = driven(np.full(600, 0.2), np.zeros(600))
    last = Odometry(np.append(usual.stamps, 1e9), np.vstack([usual.poses, usual.poses[-1:]]))
    assert _span(last) == pytest.approx(_span(usual))


def scanned(odometry, stamps, beams=40):
    return SensorLog(
        odometry, None, LaserScans(stamps, np.ones((len(stamps), beams), dtype=np.float32), 0.0, 0.01, 0.0, 0.1, 9.0)
    )


def test_pairs_are_spread_over_the_recording_and_over_stands():
    """Of a lidar of 10 Hz at 0.2 m/s each pair is five scans apart; none beyond the odometry, none across a silence."""
    time = 0.1 * np.arange(10000)
    rests = (time > 500.0) & (time < 504.0)
    odometry = driven(np.where(rests, 0.0, 0.2), 0.0 * time)
    stamps = np.arange(-5.0, 1005.0, 0.1)
    stamps = stamps[(stamps < 300.0) | (stamps > 310.0)]
    first, second = _chosen(scanned(odometry, stamps), stamps)
    assert set(second - first) == {5}
    assert np.all((stamps[first] >= 0.0) & (stamps[second] <= odometry.stamps[-1]))
    assert np.all(stamps[second] - stamps[first] < 1.5)
    possible = np.sum((stamps[:-5] >= 0.0) & (stamps[5:] <= odometry.stamps[-1]) & (stamps[5:] - stamps[:-5] < 1.5))
    inside = (stamps[first] > 500.0) & (stamps[second] < 504.0)
    # Every 39th of 9,900 makes 254; of the 35 or so within the stand every fourth besides.
    assert len(first) - inside.sum() == pytest.approx(possible / (possible // 250), abs=2)
    assert 8 <= inside.sum() <= 12


@pytest.mark.parametrize(("silence", "bridged"), [(0.9, True), (1.1, False)])
def test_no_pair_spans_three_times_its_usual_time(silence, bridged):
    """All pairs, five scans of 0.1 s apart, of a short recording; five of them lie across a silence."""
    stamps = np.concatenate([0.1 * np.arange(50), 4.9 + silence + 0.1 * np.arange(1, 50)])
    odometry = driven(np.full(150, 0.2), np.zeros(150))
    first, second = _chosen(scanned(odometry, stamps), stamps)
    span = stamps[second] - stamps[first]
    assert np.all(span < 1.5)
    assert (len(first), np.sum(span > 0.6)) == ((94, 5) if bridged else (89, 0))


@pytest.mark.parametrize(("count", "beams", "compared"), [(19, 40, False), (20, 29, False), (20, 30, True)])
def test_a_few_scans_or_beams_are_not_compared(count, beams, compared):
    odometry = driven(np.full(100, 0.2), np.zeros(100))
    assert (compare(scanned(odometry, np.arange(count) * 0.4, beams)) is not None) == compared
    assert compare(scanned(odometry, 100.0 + np.arange(40.0))) is None
    assert compare(SensorLog(odometry)) is None


def test_pairs_that_match_poorly_from_the_wheels_are_matched_from_rest_too(monkeypatch):
    """Of three the first matches well; rest explains the second no better by 0.03, and the third clearly."""
    at_rest, asked = np.array([0.82, 0.84]), []
    odometry = driven(np.full(400, 0.2), np.zeros(400))

    def steps(scans, mounting, first, second, guess):
        asked.append(len(first))
        by_wheels = len(asked) == 1
        share = np.tile([0.9, 0.8, 0.8], len(first))[: len(first)] if by_wheels else np.resize(at_rest, len(first))
        return guess + (1.0 if by_wheels else 7.0), share, np.zeros((len(share), 3, 3))

    monkeypatch.setattr(wheel_motion, "scan_steps", steps)
    monkeypatch.setattr(wheel_motion, "_fit_better", lambda log, first, *_: np.ones(len(first), dtype=bool))
    found = compare(scanned(odometry, 0.1 * np.arange(391.0)))
    count = len(found.share)
    assert asked == [count, sum(k % 3 > 0 for k in range(count))]
    np.testing.assert_allclose(found.share[:6], [0.9, 0.8, 0.84, 0.9, 0.8, 0.84])
    assert np.all((found.lidar[:, 1] == 7.0) == (np.arange(count) % 3 == 2))


def alike(count, size):
    """Return the same information for each motion (count, size)."""
    return np.tile(np.eye(size), (count, 1, 1))


def pairs(count=100, way=0.1, turn=0.0, **more):
    wheels = np.column_stack([np.full(count, way), np.zeros(count), np.full(count, turn)])
    start = np.arange(float(count))
    given = {"start": start, "end": start + 0.5, "lidar": wheels.copy(), "wheels": wheels, "share": np.ones(count)}
    given["information"] = alike(count, 3)
    return Pairs(**{**given, **more})


def test_the_lidar_is_for_or_against_the_wheels_where_scans_measure_the_way():
    way = np.where(np.arange(100) < 50, 0.1, 0.3)
    wheels = np.column_stack([way, np.zeros((100, 2))])
    lidar = np.where((np.arange(100) < 70)[:, None], wheels, 0.1 * np.eye(3)[1])
    for shown in (True, False):
        found = pairs(wheels=wheels, lidar=lidar, information=alike(100, 3) * shown)
        assert (found.against_wheels(0.0, 40.0) < -EvidencePolicy.very_strong) == shown
        assert (found.against_wheels(70.0, 100.0) > EvidencePolicy.very_strong) == shown


def test_only_pairs_within_a_time_that_match_measure_it():
    share = np.ones(10)
    share[[3, 4]] = 0.6, 0.59
    found = pairs(10, share=share)
    assert np.flatnonzero(found.within(2.0, 6.5)).tolist() == [2, 3, 5, 6]
    assert np.flatnonzero(found.within(2.1, 6.4)).tolist() == [3, 5]


def test_the_way_ratio_is_of_measured_pairs_with_a_clear_way():
    found = pairs(40)
    found.lidar[:, :2] *= 1.1
    found.lidar[:10, :2] *= 5.0
    found.share[:10] = 0.5
    found.wheels[10:15, 0] = 0.05
    assert found.way_ratio == pytest.approx(1.1)
    assert np.isnan(found.rows(np.arange(40) < 20).way_ratio)


@pytest.mark.filterwarnings("error")
def test_pairs_whose_scans_do_not_measure_the_way_have_no_part_in_its_ratio():
    """Along a wall a match stays at the wheels' guess, whatever the lidar's scale; where only the turn is known as well."""
    found = pairs(80)
    found.information[:40] = np.diag([0.0, 1.0, 1.0])
    found.information[20:40, 0, 0] = found.information[20:40, 0, 2] = found.information[20:40, 2, 0] = 1.0
    found.lidar[40:, 0] *= 1.2
    assert found.way_ratio == pytest.approx(1.2)
    found.information[40:50] *= 1e-3
    found.lidar[40:50, 0] = 0.01
    assert found.way_ratio == pytest.approx(1.2)
    found.information[:] = 0.0
    assert np.isnan(found.way_ratio)


@pytest.mark.parametrize("factor", [1.0, 1.5])
@pytest.mark.parametrize("rounded", ["wheels", "lidar"])
def test_rounding_of_either_sensor_hardly_changes_the_way_ratio(rounded, factor):
    """Ways of 0.1 m into all directions, x and y rounded up or down to 0.1 m: along the rounded ones they are shorter."""
    rng = np.random.default_rng(0)
    found, angle = pairs(400), rng.uniform(0.0, 0.5 * np.pi, 400)
    way = 0.1 * np.column_stack([np.cos(angle), np.sin(angle)])
    found.wheels[:, :2], found.lidar[:, :2] = way, way
    noisy = getattr(found, rounded)
    noisy[:, :2] = 0.1 * np.floor(way / 0.1 + rng.uniform(0.0, 1.0, (400, 2)))
    found.wheels[:, :2] *= factor
    assert abs(np.log(found.way_ratio * factor)) < 0.3
    assert abs(np.log(found.way_ratio * factor)) < 0.1 or factor > 1.0


@pytest.mark.parametrize(("share", "said"), [(0.39, True), (0.41, False)])
def test_scans_do_not_match_where_one_pair_in_ten_does_not_either(share, said):
    shares = np.linspace(0.0, share / 0.9, 301)[1:]
    found = told(unmatched(pairs(400, share=np.append(shares, np.zeros(100)))))
    assert len(found) == said
    assert all(f"less than {share:.0%}" in r.text for r in found)
    assert len(unmatched(pairs(24, share=np.full(24, 0.1)))) == 1
    assert unmatched(pairs(24, share=np.append(np.full(23, 0.1), 0.0))) == []


@pytest.mark.parametrize(
    ("off", "said"),
    [
        ((0.05, 0.0, 0.0), False), ((0.2, 0.0, 0.0), True), ((-0.05, 0.0, 0.0), False), ((-0.2, 0.0, 0.0), True),
        ((0.0, 0.05, 0.0), False), ((0.0, 0.2, 0.0), True), ((0.0, 0.0, 0.02), False), ((0.0, 0.0, -0.08), True),
    ],
)  # fmt: skip
@pytest.mark.parametrize("factor", [1.0, 0.8])
def test_a_motion_that_noise_does_not_explain_for_long_is_said(off, said, factor):
    """Of twenty pairs in a row, a second apart; the one factor between all ways is taken out before."""
    found = pairs(wheels=pairs().wheels / [factor, 1.0, 1.0])
    found.lidar[40:60] += off
    if not said:
        assert disagreeing(found, 0.0) == []
        return
    (remark,) = told(disagreeing(found, 10.0))
    assert remark.severity == "doubt"
    first, last = (int(word) for word in (remark.text.split("t = ")[1].split()[0], remark.text.split(" to ")[1].split()[0]))
    assert (first, last) == (30, 50)


@pytest.mark.parametrize(("until", "share", "severity"), [(80, 0.4, "warning"), (100, 0.4, "doubt"), (80, 0.0, "doubt")])
def test_wheels_that_count_too_much_for_a_while_slip(until, share, severity):
    """Not to the end of the recording, and not while the lidar stands still: it may be covered."""
    found = pairs(way=0.3)
    found.lidar[60:until] *= share
    (remark,) = told(disagreeing(found, 0.0))
    assert (remark.kind, remark.severity) == ("wheels-against-lidar", severity)


@pytest.mark.parametrize(("count", "said"), [(8, False), (12, True)])
def test_a_disagreement_lasts_longer_than_a_slip_and_pairs_that_do_not_match_say_nothing(count, said):
    found = pairs()
    found.lidar[40 : 40 + count, 1] = 0.5
    assert len(disagreeing(found, 0.0)) == said
    found.share[40 : 40 + count] = 0.5
    assert disagreeing(found, 0.0) == []
    few = pairs(23)
    few.lidar[:12, 1] = 0.5
    assert disagreeing(few, 0.0) == []


@pytest.mark.parametrize(("factor", "share", "said"), [(-1.0, 1.0, True), (-1.0, 0.8, False), (0.8, 1.0, False)])
def test_small_turns_that_all_differ_from_half_time_are_said(factor, share, said):
    """Curves of 0.04 rad within half a second, one pair of three; a single one shows no difference of 0.08 rad."""
    found = pairs(240)
    turns = np.arange(0, 240, 3)
    found.wheels[turns, 2] = 0.04 * np.where(turns % 2, 1.0, -1.0)
    found.lidar[:] = found.wheels
    later = turns[turns >= 120]
    found.lidar[later[np.arange(len(later)) % 10 < 10.0 * share], 2] *= factor
    facts = disagreeing(found, 0.0)
    assert len(facts) == said
    for fact in facts:
        assert fact.figures["stretches"] == [pytest.approx((120.0, 237.5), abs=3.5)]
        assert not fact.figures["slips"]


def test_scans_that_have_nothing_in_common_with_the_wheels_replace_none():
    """The wheels stand for 10 s, and the scans move in any direction all the time."""
    rng = np.random.default_rng(1)
    found = pairs(100, lidar=rng.uniform(-0.3, 0.3, (100, 3)))
    (remark,) = told(disagreeing(found, 0.0))
    assert (remark.severity, remark.stretches) == ("doubt", ())
    assert "nothing in common" in remark.text
    time = 0.1 * np.arange(1000)
    log = SensorLog(driven(np.where((time > 50.0) & (time < 60.0), 0.0, 0.2), 0.0 * time), None)
    assert wheel_motion.lost(log, found) == []
    assert np.isnan(found.way_ratio)


def test_of_many_stretches_three_are_said():
    found = pairs(400)
    for first in range(20, 400, 80):
        found.lidar[first : first + 12, 1] = 0.5
    (remark,) = told(disagreeing(found, 0.0))
    assert remark.text.count("t = ") == 3
    assert "and 2 more stretches" in remark.text


def test_the_factor_of_turns_is_of_turns_alone():
    """A base that drives sideways, whose ways are half of what it counts and whose turns are right."""
    found = pairs()
    found.wheels[:], found.lidar[:] = [0.0, 3.0, 1.0], [0.0, 1.5, 1.0]
    assert disagreeing(found, 0.0) == []


@pytest.mark.parametrize(("walls", "said"), [(CORRIDOR, False), (box(16.0, 5.0), True)])
def test_a_motion_that_matches_hardly_better_than_that_of_the_wheels_is_none(walls, said):
    """Along bare walls any does; in a room that of the lidar is the one."""
    stamps = 0.1 * np.arange(600)
    truth = np.column_stack([0.2 * stamps - 6.0, np.zeros((600, 2))])
    seen = scans(stamps, truth, walls, noise=0.01, rng=np.random.default_rng(1))
    wheels = truth - np.outer(np.clip(stamps - 20.0, 0.0, 15.0), [0.2, 0.0, 0.0])
    found = compare(SensorLog(Odometry(stamps, truth), None, seen))
    slow = SensorLog(Odometry(stamps, wheels), None, seen)
    found.wheels[:] = slow.odometry.motion(found.start, found.end)
    assert len(disagreeing(found, 0.0)) == 1
    assert len(disagreeing(found, 0.0, slow)) == said


def test_a_robot_at_rest_whose_scans_differ_by_noise_stands():
    """Its scans seem to move by a few centimetres; where the wheels stand while it drives they do move, and match so alone."""
    path = two_rounds()
    rests, drives = np.concatenate([path[:1000], np.tile(path[1000], (100, 1)), path[1000:2400]]), path[:2400]
    for truth, found in ((rests, []), (drives, [(150.0, 155.0)])):
        log = room(truth)
        still = (log.odometry.stamps[1:] > 150.0) & (log.odometry.stamps[1:] <= 155.0)
        steps = np.where(still[:, None], 0.0, se2.between(truth[:-1], truth[1:]))
        log = replace(log, odometry=Odometry(log.odometry.stamps, se2.chain(truth[0], steps)))
        compared = compare(log)
        own = compared.within(150.0, 155.0)
        if not found:
            compared.lidar[own] += [0.04, 0.0, 0.0]
        assert wheel_motion.lost(log, compared) == [pytest.approx(stretch, abs=0.5) for stretch in found]


@pytest.mark.parametrize(("walls", "shown"), [(CORRIDOR, False), (box(16.0, 5.0), True)])
def test_scans_along_a_smooth_wall_do_not_show_that_a_robot_stands(walls, shown):
    """They match as well if it drove on; in a room they do not."""
    stamps = 0.1 * np.arange(300)
    odometry = driven(np.where((stamps > 10.0) & (stamps < 20.0), 0.0, 0.2), 0.0 * stamps)
    seen = scans(stamps, odometry.poses[:-1] - [6.0, 0.0, 0.0], walls, noise=0.01, rng=np.random.default_rng(1))
    log = SensorLog(odometry, None, seen)
    found = compare(log)
    assert found.measured[found.within(10.0, 20.0)].sum() > 10
    assert wheel_motion.show_rest(log, found, 10.0, 20.0) == shown
    assert not wheel_motion.show_rest(log, found, 18.0, 18.1)


def test_wheels_that_count_nothing_any_more_are_related_to_the_lidar_as_long_as_they_count():
    """From half time on the lidar drives and turns alone."""
    rng = np.random.default_rng(2)
    found = pairs(200)
    found.lidar[:, 2] = found.wheels[:, 2] = np.where(np.arange(200) % 2, 0.1 * rng.choice([-1.0, 1.0], 200), 0.0)
    found.wheels[100:] = 0.0
    assert not found.unrelated
    (fact,) = disagreeing(found, 0.0)
    assert fact.figures["stretches"] == [pytest.approx((100.0, 199.5), abs=1.5)]
    found.wheels[:100] = found.wheels[:100][rng.permutation(100)]
    assert found.unrelated


def test_a_pair_matches_clearly_worse_at_twice_the_square_of_another_that_noise_allows():
    least = PairPolicy.noise**2
    one, other = least * np.array([2.1, 1.9, 21.0, 19.0, 1.1, 0.9]), least * np.array([1.0, 1.0, 10.0, 10.0, 0.0, 0.0])
    assert wheel_motion._clearly_worse(one, other).tolist() == [True, False] * 3


def test_the_factor_is_the_median_of_those_along_the_wheels_of_clear_motions():
    rng = np.random.default_rng(1)
    wheels, lidar = rng.normal(size=(50, 2)) * 0.1, rng.normal(size=(50, 2))
    clear = np.flatnonzero(np.hypot(*wheels.T) > 0.08)
    # The factor by which the wheels' motion comes nearest to the lidar's.
    nearest = [np.linalg.lstsq(wheels[k, :, None], lidar[k], rcond=None)[0][0] for k in clear]
    assert times_as_large(lidar, wheels, 0.08, alike(50, 2)) == pytest.approx(np.median(nearest))
    assert times_as_large(lidar[clear][:12], wheels[clear][:12], 0.0, alike(12, 2)) == pytest.approx(np.median(nearest[:12]))
    assert np.isnan(times_as_large(lidar[:11], wheels[:11], 0.0, alike(11, 2)))


def test_noise_of_turns_that_are_chosen_by_it_makes_no_factor():
    """A robot that drives straight: of turns of 0.012 rad noise those beyond 0.03 rad are noise, and the lidar has a tenth."""
    rng = np.random.default_rng(3)
    wheels, lidar = rng.normal(0.0, 0.012, (4000, 1)), rng.normal(0.0, 0.001, (4000, 1))
    true = 0.5 * (np.arange(4000) % 100 == 0)[:, None]
    wheels, lidar = wheels + true, lidar + true
    assert times_as_large(lidar, wheels, 0.03, alike(4000, 1)) < 0.2
    assert abs(lidar_by_wheels(wheels, lidar, 0.03, 1.0, alike(4000, 1)) - 1.0) < 0.02
    assert lidar_by_wheels(wheels[:5], lidar[:5], 0.0, 7.0, alike(5, 1)) == 7.0


STILL = (20.0, 30.0)
"""When the wheels count nothing, s."""


def steady(until=60.0):
    stamps = np.arange(0.0, until, 0.05)
    return stamps, se2.chain(np.array([1.0, 2.0, 0.3]), np.tile([0.01, 0.0, 0.004], (len(stamps) - 1, 1)))


def log_of(period=0.1, first=-1.0):
    """Return the recording of a robot whose wheels stood still meanwhile, and its true poses."""
    stamps, truth = steady()
    steps = se2.between(truth[:-1], truth[1:])
    steps[(stamps[1:] > STILL[0]) & (stamps[1:] <= STILL[1])] = 0.0
    scans = np.arange(first, 61.0, period)
    readings = np.ones((len(scans), 4), dtype=np.float32)
    return SensorLog(
        Odometry(stamps, se2.chain(truth[0], steps)), None, LaserScans(scans, readings, 0.0, 0.1, 0.0, 0.1, 9.0)
    ), truth


@pytest.fixture
def exact_scans(monkeypatch):
    """Scans show the true motion exactly, but for two pairs that do not match."""
    stamps, truth = steady()

    def steps(scans, mounting, first, second, guess, searches=0):
        at = [se2.interpolate_trajectory(stamps, truth, scans.middles[k]) for k in (first, second)]
        return se2.between(*at), np.where(np.isin(np.arange(len(first)), [5, 6]), 0.4, 0.9), np.zeros((len(first), 3, 3))

    monkeypatch.setattr(wheel_motion, "scan_steps", steps)


@pytest.mark.usefixtures("exact_scans")
@pytest.mark.parametrize("period", [0.1, 0.2, 0.7])
def test_the_motion_of_scans_stands_in_and_the_rest_moves_along(period):
    log, truth = log_of(period)
    done, breaks = replaced(log, [STILL])
    np.testing.assert_array_equal(done.stamps, log.odometry.stamps)
    before, after = done.stamps <= STILL[0] - 2.0 * period, done.stamps >= STILL[1] + 1.5 * period
    np.testing.assert_array_equal(done.poses[before], log.odometry.poses[before])
    # A chord instead of an arc between scans, and the odometry's own count at the edges: some millimetres.
    off = se2.between(truth, done.poses)
    assert np.abs(off[:, :2]).max() < 0.2 * period + 0.01
    assert np.abs(off[:, 2]).max() < 0.1 * period
    own = log.odometry.poses
    np.testing.assert_allclose(
        se2.between(done.poses[after][:-1], done.poses[after][1:]), se2.between(own[after][:-1], own[after][1:]), atol=1e-9
    )
    # Scans a quarter of a second apart or one by one; their steps begin before the stretch and end behind it.
    apart = max(round(0.25 / period), 1) * period
    assert len(breaks.stamps) == pytest.approx(10.0 / apart, abs=2)
    assert STILL[0] - 0.25 - period <= breaks.stamps[0] <= STILL[0] + apart
    assert np.all(np.diff(breaks.stamps) > 0.0)
    # Nothing counts there: 0.3 m/s in any direction for 2 s at a time, so that scans and ranges alone decide.
    speed = np.hypot(*(truth[1, :2] - truth[0, :2])) / (log.odometry.stamps[1] - log.odometry.stamps[0])
    walk = np.sqrt(apart / 2.0) * np.array([2.0 * speed, 2.0 * speed, 0.5])
    np.testing.assert_allclose(breaks.sigma[1:-1], np.tile(walk, (len(breaks.stamps) - 2, 1)), rtol=0.02)


@pytest.mark.usefixtures("exact_scans")
def test_several_stretches_are_replaced_one_after_the_other_and_none_without_scans():
    log, _ = log_of()
    both, breaks = replaced(log, [(20.0, 24.0), (26.0, 30.0)])
    one, first = replaced(log, [(20.0, 24.0)])
    again, second = replaced(SensorLog(one, None, log.scans), [(26.0, 30.0)])
    np.testing.assert_array_equal(both.poses, again.poses)
    np.testing.assert_array_equal(breaks.stamps, np.concatenate([first.stamps, second.stamps]))
    late, _ = log_of(first=59.95)
    unchanged, nothing = replaced(late, [(20.0, 30.0)])
    assert unchanged is late.odometry
    assert len(nothing.stamps) == 0
    assert replaced(log, [])[0] is log.odometry


def test_steps_that_scans_do_not_show_go_on_as_before_and_after(monkeypatch):
    """Measured from rest and again from the median of seven; too long or unmatched ones are that median."""
    usual = np.tile([0.1, 0.0, 0.02], (12, 1))
    one, share = usual.copy(), np.full(12, 0.8)
    one[3], share[3] = [5.0, 0.0, 0.0], 0.9
    one[6], share[6] = [0.0, 0.3, 0.0], 0.29
    one[8], share[8] = [0.0, 0.2, 0.0], 0.8
    one[10], share[10] = [0.0, 0.4, 0.0], 0.5
    other, better = usual + np.array([0.0, 0.0, 0.001]), np.full(12, 0.78)
    better[[3, 6, 8, 10]] = 0.2, 0.2, 0.76, 0.75
    guesses, answers = [], iter([(one, share, None), (other, better, None)])

    def steps(scans, mounting, first, second, guess, searches=0):
        guesses.append(guess)
        return next(answers)

    monkeypatch.setattr(wheel_motion, "scan_steps", steps)
    log, _ = log_of()
    found = _smooth_steps(log, np.arange(13))
    np.testing.assert_array_equal(guesses[0], 0.0)
    np.testing.assert_allclose(guesses[1], usual)
    expected = other.copy()
    expected[[3, 6]] = usual[[3, 6]]
    expected[8] = one[8]
    np.testing.assert_allclose(found, expected)
