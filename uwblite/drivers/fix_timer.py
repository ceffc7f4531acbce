"""When was a fix made? A DWM1001 only says that one is ready; polling brackets it, and the beat of the fixes narrows it."""

GRID_SLACK = 0.0001
"""s per period by which the grid of the fixes may wander: clocks of host and network, 1e-3 at worst."""
WIDEST = 0.032
"""s; a bracket wider than this tells nothing."""


class FixTimer:
    """Times of fixes from brackets.

    A fix lies between the last poll that found none and the first that found it. Rounds follow each other on the grid of
    the network's superframes, so the bracket of the last fix, shifted by whole periods, narrows that down; where the two
    do not overlap the tag does not keep the grid, and the new bracket stands alone.
    """

    def __init__(self) -> None:
        self.last: float | None = None
        """s, time of the last fix that was accepted."""
        self._bracket: tuple[float, float] | None = None
        self._found: tuple[float, float] | None = None

    @property
    def settled(self) -> bool:
        """Tell whether it is known when the next fix is due."""
        return self._bracket is not None

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
        high = now
        if self._bracket is not None:
            turns = max(1, int((high - self._bracket[0]) / period + 1e-6))
            shift, slack = turns * period, turns * GRID_SLACK
            narrow = max(low, self._bracket[0] + shift - slack), min(high, self._bracket[1] + shift + slack)
            if narrow[0] < narrow[1]:
                low, high = narrow
        if high - low > WIDEST:
            self._found = None
            return self.last + period if self.last is not None and now - self.last < 2 * period else now
        self._found = (low, high)
        return (low + high) / 2

    def accept(self, stamp: float, *, as_found: bool) -> None:
        """Take `stamp` as the time of the last fix.

        Parameters
        ----------
        stamp : s.
        as_found : it is what `time` returned last, so its bracket counts from now on.
        """
        self.last = stamp
        if as_found and self._found is not None:
            self._bracket = self._found
