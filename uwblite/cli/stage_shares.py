"""How far a map is on the whole: the share of the time that each stage usually takes."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..mapping import Stage

_SHARES = (
    ("keyframes", 0.01), ("edges", 0.06), ("bootstrap", 0.03), ("first optimisation", 0.10), ("constraints", 0.01),
    ("clouds", 0.11), ("scan-to-scan matching", 0.14), ("clouds made again", 0.07), ("ranges re-estimated", 0.04),
    ("loop closure", 0.17), ("second optimisation", 0.01), ("joint refinement", 0.18), ("landmark distances", 0.01),
    ("map consistency", 0.02), ("occupancy grid", 0.04), ("summary", 0.0),
)  # fmt: skip
"""Means over a room with radio and lidar and a building with lidar alone; in the order in which they come."""


class Overall:
    """Turns the progress of stages into the progress of all."""

    def __init__(self) -> None:
        self.share = 0.0
        """Of the whole work, 0..1; never falls."""

    def take(self, stage: "Stage", done: int, total: int) -> float:
        """Return the share of the whole work that is done; a stage that is not known leaves it as it is.

        Parameters
        ----------
        stage : of one with laps, whose number is not known beforehand, each lap takes half of what is left of its share.
        done, total : steps of the stage.
        """
        within = min(done / total, 1.0) if total > 0 else 0.0
        if stage.lap:
            within = 1.0 - 0.5 ** (stage.lap - 1 + within)
        before = 0.0
        whole = sum(share for _, share in _SHARES)
        for known, share in _SHARES:
            if known == stage.name:
                self.share = max(self.share, (before + share * within) / whole)
                break
            before += share
        return self.share
