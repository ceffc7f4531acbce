"""Whoever listens gets every value's latest state, once, and is let go when the feed ends."""

import json
import threading

import pytest

from uwblite.server.live import Feed


def test_the_latest_state_and_then_what_is_new():
    feed = Feed()
    feed.publish("map", {"a": 1})
    feed.publish("status", 1)
    feed.publish("status", 2)
    events = feed.events(patience=0.01)
    assert next(events).startswith(b"retry:")
    assert next(events) == b'event: map\ndata: {"a": 1}\n\nevent: status\ndata: 2\n\n'
    assert next(events).startswith(b":")
    feed.publish("status", 2)
    assert next(events).startswith(b":")
    feed.publish("status", 3)
    assert next(events) == b"event: status\ndata: 3\n\n"
    feed.close()
    assert list(events) == []


def test_text_cannot_end_an_event():
    feed = Feed()
    evil = "x\n\nevent: map\ndata: 1\r\n\u2028"
    feed.publish("status", evil)
    message = list(zip(range(2), feed.events(), strict=False))[1][1]
    assert message.count(b"\n") == 3
    assert json.loads(message.partition(b"data: ")[2]) == evil


def test_numbers_that_json_has_not_are_refused():
    with pytest.raises(ValueError, match="JSON"):
        Feed().publish("status", float("nan"))


def test_many_listeners_in_threads_all_see_the_end():
    feed, seen = Feed(), []

    def listen():
        seen.append([m for m in feed.events() if b"status" in m])

    threads = [threading.Thread(target=listen) for _ in range(8)]
    feed.publish("status", "begin")
    for thread in threads:
        thread.start()
    for k in range(50):
        feed.publish("status", k)
    feed.close()
    for thread in threads:
        thread.join(10)
    assert len(seen) == 8
