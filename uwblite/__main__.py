"""``python -m uwblite`` and the command ``uwblite``.

This file and the package's ``__init__`` import nothing that Python has not loaded yet: until the handler below is set, Ctrl-C
ends in a traceback. (``signal`` builds classes for all its numbers, milliseconds; ``_signal`` is what it wraps.) The number
of threads of numerical libraries, and the size of their pages, are set before they are imported.
"""

import _signal as signal  # type: ignore[import-not-found]
import os
import sys


def _leave(_number: int, _frame: object) -> None:
    try:
        os.write(2, b"uwblite: interrupted\n")
    finally:
        os._exit(130)


def start() -> int:
    """Run the command line; Ctrl-C while nothing has begun, or once all is done, ends it without a traceback.

    Numerical libraries have one thread, unless the environment says otherwise: the matrices here are small, so that threads
    wait for each other, and how a sum is divided among them changes its last digits. Pages of arrays are not huge: of a large
    map, of which most cells are never met, each page is used only where something is.
    """
    for library in ("OPENBLAS", "OMP", "MKL"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    os.environ.setdefault("NUMPY_MADVISE_HUGEPAGE", "0")
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _leave)
    from .cli import main

    return main()


if __name__ == "__main__":
    sys.exit(start())
