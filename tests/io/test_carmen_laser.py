import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from uwblite.io.carmen import LogReader
from uwblite.io.carmen_laser import LaserMessages, decode_equal_widths


@given(st.integers(1, 6), st.integers(1, 2), st.lists(st.integers(0, 10**8 - 1), min_size=6, max_size=6), st.booleans())
def test_numbers_of_equal_width_are_decoded_row_by_row(decimals, digits, numbers, spoil):
    width = digits + 1 + decimals
    words = [f"{(n % 10 ** (digits + decimals)) / 10**decimals:0{width}.{decimals}f}".encode() for n in numbers]
    if spoil:
        words[4] = words[4][:-1] + b"x"
    values, plain = decode_equal_widths(b" ".join(words) + b" ", 3, width)
    assert plain.tolist() == [True, not spoil]
    np.testing.assert_array_equal(values[0], np.array(words[:3], np.float64).astype(np.float32))
    if not spoil:
        np.testing.assert_array_equal(values[1], np.array(words[3:], np.float64).astype(np.float32))


WORD = st.text("0123456789.+-ex", min_size=1, max_size=9).map(str.encode)
READING = st.one_of(WORD, st.floats(0, 99, width=16).map(lambda v: b"%.2f" % v))
NUMBER = st.sampled_from([b"0", b"1.5", b"-2", b"nan", b"1e400", b"x", b""])
ODOMETRY = st.tuples(NUMBER, st.sampled_from([b"1", b"2", b"nan"]), st.booleans()).map(
    lambda w: b"ODOM %s 0 0 0 0 0 %s%s" % (w[0], w[1], b" r 1" if w[2] else b" 1")
)
RANGES = st.tuples(st.sampled_from([b"UWB", b"UWB2"]), st.sampled_from([b"a", b"b", b"\xff"]), NUMBER).map(
    lambda w: b"%s %s %s 100 1 r 1" % w
)
SCANS = st.tuples(st.sampled_from([b"FLASER", b"RAWLASER1 0 0 1 0.1 8 0 0"]), st.lists(READING, min_size=2, max_size=3)).map(
    lambda w: b"%s 2 %s %s" % (w[0], b" ".join(w[1]), b"0 0 0 0 0 0 1 r 1" if w[0] == b"FLASER" else b"0 1 r 1")
)
LINES = st.lists(st.one_of(ODOMETRY, RANGES, SCANS, st.just(b""), st.just(b"SYNC a 1 r 1")), max_size=12)


@given(st.lists(READING, min_size=1, max_size=6), st.lists(READING, min_size=1, max_size=6))
def test_readings_are_what_float_reads_or_the_line_is_broken(first, second):
    reader, wanted, broken = LogReader("log", 1, 1.0), [], 0
    for words in (first, second, second):
        reader.feed(b"FLASER %d %s 0 0 0 0 0 0 1 r 1\n" % (len(words), b" ".join(words)))
        try:
            wanted.append(np.clip(np.array(words, np.float64), -1.0, 1e30).astype(np.float32))
        except ValueError:
            broken += 1
    assert reader.broken == broken
    read = [np.array(scans.ranges).reshape(-1, layout.beams) for layout, scans in reader.laser._scans.items()]
    assert sum(map(len, read)) == len(wanted)
    np.testing.assert_array_equal(np.sort(np.concatenate([*map(np.ravel, read), []])), np.sort(np.concatenate([*wanted, []])))


@given(LINES)
def test_lines_that_are_read_together_are_those_that_are_read_one_by_one(lines):
    """Kinds of a block are read together once the log has ipc_timestamp; a block of one line has as many kinds as lines."""
    together, one_by_one = LogReader("log", 2, 1.0), LogReader("log", 2, 1.0)
    together.feed(b"ODOM 0 0 0 0 0 0 1 r 1\nUWB a 1 100 1 r 1\nFLASER 2 1.00 2.00 0 0 0 0 0 0 1 r 1\n")
    one_by_one.feed(b"ODOM 0 0 0 0 0 0 1 r 1\nUWB a 1 100 1 r 1\nFLASER 2 1.00 2.00 0 0 0 0 0 0 1 r 1\n")
    together.feed(b"".join(line + b"\n" for line in lines))
    one_by_one._take_kinds = lambda lines, before: list(range(len(lines)))
    one_by_one.feed(b"".join(line + b"\n" for line in lines))
    for name in ("odometry", "uwb", "uwb_ids", "messages", "broken", "broken_lines", "skipped", "ends_broken", "lines"):
        assert repr(getattr(together, name)) == repr(getattr(one_by_one, name)), name
    for scans in zip(together.laser._scans.items(), one_by_one.laser._scans.items(), strict=True):
        (layout, mine), (other, others) = scans
        assert (layout, mine.seen) == (other, others.seen)
        assert sorted(mine.numbers) == sorted(others.numbers)
        np.testing.assert_array_equal(np.sort(mine.ranges), np.sort(others.ranges))
    poses = [np.column_stack(reader.laser.robot_poses()).tolist() for reader in (together, one_by_one)]
    assert sorted(poses[0]) == sorted(poses[1])


def test_poses_of_messages_that_are_read_together_have_the_numbers_of_their_lines():
    def line(k):
        return f"FLASER 2 1.0{k} 2.00 {k}.5 0 0 {k}.5 {k}.25 0.5 {k}.0 r {k}.0\n"

    reader = LogReader("log", 2, 1.0)
    reader.feed(f"ODOM 0 0 0 0 0 0 1 r 1\n{line(1)}".encode())
    reader.feed("".join(line(k) + "# between\n" for k in range(2, 8)).encode())
    poses, lines = reader.laser.robot_poses()
    assert lines.tolist() == [2, *range(3, 15, 2)]
    np.testing.assert_array_equal(poses, [[k, k + 0.5, k + 0.25, 0.5] for k in range(1, 8)])
    (scans,) = reader.laser._scans.values()
    assert list(scans.numbers) == [2, 5, 9, 13]


def test_scans_that_are_written_alike_are_taken_together(monkeypatch):
    """One by one they are read at a fraction of the speed."""
    take, alone = LaserMessages.take, []

    def counted(own, name, number, words):
        alone.append(number)
        take(own, name, number, words)

    monkeypatch.setattr(LaserMessages, "take", counted)
    reader = LogReader("log", 1, 1.0)
    line = b"FLASER 3 1.25 2.50 3.75 0 0 0 0 0 0 %d r %d\n"
    reader.feed(b"ODOM 0 0 0 0 0 0 1 r 1\n" + line % (1, 1))
    reader.feed(b"".join(line % (k, k) for k in range(2, 8)))
    assert alone == [2]
    (scans,) = reader.laser._scans.values()
    assert list(scans.numbers) == list(range(2, 9))
    np.testing.assert_array_equal(np.array(scans.ranges).reshape(-1, 3), 7 * [[1.25, 2.5, 3.75]])


def test_a_message_that_ends_with_its_first_reading_is_too_short():
    """Alone of its kind in a block, it would be taken with others that begin alike: there is no blank behind the first."""
    head = b"RAWLASER1 0 0 1 0.1 8 0 0 2 "
    reader = LogReader("log", 1, 1.0)
    reader.feed(b"ODOM 0 0 0 0 0 0 1 r 1\n" + head + b"1.00 2.00 0 2 r 2\n")
    assert not reader.broken
    reader.feed(head + b"1." + b"0" * (len(head) - 4) + b"\n")
    assert reader.broken == 1
    assert "too short" in str(reader.broken_lines)
