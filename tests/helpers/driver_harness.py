"""What the driver tests share: feeding transcripts in every way, and sessions against emulators in simulated time."""

import random
from pathlib import Path

from emulators.simulated_time import of_kind, simulate

from uwblite.drivers.events import Corrupt

ROOT = Path(__file__).resolve().parents[2]


def feed_whole(make, data, stamp=1.0):
    return make().feed(data, stamp)


def feed_split(make, data, rng, stamp=1.0):
    """Feed in pieces of random size, some of them empty."""
    protocol, events, at = make(), [], 0
    while at < len(data):
        size = rng.choice([0, 1, 2, 3, 7, 20, 64, 300, 5000])
        events += protocol.feed(data[at : at + size], stamp)
        at += size
    return events


def good(events):
    return [event for event in events if not isinstance(event, Corrupt)]


def check_transcript(make, frames, expected, noises, splits=40, seed=0):
    """A transcript gives the same events whole, byte by byte, in random splits, and among noise.

    Parameters
    ----------
    make : builds a protocol.
    frames : list of bytes, each a frame; noise may stand between them.
    expected : the good events of the whole transcript.
    noises : bytes that are no frames.
    """
    data = b"".join(frames)
    assert good(feed_whole(make, data)) == expected
    byte_by_byte = make()
    events = [event for i in range(len(data)) for event in byte_by_byte.feed(data[i : i + 1], 1.0)]
    assert good(events) == expected
    rng = random.Random(seed)
    for _ in range(splits):
        assert good(feed_split(make, data, rng)) == expected
    for _ in range(splits):
        noisy = b"".join(part for frame in frames for part in (rng.choice(noises), frame)) + rng.choice(noises)
        assert good(feed_split(make, noisy, rng)) == expected, noisy


__all__ = ["ROOT", "check_transcript", "feed_split", "feed_whole", "good", "of_kind", "simulate"]
