"""A page that shows a map and what happens on it now: `uwblite watch`, and a robot that is being localised."""

import os
import secrets
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..constraints import Constraints
from ..io.carmen_live import LogTail, Sensor
from ..io.stored_result import StoredResult
from .advice import SensorState, advice, silent_after
from .feed import Feed
from .live_page import live_page
from .requests import HTML, PNG, Response, path_of, refusal, text_response
from .shown_results import described, shown_result

_TRAIL = 300
"""Points of the way since the latest map."""


class LivePage:
    """The page's state; threads may show and serve at will."""

    def __init__(self, title: str) -> None:
        self.host = ""
        self.names: tuple[str, ...] | None = None
        self.feed = Feed()
        self._title = title
        self._token = secrets.token_urlsafe(24)
        self._picture: bytes | None = None
        self._maps = 0

    def show_map(self, result: StoredResult | None, *, paths: bool = True) -> None:
        """Show another map, or with None no map any more; its paths only where they are wanted."""
        if result is None:
            self._picture = None
            empty: dict[str, Any] = {name: [] for name in ("paths", "anchors", "doubts", "warnings")}
            self.feed.publish("map", empty | {"image": None, "accepted": 0, "candidates": 0})
            return
        shown = shown_result(result)
        self._picture = shown.grid_png
        self._maps += 1
        page = described(shown, Constraints())
        kept = ("name", "doubts", "warnings", "image", "paths", "accepted", "candidates")
        anchors = [
            entry | {"covariance": a.covariance.tolist() if np.isfinite(a.covariance).all() else None}
            for entry, a in zip(page["anchors"], result.anchors, strict=True)
        ]
        hidden: dict[str, Any] = {} if paths else {"paths": []}
        version = f"{self._token[:8]}-{self._maps}"
        self.feed.publish("map", {name: page[name] for name in kept} | {"anchors": anchors, "version": version} | hidden)

    def show_status(self, status: Mapping[str, Any]) -> None:
        """Show the present state: summary, advice, sensors, pose, trail; see `watch_status`."""
        self.feed.publish("status", dict(status))

    def handle(self, method: str, target: str, headers: dict[str, str], body: bytes = b"") -> Response:
        """Answer a request; nothing can be changed."""
        if refused := refusal(self, self._token, method, headers):
            return refused
        path = path_of(target)
        if path == "/":
            return Response(200, HTML, live_page(self._title).encode())
        if path == "/events":
            return Response(200, "text/event-stream", b"", stream=self.feed.events)
        if path == "/grid.png" and self._picture is not None:
            return Response(200, PNG, self._picture)
        return text_response("there is no such page", 404)


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
