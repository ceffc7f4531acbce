"""Bulk conversion between decimal text such as ``5.600 12.034`` and numbers, without a Python loop per number.

Eight characters are eight bytes of one 64-bit word, so a handful of integer operations on whole arrays of words
turns text into numbers ("SIMD within a register"). It covers plain numbers of one common count of decimals, up to
eight characters long; everything else is reported as not done and left to the slow general way.
"""

import numpy as np
from numpy.typing import NDArray

from ..arrays import WIDE, Ints

Bytes = NDArray[np.uint8]

_U = np.uint64
_ZEROS = _U(0x3030303030303030)
_DOT = 0x2E ^ 0x30
_LONGEST = 8
"""Characters in one word."""


def decode_fixed_point(text: Bytes, ends: Ints, begins: Ints, decimals: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Decode the tokens text[begins:ends], each written as digits, a dot and `decimals` digits.

    Parameters
    ----------
    text : (bytes,) the text; its length must be a multiple of 8 and at least 8 bytes must precede every end.
    ends : (k, n) index just behind each token.
    begins : (k, n) index of each token's first character.
    decimals : digits behind the dot, 1..6.

    Returns
    -------
    values : (k, n) the numbers, in the unit of the text.
    plain : (k,) whether every token of the row has that form; the values of other rows mean nothing.
    """
    length = ends - begins
    plain = (length >= decimals + 2) & (length <= _LONGEST)
    np.clip(length, 1, _LONGEST, out=length)
    word = _words_before(text, ends)
    blank = ((_LONGEST - length) << 3).astype(_U)
    word ^= _ZEROS
    word >>= blank
    word <<= blank
    dot_byte = _U(8 * (7 - decimals))
    plain &= ((word >> dot_byte) & _U(0xFF)) == _U(_DOT)
    below = (_U(1) << dot_byte) - _U(1)
    whole = (word & below) << _U(8)
    word &= ~((below << _U(8)) | _U(0xFF))
    word |= whole
    over_nine = ((word + _U(0x7676767676767676)) | word) & _U(0x8080808080808080)
    plain &= over_nine == 0
    values = _eight_digits(word) / 10.0**decimals
    return values.astype(np.float32), np.asarray(plain.all(axis=-1))


def decode_equal_widths(
    text: Bytes, begins: Ints, count: int, width: int, decimals: int
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Decode rows of numbers that all have the same width, such as ``0.123 4.567 8.900``: several times faster yet.

    Parameters
    ----------
    begins : (k,) index of each row's first character.
    count : numbers in a row.
    width : characters of each number; one blank stands between numbers and behind the last.
    decimals : digits behind the dot, 1..6.

    Returns
    -------
    values : (k, count) the numbers, in the unit of the text.
    plain : (k,) whether every number of the row has that form; the values of other rows mean nothing.
    """
    span = count * (width + 1)
    characters = np.empty((len(begins), count, width + 1), dtype=np.uint8)
    for row, begin in zip(characters, begins.tolist(), strict=True):
        row.reshape(-1)[:] = text[begin : begin + span]
    characters ^= 0x30
    dot = width - decimals - 1
    plain = (characters[:, :, dot] == _DOT).all(axis=1) & (characters[:, :, width] ^ 0x30 <= 0x20).all(axis=1)
    total = np.zeros(characters.shape[:2], dtype=np.uint32)
    for column in (c for c in range(width) if c != dot):
        digit = characters[:, :, column]
        plain &= digit.max(axis=1) <= 9
        total *= 10
        total += digit
    return (total / 10.0**decimals).astype(np.float32), plain


def _words_before(text: Bytes, ends: Ints) -> NDArray[np.uint64]:
    """Return the eight bytes before each end as little-endian words, first character lowest."""
    words = text.view("<u8")
    start = ends - 8
    index = start >> 3
    shift = ((start & 7) << 3).astype(_U)
    high = words[np.minimum(index + 1, len(words) - 1)]
    # Two shifts, because a shift by 64 (aligned token) is undefined.
    return (words[index] >> shift) | ((high << _U(1)) << (_U(63) - shift))


def _eight_digits(word: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return the value of eight digits 0..9, one per byte, first digit in the lowest byte; works in place."""
    for factor, shift, keep in (
        (10 * 2**8 + 1, 8, 0x00FF00FF00FF00FF),
        (100 * 2**16 + 1, 16, 0x0000FFFF0000FFFF),
        (10000 * 2**32 + 1, 32, 0x00000000FFFFFFFF),
    ):
        word *= _U(factor)
        word >>= _U(shift)
        word &= _U(keep)
    return word


def encode_fixed_point(values: NDArray[np.float32], decimals: int = 3) -> list[bytes]:
    """Write rows of numbers as text with single blanks between them.

    Parameters
    ----------
    values : (k, n) numbers in [0, 1e6), finite.
    decimals : digits behind the dot, 1..3.

    Returns
    -------
    k lines of text without line end.
    """
    if values.size == 0:
        return [b""] * len(values)
    scaled = np.rint(values.astype(np.float64) * 10**decimals).astype(WIDE)
    digits = max(len(str(int(scaled.max()))), decimals + 1)
    text = np.zeros((*values.shape, digits + 2), dtype=np.uint8)
    text[..., -1] = 0x20
    dot = digits - decimals
    text[..., dot] = 0x2E
    left = scaled
    for place in range(digits):
        column = digits - 1 - place
        left, digit = np.divmod(left, 10)
        # Leading zeros stay NUL and are dropped below.
        shown = digit + 0x30 if place <= decimals else np.where(scaled >= 10**place, digit + 0x30, 0)
        text[..., column + (column >= dot)] = shown
    return [row.tobytes().translate(None, b"\0").rstrip() for row in text]
