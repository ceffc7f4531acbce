"""Ctrl-C while a verb runs: nothing is left half done, and none is lost."""

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Timer, main_thread
from typing import Any

_SOON = 0.02
"""s; by then Python has left the place where it drops exceptions."""


@contextmanager
def stopped_by(*signals: int) -> Iterator[list[int]]:
    """Give a list to which these signals are added as they come, in place of what they would do."""
    stopped: list[int] = []
    before = {n: signal.signal(n, lambda k, _frame: stopped.append(k)) for n in signals}
    try:
        yield stopped
    finally:
        for n, handler in before.items():
            signal.signal(n, handler)


@contextmanager
def interruptible() -> Iterator[list[int]]:
    """Let the first Ctrl-C raise KeyboardInterrupt, and a second one end the program.

    Where Python drops the exception, as it does in callbacks of its imports, it is raised again soon after. The list holds the
    signal once it came: what it interrupts in a library may come out as another error.
    """
    came: list[int] = []

    def interrupt(number: int, _frame: Any) -> None:
        if came:
            os._exit(130)
        came.append(number)
        raise KeyboardInterrupt

    try:
        before = signal.getsignal(signal.SIGINT)
        if before is signal.SIG_IGN:
            yield came
            return
        signal.signal(signal.SIGINT, interrupt)
    except ValueError:
        # Not the main thread: signals are somebody else's.
        yield came
        return
    try:
        with _raised_again(came):
            yield came
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _raised_again(came: list[int]) -> Iterator[None]:
    usual = sys.unraisablehook

    def dropped(error: Any) -> None:
        if not issubclass(error.exc_type, KeyboardInterrupt):
            usual(error)
            return
        came.clear()
        # A signal to the thread itself also ends what sleeps or waits for a device.
        timer = Timer(_SOON, signal.pthread_kill, (main_thread().ident, signal.SIGINT))
        timer.daemon = True
        timer.start()

    sys.unraisablehook = dropped
    try:
        yield
    finally:
        sys.unraisablehook = usual
