"""A log is followed as it grows, goes on in its next part, or begins again."""

import os

import pytest

from uwblite.errors import FormatError
from uwblite.io.log_parts import HEAD_BYTES, TAIL_BYTES, GrowingFile


def test_what_is_added_is_read(tmp_path):
    path = tmp_path / "run.log"
    path.write_bytes(b"one\n")
    file = GrowingFile(str(path))
    assert file.read() == b"one\n"
    assert file.read() == b""
    with path.open("ab") as more:
        more.write(b"two")
    assert file.read() == b"two"
    path.write_bytes(b"3\n")
    assert file.read() == b"3\n"


def test_a_long_log_begins_near_its_end_with_the_params_of_its_head(tmp_path):
    path = tmp_path / "run.log"
    line = b"ODOM 1 2 3\n"
    text = b"PARAM a 1\nODOM old\nPARAM b 2\n" + line * ((HEAD_BYTES + 2 * TAIL_BYTES) // len(line))
    path.write_bytes(text)
    file = GrowingFile(str(path))
    assert file.skipped == len(text) - HEAD_BYTES - TAIL_BYTES
    assert file.read() == b"PARAM a 1\nPARAM b 2\n# "
    rest = b"".join(iter(file.read, b""))
    assert rest == text[-TAIL_BYTES:]


def test_it_goes_on_in_the_next_part(tmp_path):
    (tmp_path / "run.log").write_bytes(b"COMMENT continued in run.2.log\n")
    file = GrowingFile(str(tmp_path / "run.log"))
    assert file.read() == b"COMMENT continued in run.2.log\n"
    assert file.read() == b""
    (tmp_path / "run.2.log").write_bytes(b"more\n")
    assert file.read() == b"more\n"
    assert file.read() == b""
    assert file.restarts == 0
    file.close()


def test_no_file_is_one_clear_error(tmp_path):
    with pytest.raises(FormatError, match="cannot be followed"):
        GrowingFile(str(tmp_path / "none.log"))


def test_another_file_in_its_place_is_read_from_its_beginning(tmp_path):
    path = tmp_path / "run.log"
    path.write_bytes(b"one and more\n")
    file = GrowingFile(str(path), whole=True)
    assert file.read() == b"one and more\n"
    path.rename(tmp_path / "old.log")
    assert file.read() == b""
    path.write_bytes(b"another, which is longer than the first\n")
    assert file.read() == b"another, which is longer than the first\n"
    assert file.read() == b""
    assert file.restarts == 1
    path.write_bytes(b"x\n")
    assert file.read() == b"x\n"
    assert file.restarts == 2


def test_whole_is_whole(tmp_path):
    path = tmp_path / "run.log"
    text = b"ODOM 1 2 3\n" * ((HEAD_BYTES + 2 * TAIL_BYTES) // 11)
    path.write_bytes(text)
    file = GrowingFile(str(path), whole=True)
    assert file.skipped == 0
    assert b"".join(iter(file.read, b"")) == text


@pytest.mark.parametrize("kind", ["pipe", "folder"])
def test_only_a_file_is_followed_and_nothing_waits_for_a_pipe(tmp_path, kind):
    odd, log, part = tmp_path / "odd", tmp_path / "run.log", tmp_path / "run.2.log"
    os.mkfifo(odd) if kind == "pipe" else odd.mkdir()
    with pytest.raises(FormatError, match=r"odd: cannot be followed: "):
        GrowingFile(str(odd))
    log.write_bytes(b"one\nCOMMENT continued in run.2.log\n")
    os.mkfifo(part) if kind == "pipe" else part.mkdir()
    file = GrowingFile(str(log))
    assert file.read().startswith(b"one")
    assert file.read() == b""
    log.unlink()
    odd.rename(log)
    assert file.read() == b""
