"""`uwblite` at work in a process of its own, for a page or a recorder.

Its standard input is a pipe that nobody writes to: where that ends, whoever started it is no more, however it came to its
end, and the process ends as well. This module is what the process runs.
"""

import os
import runpy
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from threading import Thread

_ENDING = 10.0
"""s that a process has to end in when it is asked to."""


class Child:
    """A command that runs until its end, or that of the process that made this; at niceness 19 when nobody else wants to."""

    def __init__(self, words: Sequence[str], niceness: int = 0) -> None:
        root = Path(__file__).resolve().parents[__name__.count(".")]
        path = os.pathsep.join(filter(None, (str(root), os.environ.get("PYTHONPATH"))))
        self._output = tempfile.TemporaryFile("w+b")  # noqa: SIM115
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__, *words],
            stdin=subprocess.PIPE,
            stdout=self._output,
            stderr=subprocess.STDOUT,
            env={**os.environ, "PYTHONPATH": path},
        )
        if niceness and hasattr(os, "setpriority"):
            with suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, self._process.pid, niceness)

    def code(self) -> int | None:
        """Return its exit code; None while it runs."""
        return self._process.poll()

    def output(self) -> str:
        """Return the last line of its output."""
        size = os.fstat(self._output.fileno()).st_size
        tail = os.pread(self._output.fileno(), 2000, max(size - 2000, 0)).decode(errors="replace").strip()
        errors = [line for line in tail.splitlines() if "error:" in line]
        return (errors or tail.splitlines() or [""])[-1][:400]

    def stop(self) -> None:
        self._process.terminate()
        try:
            self._process.wait(_ENDING)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def _end_with_parent() -> None:
    with suppress(OSError):
        while os.read(0, 1):
            pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    Thread(target=_end_with_parent, daemon=True).start()
    runpy.run_module((__package__ or "uwblite.cli").rpartition(".")[0], run_name="__main__")
