"""Where the robot goes: goals that cover the place again and again, roads between them, and a differential drive on them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from .fields import smooth_field
from .floorplans import FloorPlan

Floats = NDArray[np.float64]

_SPOT_TURN = 0.5
"""Speed of turns on the spot, rad/s."""
_CELL = 0.2
"""Cell of the road map, m."""


@dataclass(frozen=True)
class Motion:
    """True motion: knots of constant twist, so linear interpolation of x, y and unwrapped theta is exact to 0.1 mm."""

    stamps: Floats
    """(n,) s, evenly spaced."""
    poses: Floats
    """(n, 3) T_map_base; theta is unwrapped."""

    def at(self, times: Floats) -> Floats:
        """Return the true poses (..., 3) at the times (...); theta unwrapped."""
        return np.stack([np.interp(times, self.stamps, self.poses[:, k]) for k in range(3)], axis=-1)


class RoadMap:
    """The cells of a plan at least `clearance` m from every obstacle, as a graph."""

    def __init__(self, plan: FloorPlan, clearance: float) -> None:
        shape = np.ceil(np.asarray(plan.size) / _CELL).astype(int) + 1
        fine = 4
        blocked = np.zeros(shape * fine, dtype=bool)
        _draw(plan, blocked, _CELL / fine)
        distance = ndimage.distance_transform_edt(~blocked)[::fine, ::fine] * (_CELL / fine)
        self.shape = shape
        self.free = distance >= clearance
        label, _ = ndimage.label(self.free)
        self.cells = np.argwhere(self.free)
        self.free = label == label[tuple(self.cell(np.array(plan.start[:2])))]
        self.cells = np.argwhere(self.free)
        self.edges = self._edges(np.clip(clearance / np.maximum(distance, 1e-3), 0.2, 1.0))

    def cell(self, point: Floats) -> NDArray[np.intp]:
        """Return the free cell nearest to a point."""
        nearest: NDArray[np.intp] = self.cells[np.argmin(((self.cells * _CELL - point) ** 2).sum(axis=1))]
        return nearest

    def _edges(self, dear: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
        number = np.arange(self.free.size).reshape(self.free.shape)
        rows, cols, cost = [], [], []
        for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1), (2, 1), (1, 2), (2, -1), (1, -2)):
            a = (slice(0, self.shape[0] - dx), slice(max(0, -dy), self.shape[1] - max(0, dy)))
            b = (slice(dx, None), slice(max(0, dy), self.shape[1] + min(0, dy)))
            both = self.free[a] & self.free[b]
            rows.append(number[a][both])
            cols.append(number[b][both])
            cost.append(np.hypot(dx, dy) * (1.0 + dear[a][both] + dear[b][both]))
        return np.concatenate(rows), np.concatenate(cols), np.concatenate(cost)

    def roads(self, start: Floats, goals: NDArray[np.intp], taste: Floats) -> list[Floats]:
        """Return the cheapest road (k, 2) from the start to each goal cell; taste (cells,) makes places dear or cheap."""
        source = int(np.ravel_multi_index(tuple(self.cell(start)), self.free.shape))
        liking = np.ones(self.free.size)
        liking[np.ravel_multi_index(tuple(self.cells.T), self.free.shape)] = taste
        rows, cols, cost = self.edges
        graph = sparse.csr_array((cost * (liking[rows] + liking[cols]), (rows, cols)), shape=(self.free.size,) * 2)
        _, before = csgraph.dijkstra(graph, directed=False, indices=source, return_predecessors=True)
        roads = []
        for goal in goals:
            nodes = [int(np.ravel_multi_index(tuple(goal), self.free.shape))]
            while nodes[-1] != source:
                nodes.append(int(before[nodes[-1]]))
            roads.append(np.stack(np.unravel_index(nodes[::-1], self.free.shape), axis=1) * _CELL)
        return roads


def _draw(plan: FloorPlan, blocked: NDArray[np.bool_], cell: float) -> None:
    for x1, y1, x2, y2 in plan.walls:
        n = int(np.hypot(x2 - x1, y2 - y1) / cell * 2) + 2
        blocked[np.rint(np.linspace(x1, x2, n) / cell).astype(int), np.rint(np.linspace(y1, y2, n) / cell).astype(int)] = True
    gx, gy = np.meshgrid(*(np.arange(n) * cell for n in blocked.shape), indexing="ij")
    for x, y, radius in plan.columns:
        blocked[np.hypot(gx - x, gy - y) <= radius + cell] = True


def wander(
    plan: FloorPlan, rng: np.random.Generator, length: float, clearance: float = 0.5, start: Floats | None = None
) -> Floats:
    """Return a dense polyline (k, 2), at least `length` m long, that keeps going where it has been least.

    Every leg has a taste of its own for places, so that legs between the same ends differ; turning back is avoided.
    """
    roads = RoadMap(plan, clearance)
    places = roads.cells * _CELL
    here = np.asarray(plan.start[:2] if start is None else start, dtype=np.float64)
    course = np.array([np.cos(plan.start[2]), np.sin(plan.start[2])])
    visits, travelled, track = np.zeros(len(places)), 0.0, [here[None]]
    stride = 0.35 * min(plan.size)
    while travelled < length:
        taste = np.exp(0.7 * smooth_field(rng, places, 3.0))
        far = np.flatnonzero(np.hypot(*(places - here).T) > stride)
        choice = rng.choice(far, size=min(24, len(far)), replace=False)
        legs = roads.roads(here, roads.cells[choice], taste)
        ahead = np.array([_unit(leg[min(5, len(leg) - 1)] - leg[0]) @ course for leg in legs])
        typical = visits.mean() + 1.0
        best = int(np.argmin(visits[choice] / typical - 0.7 * ahead + rng.uniform(0, 0.5, len(choice))))
        leg = legs[best]
        visits += cKDTree(leg[::4]).query_ball_point(places, 1.5, return_length=True)
        travelled += np.hypot(*np.diff(leg, axis=0).T).sum()
        track.append(leg[1:])
        course, here = _unit(leg[-1] - leg[max(0, len(leg) - 6)]), leg[-1]
    return _smooth(np.concatenate(track))


def _unit(vector: Floats) -> Floats:
    return vector / max(1e-9, float(np.hypot(*vector)))


def _smooth(road: Floats) -> Floats:
    """Resample a road of cells every 5 cm and round its corners by two moving means over 0.65 m."""
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(road, axis=0).T))])
    at = np.arange(0.0, s[-1] + 0.05, 0.05)
    dense = np.stack([np.interp(at, s, road[:, k]) for k in range(2)], axis=1)
    once = ndimage.uniform_filter1d(dense, 13, axis=0, mode="nearest")
    return ndimage.uniform_filter1d(once, 13, axis=0, mode="nearest")


def follow(
    track: Floats,
    heading: float,
    speed: float,
    seconds: float,
    step: float = 0.05,
    stops: Sequence[tuple[float, float, float]] = (),
) -> Motion:
    """Drive along a track by pure pursuit with bounded accelerations; two seconds of rest at either end.

    At each of the stops (when, s; how long, s; by how much, rad) the robot turns on the spot, then rests.
    """
    look, max_turn, gain = max(0.35, 1.5 * speed), 0.8, 2.5
    accel, turn_accel = 0.3 * step, 2.0 * step
    x, y, theta = float(track[0, 0]), float(track[0, 1]), heading
    v = w = 0.0
    n = round(seconds / step) + 1
    poses = np.empty((n, 3))
    px, py = track[:, 0].tolist(), track[:, 1].tolist()
    target, last, rest = 0, len(track) - 1, int(2.0 / step)
    standing, turning = np.zeros(n), np.zeros(n)
    for when, pause, turn in stops:
        begin, turned = int(when / step), int(abs(turn) / _SPOT_TURN / step)
        # The robot brakes before it turns.
        standing[begin : begin + turned + int((pause + 1.0) / step)] = 1.0
        turning[begin + int(1.0 / step) : begin + int(1.0 / step) + turned] = np.copysign(_SPOT_TURN, turn)
    for k in range(n):
        poses[k] = x, y, theta
        while target < last and (px[target] - x) ** 2 + (py[target] - y) ** 2 < look * look:
            target += 1
        error = (np.arctan2(py[target] - y, px[target] - x) - theta + np.pi) % (2 * np.pi) - np.pi
        moving = rest <= k < n - rest and standing[k] == 0
        want_v = speed * max(0.0, np.cos(error)) if moving and abs(error) < 1.0 else 0.0
        want_w = np.clip(gain * error, -max_turn, max_turn) if moving else turning[k]
        v += np.clip(want_v - v, -accel, accel)
        w += np.clip(want_w - w, -turn_accel, turn_accel)
        half = 0.5 * w * step
        x += v * step * np.cos(theta + half)
        y += v * step * np.sin(theta + half)
        theta += w * step
    return Motion(np.arange(n) * step, poses)
