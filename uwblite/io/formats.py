"""Which format a file is of, by its content first: names of files of others tell little; and who reads and writes it."""

import gzip
import os
import re
import zlib
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..errors import ConfigError, FormatError
from .carmen_words import is_message_name

if TYPE_CHECKING:
    from ..sensor_log import SensorLog
    from .bag_topics import BagTopics
    from .graph_file import GraphFile
    from .uwb_mapping import UwbMapping

    BagChoices = tuple[BagTopics, tuple[UwbMapping, ...]]

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
_FOREIGN_WORDS = {b"LASER_READING": "gfs", b"LaserOdometryLog": "aria", b"@SENS": "rhino", b"LASER-RANGE": "rhino"}
"""First words of lines that only a log of another program has."""
_PLAYER = b"## Player version"
_LINES = 20
"""By which a table of numbers is told."""


def format_of_content(path: str) -> str:
    """Return the format of a file: 'bag', 'log', 'g2o' (TORO too), 'pyfg', 'isam', 'librsf', 'tum', 'numbers' (a table without
    names), 'rawlog', 'player', 'gfs', 'aria', 'rhino', which are not read, or '' of what is none of them, or cannot be read."""
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
    if foreign := names & set(_FOREIGN_WORDS):
        return _FOREIGN_WORDS[min(foreign)]
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


GRAPHS = {".g2o": "g2o", ".graph": "g2o", ".toro": "g2o", ".pyfg": "pyfg"}
"""TORO files differ from g2o by their tags."""
LOGS = {".log": "log", ".clf": "log", ".bag": "bag", ".mcap": "bag", ".db3": "bag"}
TRAJECTORIES = {".tum": "tum", ".kitti": "kitti"}


def format_of(path: str) -> str:
    """Return 'csv', 'map' (a result), 'kitti' or a format that format_of_content knows; '' where nothing shows one.

    A name tells where it ends like one of the format; what it does not tell, and whether it is a bag, the content does.
    """
    if os.path.isdir(path):
        if os.path.exists(os.path.join(path, "trajectory.tum")):
            return "map"
        if os.path.exists(os.path.join(path, "odometry.csv")):
            return "csv"
        held = os.listdir(path)
        return "bag" if any(n == "metadata.yaml" or n.removesuffix(".zstd").endswith(_PARTS) for n in held) else ""
    named, content = format_of_name(path), format_of_content(path)
    if content and (content == "bag" or not named or {content, named} <= _GRAPH_TEXTS):
        return content
    return named


_PARTS = (".mcap", ".db3")
"""Endings of the files of a ROS 2 bag's folder."""
_GRAPH_TEXTS = {"g2o", "pyfg", "isam"}
"""Names of graph files are mixed up: .graph is TORO's and iSAM's, .g2o is what many call any of them."""


def format_of_name(path: str) -> str:
    """Return the format that a name shows, '' where it shows none."""
    ending = os.path.splitext(path.removesuffix(".gz"))[1].lower()
    return "log" if path == "-" else "csv" if path.endswith(os.sep) else (GRAPHS | LOGS | TRAJECTORIES).get(ending, "")


def read_recording(path: str, every_nth_scan: int = 1, bag: "BagChoices | None" = None) -> "SensorLog":
    """Read a recording of any kind: a CARMEN log, a ROS bag or a folder of CSV files; of its scans every n-th.

    Parameters
    ----------
    path : the file or folder; - is standard input.
    bag : topics and mappings of a bag, of a log the message of the scans, as `options.bag_choices` returns them.

    Raises
    ------
    ConfigError : topics or mappings are named for what is no bag.
    FormatError : a folder is neither tables nor a bag, or a file is not what it should be.
    """
    kind = format_of(path)
    scan_message = bag[0].scan if bag is not None and kind not in ("bag", "csv") else ""
    if bag is not None and kind != "bag" and (bag[1] or bag[0] != type(bag[0])(scan=scan_message)):
        raise ConfigError(f"{path} is no ROS bag: `mappings` and the topics are for bags")
    if kind == "csv":
        from .csv_folder import read_csv_folder

        return _thin_scans(read_csv_folder(path), every_nth_scan)
    if kind == "bag":
        from .rosbag import read_bag

        return _thin_scans(read_bag(path, *(bag or ())), every_nth_scan)
    if os.path.isdir(path):
        what = "holds a map, and a recording is wanted" if kind == "map" else "holds no odometry.csv and no ROS 2 bag"
        raise FormatError(f"this folder {what}", path)
    if kind == "librsf":
        from .librsf import read_librsf

        return read_librsf(path)
    if kind in _NO_RECORDING:
        raise FormatError(_NO_RECORDING[kind], path)
    from .carmen import read_log

    try:
        return read_log(path, every_nth_scan=every_nth_scan, scan_message=scan_message)
    except FormatError as error:
        content = format_of_content(path)
        what = _GRAPH_ALONE if content in ("g2o", "pyfg") else _NO_RECORDING.get(content, "")
        raise FormatError(what, path) if what else error from None


_GRAPH_ALONE = "is a pose graph without scans (ROBOTLASER1), no recording: pose graphs are for uwblite optimize"
_TABLES = (
    "a folder of tables is read, with odometry.csv (stamp,x,y,theta; m, rad; poses, not steps), scans.csv and ranges.csv"
    " (docs/formats.md)"
)
_NO_RECORDING = {
    "isam": "is a pose graph of iSAM, no recording: uwblite optimize says how to write it",
    "tum": "is a trajectory, no recording: uwblite convert makes a folder of it (FILE.tum FOLDER/ `to=csv`), to which"
    " ranges.csv (stamp,anchor,range,quality) and scans.csv may be added; uwblite evaluate compares with it",
    "kitti": "is a trajectory without times, no recording",
    "rawlog": f"is a binary rawlog of MRPT, which is not read: rawlog-edit exports odometry and scans as text; {_TABLES}",
    "numbers": f"is a table of numbers without names, as MRPT exports its rawlogs: {_TABLES}",
    "player": f"is a log of Player (writelog), no CARMEN log: its position2d and laser lines hold what is needed; {_TABLES}",
    "gfs": "is a trace of GMapping (.gfs), no CARMEN log: take the log that GMapping was given, or what gfs2log makes of it",
    "rhino": f"is a log of RHINO or Beesoft, in centimetres and degrees, no CARMEN log; {_TABLES}",
    "aria": f"is a laser log of ARIA (.2d), in millimetres and degrees, no CARMEN log; {_TABLES}",
}
"""What is no recording, and the verb that takes it."""


def _thin_scans(log: "SensorLog", n: int) -> "SensorLog":
    return log if log.scans is None or n == 1 else replace(log, scans=log.scans.rows(np.arange(0, len(log.scans.stamps), n)))


def graph_format(path: str) -> str:
    """Return 'g2o' or 'pyfg' for the name of a graph to be written."""
    kind = format_of_name(path)
    if kind not in ("g2o", "pyfg"):
        raise ConfigError(f"{path}: the name must end in .g2o or .pyfg (or .gz behind that) to show the format")
    return kind


def read_graph(path: str, *, from_odometry: bool = False) -> "GraphFile":
    """Read a pose graph of any known format, told by its content; standard input is g2o."""
    from .g2o import read_g2o
    from .pyfg import read_pyfg

    kind = "g2o" if path == "-" else format_of(path)
    if kind == "pyfg":
        return read_pyfg(path, from_odometry=from_odometry)
    if kind in ("bag", "log", "csv", "librsf"):
        raise FormatError("is a recording, no pose graph: uwblite map makes a map of it, with graph.g2o", path)
    if kind in ("tum", "kitti"):
        raise FormatError("is a trajectory, no pose graph", path)
    if kind == "map":
        raise FormatError(f"is a result; its pose graph is {os.path.join(path, 'graph.g2o')}", path)
    return read_g2o(path, from_odometry=from_odometry)


def write_graph(path: str, file: "GraphFile") -> None:
    """Write a pose graph in the format of its name; g2o files get their ranges too."""
    from .g2o import write_g2o
    from .pyfg import write_pyfg

    if graph_format(path) == "pyfg":
        write_pyfg(path, file.graph, file.anchor_ids, file.stamps, pose_ids=file.pose_ids)
    else:
        write_g2o(path, file.graph, file.anchor_ids, pose_ids=file.pose_ids, ranges=True)


def refuse_existing(force: bool, *paths: str | None) -> None:
    """Refuse to replace what is there, unless forced."""
    for path in paths:
        if path and os.path.exists(path) and not force and os.path.isfile(path):
            raise ConfigError(f"{path} exists; use `force` to replace it, or another name")
