"""Do the ranges to one anchor agree with the map throughout, and what rests on them where they do not?"""

from collections.abc import Sequence

import numpy as np

from ..arrays import Bools, Floats, runs_of
from ..sensor_log.anchor_names import name_and_number
from .estimate import Task


def outlier_stretches(stamps: Floats, agrees: Bools) -> list[tuple[float, float]]:
    """Return the stretches (first and last stamp, s) in which most of one anchor's readings (m,) disagree with the map.

    Bins of equal counts; fewer than 100 readings show no stretches.
    """
    if len(stamps) < 100:
        return []
    order = np.argsort(stamps, kind="stable")
    bins = np.array_split(order, min(40, len(order) // 20))
    bad = np.array([agrees[b].mean() < 0.4 for b in bins], dtype=bool)
    return [(float(stamps[bins[a][0]]), float(stamps[bins[b - 1][-1]])) for a, b in runs_of(bad) if b - a >= 2]


def check_sustained_outliers(table: dict[str, Floats], anchor_ids: Sequence[str], task: Task) -> None:
    """Warn of each anchor whose ranges disagree with the map for long: its line of sight was blocked, or it was moved.

    Parameters
    ----------
    table : MapResult.range_table. anchor_ids : names.
    """
    start = float(task.recordings.stamps[0])
    for k, name in enumerate(anchor_ids):
        own = (table["anchor"] == k) & (table["weight"] > 0)
        stretches = outlier_stretches(table["stamp"][own], table["agrees"][own] > 0.5) if own.any() else []
        if stretches:
            when = ", ".join(f"{a - start:.0f} to {b - start:.0f} s" for a, b in stretches[:4])
            task.stages.warn(
                "sustained-outliers",
                f"anchor {name} disagrees with the map for long (t = {when}{' ...' if len(stretches) > 4 else ''}): "
                "its line of sight was blocked, or it was moved; these ranges count for little",
                anchor=name, stretches=stretches,
            )  # fmt: skip


def check_unit(anchor_ids: Sequence[str], task: Task) -> None:
    """Doubt another unit of the wheels where it rests on ranges alone, and these contradict each other."""
    kinds = {notice.kind for notice in task.stages.warnings}
    if task.recordings.have_scans or "odometry-unit" not in kinds:
        return
    if "sustained-outliers" in kinds or any(name_and_number(name)[1] > 1 for name in anchor_ids):
        text = (
            "the unit that the wheels were given rests on the ranges alone, and an anchor was moved or disagrees for long; "
            "give the anchors' places, or the distance between two"
        )
        task.stages.doubt("odometry-unit", text)
