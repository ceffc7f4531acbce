"""Writing files so that a full disk, a crash or a pulled plug leaves the previous file whole."""

import gzip
import hashlib
import os
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from ..report.printable import encodable

WAITING = ".uwblite-partial-"
"""In the name of a folder whose files are forced to the disk all at once, before it takes its place; see folders.py."""


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a file for writing that takes the place of `path`, by one rename, only when the block ends without an error.

    A name ending in ``.gz`` is compressed, with the same bytes every time. Devices and pipes are written directly. An OSError
    leaves the previous file untouched.
    """
    target = os.path.realpath(os.fspath(path))
    if os.path.exists(target) and not os.path.isfile(target):
        with open(target, "wb") as stream:
            yield stream
        return
    folder, name = os.path.split(target)
    temporary = os.path.join(folder, f".{shortened(name)}.{secrets.token_hex(4)}.part")
    try:
        with open(temporary, "xb") as stream:
            if name.endswith(".gz"):
                with gzip.GzipFile(filename="", mode="wb", compresslevel=6, fileobj=stream, mtime=0) as packed:
                    yield packed  # type: ignore[misc]
            else:
                yield stream
            stream.flush()
            if not (waiting := WAITING in os.path.basename(folder)):
                os.fsync(stream.fileno())
        os.replace(temporary, target)
    except BaseException as error:
        with suppress(OSError):
            os.unlink(temporary)
        if isinstance(error, OSError) and error.filename in (None, temporary):
            # A write that fails names no file, and nobody asked for the temporary one.
            error.filename = os.fspath(path)
        raise
    if not waiting:
        sync_folder(folder)


def shortened(name: str) -> str:
    """Return the beginning of a file's name, so that a longer one made of it is no longer than file systems allow."""
    return os.fsdecode(os.fsencode(name)[:100])


def write_bytes(path: str | os.PathLike[str], data: bytes) -> None:
    """Write a whole file, or leave the previous one untouched (see `replacing`)."""
    with replacing(path) as stream:
        stream.write(data)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a whole UTF-8 file with Unix line ends, or leave the previous one untouched (see `replacing`)."""
    write_bytes(path, encodable(text).encode())


def sync_folder(folder: str | os.PathLike[str]) -> None:
    """Force the new name to the disk, where the file system allows it."""
    with suppress(OSError):
        _use_handle(folder, os.fsync)


def _use_handle(path: str | os.PathLike[str], work: Callable[[int], object]) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        work(handle)
    finally:
        os.close(handle)


def sync_files(folder: str | os.PathLike[str]) -> None:
    """Force all files of a folder, and their names, to the disk; writing begins for all of them before one is waited for."""
    files = [entry.path for entry in os.scandir(folder) if entry.is_file(follow_symlinks=False)]
    for work in (_begin_writing, os.fsync):
        # One at a time: a process may have few files open.
        for file in files:
            _use_handle(file, work)
    sync_folder(folder)


def _begin_writing(handle: int) -> None:
    if hasattr(os, "posix_fadvise"):
        os.posix_fadvise(handle, 0, 0, os.POSIX_FADV_DONTNEED)


def sha256_of(path: str | os.PathLike[str]) -> str:
    """Return the hash of a file, or of all files of a folder in the order of their names, hexadecimal."""
    digest = hashlib.sha256()
    top = Path(path)
    for file in sorted(p for p in top.rglob("*") if p.is_file()) if top.is_dir() else [top]:
        with open(file, "rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()
