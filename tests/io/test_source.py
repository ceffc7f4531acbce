import io
import os
import sys
import threading

import pytest

from uwblite.errors import FormatError
from uwblite.io.source import MAX_LINE_BYTES, OVERLONG_LINE, open_input, open_source, read_bounded


def test_a_pipe_with_a_writer_is_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    writer = threading.Thread(target=lambda: (tmp_path / "pipe").write_bytes(b"one\n" * 100_000))
    writer.start()
    with open_source(tmp_path / "pipe") as source:
        assert sum(map(len, source.blocks())) == 400_000
    writer.join()


def test_a_pipe_without_a_writer_is_an_error(tmp_path, monkeypatch):
    monkeypatch.setattr("uwblite.io.source._PIPE_PATIENCE", 0.05)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(FormatError, match="is a pipe, and nobody wrote into it for"), open_source(tmp_path / "pipe"):
        pass


@pytest.mark.parametrize("stdin", [None, "closed"])
def test_closed_standard_input_is_an_error(monkeypatch, stdin):
    closed = io.StringIO()
    closed.close()
    monkeypatch.setattr(sys, "stdin", closed if stdin else None)
    with pytest.raises(FormatError, match="standard input is closed"):
        open_input("-")


@pytest.mark.parametrize(("name", "outputs"), [("none", "No such file"), (".", "Is a directory"), ("a\0b", "embedded null")])
def test_what_cannot_be_opened_is_named(tmp_path, name, outputs):
    with pytest.raises(FormatError, match=f"cannot be opened: .*{outputs}"):
        open_input(str(tmp_path / name))


def test_small_files_are_small(tmp_path):
    (tmp_path / "a").write_bytes(b"12345")
    assert read_bounded(str(tmp_path / "a"), 5) == b"12345"
    with pytest.raises(FormatError, match="larger than"):
        read_bounded(str(tmp_path / "a"), 4)
    for most, size in ((1 << 16, "66 kB"), (3 << 20, "3 MB")):
        (tmp_path / "a").write_bytes(bytes(most + 1))
        with pytest.raises(FormatError, match=f"is larger than {size},"):
            read_bounded(str(tmp_path / "a"), most)


def test_line_ends_of_old_macintosh_programs_are_named(tmp_path):
    (tmp_path / "old.log").write_bytes(b"ODOM 0 0 0 0 0 0 1 h 1\r" * 3)
    with pytest.raises(FormatError, match="its lines end in CR alone"), open_source(tmp_path / "old.log") as source:
        list(source.blocks())


@pytest.mark.parametrize("size", [1 << 16, 300_001, 1 << 21, 1 << 23])
@pytest.mark.parametrize("last", [b"", b"endless", b"after\n"])
def test_of_a_line_that_is_too_long_its_place_is_left(tmp_path, size, last):
    """Whatever the blocks are: those around it are whole, and each has its number. A block may hold it whole."""
    around, endless = [b"before %d\n" % k for k in range(1000)], b"x" * (3 << 20) + b"\n"
    lines = [*around, endless, *around, endless, *around, last.replace(b"endless", endless[:-1])]
    (tmp_path / "a.log").write_bytes(b"".join(lines))
    with open_source(tmp_path / "a.log") as source:
        found = b"".join(source.blocks(size)).splitlines()
    written = b"".join(lines).splitlines()
    short, expected = ([OVERLONG_LINE if len(line) > MAX_LINE_BYTES else line for line in some] for some in (found, written))
    assert short == expected
