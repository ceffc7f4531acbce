"""Graphs of stated size for benchmarks: the paper's, multiples of it, and those of public files."""

import gzip
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uwblite import se2
from uwblite.graph.graph import Graph
from uwblite.graph.pose_edges import RelativePoseEdges
from uwblite.graph.range_edges import RangeEdges

Floats = NDArray[np.float64]

STEP = 0.5
"""Distance between poses, m."""
SIGMA_RANGE = 0.1
SIGMA_ODOMETRY = np.array([0.02, 0.01, 0.01])
SIGMA_CLOSURE = np.array([0.03, 0.03, 0.01])
RANGES_PER_POSE = 2831 / 750
CLOSURES_PER_POSE = 127 / 750
SIDE = 20.0
"""Side of the hall of the paper, m; a graph n times as large covers n times the area with n times the anchors."""


def paper_graph(times: int = 1, seed: int = 0, guess: str = "odometry") -> tuple[Graph, Floats]:
    """Return a graph of `times` the paper's size, and its true poses.

    At 1: 750 poses, 4 anchors, 2,831 ranges, 127 closures. Guesses: 'odometry' = the dead-reckoned path and anchors
    trilaterated on its beginning, 'truth' = where the noise was added.
    """
    rng = np.random.default_rng(seed)
    n = 750 * times
    side = SIDE * np.sqrt(times)
    truth = _drive(n, side, rng)
    odometry = _odometry(truth, rng)
    k = int(np.ceil(np.sqrt(4 * times)))
    at = (np.arange(k) + 0.5) * side / k
    anchors = np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)[: 4 * times] + rng.normal(
        scale=side / k / 6, size=(4 * times, 2)
    )
    closures = _closures(truth, int(CLOSURES_PER_POSE * n), rng)
    ranges = _ranges(truth, anchors, int(RANGES_PER_POSE * n) if times > 1 else 2831, rng)
    poses = truth.copy() if guess == "truth" else _chain(truth[0], odometry.T_i_j)
    start = anchors if guess == "truth" else trilaterated(poses, ranges, len(anchors))
    return Graph(poses, start, (odometry, closures, ranges)), truth


def _drive(n: int, side: float, rng: np.random.Generator) -> Floats:
    """Drive from one random goal to the next, turning by at most 0.35 rad a step."""
    poses = np.zeros((n, 3))
    poses[0] = side / 2, side / 2, 0.0
    goal = poses[0, :2]
    for k in range(1, n):
        if np.hypot(*(goal - poses[k - 1, :2])) < 1.5:
            goal = np.clip(poses[k - 1, :2] + rng.uniform(-20, 20, size=2), 1.0, side - 1.0)
        want = np.arctan2(*(goal - poses[k - 1, :2])[::-1])
        turn = np.clip(se2.wrap_angle(want - poses[k - 1, 2]), -0.35, 0.35)
        poses[k] = se2.compose(poses[k - 1], [STEP, 0.0, turn])
    return poses


def _odometry(truth: Floats, rng: np.random.Generator) -> RelativePoseEdges:
    i = np.arange(len(truth) - 1)
    motion = se2.between(truth[:-1], truth[1:]) + rng.normal(size=(len(i), 3)) * SIGMA_ODOMETRY
    return RelativePoseEdges(i, i + 1, motion, np.tile(np.diag(1.0 / SIGMA_ODOMETRY), (len(i), 1, 1)))


def _closures(truth: Floats, count: int, rng: np.random.Generator) -> RelativePoseEdges:
    from scipy.spatial import cKDTree

    pairs = cKDTree(truth[:, :2]).query_pairs(1.0, output_type="ndarray")
    pairs = pairs[np.abs(pairs[:, 0] - pairs[:, 1]) > 40]
    pairs = np.sort(pairs[rng.permutation(len(pairs))[:count]], axis=1)
    measured = se2.between(truth[pairs[:, 0]], truth[pairs[:, 1]]) + rng.normal(size=(len(pairs), 3)) * SIGMA_CLOSURE
    return RelativePoseEdges(pairs[:, 0], pairs[:, 1], measured, np.tile(np.diag(1.0 / SIGMA_CLOSURE), (len(pairs), 1, 1)))


def _ranges(truth: Floats, anchors: Floats, count: int, rng: np.random.Generator) -> RangeEdges:
    from scipy.spatial import cKDTree

    _, nearest = cKDTree(anchors).query(truth[:, :2], k=4)
    chosen = np.sort(rng.permutation(nearest.size)[:count])
    pose, anchor = chosen // 4, nearest.ravel()[chosen]
    distance = np.hypot(*(truth[pose, :2] - anchors[anchor]).T)
    return range_edges(pose, anchor, distance + rng.normal(scale=SIGMA_RANGE, size=count), np.full(count, SIGMA_RANGE))


def range_edges(pose: Floats, anchor: Floats, ranges: Floats, sigma: Floats) -> RangeEdges:
    """Return ranges from the poses themselves: no lever arm, no calibration."""
    none, e = np.zeros((len(pose), 2)), len(pose)
    calibration = np.full((e, 6), -1)
    return RangeEdges(pose, anchor, ranges, sigma, none, none[:, 0], none, np.zeros(2), none[:, 0], calibration)


def _chain(first: Floats, motions: Floats) -> Floats:
    poses = [np.asarray(first, dtype=float)]
    for motion in motions:
        poses.append(se2.compose(poses[-1], motion))
    return np.array(poses)


def trilaterated(poses: Floats, ranges: RangeEdges, anchors: int, most: int = 300) -> Floats:
    """Return anchors (a, 2) fitted to the first `most` ranges of each by linear least squares on squared distances."""
    found = np.zeros((anchors, 2))
    for a in range(anchors):
        mine = np.nonzero(ranges.anchor == a)[0][:most]
        at = poses[ranges.pose[mine], :2]
        system = np.column_stack([-2.0 * at, np.ones(len(at))])
        found[a] = np.linalg.lstsq(system, ranges.ranges[mine] ** 2 - np.sum(at**2, axis=1), rcond=None)[0][:2]
    return found


def g2o_graph(path: Path) -> Graph:
    """Read a pose graph; without vertices the chain of edges i -> i + 1 is the guess."""
    with gzip.open(path, "rt") as lines:
        rows = [line.split() for line in lines]
    vertices = {int(r[1]): [float(x) for x in r[2:5]] for r in rows if r[0] == "VERTEX_SE2"}
    table = np.array([[float(x) for x in r[1:12]] for r in rows if r[0] == "EDGE_SE2"])
    i, j = table[:, 0].astype(np.intp), table[:, 1].astype(np.intp)
    edges = RelativePoseEdges(i, j, table[:, 2:5].copy(), _sqrt(table[:, 5:]))
    if vertices:
        return Graph(np.array([vertices[k] for k in range(len(vertices))]), edges=(edges,))
    chain = {int(a): z for a, b, z in zip(i, j, table[:, 2:5], strict=True) if b == a + 1}
    return Graph(_chain(np.zeros(3), np.array([chain[k] for k in range(max(j))])), edges=(edges,))


def _sqrt(upper: Floats) -> Floats:
    information = np.empty((len(upper), 3, 3))
    rows, columns = np.triu_indices(3)
    information[:, rows, columns] = information[:, columns, rows] = upper
    return np.ascontiguousarray(np.linalg.cholesky(information).transpose(0, 2, 1))


def pyfg_graph(path: Path) -> Graph:
    """Read poses A*, landmarks L*, odometry and ranges; the guess is the odometry, landmarks trilaterated on it."""
    with gzip.open(path, "rt") as lines:
        rows = [line.split() for line in lines]
    first = next([float(x) for x in r[3:6]] for r in rows if r[0] == "VERTEX_SE2")
    odometry = [r for r in rows if r[0] == "EDGE_SE2"]
    ranges = [r for r in rows if r[0] == "EDGE_RANGE"]
    number = [(int(r[2][1:]), int(r[3][1:])) for r in odometry]
    table = np.array([[float(x) for x in r[4:]] for r in odometry])
    information = np.linalg.inv(np.array([_sqrt(row[None])[0].T @ _sqrt(row[None])[0] for row in table[:, 3:]]))
    sqrt_information = np.ascontiguousarray(np.linalg.cholesky(information).transpose(0, 2, 1))
    i, j = np.array(number).T
    measured = np.array([[float(x) for x in r[4:6]] for r in ranges])
    edges = range_edges(
        np.array([int(r[2][1:]) for r in ranges]),
        np.array([int(r[3][1:]) for r in ranges]),
        measured[:, 0],
        np.sqrt(measured[:, 1]),
    )
    poses = _chain(np.array(first), table[:, :3])
    anchors = trilaterated(poses, edges, int(edges.anchor.max()) + 1, most=len(ranges))
    return Graph(poses, anchors, (RelativePoseEdges(i, j, table[:, :3].copy(), sqrt_information), edges))


def spoilt(graph: Graph, share: float, seed: int = 0) -> Graph:
    """Return a paper graph with a share of false closures and of outlier ranges."""
    rng = np.random.default_rng(seed)
    odometry, closures, ranges = graph.edges
    count = int(len(closures) * share / (1.0 - share))
    i = rng.integers(0, len(graph.poses) - 60, count)
    j = i + rng.integers(40, 60, count)
    false = np.column_stack([rng.normal(size=(count, 2)), rng.uniform(-np.pi, np.pi, count)])
    mixed = RelativePoseEdges(
        np.concatenate([closures.i, i]),
        np.concatenate([closures.j, j]),
        np.concatenate([closures.T_i_j, false]),
        np.concatenate([closures.sqrt_information, np.tile(closures.sqrt_information[0], (count, 1, 1))]),
    )
    off = rng.uniform(-5.0, 10.0, len(ranges)) * (rng.random(len(ranges)) < share)
    return replace(graph, edges=(odometry, mixed, replace(ranges, ranges=ranges.ranges + off)))


def ate(poses: Floats, truth: Floats) -> float:
    """Return the rms distance after the best rigid alignment, m."""
    a, b = (p[:, :2] - p[:, :2].mean(axis=0) for p in (poses, truth))
    turn = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b))
    return float(np.sqrt(np.mean(np.sum((se2.rotate(turn, a) - b) ** 2, axis=1))))


def two_views(points: int, seed: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Return two clouds of a hall with columns, each in its own frame: target, source, true pose and guess."""
    rng = np.random.default_rng(seed)
    corners = [(-5.0, -4.0, 5.0, -4.0), (5.0, -4.0, 5.0, 4.0), (5.0, 4.0, -5.0, 4.0), (-5.0, 4.0, -5.0, -4.0)]
    for x, y in ((-2.0, -1.5), (2.0, -1.5), (-2.0, 1.5), (2.0, 1.5)):
        box = [(x - 0.3, y - 0.3), (x + 0.3, y - 0.3), (x + 0.3, y + 0.3), (x - 0.3, y + 0.3)]
        corners += [(*box[k], *box[(k + 1) % 4]) for k in range(4)]
    walls = np.array(corners)
    length = np.hypot(*(walls[:, 2:] - walls[:, :2]).T)
    truth = np.append(rng.normal(scale=1.0, size=2), rng.uniform(-np.pi, np.pi))

    def view() -> Floats:
        wall = walls[rng.choice(len(walls), points, p=length / length.sum())]
        share = rng.random(points)[:, None]
        return wall[:, :2] * (1.0 - share) + wall[:, 2:] * share + rng.normal(scale=0.015, size=(points, 2))

    source = se2.transform(se2.inverse(truth), view())
    guess = se2.compose(truth, np.append(rng.uniform(-0.2, 0.2, 2), rng.uniform(-0.08, 0.08)))
    return view(), source, truth, guess
