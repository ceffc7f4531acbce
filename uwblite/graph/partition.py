"""Division of a graph into parts that share few unknowns: recordings of one place share anchors and the poses of closures."""

from dataclasses import dataclass, fields, replace
from typing import Any, cast

import numpy as np

from ..arrays import Ints
from .distance_edges import AnchorDistanceEdges
from .graph import Calibration, Edges, Graph, PriorEdges, linearize
from .unknowns import free_unknowns


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """The unknowns and edges of one part."""

    graph: Graph
    """The unknowns of the part's edges, and these edges."""
    shared: dict[str, Ints]
    """By block: for each unknown of the part its number in the graph of shared unknowns, -1 = interior."""
    members: dict[str, Ints]
    """By block: for each unknown of the part its number in the graph that was divided."""


def split(graph: Graph, part_of: Ints) -> tuple[Graph, tuple[Part, ...]]:
    """Divide a graph into parts, and the graph of what they share.

    Parameters
    ----------
    part_of : (n,) part 0, 1, ... of each pose.
    """
    # Of fixed values too: only what is free has a Jacobian.
    every = replace(graph, fixed_calibration=np.zeros_like(graph.fixed_calibration))
    touched = [[(name, index) for name, index, _ in lin.blocks] for lin in linearize(every)]
    counts = {"poses": len(graph.poses), "anchors": len(graph.anchors), "calibration": len(graph.calibration.values)}
    owner = {name: np.full(count, _UNTOUCHED) for name, count in counts.items()} | {"poses": part_of}
    for blocks in touched:
        of_poses = [part_of[index] for name, index in blocks if name == "poses"]
        for name, index in blocks:
            if of_poses and name != "poses":
                _claim(owner[name], index, of_poses[0])
    owners = [_owner_of_edges(blocks, owner) for blocks in touched]
    is_shared = {name: own < 0 for name, own in owner.items()}
    for blocks, own in zip(touched, owners, strict=True):
        for name, index in blocks:
            is_shared[name][index[own < 0]] = True
    number = {name: np.where(mask, np.cumsum(mask) - 1, -1) for name, mask in is_shared.items()}
    shared = _taken(graph, {name: np.flatnonzero(mask) for name, mask in is_shared.items()}, owners, -1)
    parts = []
    for p in range(int(part_of.max()) + 1):
        members = {name: owner[name] == p for name in counts}
        for blocks, own in zip(touched, owners, strict=True):
            for name, index in blocks:
                members[name][index[own == p]] = True
        mine = {name: np.flatnonzero(mask) for name, mask in members.items()}
        parts.append(Part(_taken(graph, mine, owners, p), {name: number[name][k] for name, k in mine.items()}, mine))
    return shared, tuple(parts)


_UNTOUCHED, _SHARED = -2, -1


def _claim(owner: Ints, index: Ints, part: Ints) -> None:
    """Note that edges of these parts (e,) touch these unknowns (e,)."""
    low, high = np.full(len(owner), np.iinfo(np.intp).max), np.full(len(owner), -1)
    np.minimum.at(low, index, part)
    np.maximum.at(high, index, part)
    here = high >= 0
    one = here & (low == high) & ((owner == _UNTOUCHED) | (owner == high))
    owner[here] = np.where(one, high, _SHARED)[here]


def _owner_of_edges(blocks: list[tuple[str, Ints]], owner: dict[str, Ints]) -> Ints:
    """Return the part (e,) that edges belong to, -1 = none: that of all their poses, or, without poses, of all they touch."""
    of_poses = [owner[name][index] for name, index in blocks if name == "poses"]
    each = np.stack(of_poses or [owner[name][index] for name, index in blocks])
    return np.where((each == each[0]).all(axis=0) & (each[0] >= 0), each[0], _SHARED)


def _taken(graph: Graph, members: dict[str, Ints], owners: list[Ints], part: int) -> Graph:
    """Return the graph of some unknowns and of the edges that belong to a part, all numbered from 0."""
    fixed, number = {}, {}
    for name, free in free_unknowns(graph).items():
        k = members[name]
        fixed[name] = ~free[k]
        number[name] = np.full(len(free) + 1, -1)
        number[name][k] = np.arange(len(k))
    edges = [e.rows(own == part) for e, own in zip(graph.edges, owners, strict=True)]
    keys = tuple(graph.calibration.keys[k] for k in members["calibration"])
    return Graph(
        graph.poses[members["poses"]],
        graph.anchors[members["anchors"]],
        tuple(_renumbered(e, number) for e in edges if len(e)),
        Calibration(keys, graph.calibration.values[members["calibration"]]),
        fixed["poses"],
        fixed["anchors"],
        fixed["calibration"],
    )


def _renumbered(edges: Any, number: dict[str, Ints]) -> Edges:
    """Return edges with the numbers of unknowns replaced; -1 stays."""
    if isinstance(edges, PriorEdges):
        return replace(edges, index=number[edges.block][edges.index])
    ends = "anchors" if isinstance(edges, AnchorDistanceEdges) else "poses"
    block = {"i": ends, "j": ends, "pose": "poses", "anchor": "anchors", "calibration": "calibration"}
    new = {f.name: number[block[f.name]][getattr(edges, f.name)] for f in fields(edges) if f.name in block}
    return cast(Edges, replace(edges, **new))
