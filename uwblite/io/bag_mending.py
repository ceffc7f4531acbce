"""Bags whose recording was not closed, shown to a reader as whole ones: what is complete, and the index that is missing.

A recorder that was killed leaves no index, and perhaps half a record at the end. Nothing is written: the reader sees a file
that is spliced of parts of the one on the disk and of bytes in memory.
"""

import bz2
import io
import struct
from bisect import bisect_right
from pathlib import Path
from typing import IO, Any, BinaryIO

ROS1, MCAP, SQLITE = b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n", b"SQLite format 3\0"
"""First bytes of a bag's file."""
_HEADER, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION, _MESSAGE = 3, 4, 5, 6, 7, 2
"""Kinds of records of a ROS 1 bag (format 2.0)."""
Pieces = list[bytes | tuple[int, int]]
_MOST_HEADER = 1 << 20
"""Bytes; no header of a record is longer."""


class SplicedFile(io.RawIOBase):
    """A file that can be read, of pieces: bytes, or (first, last) of another file."""

    def __init__(self, stream: BinaryIO, pieces: Pieces) -> None:
        self._stream, self._pieces, self._at = stream, pieces, 0
        self._begins = [0]
        for piece in pieces:
            self._begins.append(self._begins[-1] + (len(piece) if isinstance(piece, bytes) else piece[1] - piece[0]))

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = 0) -> int:
        self._at = max(0, offset + (0, self._at, self._begins[-1])[whence])
        return self._at

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        k = bisect_right(self._begins, self._at) - 1
        if k >= len(self._pieces):
            return 0
        piece, inside = self._pieces[k], self._at - self._begins[k]
        wanted = min(len(buffer), self._begins[k + 1] - self._at)
        if isinstance(piece, bytes):
            data = piece[inside : inside + wanted]
        else:
            self._stream.seek(piece[0] + inside)
            data = self._stream.read(wanted)
        buffer[: len(data)] = data
        self._at += len(data)
        return len(data)

    def close(self) -> None:
        self._stream.close()
        super().close()


class BagPath:
    """A bag's file as the readers of rosbags take it: a path with the ending of its kind, its pieces in place of its bytes."""

    def __init__(self, path: Path, suffix: str, pieces: Pieces | None = None) -> None:
        self.path, self.suffix, self.stem, self.pieces = path, suffix, path.stem, pieces

    def exists(self) -> bool:
        """Return True."""
        return True

    def is_dir(self) -> bool:
        """Return False."""
        return False

    def stat(self) -> Any:
        """Return what the system says about the file."""
        return self.path.stat()

    def open(self, *_: Any, **__: Any) -> IO[bytes]:
        """Open the file for reading."""
        stream = self.path.open("rb")
        return stream if self.pieces is None else io.BufferedReader(SplicedFile(stream, self.pieces), 1 << 16)

    def __str__(self) -> str:
        return str(self.path)


def mended(path: Path) -> BagPath | None:
    """Return a bag that was not closed as a whole one; None where nothing of it is complete.

    Parameters
    ----------
    path : a ROS 1 bag or an MCAP file. Of a block that is cut off, the messages that are complete count.
    """
    with path.open("rb") as stream:
        magic, size = stream.read(len(ROS1)), stream.seek(0, 2)
        try:
            if magic == ROS1:
                return BagPath(path, ".bag", _with_index(stream, size))
            if magic.startswith(MCAP):
                return BagPath(path, ".mcap", _with_footer(stream, size))
        except (struct.error, ValueError, OSError, EOFError, KeyError, IndexError, RuntimeError, ImportError):
            return None
    return None


def _with_footer(stream: BinaryIO, size: int) -> Pieces:
    """Return the pieces of an MCAP file with an index of its chunks.

    Of a chunk that is cut off, the messages that are complete make a chunk of their own.
    """
    at, chunks, messages, rest = len(MCAP), list[bytes](), 0, b""
    while at + 9 <= size and not rest:
        stream.seek(at)
        kind, length = struct.unpack("<BQ", stream.read(9))
        cut = at + 9 + length > size
        if kind in (0, _FOOTER, _DATA_END) or (cut and kind != _MCAP_CHUNK):
            break
        if kind == _MCAP_CHUNK:
            begin = stream.tell()
            (name,) = struct.unpack("<28xI", stream.read(32))
            compression = stream.read(name)
            (packed,) = struct.unpack("<Q", stream.read(8))
            data = _beginning(compression, stream.read(min(packed, size - stream.tell())))
            times, used = _messages_of(data)
            if cut or used < len(data):
                if not times:
                    break
                span = [t for each in times.values() for t in each]
                head = struct.pack("<QQQIIQ", min(span), max(span), used, 0, 0, used)
                rest = _mcap_record(_MCAP_CHUNK, head + data[:used])
                chunks.append(_chunk_index(head, at, len(rest), times))
                break
            stream.seek(begin)
            chunks.append(_chunk_index(stream.read(40 + name), at, 9 + length, times))
        messages += kind == _MCAP_MESSAGE
        at += 9 + length
    if not chunks and not messages:
        raise ValueError("no message is complete")
    # Counts of none: without schemas in the index a reader counts the messages itself.
    index = b"".join([*chunks, _mcap_record(_STATISTICS, bytes(46))]) if chunks else b""
    footer = _mcap_record(_FOOTER, struct.pack("<QQI", at + len(rest) if index else 0, 0, 0))
    return [(0, at), rest + index + footer + MCAP]


_FOOTER, _MCAP_MESSAGE, _MCAP_CHUNK, _CHUNK_INDEX, _STATISTICS, _DATA_END = 0x02, 0x05, 0x06, 0x08, 0x0B, 0x0F
"""Kinds of records of an MCAP file (version 0)."""


def _chunk_index(head: bytes, at: int, length: int, times: dict[int, list[int]]) -> bytes:
    """Return the record of an index on a chunk.

    Parameters
    ----------
    head : what stands before the chunk's data. at, length : of its record in the file. times : of its messages, by channel.
    """
    first, last, unpacked, _, name = struct.unpack_from("<QQQII", head)
    # Readers count the messages of a channel by the place that its own index takes behind the chunk.
    places, place = b"", at + length
    for channel, each in times.items():
        places += struct.pack("<HQ", channel, place)
        place += 15 + 16 * len(each)
    content = struct.pack("<QQQQI", first, last, at, length, len(places)) + places
    content += struct.pack("<QI", place - at - length, name) + head[32 : 40 + name] + struct.pack("<Q", unpacked)
    return _mcap_record(_CHUNK_INDEX, content)


def _beginning(compression: bytes, data: bytes) -> bytes:
    """Return what packed data hold, or their beginning where they are cut off."""
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


def _messages_of(data: bytes) -> tuple[dict[int, list[int]], int]:
    """Return the times, ns, of the complete messages in a chunk's data, by channel, and where its complete records end."""
    at, times = 0, dict[int, list[int]]()
    while at + 9 <= len(data):
        kind, length = struct.unpack_from("<BQ", data, at)
        if at + 9 + length > len(data):
            break
        if kind == _MCAP_MESSAGE:
            channel, _, time = struct.unpack_from("<HIQ", data, at + 9)
            times.setdefault(channel, []).append(time)
        at += 9 + length
    return times, at


def _mcap_record(kind: int, content: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(content)) + content


def _with_index(stream: BinaryIO, size: int) -> Pieces:
    """Return the pieces of a ROS 1 bag with an index of what is complete."""
    first = at = len(ROS1) + _length(stream, len(ROS1))
    connections, infos, tail = dict[int, bytes](), list[bytes](), Pieces()
    while at < size and not tail:
        try:
            fields, begin, length = _record(stream, at)
            if fields[b"op"][0] != _CHUNK:
                break
            # A block that is being written states no length yet.
            cut = length == 0 or begin + length > size
            data = _unpacked(stream, fields[b"compression"], begin, size - begin if cut else length, cut)
            rows, used = _messages_in(data, connections)
            behind = None if cut else _behind_index(stream, begin + length, len(rows))
        except (struct.error, ValueError, EOFError, OSError, KeyError):
            break
        if not rows:
            break
        infos.append(_chunk_info(at, rows))
        if behind is None:
            length = used if cut else length
            tail = [(first, begin - 4), struct.pack("<I", length), (begin, begin + length), _index_of(rows)]
            at = begin + length
        else:
            at = behind
    if not infos:
        raise ValueError("no block is complete")
    pieces = tail or [(first, at)]
    end = first + sum(len(p) if isinstance(p, bytes) else p[1] - p[0] for p in pieces)
    counts = {b"conn_count": struct.pack("<I", len(connections)), b"chunk_count": struct.pack("<I", len(infos))}
    fields = {b"op": bytes([_HEADER]), b"index_pos": struct.pack("<Q", end), **counts}
    blank = first - len(ROS1) - len(_ros_record(fields, b""))
    if blank < 0:
        raise ValueError("the header is too short for an index")
    return [ROS1 + _ros_record(fields, b" " * blank), *pieces, b"".join([*connections.values(), *infos])]


def _record(stream: BinaryIO, at: int) -> tuple[dict[bytes, bytes], int, int]:
    """Return the fields of the record of a ROS 1 bag at a place, where its data begin, and how long they are."""
    stream.seek(at)
    (length,) = struct.unpack("<I", stream.read(4))
    if length > _MOST_HEADER:
        raise ValueError("no header")
    head = stream.read(length)
    (data,) = struct.unpack("<I", stream.read(4))
    return _fields(head), at + 8 + length, data


def _length(stream: BinaryIO, at: int) -> int:
    """Return the length of the record at a place."""
    _, begin, length = _record(stream, at)
    return begin + length - at


def _fields(head: bytes) -> dict[bytes, bytes]:
    """Return the fields of a record's header."""
    found, at = dict[bytes, bytes](), 0
    while at < len(head):
        (length,) = struct.unpack_from("<I", head, at)
        name, _, value = head[at + 4 : at + 4 + length].partition(b"=")
        found[name] = value
        at += 4 + length
    return found


def _ros_record(fields: dict[bytes, bytes], data: bytes) -> bytes:
    parts = [name + b"=" + value for name, value in fields.items()]
    head = b"".join(struct.pack("<I", len(part)) + part for part in parts)
    return struct.pack("<I", len(head)) + head + struct.pack("<I", len(data)) + data


def _unpacked(stream: BinaryIO, compression: bytes, begin: int, length: int, cut: bool) -> bytes:
    """Return the records of a block.

    Raises
    ------
    ValueError : it is packed and cut off, or packed in an unknown way.
    """
    stream.seek(begin)
    data = stream.read(length)
    if compression == b"none":
        return data
    if cut or compression not in (b"bz2", b"lz4"):
        raise ValueError("cannot be unpacked")
    if compression == b"bz2":
        return bz2.decompress(data)
    from lz4.frame import decompress

    return bytes(decompress(data))


def _messages_in(data: bytes, connections: dict[int, bytes]) -> tuple[dict[int, list[tuple[bytes, int]]], int]:
    """Return time and place of the messages of a block, by connection, and where its last complete record ends.

    Parameters
    ----------
    connections : takes the records of connections that the block holds, by number.
    """
    found, at = dict[int, list[tuple[bytes, int]]](), 0
    while at + 4 <= len(data):
        (length,) = struct.unpack_from("<I", data, at)
        begin = at + 8 + length
        if length > _MOST_HEADER or begin > len(data):
            break
        (size,) = struct.unpack_from("<I", data, begin - 4)
        if begin + size > len(data):
            break
        fields = _fields(data[at + 4 : begin - 4])
        if b"op" not in fields or b"conn" not in fields:
            break
        (number,) = struct.unpack("<I", fields[b"conn"])
        if fields[b"op"][0] == _CONNECTION:
            connections.setdefault(number, data[at : begin + size])
        elif fields[b"op"][0] == _MESSAGE:
            found.setdefault(number, []).append((fields[b"time"], at))
        at = begin + size
    return found, at


def _behind_index(stream: BinaryIO, at: int, many: int) -> int | None:
    """Return the end of the index of a block of so many connections; None where it is not complete."""
    try:
        for _ in range(many):
            fields, begin, length = _record(stream, at)
            at = begin + length
            stream.seek(at - 1)
            if fields[b"op"][0] != _INDEX or not stream.read(1):
                return None
    except (struct.error, ValueError, KeyError):
        return None
    return at


def _index_of(rows: dict[int, list[tuple[bytes, int]]]) -> bytes:
    """Return the records of a block's index."""
    records = []
    for number, messages in rows.items():
        fields = {b"ver": struct.pack("<I", 1), b"conn": struct.pack("<I", number), b"count": struct.pack("<I", len(messages))}
        data = b"".join(time + struct.pack("<I", place) for time, place in messages)
        records.append(_ros_record({b"op": bytes([_INDEX]), **fields}, data))
    return b"".join(records)


def _chunk_info(at: int, rows: dict[int, list[tuple[bytes, int]]]) -> bytes:
    """Return the record of a bag's index on the block at a place."""
    times = sorted(struct.unpack("<II", time) for messages in rows.values() for time, _ in messages)
    fields = {
        b"op": bytes([_CHUNK_INFO]), b"ver": struct.pack("<I", 1), b"chunk_pos": struct.pack("<Q", at),
        b"start_time": struct.pack("<II", *times[0]), b"end_time": struct.pack("<II", *times[-1]),
        b"count": struct.pack("<I", len(rows)),
    }  # fmt: skip
    return _ros_record(fields, b"".join(struct.pack("<II", number, len(messages)) for number, messages in rows.items()))
