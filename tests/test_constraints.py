"""What is known beforehand: frames found, moved anchors named, edges right, files strict."""

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.laser_walks import chained
from helpers.told import told
from hypothesis import given
from hypothesis import strategies as st

from uwblite import se2
from uwblite.constraints import Clock, Constraints, ForbiddenClosure, GivenAnchor, GivenClosure, GivenDistance, GivenPose
from uwblite.errors import ConfigError, FormatError
from uwblite.graph.graph import Graph, PriorEdges
from uwblite.graph.point_edges import AnchorDistanceEdges
from uwblite.graph.pose_edges import RelativePoseEdges
from uwblite.graph.range_edges import RangeEdges
from uwblite.graph.solver import optimize
from uwblite.io.constraints_file import parse_constraints, read_anchors
from uwblite.pipeline.constraint_edges import _gauge, apply, apply_given, consensus
from uwblite.pipeline.estimate import Estimate, Task
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.pipeline.progress import Stages
from uwblite.radio.bootstrap_attempt import BootstrapResult

IDS = ("A", "B", "C", "D")
TRUE = np.array([[0.0, 0.0], [8.0, 1.0], [7.0, 6.0], [-1.0, 5.0]])
STAMPS = 100.0 + 0.5 * np.arange(40)
CLOCK = Clock(STAMPS, np.zeros(40, dtype=np.intp))
ALL = np.ones(4, dtype=bool)


def drive():
    turn = np.linspace(0, 2 * np.pi, 40)
    return np.stack([3.5 + 2.5 * np.cos(turn), 3 + 1.5 * np.sin(turn), se2.wrap_angle(turn + np.pi / 2)], axis=1)


def first_estimate(T=(2.0, -3.0, 1.2), anchors=TRUE):
    """The truth seen in another frame, with edges that hold it together."""
    T = np.array(T)
    poses, anchors = se2.compose(T, drive()), se2.transform(T, anchors)
    i = np.arange(39)
    chain = RelativePoseEdges(i, i + 1, se2.between(poses[:-1], poses[1:]), np.tile(np.eye(3) * 100, (39, 1, 1)))
    pose, anchor = np.repeat(np.arange(40), 4), np.tile(np.arange(4), 40)
    distance = np.hypot(*(poses[pose, :2] - anchors[anchor]).T)
    none = np.zeros(160)
    radio = RangeEdges(
        pose, anchor, distance, np.full(160, 0.05), np.zeros((160, 2)), none, np.zeros((160, 2)), np.zeros(2), none,
        np.full((160, 6), -1),
    )  # fmt: skip
    return Graph(poses, anchors).with_edges(chain, radio)


def surveyed(*ids, movable=False, shift=(0.0, 0.0)):
    return tuple(GivenAnchor(i, tuple(TRUE[IDS.index(i)] + shift), 0.02, movable) for i in ids)


angle = st.floats(-np.pi, np.pi)


@given(st.tuples(st.floats(-50, 50), st.floats(-50, 50), angle), st.sampled_from(["AB", "ABC", "ABCD", "BD"]))
def test_the_users_frame_is_found_from_anchors(T, ids):
    done = apply(Constraints(anchors=surveyed(*ids)), first_estimate(T), IDS, ALL, CLOCK)
    np.testing.assert_allclose(done.graph.anchors, TRUE, atol=1e-9)
    np.testing.assert_allclose(se2.between(drive(), done.graph.poses), 0, atol=1e-9)
    assert done.moved == {}


@given(st.tuples(st.floats(-50, 50), st.floats(-50, 50), angle))
def test_the_users_frame_is_found_from_a_pose(T):
    constraints = Constraints(poses=(GivenPose(float(STAMPS[7]), tuple(drive()[7].tolist())),))
    done = apply(constraints, first_estimate(T), IDS, ALL, CLOCK)
    np.testing.assert_allclose(se2.between(drive(), done.graph.poses), 0, atol=1e-9)


def test_given_poses_hold_the_map_as_far_as_they_are_sure():
    """Two that lie 0.1 m farther apart than odometry and ranges have it; the second says nothing of its heading."""
    there, sigma = drive()[[7, 30]] + np.array([[0.0] * 3, [0.1, 0.0, 2.0]]), ((0.01, 0.02, 0.05), (1e-4, 1e-4, 100.0))
    given = tuple(
        GivenPose(float(STAMPS[k]), tuple(pose.tolist()), s) for k, pose, s in zip((7, 30), there, sigma, strict=True)
    )
    done = apply(Constraints(poses=given), first_estimate(), IDS, ALL, CLOCK)
    (prior,) = (e for e in done.graph.edges if isinstance(e, PriorEdges))
    assert (prior.block, prior.index.tolist()) == ("poses", [7, 30])
    np.testing.assert_allclose(prior.value, there)
    np.testing.assert_allclose(prior.sqrt_information, [np.diag(1.0 / np.array(s)) for s in sigma])
    solved, _ = optimize(done.graph)
    np.testing.assert_allclose(solved.poses[30, :2], there[1, :2], atol=1e-3)
    assert abs(se2.wrap_angle(solved.poses[30, 2] - drive()[30, 2])) < 0.1


def test_one_anchor_leaves_the_heading_as_it_was():
    done = apply(Constraints(anchors=surveyed("B")), first_estimate((2, -3, 0.0)), IDS, ALL, CLOCK)
    solved, summary = optimize(done.graph)
    assert summary.converged
    np.testing.assert_allclose(solved.anchors, TRUE, atol=1e-6)


@pytest.mark.parametrize(("ids", "moved", "fixed"), [("B", 0, True), ("AB", 0, False), ("ABCD", 3, True), ("ABCD", 2, False)])
def test_the_heading_is_fixed_where_one_anchor_alone_is_given(ids, moved, fixed):
    """Anchors that were moved since say nothing about it."""
    edges = _gauge(Constraints(anchors=surveyed(*ids)), first_estimate(), dict.fromkeys(IDS[:moved], 1.0))
    assert [(e.block, e.index.tolist(), np.flatnonzero(e.sqrt_information[0]).tolist()) for e in edges] == (
        [("poses", [0], [8])] if fixed else []
    )


def test_a_given_pose_fixes_the_heading_itself():
    constraints = Constraints(anchors=surveyed("B"), poses=(GivenPose(float(STAMPS[7]), (0.0, 0.0, 0.0)),))
    assert _gauge(constraints, first_estimate(), {}) == []


@pytest.mark.parametrize("align", ["odometry", "walls"])
def test_given_places_and_an_alignment_exclude_each_other(align):
    graph = first_estimate()
    found = BootstrapResult(graph, ALL, (), ~ALL)
    estimate = Estimate(replace(graph, edges=()), chained(graph.poses, np.full(3, 0.01)), graph.edges[1], IDS, found)
    for places, refused in ((Constraints(anchors=surveyed("A", "B")), align == "walls"), (Constraints(), False)):
        task = Task(SimpleNamespace(clock=CLOCK), MappingConfig(align=align), places, Stages(None, None))
        with pytest.raises(ConfigError, match="leave out align") if refused else nullcontext():
            assert apply_given(estimate, task).graph.chi2() < 1e-6


def test_solving_keeps_what_was_given_and_the_first_pose_is_free():
    anchors = TRUE + np.random.default_rng(1).normal(0, 0.1, TRUE.shape)
    done = apply(Constraints(anchors=surveyed(*IDS)), first_estimate(anchors=anchors), IDS, ALL, CLOCK)
    assert not done.graph.fixed_poses.any()
    solved, summary = optimize(done.graph)
    assert summary.converged
    # Ranges of a slightly different world against the survey: both yield by less than the difference.
    assert np.all(np.hypot(*(solved.anchors - TRUE).T) < 0.15)
    assert solved.chi2() <= done.graph.chi2()


@pytest.mark.parametrize("which", IDS)
def test_an_anchor_moved_since_the_earlier_map_is_named_and_does_not_bend_the_map(which):
    anchors = TRUE.copy()
    anchors[IDS.index(which)] += (2.0, -1.5)
    constraints = Constraints(anchors=surveyed(*IDS, movable=True))
    done = apply(constraints, first_estimate(anchors=anchors), IDS, ALL, CLOCK)
    assert set(done.moved) == {which}
    assert done.moved[which] == pytest.approx(2.5, abs=0.01)
    np.testing.assert_allclose(done.graph.anchors, anchors, atol=1e-6)
    solved, _ = optimize(done.graph)
    np.testing.assert_allclose(solved.anchors, anchors, atol=1e-6)


def test_it_is_told_with_how_far_it_was_moved():
    anchors = TRUE.copy()
    anchors[2] += (2.0, -1.5)
    graph, stages = first_estimate(anchors=anchors), Stages(None, None)
    found = BootstrapResult(graph, ALL, (), ~ALL)
    estimate = Estimate(replace(graph, edges=()), chained(graph.poses, np.full(3, 0.01)), graph.edges[1], IDS, found)
    given = Constraints(anchors=surveyed(*IDS, movable=True))
    done = apply_given(estimate, Task(SimpleNamespace(clock=CLOCK), MappingConfig(), given, stages))
    np.testing.assert_allclose(done.graph.anchors, anchors, atol=0.02)
    (finding,) = told(stages.facts)
    assert (finding.kind, finding.severity, finding.anchor) == ("moved-anchor", "warning", "C")
    assert "anchor C stands 2.50 m from its earlier place" in finding.text


def test_a_given_distance_between_anchors_counts():
    constraints = Constraints(distances=(GivenDistance(("A", "B"), 9.0, 0.001),))
    done = apply(constraints, first_estimate(), IDS, ALL, CLOCK)
    np.testing.assert_array_equal(done.graph.fixed_poses, np.arange(len(done.graph.poses)) == 0)
    solved, _ = optimize(done.graph)
    assert np.hypot(*(solved.anchors[0] - solved.anchors[1])) == pytest.approx(9.0, abs=0.05)


def test_the_jacobian_of_a_distance_is_right():
    edges = AnchorDistanceEdges(np.array([0, 2]), np.array([1, 3]), np.array([5.0, 3.0]), np.array([0.1, 0.3]))
    graph = first_estimate()
    lin = edges.linearize(graph)
    np.testing.assert_allclose(lin.residuals, edges.residuals(graph))
    for _, index, jacobian in lin.blocks:
        for axis in range(2):
            step = np.zeros_like(graph.anchors)
            step[index, axis] = 1e-6
            up, down = (edges.residuals(graph.updated(graph.poses, graph.anchors + s, np.zeros(0))) for s in (step, -step))
            np.testing.assert_allclose(jacobian[:, :, axis], (up - down) / 2e-6, atol=1e-6)


def test_a_given_closure_ties_two_times_together():
    constraints = Constraints(closures=(GivenClosure((float(STAMPS[3]), float(STAMPS[30]))),))
    edges = apply(constraints, first_estimate(), IDS, ALL, CLOCK).graph.edges[-1]
    assert (edges.i.tolist(), edges.j.tolist()) == ([3], [30])
    np.testing.assert_allclose(edges.sqrt_information[0], np.eye(3) * 10)


def test_forbidden_pairs_are_refused_both_ways_and_others_not():
    constraints = Constraints(forbidden=(ForbiddenClosure((100.0, 200.0), within=5.0),))
    one, two = np.array([101.0, 199.0, 101.0, 150.0]), np.array([198.0, 104.0, 190.0, 200.0])
    clock = Clock(np.concatenate([one, two]), np.zeros(8, dtype=np.intp))
    assert constraints.allowed(clock, np.arange(4), np.arange(4, 8)).tolist() == [False, False, True, True]


def test_stamps_of_several_recordings_are_distinguished():
    """Two clocks that both begin at 100 s; the second is meant where it is named."""
    clock = Clock(np.concatenate([STAMPS[:20], STAMPS[:20]]), np.repeat([0, 1], 20))
    stamp = float(STAMPS[7])
    assert (clock.nearest(stamp, 1), clock.nearest(stamp, 2)) == (7, 27)
    constraints = Constraints(closures=(GivenClosure((stamp, stamp), recordings=(2, 1)),))
    edges = apply(constraints, first_estimate(), IDS, ALL, clock).graph.edges[-1]
    assert (edges.i.tolist(), edges.j.tolist()) == ([27], [7])
    banned = Constraints(forbidden=(ForbiddenClosure((stamp, stamp), within=0.1, recordings=(1, 2)),))
    i, j = np.array([7, 27, 6, 7]), np.array([27, 7, 27, 7])
    assert banned.allowed(clock, i, j).tolist() == [False, False, True, True]
    with pytest.raises(ConfigError, match="there is no recording 3; there are 2"):
        apply(Constraints(poses=(GivenPose(stamp, (0, 0, 0), recording=3),)), first_estimate(), IDS, ALL, clock)
    with pytest.raises(ConfigError, match=r"outside recording 2 \(100 to 109.5 s\)"):
        apply(Constraints(poses=(GivenPose(300.0, (0, 0, 0), recording=2),)), first_estimate(), IDS, ALL, clock)


def test_a_stamp_outside_the_only_recording_is_said_to_be_outside_the_recording():
    """A second before the first pose and after the last one are taken for the ends."""
    for stamp in (STAMPS[0] - 1.0, STAMPS[-1] + 1.0):
        assert CLOCK.nearest(float(stamp), 1) in (0, 39)
    for stamp in (STAMPS[0] - 1.1, STAMPS[-1] + 1.1):
        with pytest.raises(ConfigError, match=r"lies outside the recording \(100 to 119.5 s\)"):
            CLOCK.nearest(float(stamp), 1)


def test_of_a_moved_anchor_the_last_place_counts(tmp_path):
    file = tmp_path / "anchors.csv"
    file.write_text("id,x,y,sigma_x,sigma_y,status\nA,1,2,0.1,0.1,ok\nA#2,5,6,0.1,0.1,ok\nB#7,3,4,0.1,0.1,ok\n")
    assert [(a.id, a.position) for a in read_anchors(file).anchors] == [("A", (5.0, 6.0)), ("B#7", (3.0, 4.0))]


def test_sums_take_the_later_place_of_an_anchor():
    both = Constraints(anchors=surveyed("A", "B", movable=True)) + Constraints(anchors=surveyed("B", shift=(1, 0)))
    assert [(a.id, a.movable) for a in both.anchors] == [("A", True), ("B", False)]


@pytest.mark.parametrize(
    ("constraints", "message"),
    [
        (Constraints(anchors=(GivenAnchor("X", (0, 0)),)), "no ranges to anchor X; the recording has A, B, C, D"),
        (Constraints(distances=(GivenDistance(("A", "Y"), 1.0),)), "anchor Y"),
        (Constraints(poses=(GivenPose(7.0, (0, 0, 0)),)), "stamp 7 lies outside"),
        (Constraints(closures=(GivenClosure((101.0, 900.0)),)), "stamp 900 lies outside"),
    ],
)
def test_what_does_not_belong_to_the_recording_is_refused(constraints, message):
    with pytest.raises(ConfigError, match=message):
        apply(constraints, first_estimate(), IDS, ALL, CLOCK)
    gone = Constraints(anchors=(GivenAnchor("X", (0, 0), movable=True), *surveyed("A", "B", movable=True)))
    np.testing.assert_allclose(apply(gone, first_estimate(), IDS, ALL, CLOCK).graph.anchors, TRUE, atol=1e-6)


FILE = """
[[anchor]]
id = "5C0B"
position = [1.0, 2]
sigma = 0.02

[[pose]]
stamp = 12.5
pose = [0, 0, 1.5]

[[anchor_distance]]
anchors = ["5C0B", "91A3"]
distance = 7.25

[[closure]]
stamps = [10, 200]

[[forbidden_closure]]
stamps = [10, 300]
within = 20
"""


def test_a_file_reports_it_all():
    constraints = parse_constraints(FILE)
    assert constraints.anchors == (GivenAnchor("5C0B", (1.0, 2.0), 0.02),)
    assert constraints.poses[0].pose == (0.0, 0.0, 1.5)
    assert constraints.distances[0].anchors == ("5C0B", "91A3")
    assert constraints.closures[0].stamps == (10.0, 200.0)
    assert constraints.forbidden[0].within == 20.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[[anchr]]\nid = 'A'", r"unknown table 'anchr'; it may hold \[\[anchor\]\]"),
        ("[anchor]\nid = 'A'", "unknown table 'anchor'"),
        ("[[anchor]]\nid = 'A'", r"\[\[anchor\]\] number 1 needs position"),
        ("[[anchor]]\nid = 'A'\nposition = [1]", "2 values, not 1"),
        ("[[anchor]]\nid = 'A'\nposition = [1, 2]\nsigma = 0", "must be > 0"),
        ("[[anchor]]\nid = 'A'\nposition = [1, 2]\nsgma = 1", "did you mean 'sigma'"),
        ("anchor = [1]", "not a table"),
        ("x = ", "not valid TOML"),
    ],
)
def test_a_wrong_file_is_named(text, message):
    for path, named in (("", "constraints"), ("known.toml", "known.toml")):
        with pytest.raises(ConfigError, match=f"^{named}: .*{message}"):
            parse_constraints(text, path)


def test_the_anchors_of_an_earlier_map(tmp_path):
    file = tmp_path / "anchors.csv"
    file.write_text("id,x,y,sigma_x,sigma_y,status\nA,1,2,0.01,0.3,ok\nB,3,4,,,ok\nC,,,,,unplaced\nD,1,1,1,1,distrusted\n")
    constraints = read_anchors(file)
    assert constraints.anchors == (GivenAnchor("A", (1.0, 2.0), 0.3, True), GivenAnchor("B", (3.0, 4.0), 0.02, True))
    file.write_text("id,x,y\nC,,\n")
    with pytest.raises(FormatError, match="no anchor in it has a place"):
        read_anchors(file)
    file.write_text("id,x\nC,1\n")
    with pytest.raises(FormatError, match="no column 'y'"):
        read_anchors(file)


@pytest.mark.parametrize("field", ["position = [1e300, 0]", "position = [0, 0]\nsigma = 1e9"])
def test_numbers_that_nobody_measured_are_refused(field):
    with pytest.raises(ConfigError, match="beyond 1e"):
        parse_constraints(f'[[anchor]]\nid = "A"\n{field}\n')


@pytest.mark.parametrize("seed", range(6))
def test_the_consensus_is_that_of_a_loop_over_pairs(seed):
    """Of all motions that bring a pair together, the one with most places nearby, 1 - (error / tolerance)^2 each."""
    rng = np.random.default_rng(seed)
    here, tolerance = rng.uniform(-8.0, 8.0, (7, 2)), rng.uniform(0.5, 1.5, 7)
    there = se2.transform([3.0, -1.0, 0.8], here) + rng.normal(scale=0.7, size=(7, 2))
    there[:2] += 6.0
    worth, best = -1.0, None
    for i in range(7):
        for j in range(i + 1, 7):
            motion = se2.align(here[[i, j]], there[[i, j]])
            off = np.hypot(*(se2.transform(motion, here) - there).T) / tolerance
            total = sum(1.0 - e * e for e in off if e < 1.0)
            if total > worth:
                worth, best = total, off < 1.0
    np.testing.assert_allclose(consensus(here, there, tolerance), se2.align(here[best], there[best]))


@pytest.mark.parametrize(("ids", "fixed"), [("", True), ("A", True), ("AB", False)])
def test_the_heading_of_the_first_pose_is_fixed_where_one_place_leaves_it_open(ids, fixed):
    edges = apply(Constraints(anchors=surveyed(*ids)), first_estimate(), IDS, ALL, CLOCK).graph.edges
    priors = [e for e in edges if isinstance(e, PriorEdges) and e.block == "poses"]
    assert len(priors) == (1 if fixed and ids else 0)
    for prior in priors:
        np.testing.assert_array_equal(prior.sqrt_information[0], np.diag([0.0, 0.0, 1e4]))
        assert prior.index.tolist() == [0]
