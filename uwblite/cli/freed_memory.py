"""Memory that the program has freed, given back to the system.

The C library keeps freed arrays of up to 32 MB for what comes next, between others that live on. Where several recordings go
through all stages, that grows to as much as what lives.
"""

import sys
from collections.abc import Callable
from functools import cache
from typing import Any


def give_back() -> None:
    """Give the freed pages of all heaps back; where the C library cannot (it is not glibc), nothing happens."""
    if trim := _trim():
        trim(0)


@cache
def _trim() -> Callable[[int], Any] | None:
    if not sys.platform.startswith("linux"):
        return None
    import ctypes

    return getattr(ctypes.CDLL(None), "malloc_trim", None)
