"""PNG pictures of 8-bit grey, grey + alpha, RGB and RGBA, written and read with nothing but zlib."""

import os
import struct
import zlib
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError
from .files import write_bytes

Image = NDArray[np.uint8]

SIGNATURE = b"\x89PNG\r\n\x1a\n"
_COLOUR_TYPE = {1: 0, 2: 4, 3: 2, 4: 6}
"""PNG's colour type by number of channels."""
_CHANNELS = {colour: channels for channels, colour in _COLOUR_TYPE.items()}
_MOST_PIXELS = 1 << 28


def encode_png(image: Image) -> bytes:
    """Return an image as PNG; equal images give equal bytes.

    Parameters
    ----------
    image : (height, width) grey, or (height, width, c) with c = 1 grey, 2 grey + alpha, 3 RGB, 4 RGBA; row 0 on top.
    """
    pixels = image[:, :, None] if image.ndim == 2 else image
    height, width, channels = pixels.shape
    # Each row begins with the number of its filter; 0 = none, best for drawings with few colours.
    rows = np.zeros((height, 1 + width * channels), dtype=np.uint8)
    rows[:, 1:] = pixels.reshape(height, -1)
    header = struct.pack(">IIBBBBB", width, height, 8, _COLOUR_TYPE[channels], 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(rows.tobytes(), 6)), (b"IEND", b""))
    return SIGNATURE + b"".join(_chunk(kind, data) for kind, data in chunks)


def write_png(path: str | os.PathLike[str], image: Image) -> None:
    """Write an image (see encode_png); the previous file stays whole until the new one is complete."""
    write_bytes(path, encode_png(image))


def decode_png(data: bytes, path: str = "") -> Image:
    """Return the image (height, width, channels) of a PNG with 8 bits per channel, no palette, not interlaced.

    Raises
    ------
    FormatError : the data is damaged or of a kind not read here.
    """
    if not data.startswith(SIGNATURE):
        raise FormatError("this is not a PNG picture", path)
    header, packed = b"", []
    for kind, content in _chunks(data, path):
        if kind == b"IHDR":
            header = content
        elif kind == b"IDAT":
            packed.append(content)
    if len(header) != 13:
        raise FormatError("the PNG has no header", path)
    width, height, depth, colour, _, _, interlaced = struct.unpack(">IIBBBBB", header)
    if depth != 8 or colour not in _CHANNELS or interlaced:
        raise FormatError("only PNG with 8 bits per channel, without palette and interlacing, is read", path)
    channels = _CHANNELS[colour]
    if not 0 < width * height <= _MOST_PIXELS:
        raise FormatError(f"a PNG of {width} x {height} pixels is not read", path)
    size = height * (1 + width * channels)
    try:
        raw = zlib.decompressobj().decompress(b"".join(packed), size)
    except zlib.error:
        raise FormatError("the PNG's pixels are damaged", path) from None
    if len(raw) != size:
        raise FormatError("the PNG is cut off", path)
    return _unfiltered(np.frombuffer(raw, dtype=np.uint8).reshape(height, -1), channels, path)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _chunks(data: bytes, path: str) -> Iterator[tuple[bytes, bytes]]:
    place = len(SIGNATURE)
    while place + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, place)
        kind, content = data[place + 4 : place + 8], data[place + 8 : place + 8 + length]
        checksum = data[place + 8 + length : place + 12 + length]
        if checksum != struct.pack(">I", zlib.crc32(kind + content)):
            raise FormatError("the PNG is damaged or cut off", path)
        yield kind, content
        place += 12 + length


def _unfiltered(rows: Image, channels: int, path: str) -> Image:
    """Undo the filters that each row names: sums with the left, upper and upper left neighbours (PNG specification 9.2)."""
    height, width = rows.shape[0], (rows.shape[1] - 1) // channels
    image = np.zeros((height, width, channels), dtype=np.uint8)
    above = np.zeros((width, channels), dtype=np.uint8)
    for row in range(height):
        kind, line = int(rows[row, 0]), rows[row, 1:].reshape(width, channels)
        if kind == 1:
            line = np.cumsum(line, axis=0, dtype=np.uint8)
        elif kind == 2:
            line = line + above
        elif kind in (3, 4):
            line = _mixed(line, above, average=kind == 3)
        elif kind:
            raise FormatError(f"the PNG's row {row} names an unknown filter", path)
        image[row] = above = line
    return image


def _mixed(line: Image, above: Image, average: bool) -> Image:
    """Undo the average or the Paeth filter, where each pixel needs the one before."""
    done = line.astype(int).tolist()
    upper = above.astype(int).tolist()
    channels = range(line.shape[1])
    left, corner = [0] * line.shape[1], [0] * line.shape[1]
    for pixel, up in zip(done, upper, strict=True):
        for c in channels:
            a, b, d = left[c], up[c], corner[c]
            if average:
                guess = (a + b) // 2
            else:
                estimate = a + b - d
                guess = min((abs(estimate - a), 0, a), (abs(estimate - b), 1, b), (abs(estimate - d), 2, d))[2]
            pixel[c] = (pixel[c] + guess) & 255
        left, corner = pixel, up
    return np.array(done, dtype=np.uint8).reshape(line.shape)
