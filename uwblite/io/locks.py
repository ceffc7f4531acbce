"""Keeping writers of one place out of each other's way, on one computer and as far as its system can."""

import hashlib
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from ..errors import ConfigError


@contextmanager
def sole_writer(path: str | os.PathLike[str]) -> Iterator[None]:
    """Hold the name of a result while it is computed, so that no second run computes in vain.

    Raises
    ------
    ConfigError : another run of this user holds it.
    """
    with _held(path, "run", wait=False) as held:
        if not held:
            raise ConfigError(f"another run is writing {os.fspath(path)}; wait for it, or choose another --out")
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
