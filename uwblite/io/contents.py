"""Which format a file is of, by its content: names of files of others tell little."""

import gzip
import os
import re
import zlib

from .carmen_words import is_message_name

_BAGS = (b"#ROSBAG", b"\x89MCAP", b"SQLite format 3\0")
_RAWLOGS = (b"CObservation", b"CSensoryFrame", b"CActionCollection")
"""Names of the classes that a binary rawlog of MRPT begins with."""
_GZIP = b"\x1f\x8b"
_BYTES = 1 << 16
"""At the beginning, by which a text is told; scans before the first word of another kind are shorter."""
_GRAPH = re.compile(rb"(VERTEX|EDGE)(2|3|_[A-Z0-9_:]+)$|EDGE_RANGE$|FIX$")
_ISAM = {b"ODOMETRY", b"LANDMARK"}
_LIBRSF = {b"range2", b"odom2diff", b"odom2", b"point2", b"gt2", b"range3", b"odom3"}
_CARMEN = {b"ODOM", b"FLASER", b"PARAM", b"ROBOTLASER1", b"RAWLASER1", b"RLASER", b"UWB", b"SYNC"}
_NAME_OF_PYFG = re.compile(rb"[A-Za-z]\d+$")
_COLUMNS_OF_TUM = 8
_OTHERS = {b"LASER_READING": "gfs", b"LaserOdometryLog": "aria", b"@SENS": "rhino", b"LASER-RANGE": "rhino"}
"""First words of lines that only a log of another program has."""
_PLAYER = b"## Player version"
_LINES = 20
"""By which a table of numbers is told."""


def format_of_content(path: str) -> str:
    """Return the format of a file: 'bag', 'log', 'g2o', 'pyfg', 'isam', 'librsf', 'tum', 'numbers' (a table without names), or
    'rawlog', 'player', 'gfs', 'aria', 'rhino', which are not read.

    '' of what is none of them, or cannot be read. TORO files are 'g2o', whose reader takes them.
    """
    start = _beginning(path)
    if start.startswith(_BAGS):
        return "bag"
    if any(name in start[:200] for name in _RAWLOGS):
        return "rawlog"
    if start.startswith(_PLAYER):
        return "player"
    lines = [line.split() for line in start.removeprefix(b"\xef\xbb\xbf").split(b"\n")[:-1]]
    lines = [words for words in lines if words and not words[0].startswith(b"#")]
    names = {words[0] for words in lines}
    if any(_GRAPH.match(name) for name in names):
        named = (words for words in lines if _GRAPH.match(words[0]))
        return "pyfg" if any(_NAME_OF_PYFG.match(word) for words in named for word in words[1:4]) else "g2o"
    if foreign := names & set(_OTHERS):
        return _OTHERS[min(foreign)]
    if names & _CARMEN:
        return "log"
    if names & _ISAM:
        return "isam"
    if names & _LIBRSF:
        return "librsf"
    if lines and all(_is_number(word) for words in lines[:_LINES] for word in words):
        return "tum" if all(len(words) == _COLUMNS_OF_TUM for words in lines) else "numbers"
    return "log" if names and all(is_message_name(name) for name in names) else ""


def _is_number(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _beginning(path: str) -> bytes:
    """Return the first bytes of a file, unpacked; b'' where it cannot be read. Pipes are not touched."""
    if not os.path.isfile(path):
        return b""
    try:
        with open(path, "rb") as stream:
            start = stream.read(_BYTES)
            if not start.startswith(_GZIP):
                return start
            stream.seek(0)
            with gzip.open(stream) as unpacked:
                return unpacked.read(_BYTES)
    except (OSError, EOFError, zlib.error):
        return b""
