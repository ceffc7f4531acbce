"""Starts of pose graphs from their relative poses alone."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted_graphs import at_random, loop, random_poses, relative_edges

from uwblite import se2
from uwblite.graph.chordal_start import chordal_start
from uwblite.graph.graph import Graph
from uwblite.graph.pose_edges import RelativePoseEdges
from uwblite.graph.solver import optimize


def test_without_noise_the_start_is_the_truth():
    rng = np.random.default_rng(0)
    truth = random_poses(rng, 40)
    i, j = rng.integers(0, 40, (2, 200))
    edges = relative_edges(truth, i[i != j], j[i != j], [0.1, 0.2, 0.05])
    fixed = np.isin(np.arange(40), [0, 7])
    start = chordal_start(Graph(np.where(fixed[:, None], truth, 0.0), edges=(edges,), fixed_poses=fixed))
    np.testing.assert_allclose(se2.between(truth, start.poses), 0.0, atol=1e-9)


@pytest.mark.parametrize("seed", range(2))
def test_any_headings_end_in_the_same_minimum(seed):
    graph = loop(seed, n=400, anchors=0)[0]
    graph = replace(graph, edges=graph.edges[:2])
    rng = np.random.default_rng(seed)
    anywhere = random_poses(rng, len(graph.poses), 100.0)
    anywhere[0] = graph.poses[0]
    best = optimize(graph)[1].chi2
    assert optimize(chordal_start(replace(graph, poses=anywhere)))[1].chi2 == pytest.approx(best, rel=1e-6)


def test_a_chain_and_an_open_pose_have_none():
    graph = loop(0)[0]
    assert chordal_start(replace(graph, edges=graph.edges[:1])) is None
    assert chordal_start(Graph(np.append(graph.poses, np.zeros((1, 3)), axis=0), graph.anchors, graph.edges)) is None


def test_parallel_edges_are_averaged_by_their_information():
    """Headings, as unit complex numbers, by the information on turns; places by the mean of that on x and y."""
    T = np.array([[1.0, 2.0, 0.1], [3.0, 1.0, 0.4], [2.0, 5.0, -0.3]])
    L = np.stack([np.diag(d) for d in ([1.0, 3.0, 2.0], [2.0, 0.5, 1.0], [1.0, 1.0, 3.0])])
    edges = RelativePoseEdges(np.zeros(3, int), np.ones(3, int), T, L, weights=np.array([1.0, 0.5, 2.0]))
    start = chordal_start(Graph(np.zeros((2, 3)), edges=(edges,), fixed_poses=np.array([True, False])))
    turns, places = np.array([4.0, 0.5, 18.0]), np.array([5.0, 0.5 * 2.125, 2.0])
    np.testing.assert_allclose(start.poses[1, :2], places @ T[:, :2] / places.sum())
    np.testing.assert_allclose(start.poses[1, 2], np.angle(turns @ np.exp(1j * T[:, 2])))


def test_a_step_from_a_pose_of_uncertain_heading_keeps_its_length():
    """Edges that contradict each other make the mean of unit numbers shorter than 1; a step taken there is none the shorter."""
    T = np.array([[1.0, 2.0, 0.9], [1.0, 2.0, -0.7], [2.0, 5.0, 0.1], [3.0, -1.0, 0.4]])
    edges = RelativePoseEdges(np.array([0, 0, 0, 1]), np.array([1, 1, 1, 2]), T, np.tile(np.eye(3), (4, 1, 1)))
    poses = chordal_start(Graph(np.zeros((3, 3)), edges=(edges,), fixed_poses=np.arange(3) == 0)).poses
    np.testing.assert_allclose(se2.between(poses[1], poses[2]), T[3])


def test_where_the_matrix_would_fill_up_there_is_none(monkeypatch):
    graph = at_random(200, 400)
    assert chordal_start(graph) is not None
    monkeypatch.setattr("uwblite.graph.elimination.EliminationPolicy.little_work", 0.0)
    monkeypatch.setattr("uwblite.graph.elimination.EliminationPolicy.per_pose", 500.0)
    assert chordal_start(graph) is None
