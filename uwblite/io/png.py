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
MOST_PIXELS = 40_000_000
"""Largest picture read: the largest grid that the mapper makes by itself. Decoding takes about three bytes a pixel."""


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
    """Return the image (height, width, channels) of a PNG with 8 bits per channel, no palette, not interlaced."""
    height, width, channels = png_shape(data, path)
    size = height * (1 + width * channels)
    try:
        packed = b"".join(content for kind, content in _chunks(data, path) if kind == b"IDAT")
        raw = zlib.decompressobj().decompress(packed, size)
    except zlib.error:
        raise FormatError("the PNG's pixels are damaged", path) from None
    if len(raw) != size:
        raise FormatError("the PNG is cut off", path)
    return _unfiltered(np.frombuffer(raw, dtype=np.uint8).reshape(height, -1), channels, path)


def png_shape(data: bytes, path: str) -> tuple[int, int, int]:
    """Return height, width and channels from the beginning of a PNG; raise FormatError for a kind not read here."""
    if not data.startswith(SIGNATURE):
        raise FormatError("this is not a PNG picture", path)
    if len(data) < _HEADER.size or data[12:16] != b"IHDR":
        raise FormatError("the PNG has no header", path)
    *_, width, height, depth, colour, _, _, interlaced = _HEADER.unpack_from(data)
    if depth != 8 or colour not in _CHANNELS or interlaced:
        raise FormatError("only PNG with 8 bits per channel, without palette and interlacing, is read", path)
    if not 0 < width * height <= MOST_PIXELS:
        most = f"at most {MOST_PIXELS / 1e6:.0f} million pixels"
        raise FormatError(f"a PNG of {width} x {height} pixels is not read ({most})", path)
    return height, width, _CHANNELS[colour]


_HEADER = struct.Struct(">8sI4sIIBBBBB")
"""Signature, length and name of the first chunk, width, height, depth, colour, compression, filter, interlacing."""


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
    kinds, lines = rows[:, 0], rows[:, 1:].reshape(height, width, channels)
    unknown = np.flatnonzero(kinds > 4)
    if len(unknown):
        raise FormatError(f"the PNG's row {unknown[0]} names an unknown filter", path)
    return _by_diagonals(kinds, lines) if kinds.any() else lines


def _by_diagonals(kinds: Image, lines: Image) -> Image:
    """Undo the filters of rows.

    A pixel needs its left, upper and upper left neighbours, so that all pixels of an anti-diagonal, row + column = d, can
    be decoded at once. In a flat array of rows of P pixels these lie P - 1 apart.
    """
    height, width, channels = lines.shape
    pitch = width + 1
    padded = np.zeros((height + 1, pitch, channels), dtype=np.uint8)
    padded[1:, 1:] = lines
    flat = padded.reshape(-1, channels)
    for d in range(2, height + width + 1):
        first, last = max(1, d - width), min(height, d - 1)
        here = first * pitch + (d - first)
        count = last - first + 1

        def neighbours(back: int, here: int = here, count: int = count) -> NDArray[np.int16]:
            start = here - back
            return flat[start : start + (count - 1) * (pitch - 1) + 1 : pitch - 1].astype(np.int16)

        kind = kinds[first - 1 : last, None]
        guess = _guess(kind, neighbours(1), neighbours(pitch), neighbours(pitch + 1))
        flat[here : here + (count - 1) * (pitch - 1) + 1 : pitch - 1] += guess.astype(np.uint8)
    return padded[1:, 1:]


def _guess(kind: Image, left: NDArray[np.int16], up: NDArray[np.int16], corner: NDArray[np.int16]) -> NDArray[np.int16]:
    """Return what the filter of each pixel's row (n, 1) adds to it (n, channels)."""
    by_left, by_up = np.abs(up - corner), np.abs(left - corner)
    by_corner = np.abs(left + up - 2 * corner)
    paeth = np.where((by_left <= by_up) & (by_left <= by_corner), left, np.where(by_up <= by_corner, up, corner))
    return np.choose(kind, [np.zeros_like(left), left, up, (left + up) >> 1, paeth])
