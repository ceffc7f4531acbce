import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from uwblite.errors import FormatError
from uwblite.io.png import _chunk, decode_png, encode_png, write_png

IMAGES = st.integers(1, 4).flatmap(
    lambda channels: hnp.arrays(np.uint8, st.tuples(st.integers(1, 9), st.integers(1, 9), st.just(channels)))
)


@given(IMAGES)
def test_what_is_written_is_read(image):
    np.testing.assert_array_equal(decode_png(encode_png(image)), image)


def filtered(image, kinds):
    """Filter each row by the formulas of the PNG specification."""
    height, width, channels = image.shape
    padded = np.zeros((height + 1, width + 1, channels), int)
    padded[1:, 1:] = image
    left, up, corner = padded[1:, :-1], padded[:-1, 1:], padded[:-1, :-1]
    estimate = left + up - corner
    distance = np.abs(np.stack([estimate - left, estimate - up, estimate - corner]))
    paeth = np.choose(distance.argmin(axis=0), [left, up, corner])
    guesses = [0 * left, left, up, (left + up) // 2, paeth]
    guess = np.stack([guesses[kind][row] for row, kind in enumerate(kinds)])
    rows = ((image - guess) % 256).reshape(height, -1).astype(np.uint8)
    return np.concatenate([np.array(kinds, np.uint8)[:, None], rows], axis=1).tobytes()


@given(IMAGES, st.lists(st.integers(0, 4), min_size=9, max_size=9))
def test_all_filters_of_other_writers_are_undone(image, kinds):
    data = encode_png(image)
    header = data[: 8 + 25]
    packed = zlib.compress(filtered(image, kinds[: len(image)]))
    cut = len(packed) // 2
    # Pixels may come in several chunks, with foreign ones between.
    body = _chunk(b"IDAT", packed[:cut]) + _chunk(b"tEXt", b"a\0b") + _chunk(b"IDAT", packed[cut:]) + _chunk(b"IEND", b"")
    np.testing.assert_array_equal(decode_png(header + body), image)


def test_grey_images_need_no_channel_axis(tmp_path):
    image = np.arange(12, dtype=np.uint8).reshape(3, 4)
    write_png(tmp_path / "a.png", image)
    np.testing.assert_array_equal(decode_png((tmp_path / "a.png").read_bytes())[:, :, 0], image)
    assert encode_png(image) == (tmp_path / "a.png").read_bytes()


@given(st.binary(max_size=120), IMAGES, st.data())
def test_broken_pictures_are_refused_and_nothing_else(junk, image, data):
    good = encode_png(image)
    cut = data.draw(st.integers(0, len(good)))
    for bad in (junk, good[:cut], good[:cut] + junk + good[cut + len(junk) :]):
        try:
            decode_png(bad)
        except FormatError:
            continue
        assert len(bad) >= 57


def test_a_small_file_cannot_claim_a_huge_picture():
    header = b"\x00\x01\x00\x00\x00\x01\x00\x00\x08\x06\x00\x00\x00"
    bomb = _chunk(b"IDAT", zlib.compress(bytes(1 << 20)))
    with pytest.raises(FormatError, match="not read"):
        decode_png(b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", header) + bomb)
    small = b"\x00\x00\x00\x02\x00\x00\x00\x02\x08\x00\x00\x00\x00"
    assert decode_png(b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", small) + bomb).shape == (2, 2, 1)
