"""The files of a recording that was cut into parts of bounded size: ``run.log``, ``run.2.log``, ``run.3.log`` ...

`uwblite record --rotate` writes into the head of each part which one it continues. Whoever names one of them means the
recording.
"""

import gzip
import os
import re
import zlib
from collections.abc import Sequence

HEAD_BYTES = 1 << 16
"""Bytes at the beginning of a part among which the comment stands."""
TAIL_BYTES = 1024


def parts_of(path: str) -> tuple[list[str], str]:
    """Return the files of the recording that a file is part of.

    Returns
    -------
    parts : in order; `path` alone where it is no part.
    missing : name of a part that should be there and is not, or "".
    """
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
    found = re.search(rb"^COMMENT part (\d{1,6}), continues (\S+)$", head, re.MULTILINE)
    return (int(found[1]), found[2].decode("utf-8", "replace")) if found else (1, "")


def _goes_on(path: str) -> bool:
    """Return whether the last line of a part names a next one; of a packed one that is unknown."""
    try:
        with open(path, "rb") as file:
            file.seek(max(0, os.path.getsize(path) - TAIL_BYTES))
            return re.search(rb"^COMMENT continued in \S+\s*\Z", file.read(), re.MULTILINE) is not None
    except OSError:
        return False
