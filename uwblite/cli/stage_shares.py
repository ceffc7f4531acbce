"""How far a map is on the whole: the share of the time that each stage usually takes."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..mapping import Stage

_WITH_LIDAR = (
    ("keyframes", 0.04), ("edges", 0.01), ("bootstrap", 0.02), ("first optimisation", 0.03), ("constraints", 0.01),
    ("clouds", 0.04), ("keyframes added", 0.03), ("scan-to-scan matching", 0.36), ("clouds made again", 0.06),
    ("ranges re-estimated", 0.02), ("loose links", 0.01), ("long stretches", 0.01), ("loop closure", 0.18),
    ("second optimisation", 0.01), ("joint refinement", 0.11), ("matched once more", 0.01), ("surfaces", 0.05),
    ("map consistency", 0.01),
    ("landmark distances", 0.01), ("occupancy grid", 0.05), ("summary", 0.01),
)  # fmt: skip
"""Means over two recordings with radio and lidar and six with lidar alone; in the order in which they come."""
_WITHOUT_LIDAR = (
    ("keyframes", 0.03), ("edges", 0.01), ("bootstrap", 0.24), ("first optimisation", 0.26), ("constraints", 0.01),
    ("second optimisation", 0.01), ("landmark distances", 0.01), ("occupancy grid", 0.01), ("summary", 0.42),
)  # fmt: skip
"""Means over two recordings with radio alone; the last optimisation counts to the summary."""


class Overall:
    """Turns the progress of stages into the progress of all."""

    def __init__(self, *, lidar: bool = True) -> None:
        self._shares = _WITH_LIDAR if lidar else _WITHOUT_LIDAR
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
        whole = sum(share for _, share in self._shares)
        for known, share in self._shares:
            if known == stage.name:
                self.share = max(self.share, (before + share * within) / whole)
                break
            before += share
        return self.share
