"""Stretches of the trajectory that the lidar has displaced, detected by the ranges to several anchors together.

Where a lidar sees bare walls only and the wheels miss some of the distance, scans and odometry agree on a wrong place, and the
robust kernel treats the ranges of that stretch as outliers. They disagree with the map, and agree with a path beside it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from ..arrays import Bools, Floats, Ints
from ..findings import Finding, doubt
from ..map_result import AnchorEstimate
from ..pipeline.estimate import Task
from .moments import parts_beside

_WAY, _STEP = 5.0, 1.0
"""m; length of the stretches that are tested, and distance from one to the next."""
_FEWEST, _ANCHORS = 12, 3
"""Least number of ranges of a stretch that is tested, and of their anchors: any ranges to two fit some path."""
_OFF, _NEAR = 0.5, 0.3
"""m; residuals of ranges that disagree with the map, and of those that agree with the path beside it. The first is also the
least distance of this path."""
_MOST = 0.7
"""Share of a stretch's ranges that must disagree with the map, and of all that must agree with the path beside it."""
_ROUNDS = 20


def check_displaced_stretches(table: dict[str, Floats], anchors: Sequence[AnchorEstimate], task: Task) -> Iterator[Finding]:
    """Doubt a map of recordings with lidar in which the ranges of a stretch agree with another path.

    Parameters
    ----------
    table : MapResult.range_table. anchors : in the order of its numbers.
    """
    places, placed = np.array([a.position for a in anchors]), np.array([a.status != "unplaced" for a in anchors])
    numbers = table["anchor"].astype(np.intp)
    used = (table["weight"] > 0.0) & placed[numbers] if len(numbers) else np.zeros(0, dtype=bool)
    for recording in task.recordings.each if used.any() else ():
        own = np.flatnonzero(used & (table["recording"] == recording.number))
        own = own[np.argsort(table["stamp"][own], kind="stable")]
        if not recording.has_scans or len(own) < _FEWEST:
            continue
        tags = np.column_stack([table["x"], table["y"]])[own]
        found = [
            (first, last, beside)
            for first, last in _stretches(tags, np.abs(table["residual"][own]) > _OFF)
            if (beside := _path_beside(tags[first:last], places[numbers[own[first:last]]], table["residual"][own[first:last]],
                                       numbers[own[first:last]])) is not None
        ]  # fmt: skip
        if found:
            stamps, start = table["stamp"][own], float(recording.frames.stamps[0])
            first, last = min(found)[0], max(last for _, last, _ in found) - 1
            off = float(max(np.hypot(*beside) for *_, beside in found))
            displaced = doubt(
                "ranges-disagree",
                f"from t = {stamps[first] - start:.0f} to {stamps[last] - start:.0f} s the ranges agree with a path "
                f"{off:.1f} m beside that of the map: did the wheels slip where the lidar sees bare walls only?",
                start=float(stamps[first]), end=float(stamps[last]), off=off,
            )  # fmt: skip
            span, cure = (float(stamps[first]), float(stamps[last])), parts_beside(stamps[first] - start, stamps[last] - start)
            yield replace(displaced, recording=recording.number + 1, stretches=(span,), cure=cure)


def _stretches(tags: Floats, off: Bools) -> list[tuple[int, int]]:
    """Return first and last + 1 of the ranges of each stretch of which most disagree with the map.

    Parameters
    ----------
    tags : (m, 2) m, where each range was measured, in order. off : (m,) ranges that disagree.
    """
    way = np.append(0.0, np.cumsum(np.hypot(*np.diff(tags, axis=0).T)))
    begins = np.arange(0.0, way[-1], _STEP)
    first, last = np.searchsorted(way, begins), np.searchsorted(way, begins + _WAY, "right")
    wrong = np.append(0, np.cumsum(off))
    chosen = (last - first >= _FEWEST) & (wrong[last] - wrong[first] >= _MOST * (last - first))
    return list(zip(first[chosen].tolist(), last[chosen].tolist(), strict=True))


def _path_beside(tags: Floats, places: Floats, residuals: Floats, numbers: Ints) -> Floats | None:
    """Return the offset (2,), m, from the map of the path with which the ranges of a stretch agree; None where none is clear.

    Ranges that are all late by the same amount have passed through an obstacle.

    Parameters
    ----------
    tags, places : (m, 2) both ends of the ranges, m. residuals : (m,) measured minus expected, m. numbers : (m,) anchors.
    """
    away = tags - places
    reach, beside = np.hypot(*away.T), np.zeros(2)
    for _ in range(_ROUNDS):
        moved = away + beside
        length = np.maximum(np.hypot(*moved.T), _NEAR)
        left = length - reach - residuals
        slopes, weights = moved / length[:, None], 1.0 / np.maximum(np.abs(left), _NEAR)
        normal = (slopes * weights[:, None]).T @ slopes + _NEAR * np.eye(2)
        beside = beside - np.linalg.solve(normal, (slopes * weights[:, None]).T @ left)
    near = np.abs(np.hypot(*(away + beside).T) - reach - residuals) < _NEAR
    alike = np.abs(residuals - np.median(residuals)) < _NEAR
    clear = near.mean() >= _MOST > alike.mean() and len(np.unique(numbers[near])) >= _ANCHORS
    return beside if clear and np.hypot(*beside) > _OFF else None
