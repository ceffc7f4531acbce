"""The chain of odometry: what is a jump, what joins its sides, and readings that are left out."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.told import told

from uwblite import se2
from uwblite.errors import DataError
from uwblite.screening.odometry_chain import Motion, rejoined, without_glitches, without_repeats
from uwblite.sensor_log import Odometry


def steady(speed=0.4, turn_rate=0.1, count=200, period=0.1):
    steps = np.tile([speed * period, 0.0, turn_rate * period], (count - 1, 1))
    return Odometry(period * np.arange(count), se2.chain(np.array([1.0, 2.0, 0.5]), steps))


@pytest.mark.parametrize(
    ("speed", "turn_rate", "most"),
    [(0.1, 0.4, (0.5, 2.0)), (0.2, 0.6, (0.8, 2.4)), (2.0, 0.0, (8.0, 2.0)), (5.0, 3.0, (9.0, 12.0)), (0.0, 0.0, (0.5, 2.0))],
)
def test_the_greatest_plausible_speed_is_four_times_the_usual_one(speed, turn_rate, most):
    np.testing.assert_allclose(Motion.of(steady(speed, turn_rate)).speed, most)


def test_what_is_usual_is_the_upper_quartile_of_the_steps_that_move():
    steps = np.zeros((400, 3))
    steps[200:, 0] = 0.1 * np.linspace(0.0, 1.0, 200)
    odometry = Odometry(0.1 * np.arange(401), se2.chain(np.zeros(3), steps))
    assert Motion.of(odometry).speed[0] == pytest.approx(4.0 * 0.75, rel=0.01)


@pytest.mark.parametrize(("excess", "jumps"), [(0.999, False), (1.001, True)])
@pytest.mark.parametrize("sort", ["way", "turn", "back"])
def test_a_step_beyond_the_least_and_the_greatest_speed_jumps(sort, excess, jumps):
    """0.3 m and 0.5 rad, and what the greatest speed covers in its time and two usual periods more."""
    steps = np.tile([0.04, 0.0, 0.001], (100, 1))
    span = np.full(100, 0.1)
    span[50] = 0.7
    most = {"way": [0.3 + 1.6 * 0.9, 0, 0], "turn": [0, 0, 0.5 + 2.0 * 0.9], "back": [0, -0.3 - 1.6 * 0.9, 0]}[sort]
    steps[50] = np.array(most) * excess
    motion = Motion.of(Odometry(np.append(0.0, np.cumsum(span)), se2.chain(np.zeros(3), steps)))
    assert np.flatnonzero(motion.jumps()).tolist() == ([50] if jumps else [])
    assert not Motion.of(steady(count=1)).jumps().any()


@pytest.mark.parametrize("at", [3, 100, 197])
@pytest.mark.parametrize("gap", [0.0, 3.0])
def test_a_break_is_joined_by_the_motion_before_and_after_it(at, gap):
    """For a second at most: who drives on as he did is where he was."""
    true = steady()
    stamps = 1e3 + true.stamps + gap * (np.arange(200) > at)
    broken = true.poses.copy()
    broken[at + 1 :] = se2.compose(np.array([9.0, -5.0, 2.0]), broken[at + 1 :])
    joined, breaks, facts = rejoined(Odometry(stamps, broken))
    (remark,) = told(facts)
    factor = min(0.1 + gap, 1.0) / 0.1
    expected = se2.between(true.poses[:-1], true.poses[1:]) * np.where(np.arange(199) == at, factor, 1.0)[:, None]
    np.testing.assert_allclose(se2.between(joined.poses[:-1], joined.poses[1:]), expected, atol=1e-12)
    np.testing.assert_allclose(joined.poses[0], true.poses[0])
    np.testing.assert_array_equal(breaks.stamps, stamps[[at]])
    np.testing.assert_allclose(breaks.sigma, 0.05 + 0.5 * np.array([[1.6, 1.6, 2.0]]) * (0.1 + gap))
    length = np.hypot(*se2.between(broken[at], broken[at + 1])[:2])
    assert f"at t = {0.1 * at:.1f} s (by up to {length:.2f} m)" in remark.text


def test_only_steps_near_a_break_and_no_other_break_predict_its_motion():
    """Six on either side; before them the robot stood, and the next break is two steps on."""
    steps = np.tile([0.04, 0.0, 0.0], (60, 1))
    steps[:24] = steps[37:] = 0.0
    steps[[30, 32]] = [20.0, 0.0, 0.0], [0.0, -30.0, 0.0]
    joined, breaks, facts = rejoined(Odometry(0.1 * np.arange(61), se2.chain(np.zeros(3), steps)))
    (remark,) = told(facts)
    found = se2.between(joined.poses[:-1], joined.poses[1:])
    # Of the steps 24 to 36 but 30 and 32 all drive; of 26 to 38 the last two stand.
    np.testing.assert_allclose(found[[30, 32], 0], [0.04, 0.04 * 9 / 11], rtol=1e-9)
    np.testing.assert_allclose(breaks.stamps, [3.0, 3.2])
    assert "t = 3.0, 3.2 s (by up to 30.00 m)" in remark.text


def test_a_chain_of_two_readings_that_jumps_stands():
    joined, breaks, _ = rejoined(Odometry(np.array([0.0, 0.1]), np.array([[0.0, 0.0, 0.0], [50.0, 0.0, 1.0]])))
    np.testing.assert_array_equal(joined.poses, 0.0)
    assert len(breaks.stamps) == 1


def test_many_breaks_are_listed_to_the_fifth():
    steps = np.tile([0.04, 0.0, 0.0], (199, 1))
    steps[20::20] = [5.0, 0.0, 0.0]
    _, breaks, facts = rejoined(Odometry(0.1 * np.arange(200), se2.chain(np.zeros(3), steps)))
    (remark,) = told(facts)
    assert len(breaks.stamps) == 9
    assert "t = 2.0, 4.0, 6.0, 8.0, 10.0 ... s" in remark.text


def glitch(first, count, off=(40.0, 0.0, 0.0)):
    odometry = steady()
    poses = odometry.poses.copy()
    poses[first : first + count] += off
    return replace(odometry, poses=poses)


@pytest.mark.parametrize(
    ("first", "count", "left_out"),
    [(50, 1, True), (50, 10, True), (50, 11, False), (198, 1, True), (1, 1, True), (199, 1, False)],
)
def test_readings_off_for_less_than_a_second_are_left_out(first, count, left_out):
    """The last one may as well be a jump."""
    bad = glitch(first, count)
    done, facts = without_glitches(bad)
    remarks = told(facts)
    kept = np.delete(np.arange(200), np.arange(first, first + count) if left_out else [])
    np.testing.assert_array_equal(done.stamps, bad.stamps[kept])
    np.testing.assert_array_equal(done.poses, bad.poses[kept])
    assert [r.text.split(" lie")[0] for r in remarks] == [f"{count} odometry readings"] * left_out
    assert all(f"t = {0.1 * first:.1f} s" in r.text for r in remarks)


def test_a_turn_that_goes_back_is_a_glitch_and_one_that_stays_is_none():
    assert len(without_glitches(glitch(50, 1, (0.0, 0.0, 2.5)))[0].stamps) == 199
    assert without_glitches(glitch(50, 150, (0.0, 0.0, 2.5)))[1] == []
    # Two jumps one after the other that do not lead back.
    odometry = steady()
    poses = odometry.poses + np.outer(np.arange(200) >= 50, [40.0, 0.0, 0.0]) + np.outer(np.arange(200) >= 53, [0.0, 40.0, 0.0])
    assert without_glitches(replace(odometry, poses=poses))[1] == []


def test_a_reading_between_two_glitches_is_kept():
    odometry = steady()
    poses = odometry.poses.copy()
    poses[[50, 52]] += [40.0, 0.0, 0.0]
    done, _ = without_glitches(replace(odometry, poses=poses))
    np.testing.assert_array_equal(done.stamps, np.delete(odometry.stamps, [50, 52]))


@pytest.mark.parametrize(
    ("count", "wrong", "refused"), [(400, 10, False), (400, 11, True), (2000, 50, False), (2000, 51, True)]
)
def test_an_odometry_that_jumps_all_the_time_is_of_two_sources(count, wrong, refused):
    """More than 20 times, and more than 5 % of the steps; each reading apart jumps there and back."""
    odometry = steady(count=count)
    off = np.isin(np.arange(count), np.arange(1, wrong + 1) * (count // (wrong + 2)))
    bad = replace(odometry, poses=odometry.poses + np.outer(off, [60.0, 0.0, 0.0]))
    if refused:
        first, last = (0.1 * k for k in np.flatnonzero(off)[[0, -1]])
        with pytest.raises(
            DataError, match=rf"{2 * off.sum()} times in {count} readings, from t = {first - 0.1:.1f} to {last:.1f} s"
        ):
            without_glitches(bad)
    else:
        assert len(without_glitches(bad)[0].stamps) == count - off.sum()


def test_only_what_repeats_stamp_and_pose_is_a_repeat():
    stamps = np.array([0.0, 0.0, 0.1, 0.1, 0.2, 0.2])
    poses = np.array([[0, 0, 0], [0, 0, 0], [1, 0, 0], [1, 0, 0.1], [1, 0, 0.1], [1, 0, 0.1]], dtype=float)
    done, facts = without_repeats(Odometry(stamps, poses))
    assert [fact.figures for fact in facts] == [{"count": 2}]
    np.testing.assert_array_equal(done.stamps, [0.0, 0.1, 0.1, 0.2])
    np.testing.assert_array_equal(done.poses, poses[[0, 2, 3, 4]])
    whole = Odometry(stamps[::2], poses[::2])
    assert without_repeats(whole) == (whole, [])


@pytest.mark.parametrize(("at", "other"), [(3, 0), (56, 59)])
def test_the_first_and_the_last_step_predict_as_well(at, other):
    steps = np.tile([0.04, 0.0, 0.0], (60, 1))
    steps[other], steps[at] = [0.1, 0.0, 0.0], [20.0, 0.0, 0.0]
    joined, _, _ = rejoined(Odometry(0.1 * np.arange(61), se2.chain(np.zeros(3), steps)))
    assert se2.between(joined.poses[at], joined.poses[at + 1])[0] == pytest.approx((0.1 + 8 * 0.04) / 9)
