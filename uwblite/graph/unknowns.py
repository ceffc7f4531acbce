"""Free scalars of a graph as one vector, and the effect of a step on the estimates."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, Ints
from .graph import Graph, Linearization


@dataclass(frozen=True, slots=True, eq=False)
class Unknowns:
    """Positions of the free scalars of a graph in the vector of unknowns."""

    number: dict[str, Ints]
    """By block (unknowns, scalars): position in the vector, -1 = fixed."""
    size: int
    """Length of the vector."""

    def spread(self, name: str, vector: Floats) -> Floats:
        """Return the part of a vector that belongs to a block, (unknowns, scalars), 0 where fixed."""
        return np.append(vector, 0.0)[self.number[name]]


def move_by_arcs(graph: Graph, unknowns: Unknowns, step: Floats) -> Graph:
    """Return the graph moved by a step: poses along the arc of a constant twist, the rest straight.

    Long bent chains need about two iterations fewer than with plain addition, which it is to first order.
    """
    shift = unknowns.spread("poses", step)
    arc = se2.exp(shift)
    poses = np.empty_like(graph.poses)
    poses[:, :2] = graph.poses[:, :2] + arc[:, :2]
    poses[:, 2] = se2.wrap_angle(graph.poses[:, 2] + shift[:, 2])
    return _with_poses(graph, unknowns, step, poses)


def move_by_links(graph: Graph, unknowns: Unknowns, step: Floats, linked: Bools) -> Graph:
    """Return the graph moved by a step, poses link by link: each relative pose changes by the step to first order,
    and the chain is put together again from these. It keeps relative poses for any turn; `move_by_arcs` keeps loops closed.

    Parameters
    ----------
    linked : (n - 1,) pose k + 1 is defined relative to pose k.
    """
    shift, start = unknowns.spread("poses", step), move_by_arcs(graph, unknowns, step).poses
    link, change = se2.between(graph.poses[:-1], graph.poses[1:]), np.diff(shift, axis=0)
    turned = np.stack([link[:, 1], -link[:, 0]], axis=1) * shift[:-1, 2:]
    link[:, :2] += se2.rotate(-graph.poses[:-1, 2], change[:, :2]) + turned
    link[:, 2] += change[:, 2]
    free = np.zeros(len(start), dtype=bool)
    free[1:] = linked & np.all(unknowns.number["poses"][1:] >= 0, axis=1)
    first = np.maximum.accumulate(np.where(free, 0, np.arange(len(free))))
    poses = start.copy()
    poses[:, 2] = start[first, 2] + _sums_from(np.append(0.0, link[:, 2]), first)
    way = np.zeros_like(start[:, :2])
    way[1:] = se2.rotate(poses[:-1, 2], link[:, :2])
    poses[:, :2] = start[first, :2] + _sums_from(way, first)
    poses[:, 2] = se2.wrap_angle(poses[:, 2])
    return _with_poses(graph, unknowns, step, np.where(free[:, None], poses, start))


def turns_much(unknowns: Unknowns, step: Floats) -> bool:
    """Return whether a step turns a pose so much that `move_by_arcs` and `move_by_links` differ."""
    return bool(np.abs(unknowns.spread("poses", step)[:, 2]).max(initial=0.0) >= _LARGE_TURN)


_LARGE_TURN = 0.05
"""rad; for smaller turns of a pose the second-order term is negligible."""


def linked_poses(poses: int, linearized: Sequence[Linearization]) -> Bools:
    """Return which poses (n - 1,) are linked with the next one, in chains.

    Where edges of one kind all join neighbours, as odometry does, only these count: where one recording ends and another
    begins, clouds may be paired as well, and even with no weight.
    """
    ends = [[index for name, index, _ in lin.blocks if name == "poses"] for lin in linearized]
    # Some files store each step backwards, from the later pose to the one before.
    pairs = [(np.minimum(*pair), np.maximum(*pair)) for pair in ends if len(pair) == 2]
    chains = [(a, b) for a, b in pairs if np.all(b == a + 1)]
    linked = np.zeros(max(poses - 1, 0), dtype=bool)
    for a, b in chains or pairs:
        linked[a[b == a + 1]] = True
    return linked


def _sums_from(values: Floats, first: Ints) -> Floats:
    """Return sums of the values after row first[k] up to row k."""
    total = np.cumsum(values, axis=0)
    return total - total[first]


def _with_poses(graph: Graph, unknowns: Unknowns, step: Floats, poses: Floats) -> Graph:
    calibration = graph.calibration.values + unknowns.spread("calibration", step)[:, 0]
    return graph.updated(poses, graph.anchors + unknowns.spread("anchors", step), calibration)


def free_unknowns(graph: Graph) -> dict[str, Bools]:
    """Return by block which unknowns are free."""
    return {"poses": ~graph.fixed_poses, "anchors": ~graph.fixed_anchors, "calibration": ~graph.fixed_calibration}
