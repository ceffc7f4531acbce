"""Reading text files of any size and any manners: plain or gzip, from a path or standard input, in blocks of lines."""

import gzip
import hashlib
import io
import math
import os
import select
import stat
import sys
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import BinaryIO

import numpy as np

from ..arrays import Floats
from ..errors import FormatError

BLOCK_BYTES = 1 << 18
"""Bytes decoded at a time: arrays of this size stay in a processor's second-level cache."""
MAX_LINE_BYTES = 1 << 20
"""A longer line is not read into memory."""
OVERLONG_LINE = b"\xfe"
"""Stands in a block in place of a line longer than MAX_LINE_BYTES."""

_BOMB_BYTES, _BOMB_RATIO = 1 << 24, 100
"""A recording packs to a tenth. What unpacks to a hundred times its size, and to more than so many bytes, is made to fill
the memory."""

_PIPE_PATIENCE = 10.0
"""s to wait until data are written into a named pipe."""

_GZIP = b"\x1f\x8b"
_OTHER_FORMATS = (
    (b"#ROSBAG", "this is a ROS 1 bag, not text; bags are read from files, and not through a pipe"),
    (b"\x89MCAP", "this is an MCAP bag, not text; bags are read from files, and not through a pipe"),
    (b"SQLite format 3", "this is an SQLite file (ROS 2 bag?), not text; bags are read from files, and not through a pipe"),
    (b"PK\x03\x04", "this is a zip archive; unpack it first"),
    (b"\x28\xb5\x2f\xfd", "this is zstd-compressed; unpack it first (only gzip is read directly)"),
    (b"BZh", "this is bzip2-compressed; unpack it first (only gzip is read directly)"),
    (b"\xfd7zXZ", "this is xz-compressed; unpack it first (only gzip is read directly)"),
    (b"\xff\xfe", "this is UTF-16 text; save it as UTF-8 or plain ASCII"),
)


class _HashingReader(io.RawIOBase):
    """Pass bytes on, hashed."""

    def __init__(self, stream: BinaryIO, digest: "hashlib._Hash | None" = None) -> None:
        self._stream = stream
        self.hash = digest or hashlib.sha256()
        self.count = 0

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        count: int = self._stream.readinto(buffer)  # type: ignore[attr-defined]
        self.hash.update(buffer[:count])
        self.count += count
        return count


class TextSource:
    """An open text file: `blocks()` gives its lines, `sha256()` the hash of the bytes as stored."""

    def __init__(self, stream: BinaryIO, path: str, digest: "hashlib._Hash | None" = None) -> None:
        self.path = path
        self._hashing = _HashingReader(stream, digest)
        self._buffered = io.BufferedReader(self._hashing, BLOCK_BYTES)
        start = self._buffered.peek(16)
        for magic, problem in _OTHER_FORMATS:
            if start.startswith(magic):
                raise FormatError(problem, path)
        packed = start.startswith(_GZIP)
        self._text: BinaryIO = gzip.GzipFile(fileobj=self._buffered) if packed else self._buffered  # type: ignore[assignment]

    def sha256(self) -> str:
        """Read the rest and return the hash of all bytes that it took, hexadecimal."""
        while self._buffered.read(BLOCK_BYTES):
            pass
        return self._hashing.hash.hexdigest()

    def blocks(self, size: int = BLOCK_BYTES) -> Iterator[bytes]:
        """Yield the text in blocks of whole lines, each ending with a newline; OVERLONG_LINE stands for too long ones."""
        carry, overlong, first, unpacked = b"", False, True, 0
        while data := self._text.read(size):
            unpacked += len(data)
            if unpacked > _BOMB_BYTES and unpacked > _BOMB_RATIO * self._hashing.count:
                problem = f"unpacks to more than {_BOMB_RATIO} times its size: nothing that was measured does"
                raise FormatError(problem, self.path)
            if first and b"\0" in data[:4096]:
                raise FormatError("this is binary data, not a text file", self.path)
            if first and b"\r" in data and b"\n" not in data:
                raise FormatError("its lines end in CR alone; tr '\\r' '\\n' makes lines of them", self.path)
            data, first = data.removeprefix(b"\xef\xbb\xbf") if first else data, False
            if overlong:
                cut = data.find(b"\n")
                if cut < 0:
                    continue
                data, overlong = OVERLONG_LINE + data[cut:], False
            cut = data.rfind(b"\n") + 1
            if cut:
                yield b"".join((carry, memoryview(data)[:cut]))
            carry = data[cut:] if cut else carry + data
            if len(carry) > MAX_LINE_BYTES:
                carry, overlong = b"", True
        if first:
            raise FormatError("the file is empty", self.path)
        if overlong:
            carry = OVERLONG_LINE
        if carry:
            yield carry + b"\n"

    def rows(self) -> Iterator[list[tuple[int, list[bytes]]]]:
        """Yield line number and words of the lines that are neither blank nor a comment (#), a block of lines at a time."""
        read = 0
        for block in self.blocks():
            lines = block.split(b"\n")[:-1]
            rows = ((number, line.split()) for number, line in enumerate(lines, read + 1))
            yield [(number, words) for number, words in rows if words and not words[0].startswith(b"#")]
            read += len(lines)


@contextmanager
def open_source(path: str | os.PathLike[str], digest: "hashlib._Hash | None" = None) -> Iterator[TextSource]:
    """Open a text file, gzip or not (by its content), or standard input for ``-``; raise FormatError where it cannot be read.

    Parameters
    ----------
    digest : takes the bytes as stored, where several files are hashed together.
    """
    name = os.fspath(path)
    with opened(name) as stream:
        try:
            yield TextSource(stream, "stdin" if name == "-" else name, digest)
        except EOFError:
            raise FormatError("the gzip data is cut off; copy the file again, or save what zcat can read", name) from None
        except (gzip.BadGzipFile, zlib.error) as error:
            raise FormatError(f"the gzip data is damaged ({error}); copy it again, or save what zcat can read", name) from None


@contextmanager
def opened(name: str) -> Iterator[BinaryIO]:
    """Open a file, a pipe or standard input (``-``), which is not closed; raise FormatError where it cannot be read."""
    stream = open_input(name)
    try:
        yield stream
    except OSError as error:
        raise FormatError(f"cannot be read: {error.strerror or error}", name) from None
    finally:
        if name != "-":
            stream.close()


def open_input(name: str) -> BinaryIO:
    """Open a file, a pipe or standard input (``-``) for reading; raise FormatError where nothing can be read."""
    if name == "-":
        if sys.stdin is None or getattr(sys.stdin, "closed", False):
            raise FormatError("standard input is closed; name a file, or send one through a pipe", "stdin")
        return sys.stdin.buffer
    try:
        # A pipe without a writer would hold the opening for ever.
        handle = os.open(name, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise FormatError(f"cannot be opened: {reason}", name) from None
    if stat.S_ISFIFO(os.fstat(handle).st_mode) and not select.select([handle], [], [], _PIPE_PATIENCE)[0]:
        os.close(handle)
        raise FormatError(f"is a pipe, and nobody wrote into it for {_PIPE_PATIENCE:.0f} s", name)
    if hasattr(os, "set_blocking"):
        os.set_blocking(handle, True)
    try:
        return os.fdopen(handle, "rb")
    except OSError as error:  # a folder
        os.close(handle)
        raise FormatError(f"cannot be opened: {error.strerror}", name) from None


def read_bounded(name: str, most: int) -> bytes:
    """Return the bytes of a small file; raise FormatError where it cannot be read, or holds more than `most`."""
    with opened(name) as stream:
        data = stream.read(most + 1)
    if len(data) > most:
        size = f"{most / 1e6:.0f} MB" if most >= 1e6 else f"{most / 1e3:.0f} kB"
        raise FormatError(f"is larger than {size}, far too large for what it should be", name)
    return data


def finite(text: str | bytes, fault: str, path: str, line: int | None = None) -> float:
    """Return the number that a text is; raise FormatError with the words of `fault` where it is none or not finite."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise FormatError(fault, path, line)
    return value


def number_table(rows: Sequence[tuple[int, Sequence[bytes]]], path: str) -> Floats:
    """Return the words of rows, equally many in each behind its line, as finite numbers (n, words) that can be squared."""
    try:
        table = np.array([words for _, words in rows], dtype=np.float64).reshape(len(rows), -1)
    except ValueError:
        for line, words in rows:
            for word in words:
                finite(word, f"{word[:30]!r} is not a number", path, line)
        raise FormatError("a number cannot be read", path, rows[0][0]) from None
    bad = np.flatnonzero(~(np.abs(table) < 1e100).all(axis=1))
    if len(bad):
        raise FormatError("a number is not finite", path, rows[bad[0]][0])
    return table


_LARGEST_SETTINGS = 1 << 20
"""Bytes of a file that a user writes by hand."""


def read_settings(name: str) -> str:
    """Return the text of a small file that a user writes: settings, mappings, constraints."""
    try:
        return read_bounded(name, _LARGEST_SETTINGS).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise FormatError("not a text file (UTF-8)", name) from None
