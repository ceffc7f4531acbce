"""When a growing log is mapped again, and from how many of its scans.

The cost of a round is processor time, expected from the last one by the law

    c(T, n) ~ (T0 + T) share(n),    share(n) = min(1, (8 / n)^0.4)

for T seconds of recording and every n-th scan; T0 stands for what any round takes, and up to every 8th scan the same keyframes
are mapped. Scans are thinned out until a round fits into a tenth of PATIENCE; where that is not enough, rounds become rarer.
In either case a round is expected to take a tenth of the time since the last one at most.
"""

from dataclasses import dataclass

SHARE = 0.1
"""Of the time that may go into rounds."""
PATIENCE = 60.0
"""s that a person waits for a new map: beyond, scans are left out rather than waited for; and a recording that has not grown
for so long counts as finished, and is mapped from all scans."""
LEAST_PAUSE = 10.0
"""s between rounds, and s of recording that must be new."""
FIRST_AFTER = 20.0
"""s of recording before the first round: less shows no map."""
_SAME_KEYFRAMES, _EXPONENT = 8, 0.4
_THINNINGS = (1, _SAME_KEYFRAMES, 2 * _SAME_KEYFRAMES, 4 * _SAME_KEYFRAMES)
_ALWAYS = 200.0
"""s of recording that cost as much as what any round takes."""


@dataclass(frozen=True, slots=True)
class Round:
    """A round that has ended."""

    ended: float
    """s, on the caller's clock."""
    cost: float
    """s of processor time that it took."""
    recorded: float
    """s of recording that there were when it began."""
    every_nth_scan: int
    failed: bool = False


def next_thinning(last: Round | None, recorded: float, now: float, at_rest: float = 0.0) -> int | None:
    """Return how the next round thins the scans out, or None where it is not due yet.

    Parameters
    ----------
    recorded, at_rest : s of recording that there are, and since the log has grown.
    now : s, on the clock of the rounds.
    """
    if last is None:
        return 1 if recorded >= FIRST_AFTER else None
    since = now - last.ended
    if since < LEAST_PAUSE:
        return None
    if at_rest >= PATIENCE:
        best = last.every_nth_scan == 1 and last.recorded >= recorded
        return None if best or last.failed else 1
    if recorded - last.recorded < LEAST_PAUSE and not last.failed:
        return None
    costs = [(n, expected_cost(last, recorded, n)) for n in _THINNINGS]
    n, cost = next(((n, c) for n, c in costs if c <= SHARE * PATIENCE), costs[-1])
    return n if since >= cost / SHARE else None


def expected_cost(last: Round, recorded: float, every_nth_scan: int) -> float:
    """Return how much processor time a round will take, s."""
    growth = (_ALWAYS + recorded) / (_ALWAYS + last.recorded)
    return last.cost * growth * _share(every_nth_scan) / _share(last.every_nth_scan)


def _share(every_nth_scan: int) -> float:
    return float(min(1.0, (_SAME_KEYFRAMES / every_nth_scan) ** _EXPONENT))
