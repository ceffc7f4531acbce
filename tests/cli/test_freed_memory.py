"""Freed memory goes back to the system, between the stages of a map."""

import sys
from pathlib import Path

import numpy as np
import pytest

from uwblite.cli import main, memory

MEGABYTE = 1 << 20


def resident():
    words = Path("/proc/self/statm").read_text().split()
    return int(words[1]) * 4096 / MEGABYTE


@pytest.mark.skipif(not sys.platform.startswith("linux") or memory._trim() is None, reason="no glibc")
def test_what_is_freed_between_living_arrays_goes_back():
    """4,000 arrays of 64 kB, the size of which the heap keeps; every second of them lives on."""
    freed = memory.FreedMemory()
    freed.give_back(over=True)
    arrays = [np.ones(8192) for _ in range(4000)]
    before = resident()
    del arrays[::2]
    freed.give_back(over=False)
    assert resident() < before - 100
    assert sum(a[0] for a in arrays) == 2000


def test_within_a_stage_it_is_given_back_only_where_the_process_has_grown(monkeypatch):
    trimmed, resident = [], iter([300, 200, 250, 263, 265, 210, 260])
    monkeypatch.setattr(memory, "_trim", lambda: trimmed.append)
    monkeypatch.setattr(memory, "_resident", lambda: next(resident) * MEGABYTE)
    freed, counts = memory.FreedMemory(), []
    for _ in range(5):
        freed.give_back(over=False)
        counts.append(len(trimmed))
    assert counts == [1, 1, 1, 2, 2]


def test_at_the_end_of_a_stage_it_is_given_back_in_any_case(monkeypatch):
    trimmed = []
    monkeypatch.setattr(memory, "_trim", lambda: trimmed.append)
    monkeypatch.setattr(memory, "_resident", lambda: 0)
    memory.FreedMemory().give_back(over=True)
    assert trimmed == [0]


def test_where_the_library_has_no_such_function_nothing_happens(monkeypatch):
    monkeypatch.setattr(memory, "_trim", lambda: None)
    monkeypatch.setattr(memory, "_resident", lambda: pytest.fail("nothing is to be measured"))
    memory.FreedMemory().give_back(over=True)


def test_without_proc_it_is_given_back_where_a_stage_is_over(monkeypatch, tmp_path):
    trimmed = []
    monkeypatch.setattr(memory, "_trim", lambda: trimmed.append)
    monkeypatch.setattr(memory, "_PROC", str(tmp_path))
    freed = memory.FreedMemory()
    freed.give_back(over=False)
    freed.give_back(over=True)
    (tmp_path / "self").mkdir()
    (tmp_path / "self/statm").write_text("no numbers")
    freed.give_back(over=True)
    assert trimmed == [0, 0]


def test_memory_is_given_back_within_and_between_the_stages_of_a_map(monkeypatch, short_log, tmp_path):
    times = []
    monkeypatch.setattr(memory.FreedMemory, "give_back", lambda self, *, over: times.append(over))
    assert main(["map", str(short_log), "--out", str(tmp_path / "map"), "-q"]) in (0, 3)
    assert sum(times) > 10
    assert not all(times)
