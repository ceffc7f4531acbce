"""The list that the checks of a recording write to."""

from dataclasses import dataclass

import numpy as np

from ..arrays import Floats

RANKS = ("serious", "warning", "note")
"""Worst first."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding about a recording."""

    rank: str
    """One of RANKS."""
    topic: str
    """'log', 'odometry', 'radio', 'lidar' or 'map'."""
    what: str
    """The finding, with figures and units."""
    advice: str
    """What to do about it; empty where `what` contains it."""


class Findings:
    """Findings in the order in which they are made."""

    def __init__(self) -> None:
        self._found: list[Finding] = []

    def add(self, rank: str, topic: str, what: str, advice: str) -> None:
        """Note a finding."""
        self._found.append(Finding(rank, topic, what, advice))

    def serious(self, topic: str, what: str, advice: str) -> None:
        """Note a fault that spoils the map or prevents it."""
        self.add("serious", topic, what, advice)

    def warning(self, topic: str, what: str, advice: str) -> None:
        """Note a fault that costs accuracy."""
        self.add("warning", topic, what, advice)

    def note(self, topic: str, what: str, advice: str) -> None:
        """Note useful information."""
        self.add("note", topic, what, advice)

    def ranked(self) -> tuple[Finding, ...]:
        """Return the findings, worst first, otherwise in the order in which they were made."""
        return tuple(sorted(self._found, key=lambda f: RANKS.index(f.rank)))


_FINEST = 1e-6
"""s; stamps are written no finer, and differences below are those of numbers that are no times."""


def timing(
    stamps: Floats, topic: str, found: Findings, *, expected_gap: float, repeats: float | None = None
) -> dict[str, float]:  # fmt: skip
    """Check the rhythm of a sensor: rate, gaps, equal stamps.

    Parameters
    ----------
    stamps : (n,) s, non-decreasing.
    expected_gap : a silence longer than this is a gap, s (or five periods, where that is longer).
    repeats : share of equal stamps that is not right, where some are; None = any is wrong.
    """
    steps = np.diff(stamps)
    some = steps > _FINEST
    period = float(np.median(steps[some])) if some.any() else 0.0
    duration = float(stamps[-1] - stamps[0])
    gap = max(expected_gap, 5.0 * period)
    gaps = np.flatnonzero(steps > gap)
    equal = float(np.mean(steps == 0)) if len(steps) else 0.0
    repeated = equal if repeats is None else repeats
    if len(gaps):
        worst = gaps[np.argmax(steps[gaps])]
        found.add(
            "warning" if steps[gaps].sum() > 0.02 * duration or steps[worst] > 5.0 else "note",
            topic,
            f"{len(gaps)} silences longer than {gap:.1f} s; the longest is {steps[worst]:.1f} s"
            f" at t = {stamps[worst] - stamps[0]:.1f} s",
            "check cable, power and processor load at these times",
        )
    if repeated > 0.02:
        found.add(
            "warning" if topic != "radio" else "note",
            topic,
            f"{100 * repeated:.0f} % of the stamps equal the one before",
            "stamps of low resolution, or readings that arrived in one piece: stamp each reading when it is made",
        )
    return {
        "count": len(stamps),
        "duration s": round(duration, 3),
        "rate Hz": round(1.0 / period, 3) if period else 0.0,
        "longest gap s": round(float(steps.max(initial=0.0)), 3),
        "gaps": len(gaps),
        "share of equal stamps": round(equal, 4),
    }
