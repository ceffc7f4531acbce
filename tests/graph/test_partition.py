"""Parts of a graph: every edge and unknown is in one of them or shared, and what they hold is what the graph held."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted_graphs import every_kind

from uwblite.graph.graph import Graph, PriorEdges
from uwblite.graph.partition import split

BLOCKS = {"poses": "poses", "anchors": "anchors", "calibration": "calibration"}


def values_of(graph):
    return {"poses": graph.poses, "anchors": graph.anchors, "calibration": graph.calibration.values}


def with_every_kind(seed):
    """Return a graph with edges of every kind, some unknowns fixed, and an anchor and a calibration value of priors alone."""
    graph, kinds = every_kind(seed, edges=5)
    rng = np.random.default_rng(seed)
    lone = [PriorEdges("anchors", np.array([3]), rng.normal(size=(1, 2)), np.eye(2)[None])]
    anchors = np.concatenate([graph.anchors, rng.normal(size=(2, 2))])
    fixed = [rng.random(n) < 0.3 for n in (len(graph.poses), len(anchors), len(graph.calibration.values))]
    return Graph(graph.poses, anchors, (*kinds.values(), *lone), graph.calibration, *fixed)


def touched_by(edges, graph):
    """Return for each edge the set of (block, number) that it touches."""
    # Of fixed calibration values as well, which have no Jacobian.
    blocks = edges.linearize(replace(graph, fixed_calibration=np.zeros_like(graph.fixed_calibration))).blocks
    return [{(name, int(index[e])) for name, index, _ in blocks if index[e] >= 0} for e in range(len(edges))]


@pytest.mark.parametrize("parts", [1, 2, 3])
@pytest.mark.parametrize("seed", range(4))
def test_parts_and_what_they_share_are_the_graph(seed, parts):
    graph = with_every_kind(seed)
    part_of = np.append(np.arange(parts), np.random.default_rng(seed).integers(0, parts, len(graph.poses) - parts))
    shared, found = split(graph, part_of)
    assert len(found) == parts
    # Every edge is in one part or shared: all measure the same as before.
    assert shared.chi2() + sum(p.graph.chi2() for p in found) == pytest.approx(graph.chi2(), rel=1e-12)
    whole, fixed = values_of(graph), {n: getattr(graph, f"fixed_{n}") for n in BLOCKS}
    times_interior = {name: np.zeros(len(values), dtype=int) for name, values in whole.items()}
    for part in found:
        assert part.graph.calibration.keys == tuple(graph.calibration.keys[k] for k in part.members["calibration"])
        for name, own in values_of(part.graph).items():
            members, number = part.members[name], part.shared[name]
            np.testing.assert_array_equal(own, whole[name][members])
            np.testing.assert_array_equal(getattr(part.graph, f"fixed_{name}"), fixed[name][members])
            np.testing.assert_array_equal(values_of(shared)[name][number[number >= 0]], own[number >= 0])
            times_interior[name][members[number < 0]] += 1
    # What is not shared is in one part alone; what no edge touches is in none.
    for name, times in times_interior.items():
        held = np.zeros(len(times), dtype=bool)
        for edges in graph.edges:
            held[[k for each in touched_by(edges, graph) for block, k in each if block == name]] = True
        assert times.max(initial=0) <= 1
        assert len(values_of(shared)[name]) == len(times) - times.sum()
        assert np.all(times[~held] == 0) or name == "poses"


@pytest.mark.parametrize("seed", range(4))
def test_an_unknown_is_interior_where_edges_of_one_part_alone_touch_it(seed):
    """Edges between poses of two parts belong to neither; those that touch no pose, to the part of all that they touch."""
    graph = with_every_kind(seed)
    part_of = np.array([0, 0, 0, 1, 1, 1])
    _, found = split(graph, part_of)
    touching = [(k, each) for k, edges in enumerate(graph.edges) for each in touched_by(edges, graph)]
    parts_of = {("poses", k): {int(p)} for k, p in enumerate(part_of)}
    for _, each in touching:
        poses = {int(part_of[k]) for block, k in each if block == "poses"}
        for unknown in each:
            if poses and unknown[0] != "poses":
                parts_of.setdefault(unknown, set()).update(poses)
    interior = {u for u, parts in parts_of.items() if len(parts) == 1}
    for _, each in touching:
        poses = {int(part_of[k]) for block, k in each if block == "poses"}
        owners = poses or {p if u in parts_of and len(parts_of[u]) == 1 else -1 for u in each for p in parts_of.get(u, {-1})}
        if len(owners) > 1 or -1 in owners:
            interior -= each
    for p, part in enumerate(found):
        mine = {(n, int(k)) for n in BLOCKS for k in part.members[n][part.shared[n] < 0]}
        assert mine == {u for u in interior if parts_of[u] == {p}}
