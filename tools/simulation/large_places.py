"""The large and sparse buildings, where a lidar of a few metres sees little and the radio carries the map."""

from dataclasses import replace

import numpy as np

from .floorplans import ANCHOR_IDS, FloorPlan, box


def wall(x1: float, y1: float, x2: float, y2: float, doors: tuple[float, ...], width: float = 2.4) -> list[list[float]]:
    """Return a straight wall from 1 to 2 that is open over a width about each of these distances from 1, m."""
    start, end = np.array([x1, y1]), np.array([x2, y2])
    length = float(np.hypot(*(end - start)))
    cuts = [0.0, *(s + half * width for s in sorted(doors) for half in (-0.5, 0.5)), length]
    points = start + np.outer(cuts, (end - start) / length)
    return [[*a, *b] for a, b in zip(points[::2].tolist(), points[1::2].tolist(), strict=True)]


def arena() -> FloorPlan:
    """70 x 45 m, nearly empty: smooth walls, five posts, six anchors; from most places nothing is within the lidar's reach."""
    return FloorPlan(
        name="arena",
        size=(70.0, 45.0),
        walls=np.array(box(0, 0, 70, 45)),
        columns=np.array([[x, y, 0.3] for x, y in ((17.0, 14.0), (35.0, 31.0), (52.0, 12.5), (14.5, 33.0), (57.0, 34.0))]),
        anchors=np.array([[0.8, 1.2], [35.6, 0.5], [69.2, 1.9], [68.6, 44.1], [33.1, 44.4], [1.4, 43.2]]),
        landmarks=tuple(f"P{i}" for i in range(1, 6)),
        start=(10.0, 8.0, 0.0),
        minutes=40.0,
    )


def tunnel() -> FloorPlan:
    """110 m corridor, 3 m wide, smooth, with four side arms of 4 m; six anchors on one line under its ceiling."""
    arms = (17.0, 48.5, 66.0, 94.0)
    walls = wall(0.2, 5.0, 110.2, 5.0, (arms[0], arms[2])) + wall(0.2, 8.0, 110.2, 8.0, (arms[1], arms[3]))
    walls += [[0.2, 5.0, 0.2, 8.0], [110.2, 5.0, 110.2, 8.0]]
    for x, into in zip(arms, (-4.0, 4.0, -4.0, 4.0), strict=True):
        y, left, right = (5.0 if into < 0 else 8.0), x + 0.2 - 1.2, x + 0.2 + 1.2
        walls += [[left, y, left, y + into], [left, y + into, right, y + into], [right, y + into, right, y]]
    return FloorPlan(
        name="tunnel",
        size=(110.4, 13.0),
        walls=np.array(walls),
        columns=np.array([[x, y, 0.15] for x, y in ((17.9, 1.4), (48.0, 11.6), (65.6, 1.5), (93.3, 11.5))]),
        anchors=np.array([[x, 6.5] for x in (2.0, 23.0, 45.0, 67.0, 88.0, 108.5)]),
        landmarks=("T1", "T2", "T3", "T4"),
        start=(3.0, 6.3, 0.0),
        minutes=30.0,
    )


def site() -> FloorPlan:
    """150 x 100 m: four halls, a corridor between them, a yard; sixteen anchors, three to five in reach at a time."""
    walls = box(0, 0, 150, 100)
    walls += wall(0, 48, 100, 48, (12.0, 44.0, 82.0)) + wall(0, 51, 100, 51, (20.0, 52.0, 74.0))
    walls += wall(60, 0, 60, 48, (15.0,)) + wall(60, 51, 60, 100, (33.0,))
    walls += wall(100, 0, 100, 48, (20.0,), 5.0) + wall(100, 48, 100, 51, (1.5,)) + wall(100, 51, 100, 100, (30.0,), 5.0)
    for y in (7.0, 14.0, 21.0, 28.0, 35.0):
        walls += box(8.0, y, 20.0, 2.4) + box(33.0, y, 18.0, 2.4)
    # fmt: off
    for x, y, width, depth in (
        (66.0, 6.0, 3.0, 1.5), (74.0, 30.0, 2.0, 4.0), (88.0, 12.0, 5.0, 2.0), (92.0, 38.0, 1.2, 1.2), (80.0, 20.5, 1.5, 1.5),
        (66.0, 60.0, 2.2, 6.0), (72.0, 62.0, 2.2, 6.0), (78.0, 60.0, 2.2, 6.0), (84.0, 78.0, 7.0, 2.0), (68.0, 90.0, 6.0, 1.6),
        (112.0, 20.0, 6.0, 2.5), (130.0, 62.0, 2.5, 6.0), (120.0, 84.0, 6.0, 2.5), (136.0, 32.0, 2.5, 12.0),
    ):
        walls += box(x, y, width, depth)
    # fmt: on
    columns = [[x, y, 0.3] for x in (12.0, 30.0, 48.0) for y in (63.0, 76.0, 89.0)]
    columns += [[104.0, 50.0, 0.25], [118.0, 50.0, 0.25], [145.0, 96.0, 0.25]]
    # fmt: off
    anchors = [
        [1.0, 1.2], [30.5, 0.8], [59.2, 24.0], [0.9, 47.0], [30.0, 49.5], [1.1, 98.8], [29.5, 99.0], [59.0, 72.0],
        [61.0, 2.0], [98.8, 1.5], [80.5, 47.2], [62.0, 98.0], [99.2, 75.0], [124.0, 1.5], [148.8, 46.0], [126.0, 98.7],
    ]
    # fmt: on
    return FloorPlan(
        name="site",
        size=(150.0, 100.0),
        walls=np.array(walls),
        columns=np.array(columns),
        anchors=np.array(anchors),
        landmarks=tuple(f"S{i}" for i in range(1, len(columns) + 1)),
        start=(3.0, 49.5, 0.0),
        minutes=40.0,
        opacity=0.3,
        radio_range=45.0,
    )


def site_next_day() -> FloorPlan:
    """The site a night later: the anchor at the racks was moved by three metres, the one of the corridor was replaced."""
    before = site()
    anchors, ids = before.anchors.copy(), list(ANCHOR_IDS)
    anchors[1] += (3.0, 0.6)
    ids[4] = "55AA"
    return replace(before, name="site_next_day", anchors=anchors, anchor_ids=tuple(ids))
