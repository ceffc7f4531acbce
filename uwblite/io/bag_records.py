"""Bags whose recording was not closed, read record by record: a recorder that was killed leaves no index.

Of a block that is cut off the messages that are complete count. Formats: ROS 1 bags (2.0), MCAP (0).
"""

import bz2
import io
import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, BinaryIO

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
        self._numbers: dict[int, int] = {}
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

        if number not in self._numbers:
            self._numbers[number] = len(self.connections)
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
    found, at = dict[bytes, bytes](), 0
    while at < len(head):
        end = at + 4 + _uint32(head[at : at + 4])
        name, _, found[name] = head[at + 4 : end].partition(b"=")
        at = end
    return found


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
            name, form, text = _strings(data, 2, 3)
            schemas[_uint16(data)] = name, MessageDefinition(formats.get(form, Form.NONE), text)
        elif kind == 0x04:
            add(_uint16(data), _strings(data, 4, 1)[0], *schemas[_uint16(data[2:])])
        elif kind == 0x05:
            channel, _, time = struct.unpack_from("<HIQ", data)
            yield channel, time, data[22:]


def _uint16(raw: bytes) -> int:
    return int(struct.unpack_from("<H", raw)[0])


def _strings(data: bytes, at: int, count: int) -> list[str]:
    """Return so many texts, each behind its length."""
    found = []
    for _ in range(count):
        end = at + 4 + _uint32(data[at : at + 4])
        found.append(data[at + 4 : end].decode())
        at = end
    return found


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
