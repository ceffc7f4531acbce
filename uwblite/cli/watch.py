"""`uwblite watch`: the map of a recording while it grows, on a local page."""

import argparse
import os
import signal
import time
from contextlib import suppress

from ..errors import ConfigError, UwbliteError
from ..io.carmen_live import LogTail
from ..io.results import check_target
from ..io.stored_result import StoredResult, read_result
from ..server.live import LivePage, watch_status
from ..server.rounds import Round, next_thinning
from . import console
from .child import Child
from .inputs import effective_config, mounting_words
from .serving import serving

_STEP = 1.0
"""s between looks at the log."""
_OWN_NICENESS, _NICENESS = 5, 19
"""Of the page and of the rounds: the recorder comes first."""
_LONGEST = 1800.0
"""s after which a round has failed."""


def run(args: argparse.Namespace) -> int:
    effective_config(args)
    folder = _folder(args)
    page = LivePage(f"uwblite watch {os.path.basename(args.log)}")
    watch = Watch(args.log, folder, page, map_options(args))
    with serving(page, args.host, args.port) as address:
        try:
            with suppress(OSError, AttributeError):
                os.nice(_OWN_NICENESS)
            with suppress(ValueError):  # not the main thread: signals are somebody else's
                signal.signal(signal.SIGTERM, signal.default_int_handler)
            console.say(f"open {address} in a browser; Ctrl-C ends it")
            console.note(f"uwblite: the latest map is in {folder}")
            console.flush()
            while True:
                watch.step(time.monotonic())
                time.sleep(_STEP)
        except KeyboardInterrupt:
            console.note("uwblite: the page has ended")
        finally:
            watch.close()
    return 0


def _folder(args: argparse.Namespace) -> str:
    """Return where the maps go, refusing what cannot be watched."""
    if args.log == "-" or args.log.endswith(".gz"):
        raise ConfigError(f"{args.log} does not grow in a way that can be followed; name the plain log that is being written")
    if os.path.exists(args.log) and not os.path.isfile(args.log):
        what = "a folder" if os.path.isdir(args.log) else "a pipe or a device, and only a file can be followed"
        raise ConfigError(f"{args.log} is {what}; name the log that is being written")
    folder = args.out or f"{os.path.splitext(args.log)[0]}_watch"
    check_target(folder, force=args.force or not args.out)
    return str(folder)


def map_options(args: argparse.Namespace) -> list[str]:
    words = [f"--set={value}" for value in args.set]
    words += [f"--{name}={value}" for name in ("preset", "config") if (value := getattr(args, name))]
    return words + mounting_words(args)


class Watch:
    """The log, its rounds and what the page shows of them; a map of an earlier watch is shown at once."""

    def __init__(self, log: str, folder: str, page: LivePage, options: list[str]) -> None:
        self.tail, self.folder, self.page, self.options = LogTail(log), folder, page, options
        self.result: StoredResult | None = None
        self.last: Round | None = None
        self._job: Child | None = None
        self._job_began = self._job_recorded = self._job_cost = 0.0
        self._job_nth, self._failure = 1, ""
        self._mapped_at = self._grown = float("-inf")
        self._restarts = 0
        self._read_result(float("-inf"))

    def step(self, now: float) -> None:
        """Look at the log and the running round, begin another where it is due, and show what there is."""
        self._follow(now)
        if self.tail.restarts != self._restarts:
            self._forget()
        self._collect(now)
        if self._job is None:
            nth = next_thinning(self.last, self.tail.seconds, now, now - self._grown)
            if nth is not None:
                self._launch(nth, now)
        self.page.show_status(watch_status(self.tail, self.result, max(now - self._grown, 0.0), self._rounds(now)))

    def close(self) -> None:
        if self._job is not None:
            self._job.stop()

    def _follow(self, now: float) -> None:
        """Read what is new; what has grown before the first look is as old as the file says."""
        first = self._grown == float("-inf")
        grown = False
        while self.tail.poll():
            grown = True
        if grown:
            self._grown = now - (_age(self.tail.path) if first else 0.0)
        elif first:
            self._grown = now

    def _forget(self) -> None:
        """Leave the map of a log that is no more."""
        self._restarts = self.tail.restarts
        if self._job is not None:
            self._job.stop()
        self._job = self.last = self.result = None
        self._failure = ""
        self.page.show_map(None)

    def _launch(self, nth: int, now: float) -> None:
        words = ["map", self.tail.path, "--out", self.folder, "--force", "-q", "--every-nth-scan", str(nth), *self.options]
        self._job_began, self._job_recorded, self._job_nth = now, self.tail.seconds, nth
        self._job_cost = _spent_on_rounds(now)
        try:
            self._job = Child(words, _NICENESS)
        except OSError as error:
            self._ended(now, str(error))

    def _collect(self, now: float) -> None:
        if self._job is None:
            return
        code = self._job.code()
        if code is None and now - self._job_began > _LONGEST:
            self._job.stop()
            self._ended(now, f"it took more than {_LONGEST / 60:.0f} minutes")
        elif code in (0, 3):
            self._ended(now, self._read_result(now))
        elif code is not None:
            self._ended(now, self._job.output().removeprefix("uwblite: error: ") or f"exit code {code}")

    def _ended(self, now: float, failure: str) -> None:
        self._job, self._failure = None, failure
        self.last = Round(now, _spent_on_rounds(now) - self._job_cost, self._job_recorded, self._job_nth, bool(failure))

    def _read_result(self, now: float) -> str:
        """Show the map in the folder; return why it cannot be shown, where it is so."""
        if not os.path.isfile(os.path.join(self.folder, "trajectory.tum")):
            return "there is no map"
        try:
            self.result = read_result(self.folder)
        except (UwbliteError, OSError) as error:
            return str(error)
        self._mapped_at = now
        self.page.show_map(self.result)
        return ""

    def _rounds(self, now: float) -> str:
        """Return words about the latest map and the round that runs."""
        words = []
        if self.result is not None:
            span = float(self.result.trajectories[-1][0][-1] - self.result.trajectories[-1][0][0])
            made = f"made {now - self._mapped_at:.0f} s ago" if now - self._mapped_at < 1e6 else "made by an earlier watch"
            words.append(f"map of {span:.0f} s, {made}")
        if self._failure:
            words.append(f"the last round failed: {self._failure}")
        if self._job is not None:
            words.append("mapping ...")
        return "; ".join(words)


def _spent_on_rounds(now: float) -> float:
    """Return the processor time of the rounds that have ended, s; the time of the clock where the system does not count it."""
    try:
        import resource
    except ImportError:
        return now
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _age(path: str) -> float:
    """Return how long ago a file was written, s; 0 where that is not known."""
    try:
        return max(time.time() - os.stat(path).st_mtime, 0.0)
    except OSError:
        return 0.0
