"""Graphs as gtsam reads them, where it is installed: every edge of every kind of file we write, and the same chi2.

gtsam measures the error of a relative pose by its logarithm, the solver by the chart of g2o; the two differ where errors of
heading are large. Here both programs measure the logarithm, of the same poses and edges; where errors are as small as noise
makes them, the solver's own chi2 must be gtsam's too.
"""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted_graphs import every_kind, loop
from helpers.results import small_log, small_result

from uwblite import se2
from uwblite.cli import main
from uwblite.graph.pose_edges import RelativePoseEdges
from uwblite.graph.solver import optimize
from uwblite.io.corrected_log import write_graph_with_scans
from uwblite.io.g2o import read_g2o, write_g2o
from uwblite.io.pyfg import write_pyfg
from uwblite.io.result_text import RunRecord
from uwblite.io.results import write_result
from uwblite.io.stored_result import read_result

gtsam = pytest.importorskip("gtsam", reason="gtsam is absent")

AGREEMENT = 1e-6
"""Largest relative difference of chi2: sums of some thousand squares, of numbers written in full."""


def check(path, *, optimised=False, edges=None):
    """Compare a file as gtsam reads it with how we do; `edges` between poses must be in it."""
    factors, values = gtsam.readG2o(str(path), False)
    graph = read_g2o(path).graph
    poses = np.array([[p.x(), p.y(), p.theta()] for p in (values.atPose2(k) for k in range(len(graph.poses)))])
    np.testing.assert_allclose(se2.between(graph.poses, poses), 0.0, atol=1e-9)
    between = [factors.at(k) for k in range(factors.size()) if isinstance(factors.at(k), gtsam.BetweenFactorPose2)]
    ours = [e for e in graph.edges if isinstance(e, RelativePoseEdges)]
    assert len(between) == sum(map(len, ours)) == (len(between) if edges is None else edges) > 0
    keys = np.array([f.keys() for f in between])
    np.testing.assert_array_equal(keys, np.concatenate([np.stack([e.i, e.j], axis=1) for e in ours]))
    theirs = 2.0 * sum(f.error(values) for f in between)
    assert theirs == pytest.approx(sum(chi2_of_logarithms(e, graph.poses) for e in ours), rel=AGREEMENT)
    if optimised:
        assert theirs == pytest.approx(sum(float(np.sum(e.residuals(graph) ** 2)) for e in ours), rel=1e-3)


def chi2_of_logarithms(edges, poses):
    """Return the sum of |L log(Z^-1 Xi^-1 Xj)|^2."""
    error = se2.log(se2.between(edges.T_i_j, se2.between(poses[edges.i], poses[edges.j])))
    return float(np.sum(np.einsum("eij,ej->ei", edges.sqrt_information, error) ** 2))


def test_a_result(tmp_path):
    write_g2o(tmp_path / "graph.g2o", small_result().graph)
    check(tmp_path / "graph.g2o", edges=23)


def test_a_graph_with_anchors_and_ranges(tmp_path):
    write_g2o(tmp_path / "graph.g2o", small_result().graph, ["5C0B", "91A3"], ranges=True)
    check(tmp_path / "graph.g2o", edges=23)


def test_an_optimised_graph(tmp_path):
    write_g2o(tmp_path / "loop.g2o", optimize(loop()[0])[0], ranges=True)
    check(tmp_path / "loop.g2o", optimised=True)


@pytest.mark.parametrize("seed", range(2))
def test_every_kind_of_edge_at_random_poses(tmp_path, seed):
    """Errors of any heading, calibration and lever arms, landmarks, priors, ranges and what is fixed."""
    graph, kinds = every_kind(seed)
    fixed = np.arange(len(graph.poses)) < 2
    write_g2o(tmp_path / "graph.g2o", replace(graph, edges=tuple(kinds.values()), fixed_poses=fixed), ranges=True)
    written = {line.split()[0] for line in (tmp_path / "graph.g2o").read_text().splitlines()}
    assert {"EDGE_SE2", "EDGE_SE2_XY", "EDGE_PRIOR_SE2", "EDGE_RANGE_SE2_XY", "FIX"} <= written
    check(tmp_path / "graph.g2o", edges=sum(len(kinds[k]) for k in ("relative pose", "odometry", "scan")))


def test_a_graph_with_scans(tmp_path):
    """ROBOTLASER1 lines behind the vertices, which gtsam does not know, hide none of the edges."""
    log, result = small_log(), small_result()
    write_result(tmp_path / "map", [log], result, RunRecord("uwblite map", ""))
    assert write_graph_with_scans(tmp_path / "scans.g2o", read_result(tmp_path / "map"), [log]) == 24
    check(tmp_path / "scans.g2o", edges=23)


def test_what_the_commands_write(tmp_path):
    """PyFG to g2o keeps the names of its vertices in comments; both ways through `optimize` keep every edge."""
    graph = loop()[0]
    write_pyfg(tmp_path / "loop.pyfg", graph, ["A", "B", "C"], np.arange(len(graph.poses), dtype=float))
    count = sum(len(e) for e in graph.edges if isinstance(e, RelativePoseEdges))
    assert main(["convert", str(tmp_path / "loop.pyfg"), str(tmp_path / "loop.g2o"), "-q"]) == 0
    check(tmp_path / "loop.g2o", edges=count)
    for k, options in enumerate(([], ["--robust"], ["--incremental"])):
        out = tmp_path / f"best{k}.g2o"
        assert main(["optimize", str(tmp_path / "loop.g2o"), "--out", str(out), "-q", *options]) == 0
        check(out, edges=count, optimised=True)


def test_the_map_of_the_sample(minute_map):
    check(minute_map / "graph.g2o", optimised=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sesync_intel", "sesync_CSAIL", "efpno_manhattanOlson3500"])
def test_published_graphs(tmp_path, shared_data, name):
    solved = optimize(read_g2o(shared_data / "pose_graphs" / f"{name}.g2o.gz").graph)[0]
    write_g2o(tmp_path / "graph.g2o", solved)
    check(tmp_path / "graph.g2o", optimised=True)
