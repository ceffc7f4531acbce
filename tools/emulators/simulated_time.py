"""Sessions against emulated devices in simulated time: a link with delays, a bit rate, faults and a cable that is pulled."""

import math

from uwblite.drivers.events import Reopen, Send, SetBaud
from uwblite.drivers.link import HANG, SILENCE
from uwblite.drivers.session import Session
from uwblite.drivers.transport import CHUNK


def simulate(
    session, device, seconds, *, line=None, step=0.0005, start=1000.0, latency=0.0008, jitter=lambda: 0.0, tick=0.0,
    replug=None, piece=1 << 20, pause=None, stop=None, mute=None,
):  # fmt: skip
    """Run a session, or a driver's, against an emulated device in simulated time, with a fault line between them.

    Parameters
    ----------
    latency : s of a round trip without the device.
    jitter : s that bytes take to the host, called for each piece.
    replug : (s, s); when the cable is pulled, and for how long.
    pause, stop, mute : (s, s); when the link holds back all bytes, the host does nothing, or what the device sends is lost,
        and for how long.
    piece : bytes that reach the host at once, at most.
    tick : s; bytes reach the host in steps of this length, as an FTDI adapter delivers them.

    Returns
    -------
    actions : all but Send, each with the time it was made.
    reopens : how often the session asked for the port to be opened again.
    """
    session = session if isinstance(session, Session) else Session(session)
    now, end = start, start + seconds
    actions, to_host, to_device, reopens, last_data = [], [], [], 0, start
    held, stopped, muted = [(start + span[0], start + sum(span)) if span else (end, end) for span in (pause, stop, mute)]
    device.power_up(now)

    def put(queue, data, due, rate=None):
        """Queue bytes, in order; on a line with a bit rate each of its pieces takes its time."""
        size = min(32, piece) if rate else piece
        for at in range(0, len(data), size):
            part = data[at : at + size]
            due = max(due, queue[-1][0] if queue else due) + (10 * len(part) / rate if rate else 0.0)
            if queue is to_host and muted[0] <= due < muted[1]:
                continue
            due = held[1] if held[0] <= due < held[1] else due
            queue.append((math.ceil(due / tick) * tick if tick and queue is to_host else due, part))

    def do(new):
        nonlocal reopens, last_data
        for action in new:
            if isinstance(action, Send):
                put(to_device, action.data, now + latency / 2)
            elif isinstance(action, SetBaud) and getattr(device, "host_rate", None) is not None:
                device.host_rate = action.rate
                actions.append((now, action))
            elif isinstance(action, Reopen):
                if not SILENCE < now - last_data <= HANG:  # as Link.is_held_up
                    reopens, last_data = reopens + 1, now
                    do(session.start(now))
            else:
                actions.append((now, action))

    if getattr(device, "host_rate", None) is not None:
        device.host_rate = session.baud
    do(session.start(now))
    pulled, back = (start + replug[0], start + sum(replug)) if replug else (end, end)
    while now < end:
        if now >= pulled:
            pulled, now = end, max(now, back)
            to_host.clear()
            to_device.clear()
            device.advance(now)
            device.power_up(now)
            do(session.start(now))
        rate = getattr(device, "rate", None)
        put(to_host, device.advance(now), now + jitter(), rate)
        while to_device and to_device[0][0] <= now:
            put(to_host, device.receive(to_device.pop(0)[1], now), now + latency / 2 + jitter(), rate)
        if stopped[0] <= now < stopped[1]:
            now = min([now + 0.05, stopped[1], max(now, device.next_time(now))]) + step / 10
            continue
        while to_host and to_host[0][0] <= now:
            data = to_host.pop(0)[1]
            while to_host and to_host[0][0] <= now and piece > CHUNK > len(data) + len(to_host[0][1]):
                data += to_host.pop(0)[1]  # one read
            if line is not None:
                data = line.pass_on(data, now - start)
            if data:
                last_data = now
                do(session.feed(data, now))
        deadline = session.deadline()
        if deadline is not None and deadline <= now:
            do(session.tick(now))
        queues = [queue[0][0] for queue in (to_host, to_device) if queue]
        times = [device.next_time(now), session.deadline() or end, *queues, pulled, end]
        now = max(now + step / 10, min(max(min(times), now), now + 0.05))
    return actions, reopens


def of_kind(actions, kind):
    return [action for _, action in actions if isinstance(action, kind)]
