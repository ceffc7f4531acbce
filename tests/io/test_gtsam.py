"""Graphs as gtsam reads them, where it is installed: every edge, and the same chi2."""

import numpy as np
import pytest
from helpers.planted_graphs import loop
from helpers.results import small_result

from uwblite.graph.pose_edges import RelativePoseEdges
from uwblite.graph.solver import optimize
from uwblite.io.g2o import read_g2o, write_g2o

gtsam = pytest.importorskip("gtsam", reason="gtsam is absent")


def check(path, *, small_errors=True):
    """Compare a file as gtsam reads it with how we do."""
    factors, values = gtsam.readG2o(str(path), False)
    graph = read_g2o(path).graph
    [edges] = [e for e in graph.edges if isinstance(e, RelativePoseEdges)]
    between = [factors.at(k) for k in range(factors.size()) if isinstance(factors.at(k), gtsam.BetweenFactorPose2)]
    assert len(between) == len(edges)
    keys = np.array([[f.keys()[0], f.keys()[1]] for f in between])
    np.testing.assert_array_equal(keys, np.stack([edges.i, edges.j], axis=1))
    poses = np.array([[p.x(), p.y(), p.theta()] for p in (values.atPose2(k) for k in range(len(graph.poses)))])
    np.testing.assert_allclose(poses, graph.poses, atol=1e-9)
    ours = float(np.sum(edges.residuals(graph) ** 2))
    # gtsam measures the logarithm of the error, we its chart: alike for small errors.
    if small_errors:
        assert 2.0 * sum(f.error(values) for f in between) == pytest.approx(ours, rel=1e-3, abs=1e-9)


def test_gtsam_reads_every_edge_of_a_result(tmp_path):
    write_g2o(tmp_path / "graph.g2o", small_result().graph, [a.id for a in small_result().anchors], ranges=True)
    check(tmp_path / "graph.g2o", small_errors=False)


def test_gtsam_finds_our_chi2_in_an_optimised_graph(tmp_path):
    write_g2o(tmp_path / "loop.g2o", optimize(loop()[0])[0], ranges=True)
    check(tmp_path / "loop.g2o")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sesync_intel", "sesync_CSAIL", "efpno_manhattanOlson3500"])
def test_gtsam_reads_published_graphs_as_we_write_them(tmp_path, shared_data, name):
    solved = optimize(read_g2o(shared_data / "pose_graphs" / f"{name}.g2o.gz").graph)[0]
    write_g2o(tmp_path / "graph.g2o", solved)
    check(tmp_path / "graph.g2o")
