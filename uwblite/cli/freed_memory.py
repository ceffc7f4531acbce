"""Memory that the program has freed, given back to the system.

The C library keeps freed arrays of up to 32 MB for what comes next, between others that live on. Where several recordings go
through all stages, that grows to as much as what lives.
"""

import sys
from collections.abc import Callable
from functools import cache
from typing import Any

_GROWN = 64 << 20
"""Bytes by which the process has grown since memory was last given back, when it is worth doing again: each page that is used
anew costs a microsecond."""
_OF_STATM = "/proc/self/statm"


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
    import os

    try:
        with open(_OF_STATM, encoding="ascii") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError):
        return 0
