"""Output of the command line: results on stdout, everything else on stderr, a progress bar on a terminal.

A reader that leaves early (``uwblite map ... | head -1``) does not stop the work: what it no longer reads is dropped. Nor
does a full disk behind stdout, which is reported at the end. No line has what a terminal would obey, whatever a file's name.
"""

import errno
import json
import logging
import os
import sys
import time
import traceback
from collections.abc import Iterable
from typing import Any, TextIO

from ..report.printable import duration, json_ready, printable
from .options import name_options

_LOGGER = logging.getLogger("uwblite")


class _Console:
    """The one place that holds the state of this process's output."""

    def __init__(self) -> None:
        self.quiet = False
        self.bar: Progress | None = None
        self.lost = ""
        """Why stdout did not take what was written; empty = it did."""


_CONSOLE = _Console()


def set_up(*, quiet: bool = False, verbose: int = 0) -> None:
    """Choose how much is written; log records of the package go to stderr."""
    _CONSOLE.quiet = quiet
    level = logging.ERROR if quiet else (logging.WARNING, logging.INFO, logging.DEBUG)[min(verbose, 2)]
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("uwblite: %(message)s"))
    _LOGGER.handlers[:] = [handler]
    _LOGGER.setLevel(level)


def say(text: str = "") -> None:
    """Write one line of the result to stdout."""
    say_lines(printable(name_options(text)))


def say_lines(text: str) -> None:
    """Write lines of our own making to stdout."""
    _clear_bar()
    write(sys.stdout, text + "\n")


def report(as_json: bool, figures: Any, lines: Iterable[str]) -> None:
    """Write a result to stdout, as one JSON object or as lines of text."""
    if as_json:
        say_json(figures)
    else:
        for line in lines:
            say(line)


def note(text: str) -> None:
    """Write one line beside the result to stderr; --quiet drops it."""
    if not _CONSOLE.quiet:
        _clear_bar()
        write(sys.stderr, printable(name_options(text)) + "\n")


def note_of(name: str, warnings: Iterable[str]) -> None:
    """Write what is odd about a file, a line each, to stderr."""
    for warning in warnings:
        note(f"uwblite: {name}: {warning}")


def fail(text: str, code: int, *, trace: bool = False) -> int:
    """Write one line about what went wrong to stderr and return the exit code."""
    _clear_bar()
    if trace:
        write(sys.stderr, traceback.format_exc())
    head = "uwblite: " if code == 130 else "uwblite: error: "
    write(sys.stderr, head + printable(name_options(" ".join(text.split()))) + "\n")
    return code


def os_error_text(error: OSError) -> str:
    """Return one line about an error of the operating system, with the way out where it is known."""
    reason = error.strerror or str(error) or type(error).__name__
    if error.filename is None and _folder_is_gone():
        return "the current folder is no more; go to one that is there, or name whole paths"
    where = f"{error.filename}: " if error.filename else ""
    hint = {
        "ENOSPC": "; free some space, or write to another disk with --out",
        "EACCES": "; check who owns it, or choose another place",
        "EROFS": "; choose a place that can be written to",
        "ENOENT": "; check the spelling",
    }.get(errno.errorcode.get(error.errno or 0, ""), "")
    return f"{where}{reason}{hint}"


def _folder_is_gone() -> bool:
    try:
        os.getcwd()
    except OSError:
        return True
    return False


def flush() -> bool:
    """Push out what was written; False where stdout could not take it (disk full, not a closed pipe)."""
    _flush(sys.stdout)
    _flush(sys.stderr)
    lost, _CONSOLE.lost = _CONSOLE.lost, ""
    if lost:
        write(sys.stderr, f"uwblite: error: stdout: {lost}\n")
    return not lost


def write(stream: TextIO, text: str) -> None:
    """Write text as it is; a stream that cannot take it gets nothing from then on (see `flush`)."""
    try:
        stream.write(text)
    except UnicodeEncodeError:
        encoding = stream.encoding or "ascii"
        stream.write(text.replace("\u00b1", "+-").encode(encoding, "replace").decode(encoding))
    except OSError as error:
        _drop(stream, error)


def _flush(stream: TextIO) -> None:
    try:
        stream.flush()
    except OSError as error:
        _drop(stream, error)


def _drop(stream: TextIO, error: OSError) -> None:
    """Send the rest of a stream that nobody reads to nowhere."""
    if stream is sys.stdout and not isinstance(error, BrokenPipeError):
        _CONSOLE.lost = os_error_text(error)
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    except (OSError, ValueError):
        return


def _clear_bar() -> None:
    if _CONSOLE.bar is not None:
        _CONSOLE.bar.clear()


class Progress:
    """A progress bar on stderr, with the time left; silent where stderr is not a terminal.

    Call it as ``progress(stage, done, total)``: the signature that ``build_map`` asks for. The time left is that of the
    stage, or of all stages where their share that is done is given as well.
    """

    def __init__(self, stream: TextIO | None = None, clock: Any = time.monotonic) -> None:
        self.first = clock()
        self.stream = sys.stderr if stream is None else stream
        self.clock = clock
        self.active = self.stream.isatty() and not _CONSOLE.quiet
        self.stage, self.began, self.shown = "", 0.0, -1.0
        self.width = 0
        if self.active:
            _CONSOLE.bar = self

    def __call__(self, stage: str, done: int, total: int, share: float | None = None) -> None:
        """Show that `done` of `total` steps of a stage are behind us, and which share, 0..1, of all stages."""
        if not self.active:
            return
        now = self.clock()
        if stage != self.stage:
            self.clear()
            self.stage, self.began, self.shown = stage, now, -1.0
        if now - self.shown < 0.1 and done < total:
            return
        self.shown = now
        part, since = (done / total if total > 0 else None, self.began) if share is None else (share, self.first)
        self._draw(progress_line(stage, part, now - since))

    def _draw(self, line: str) -> None:
        line = printable(line)[: self._columns() - 1]
        write(self.stream, "\r" + line + " " * (self.width - len(line)))
        _flush(self.stream)
        self.width = len(line)

    def _columns(self) -> int:
        try:
            return os.get_terminal_size(self.stream.fileno()).columns or 80
        except (OSError, ValueError):
            return 80

    def clear(self) -> None:
        """Wipe the bar, so that a line can be written in its place."""
        if self.active and self.width:
            write(self.stream, "\r" + " " * self.width + "\r")
            _flush(self.stream)
            self.width = 0

    def close(self) -> None:
        """Wipe the bar for good."""
        self.clear()
        if _CONSOLE.bar is self:
            _CONSOLE.bar = None


def progress_line(stage: str, share: float | None, elapsed: float) -> str:
    """Return the text of a progress bar; share 0..1 is done, None = not known, since the work began that long ago, s."""
    if share is None:
        return f"{stage} ..."
    share = min(max(share, 0.0), 1.0)
    left = f"  about {duration(elapsed / share - elapsed)} left" if 0.05 < share < 1.0 and elapsed > 2.0 else ""
    return f"[{'#' * int(20 * share):<20}] {100 * share:3.0f} %  {stage}{left}"


def say_json(value: Any) -> None:
    """Write one JSON object to stdout; numbers that are not finite become null."""
    say_lines(json.dumps(plain(value), indent=2, allow_nan=False))


def plain(value: Any) -> Any:
    """Return a value as JSON has it, with options in its texts in place of the settings that these name."""
    return json_ready(value, text=name_options)
