"""Lines of the log: stamps of the wall clock, and the time since the recording began."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from uwblite.drivers.devices import open_device
from uwblite.drivers.events import OdometryPose, RangeEpoch, RangeReading
from uwblite.drivers.link import Host, Link, Mounting
from uwblite.drivers.log_file import LogText


class Written:
    """Stands in for the file."""

    def __init__(self):
        self.head, self.lines = [], []

    def write(self, lines):
        self.lines += lines


def text_at(*moments):
    """Return a text whose clock shows these moments, s, one after the other; it began at 50 s, 1000 s before wall time."""
    clock, log = iter((50.0, *moments)), Written()
    return LogText(log, Mounting(params=(("anchor_height", "2.0"),)), Host("robot", lambda: next(clock), 1000.0)), log


@pytest.mark.parametrize(("moment", "elapsed"), [(50.25, "0.250"), (49.0, "0.000"), (3650.0, "3600.000")])
def test_a_comment_has_the_time_since_the_beginning_and_one_line(moment, elapsed):
    text, log = text_at(moment)
    text.comment("two\nlines  of it")
    text.flush()
    assert log.lines == [f"COMMENT {elapsed} two lines of it"]


def test_a_parameter_is_written_once_for_each_value_and_stands_in_the_head():
    text, log = text_at(50.5, 50.5, 51.0, 51.0)
    for value in ("1", "1", "2"):
        text.param("laser_range_min", value)
    text.flush()
    assert log.lines == [
        "PARAM laser_range_min 1 1050.500000 robot 0.500000", "PARAM laser_range_min 2 1051.000000 robot 1.000000",
    ]  # fmt: skip
    assert log.head == log.lines


def written_stamps(measurements):
    log = Written()
    text = LogText(log, Mounting(), Host("robot", lambda: 0.0, 1.7e9))
    link = Link("odometry", "port", open_device("odometry", "line:port?columns=x,y,theta")[0])
    for measured in measurements:
        text.write(measured, link)
    text.flush()
    return [(line.split()[0:2], float(line.split()[-3]) - 1.7e9) for line in log.lines]


@given(
    rows=st.lists(
        st.tuples(st.floats(1e-5, 2.0), st.sampled_from([0.0, 0.0, 1e-7, 0.02, 1.5]), st.floats(-0.01, 0.01)), max_size=40
    )
)
def test_stamps_of_a_sensor_rise_and_none_gets_worse_than_one_before_was(rows):
    """Read late in bursts, and by clock maps that are corrected now and then."""
    true, stamps, worst = 0.0, [], []
    for step, late, error in rows:
        true += step
        stamps.append((true, true + late + error))
        worst.append(max([abs(late + error), *worst[-1:]]))
    out = [stamp for _, stamp in written_stamps([OdometryPose(stamp, 0.0, 0.0, 0.0) for _, stamp in stamps])]
    assert all(after - before > 0.5e-6 for before, after in pairwise(out))
    for (true, own), stamp, most in zip(stamps, out, worst, strict=True):
        assert stamp >= own - 1e-6
        assert abs(stamp - true) <= most + 1.5e-6


def test_lines_of_one_round_share_its_stamp_and_a_late_anchor_keeps_its_own():
    """On a damaged link a new anchor's ranges wait for others that agree, while known anchors go on."""
    rounds = [(1.0, "AB"), (1.0, "C"), (1.0, "A"), (1.1, "ABC"), (0.9, "D"), (1.05, "D"), (1.0, "D")]
    epochs = [RangeEpoch(stamp, tuple(RangeReading(name, 2.0, 100) for name in names)) for stamp, names in rounds]
    out = [(words[1], round(stamp, 6)) for words, stamp in written_stamps(epochs)]
    assert out == [
        ("A", 1.0), ("B", 1.0), ("C", 1.0), ("A", 1.000001), ("A", 1.1), ("B", 1.1), ("C", 1.1),
        ("D", 0.9), ("D", 1.05), ("D", 1.050001),
    ]  # fmt: skip
