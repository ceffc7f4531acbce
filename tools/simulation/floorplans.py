"""The buildings: straight walls, round columns, anchors. Adding one is a function of ten lines and a row in plans.py."""

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# fmt: off
ANCHOR_IDS = (
    "DD07", "5C0B", "91A3", "1E05", "0F42", "C8D6", "4B19", "A27E", "0093", "E610", "7D3C", "36F8",
    "AD31", "1B77", "C402", "8F5E",
)
# fmt: on


@dataclass(frozen=True)
class FloorPlan:
    """A building seen from above, at the height of the laser."""

    name: str
    size: tuple[float, float]
    """Width and depth, m; the outer walls run along its edges, the lower left corner is the origin."""
    walls: Floats
    """(w, 4) x1, y1, x2, y2 of each straight wall, outer walls first, m."""
    columns: Floats
    """(c, 3) x, y, radius of each round obstacle, m."""
    anchors: Floats
    """(a, 2) places of the anchors, m."""
    landmarks: tuple[str, ...]
    """Names of the first columns; the rest of the columns (table legs) have none."""
    start: tuple[float, float, float]
    """Pose at which the recording begins."""
    minutes: float
    """Usual length of the recording."""
    opacity: float = 1.0
    """How much one obstacle disturbs a radio ray: 1 = concrete, 0 = air."""
    pairs: tuple[tuple[str, str], ...] = field(default=())
    """Pairs of landmarks whose distance is judged; empty = all of them."""
    anchor_ids: tuple[str, ...] = ANCHOR_IDS
    """Names of the anchors, at least as many as there are."""
    radio_range: float = np.inf
    """Distance beyond which no anchor is in reach in this place, m; a radio may reach less."""


def box(x: float, y: float, width: float, depth: float) -> list[list[float]]:
    """Return the four walls of a rectangle with lower left corner x, y."""
    a, b = x + width, y + depth
    return [[x, y, a, y], [a, y, a, b], [a, b, x, b], [x, b, x, y]]


def hall() -> FloorPlan:
    """20 x 20 m, plain walls, eight columns in two rows of four; the ten pairs are the neighbours in that grid."""
    columns = [[x, y, 0.35] for y in (6.5, 13.5) for x in (4.0, 8.0, 12.0, 16.0)]
    rows = [(f"C{i}", f"C{i + 1}") for i in (1, 2, 3, 5, 6, 7)]
    across = [(f"C{i}", f"C{i + 4}") for i in (1, 2, 3, 4)]
    return FloorPlan(
        name="hall",
        size=(20.0, 20.0),
        walls=np.array(box(0, 0, 20, 20)),
        columns=np.array(columns),
        anchors=np.array([[1.2, 2.0], [18.4, 1.1], [17.7, 18.6], [2.1, 17.5]]),
        landmarks=tuple(f"C{i}" for i in range(1, 9)),
        start=(10.0, 3.0, 0.0),
        minutes=31.0,
        pairs=tuple(rows + across),
    )


def corridor() -> FloorPlan:
    """12 x 26 m loop, 2.4 m wide, with door niches at uneven distances and six litter bins along the walls."""
    walls = box(0, 0, 12, 26)
    walls += niches(2.4, 2.4, 2.4, 23.6, at=(3.1, 7.4, 9.9, 16.2, 20.8), deep=0.25)
    walls += niches(9.6, 23.6, 9.6, 2.4, at=(1.7, 6.0, 12.9, 17.5), deep=0.25)
    walls += niches(9.6, 2.4, 2.4, 2.4, at=(2.2,), deep=0.25) + niches(2.4, 23.6, 9.6, 23.6, at=(4.4,), deep=0.25)
    bins = [[0.45, 4.3], [11.5, 8.9], [0.5, 18.1], [11.55, 20.6], [5.2, 0.5], [7.3, 25.45]]
    return FloorPlan(
        name="corridor",
        size=(12.0, 26.0),
        walls=np.array(walls),
        columns=np.array([[x, y, 0.22] for x, y in bins]),
        anchors=np.array([[0.4, 0.9], [11.6, 1.6], [11.3, 25.2], [0.7, 24.6]]),
        landmarks=tuple(f"B{i}" for i in range(1, 7)),
        start=(1.2, 3.0, np.pi / 2),
        minutes=20.0,
    )


def niches(x1: float, y1: float, x2: float, y2: float, at: tuple[float, ...], deep: float) -> list[list[float]]:
    """Return a wall from 1 to 2 with door niches 0.9 m wide, cut to its right at the given distances from 1."""
    start, end = np.array([x1, y1]), np.array([x2, y2])
    along = (end - start) / np.hypot(*(end - start))
    into = deep * np.array([along[1], -along[0]])
    points = [start]
    for s in sorted(at):
        a, b = start + (s - 0.45) * along, start + (s + 0.45) * along
        points += [a, a + into, b + into, b]
    points.append(end)
    return [[*p, *q] for p, q in pairwise(points)]


def lab() -> FloorPlan:
    """15 x 20 m, cluttered: half walls, cabinets, table legs, four pillars."""
    walls = box(0, 0, 15, 20)
    walls += [[0, 8.2, 4.6, 8.2], [6.4, 8.2, 10.3, 8.2], [9.0, 8.2, 9.0, 4.9], [9.4, 13.1, 15, 13.1], [5.2, 20, 5.2, 15.8]]
    # fmt: off
    for x, y, width, depth in (
        (0.05, 1.2, 0.5, 2.4), (3.2, 0.05, 1.8, 0.6), (7.3, 0.05, 1.0, 0.45), (14.3, 2.3, 0.65, 1.7),
        (14.45, 7.0, 0.5, 2.9), (0.05, 10.0, 0.6, 1.2), (0.05, 14.1, 0.45, 2.6), (2.0, 19.2, 1.6, 0.75), (7.6, 19.4, 2.2, 0.55),
        (12.1, 19.0, 0.9, 0.95), (10.9, 13.15, 1.2, 0.5), (2.3, 4.6, 1.4, 0.7), (11.6, 10.1, 0.8, 0.8),
        (6.9, 11.2, 0.6, 1.5), (2.4, 11.6, 1.2, 0.6),
        (11.4, 4.4, 0.7, 1.3), (8.4, 16.6, 1.3, 0.6),
    ):
        walls += box(x, y, width, depth)
    # fmt: on
    pillars = [[5.6, 4.4, 0.25], [11.2, 7.0, 0.25], [4.6, 13.6, 0.25], [11.7, 16.2, 0.25]]
    legs = [[x + dx, y + dy, 0.03] for x, y in ((6.4, 2.3), (12.5, 15.0), (1.3, 6.6)) for dx in (0, 1.4) for dy in (0, 0.7)]
    return FloorPlan(
        name="lab",
        size=(15.0, 20.0),
        walls=np.array(walls),
        columns=np.array(pillars + legs),
        anchors=np.array([[0.9, 0.6], [14.2, 1.3], [14.1, 18.4], [0.8, 18.9]]),
        landmarks=("P1", "P2", "P3", "P4"),
        start=(4.4, 6.4, 0.0),
        minutes=20.0,
        opacity=0.6,
    )


def warehouse() -> FloorPlan:
    """60 x 40 m, equal racks in three blocks of six: every aisle looks like every other; eight pillars, eight anchors."""
    walls = box(0, 0, 60, 40)
    for x in (4.0, 23.0, 42.0):
        for y in (4.0, 9.8, 15.6, 21.4, 27.2, 33.0):
            walls += box(x, y, 14.0, 2.6)
    anchors = [[0.8, 1.0], [30.5, 0.6], [59.1, 1.4], [59.3, 21.5], [58.8, 39.2], [29.2, 39.4], [1.1, 38.7], [0.7, 18.1]]
    pillars = [[20.5, 8.1], [39.5, 8.1], [20.5, 19.8], [39.5, 19.8], [20.5, 31.4], [39.5, 31.4], [1.6, 19.8], [58.4, 19.8]]
    return FloorPlan(
        name="warehouse",
        size=(60.0, 40.0),
        walls=np.array(walls),
        columns=np.array([[x, y, 0.3] for x, y in pillars]),
        anchors=np.array(anchors),
        landmarks=tuple(f"P{i}" for i in range(1, 9)),
        start=(2.0, 2.0, 0.0),
        minutes=60.0,
        opacity=0.3,
    )


def room() -> FloorPlan:
    """7 x 6 m: a few minutes are enough; for the first try and the tests."""
    walls = box(0, 0, 7, 6) + box(5.4, 4.9, 1.55, 1.05) + box(0.05, 2.2, 0.5, 1.4) + [[3.4, 6.0, 3.4, 4.9]]
    columns = [[2.1, 1.7, 0.15], [4.9, 2.4, 0.2], [2.0, 4.3, 0.15]]
    return FloorPlan(
        name="room",
        size=(7.0, 6.0),
        walls=np.array(walls),
        columns=np.array(columns),
        anchors=np.array([[0.3, 0.4], [6.7, 0.5], [6.6, 4.6], [0.5, 5.6]]),
        landmarks=("C1", "C2", "C3"),
        start=(3.5, 1.0, 0.0),
        minutes=4.0,
    )
