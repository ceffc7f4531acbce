"""A bag that is open for reading: ROS 1 or 2, one file or several, closed properly or not.

A message whose definition cannot be read matters only where somebody wants its topic.
"""

import heapq
import os
from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from ..errors import FormatError, UwbliteError
from .bag_records import MCAP, ROS1, SQLITE, UnclosedBag
from .bag_topics import BagTopic
from .optional_packages import missing_package

_KINDS = {ROS1: ".bag", MCAP: ".mcap", SQLITE: ".db3"}
_PACKED = b"\x28\xb5\x2f\xfd"


class OpenBag:
    """Connections, types and messages of a bag."""

    def __init__(self, readers: list[Any], ros1: bool, notes: list[str]) -> None:
        self.readers, self.ros1, self.notes = readers, ros1, notes
        self.connections = [c for reader in readers for c in reader.connections]
        self.unreadable: dict[str, str] = {}
        """Types whose definition cannot be read, and why."""
        self._store = self._with_types()

    def topics(self) -> tuple[BagTopic, ...]:
        """Return the topics by name."""
        found: dict[str, BagTopic] = {}
        for c in self.connections:
            before = found.get(c.topic, BagTopic(c.topic, c.msgtype or "?", 0))
            kind = before.type if before.type == c.msgtype else "?"
            found[c.topic] = BagTopic(c.topic, kind, before.count + c.msgcount)
        return tuple(found[name] for name in sorted(found))

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        """Yield topic, time of recording, ns, and message of every message of some topics, in the order of recording.

        Raises
        ------
        FormatError : the definition of such a message cannot be read.
        """
        parts = []
        for reader in self.readers:
            wanted = [c for c in reader.connections if c.topic in topics]
            for c in wanted:
                if c.msgtype not in self._store.fielddefs:
                    why = self.unreadable.get(c.msgtype, "the bag does not hold it")
                    raise FormatError(f"the definition of {c.msgtype}, on {c.topic}, cannot be read: {why}")
            # An empty choice would stand for all.
            parts += [reader.messages(connections=wanted)] if wanted else []
        decode = self._store.deserialize_ros1 if self.ros1 else self._store.deserialize_cdr
        for connection, time, raw in heapq.merge(*parts, key=lambda row: row[1]):
            yield connection.topic, time, decode(raw, connection.msgtype)

    def samples(self, topic: str, most: int) -> list[Any]:
        """Return the first messages of a topic; none where their definition cannot be read."""
        known = all(c.msgtype in self._store.fielddefs for c in self.connections if c.topic == topic)
        messages = self.messages((topic,)) if known else iter(())
        return [message for _, (_, _, message) in zip(range(most), messages, strict=False)]

    def seconds(self) -> float:
        """Return the time from the first message to the last, s."""
        readers = [r for r in self.readers if r.message_count]
        span = max((r.end_time for r in readers), default=0) - min((r.start_time for r in readers), default=0)
        return float(span) / 1e9

    def _with_types(self) -> Any:
        from rosbags.interfaces import MessageDefinitionFormat
        from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

        known = get_typestore(Stores.ROS2_HUMBLE)  # for bags that do not carry the definitions of their messages
        store = get_typestore(Stores.EMPTY)
        stated = {c.msgtype: c.msgdef for c in self.connections if c.msgdef.format != MessageDefinitionFormat.NONE}
        for kind in sorted({c.msgtype for c in self.connections}):
            try:
                if (definition := stated.get(kind)) is None:
                    types = {name: known.fielddefs[name] for name in _with_parts(kind, known.fielddefs)}
                elif definition.format == MessageDefinitionFormat.MSG:
                    types = get_types_from_msg(definition.data, kind)
                else:
                    # Definitions stand one behind the other, each below a line of = and one with its name.
                    line, text = "=" * 80 + "\n", definition.data
                    parts = [p.split("\n", 1)[1] for p in text.split(line)[1:]] if text.startswith(f"{line}IDL: ") else [text]
                    types = {name: how for part in parts for name, how in get_types_from_idl(part).items()}
                # One name may have stood for two things in the course of a recording: the first counts.
                store.register({name: how for name, how in types.items() if name not in store.fielddefs})
            except KeyError:
                self.unreadable[kind] = "the bag does not hold it"
            except Exception as error:  # the parser has errors of many kinds for what is no definition
                self.unreadable[kind] = _words(error, 100)
        return store


def _with_parts(kind: str, fielddefs: Any) -> list[str]:
    """Return a type and those that its fields are of; raise KeyError where one is not known."""
    found, left = list[str](), [kind]
    while left:
        if (name := left.pop()) not in found:
            found.append(name)
            for _, (node, detail) in fielddefs[name][1]:
                inner = detail if node.name == "NAME" else detail[0][1] if node.name != "BASE" else None
                left += [inner] if isinstance(inner, str) else []
    return found


def _words(error: Exception, most: int) -> str:
    """Return the words of another package's error on one line."""
    return " ".join(str(error).split())[:most] or type(error).__name__


@contextmanager
def open_bag(path: str | os.PathLike[str]) -> Iterator[OpenBag]:
    """Open a bag.

    Parameters
    ----------
    path : a file of any name, told by its content, or the folder of a ROS 2 bag, with or without its metadata.yaml.

    Raises
    ------
    FormatError : it is not there, is no bag, or nothing in it can be read.
    """
    name = os.fspath(path)
    if not os.path.exists(name):
        raise FormatError("cannot be opened: no such file or folder", name)
    try:
        import rosbags.highlevel  # noqa: F401
    except ImportError:
        raise missing_package("rosbags", "reading bags") from None
    try:
        with ExitStack() as stack:
            yield _opened(Path(name), stack)
    except FormatError as error:
        raise error if error.path else FormatError(str(error), name) from None
    except UwbliteError:
        raise
    except Exception as error:
        # rosbags, sqlite and the decompressors each have errors of their own for a damaged file, and a damaged length
        # asks for more memory than there is.
        raise FormatError(_damaged(error, name), name) from None


def _damaged(error: Exception, name: str) -> str:
    detail = _words(error, 200)
    text = f"cannot be read as a ROS bag: it is damaged ({type(error).__name__}: {detail})"
    if "database disk image is malformed" in detail:
        text += f"; sqlite3 {os.path.basename(name)} .recover | sqlite3 saved.db3 saves what can be read"
    return text


def _opened(path: Path, stack: ExitStack) -> OpenBag:
    notes = list[str]()
    readers = _of_folder(path, stack, notes) if path.is_dir() else [_of_file(path, stack, notes)]
    bag = OpenBag(readers, any(reader.path.suffix == ".bag" for reader in readers), notes)
    if notes:
        notes[0] = f"{notes[0]}; what is complete, {bag.seconds():.0f} s, was read"
    return bag


def _of_folder(folder: Path, stack: ExitStack, notes: list[str]) -> list[Any]:
    """Return the readers of a bag's folder: one for all of it, or one for each of its files."""
    from rosbags.rosbag2 import Reader

    why = "has no metadata.yaml"
    if (folder / "metadata.yaml").exists():
        try:
            return [stack.enter_context(Reader(folder))]
        except Exception as error:
            why = f"has a metadata.yaml that does not fit ({_words(error, 120)})"
    parts = sorted((p for p in folder.iterdir() if p.suffix in _KINDS.values()), key=_number)
    packed = [p.name for p in folder.iterdir() if p.name.endswith(".zstd")]
    if not parts:
        cure = f"; unpack its parts first: zstd -d {packed[0]}" if packed else ""
        raise FormatError(f"this folder {why} and holds no .mcap, .db3 or .bag file{cure}", str(folder))
    readers, first, unread = list[Any](), list[str](), list[str]()
    for part in parts:
        try:
            readers.append(_of_file(part, stack, first))
        except FormatError as error:
            unread.append(f"{part.name} ({error.problem})")
    if not readers:
        raise FormatError(f"this folder {why}, and none of its files can be read: {'; '.join(unread)}", str(folder))
    closed = f"the bag was not closed: its folder {why} (ros2 bag reindex {folder.name} writes it)"
    notes += [closed, *first, *(f"not read: {text}" for text in unread)]
    return readers


def _number(path: Path) -> tuple[int, str]:
    """Return the number of a part, as in run_10.mcap, and its name."""
    digits = path.stem.rsplit("_", 1)[-1]
    return int(digits) if digits.isdigit() else -1, path.name


class _NamedPath(type(Path())):  # type: ignore[misc]
    """A path that ends as files of its kind do, whatever it is called."""

    suffix = ""


def _of_file(path: Path, stack: ExitStack, notes: list[str]) -> Any:
    """Return the reader of one file, told by its first bytes, of what is complete where its recording was not closed."""
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2

    with path.open("rb") as stream:
        start = stream.read(16)
    kind = next((ending for magic, ending in _KINDS.items() if start.startswith(magic)), "")
    if not kind:
        why = "it begins like none (ROS 1 .bag, .mcap or sqlite3 .db3); is it whole?" if start else "the file is empty"
        if start.startswith(_PACKED):
            why = f"it is packed; unpack it first: zstd -d {path.name}"
        elif start and not start.strip(b"\0"):
            why = "it holds zeros alone, as after a power failure"
        raise FormatError(f"cannot be read as a ROS bag: {why}", str(path))
    reader: Any = Reader1 if kind == ".bag" else Reader2
    named = _NamedPath(path)
    named.suffix = kind
    if (log := path.with_name(path.name + "-wal")).exists() and log.stat().st_size:
        notes.append(f"the recording was not closed: {log.name} holds its end (sqlite3 {path.name} 'PRAGMA wal_checkpoint')")
    # Other programs that mend a file; that of ROS 1 takes a name that ends in .bag alone.
    whole = path.name.removesuffix(".active")
    repair = f"{'' if whole == path.name else f'mv {path.name} {whole}, then '}rosbag reindex {whole}"
    repair = f"mcap recover {path.name} -o whole.mcap" if kind == ".mcap" else repair
    try:
        return stack.enter_context(reader(named))
    except Exception as error:
        if kind == ".db3":
            raise FormatError(_damaged(error, path.name), str(path)) from None
        unclosed = UnclosedBag(named)
        if not unclosed.message_count:
            why = f"it was not closed, or is damaged ({_words(error, 120)}), and no message of it is complete"
            raise FormatError(f"cannot be read as a ROS bag: {why}; {repair} may save more", str(path)) from None
    notes.append(f"{path.name}: the recording was not closed (recorder killed, or power lost; {repair} mends it)")
    return unclosed
