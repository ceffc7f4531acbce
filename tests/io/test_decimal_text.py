import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from uwblite.io.decimal_text import decode_equal_widths, decode_fixed_point, encode_fixed_point


def decode(rows, decimals):
    """Decode rows of words, each followed by a blank."""
    text = b"prefix: " + b" ".join(b" ".join(row) for row in rows) + b" "
    text += b" " * (-len(text) % 8)
    gaps = np.flatnonzero(np.frombuffer(text, np.uint8) == 32)
    count = len(rows) * len(rows[0])
    ends = gaps[1 : count + 1].reshape(len(rows), -1)
    begins = gaps[:count].reshape(len(rows), -1) + 1
    return decode_fixed_point(np.frombuffer(text, np.uint8), ends, begins, decimals)


@given(st.integers(1, 6).flatmap(lambda d: st.tuples(st.just(d), st.lists(st.integers(0, 10**7 - 1), min_size=1, max_size=20))))
def test_plain_numbers_of_up_to_eight_characters_are_decoded(case):
    decimals, digits = case
    words = [f"{number % 10 ** (7 - decimals) + (number / 10**decimals) % 1:.{decimals}f}"[:8].encode() for number in digits]
    values, plain = decode([words], decimals)
    good = all(len(w) <= 8 and len(w.split(b".")[1]) == decimals for w in words)
    assert plain[0] == good
    if good:
        np.testing.assert_array_equal(values[0], np.array(words, np.float64).astype(np.float32))


WORD = st.text("0123456789.+-ex", min_size=1, max_size=9).map(str.encode)


@given(st.lists(WORD, min_size=1, max_size=6))
def test_what_is_called_plain_is_what_float_reports(words):
    values, plain = decode([words], 3)
    if plain[0]:
        np.testing.assert_array_equal(values[0], np.array(words, np.float64).astype(np.float32))
        assert all(len(w.rpartition(b".")[2]) == 3 for w in words)


def test_rows_are_judged_one_by_one():
    values, plain = decode([[b"1.000", b"2.500"], [b"1.000", b"x.500"], [b"12.250", b"9.999"]], 3)
    assert plain.tolist() == [True, False, True]
    np.testing.assert_array_equal(values[[0, 2]], np.array([[1, 2.5], [12.25, 9.999]], np.float32))


SHAPE = st.tuples(st.integers(1, 4), st.integers(1, 9))


@given(hnp.arrays(np.float32, SHAPE, elements=st.floats(0, 99999, width=32)), st.integers(1, 3))
def test_numbers_are_written_as_format_writes_them(values, decimals):
    for row, line in zip(values, encode_fixed_point(values, decimals), strict=True):
        words = line.decode().split(" ")
        assert len(words) == len(row)
        for number, word in zip(row.tolist(), words, strict=True):
            assert word == f"{float(word):.{decimals}f}"
            # Ties may fall either way.
            assert abs(float(word) - number) <= 0.5000001 * 10**-decimals + 1e-9


def test_nothing_is_written_as_nothing():
    assert encode_fixed_point(np.zeros((2, 0), np.float32)) == [b"", b""]


@given(st.integers(1, 6), st.integers(1, 2), st.lists(st.integers(0, 10**8 - 1), min_size=6, max_size=6), st.booleans())
def test_numbers_of_equal_width_are_decoded_row_by_row(decimals, digits, numbers, spoil):
    width = digits + 1 + decimals
    words = [f"{(n % 10 ** (digits + decimals)) / 10**decimals:0{width}.{decimals}f}".encode() for n in numbers]
    if spoil:
        words[4] = words[4][:-1] + b"x"
    text = b"ab " + b" ".join(words) + b"\n"
    begins = np.array([3, 3 + 3 * (width + 1)])
    values, plain = decode_equal_widths(np.frombuffer(text, np.uint8), begins, 3, width, decimals)
    assert plain.tolist() == [True, not spoil]
    np.testing.assert_array_equal(values[0], np.array(words[:3], np.float64).astype(np.float32))
    if not spoil:
        np.testing.assert_array_equal(values[1], np.array(words[3:], np.float64).astype(np.float32))
