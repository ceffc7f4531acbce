"""Freed memory goes back to the system, between the stages of a map."""

import sys
from pathlib import Path

import numpy as np
import pytest

from uwblite.cli import freed_memory, main

MEGABYTE = 1 << 20


def resident():
    words = Path("/proc/self/statm").read_text().split()
    return int(words[1]) * 4096 / MEGABYTE


@pytest.mark.skipif(not sys.platform.startswith("linux") or freed_memory._trim() is None, reason="no glibc")
def test_what_is_freed_between_living_arrays_goes_back():
    """4,000 arrays of 64 kB, the size of which the heap keeps; every second of them lives on."""
    arrays = [np.ones(8192) for _ in range(4000)]
    before = resident()
    del arrays[::2]
    freed_memory.give_back()
    assert resident() < before - 100
    assert sum(a[0] for a in arrays) == 2000


def test_where_the_library_has_no_such_function_nothing_happens(monkeypatch):
    monkeypatch.setattr(freed_memory, "_trim", lambda: None)
    freed_memory.give_back()


def test_memory_is_given_back_at_the_end_of_each_stage(monkeypatch, room_log, tmp_path):
    times = []
    monkeypatch.setattr(freed_memory, "give_back", lambda: times.append(1))
    assert main(["map", str(room_log), "--out", str(tmp_path / "map"), "-q"]) in (0, 3)
    assert len(times) > 10
