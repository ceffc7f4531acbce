"""A bag that is open for reading: ROS 1 (2.0) or 2 (sqlite3, MCAP 0), one file or several, closed properly or not.

A recorder that was killed leaves no index: such a file is read record by record.
"""

import bz2
import heapq
import io
import os
import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, contextmanager
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

from ..errors import FormatError, UwbliteError
from .bag_topics import BagTopic
from .optional_packages import missing_package

ROS1, MCAP, SQLITE = b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n", b"SQLite format 3\0"
"""First bytes of a bag's file."""
_MOST_HEADER = 1 << 20
"""Bytes; no header of a record is longer."""
Message = tuple[int, int, bytes]
"""Number of its connection, time of recording, ns, and content."""
Add = Callable[[int, str, str, Any], None]
"""Takes a connection: number, topic, type and definition."""


class UnclosedBag:
    """The complete messages of a file, with as much of the interface of rosbags' readers as is used here."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.connections: list[Any] = []
        counts, times = Counter[int](), [0]
        for number, time, _ in self._messages():
            counts[number] += 1
            times.append(time)
        self.start_time, self.end_time, self.message_count = min(times[1:], default=0), max(times), counts.total()
        self.connections = [c._replace(msgcount=counts[c.id]) for c in self.connections]

    def messages(self, connections: Collection[Any]) -> Iterator[tuple[Any, int, bytes]]:
        """Yield connection, time of recording, ns, and content of each message of some connections."""
        wanted = {c.id: c for c in connections}
        yield from ((wanted[number], time, data) for number, time, data in self._messages() if number in wanted)

    def _add(self, number: int, topic: str, kind: str, definition: Any) -> None:
        from rosbags.interfaces import Connection

        if all(connection.id != number for connection in self.connections):
            self.connections.append(Connection(number, topic, kind, definition, "", 0, None, self))  # type: ignore[arg-type]

    def _messages(self) -> Iterator[Message]:
        with self.path.open("rb") as stream:
            size = self.path.stat().st_size
            try:
                if stream.read(len(ROS1)) == ROS1:
                    yield from _of_ros1(stream, size, self._add)
                else:
                    stream.seek(len(MCAP))
                    yield from _of_mcap(stream, size, self._add)
            except Exception:  # decompressors have errors of many kinds; what follows a damaged record is not read
                return


def _of_ros1(stream: BinaryIO, size: int, add: Add) -> Iterator[Message]:
    """Yield the messages of the records in a stream, up to its end."""
    from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat

    while len(raw := stream.read(4)) == 4 and (length := _uint32(raw)) <= _MOST_HEADER:
        fields = _fields(stream.read(length))
        kind, count = fields[b"op"][0], _uint32(stream.read(4))
        # A block that is being written states no length yet.
        data = stream.read(min(count, size) if count or kind != _CHUNK else size)
        if kind == _CHUNK:
            yield from _of_ros1(io.BytesIO(_unpacked(fields[b"compression"], data)), size, add)
        elif len(data) < count:
            return
        elif kind == _CONNECTION:
            inner = {name: value.decode() for name, value in _fields(data).items()}
            definition = MessageDefinition(MessageDefinitionFormat.MSG, inner[b"message_definition"])
            kind_of_message = inner[b"type"].replace("/msg/", "/").replace("/", "/msg/")
            add(_uint32(fields[b"conn"]), fields[b"topic"].decode(), kind_of_message, definition)
        elif kind == _MESSAGE:
            seconds, rest = struct.unpack("<II", fields[b"time"])
            yield _uint32(fields[b"conn"]), seconds * 1_000_000_000 + rest, data


_MESSAGE, _CHUNK, _CONNECTION = 2, 5, 7
"""Kinds of records of a ROS 1 bag."""


def _uint32(raw: bytes) -> int:
    return int(struct.unpack("<I", raw)[0])


def _fields(head: bytes) -> dict[bytes, bytes]:
    """Return the fields of a record's header."""
    return {name: value for name, _, value in (field.partition(b"=") for field in _pieces(head))}


def _pieces(data: bytes, place: int = 0) -> Iterator[bytes]:
    """Yield the pieces of data from a place on, each of which stands behind its length."""
    while place < len(data):
        end = place + 4 + _uint32(data[place : place + 4])
        yield data[place + 4 : end]
        place = end


def _of_mcap(stream: BinaryIO, size: int, add: Add, schemas: dict[int, tuple[str, Any]] | None = None) -> Iterator[Message]:
    """Yield the messages of the records in a stream, up to its end; `schemas` are known from before."""
    from rosbags.interfaces import MessageDefinition
    from rosbags.interfaces import MessageDefinitionFormat as Form

    formats = {"ros2msg": Form.MSG, "ros2idl": Form.IDL, "omgidl": Form.IDL}
    schemas = {0: ("__schemaless__", MessageDefinition(Form.NONE, ""))} if schemas is None else schemas
    while len(head := stream.read(9)) == 9:
        kind, length = struct.unpack("<BQ", head)
        data = stream.read(min(length, size))
        if kind == 0x06:  # a chunk: times, sizes, checksum, compression, records
            behind = 32 + _uint32(data[28:32])
            yield from _of_mcap(io.BytesIO(_unpacked(data[32:behind], data[behind + 8 :])), size, add, schemas)
        elif len(data) < length or kind in (0x00, 0x02, 0x0F):  # zeros, footer, end of the data
            return
        elif kind == 0x03:
            name, form, text = (piece.decode() for piece in islice(_pieces(data, 2), 3))
            schemas[_uint16(data)] = name, MessageDefinition(formats.get(form, Form.NONE), text)
        elif kind == 0x04:
            add(_uint16(data), next(_pieces(data, 4)).decode(), *schemas[_uint16(data[2:])])
        elif kind == 0x05:
            channel, _, time = struct.unpack_from("<HIQ", data)
            yield channel, time, data[22:]


def _uint16(raw: bytes) -> int:
    return int(struct.unpack_from("<H", raw)[0])


def _unpacked(compression: bytes, data: bytes) -> bytes:
    """Return what packed data hold, or their beginning where they are cut off."""
    if compression == b"bz2":
        return bz2.BZ2Decompressor().decompress(data)
    if compression == b"lz4":
        from lz4.frame import LZ4FrameDecompressor

        return bytes(LZ4FrameDecompressor().decompress(data))
    if compression == b"zstd":
        try:
            from backports.zstd import ZstdDecompressor
        except ImportError:
            from zstandard import ZstdDecompressor as Older

            return bytes(Older().decompressobj().decompress(data))
        return bytes(ZstdDecompressor().decompress(data))
    return data


_KINDS = {ROS1: ".bag", MCAP: ".mcap", SQLITE: ".db3"}
_PACKED = b"\x28\xb5\x2f\xfd"


class OpenBag:
    """Connections, types and messages of a bag."""

    def __init__(self, readers: list[Any], ros1: bool, notes: list[str]) -> None:
        self.readers, self.ros1, self.notes = readers, ros1, notes
        self.connections = [c for reader in readers for c in reader.connections]
        self.unreadable: dict[str, str] = {}
        """Types whose definition cannot be read, and why."""
        self._store = self._read_types()

    def topics(self) -> tuple[BagTopic, ...]:
        """Return the topics by name."""
        topics: dict[str, BagTopic] = {}
        for c in self.connections:
            before = topics.get(c.topic, BagTopic(c.topic, c.msgtype or "?", 0))
            kind = before.type if before.type == c.msgtype else "?"
            topics[c.topic] = BagTopic(c.topic, kind, before.count + c.msgcount)
        return tuple(topics[name] for name in sorted(topics))

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        """Yield topic, time of recording, ns, and message of every message of some topics, in the order of recording."""
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

    def _read_types(self) -> Any:
        from rosbags.interfaces import MessageDefinitionFormat
        from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

        known = get_typestore(Stores.ROS2_HUMBLE)  # for bags that do not carry the definitions of their messages
        store = get_typestore(Stores.EMPTY)
        stated = {c.msgtype: c.msgdef for c in self.connections if c.msgdef.format != MessageDefinitionFormat.NONE}
        for kind in sorted({c.msgtype for c in self.connections}):
            try:
                if (definition := stated.get(kind)) is None:
                    types = {name: known.fielddefs[name] for name in _parts_of_type(kind, known.fielddefs)}
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
                continue
            except Exception as error:  # the parser has errors of many kinds for what is no definition
                self.unreadable[kind] = _words(error, 100)
        return store


def _parts_of_type(kind: str, fielddefs: Any) -> list[str]:
    """Return a type and those that its fields are of; raise KeyError where one is not known."""
    parts, left = list[str](), [kind]
    while left:
        if (name := left.pop()) not in parts:
            parts.append(name)
            for _, (node, detail) in fielddefs[name][1]:
                inner = detail if node.name == "NAME" else detail[0][1] if node.name != "BASE" else None
                left += [inner] if isinstance(inner, str) else []
    return parts


def _words(error: Exception, most: int) -> str:
    """Return the words of another package's error on one line."""
    return " ".join(str(error).split())[:most] or type(error).__name__


@contextmanager
def open_bag(path: str | os.PathLike[str]) -> Iterator[OpenBag]:
    """Open a bag: a file of any name, told by its content, or the folder of a ROS 2 bag, with or without its metadata.yaml.

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
            # What Python says of a record that breaks off means nothing.
            of_python = type(error).__module__ == "builtins"
            detail = "a record breaks off, or states a length that cannot be" if of_python else _words(error, 120)
            why = f"it was not closed, or is damaged ({detail}), and no message of it is complete"
            raise FormatError(f"cannot be read as a ROS bag: {why}; {repair} may save more", str(path)) from None
    notes.append(f"{path.name}: the recording was not closed (recorder killed, or power lost; {repair} mends it)")
    return unclosed
