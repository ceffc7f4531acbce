"""What the driver tests share: feeding transcripts in every way, and sessions against emulators in simulated time."""

import math
import random
from pathlib import Path

from uwblite.drivers.events import Corrupt, Reopen, Send, SetBaud
from uwblite.drivers.session import Session

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


def check_transcript(make, frames, expected, noises, splits=200, seed=0):
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


def simulate(session, device, seconds, *, line=None, step=0.0005, start=1000.0, latency=0.0008, jitter=lambda: 0.0, tick=0.0):
    """Run a session, or a driver's, against an emulated device in simulated time, with a fault line between them.

    Parameters
    ----------
    latency : s of a round trip without the device.
    jitter : s that bytes take to the host, called for each piece.
    tick : s; bytes reach the host in steps of this length, as an FTDI adapter delivers them.

    Returns
    -------
    actions : all but Send, each with the time it was made.
    reopens : how often the session asked for the port to be opened anew.
    """
    session = session if isinstance(session, Session) else Session(session)
    now, end = start, start + seconds
    actions, to_host, to_device, reopens = [], [], [], 0
    device.power_up(now)

    def put(queue, data, due, rate=None):
        """Queue bytes, in order; on a line with a bit rate each piece of 32 bytes takes its time."""
        for at in range(0, len(data), 32 if rate else max(1, len(data))):
            piece = data[at : at + (32 if rate else len(data))]
            due = max(due, queue[-1][0] if queue else due) + (10 * len(piece) / rate if rate else 0.0)
            queue.append((math.ceil(due / tick) * tick if tick and queue is to_host else due, piece))

    def do(new):
        nonlocal reopens
        for action in new:
            if isinstance(action, Send):
                put(to_device, action.data, now + latency / 2)
            elif isinstance(action, SetBaud) and getattr(device, "host_rate", None) is not None:
                device.host_rate = action.rate
                actions.append((now, action))
            elif isinstance(action, Reopen):
                reopens += 1
                do(session.start(now))
            else:
                actions.append((now, action))

    if getattr(device, "host_rate", None) is not None:
        device.host_rate = session.baud
    do(session.start(now))
    while now < end:
        rate = getattr(device, "rate", None)
        put(to_host, device.advance(now), now + jitter(), rate)
        while to_device and to_device[0][0] <= now:
            put(to_host, device.receive(to_device.pop(0)[1], now), now + latency / 2 + jitter(), rate)
        while to_host and to_host[0][0] <= now:
            data = to_host.pop(0)[1]
            if line is not None:
                data = line.pass_on(data, now - start)
            if data:
                do(session.feed(data, now))
        deadline = session.deadline()
        if deadline is not None and deadline <= now:
            do(session.tick(now))
        queues = [queue[0][0] for queue in (to_host, to_device) if queue]
        times = [device.next_time(now), session.deadline() or end, *queues, end]
        now = max(now + step / 10, min(max(min(times), now), now + 0.05))
    return actions, reopens


def of_kind(actions, kind):
    return [action for _, action in actions if isinstance(action, kind)]
