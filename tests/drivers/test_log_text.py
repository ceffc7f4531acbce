"""Lines of the log: stamps of the wall clock, and the time since the recording began."""

import pytest

from uwblite.drivers.link import Host, Mounting
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
