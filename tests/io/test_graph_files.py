"""g2o, TORO and PyFG: what is written is read, with the same chi2, and wrong files are named."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uwblite import se2
from uwblite.errors import FormatError
from uwblite.graph.graph import Calibration, Graph, PriorEdges, UnknownKey
from uwblite.graph.point_edges import LandmarkEdges
from uwblite.graph.pose_edges import OdometryEdges, RelativePoseEdges, ScanEdges
from uwblite.graph.range_edges import RangeEdges
from uwblite.graph.solver import optimize
from uwblite.io.g2o import read_g2o, write_g2o
from uwblite.io.graph_file import chained_poses, plain_edges, root
from uwblite.io.pyfg import read_pyfg, write_pyfg

FORMATS = [
    (lambda path, graph: write_g2o(path, graph, ranges=True), read_g2o),
    (write_pyfg, read_pyfg),
]


def roots(rng, count, size):
    return rng.normal(size=(count, size, size)) + 3.0 * np.eye(size)


def relative(rng, poses, count):
    i = rng.integers(0, len(poses) - 1, count, dtype=np.intp)
    j = i + rng.integers(1, len(poses) - i, dtype=np.intp)
    noise = 0.05 * rng.normal(size=(count, 3))
    return i, j, se2.compose(se2.between(poses[i], poses[j]), noise)


def plain_graph(seed=0, poses=9, anchors=3):
    """A graph of every kind that the formats can say: no calibration, no lever arms."""
    rng = np.random.default_rng(seed)
    X = np.stack([*rng.normal(scale=3.0, size=(2, poses)), rng.uniform(-np.pi, np.pi, poses)], axis=1)
    A = rng.normal(scale=5.0, size=(anchors, 2))
    i, j, T = relative(rng, X, 14)
    steps = np.arange(poses - 1)
    chain = RelativePoseEdges(steps, steps + 1, se2.between(X[:-1], X[1:]), roots(rng, poses - 1, 3))
    pose, anchor = rng.integers(0, poses, 20, dtype=np.intp), rng.integers(0, anchors, 20, dtype=np.intp)
    apart = np.hypot(*(X[pose, :2] - A[anchor]).T) + 0.1 * rng.normal(size=20)
    none, flat = np.full((20, 6), -1), np.zeros((20, 2))
    sigma, zero = rng.uniform(0.1, 0.3, 20), np.zeros(20)
    ranges = RangeEdges(pose, anchor, apart, sigma, flat, zero, flat, np.zeros(2), zero, none)
    seen = se2.rotate(-X[pose, 2], A[anchor] - X[pose, :2]) + 0.1 * rng.normal(size=(20, 2))
    return Graph(
        X,
        A,
        (
            chain,
            RelativePoseEdges(i, j, T, roots(rng, 14, 3), weights=rng.choice([0.0, 0.5, 1.0], 14)),
            ranges,
            LandmarkEdges(pose, anchor, seen, roots(rng, 20, 2)),
            PriorEdges("poses", np.array([2, 5]), X[[2, 5]] + 0.1, roots(rng, 2, 3)),
            PriorEdges("anchors", np.array([1]), A[[1]] + 0.2, roots(rng, 1, 2)),
        ),
    )


def calibrated_graph(seed=0):
    """Odometry, scan and range edges with calibration and lever arms."""
    rng = np.random.default_rng(seed)
    base = plain_graph(seed)
    X, A = base.poses, base.anchors
    i, j, T = relative(rng, X, 8)
    names = ("odometry_scale", "laser_x", "laser_theta", "laser_delay", "bias")
    calibration = Calibration(tuple(map(UnknownKey, names)), np.array([0.02, 0.05, 0.03, 0.02, 0.3]))
    odometry = OdometryEdges(
        i, j, T, np.ones(8), np.ones(8), roots(rng, 8, 3), np.broadcast_to(np.append(0, np.full(7, -1)), (8, 8))
    )
    twist = rng.normal(size=(2, 8, 3))
    scans = ScanEdges(i, j, T, roots(rng, 8, 3), twist[0], twist[1], np.array([1, -1, 2, 3]), 0.01)
    pose, anchor = rng.integers(0, len(X), 20, dtype=np.intp), rng.integers(0, len(A), 20, dtype=np.intp)
    cal = np.full((20, 6), -1)
    cal[:, 1] = 4
    arm, turn, velocity = rng.normal(size=(20, 2)), rng.normal(size=20), rng.normal(size=(20, 2))
    ranges = RangeEdges(
        pose, anchor, rng.uniform(3, 9, 20), np.full(20, 0.2), arm, turn, velocity, np.array([0.1, 0.05]), np.ones(20), cal
    )
    return Graph(X, A, (odometry, scans, ranges), calibration)


@pytest.mark.parametrize(("write", "read"), FORMATS)
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("ending", ["", ".gz"])
def test_what_is_written_is_read_with_the_same_chi2(tmp_path, write, read, seed, ending):
    graph = plain_graph(seed)
    write(tmp_path / f"a{ending}", graph)
    back = read(tmp_path / f"a{ending}")
    assert back.graph.chi2() == pytest.approx(graph.chi2(), rel=1e-9)
    np.testing.assert_array_equal(back.graph.poses, graph.poses)
    np.testing.assert_array_equal(back.graph.anchors, graph.anchors)
    assert back.skipped == {}
    assert back.warnings == ()
    assert len(back.pose_ids) == 9
    assert len(back.anchor_ids) == 3
    # What a file says is settled: written again it is the same file.
    write(tmp_path / "b", back.graph)
    again = read(tmp_path / "b")
    assert again.graph.chi2() == pytest.approx(graph.chi2(), rel=1e-9)


@pytest.mark.parametrize(("write", "read"), FORMATS)
def test_the_optimum_of_the_file_is_that_of_the_graph(tmp_path, write, read):
    graph = plain_graph(5)
    write(tmp_path / "a", graph)
    here, there = optimize(graph)[1], optimize(read(tmp_path / "a").graph)[1]
    # Both have priors that hold the frame; the file's graph lets the first pose go, so it may only be better.
    assert there.chi2 <= here.chi2 * (1 + 1e-6)


def test_fixed_vertices_stay_fixed(tmp_path):
    graph = plain_graph()
    fixed = {"fixed_poses": np.arange(9) % 4 == 1, "fixed_anchors": np.arange(3) == 2}
    graph = Graph(graph.poses, graph.anchors, graph.edges[:1], **fixed)
    write_g2o(tmp_path / "a", graph)
    back = read_g2o(tmp_path / "a").graph
    np.testing.assert_array_equal(back.fixed_poses, graph.fixed_poses)
    np.testing.assert_array_equal(back.fixed_anchors, graph.fixed_anchors)


@pytest.mark.parametrize("seed", range(2))
def test_calibration_and_lever_arms_are_worked_in(tmp_path, seed):
    graph = calibrated_graph(seed)
    write_pyfg(tmp_path / "a", graph)
    back = read_pyfg(tmp_path / "a").graph
    odometry, _, ranges = (np.sum(e.residuals(graph) ** 2) for e in graph.edges)
    relative_edges, range_edges = back.edges
    squared = np.sum(relative_edges.residuals(back) ** 2, axis=1)
    assert squared[:8].sum() == pytest.approx(odometry, rel=1e-7)
    assert np.sum(range_edges.residuals(back) ** 2) == pytest.approx(ranges, rel=1e-9)
    # Scan edges between sensors become edges between bases: zero residual stays zero, and small ones to first order.
    scans = graph.edges[1]
    calibration = graph.calibration.values
    correction = [calibration[1], 0.0, calibration[2]]
    place = [se2.compose(se2.exp(twist * calibration[3]), correction) for twist in (scans.twist_i, scans.twist_j)]
    true = se2.between(se2.compose(graph.poses[scans.i], place[0]), se2.compose(graph.poses[scans.j], place[1]))
    small = 1e-5 * np.random.default_rng(seed).normal(size=(8, 3))
    exact = replace(scans, T_i_j=se2.compose(true, small))
    plain = plain_edges(Graph(graph.poses, graph.anchors, (exact,), graph.calibration))["relative"]
    base = RelativePoseEdges(*plain.ends, plain.value, root(plain.information))
    here, there = (np.sum(e.residuals(graph) ** 2, axis=1) for e in (exact, base))
    np.testing.assert_allclose(there, here, rtol=1e-3)


def test_directions_that_were_not_measured_have_a_wide_covariance(tmp_path):
    L = np.array([[[3.0, 0, 0], [0, 0, 0], [0, 0, 9.0]]])
    edges = RelativePoseEdges(np.array([0]), np.array([1]), np.array([[1.0, 0, 0]]), L)
    graph = Graph(np.array([[0.0, 0, 0], [1.2, 5.0, 0.01]]), edges=(edges,))
    for write, read in FORMATS:
        write(tmp_path / "a", graph)
        assert read(tmp_path / "a").graph.chi2() == pytest.approx(graph.chi2(), rel=1e-3)


def test_anchors_without_a_position_are_left_out(tmp_path):
    graph = plain_graph()
    graph.anchors[1] = np.nan
    graph = Graph(graph.poses, graph.anchors, graph.edges[:3])
    for write, read in FORMATS:
        write(tmp_path / "a", graph)
        assert len(read(tmp_path / "a").anchor_ids) == 2


def test_vertices_that_are_missing_are_reached_along_edges(tmp_path):
    rng = np.random.default_rng(3)
    X = np.stack([*rng.normal(scale=3.0, size=(2, 6)), rng.uniform(-np.pi, np.pi, 6)], axis=1)
    pairs = [(0, 1), (2, 1), (2, 3), (5, 3), (4, 5)]
    T = np.array([se2.between(X[a], X[b]) for a, b in pairs])
    measured = zip(pairs, T.tolist(), strict=True)
    lines = [f"EDGE_SE2 {10 * a} {10 * b} {x!r} {y!r} {t!r} 1 0 0 1 0 1\n" for (a, b), (x, y, t) in measured]
    (tmp_path / "a").write_text("".join(lines))
    back = read_g2o(tmp_path / "a")
    np.testing.assert_allclose(se2.between(back.graph.poses[0], back.graph.poses), se2.between(X[0], X), atol=1e-9)
    assert back.pose_ids == ("0", "10", "20", "30", "40", "50")
    vertex = f"VERTEX_SE2 30 {float(X[3, 0])} {float(X[3, 1])} {float(X[3, 2])}\n"
    (tmp_path / "a").write_text(vertex + "".join(lines))
    moved = read_g2o(tmp_path / "a").graph.poses
    np.testing.assert_allclose(moved[:, :2], X[:, :2], atol=1e-9)
    np.testing.assert_allclose(se2.wrap_angle(moved[:, 2] - X[:, 2]), 0.0, atol=1e-9)


def test_successive_poses_are_chained_before_closures():
    T = np.array([[1.0, 0, 0], [1.0, 0, 0], [9.0, 9.0, 9.0]])
    poses = chained_poses(np.full((3, 3), np.nan), np.array([0, 1, 0]), np.array([1, 2, 2]), T)
    np.testing.assert_allclose(poses[:, 0], [0, 1, 2])


def test_toro_orders_its_information_differently(tmp_path):
    (tmp_path / "b").write_text("VERTEX2 0 0 0 0\nVERTEX2 1 1 0 0\nEDGE2 0 1 1 0 0 50 1 60 70 2 3\n")
    edges = read_g2o(tmp_path / "b").graph.edges[0]
    information = edges.sqrt_information[0].T @ edges.sqrt_information[0]
    np.testing.assert_allclose(information, [[50, 1, 2], [1, 60, 3], [2, 3, 70]], atol=1e-9)


def test_landmarks_without_a_vertex_are_placed_by_what_saw_them(tmp_path):
    (tmp_path / "a").write_text("VERTEX_SE2 0 1 2 1.5707963267948966\nEDGE_SE2_XY 0 7 2 0 1 0 1\n")
    back = read_g2o(tmp_path / "a")
    np.testing.assert_allclose(back.graph.anchors, [[1.0, 4.0]], atol=1e-12)
    (tmp_path / "a").write_text("VERTEX_SE2 0 1 2 0\nEDGE_RANGE_SE2_XY 0 7 2 1\n")
    back = read_g2o(tmp_path / "a")
    assert np.isnan(back.graph.anchors).all()
    assert "no position" in back.warnings[0]


def test_pyfg_names_stamps_and_ranges_between_landmarks(tmp_path):
    (tmp_path / "a").write_text(
        "VERTEX_SE2 5.5 B1 1 0 0\nVERTEX_SE2 4.5 A10 0 0 0\nVERTEX_XY L2 3 4\nVERTEX_XY L1 3 4\n"
        "EDGE_RANGE 6 L2 A10 5.5 0.25\nEDGE_RANGE 6 L1 L2 0.1 0.25\nEDGE_RANGE 6 A10 B1 0.1 0.25\n"
        "EDGE_SE2 7 A10 B1 1 0 0 1 0 0 1 0 1\n"
    )
    back = read_pyfg(tmp_path / "a")
    assert back.pose_ids == ("A10", "B1")
    assert back.anchor_ids == ("L1", "L2")
    assert back.stamps.tolist() == [4.5, 5.5]
    assert back.graph.chi2() == pytest.approx((0.5 / 0.5) ** 2 + (0.9 / 0.5) ** 2 + (0.1 / 0.5) ** 2, rel=1e-4)
    assert back.skipped == {}


G2O_ERRORS = [
    ("", "empty"),
    ("# nothing\n", "no poses"),
    ("VERTEX_SE2 0 1 2\n", "a:1: VERTEX_SE2 has 3 fields, expected 4"),
    ("VERTEX_SE2 0 1 2 3\nVERTEX_SE2 1 1 x 3\n", "a:2: b'x' is not a number"),
    ("VERTEX_SE2 0 1 inf 3\n", "a:1: a number is not finite"),
    ("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 0 0 0 0\n", "a:2: this vertex was given before"),
    ("VERTEX_SE2 q 0 0 0\n", "'q' is not a vertex id"),
    ("VERTEX_SE2 99999999999999999999999 0 0 0\n", "not a vertex id"),
    ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n", "three-dimensional"),
    ("VERTEX_SE2 0 0 0 0\nEDGE_RANGE_SE3 0 1 3 1\n", "EDGE_RANGE_SE3: the graph is three-dimensional"),
    ("VERTEX_SE2 0 0 0 0\nVERTEX_XYZ 5 1 1 1\n", "VERTEX_XYZ: the graph is three-dimensional"),
    ("VERTEX_SIM3:EXPMAP 0 0 0 0 0 0 0 1\n", "three-dimensional"),
    ("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 5 0 0 0\nEDGE_SE2 1 2 0 0 0 1 0 0 1 0 1\n", "pose 1 is not connected"),
    ("EDGE_SE2 1 1 0 0 0 1 0 0 1 0 1\n", "a:1: an edge leads from a pose to itself"),
    ("EDGE_SE2 1 2 0 0 0 1 0 0 -1 0 1\n", "a:1: the information matrix is not positive"),
    ("VERTEX_SE2 0 0 0 0\nVERTEX_XY 0 1 1\n", "vertex 0 is used as a pose and as a landmark"),
    ("VERTEX_SE2 0 0 0 0\nEDGE_RANGE_SE2_XY 0 1 1 0\n", "a:2: the information of a range must be positive"),
    ("\xff\xfe\x00", "UTF-16"),
]


@pytest.mark.parametrize(("text", "outputs"), G2O_ERRORS)
def test_wrong_g2o_files_are_named(tmp_path, text, outputs):
    (tmp_path / "a").write_bytes(text.encode("latin1"))
    with pytest.raises(FormatError, match=outputs):
        read_g2o(tmp_path / "a")


@pytest.mark.parametrize(
    ("text", "outputs"),
    [
        ("VERTEX_XY L0 1 2\n", "no poses"),
        ("VERTEX_SE2 0 1 0 0 0\n", "'1' is not a name"),
        ("VERTEX_SE2 0 L1 0 0 0\nVERTEX_SE2 0 A1 0 0 0\n", "named like a landmark"),
        ("VERTEX_SE2 0 A1 0 0 0\nVERTEX_XY A1 0 0\n", "named like a pose"),
        ("EDGE_SE2 0 A0 L1 0 0 0 1 0 0 1 0 1\n", "a:1: an edge between poses names a landmark"),
        ("EDGE_SE2 0 A0 A1 0 0 0 0 0 0 1 0 1\n", "a:1: the covariance matrix is singular"),
        ("EDGE_SE2 0 A0 A1 0 0 0 -1 0 0 1 0 1\n", "a:1: the covariance matrix is not positive"),
        ("VERTEX_SE2 0 A1 0 0 0\nEDGE_RANGE 0 A1 L1 5 0\n", "a:2: the variance of a range must be positive"),
        ("VERTEX_SE3:QUAT 0 A0 0 0 0 0 0 0 1\n", "three-dimensional"),
        ("VERTEX_SE2 0 A1 0 0 0\nEDGE_SE3_XYZ 0 A1 L0 1 1 1\n", "EDGE_SE3_XYZ: the graph is three-dimensional"),
    ],
)
def test_wrong_pyfg_files_are_named(tmp_path, text, outputs):
    (tmp_path / "a").write_text(text)
    with pytest.raises(FormatError, match=outputs):
        read_pyfg(tmp_path / "a")


TAGS = (
    "VERTEX_SE2 VERTEX_XY EDGE_SE2 EDGE_SE2_XY EDGE_RANGE EDGE_RANGE_SE2_XY EDGE_PRIOR_SE2 VERTEX_SE2:PRIOR FIX EDGE2 VERTEX2 "
    "EDGE_PRIOR_XY VERTEX_XY:PRIOR 0 1 2 3 A0 A1 L0 L1 0.5 -1 1e300 nan -0 1e-300 x \x00 é"
)
WORD = st.sampled_from(TAGS.split(" ")) | st.text(max_size=3)
KINDS = [("VERTEX_SE2", 1, 3), ("EDGE_SE2", 2, 9), ("EDGE_SE2_XY", 2, 5), ("VERTEX_XY", 1, 2), ("EDGE_RANGE_SE2_XY", 2, 2)]
LINES = st.lists(st.lists(WORD, max_size=13).map(" ".join), max_size=8).map("\n".join)
PLAUSIBLE = st.lists(
    st.tuples(
        st.sampled_from(KINDS),
        st.lists(st.integers(0, 4), min_size=2, max_size=2),
        st.lists(st.sampled_from([0.0, 1.0, -1.0, 1e200, 1e-200, 3.5]), min_size=9, max_size=9),
    ),
    max_size=8,
)


def spelled(rows):
    lines = ([tag, *ids[:names], *numbers[:count]] for (tag, names, count), ids, numbers in rows)
    return "\n".join(" ".join(map(str, line)) for line in lines)


@given(st.binary(max_size=60) | LINES.map(lambda s: s.encode(errors="replace")) | PLAUSIBLE.map(spelled).map(str.encode))
def test_anything_else_is_a_format_error(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "anything"
    path.write_bytes(data)
    for read in (read_g2o, read_pyfg):
        for from_odometry in (False, True):
            try:
                graph = read(path, from_odometry=from_odometry).graph
            except FormatError:
                continue
            assert not np.isnan(graph.poses).any()


@pytest.mark.parametrize(
    ("name", "optimum"),
    [
        ("efpno_input_M3500_original", 137.912951),
        ("efpno_manhattanOlson3500", 146.076613),
        ("sesync_intel", 45.004696),
        ("sesync_CSAIL", 40.555129),
    ],
)
def test_public_graphs_reach_their_stated_optimum(shared_data, tmp_path, name, optimum):
    read = read_g2o(shared_data / "pose_graphs" / f"{name}.g2o.gz")
    found, summary = optimize(read.graph)
    assert summary.converged
    assert summary.chi2 == pytest.approx(optimum, rel=1e-6)
    assert found.chi2() == pytest.approx(summary.chi2, rel=1e-12)
    write_g2o(tmp_path / "a", read.graph)
    assert read_g2o(tmp_path / "a").graph.chi2() == pytest.approx(read.graph.chi2(), rel=1e-12)


def test_plaza_with_ranges_reaches_its_stated_optimum(shared_data):
    read = read_pyfg(shared_data / "plaza1" / "plaza1.pyfg.gz")
    assert len(read.anchor_ids) == 4
    assert optimize(read.graph)[1].chi2 == pytest.approx(2660.5, abs=0.1)


@pytest.mark.parametrize(("ending", "there"), [("pyfg", "pyfg"), ("g2o", "g2o"), ("g2o", "pyfg")])
def test_names_of_vertices_survive(tmp_path, ending, there, capsys):
    """Names of several robots in PyFG, numbers with gaps in g2o, which become A and L in PyFG."""
    from uwblite.cli import main

    pyfg = "VERTEX_SE2 0 A225 0 0 0\nVERTEX_SE2 1 A226 1 0 0\nVERTEX_SE2 0 b7 0 1 0\nVERTEX_XY L9 3 3\n" + "".join(
        f"EDGE_SE2 0 {i} {j} 1 0 0 0.01 0 0 0.01 0 0.01\n" for i, j in (("A225", "A226"), ("A225", "b7"))
    )
    g2o = "VERTEX_SE2 225 0 0 0\nVERTEX_SE2 300 1 0 0\nVERTEX_XY 226 3 3\nEDGE_SE2 225 300 1 0 0 9 0 0 9 0 9\n"
    landmarks = {"pyfg": "EDGE_RANGE 0 A225 L9 4 0.01\nEDGE_RANGE 1 A226 L9 4 0.01\n", "g2o": "EDGE_SE2_XY 225 226 3 3 1 0 1\n"}
    (tmp_path / f"in.{ending}").write_text({"pyfg": pyfg, "g2o": g2o}[ending] + landmarks[ending])
    assert main(["optimize", str(tmp_path / f"in.{ending}"), "--out", str(tmp_path / f"out.{there}")]) == 0
    lines = lines_of(tmp_path / f"out.{there}", "VERTEX")
    names = {line.split()[1 + (there == "pyfg" and "_XY" not in line)] for line in lines}
    expected = {"pyfg": {"A225", "A226", "b7", "L9"}, "g2o": {"225", "300", "226"}}[ending]
    assert names == ({"A225", "A300", "L226"} if ending != there else expected)


def lines_of(path, tag):
    return [line for line in path.read_text().splitlines() if line.startswith(tag)]


def test_all_edges_of_a_kind_are_counted(tmp_path, capsys):
    """Robust kernels part the edges of one kind in two: they are counted together."""
    from uwblite.cli import main

    edges = "".join(f"EDGE_SE2 {i} {j} {j - i} 0 0 9 0 0 9 0 9\n" for i, j in ((0, 1), (1, 2), (0, 2)))
    (tmp_path / "a.g2o").write_text(edges)
    assert main(["optimize", str(tmp_path / "a.g2o"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["edges"] == {"RelativePoseEdges": 3}


def test_an_edge_that_leaves_a_direction_open_is_written_so_that_readers_can_factorize_it(tmp_path):
    """The Cholesky factor of a singular matrix, as gtsam takes it, breaks down; the direction stays as good as open."""
    poses = np.array([[0.0, 0.0, 0.0], [1.0, 0.1, 0.2]])
    L = np.array([[80.0, 60.0, -10.0], [0.0, 0.0, 90.0], [0.0, 0.0, 0.0]])
    edge = RelativePoseEdges(np.array([0]), np.array([1]), np.array([[1.1, 0.0, 0.18]]), L[None])
    graph = Graph(poses, np.zeros((0, 2)), (edge,))
    for name, write, read in (("x.g2o", write_g2o, read_g2o), ("x.pyfg", write_pyfg, read_pyfg)):
        write(tmp_path / name, graph)
        back = read(tmp_path / name).graph
        [found] = [e for e in back.edges if isinstance(e, RelativePoseEdges)]
        [information] = np.swapaxes(found.sqrt_information, 1, 2) @ found.sqrt_information
        factor = np.linalg.cholesky(information)
        np.testing.assert_allclose(factor @ factor.T, L.T @ L, atol=1e-3)
        assert back.chi2() == pytest.approx(graph.chi2(), rel=1e-5)


def test_ids_of_gtsam_and_several_fixed_vertices_on_a_line(tmp_path):
    """gtsam puts a letter into the highest byte of an id; g2o reads FIX to the end of the line."""
    x = ord("x") << 56
    edges = [f"EDGE_SE2 {x + k} {x + k + 1} 1 0 0 1 0 0 1 0 1\n" for k in range(3)]
    (tmp_path / "a.g2o").write_text(f"FIX {x} {x + 2} {x + 9}\n" + "".join(edges))
    file = read_g2o(tmp_path / "a.g2o")
    assert file.pose_ids == tuple(str(x + k) for k in range(4))
    assert file.graph.fixed_poses.tolist() == [True, False, True, False]
    (tmp_path / "b.g2o").write_text("FIX\n" + edges[0])
    with pytest.raises(FormatError, match="FIX has 0 fields, expected 1"):
        read_g2o(tmp_path / "b.g2o")
    (tmp_path / "c.g2o").write_text(edges[0].replace(str(x), str(2**63)))
    with pytest.raises(FormatError, match="is not a vertex id"):
        read_g2o(tmp_path / "c.g2o")


def test_one_known_landmark_does_not_also_hold_the_first_pose(tmp_path):
    lines = "VERTEX_XY 9 5 5\nFIX 9\n" + "".join(f"EDGE_SE2 {k} {k + 1} 1 0 0.5 1 0 0 1 0 1\n" for k in range(3))
    (tmp_path / "a.g2o").write_text(lines + "".join(f"EDGE_RANGE_SE2_XY {k} 9 {1 + k} 100\n" for k in range(4)))
    graph = read_g2o(tmp_path / "a.g2o").graph
    assert not graph.fixed_poses.any()
    assert graph.fixed_anchors.tolist() == [True]


def test_a_prior_says_where_poses_start_that_nothing_else_places(tmp_path):
    lines = "".join(f"EDGE_SE2 {k} {k + 1} 1 0 0 1 0 0 1 0 1\n" for k in range(3))
    (tmp_path / "a.g2o").write_text(lines + f"EDGE_PRIOR_SE2 1 7 8 {np.pi / 2!r} 1 0 0 1 0 1\n")
    poses = read_g2o(tmp_path / "a.g2o").graph.poses
    np.testing.assert_allclose(poses[:, :2], [[7, 7], [7, 8], [7, 9], [7, 10]], atol=1e-12)
