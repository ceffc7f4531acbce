"""Logs whose stamps are false, stand still or were never set: the order of the lines tells what they do not."""

import numpy as np
import pytest

from uwblite import se2
from uwblite.io.carmen import read_log
from uwblite.io.carmen_stamps import false_stamps
from uwblite.screening.screen import screen
from uwblite.sensor_log import stand_still

GARBAGE = ("0", "-5.7752", "8.5429e-72", "9.98035", "1.30388e-76")


def corrected(stamp, count=600, speed=0.4, garbage=GARBAGE, every=10, extra=""):
    """Return a log in the form of GMapping's corrected ones: a laser message, an ODOM that repeats it, a NEFF.

    Parameters
    ----------
    stamp : gives the text of the stamp of reading k.
    """
    lines = []
    for k in range(count):
        t = 0.1 * k
        pose = f"{3 * np.sin(speed * t / 3):.6f} {3 - 3 * np.cos(speed * t / 3):.6f} {speed * t / 3:.6f}"
        lines.append(f"ODOM {pose} 0 0 0 {stamp(k)} pippo {stamp(k)}")
        if k % every == every - 1:
            lines.append(f"FLASER 180 {' '.join(['2.5'] * 180)} {pose} {pose} {stamp(k)} pippo {stamp(k)}")
            false = garbage[k // every % len(garbage)]
            lines += [f"ODOM {pose} 0 0 0 {false} pippo {false}", "NEFF 30.5"]
            lines += [extra.format(stamp=stamp(k))] if extra else []
    return "\n".join(lines) + "\n"


def read(tmp_path, text):
    (tmp_path / "run.log").write_text(text)
    return read_log(tmp_path / "run.log")


def leaping(count=60, every=10):
    """Return a corrected log of a robot that drives, stands from reading 32 to 37 and drives on: it leaps at each scan."""
    rng, truth, lines, off, x = np.random.default_rng(2), [], [], np.zeros(3), 0.0
    for k in range(count):
        x += 0.0 if 32 <= k <= 37 else 0.04
        pose, t = se2.compose(off, np.array([x, 0.1 * x * x, 0.2 * x])), f"{100 + 0.1 * k:.6g}"
        lines.append("ODOM {} {} {} 0 0 0 {t} h {t}".format(*pose, t=t))
        if k % every == every - 1:
            off = se2.compose(off, rng.normal(0.0, 0.02, 3))
            pose = se2.compose(off, np.array([x, 0.1 * x * x, 0.2 * x]))
            text = "{} {} {}".format(*pose)
            lines.append(f"FLASER 180 {' '.join(['2.5'] * 180)} {text} {text} {t} h {t}")
            lines.append(f"ODOM {text} 0 0 0 0 h 0")
            truth.append(pose)
    return "\n".join(lines) + "\n", np.array(truth)


def test_a_corrected_log_has_the_corrected_poses_at_its_scans_and_no_leaps(tmp_path):
    """GMapping corrects the pose at each scan, and the odometry behind it goes on from there."""
    text, truth = leaping()
    log = read(tmp_path, text)
    np.testing.assert_allclose(log.odometry.at(log.scans.stamps), truth, atol=1e-9)
    inside = (log.odometry.stamps > 103.15) & (log.odometry.stamps < 103.75)
    np.testing.assert_allclose(log.odometry.stamps[inside], 103.2 + 0.1 * np.arange(6), atol=1e-6)
    assert np.ptp(log.odometry.poses[inside], axis=0).max() < 1e-9  # it stands
    place = log.odometry.poses[inside][0]
    between = se2.between(truth[2], truth[3])
    assert 0.0 < se2.between(truth[2], place)[0] < between[0]
    assert any("this log was corrected, as by GMapping: 6 ODOM messages repeat" in w for w in log.notes.warnings)
    assert log.notes.one_clock
    assert not log.notes.set_back


def test_a_repetition_whose_stamp_was_never_set_is_dropped(tmp_path):
    """A few do not make a corrected log; those with a stamp that fits stay."""
    text = corrected(lambda k: f"{100 + 0.1 * k:.6g}", garbage=("0", *[None] * 9))
    lines = [line for line in text.splitlines() if "None" not in line]
    log = read(tmp_path, "\n".join(lines) + "\n")
    np.testing.assert_allclose(log.odometry.stamps, 100 + 0.1 * np.arange(600), atol=1e-6)
    assert any(w.startswith("6 ODOM messages repeat the pose of the laser message") for w in log.notes.warnings)
    assert not log.notes.one_clock


@pytest.mark.parametrize(
    "stamp", [lambda k: "1.01893e+09", lambda k: "0", lambda k: "4.29497e+09" if k > 90 else f"{-0.04 * k:.6g}"]
)
def test_stamps_that_stand_still_give_way_to_the_order_of_lines(tmp_path, stamp):
    """The readings move at a usual speed, and each scan has the odometry's pose of its own line."""
    log = read(tmp_path, corrected(stamp, extra="UWB A1 2.0 100 {stamp} pippo {stamp}"))
    assert any("stamps of this log cannot be used" in w for w in log.notes.warnings)
    assert np.all(np.diff(log.odometry.stamps) > 0.0)
    speed = log.odometry.travelled[-1] / np.ptp(log.odometry.stamps)
    assert 0.2 < speed <= 0.5
    assert np.all(np.isin(log.scans.stamps, log.odometry.stamps))
    np.testing.assert_allclose(log.odometry.travelled_at(log.scans.stamps), 0.4 * np.arange(60), atol=0.03)
    np.testing.assert_allclose(log.odometry.travelled_at(log.ranges.stamps)[:-1], 0.4 * np.arange(59) + 0.1, atol=0.11)
    assert log.notes.one_clock
    done = screen(log.without(lidar=True, uwb=True))  # neither another unit, nor two robots, nor a clock that was set back
    assert done.screening.facts == ()
    np.testing.assert_array_equal(done.odometry.poses, log.odometry.poses)


def test_odometry_of_a_log_that_nobody_corrected_goes_by_its_lines(tmp_path):
    lines = [line for line in corrected(lambda k: "7").splitlines() if not line.endswith(GARBAGE)]
    log = read(tmp_path, "\n".join(lines) + "\n")
    assert len(log.odometry.stamps) == 600
    assert np.all(np.diff(log.odometry.stamps) > 0.0)
    np.testing.assert_allclose(log.odometry.travelled_at(log.scans.stamps), 0.04 * np.arange(9, 600, 10), atol=0.04)
    assert any("599 of 600 have that of the message before" in w for w in log.notes.warnings)


def test_stamps_of_one_sensor_that_stand_still_follow_the_odometry(tmp_path):
    text = corrected(lambda k: f"{100 + 0.1 * k:.6g}", extra="UWB A1 2.0 100 7 pippo 7")
    log = read(tmp_path, text)
    assert any("stamps of 60 UWB messages stand still" in w for w in log.notes.warnings)
    np.testing.assert_allclose(log.ranges.stamps, log.scans.stamps, atol=0.25)


def test_a_stamp_of_zero_among_others_was_never_set(tmp_path):
    lines = [f"ODOM {0.1 * k} 0 0 0 0 0 {1e9 + 0.1 * k:.3f} a 0" for k in range(50)]
    for k in (0, 7, 20, 21, 49):
        lines[k] = f"ODOM {0.1 * k} 0 0 0 0 0 0 a 0"
    log = read(tmp_path, "\n".join(lines) + "\n")
    assert any(w.startswith("5 of 50 odometry messages have a stamp that no clock gives (the first is 0 s in line 1)")
               for w in log.notes.warnings)  # fmt: skip
    inner = slice(1, 49)
    np.testing.assert_allclose(log.odometry.stamps[inner], 1e9 + 0.1 * np.arange(50)[inner], atol=1e-6)
    np.testing.assert_allclose(log.odometry.poses[:, 0], 0.1 * np.arange(50))


@pytest.mark.parametrize(("period", "most"), [(0.125, 11), (1.0 / 64.0, 33), (1.0, 9)])
def test_a_clock_that_begins_at_zero_has_stamps_of_zero_for_ten_readings_or_half_a_second(period, most):
    """Later ones were never set, nor are those before a stamp of more than 10 s."""
    for k in range(1, 60):
        stamps = period * np.arange(60.0)
        stamps[k] = 0.0
        np.testing.assert_array_equal(false_stamps(stamps), (np.arange(60) == k) & (k > most))
    assert not false_stamps(np.zeros(60)).any()
    assert not false_stamps(np.append(np.zeros(59), 100.0)).any()


@pytest.mark.parametrize("seed", range(5))
def test_false_stamps_are_those_that_were_made_false(seed):
    """Whatever the rhythm; where the lines were mixed or a clock was set back, nothing is called false."""
    rng = np.random.default_rng(seed)
    stamps = 1e9 + np.cumsum(rng.exponential(0.2, 400))
    made = np.zeros(400, dtype=bool)
    made[rng.choice(np.arange(1, 200), 12, replace=False) * 2 - 1] = True
    false = np.where(made, rng.uniform(-1e10, 1e10, 400), stamps)
    np.testing.assert_array_equal(false_stamps(false), made)
    assert not false_stamps(stamps).any()
    assert not false_stamps(rng.permutation(1000.0 * (stamps - 1e9))).any()
    assert not false_stamps(np.concatenate([stamps[200:], stamps[:200]])).any()


def test_buffers_do_not_stand_still():
    """Bursts share a stamp while the robot drives a few metres at most; one stamp for all of the path does not pass."""
    travelled = 0.05 * np.arange(1000)
    assert not stand_still(np.repeat(np.arange(50.0), 20), travelled)
    assert stand_still(np.repeat(np.arange(4.0), 250), travelled)
    assert stand_still(np.zeros(1000), travelled)
    assert not stand_still(np.zeros(1000), np.zeros(1000))
    assert not stand_still(np.zeros(10), travelled[:10])


def test_between_the_scans_of_a_corrected_log_nothing_is_silent(tmp_path):
    """Some of its scans are seconds apart, others come where the robot stands."""
    lines, t = [], 0.0
    for k in range(40):
        t, pose = t + (8.0 if k in (20, 30) else 0.2), f"{0.3 * k} 0 0"
        lines.append(f"FLASER 180 {' '.join(['2.5'] * 180)} {pose} {pose} {t} h {t}")
        lines.append(f"ODOM {pose} 0 0 0 -5.77 h -5.77")
    log = read(tmp_path, "\n".join(lines) + "\n")
    assert not [r for r in screen(log.without(lidar=True)).screening.facts if r.kind == "odometry-gap"]
    assert log.notes.one_clock
