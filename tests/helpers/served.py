"""A verb that serves a page, as a process, until a block ends."""

import re
import signal
import subprocess
import sys

from conftest import ROOT

PATIENCE = 120
"""s after which a program that does not end counts as hanging: a loaded computer is slow."""


AT_ONCE = "import os, runpy; del os.nice, os.setpriority; runpy.run_module('uwblite', run_name='__main__', alter_sys=True)"
"""As `python -m uwblite`, at the priority of the tests: at the lowest, other tests would leave it no processor for minutes."""


class Served:
    """The program at work: `address` of its page; `code`, its exit code after Ctrl-C at the end of the block."""

    def __init__(self, verb, *words, cwd=None):
        self.process = subprocess.Popen(
            [sys.executable, "-c", AT_ONCE, verb, *words], cwd=cwd,
            env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(ROOT)},
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        self.address = re.search(r"http://127\.0\.0\.1:\d+/", self.process.stdout.readline()).group()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.send_signal(signal.SIGINT)
        self.code = self.process.wait(timeout=PATIENCE)
