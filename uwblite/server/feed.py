"""The latest of what changes, handed to everybody who looks: server-sent events (HTML Living Standard, section 9.2)."""

import json
import threading
from collections.abc import Iterator
from typing import Any

_PATIENCE = 10.0
"""s of silence after which a line goes out all the same: it shows who has left, and keeps lines open in between."""


class Feed:
    """Named values, each with its latest state. Threads may publish and listen at will."""

    def __init__(self) -> None:
        self._news = threading.Condition()
        self._latest: dict[str, tuple[int, bytes]] = {}
        self._count = 0
        self._closed = False

    def publish(self, name: str, value: Any) -> None:
        """Give a value its new state; what is as before is not sent again."""
        text = json.dumps(value, allow_nan=False)
        message = f"event: {name}\ndata: {text}\n\n".encode()
        with self._news:
            if self._latest.get(name, (0, b""))[1] != message:
                self._count += 1
                self._latest[name] = (self._count, message)
                self._news.notify_all()

    def close(self) -> None:
        """End all listening."""
        with self._news:
            self._closed = True
            self._news.notify_all()

    def events(self, patience: float = _PATIENCE) -> Iterator[bytes]:
        """Yield the state of all values and then whatever is new, until the feed is closed.

        A listener who is slow gets the latest state and not all that were in between.
        """
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
