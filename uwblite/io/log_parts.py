"""The files of a recording that was cut into parts of bounded size (``run.log``, ``run.2.log`` ...), whole or as they grow.

The head of each part says which one it continues, and its end which one follows.
"""

import errno
import gzip
import os
import re
import stat
import zlib
from collections.abc import Sequence
from contextlib import suppress
from io import FileIO
from pathlib import Path

from ..errors import FormatError

HEAD_BYTES = 1 << 16
"""Bytes at the beginning of a log among which its PARAM lines stand, and what it continues."""
TAIL_BYTES = 4 << 20
"""Bytes at the end of a long log with which following begins: about a minute of a robot with a lidar."""
_PIECE = 1 << 17
"""Bytes read at once."""
_NEXT_PART = re.compile(rb"^COMMENT continued in ([^\n]+)\n", re.MULTILINE)
"""What the recorder writes at the end of a part, before the name of the next."""
_MARK_BYTES = 1024


def parts_of(path: str) -> tuple[list[str], str]:
    """Return the files of the recording that a file is part of, in order, and the name of a part that is missing, or ""."""
    if not os.path.isfile(path):
        return [path], ""
    packed = path.endswith(".gz")
    root, ending = os.path.splitext(path.removesuffix(".gz"))
    if ending[1:].isdigit():
        root, ending = root + ending, ""
    number, before_it = _continues(path)
    if number > 1 and not root.endswith(f".{number}"):
        return [path], before_it  # it was renamed: where the others are is not known
    root = root.removesuffix(f".{number}") if number > 1 else root

    def name(part: int) -> str:
        return f"{root}{ending}" if part == 1 else f"{root}.{part}{ending}"

    def find(part: int) -> str:
        """Return the file of a part, packed or not, "" where there is none."""
        names = (name(part) + ".gz", name(part)) if packed else (name(part), name(part) + ".gz")
        return next((n for n in names if os.path.isfile(n) and _continues(n)[0] == part), "")

    parts, first, last = [path], number, number
    while first > 1 and (before := find(first - 1)):
        parts, first = [before, *parts], first - 1
    while after := find(last + 1):
        parts, last = [*parts, after], last + 1
    absent = name(first - 1) if first > 1 else name(last + 1) if _goes_on(parts[-1]) else ""
    return parts, os.path.basename(absent)


def each_once(paths: Sequence[str]) -> list[str]:
    """Return the recordings that files are or are part of, each once: the first part stands for several that are named."""
    named: dict[str, list[str]] = {}
    for path in paths:
        named.setdefault(parts_of(path)[0][0], []).append(path)
    return [first if len(files) > 1 else files[0] for first, files in named.items()]


def _continues(path: str) -> tuple[int, str]:
    """Return which part of a recording a file is, and the name of the one before it; 1, "" where it does not say."""
    try:
        with (gzip.open if path.endswith(".gz") else open)(path, "rb") as file:
            head = file.read(HEAD_BYTES)
    except (OSError, EOFError, zlib.error):
        return 1, ""
    match = re.search(rb"^COMMENT part (\d{1,6}), continues (\S+)$", head, re.MULTILINE)
    return (int(match[1]), match[2].decode("utf-8", "replace")) if match else (1, "")


def _goes_on(path: str) -> bool:
    """Return whether the last line of a part names a next one; of a packed one that is unknown."""
    try:
        with open(path, "rb") as file:
            file.seek(max(0, os.path.getsize(path) - _MARK_BYTES))
            return re.search(rb"^COMMENT continued in \S+\s*\Z", file.read(), re.MULTILINE) is not None
    except OSError:
        return False


def _open(path: Path) -> FileIO:
    """Open a regular file, or raise OSError."""
    return open(path, "rb", buffering=0, opener=_regular)


def _regular(path: str, flags: int) -> int:
    """Open a file without waiting: a pipe would hold the opening until somebody writes into it."""
    handle = os.open(path, flags | getattr(os, "O_NONBLOCK", 0))
    if stat.S_ISREG(os.fstat(handle).st_mode):
        return handle
    os.close(handle)
    raise OSError(errno.EINVAL, "it is a pipe, a device or a folder, and only a file can be followed")


class GrowingFile:
    """Follow a regular file and its next parts from the head; what it holds already whole, or from near its end.

    A file that became shorter, or that another has taken the place of, is read from its beginning.
    """

    def __init__(self, path: str, *, whole: bool = False) -> None:
        self.path = Path(path)
        self.restarts = 0
        """How often the file was begun again."""
        try:
            self._file = _open(self.path)
            self._first, self._begun = self.path, os.fstat(self._file.fileno())
        except OSError as error:
            raise FormatError(f"cannot be followed: {error.strerror or error}", path) from None
        self.skipped = 0 if whole else max(self._begun.st_size - HEAD_BYTES - TAIL_BYTES, 0)
        """Bytes between head and tail that are not read."""
        self._head_left = HEAD_BYTES if self.skipped else 0
        self._end = b""

    def read(self) -> bytes:
        """Return new bytes, at most one piece; b"" where there are none."""
        if self._head_left:
            data = self._file.read(self._head_left)
            self._head_left = 0
            self._file.seek(self.skipped + HEAD_BYTES)
            # What was measured then is not wanted; the line into which the jump leads becomes a comment.
            kept = [line for line in data.split(b"\n")[:-1] if line.startswith(b"PARAM ")]
            return b"\n".join([*kept, b"# "])
        if os.fstat(self._file.fileno()).st_size < self._file.tell():
            self._file.seek(0)
            self.restarts += 1
            self._end = b""
        data = self._file.read(_PIECE) or self._successor() or self._next_part()
        self._end = (self._end + data)[-_MARK_BYTES:]
        return data

    def _successor(self) -> bytes:
        """Return the beginning of another file in the place of this one, or of the first part; b"" where there is none."""
        for path, known in ((self.path, os.fstat(self._file.fileno())), (self._first, self._begun)):
            with suppress(OSError):
                if not os.path.samestat(os.stat(path), known):
                    other = _open(path)
                    self._file.close()
                    self.path, self._file, self._end = path, other, b""
                    self._first, self._begun = path, os.fstat(other.fileno())
                    self.restarts += 1
                    return self._file.read(_PIECE)
        return b""

    def _next_part(self) -> bytes:
        """Return the beginning of the part beside this one that this one names as the next; b"" where there is none."""
        named = _NEXT_PART.findall(self._end)
        following = self.path.with_name(os.path.basename(named[-1].decode("utf-8", "replace").strip())) if named else None
        if following is None or not following.is_file():
            return b""
        try:
            part = _open(following)
        except OSError:
            return b""
        self._file.close()
        self.path, self._end, self._file = following, b"", part
        return self._file.read(_PIECE)

    def close(self) -> None:
        """Let it go."""
        self._file.close()
