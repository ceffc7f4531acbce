"""Odometry by text line."""

import math
import random

import pytest
from helpers.driver_harness import check_transcript, feed_whole, good

from uwblite.drivers.devices import open_device
from uwblite.drivers.events import Corrupt, Note, OdometryPose
from uwblite.drivers.odometry_line import LineFormat, OdometryLineDriver, odometry_format, values_by
from uwblite.drivers.text_lines import Line, LineProtocol
from uwblite.errors import ConfigError

MOST = 256
"""Bytes of a line."""


def protocol(spec=None):
    return LineProtocol(values_by(spec or LineFormat()), MOST)


def test_transcript_in_every_split_and_among_noise():
    frames = [f"{0.05 * k:.3f},{0.01 * k:.4f},{-0.02 * k:.4f},{0.001 * k:.5f}\r\n".encode() for k in range(30)]
    expected = feed_whole(protocol, b"".join(frames))
    assert len(expected) == 30
    noises = [b"", b"\n", b"hello\n", b"1,2,3\n", b"1,2,3,nan\n", b"1,2,3,4,5\n", b"\xff\xfe\r\n", b"x" * 900 + b"\n"]
    check_transcript(protocol, frames, expected, noises)


@pytest.mark.parametrize("separator", [",", " ", ";", "\t", ", "])
def test_separators(separator):
    line = separator.join(["1.5", "2", "-3e0", ".25"]).encode() + b"\n"
    (sample,) = feed_whole(protocol, line)
    assert sample.content == {"t": 1.5, "x": 2.0, "y": -3.0, "theta": 0.25}


@pytest.mark.parametrize("line", [b"a,b,c,d", b"1,2,3", b"1,2,3,inf", b"1,2,3,0x10", b"1,2,3,1_0", b"1,2,3,--4"])
def test_lines_that_do_not_fit_are_corrupt(line):
    events = feed_whole(protocol, line + b"\n")
    assert [type(e) for e in events] == [Corrupt]


def test_prefix_and_skipped_columns():
    spec = odometry_format("-,t,x,y,theta", prefix="ODO ", time_unit=0.001, angle_unit=0.0174532925)
    (sample,) = protocol(spec).feed(b"[info] started\n#ODO 77 2500 1.0 2.0 90\n", 3.0)
    (pose,) = OdometryLineDriver(spec).measured(sample)
    assert (pose.x, pose.y) == (1.0, 2.0)
    assert pose.theta == pytest.approx(math.pi / 2)
    assert sample.content["t"] * spec.time_unit == pytest.approx(2.5)


def test_ticks_follow_a_circle_and_wrap():
    """A full turn on a circle of 1 m radius in 2,000 steps closes to the rounding of the ticks."""
    spec = odometry_format("t,left,right", tick=1e-4, wheel_base=0.3, tick_modulus=65536)
    driver = OdometryLineDriver(spec)
    for k in range(2001):
        angle = 2 * math.pi * k / 2000
        left, right = round(angle * 0.85 / 1e-4) % 65536, round(angle * 1.15 / 1e-4) % 65536
        for sample in good(protocol(spec).feed(f"{0.05 * k},{left},{right}\n".encode(), 0.05 * k)):
            (pose,) = driver.measured(sample)
    assert math.hypot(pose.x, pose.y) < 0.002
    assert abs(pose.theta) < 0.001


@pytest.mark.parametrize(
    "options",
    [
        "columns=t,x",
        "columns=t,x,y,theta,theta",
        "columns=t,left,right",
        "colums=t",
        "tick=abc",
        "columns=t,left,right&tick=0&wheel_base=0.3",
        "columns=t,x,y,psi",
    ],
)
def test_formats_that_make_no_pose_are_refused(options):
    with pytest.raises(ConfigError):
        open_device("odometry", f"line:/dev/null?{options}")


def test_memory_is_bounded():
    reader = protocol()
    rng = random.Random(0)
    for _ in range(2000):
        reader.feed(rng.randbytes(500).replace(b"\n", b"x").replace(b"\r", b"x"), 0.0)
        assert reader._lines.pending <= MOST


def lines_of(driver, rows):
    """Return what a driver makes of lines that come every 20 ms."""
    return [
        a
        for k, row in enumerate(rows)
        for a in driver.take(Line(50 + 0.02 * k, {**dict(zip("txy", row, strict=True)), "theta": 0.0}))
    ]


def rows(count, start=0.0, x=0.0):
    return [(start + 0.02 * k, x + 0.004 * k, 0.0) for k in range(count)]


@pytest.mark.parametrize("broken", [(1.0, 40.2, 0.0), (1.0, 0.2, -7.0), (11.0, 0.2, 0.0), (0.01, 0.2, 0.0)])
def test_a_line_that_leaps_away_and_back_is_damage(broken):
    """Lines have no sum: a digit that was lost makes another number of it."""
    good_rows = rows(400)
    actions = lines_of(OdometryLineDriver(LineFormat()), [*good_rows[:200], broken, *good_rows[200:]])
    poses = [a for a in actions if isinstance(a, OdometryPose)]
    assert [pose.x for pose in poses] == pytest.approx([row[1] for row in good_rows])
    assert [a.why for a in actions if isinstance(a, Corrupt)] == ["line that leaps away and back"]


def test_a_base_that_begins_again_is_followed_from_its_second_line():
    actions = lines_of(OdometryLineDriver(LineFormat()), [*rows(200, 100.0, 3.0), *rows(200)])
    assert len([a for a in actions if isinstance(a, OdometryPose)]) == 400
    assert [a.name for a in actions if isinstance(a, Note)] == ["odometry-clock"]


def test_a_stall_of_the_computer_costs_no_line():
    driver, poses = OdometryLineDriver(LineFormat()), []
    for k, (time, x, y) in enumerate(rows(600)):
        stamp = 50 + (0.02 * k if not 300 < k < 500 else 10.0)
        sample = Line(stamp, {"t": time, "x": x, "y": y, "theta": 0.0})
        poses += [a for a in driver.take(sample) if isinstance(a, OdometryPose)]
    assert len(poses) == 600
    assert [pose.stamp for pose in poses[200:]] == pytest.approx([50 + 0.02 * k for k in range(200, 600)], abs=1e-6)
