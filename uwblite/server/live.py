"""A page that shows a map and what happens on it now: `uwblite watch`, and a robot that is being localised."""

import json
import math
import os
import threading
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from ..io.carmen_live import LogTail, Sensor
from ..io.stored_result import StoredResult
from ..localization.live_feed import CONSEQUENCES, NO_ODOMETRY
from ..localization.pose_estimator import LocalizerState
from ..report.drawn_map import ellipse
from ..report.svg_map import map_svg
from .advice import SensorState, advice, silent_after
from .pages import live_page
from .shown_results import drawn_result, grid_png, shown_anchors, shown_head
from .web import HTML, PNG, Page, Response

_PATIENCE = 10.0
"""s of silence after which a line goes out all the same: it shows who has left, and keeps lines open in between."""
_EVERY = 0.2
"""s between states of a robot that are shown."""
_TRAIL = 300
"""Points of the way that is shown: since the latest map, or in the last minute."""
MOST_ALTERNATIVES = 8
"""Places where a robot may be that are shown."""


class Feed:
    """Named values, each with its latest state, as server-sent events (HTML Living Standard, section 9.2).

    Threads may publish and listen at will. A listener who is slow gets the latest state and not all that were in between.
    """

    def __init__(self) -> None:
        self._news = threading.Condition()
        self._latest: dict[str, tuple[int, bytes]] = {}
        self._count = 0
        self._closed = False

    def publish(self, name: str, value: Any) -> None:
        """Give a value its new state; what is as before is not sent again."""
        message = f"event: {name}\ndata: {json.dumps(value, allow_nan=False)}\n\n".encode()
        with self._news:
            if self._latest.get(name, (0, b""))[1] != message:
                self._count += 1
                self._latest[name] = (self._count, message)
                self._news.notify_all()

    def close(self) -> None:
        with self._news:
            self._closed = True
            self._news.notify_all()

    def events(self, patience: float = _PATIENCE) -> Iterator[bytes]:
        """Yield the state of all values and then whatever is new, until the feed is closed."""
        seen = 0
        yield b"retry: 2000\n\n"
        while True:
            with self._news:
                if not self._closed and self._count == seen:
                    self._news.wait(patience)
                if self._closed:
                    return
                news = sorted(v for v in self._latest.values() if v[0] > seen)
                seen = self._count
            yield b"".join(message for _, message in news) or b": still here\n\n"


class LivePage(Page):
    """The page's state; threads may show and serve at will."""

    def __init__(self, title: str) -> None:
        super().__init__()
        self.feed = Feed()
        self._title = title
        self._picture: bytes | None = None
        self._maps = 0

    def show_map(self, result: StoredResult | None, *, paths: bool = True) -> None:
        """Show another map, or with None no map any more; its paths only where they are wanted."""
        if result is None:
            self._picture = None
            empty = {"svg": "", "anchors": [], "doubts": [], "warnings": [], "accepted": 0, "candidates": 0}
            self.feed.publish("map", empty)
            return
        self._picture = grid_png(result)
        self._maps += 1
        drawn = replace(drawn_result(result), closures=())
        svg = map_svg(drawn if paths else replace(drawn, paths=()), f"/grid.png?{self.token[:8]}-{self._maps}")
        self.feed.publish("map", shown_head(result) | {"svg": svg, "anchors": shown_anchors(result)})

    def show_status(self, status: Mapping[str, Any]) -> None:
        """Show the present state: summary, advice, sensors, pose, trail; see `watch_status`."""
        self.feed.publish("status", dict(status))

    def get(self, path: str) -> Response | None:
        """Return the page, its events or the picture of its grid."""
        if path == "/":
            return Response(HTML, live_page(self._title).encode())
        if path == "/events":
            return Response("text/event-stream", b"", stream=self.feed.events)
        return Response(PNG, self._picture) if path == "/grid.png" and self._picture is not None else None


def watch_status(tail: LogTail, result: StoredResult | None, at_rest: float, rounds: str) -> dict[str, Any]:
    """Return the present content of the page of a log that is being written.

    Parameters
    ----------
    result : the latest map.
    at_rest : s since the log has grown.
    rounds : words about the latest map and the next.
    """
    sensors = {name: _state_of(sensor, tail.last) for name, sensor in sorted(tail.sensors.items())}
    anchors = {name: tail.last - sensor.last for name, sensor in tail.anchors.items()}
    summary = f"{os.path.basename(tail.path)}: {tail.seconds:.0f} s, {tail.bytes / 1e6:.1f} MB"
    summary += f", {tail.broken} broken lines" if tail.broken else ""
    summary += ", begun again" if tail.restarts else ""
    summary += "" if tail.is_file else "; a pipe, a device or a folder now has its name, and only a file can be followed"
    trail = None if result is None else result.trail(*tail.odometry(), _TRAIL)
    return {
        "summary": summary,
        "rounds": rounds,
        "advice": advice(sensors, anchors, tail.seconds, at_rest, result),
        "sensors": [
            {"name": name, "count": s.count, "rate": 0.0 if late else round(s.rate, 1), "silent": round(s.silent), "late": late}
            for name, s in sensors.items()
            for late in [s.silent > silent_after(s)]
        ],
        "anchors": {name: round(sensor.rate(tail.last), 1) for name, sensor in tail.anchors.items()},
        "pose": None if trail is None else trail[-1].round(3).tolist(),
        "trail": [] if trail is None else trail[:, :2].round(2).tolist(),
    }


def _state_of(sensor: Sensor, now: float) -> SensorState:
    """Return what came from a sensor; of a silent one the rate is the one that it had."""
    return SensorState(sensor.count, sensor.rate(sensor.last), now - sensor.last)


class PoseStatus:
    """The content of the page of a robot that is being localised: thins the states out, and remembers the way."""

    nothing: ClassVar[dict[str, Any]] = {
        "pose": None,
        "summary": "no data yet",
        "advice": ["the pose is not known: nothing has come in yet; is the recorder running, and is this its log?"],
    }
    """What there is to show before the first state."""

    def __init__(self) -> None:
        self._trail: deque[list[float]] = deque(maxlen=_TRAIL)
        self._shown = -math.inf

    def take(self, state: LocalizerState) -> dict[str, Any] | None:
        """Return what there is to show of a state; None where the last one will do."""
        if 0.0 <= state.stamp - self._shown < _EVERY and not state.age:
            return None
        self._shown = state.stamp
        known = bool(np.isfinite(state.pose).all())
        if state.lost:
            self._trail.clear()
        elif known:
            self._trail.append(state.pose[:2].round(2).tolist())
        axes, variance = ellipse(state.covariance[:2, :2]), float(np.trace(state.covariance[:2, :2]))
        place = f", known to {math.sqrt(variance):.2f} m" if axes is not None and not state.lost else ""
        age = f"{state.age:.0f} s old, " if state.age else ""
        return {
            "summary": f"t = {state.stamp:.1f} s, {age}quality {state.quality:.2f}{place}",
            "advice": _pose_advice(state),
            "late": state.lost and state.age > 0.0,
            "fine": "The pose is known.",
            "pose": state.pose.round(3).tolist() if known else None,
            "ellipse": [axes[0], axes[1], math.degrees(axes[2])] if known and axes is not None else None,
            "alternatives": state.alternatives[:MOST_ALTERNATIVES].round(2).tolist(),
            "lost": state.lost,
            "trail": list(self._trail),
        }


def _pose_advice(state: LocalizerState) -> list[str]:
    if state.age:
        advice = [f"the pose is {state.age:.0f} s old: no data; is the recorder still running?"]
    else:
        advice = [f"the pose is not known: {state.reason or 'drive on, past walls and anchors'}"] if state.lost else []
        # Where none has ever come there is no pose to be held.
        silent = state.silent.keys() - ({"odometry"} if state.reason == NO_ODOMETRY else set())
        advice += [f"nothing from {name} for {state.silent[name]:.0f} s: {CONSEQUENCES[name]}" for name in sorted(silent)]
    moved = "has been moved since the map was made, or its line of sight is blocked"
    return advice + [f"anchor {name} {moved}" for name in state.moved_anchors]
