"""One device of a recording: its port, its session, its record, and what all of them did in sentences."""

import re
import threading
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from functools import partial

from ..errors import DeviceError
from .events import Note, Send, SetBaud, SetDtr
from .session import Session
from .transport import Port, open_port

SILENCE = 3.0
"""s without a measurement before it is reported."""
HANG = 10.0
"""s without a measurement before the port is opened again."""
BACK_OFF = (0.1, 0.2, 0.4, 0.7, 1.0)
"""s between attempts to open a port that is gone; the last one repeats."""


@dataclass(slots=True)
class Counts:
    """What one device did."""

    messages: int = 0
    """Measurements written: scans, ranging rounds, poses."""
    lost: int = 0
    """Measurements that the device made and that did not arrive, by its own clock."""
    corrupt: Counter[str] = field(default_factory=Counter)
    """Damaged frames and noise, by reason."""
    bytes: int = 0
    connects: int = 0
    silent_time: float = 0.0
    """s, sum of the pauses longer than SILENCE."""
    anchors: Counter[str] = field(default_factory=Counter)
    """Ranges by anchor."""
    spread: float = 0.0
    """s, sum of what the stamps may be wrong by, where the device does not stamp itself."""
    widest: float = 0.0
    """s, the largest of these."""


@dataclass(frozen=True, slots=True)
class Mounting:
    """Mounting of the sensors; written to the log for mapping."""

    laser: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """x, y, theta on the base; m, m, rad."""
    params: tuple[tuple[str, str], ...] = ()
    """PARAM name, value."""
    more_lasers: tuple[tuple[float, float, float], ...] = ()
    """x, y, theta of the second lidar, the third ..."""


@dataclass(frozen=True, slots=True)
class Host:
    """The computer that records."""

    name: str
    monotonic: Callable[[], float]
    """s, a clock that never leaps."""
    wall_offset: float
    """s to add to it for the log's timestamps."""
    wall: Callable[[], float] | None = None
    """s, the computer's own clock, to report that it was set; stamps do not follow it."""
    open_port: Callable[[str, int], Port] = open_port
    """(url, baud) -> Port."""


class Opening:
    """A port that is being opened by a thread of its own, so that nobody has to wait for it."""

    def __init__(self, open_port: Callable[[str, int], Port], url: str, baud: int) -> None:
        self._port = Future[Port]()
        opening = partial(open_port, url, baud)
        threading.Thread(target=self._run, args=(opening,), name=f"uwblite-open {url}", daemon=True).start()

    def _run(self, opening: Callable[[], Port]) -> None:
        try:
            self._port.set_result(opening())
        except DeviceError as error:
            self._port.set_exception(error)

    def result(self) -> Port | DeviceError | None:
        """Return the port, why not, None while that is unknown."""
        try:
            return self._port.result() if self._port.done() else None
        except DeviceError as error:
            return error

    def give_up(self) -> None:
        """Close the port when it opens after all."""
        self._port.add_done_callback(lambda done: None if done.exception() else done.result().close())


class Link:
    """One device: its port, session and counts; the robot's first (1), second ... of its kind."""

    def __init__(self, sensor: str, url: str, session: Session, number: int = 1) -> None:
        self.name = sensor if number == 1 else f"{sensor}{number}"
        self.url, self.session, self.number = url, session, number
        self.counts = Counts()
        self.port: Port | None = None
        self.opening: Opening | None = None
        self.retry_at = 0.0
        self.attempt = 0
        self.stated: set[str] = set()
        """Names of the notes since it last gave data."""
        self.last_data = self.last_message = self.opened = 0.0
        self.quiet = False
        self.new_lost = self.new_corrupt = 0
        self.rate = 0.0
        self._rate_base = (0.0, 0)

    # ---- its port

    def connect(self, now: float, open_port: Callable[[str, int], Port]) -> Port | DeviceError | None:
        """Open the port in the background; return it once it is open, why not, None while that is unknown."""
        if self.opening is None:
            self.opening = Opening(open_port, self.url, self.session.baud)
        port = self.opening.result()
        if port is None:
            return None
        self.opening = None
        if not isinstance(port, DeviceError):
            try:
                port.read()  # what waited came at an unknown time
            except DeviceError as error:
                port.close()
                port = error
        if isinstance(port, DeviceError):
            self._retry_later(now)
            return port
        self.port, self.attempt = port, 0
        self.counts.connects += 1
        self.opened = self.last_data = now
        return port

    def disconnect(self, now: float) -> None:
        """Close the port, to be opened again after a pause."""
        if self.port is not None:
            self.port.close()
            self.port = None
            self._retry_later(now)
            self._fall_silent()

    def _retry_later(self, now: float) -> None:
        self.retry_at = now + BACK_OFF[min(self.attempt, len(BACK_OFF) - 1)]
        self.attempt += 1

    def send(self, action: Send | SetBaud | SetDtr) -> None:
        """Do to the port what the session wants.

        Raises
        ------
        DeviceError : the device is gone.
        """
        if self.port is None:
            return
        if isinstance(action, Send):
            self.port.write(action.data)
        elif isinstance(action, SetBaud):
            self.port.set_baud(action.rate)
        else:
            self.port.set_dtr(action.on)

    def finish(self) -> str:
        """Close the port; return why it was never open, "" where it was."""
        if self.port is not None:
            self.port.close()
            self.port = None
        if self.opening is None or self.counts.connects:
            return ""
        self.opening.give_up()
        why = self.opening.result() or "it was still being opened at the end"
        return f"{self.name}: {self.url}: {why}" if isinstance(why, str | DeviceError) else ""

    # ---- its data

    def received(self, stamp: float, now: float) -> str:
        """Count a measurement made at `stamp` s; return what to say of the silence that it ends, "" = there was none."""
        self.counts.messages += 1
        pause = max(0.0, stamp - self.last_message) if self.quiet else 0.0
        self.counts.silent_time += pause
        ended, self.quiet, self.last_message = self.quiet, False, now
        if not ended:
            return ""
        return f"what was late by {now - stamp:.1f} s has come" if now - stamp > SILENCE else f"data again after {pause:.1f} s"

    def watch(self, now: float) -> tuple[Note | None, bool]:
        """Return what is to be reported of a device that falls silent, and whether its port should be opened again."""
        silent, note = now - max(self.last_message, self.opened), None
        if silent > SILENCE and not self.quiet and not self.session.is_catching_up:
            self._fall_silent()
            # What came last before a device fell silent says nothing of the silence.
            lately = 0.5 * silent if self.counts.messages else silent
            if now - self.session.last_event < lately:
                why = "it answers, but measures nothing"
            elif now - self.last_data < lately:
                why = "bytes come, but no good frame: wrong bit rate, wrong device or a bad cable"
            else:
                why = "check power and cable; unplug it and plug it in again"
            note = Note("warning", f"{self.name}-no-data", f"{self.name}: no data for {silent:.0f} s; {why}")
        return note, silent > HANG and now - self.last_data > HANG

    def is_held_up(self, now: float) -> bool:
        """Return whether a silence may be the link's, which delivers late what the device sends, as a wireless bridge does."""
        return SILENCE < now - self.last_data <= HANG

    def _fall_silent(self) -> None:
        if not self.quiet:
            self.quiet, self.last_message = True, max(self.last_message, self.opened)

    def param_name(self, name: str) -> str:
        """Return the name of a fact about this device in the log: ``laser_serial``, ``laser2_serial`` ..."""
        kind, _, rest = name.partition("_")
        return name if self.number == 1 else f"{kind}{self.number}_{rest}"

    def named(self, note: Note) -> Note:
        """Return a driver's note, which names the sensor alone, with the name of this device."""
        sensor = self.name.removesuffix(str(self.number))
        name, text = (re.sub(f"^{sensor}(?=[-:])", self.name, words) for words in (note.name, note.text))
        return replace(note, name=name, text=text)

    def update_rate(self, now: float) -> None:
        """Refresh `rate`, messages per second over the last two seconds."""
        since, count = self._rate_base
        if now - since >= 2.0:
            self.rate = (self.counts.messages - count) / (now - since)
            self._rate_base = (now, self.counts.messages)

    def silent_time(self, start: float, end: float) -> float:
        """Return how long nothing came between `start` and `end`, s, pauses up to SILENCE excepted."""
        if not self.counts.messages:
            return end - start
        return self.counts.silent_time + (end - self.last_message if self.quiet else 0.0)


def summary_lines(links: list[Link], start: float, end: float) -> list[str]:
    """Return what each device did, for people."""
    lines = []
    for link in links:
        counts = link.counts
        text = (
            f"{link.name}: {counts.messages} messages ({counts.messages / max(end - start, 1e-9):.2f}/s),"
            f" lost {counts.lost}, corrupt {sum(counts.corrupt.values())}, connected {counts.connects} times,"
            f" silent {link.silent_time(start, end):.1f} s"
        )
        if counts.anchors:
            text += "; anchors " + ", ".join(f"{name} {count}" for name, count in sorted(counts.anchors.items()))
        if counts.widest:
            mean = counts.spread / counts.messages
            text += f"; stamps within {1000 * mean:.1f} ms on average, {1000 * counts.widest:.1f} ms at worst"
        lines.append(text)
        lines += [f"{link.name}: corrupt {count} times: {why}" for why, count in counts.corrupt.most_common(8)]
    return lines


def doubts(links: list[Link], start: float, end: float) -> list[str]:
    """Return why a recording should not be trusted; empty when it can be."""
    seconds, doubts = max(end - start, 1e-9), []
    for link in links:
        counts = link.counts
        silent, total = link.silent_time(start, end), counts.messages + counts.lost
        if not counts.messages:
            doubts.append(f"{link.name}: no data at all")
        elif silent > 0.1 * seconds:
            doubts.append(f"{link.name}: silent for {silent:.0f} s of {seconds:.0f} s")
        elif counts.lost > 0.1 * total:
            doubts.append(f"{link.name}: lost {counts.lost} of {total}")
    return doubts
