"""Bytes keep the stamp of the piece they came in, whatever is dropped before them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from uwblite.drivers.framing import FixedPackets, FrameReader, HeadedFrames, PacketReader, StampedBuffer
from uwblite.drivers.text_lines import LineDriver


@given(st.lists(st.one_of(st.binary(max_size=5), st.integers(1, 6)), max_size=30))
def test_every_byte_keeps_its_stamp(steps):
    """Bytes are appended, numbers dropped; a list of single bytes with their stamps does the same."""
    buffer, reference = StampedBuffer(), []
    for stamp, step in enumerate(steps):
        if isinstance(step, int):
            buffer.drop(step)
            reference = reference[step:]
        else:
            buffer.append(step, float(stamp))
            reference += [(byte, float(stamp)) for byte in step]
        assert bytes(buffer.data) == bytes([byte for byte, _ in reference])
        assert [buffer.stamp_at(k) for k in range(len(reference))] == [when for _, when in reference]


def test_nothing_is_left_of_what_was_cleared():
    buffer = StampedBuffer()
    buffer.append(b"old", 1.0)
    buffer.clear()
    buffer.append(b"new", 2.0)
    assert (bytes(buffer.data), buffer.stamp_at(0)) == (b"new", 2.0)


@pytest.mark.parametrize("base", [FrameReader, HeadedFrames, PacketReader, FixedPackets, LineDriver])
def test_a_protocol_that_leaves_something_undefined_cannot_be_made(base):
    """The error names what is missing, when the driver is made and not when the first frame comes."""
    with pytest.raises(TypeError, match=f"abstract class '?{base.__name__}"):
        type("Protocol", (base,), {}).__new__(base)
