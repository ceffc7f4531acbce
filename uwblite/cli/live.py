"""`uwblite localize --live`: the pose as JSON lines while a robot drives."""

import argparse
import json
import math
import os
import select
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from ..errors import UsageError
from ..io.log_parts import GrowingFile
from ..io.source import open_input
from ..io.stored_result import StoredResult, read_result
from ..localization import LocalizerState
from ..localization.known_map import KnownMap, from_result
from ..localization.live_feed import LiveFeed, Patience
from ..server.live import MOST_ALTERNATIVES, LivePage, PoseStatus
from . import console
from .inputs import mounted
from .interruption import stopped_by
from .serving import serving

DEVICES = ("odometry", "lidar", "uwb", "gyro")


def run_live(args: argparse.Namespace) -> int:
    devices = any(getattr(args, name) for name in DEVICES)
    if devices == bool(args.log):
        raise UsageError("--live needs either a log to follow (- = standard input) or devices: --odometry, --lidar, --uwb")
    for name in ("out", "picture", "covariance"):
        if getattr(args, name):
            raise UsageError(f"--{name} belongs to a recording that has ended; --live writes lines to stdout")
    result = read_result(args.map)
    known = from_result(result)
    tell_doubts(result)
    _tell_map(known)
    tracker = Tracker(known, args)
    with _shown(result, tracker, args.serve):
        return _track(tracker, args, devices)


def _track(tracker: "Tracker", args: argparse.Namespace, devices: bool) -> int:
    with stopped_by(signal.SIGINT, signal.SIGTERM) as stopped:
        if devices:
            from .record import record_into

            record_into(args, tracker.take, lambda: bool(stopped), tracker.wait)
        else:
            pieces = _stdin() if args.log == "-" else _growing(args.log, args.idle, lambda: bool(stopped))
            for data in pieces:
                tracker.take(data) if data else tracker.wait()
                if stopped:
                    break
    return tracker.ended(signal.SIGINT in stopped)


class Tracker:
    def __init__(self, known: KnownMap, args: argparse.Namespace) -> None:
        self.state: LocalizerState | None = None
        self.on_state: Callable[[LocalizerState], None] = lambda _: None
        patience = Patience(args.late, args.lost_after)
        self._feed = LiveFeed(known, lambda own: mounted(own, args), lambda line: console.note(f"uwblite: {line}"), patience)
        self._clock = time.monotonic
        self._heard = self._waited = self._clock()
        self._period = 0.999 / args.rate
        self._said, self._was_lost = -float("inf"), True

    def take(self, data: bytes) -> None:
        for state in self._feed.take(data):
            self._say(state)
        self._heard = self._clock()

    def wait(self) -> None:
        """Say how old the pose is, once a second, where nothing comes."""
        now = self._clock()
        if now - max(self._waited, self._heard) < _WAITING:
            return
        self._waited = now
        for state in self._feed.wait(now - self._heard):
            self._say(state)

    def _say(self, state: LocalizerState) -> None:
        self.state = state
        if not state.stamp > -float("inf"):
            return
        self.on_state(state)
        soon = self._said <= state.stamp < self._said + self._period and state.lost == self._was_lost
        if soon and not state.age:
            return
        self._said, self._was_lost = state.stamp, state.lost
        console.say_lines(line_of(state))
        console.flush()

    def ended(self, interrupted: bool) -> int:
        """Say what was left out and return the exit code."""
        for state in self._feed.end():
            self._say(state)
        if interrupted:
            return 130
        if self.state is None:
            console.note("uwblite: warning: the log holds no measurement")
        return 0 if self.state is not None and not self.state.lost else 3


@contextmanager
def _shown(result: StoredResult, tracker: Tracker, where: tuple[str, int] | None) -> Iterator[None]:
    """Show the poses on a page, where one is wanted, until the block ends."""
    if where is None:
        yield
        return

    page, status = LivePage(f"uwblite localize: {result.folder.name}"), PoseStatus()
    page.show_map(result, paths=False)
    page.show_status(status.nothing)

    def show(state: LocalizerState) -> None:
        if (news := status.take(state)) is not None:
            page.show_status(news)

    tracker.on_state = show
    with serving(page, *where) as address:
        console.note(f"uwblite: open {address} in a browser")
        yield


def line_of(state: LocalizerState) -> str:
    """Return a state as one line of JSON; numbers that are not known are null."""
    fields: dict[str, Any] = {
        "stamp": round(state.stamp, 6),
        "pose": _rounded(state.pose.tolist()),
        "covariance": [[float(f"{v:.4g}") for v in row] for row in state.covariance.tolist()],
        "quality": round(state.quality, 3),
        "lost": state.lost,
        "age": round(state.age, 1),
        "odometry": _rounded(state.odometry.tolist()),
    }
    if state.reason:
        fields["reason"] = state.reason
    if len(state.alternatives):
        fields["alternatives"] = [[round(v, 3) for v in row] for row in state.alternatives[:MOST_ALTERNATIVES].tolist()]
    if state.silent:
        fields["silent"] = {name: round(age, 1) for name, age in state.silent.items()}
    if state.moved_anchors:
        fields["moved_anchors"] = list(state.moved_anchors)
    return json.dumps(console.plain(fields), allow_nan=False)


def _rounded(pose: list[float]) -> list[float] | None:
    """Return a pose (3,) as a line has it: m, m, rad; None where it is not known."""
    return [round(v, 5) for v in pose] if math.isfinite(sum(pose)) else None


def tell_doubts(result: StoredResult) -> None:
    """Say where a map was doubted when it was made: poses in it are no better."""
    doubts = result.report.get("doubts")
    for doubt in doubts if isinstance(doubts, list) else []:
        text = doubt.get("text") if isinstance(doubt, dict) else doubt
        console.note(f"uwblite: warning: the map is doubted: {text}")


def _tell_map(known: KnownMap) -> None:
    if not known.anchors.ids:
        console.note("uwblite: warning: the map has no anchor with a place: the robot is localised by the walls alone")
    if known.walls is None:
        console.note("uwblite: warning: the map has no grid: the robot is localised by the anchors alone")


def _stdin() -> Iterator[bytes]:
    """Yield what standard input holds, as it comes, and nothing from time to time where nothing comes."""
    stream = open_input("-")
    while True:
        if not select.select([stream], [], [], _WAITING)[0]:
            yield b""
        elif data := os.read(stream.fileno(), 1 << 16):
            yield data
        else:
            return


def _growing(path: str, idle: float | None, stopping: Callable[[], bool]) -> Iterator[bytes]:
    """Yield what a log holds and what is added to it, and nothing where nothing is."""
    file = GrowingFile(path)
    if file.skipped:
        console.note(f"uwblite: {file.skipped / 1e6:.1f} MB of {path} lie further back and are not read")
    quiet = 0.0
    try:
        while not stopping():
            data = file.read()
            if data:
                quiet = 0.0
                yield data
                continue
            if idle is not None and quiet >= idle:
                return
            yield b""
            sys.stdout.flush()
            time.sleep(_PAUSE)
            quiet += _PAUSE
    finally:
        file.close()


_PAUSE, _WAITING = 0.05, 1.0
"""s between looks at a log that does not grow, and between lines that say how old the pose is."""
