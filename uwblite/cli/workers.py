"""Who does the heavy work: this process, several of this computer, or a cluster of dask.distributed."""

import os
import platform
import signal
import time
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from threading import Thread
from typing import Any

import numpy
import scipy

from .. import __version__
from ..errors import ConfigError
from ..io.optional_packages import missing_package
from . import console

_PARENT_LOOK = 1.0
"""s between looks at whether the main process lives."""
_SECONDS_TO_CONNECT = 10
"""A scheduler that runs answers within milliseconds."""


@contextmanager
def workers(jobs: int, scheduler: str = "") -> Iterator[Executor | None]:
    """Give an executor: the scheduler's workers, so many processes, or, for one job, none."""
    if scheduler:
        with cluster(scheduler) as executor:
            yield executor
    elif jobs == 1:
        yield None
    else:
        with processes(jobs) as executor:
            yield executor


@contextmanager
def processes(jobs: int) -> Iterator[Executor]:
    """Start so many processes; what waits is dropped at the end, and what runs too where an exception ends it."""
    from multiprocessing import active_children

    executor = ProcessPoolExecutor(jobs, initializer=_begin)
    try:
        yield executor
    except BaseException:
        # Each worker has been handed another task already, which cannot be taken back: Ctrl-C would wait for all of them.
        for child in active_children():
            child.terminate()
        raise
    finally:
        executor.shutdown(cancel_futures=True)


@contextmanager
def cluster(address: str) -> Iterator[Executor]:
    """Connect to a scheduler, whose workers must have this uwblite.

    Raises
    ------
    ConfigError : dask.distributed is missing, no scheduler answers, or a worker has no uwblite or another one.
    """
    try:
        from distributed import Client
    except ImportError:
        raise missing_package("distributed", "--scheduler") from None
    try:
        client = Client(address, timeout=_SECONDS_TO_CONNECT)
    except (OSError, ValueError, TimeoutError) as error:
        reason = str(error) or type(error).__name__
        raise ConfigError(f"no scheduler answers at {address} ({reason}); `dask scheduler` starts one") from None
    try:
        _compare_versions(client)
        with client.get_executor(pure=False) as executor:
            yield executor
    finally:
        client.close()


def _compare_versions(client: Any) -> None:
    """Refuse workers whose uwblite is another one; other libraries may change the last digits, which is said."""
    local = versions()
    answers = client.run(versions, on_error="return")
    if not answers:
        console.note("uwblite: the scheduler has no worker yet; waiting for one (`dask worker ADDRESS`)")
    for worker, remote in answers.items():
        if isinstance(remote, BaseException):
            raise ConfigError(f"worker {worker} cannot import this uwblite ({remote}); install it there")
        if remote["uwblite"] != local["uwblite"]:
            raise ConfigError(f"worker {worker} has uwblite {remote['uwblite']}, this is {local['uwblite']}; install the same")
        if remote != local:
            differ = ", ".join(f"{name} {remote[name]} for {local[name]}" for name in local if remote[name] != local[name])
            console.note(f"uwblite: worker {worker} has {differ}: last digits may differ")


def versions() -> dict[str, str]:
    """Return the versions of uwblite, Python and the libraries that results depend on."""
    return {"uwblite": __version__, "Python": platform.python_version(), "numpy": numpy.__version__, "scipy": scipy.__version__}


def _begin() -> None:
    """Let Ctrl-C reach the main process alone, which stops the workers; end where it was killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this process once its parent has: nobody else would ever tell a worker that waits for work."""
    parent = os.getppid()
    while os.getppid() == parent:
        time.sleep(_PARENT_LOOK)
    os._exit(1)
