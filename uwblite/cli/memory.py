"""How much memory this process may have, compared beforehand with what a map needs; and memory that is freed given back."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from typing import Any, NamedTuple

_PROC, _CGROUPS = "/proc", "/sys/fs/cgroup"
_LIBRARIES, _BUFFERS = 300_000_000, 130_000_000
"""Bytes that numpy and scipy map with the buffers of OpenBLAS: 230 MB in Debian 12, 128 MB of them for the first product of
matrices, and 270 MB in PyPI's wheels, where each has an OpenBLAS of its own; the buffers alone where they are loaded."""
_PRIVATE = 200_000_000
"""Bytes of them that are mapped for one process alone to write."""
_RESIDENT = 76_000_000
"""Bytes of memory that Python, numpy, scipy and this package take before anything is read."""
_ADDRESSES = 1 << 31
"""Bytes that a process of a 32-bit system has at least."""
_NO_LIMIT = 1 << 60
"""Bytes from which a cgroup of version 1 has no limit: it says the largest multiple of a page in 63 bits."""


class Limit(NamedTuple):
    """The most memory that this process may have."""

    name: str
    bytes: int
    of_addresses: bool = False
    """It counts what is mapped, used or not, libraries too, and for each process alone."""
    of_data: bool = False
    """It counts what is mapped, used or not, for a process alone to write."""

    @property
    def of_a_process(self) -> bool:
        """Whether it counts each process by itself."""
        return self.of_addresses or self.of_data


class NoRoom(MemoryError):
    """There is no room even for the libraries."""


class Shortage(NamedTuple):
    """A map that needs more memory than there is."""

    text: str
    hopeless: bool
    """It needs more than twice as much: the estimate is not as wrong as that."""


def shortage(megabytes: float, maps: int = 1) -> Shortage | None:
    """Compare the memory that so many maps at a time need with the limits of this process; None where it suffices.

    Each map has a process of its own: addresses are limited for each, memory for all.
    """
    shares = [(_needed(megabytes, limit) / limit.bytes, limit) for limit in limits()]
    worst, limit = max(((one * (1 if limit.of_a_process else maps), limit) for one, limit in shares), default=(0.0, None))
    if limit is None or worst <= 1.0:
        return None
    who = "this map needs" if maps == 1 or limit.of_a_process else f"{maps} such maps at a time need"
    text = f"{who} about {worst * limit.bytes / 1e6:.0f} MB of memory; {limit.name} is {limit.bytes / 1e6:.0f} MB"
    cure = f"{'' if maps == 1 else 'fewer --jobs, '}a larger --resolution, --every-nth-scan or a part of the recording"
    return Shortage(f"{text}: {cure} {'needs' if maps == 1 else 'need'} less", max(one for one, _ in shares) > 2.0)


def _needed(megabytes: float, limit: Limit) -> float:
    """Return bytes as this limit counts them."""
    pages = _pages()
    mapped, used = (pages.mapped, pages.resident) if limit.of_addresses else (pages.private, pages.used)
    # Where more is mapped than this process could, the pages are those of an emulator that runs it.
    known = limit.of_a_process and mapped <= limit.bytes
    return 1e6 * megabytes + (max(mapped - used, 0) if known else 0)


def limits() -> list[Limit]:
    """Return the limits that this system sets; what cannot be read sets none."""
    limits = [Limit("this computer's memory", total)] if (total := _memory("MemTotal", "SwapTotal")) else []
    if sys.maxsize < _ADDRESSES:
        limits.append(Limit("what a 32-bit system can address", _ADDRESSES, of_addresses=True))
    return limits + shell_limits() + ([Limit("the limit of this control group", group)] if (group := group_limit()) else [])


def shell_limits() -> list[Limit]:
    """Return the limits that the shell sets for each process; its commands in brackets."""
    try:
        import resource
    except ImportError:
        return []
    addresses, data = (resource.getrlimit(kind)[0] for kind in (resource.RLIMIT_AS, resource.RLIMIT_DATA))
    limits = [Limit("the limit of the address space (ulimit -v)", addresses, of_addresses=True)]
    limits.append(Limit("the limit of the data (ulimit -d)", data, of_data=True))
    return [limit for limit in limits if limit.bytes != resource.RLIM_INFINITY]


@contextmanager
def within_limits() -> Iterator[None]:
    """Refuse to begin where numpy and scipy do not fit; raise MemoryError within where their process would be killed.

    A control group's process that needs more than the limit is killed without a word. Its private memory gets the same limit,
    and what OpenBLAS and others have mapped and not used beyond that.

    Raises
    ------
    NoRoom : the libraries do not fit.
    """
    for limit in limits():
        if not limit.of_a_process and limit.bytes < _RESIDENT:
            need = f"numpy and scipy alone need {_RESIDENT / 1e6:.0f} MB"
            raise NoRoom(f"{need}; {limit.name} is {limit.bytes / 1e6:.0f} MB")
    group = group_limit()
    if group or shell_limits():
        _load_libraries()
    pages = _pages()
    if not group or not pages.private:
        yield
        return
    import resource

    before = resource.getrlimit(resource.RLIMIT_DATA)
    most = group + _memory("SwapTotal") + pages.private - pages.used
    resource.setrlimit(resource.RLIMIT_DATA, (most if before[1] == resource.RLIM_INFINITY else min(most, before[1]), before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)


def allowed() -> str:
    """Return what to say after "out of memory" of the limits that end a process by an error."""
    shell = [f"; the shell allows {limit.bytes / 1e6:.0f} MB ({limit.name.rpartition('(')[2]}" for limit in shell_limits()]
    group = group_limit()
    return "".join(shell) + (f"; this control group allows {group / 1e6:.0f} MB" if group else "")


def _load_libraries() -> None:
    """Let OpenBLAS map its buffers while there is room: it tries for ever where it cannot."""
    import mmap

    loaded = "scipy" in sys.modules
    for what, size, access in (("addresses", _LIBRARIES, mmap.MAP_SHARED), ("data", _PRIVATE, mmap.MAP_PRIVATE)):
        try:
            mmap.mmap(-1, _BUFFERS if loaded else size, access).close()
        except OSError as error:
            raise NoRoom(f"numpy and scipy alone need {size / 1e6:.0f} MB of {what}{allowed()}") from error
    import numpy as np
    from scipy.linalg import blas

    square = np.ones((128, 128))  # products of smaller matrices do without the buffer
    np.dot(square, square.T)
    blas.dsyrk(1.0, square)


class _Pages(NamedTuple):
    """Bytes of this process; zeros where they are not known."""

    mapped: int = 0
    resident: int = 0
    private: int = 0
    """Mapped for this process alone to write."""
    used: int = 0
    """Of them in memory."""


def _pages() -> _Pages:
    import os

    words = _text(f"{_PROC}/self/statm").split()
    with suppress(ValueError, IndexError):
        mapped, resident, shared, _, _, private = (int(word) * os.sysconf("SC_PAGE_SIZE") for word in words[:6])
        return _Pages(mapped, resident, private, resident - shared)
    return _Pages()


def _memory(*names: str) -> int:
    """Return a sum of rows of /proc/meminfo, bytes; 0 where it is not known."""
    rows = dict(line.split(":", 1) for line in _text(f"{_PROC}/meminfo").splitlines() if ":" in line)
    return sum(1024 * int(rows[name].split()[0]) for name in names if rows.get(name, "").split())


def group_limit() -> int:
    """Return the smallest limit of this process's control groups, bytes; 0 = none."""
    return min((size for size in _group_limits() if size < _NO_LIMIT), default=0)


def _group_limits() -> Iterator[int]:
    """Yield the limits of this process's control group, of either version, and of those around it, bytes."""
    for line in _text(f"{_PROC}/self/cgroup").splitlines():
        _, controllers, path = (*line.split(":", 2), "", "")[:3]
        if controllers and "memory" not in controllers.split(","):
            continue
        root, name = (f"{_CGROUPS}/memory", "memory.limit_in_bytes") if controllers else (_CGROUPS, "memory.max")
        parts = [part for part in path.split("/") if part]
        for depth in range(len(parts), -1, -1):
            with suppress(ValueError):
                yield int(_text("/".join([root, *parts[:depth], name])))


def _text(path: str) -> str:
    try:
        with open(path, encoding="ascii", errors="replace") as file:
            return file.read()
    except OSError:
        return ""


_GROWN = 64 << 20
"""Bytes by which the process has grown since memory was last given back, when it is worth doing again: each page that is used
anew costs a microsecond."""


class FreedMemory:
    """Gives freed pages of all heaps back; does nothing where the C library cannot (it is not glibc)."""

    def __init__(self) -> None:
        self._resident = 0

    def give_back(self, *, over: bool) -> None:
        """Give back what is free where a stage is over; within one only if the process has grown much since the last time."""
        trim = _trim()
        if trim is not None and (over or _resident() > self._resident + _GROWN):
            trim(0)
            self._resident = _resident()


@cache
def _trim() -> Callable[[int], Any] | None:
    if not sys.platform.startswith("linux"):
        return None
    import ctypes

    return getattr(ctypes.CDLL(None), "malloc_trim", None)


def _resident() -> int:
    """Return the memory of this process, bytes; 0 where it is not known, as where /proc is not mounted."""
    return _pages().resident
