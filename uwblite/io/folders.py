"""Replacing a folder of files as a whole, as far as the system allows, by one writer at a time.

A new folder appears by one rename. One that holds nothing but an earlier result changes places with its successor in one step,
where the system can (Linux' renameat2). In a folder that others use too, the finished files are first named as such and then
renamed one by one: what a crash leaves undone is done by `mend`.
"""

import ctypes
import hashlib
import os
import secrets
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ..errors import ConfigError
from .files import WAITING, shortened, sync_files, sync_folder, write_text

_READY = ".uwblite-ready"
_LIST = "files"
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2
Owned = Callable[[str], bool]
"""Matches names of files that belong to a result."""


@contextmanager
def replacing_folder(path: str | os.PathLike[str], owned: Owned) -> Iterator[Path]:
    """Give an empty folder to write into; when the block ends well, its files replace those of a folder that `owned` names.

    Raises
    ------
    ConfigError : a folder stands where a file belongs.
    OSError : the disk is full or may not be written; the folder is as it was.
    """
    folder = Path(os.path.realpath(path))
    check_free(folder, owned)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with one_at_a_time(folder):
        yield from _replacing(folder, owned)


def check_free(folder: str | os.PathLike[str], owned: Owned) -> None:
    """Raise ConfigError where another folder in a folder has the name of a file: only some of the files could be replaced."""
    inside = Path(folder).iterdir() if os.path.isdir(folder) else iter(())
    blocked = next((p for p in inside if owned(p.name) and p.is_dir() and not p.is_symlink()), None)
    if blocked is not None:
        raise ConfigError(f"{blocked} is a folder, and a file of this name is to be written; move it away")


def refuse_foreign(files: Iterable[Path]) -> None:
    """Raise ConfigError for the first of files that somebody else has written."""
    for file in files:
        raise ConfigError(f"{file} was not written by uwblite, or was changed since; move it away, or choose another folder")


def unmarked(folder: Path, names: Iterable[str], mark: str, start: str) -> list[Path]:
    """Return the files of a folder with these names, unless the one called `mark` begins as uwblite writes it."""
    with suppress(OSError), open(folder / mark, "rb") as stream:
        if stream.read(len(start.encode())) == start.encode():
            return []
    return [folder / name for name in names if (folder / name).is_file()]


def refuse_foreign_picture(table: str, picture: str, head: str) -> None:
    """Refuse to replace a table and the picture of the same name beside it, unless the table begins as uwblite writes it."""
    file = Path(table)
    refuse_foreign(unmarked(file.parent, (file.name, Path(picture).name), file.name, head))


def _replacing(folder: Path, owned: Owned) -> Iterator[Path]:
    _repair(folder, owned)
    beside = not folder.exists() or _may_change_places(folder, owned)
    home, prefix = (folder.parent, f".{shortened(folder.name)}{WAITING}") if beside else (folder, WAITING)
    for left in [p for p in home.iterdir() if p.name.startswith(prefix)]:  # of killed writers
        shutil.rmtree(left, ignore_errors=True)
    waiting = home / f"{prefix}{secrets.token_hex(4)}"
    try:
        waiting.mkdir()
        yield waiting
        sync_files(waiting)
        if not (beside and _in_one_step(waiting, folder, owned)):
            write_text(waiting / _LIST, "\n".join(sorted(p.name for p in waiting.iterdir())))
            sync_files(waiting)
            folder.mkdir(exist_ok=True)
            # What a crash left of an earlier one, after its files had been moved.
            shutil.rmtree(folder / _READY, ignore_errors=True)
            os.replace(waiting, folder / _READY)
            sync_folder(folder)
            _repair(folder, owned)
    except OSError as error:
        # Nobody asked for the folder that waits.
        if error.filename is not None and (path := Path(os.fsdecode(error.filename))).is_relative_to(waiting):
            error.filename = os.fspath(folder / path.relative_to(waiting))
        raise
    finally:
        shutil.rmtree(waiting, ignore_errors=True)


def mend(path: str | os.PathLike[str], owned: Owned) -> bool:
    """Finish a replacement that was interrupted after all of its files were complete; return whether there was one."""
    folder = Path(os.path.realpath(path))
    if not (folder / _READY / _LIST).is_file():
        return False
    with one_at_a_time(folder):
        return _repair(folder, owned)


def _repair(folder: Path, owned: Owned) -> bool:
    ready = folder / _READY
    if ready.is_symlink() or not (ready / _LIST).is_file():
        return False
    names = [n for n in (ready / _LIST).read_text().split("\n") if owned(n)]
    for name in names:
        with suppress(FileNotFoundError):
            os.replace(ready / name, folder / name)
    for old in list(folder.iterdir()):
        if owned(old.name) and old.name not in names:
            old.unlink()
    sync_folder(folder)
    (ready / _LIST).unlink()
    shutil.rmtree(ready, ignore_errors=True)
    return True


def _may_change_places(folder: Path, owned: Owned) -> bool:
    """Return whether a folder holds nothing but a result and no process works in it."""
    others = [p.name for p in folder.iterdir() if not (owned(p.name) and p.is_file() and not p.is_symlink())]
    if [name for name in others if not name.startswith(WAITING)] or os.path.ismount(folder):
        return False
    with suppress(OSError):
        if Path.cwd().is_relative_to(folder):
            return False
    return os.access(folder.parent, os.W_OK | os.X_OK)


def _in_one_step(waiting: Path, folder: Path, owned: Owned) -> bool:
    """Put a finished folder in the place of another by one rename; False where the system cannot."""
    if not folder.exists() or not any(folder.iterdir()):
        if folder.exists():
            shutil.copymode(folder, waiting)
        os.replace(waiting, folder)
        sync_folder(folder.parent)
        return True
    with suppress(OSError):
        shutil.copymode(folder, waiting)
    if not _exchange(waiting, folder):
        return False
    sync_folder(folder.parent)
    for late in list(waiting.iterdir()):
        if not owned(late.name) and not late.name.startswith(WAITING):
            os.replace(late, folder / late.name)
    return True


def _exchange(one: Path, other: Path) -> bool:
    """Let two names change places in one step; False where the system or the file system cannot."""
    call = getattr(ctypes.CDLL(None), "renameat2", None) if os.name == "posix" else None
    if call is None:
        return False
    first, second = (ctypes.c_char_p(os.fsencode(name)) for name in (one, other))
    return bool(call(_AT_FDCWD, first, _AT_FDCWD, second, ctypes.c_uint(_RENAME_EXCHANGE)) == 0)


@contextmanager
def sole_writer(path: str | os.PathLike[str]) -> Iterator[None]:
    """Hold the name of a result while it is computed; raise ConfigError where another run of this user holds it."""
    with _held(path, "run", wait=False) as held:
        if not held:
            raise ConfigError(f"another run is writing {os.fspath(path)}; wait for it, or choose another `folder`")
        yield


@contextmanager
def one_at_a_time(path: str | os.PathLike[str]) -> Iterator[None]:
    """Wait until no other process or thread of this user writes the files of a folder."""
    with _held(path, "files", wait=True):
        yield


@contextmanager
def _held(path: str | os.PathLike[str], what: str, *, wait: bool) -> Iterator[bool]:
    """Hold a name; give False where another holds it and is not waited for. Without locks everybody holds it."""
    handle, name = _locked(path, what, wait)
    try:
        yield handle != _TAKEN
    finally:
        if handle >= 0:
            with suppress(OSError):
                os.unlink(name)
            os.close(handle)


_TAKEN, _NO_LOCKS = -1, -2


def _locked(path: str | os.PathLike[str], what: str, wait: bool) -> tuple[int, str]:
    """Return the handle and name of a locked file that stands for a path; _TAKEN or _NO_LOCKS in place of the handle."""
    try:
        import fcntl
    except ImportError:
        return _NO_LOCKS, ""
    key = hashlib.sha256(os.fsencode(os.path.realpath(path))).hexdigest()[:24]
    try:
        folder = tempfile.gettempdir()
    except FileNotFoundError:
        # Full disks: none of them takes a file, and the one that is written to may be another.
        return _NO_LOCKS, ""
    name = os.path.join(folder, f"uwblite-{os.getuid()}-{key}.{what}")
    while True:
        try:
            handle = os.open(name, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        except OSError:
            return _NO_LOCKS, ""
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            # The process that locked it before has removed it: then others lock another file of that name.
            if os.path.samestat(os.fstat(handle), os.stat(name)):
                return handle, name
        except BlockingIOError:
            os.close(handle)
            return _TAKEN, ""
        except FileNotFoundError:
            pass
        except OSError:
            os.close(handle)
            return _NO_LOCKS, ""
        os.close(handle)
