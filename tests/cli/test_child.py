"""A command in a process of its own ends with the one that started it."""

import os
import signal
import socket
import subprocess
import sys
import time

import pytest
from helpers.served import PATIENCE

from uwblite import __version__
from uwblite.cli import child as child_module
from uwblite.cli.child import Child

PARENT = "import sys; from uwblite.cli.child import Child; child = Child(sys.argv[1:]); print(flush=True); input()"


def until(answers, port):
    """Wait until somebody, or nobody, answers at a port of this computer."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        with socket.socket() as line:
            if (line.connect_ex(("127.0.0.1", port)) == 0) == answers:
                return
        time.sleep(0.02)
    pytest.fail(f"port {port}: {'nobody' if answers else 'somebody'} answers")


@pytest.mark.slow
def test_a_command_ends_with_a_parent_that_was_killed(tmp_path):
    with socket.socket() as line:
        line.bind(("127.0.0.1", 0))
        port = line.getsockname()[1]
    words = ["watch", str(tmp_path / "run.log"), "--port", str(port)]
    with subprocess.Popen([sys.executable, "-c", PARENT, *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as parent:
        until(True, port)
        parent.kill()
    until(False, port)


def test_a_command_that_does_not_end_when_asked_is_killed(monkeypatch):
    """It is over, and waited for, when `stop` returns."""
    monkeypatch.setattr(child_module, "_ENDING", 0.01)
    usual = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        stuck = Child(["watch", "run.log"])
    finally:
        signal.signal(signal.SIGTERM, usual)
    stuck.stop()
    assert stuck.code() == -signal.SIGKILL


def test_of_what_a_command_says_the_last_line_counts_or_the_error_among_it(monkeypatch):
    """Of the last 2,000 bytes; what is not text is replaced, and a line is cut."""
    child = Child(["--version"], 19)
    try:
        priority = os.getpriority(os.PRIO_PROCESS, child._process.pid)
        assert child._process.wait(PATIENCE) == child.code() == 0
        assert (priority, child.output()) == (19, f"uwblite {__version__}")
        for output, told in (
            (b"", ""),
            (b"first\nsecond\n\n", "second"),
            (b"uwblite: error: the disk is full\nand more\n", "uwblite: error: the disk is full"),
            (b"error: long ago\n" + b"x" * 2000, "x" * 400),
            (b"\xff\n", "\ufffd"),
        ):
            child._output.seek(0)
            child._output.truncate()
            child._output.write(output)
            child._output.flush()
            assert child.output() == told
    finally:
        child.stop()
