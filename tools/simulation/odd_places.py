"""Places whose surfaces are not straight walls at right angles: round, oblique, thin, or many of one kind."""

import numpy as np

from .floorplans import FloorPlan, box


def _around(radius: float, sides: int, centre: tuple[float, float]) -> list[list[float]]:
    """Return a ring of straight walls."""
    angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    ring = np.asarray(centre) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return [[*a, *b] for a, b in zip(ring[:-1].tolist(), ring[1:].tolist(), strict=True)]


def rotunda() -> FloorPlan:
    """A round hall of 9 m radius with a round counter in its middle and six columns between."""
    columns = [[12 + 5.5 * np.cos(a), 12 + 5.5 * np.sin(a), 0.3] for a in np.arange(6) * np.pi / 3 + 0.2]
    return FloorPlan(
        name="rotunda",
        size=(24.0, 24.0),
        walls=np.array(box(0, 0, 24, 24) + _around(9.0, 96, (12, 12)) + _around(2.0, 40, (12, 12))),
        columns=np.array(columns),
        anchors=np.array([[4.5, 8.0], [19.0, 7.0], [17.5, 18.5], [6.0, 18.0]]),
        landmarks=tuple(f"R{i}" for i in range(1, 7)),
        start=(16.5, 7.5, 1.0),
        minutes=20.0,
    )


def orchard() -> FloorPlan:
    """Rows of thin stems 3 m apart, 6 to 12 cm thick, uneven along the rows; a fence that the lidar hardly reaches."""
    rng = np.random.default_rng(7)
    stems = [
        [x + rng.uniform(-0.3, 0.3), y + rng.uniform(-0.15, 0.15), rng.uniform(0.06, 0.12)]
        for y in np.arange(4.0, 28.0, 3.0) for x in np.arange(4.0, 36.0, 1.8)
    ]  # fmt: skip
    return FloorPlan(
        name="orchard",
        size=(40.0, 32.0),
        walls=np.array(box(0, 0, 40, 32)),
        columns=np.array(stems),
        anchors=np.array([[1.0, 1.5], [38.5, 1.0], [39.0, 30.5], [1.5, 31.0], [20.0, 31.0]]),
        landmarks=("S1", "S2", "S3", "S4"),
        start=(2.0, 2.0, 0.0),
        minutes=20.0,
        opacity=0.2,
    )


def supermarket() -> FloorPlan:
    """Six equal shelves of 12 m, a row of tills, pallets that stand askew."""
    walls = box(0, 0, 26, 20)
    for x in (4.0, 7.5, 11.0, 14.5, 18.0, 21.5):
        walls += box(x, 5.0, 1.1, 12.0)
    for x in (6.0, 9.0, 12.0, 15.0):
        walls += box(x, 2.2, 0.6, 1.4)
    for x, y, turn in ((2.0, 9.0, 0.4), (24.3, 14.0, -0.3), (20.0, 2.5, 0.8)):
        c, s = np.cos(turn), np.sin(turn)
        ends = np.array(box(0, 0, 1.2, 0.8)).reshape(-1, 2) @ np.array([[c, s], [-s, c]]) + [x, y]
        walls += ends.reshape(-1, 4).tolist()
    return FloorPlan(
        name="supermarket",
        size=(26.0, 20.0),
        walls=np.array(walls),
        columns=np.array([[13.0, 18.4, 0.2], [3.0, 18.2, 0.2], [23.5, 3.0, 0.2]]),
        anchors=np.array([[0.8, 0.9], [25.2, 1.1], [24.9, 19.2], [1.0, 19.0]]),
        landmarks=("M1", "M2", "M3"),
        start=(2.0, 4.0, 0.0),
        minutes=20.0,
        opacity=0.5,
    )


def shed() -> FloorPlan:
    """A shed whose walls stand at all angles, with bales along them and four posts."""
    outline = np.array([[1.0, 2.0], [16.0, 0.8], [21.5, 7.5], [19.0, 16.5], [8.0, 18.8], [2.5, 12.0]])
    walls = box(0, 0, 22, 20)
    walls += [[*a, *b] for a, b in zip(outline.tolist(), np.roll(outline, -1, axis=0).tolist(), strict=True)]
    walls += [[6.0, 9.0, 9.5, 7.2], [12.0, 12.5, 13.8, 9.6], [14.5, 4.0, 17.0, 5.1]]
    return FloorPlan(
        name="shed",
        size=(22.0, 20.0),
        walls=np.array(walls),
        columns=np.array([[5.0, 5.5, 0.12], [11.0, 5.0, 0.12], [16.0, 9.5, 0.12], [9.0, 14.5, 0.12]]),
        anchors=np.array([[2.0, 2.6], [16.0, 1.6], [19.0, 15.5], [8.0, 18.0]]),
        landmarks=("B1", "B2", "B3", "B4"),
        start=(4.0, 3.5, 0.3),
        minutes=20.0,
    )
