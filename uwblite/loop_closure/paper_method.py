"""Loop closures by the paper's method: ICP between sub-maps that overlap after the first optimisation.

One registration per pair, from the graph's guess; a pair is accepted when the fitness score, the mean squared distance
of the source's points to the target, is below a threshold.
"""

from collections.abc import Callable
from concurrent.futures import Executor

import numpy as np

from .. import se2
from ..arrays import Floats, Ints
from ..graph.graph import Graph
from ..lidar.clouds import Clouds
from ..lidar.point_cloud import make_tree
from ..lidar.point_to_point import IcpConfig, Registration, align
from ..lidar.submaps import Submaps
from ..map_result import LoopClosure
from .candidates import CandidatePolicy, best_per_submap
from .closures import Closures, LoopClosureConfig, collected
from .parallel import batches, in_order

_CELL = 0.5
"""m, edge of squares; the overlap of two sub-maps is the share of the smaller one's squares in which both have points."""

_Batch = tuple[Clouds, Ints, Ints, Floats, IcpConfig]
"""Clouds of sub-maps, and numbers of targets and sources among them with the guessed poses of these pairs."""


def find(
    graph: Graph, submaps: Submaps, recording: Ints, config: LoopClosureConfig, icp: IcpConfig,
    progress: Callable[[int, int], None] | None = None, executor: Executor | None = None,
) -> Closures:
    """Align every pair of sub-maps that overlap by the graph; keep all, with their outcomes.

    Parameters
    ----------
    recording : (k,) recording of each keyframe; neighbouring sub-maps of one recording are no candidates.
    config : its partners bound the candidates per sub-map. executor : the result does not depend on it.
    """
    target, source = candidates(graph.poses, submaps, recording, config.partners)
    i, j = submaps.reference[target], submaps.reference[source]
    guess = se2.between(graph.poses[i], graph.poses[j])
    results: list[Registration] = []
    tasks = (
        (submaps.clouds.chosen(used), a, b, guess[rows], icp) for rows, used, a, b in batches(target, source)
    )
    for part in in_order(_align, tasks, executor):
        results += part
        if progress is not None:
            progress(len(results), len(target))
    information = np.array([found.information / config.correlation for found in results]).reshape(-1, *se2.POSE, *se2.POSE)
    pairs = zip(i.tolist(), j.tolist(), results, information, strict=True)
    return collected([_record(*pair) for pair in pairs], _root(information))


def candidates(poses: Floats, submaps: Submaps, recording: Ints, limit: int) -> tuple[Ints, Ints]:
    """Return target (c,) and source (c,) of the pairs of sub-maps that share enough of their surface, a < b.

    Parameters
    ----------
    poses, recording : of the keyframes. limit : most partners per sub-map, best overlap first.
    """
    a, b = np.triu_indices(len(submaps), 1)
    first = recording[submaps.reference]
    worth = np.where((b - a > 1) | (first[a] != first[b]), _shared(poses[submaps.reference], submaps)[a, b], 0.0)
    rows = best_per_submap(a, b, np.where(worth >= CandidatePolicy.shared, worth, 0.0), limit)
    return a[rows], b[rows]


def _shared(poses: Floats, submaps: Submaps) -> Floats:
    """Return the share (s, s) of the squares of the smaller sub-map in which the larger one has points, too."""
    owner = submaps.clouds.owner
    points = se2.transform_each(poses, owner, submaps.clouds.points)
    cell = np.floor(points / _CELL).astype(np.intp)
    cell -= cell.min(axis=0, initial=0)
    _, column = np.unique(cell[:, 0] * (cell[:, 1].max(initial=0) + 1) + cell[:, 1], return_inverse=True)
    seen = np.zeros((len(submaps), int(column.max(initial=-1)) + 1), dtype=np.float32)
    seen[owner, column] = 1.0
    size = np.maximum(seen.sum(axis=1), 1.0)
    return np.asarray(seen @ seen.T / np.minimum(size[:, None], size[None]), dtype=np.float64)


def _align(batch: _Batch) -> list[Registration]:
    """Align the pairs of a batch; runs in a worker."""
    clouds, target, source, guess, icp = batch
    points = [clouds.cloud(k)[0] for k in range(len(clouds))]
    trees = [make_tree(p) for p in points]
    return [align(trees[a], points[b], T, icp) for a, b, T in zip(target.tolist(), source.tolist(), guess, strict=True)]


def _record(i: int, j: int, found: Registration, information: Floats) -> LoopClosure:
    outcome = "accepted" if found.converged else "not-converged"
    why = f"fitness score {found.fitness:.3g} m2 after {found.iterations} iterations" if found.converged else found.reason
    return LoopClosure(i, j, found.T_target_source, information, found.rmse, found.overlap, outcome, why)


def _root(information: Floats) -> Floats:
    """Return L (e, 3, 3) with L^T L = information (e, 3, 3), which may be singular."""
    values, vectors = np.linalg.eigh(information)
    return np.sqrt(np.maximum(values, 0.0))[:, :, None] * np.swapaxes(vectors, 1, 2)
