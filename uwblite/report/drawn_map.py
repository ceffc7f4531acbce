"""What is drawn of a map, as picture or as SVG: paths, anchors, closures, the box around them, and where names stand."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from ..arrays import Floats, Ints
from ..grid.geometry import central_box
from ..grid.occupancy_grid import OccupancyGrid
from ..map_result import MapResult
from .printable import anchor_line, percent

MOST_SHOWN = 1500
"""Rejected closures, and residuals of one anchor, that are shown at most; accepted closures all are."""
_SIGMAS = 2.0
"""Standard deviations of an ellipse's half axes."""
_MOST_SPREAD = 2.0
"""m of them for which room is made."""
_ANCHOR_REACH = 100.0
"""m; no anchor is reached farther away than this and the extent of the path."""
_MARGIN, _LEAST_MARGIN = 0.03, 0.5
"""Free border around what is drawn: share of its size, and m."""
_NAME_ROOM = 0.12
"""Room to the right of an anchor for its name, as a share of the map's size on a phone."""
_LETTER = 0.7
"""Width of a letter, in heights of a line."""
_SIDES = {"right": (0.75, 0.3), "left": (-0.75, 0.3), "below": (0.0, 1.6), "above": (0.0, -0.85)}
"""Where a name stands beside its anchor, in this order, and the foot of its line, y downwards, in heights of a line."""


@dataclass(frozen=True, slots=True, eq=False)
class DrawnAnchor:
    """An anchor to draw."""

    id: str
    position: Floats
    """(2,) m, map frame; one that is not finite is not drawn."""
    covariance: Floats | None = None
    """(2, 2) m^2; drawn as an ellipse of two standard deviations."""
    kind: str = "ok"
    """'ok', 'doubt', or 'proposed' where it does not stand there yet."""
    text: str = ""
    """Shown where it is pointed at."""
    alternative: Floats | None = None
    """(2,) m; its mirror image."""


class DrawnClosure(NamedTuple):
    """A candidate of a loop closure to draw."""

    ends: Floats
    """(2, 2) m; where the robot was at both times."""
    accepted: bool
    text: str = ""
    """Shown where it is pointed at."""


@dataclass(frozen=True, slots=True, eq=False)
class DrawnMap:
    """A map to draw."""

    grid: OccupancyGrid | None
    paths: Sequence[Floats] = ()
    """(n, 2 or more) x, y of the base along each recording, m, map frame."""
    anchors: Sequence[DrawnAnchor] = ()
    closures: Sequence[DrawnClosure] = ()
    doubted: Sequence[Floats] = ()
    """(n, 2) x, y along each stretch of a path that is not to be trusted, m."""

    def placed(self) -> list[DrawnAnchor]:
        return [a for a in self.anchors if np.isfinite(a.position).all()]

    def box(self) -> Floats:
        """Return lower and upper corner (2, 2) of all but what strays far from the rest, with room for names, m."""
        path = np.concatenate([np.zeros((0, 2)), *(p[:, :2] for p in self.paths)])
        path = path[np.isfinite(path).all(axis=1)]
        places = np.array([a.position + side for a in self.placed() for side in _reach(a)]).reshape(-1, 2)
        if len(path):
            low, high = central_box(path)
            far = max(float((high - low).max()), _ANCHOR_REACH)
            path, places = np.clip(path, low, high), np.clip(places, low - far, high + far)
        parts = [path, places]
        if self.grid is not None and (observed := self.grid.log_odds != 0.0).any():
            rows, cols = np.flatnonzero(observed.any(axis=1)), np.flatnonzero(observed.any(axis=0))
            parts.append(self.grid.geometry.centre_of(rows[[0, -1]], cols[[0, -1]]))
        points = np.concatenate(parts)
        low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else np.zeros((2, 2))
        size = float((high - low).max())
        high[0] = max(high[0], places[:, 0].max(initial=-math.inf) + _NAME_ROOM * size)
        margin = _MARGIN * size + _LEAST_MARGIN
        return np.stack([low - margin, high + margin])


def drawn_map(result: MapResult) -> DrawnMap:
    """Return what is drawn of a result."""
    places = result.graph.poses[:, :2]
    anchors = [
        DrawnAnchor(a.id, a.position, a.covariance, "ok" if a.status == "ok" else "doubt", anchor_line(a), a.alternative)
        for a in result.anchors
    ]
    closures = [
        DrawnClosure(
            places[[c.i, c.j]],
            c.accepted,
            f"{c.i}\u2013{c.j}: {c.reason} (fitness {c.fitness:.3f} m, overlap {percent(c.overlap)})",
        )
        for c in result.closures
    ]
    paths = [result.trajectory[result.recording == k, :2] for k in np.unique(result.recording)]
    return DrawnMap(result.grid, paths, anchors, closures, result.doubted_paths())


def thin(n: int, most: int) -> Ints:
    """Return at most about `most` of n indices, evenly spread, the last included."""
    return np.unique(np.append(np.arange(0, n, max(1, -(-n // most))), n - 1)) if n else np.zeros(0, dtype=np.intp)


def shown_closures(accepted: Iterable[bool]) -> list[int]:
    """Return the places of all accepted closures, then those of a sample of the rejected ones."""
    kept = np.array([*accepted], dtype=bool)
    rejected = np.flatnonzero(~kept)
    return np.append(np.flatnonzero(kept), rejected[thin(len(rejected), MOST_SHOWN)]).tolist()


def ellipse(covariance: Floats | None) -> tuple[float, float, float] | None:
    """Return the half axes of two standard deviations, m, the longer one first, and its angle, rad; None = not known."""
    if covariance is None or not np.isfinite(covariance).all():
        return None
    values, vectors = np.linalg.eigh(covariance)
    minor, major = (_SIGMAS * np.sqrt(np.maximum(values, 0.0))).tolist()
    return major, minor, math.atan2(vectors[1, 1], vectors[0, 1])


def _reach(anchor: DrawnAnchor) -> Floats:
    """Return the corners (2, 2) of an anchor's ellipse from its middle, m; of a vast one only a part."""
    if anchor.covariance is None or not np.isfinite(anchor.covariance).all():
        return np.zeros((1, 2))
    reach = np.minimum(_SIGMAS * np.sqrt(np.maximum(np.diag(anchor.covariance), 0.0)), _MOST_SPREAD)
    return np.stack([-reach, reach])


def name_box(side: str, letters: int) -> Floats:
    """Return lower and upper corner (2, 2) of a name beside its anchor, y upwards, in heights of a line."""
    x, foot = _SIDES[side]
    width = _LETTER * letters
    left = {"right": x, "left": x - width}.get(side, -width / 2)
    return np.array([[left, -foot], [left + width, 1.0 - foot]])


def free_sides(drawn: DrawnMap, frame: Floats, heights: Sequence[float]) -> list[str]:
    """Return on which side of each anchor its name covers the fewest walls, within the map where that is possible.

    Parameters
    ----------
    frame : lower and upper corner of the map (2, 2), m.
    heights : of a line of text, as shares of the map's longer side; more than one where it is shown in several sizes.
    """
    walls = np.zeros((0, 2)) if drawn.grid is None else drawn.grid.occupied_points()
    lines = float(np.ptp(frame, axis=0).max()) * np.asarray(heights)

    def cost(anchor: DrawnAnchor, side: str) -> tuple[int, int]:
        boxes = [anchor.position + line * name_box(side, len(anchor.id)) for line in lines]
        outside = sum(bool((b[0] < frame[0]).any() or (b[1] > frame[1]).any()) for b in boxes)
        return outside, sum(int(((walls >= b[0]) & (walls <= b[1])).all(axis=1).sum()) for b in boxes)

    return [min(_SIDES, key=partial(cost, anchor)) for anchor in drawn.anchors]
