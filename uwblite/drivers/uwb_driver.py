"""A UWB tag that only sends, lines or frames: rounds that are missing, ranges of other tags, ranges that no sum protects."""

from collections import Counter

from ..clocks.device_clock import DeviceClock
from .continuity import RangeGuard
from .events import Action, Corrupt, Lost, Note, RangeEpoch
from .session import ByteProtocol, Identity
from .text_lines import Line, LineDriver
from .uwb_line import Ranges, Refused

MOST_LEAP, NEAR = 100_000, 3
"""Rounds that may be lost together; rounds within which the next one must follow a leap, as a damaged digit leaps too."""
OTHER_TAG = "line of a tag that was seen once"
MUCH = 50
"""Rounds in a row without a range after which it is reported."""


class UwbDriver(LineDriver):
    """A UWB tag that sends its ranges unasked. Nothing is ever sent.

    Parameters
    ----------
    protocol : bytes to Line of Ranges or Refused.
    title, baud, clock, unit : as for `LineDriver`.
    tag : the tag whose ranges to take, where lines name several; "" = the first that is seen twice.
    """

    def __init__(
        self, protocol: ByteProtocol, title: str, baud: int, clock: DeviceClock, unit: float, tag: str = ""
    ) -> None:  # fmt: skip
        super().__init__(protocol, title, baud, clock, unit)
        self.first_is_whole = clock.proven
        self._tag, self._leap, self._empty = tag, 0, 0
        self._tags: Counter[str] = Counter()
        self._first: Line | None = None
        """The line of a tag that was seen once."""
        self._round: int | None = None
        self._guard = RangeGuard(self.health)

    def time_of(self, content: Ranges | Refused) -> float | None:
        """Return the board's time, its own unit; None = there is none."""
        return content.time if isinstance(content, Ranges) else None

    def members(self, event: Line | Corrupt) -> tuple[str, ...]:
        """Return the anchors of a line: some boards print one line for each."""
        content = event.content if isinstance(event, Line) else None
        return tuple(f"{content.tag}/{r.anchor_id}" for r in content.readings) if isinstance(content, Ranges) else ()

    def measured(self, line: Line) -> list[Action]:
        """Turn a line into ranges."""
        if isinstance(line.content, Refused):
            text = f"uwb: it prints {line.content.what}, which are no ranges: set it to two-way ranging, and to print distances"
            return self.say_once(Note("error", "uwb-no-ranges", text))
        tag = line.content.tag
        if not tag or tag == self._tag:
            return self._ranges(line)
        self._tags[tag] += 1
        if self._tags[tag] == 1:  # its name may be damaged
            dropped: list[Action] = [Corrupt(b"", OTHER_TAG)] if self._tag or self._first else []
            self._first = self._first if self._tag else line
            return dropped
        if self._tag:
            text = f"uwb: ranges of tag {tag} besides those of tag {self._tag} are left out; tag=ID chooses"
            return self.say_once(Note("warning", "uwb-other-tag", text))
        self._tag, first, self._first = tag, self._first, None
        ours = [first] if first is not None and first.content.tag == tag else []
        left: list[Action] = [Corrupt(b"", OTHER_TAG)] * (first is not None and not ours)
        return left + [action for each in (*ours, line) for action in self._ranges(each)]

    def _ranges(self, line: Line) -> list[Action]:
        self.ready, content = True, line.content
        actions: list[Action] = [Lost(line.stamp, count)] if (count := self._missed(content)) else []
        stamp, _, lost = self.timed(line)
        actions += lost
        self._empty = 0 if content.readings else self._empty + 1
        if self._empty == MUCH:
            text = "uwb: rounds come, but without ranges: set tag and anchors to two-way ranging, not to time differences"
            actions += self.say_once(Note("warning", "uwb-no-ranges", text))
        return [*actions, *self._guard.take(RangeEpoch(stamp, content.readings), line.stamp)]

    def _missed(self, line: Ranges) -> int:
        """Return how many rounds were missed before the line before this one, by their numbers; 0 where the board restarted."""
        if line.round is None:
            return 0
        step = 1 if self._round is None else line.round - self._round
        step = step % line.modulus if line.modulus else step
        leap, self._leap, self._round = self._leap, step - 1 if 1 < step <= MOST_LEAP else 0, line.round
        return leap if 0 < step <= NEAR else 0

    def stop(self) -> list[Action]:
        """Return Corrupt for what nothing confirmed."""
        return [*super().stop(), *[Corrupt(b"", OTHER_TAG)] * (self._first is not None), *self._guard.finish()]

    def identity(self) -> Identity:
        """Say who answered."""
        return Identity(self.title, (("tag", self._tag),) if self._tag else ())
