"""Small graphs with a known truth and one edge of every kind, for the tests of the solver and its neighbours."""

from dataclasses import replace

import numpy as np

from uwblite import se2
from uwblite.graph.graph import Calibration, Graph, PriorEdges, UnknownKey
from uwblite.graph.point_edges import AnchorDistanceEdges, LandmarkEdges, PointDistanceEdges
from uwblite.graph.pose_edges import OdometryEdges, RelativePoseEdges, ScanEdges
from uwblite.graph.range_edges import RangeEdges
from uwblite.graph.robust import Kernel
from uwblite.graph.solver import optimize

NAMES = ("scale", "turn", "per_metre", "per_second", "x", "y", "theta", "delay")
RANGE_NAMES = ("range_scale", "bias", "height2", "tag_x", "tag_y", "range_delay")
SLIP_NAMES = ("sideways_per_turn", "sideways_scale", "sideways_per_metre", "ahead_per_sideways")


def random_poses(rng, n, spread=3.0):
    return np.column_stack([rng.normal(scale=spread, size=(n, 2)), rng.uniform(-np.pi, np.pi, n)])


def every_kind(seed, calibrated=True, edges=8):
    """Return a graph of random estimates and one instance of every kind of edges, random measurements in each."""
    rng = np.random.default_rng(seed)
    n, a, e = 6, 3, edges
    every = NAMES + RANGE_NAMES + SLIP_NAMES
    graph = Graph(
        random_poses(rng, n, 2.0),
        rng.normal(scale=4.0, size=(a, 2)),
        (),
        Calibration(tuple(map(UnknownKey, every)), rng.normal(scale=0.1, size=len(every))),
    )
    i = rng.integers(0, n, e, dtype=np.intp)
    j = (i + rng.integers(1, n, e, dtype=np.intp)) % n
    poses, L = random_poses(rng, e, 1.0), rng.normal(size=(e, 3, 3))

    def which(*columns):
        index = np.tile(np.array(columns), (e, 1))
        return np.where(rng.random(index.shape) < 0.8, index, -1) if calibrated else np.full_like(index, -1)

    laser = np.arange(4, 8) if calibrated else np.full(4, -1)
    kinds = {
        "relative pose": RelativePoseEdges(i, j, poses, L),
        "odometry": OdometryEdges(i, j, poses, rng.normal(size=e), rng.uniform(size=e), L, which(0, 1, 2, 3, 14, 15, 16, 17)),
        "scan": ScanEdges(i, j, poses, L, rng.normal(size=(e, 3)), rng.normal(size=(e, 3)), laser, 0.3),
        "range": RangeEdges(
            pose=i,
            anchor=rng.integers(0, a, e, dtype=np.intp),
            ranges=rng.uniform(1.0, 4.0, e),
            sigma=rng.uniform(0.1, 1.0, e),
            lever_arm=rng.normal(size=(e, 2)),
            turn=rng.normal(size=e),
            velocity=rng.normal(size=(e, 2)),
            tag=rng.normal(size=2),
            height=rng.uniform(size=e),
            calibration=which(8, 9, 10, 11, 12, 13),
        ),
        "landmark": LandmarkEdges(i, rng.integers(0, a, e, dtype=np.intp), rng.normal(size=(e, 2)), rng.normal(size=(e, 2, 2))),
        "prior on poses": PriorEdges("poses", i, poses, L),
        "prior on anchors": PriorEdges(
            "anchors", rng.integers(0, a, e, dtype=np.intp), rng.normal(size=(e, 2)), rng.normal(size=(e, 2, 2))
        ),
        "prior on calibration": PriorEdges("calibration", i, rng.normal(size=(e, 1)), rng.uniform(size=(e, 1, 1))),
        "distance of anchors": AnchorDistanceEdges(i % a, (i + 1) % a, rng.uniform(1.0, 4.0, e), rng.uniform(0.1, 1.0, e)),
        "distance of points": PointDistanceEdges(
            i, j, *rng.normal(size=(2, e, 2)), rng.uniform(1.0, 4.0, e), rng.uniform(0.1, 1.0, e)
        ),
    }
    return graph, kinds


def plain_ranges(pose, anchor, ranges, sigma):
    """Return ranges between poses and anchors themselves: no lever arm, no calibration."""
    e = len(pose)
    none = np.zeros((e, 2))
    return RangeEdges(
        pose, anchor, ranges, np.full(e, sigma), none, none[:, 0], none, np.zeros(2), none[:, 0], np.full((e, 6), -1)
    )


def expected_ranges(edges, graph):
    """Return the ranges (m,) that a graph expects, m, their known delays aside."""
    return edges.residuals(graph)[:, 0] * edges.sigma + edges.corrected


def relative_edges(truth, i, j, sigma, rng=None):
    """Return measurements of pose j in pose i with Gaussian noise (none without rng)."""
    i, j, sigma = np.asarray(i), np.asarray(j), np.asarray(sigma, dtype=float)
    z = se2.between(truth[i], truth[j])
    if rng is not None:
        z = z + rng.normal(size=z.shape) * sigma
    return RelativePoseEdges(i, j, z, np.tile(np.diag(1.0 / sigma), (len(i), 1, 1)))


def loop(seed=0, n=60, anchors=3, noise=True):
    """Return a graph of two rounds of a circle with odometry, closures and ranges, started at its odometry; and the truth."""
    rng = np.random.default_rng(seed)
    angle = np.arange(n) * 4.0 * np.pi / n
    truth = np.column_stack([4.0 * np.sin(angle), 4.0 - 4.0 * np.cos(angle), se2.wrap_angle(angle)])
    where = rng.uniform((-6.0, -2.0), (6.0, 10.0), size=(anchors, 2))
    each = np.arange(n - 1)
    odometry = relative_edges(truth, each, each + 1, [0.05, 0.02, 0.02], rng if noise else None)
    half = np.arange(0, n // 2, 4)
    closures = relative_edges(truth, half, half + n // 2, [0.03, 0.03, 0.01], rng if noise else None)
    pose, anchor = np.repeat(np.arange(n), anchors), np.tile(np.arange(anchors), n)
    distance = np.hypot(*(truth[pose, :2] - where[anchor]).T)
    ranges = plain_ranges(pose, anchor, distance + (rng.normal(scale=0.1, size=len(pose)) if noise else 0.0), 0.1)
    start = [truth[0]]
    for motion in odometry.T_i_j:
        start.append(se2.compose(start[-1], motion))
    guess = where + (rng.normal(scale=0.5, size=where.shape) if anchors else 0.0)
    return Graph(np.array(start), guess, (odometry, closures, ranges)), truth, where


def dense_covariance(graph):
    """Return the covariance of every block of unknowns with every other, zero where fixed, by a dense inverse."""
    H, _, number = dense_system(graph)
    padded = np.zeros((len(H) + 1, len(H) + 1))
    padded[:-1, :-1] = np.linalg.inv(H)
    return lambda a, i, b, j: padded[np.ix_(number[a][i], number[b][j])]


def dense_system(graph):
    """Return H, g and the numbers of the free scalars, assembled edge by edge from the Jacobians."""
    from uwblite.graph.graph import edge_weights
    from uwblite.graph.unknowns import free_unknowns

    widths, number, size = {"poses": 3, "anchors": 2, "calibration": 1}, {}, 0
    for name, free in free_unknowns(graph).items():
        number[name] = np.full((len(free), widths[name]), -1)
        number[name][free] = size + np.arange(free.sum() * widths[name]).reshape(-1, widths[name])
        size += free.sum() * widths[name]
    H, g = np.zeros((size + 1, size + 1)), np.zeros(size + 1)
    for edges in graph.edges:
        linear = edges.linearize(graph)
        for e, weight in enumerate(edge_weights(edges, graph)):
            places = np.concatenate([number[block][index[e]] for block, index, _ in linear.blocks])
            touched, column = np.unique(places, return_inverse=True)
            # An edge may name one unknown twice: its derivatives add up.
            J = np.zeros((linear.residuals.shape[1], len(touched)))
            np.add.at(J.T, column, np.concatenate([jacobian[e] for _, _, jacobian in linear.blocks], axis=1).T)
            H[np.ix_(touched, touched)] += weight * J.T @ J
            g[touched] += weight * J.T @ linear.residuals[e]
    return H[:-1, :-1], g[:-1], number


def lawn(seed, n=1500, side=60.0, drift=0.02):
    """Return a long path between random goals with 16 anchors, guessed by dead reckoning; the truth; the anchors."""
    rng = np.random.default_rng(seed)
    truth = np.zeros((n, 3))
    truth[0, :2] = goal = np.array([side / 2, side / 2])
    for k in range(1, n):
        while np.hypot(*(goal - truth[k - 1, :2])) < 2.0:
            goal = np.clip(truth[k - 1, :2] + rng.uniform(-25.0, 25.0, 2), 2.0, side - 2.0)
        want = np.arctan2(*(goal - truth[k - 1, :2])[::-1])
        turn = np.clip(se2.wrap_angle(want - truth[k - 1, 2]), -0.35, 0.35)
        truth[k] = se2.compose(truth[k - 1], [0.5, 0.0, turn])
    axis = (np.arange(4) + 0.5) * side / 4
    anchors = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2) + rng.normal(scale=2.0, size=(16, 2))
    each = np.arange(n - 1)
    odometry = relative_edges(truth, each, each + 1, [0.02, 0.01, drift], rng)
    distance = np.hypot(*(truth[:, None, :2] - anchors).transpose(2, 0, 1))
    pose = np.repeat(np.arange(n), 3)
    anchor = np.argsort(distance, axis=1)[:, :3].ravel()
    ranges = plain_ranges(pose, anchor, distance[pose, anchor] + rng.normal(scale=0.1, size=len(pose)), 0.1)
    guess = [truth[0]]
    for motion in odometry.T_i_j:
        guess.append(se2.compose(guess[-1], motion))
    return Graph(np.array(guess), np.zeros((16, 2)), (odometry, ranges)), truth, anchors


def calibrated_loop(seed=0, n=60):
    """Return an optimised graph whose ranges have a common scale and bias, with a prior on both, and robust closures."""
    graph, truth, _ = loop(seed, n=n)
    odometry, closures, ranges = graph.edges
    ranges = replace(ranges, calibration=np.tile([0, 1, -1, -1, -1, -1], (len(ranges), 1)))
    prior = PriorEdges("calibration", np.arange(2), np.zeros((2, 1)), np.array([[[50.0]], [[5.0]]]))
    closures = replace(closures, kernel=Kernel("cauchy", 2.0))
    graph = replace(
        graph,
        calibration=Calibration((UnknownKey("scale"), UnknownKey("bias")), np.zeros(2)),
        edges=(odometry, closures, ranges, prior),
    )
    return optimize(graph)[0], truth


def at_random(poses, closures, seed=0):
    """Return a chain of poses and closures between any two of them, all measurements and estimates random."""
    rng = np.random.default_rng(seed)
    i, j = rng.integers(0, poses, (2, closures))
    j = np.where(i == j, (i + 2) % poses, j)
    i, j = np.concatenate([np.arange(poses - 1), i]), np.concatenate([np.arange(1, poses), j])
    measured, start = (rng.normal(scale=[20.0, 20.0, 1.5], size=(count, 3)) for count in (len(i), poses))
    edges = RelativePoseEdges(i, j, measured, np.tile(10.0 * np.eye(3), (len(i), 1, 1)))
    return Graph(start, edges=(edges,), fixed_poses=np.arange(poses) == 0)
