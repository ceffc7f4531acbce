"""When was a fix made? A DWM1001 only says that one is ready; polling brackets it, and the beat of the fixes narrows it."""

GRID_SLACK = 0.0001
"""s per period by which the grid of the fixes may wander: clocks of host and network, 1e-3 at worst."""
WIDEST = 0.032
"""s; a bracket wider than this tells nothing."""
LATE = 0.015
"""s by which a fix may be announced after its slot: the module computes a position first."""
STRAYS = 3
"""Fixes in a row off the grid after which the grid is given up for a new one."""

Bracket = tuple[float, float]


class FixTimer:
    """Times of fixes from brackets.

    A fix is announced between the last poll that found none and the first that found it. Ranging happens in a fixed slot
    of the network's superframe, so the bracket of an earlier fix, shifted by whole periods, narrows that down. An
    announcement a little after its slot is stamped with the slot; one far off stands alone, and when the slot itself has
    moved the grid follows: at once when fixes come earlier, after a few when they come later.
    """

    def __init__(self) -> None:
        self.last: float | None = None
        """s, time of the last fix that was accepted."""
        self._grid: Bracket | None = None
        self._found: Bracket | None = None
        self._strays = 0
        self._tight = False

    @property
    def settled(self) -> bool:
        """Tell whether it is known when the next fix is due."""
        return self._grid is not None

    def time(self, not_before: float | None, now: float, period: float) -> float | None:
        """Return when the fix that was found ready at `now` was made.

        Parameters
        ----------
        not_before : s, when the last poll that found none was sent; None where the first poll found it.
        now : s.
        period : s between fixes.

        Returns
        -------
        float, s; None = unknown: it may have waited for long.
        """
        low = self.last if not_before is None else not_before
        if low is None:
            return None
        tight = now - low <= WIDEST
        self._tight, self._found = tight, (low, now) if tight else None
        if self._grid is None:
            return (low + now) / 2 if tight else now
        slot = self._slot(now, period)
        narrow = max(low, slot[0]), min(now, slot[1])
        if narrow[0] < narrow[1]:
            self._found = narrow if tight else None
            return sum(narrow) / 2
        if not tight:
            return now if self.last is None else min(now, self.last + period)
        if slot[1] <= low and self._strays + 1 < STRAYS:
            self._found = None  # it came late: the grid stays
            if low - slot[1] < LATE:
                return sum(slot) / 2
        return (low + now) / 2

    def _slot(self, now: float, period: float) -> Bracket:
        """Return the bracket of the latest slot that has begun."""
        assert self._grid is not None
        turns = max(1, int((now - self._grid[0]) / period + 1e-6))
        shift, slack = turns * period, turns * GRID_SLACK
        return self._grid[0] + shift - slack, self._grid[1] + shift + slack

    def accept(self, stamp: float, *, as_found: bool) -> None:
        """Take `stamp` as the time of the last fix.

        Parameters
        ----------
        stamp : s.
        as_found : it is what `time` returned last, so its bracket counts from now on.
        """
        self.last = stamp
        if not (as_found and self._tight):
            return  # a grid must not confirm itself
        self._strays = 0 if self._found else self._strays + 1
        self._grid = self._found or self._grid
