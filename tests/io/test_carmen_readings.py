import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from uwblite.io.carmen_laser import Block, Pending, decode_equal_widths


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


WORD = st.text("0123456789.+-ex", min_size=1, max_size=9).map(str.encode)


@given(st.lists(st.one_of(WORD, st.floats(0, 99, width=16).map(lambda v: b"%.2f" % v)), min_size=1, max_size=6))
def test_readings_are_what_float_reads_or_the_line_is_broken(words):
    block = Block.of(b"A 2 " + b" ".join(words) + b" 0\n")
    (values,), (error,) = block.decode_rows(len(words), [Pending(1, 2, 0.0)])
    try:
        wanted = np.clip(np.array(words, np.float64), -1.0, 1e30).astype(np.float32)
    except ValueError:
        assert error is not None
    else:
        assert error is None
        np.testing.assert_array_equal(values, wanted)
