"""Distances between landmarks: edges that are right, landmarks that are found, a map that becomes as long as it is."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import planted
from helpers.planted_tasks import task_of
from helpers.told import warned
from hypothesis import given
from hypothesis import strategies as st

from uwblite import build_map, se2
from uwblite.constraints import Constraints, GivenLandmark, GivenLandmarkDistance
from uwblite.errors import ConfigError
from uwblite.graph.graph import Graph
from uwblite.graph.point_edges import PointDistanceEdges
from uwblite.io.constraints_file import parse_constraints
from uwblite.lidar import clouds
from uwblite.lidar.scan_to_scan import TrackingConfig
from uwblite.mapping import MappingConfig
from uwblite.pipeline.constraint_edges import Ties, _column_in, observations, outcome, ties
from uwblite.sensor_log import Odometry

LONG, SCALE = 24.0, 0.96
"""m between the two columns, and what the wheels make of a metre."""


def random_graph(seed):
    rng = np.random.default_rng(seed)
    poses = np.column_stack([rng.uniform(-5, 5, (6, 2)), rng.uniform(-np.pi, np.pi, 6)])
    points = rng.uniform(-3, 3, (2, 3, 2))
    edges = PointDistanceEdges(
        np.array([0, 1, 2]), np.array([3, 4, 5]), points[0], points[1], rng.uniform(1, 9, 3), rng.uniform(0.01, 0.5, 3)
    )
    return Graph(poses), edges


@given(st.integers(0, 10_000))
def test_the_jacobian_is_that_of_differences(seed):
    graph, edges = random_graph(seed)
    lin = edges.linearize(graph)
    np.testing.assert_allclose(lin.residuals, edges.residuals(graph))
    for _, index, jacobian in lin.blocks:
        for axis in range(3):
            step = np.zeros_like(graph.poses)
            step[index, axis] = 1e-6
            up, down = (edges.residuals(graph.updated(graph.poses + s, graph.anchors, np.zeros(0))) for s in (step, -step))
            tolerance = 1e-5 * max(1.0, float(np.abs(jacobian).max()))
            np.testing.assert_allclose(jacobian[:, :, axis], (up - down) / 2e-6, atol=tolerance)


@given(st.integers(0, 10_000), st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-np.pi, np.pi)))
def test_a_distance_does_not_care_where_the_frame_lies(seed, T):
    graph, edges = random_graph(seed)
    moved = Graph(se2.compose(np.array(T), graph.poses))
    np.testing.assert_allclose(edges.residuals(graph), edges.residuals(moved), atol=1e-8)


def post(x, y, radius=0.3, sides=12):
    """A round column as a polygon about its circle."""
    angle = 2 * np.pi * np.arange(sides + 1) / sides
    ring = np.array([x, y]) + radius / np.cos(np.pi / sides / 2) * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.hstack([ring[:-1], ring[1:]])


WALLS = np.vstack([
    [[-30.0, 1.5, 60.0, 1.5], [-30.0, -1.5, 60.0, -1.5]], post(2.0, 0.9), post(2.0 + LONG, 0.9),
])  # fmt: skip
"""A corridor without end or feature, but for two columns not visible from each other."""


def drive_along(scale):
    """There and back along it, with wheels that make of a metre at x scale(x)."""
    turn = ((0.0, 0.0, 0.4), np.pi / 0.4)
    legs = [((0.4, 0.0, 0.0), (LONG + 3.0) / 0.4), turn, ((0.4, 0.0, 0.0), (LONG + 3.0) / 0.4)]
    stamps, truth = planted.drive([t for t, _ in legs], [s for _, s in legs])
    rng = np.random.default_rng(5)
    stated = planted.odometry(stamps, truth, rng, noise=0.002, turn_noise=0.002)
    motion = se2.between(stated.poses[:-1], stated.poses[1:])
    motion[:, :2] *= scale(truth[:-1, 0])[:, None]
    lidar = planted.scans(stamps, truth, WALLS, range_max=4.0, noise=0.01, rng=rng)
    return planted.recording(Odometry(stamps, planted.chain(np.zeros(3), motion)), lidar=lidar), stamps, truth


@pytest.fixture(scope="module")
def carpet():
    """Wheels that slip where there is nothing to see."""
    return drive_along(lambda x: np.where((x > 7.0) & (x < 21.0), 0.93, 1.0))


@pytest.fixture(scope="module")
def wrong_wheels():
    """Wheels that are smaller than the robot is configured for, everywhere."""
    return drive_along(lambda x: np.full(len(x), SCALE))


def surveyed(far, distance=LONG, sigma=0.02, radius=0.3):
    places = {"near": (2.0, 0.9), "far": (far, 0.9)}
    return Constraints(
        landmarks=tuple(GivenLandmark(name, place, radius) for name, place in places.items()),
        landmark_distances=(GivenLandmarkDistance(("near", "far"), distance, sigma),),
    )


def stretch(result, stamps, truth):
    """How long the map's path is against the true one, end to end of the way there."""
    there = np.argmax(truth[:, 0])
    ends = se2.interpolate_trajectory(result.stamps, result.trajectory, stamps[[0, there]])
    return np.hypot(*(ends[1] - ends[0])[:2]) / np.hypot(*(truth[there] - truth[0])[:2])


@pytest.mark.slow
def test_a_measured_distance_gives_the_map_its_true_length(carpet):
    log, stamps, truth = carpet
    before = stretch(build_map(log), stamps, truth)
    assert before < 0.98
    after = build_map(log, constraints=surveyed(2.0 + LONG * before))
    # The tape's sigma, and a centimetre or two of each column's place.
    assert stretch(after, stamps, truth) == pytest.approx(1.0, abs=3 * np.hypot(0.02, 0.02) / LONG)
    reported = next(s for s in after.stages if s.name == "landmark distances").figures["distances"]
    assert reported[0]["map"] == pytest.approx(LONG, abs=0.06)
    assert not [w for w in after.warnings if "measured" in w.text]


def test_a_measured_distance_calibrates_the_wheels(wrong_wheels):
    """Scans are not matched with each other here: wheels and tape are all there is."""
    log, stamps, truth = wrong_wheels
    blind = MappingConfig(use_loops=False, scan_to_scan=TrackingConfig(on=False))
    assert stretch(build_map(log, blind), stamps, truth) == pytest.approx(SCALE, abs=0.003)
    names = zip(("near", "far"), (2.0, 2.0 + LONG), strict=True)
    shrunk = replace(surveyed(0.0), landmarks=tuple(GivenLandmark(name, (SCALE * x, 0.9), 0.3) for name, x in names))
    after = build_map(log, blind, constraints=shrunk)
    reported = next(s for s in after.stages if s.name == "landmark distances").figures["distances"]
    assert reported[0]["map"] == pytest.approx(LONG, abs=0.06)
    # The way there alone may bend a little: the tape holds both ways together.
    assert stretch(after, stamps, truth) == pytest.approx(1.0, abs=0.015)
    scale = next(c for c in after.calibration if c.name == "odometry_scale")
    assert scale.value == pytest.approx(1 / SCALE - 1, abs=2 * scale.sigma)
    # Well below the prior of 0.02; errors of the floor, alike over ten steps, double what single steps would leave.
    assert scale.sigma < 0.6 * 0.02


@pytest.mark.slow
def test_places_are_those_of_the_map_as_it_is_turned(carpet):
    log, stamps, truth = carpet
    plain = build_map(log, MappingConfig(align="first-pose"))
    walls = build_map(log, MappingConfig(align="walls"))
    turn = se2.compose(walls.graph.poses[0], se2.inverse(plain.graph.poses[0]))
    places = se2.transform(turn, np.array([[2.0, 0.9], [2.0 + LONG * stretch(plain, stamps, truth), 0.9]])).tolist()
    names = zip(("near", "far"), places, strict=True)
    given = replace(surveyed(0.0), landmarks=tuple(GivenLandmark(name, tuple(place), 0.3) for name, place in names))
    after = build_map(log, MappingConfig(align="walls"), constraints=given)
    assert stretch(after, stamps, truth) == pytest.approx(1.0, abs=3 * np.hypot(0.02, 0.02) / LONG)


def test_a_distance_that_all_else_contradicts_is_named():
    stamps, truth = planted.drive([(0.3, 0.0, 0.15)], [45.0], start=(0.0, -2.0, 0.0))
    rng = np.random.default_rng(2)
    lidar = planted.scans(stamps, truth, np.vstack([planted.box(9, 7), post(3, 2), post(-3, 2)]), noise=0.01, rng=rng)
    log = planted.recording(planted.odometry(stamps, truth, rng, noise=0.002, turn_noise=0.002), lidar=lidar)
    here = se2.transform(se2.inverse(truth[0]), np.array([[3.0, 2.0], [-3.0, 2.0]])).tolist()
    wrong = Constraints(
        landmarks=(GivenLandmark("a", tuple(here[0]), 0.3), GivenLandmark("b", tuple(here[1]), 0.3)),
        landmark_distances=(GivenLandmarkDistance(("a", "b"), 7.0, 0.05),),
    )
    result = build_map(log, MappingConfig(), constraints=wrong)
    assert [w for w in result.warnings if "a - b" in w.text and "7.000 m" in w.text]


def test_what_is_not_there_is_reported(carpet):
    log, _, _ = carpet
    nowhere, alone = GivenLandmark("x", (12.0, 9.0)), GivenLandmarkDistance(("x", "x"), 1.0)
    lost = Constraints(landmarks=(nowhere,), landmark_distances=(alone,))
    with pytest.raises(ConfigError, match="saw nothing within"):
        build_map(log, MappingConfig(use_loops=False), constraints=lost)
    with pytest.raises(ConfigError, match="need the lidar"):
        build_map(log, MappingConfig(use_lidar=False), constraints=surveyed(26.0))


def one_cloud(points):
    points = np.asarray(points, dtype=float)
    n = len(points)
    return clouds.Clouds(np.array([0, n]), points, np.zeros((n, 2)), np.zeros(n, dtype=np.intp), np.zeros(n))


def test_a_column_is_found_beside_its_given_place():
    angle = np.linspace(0, 2 * np.pi, 60)
    ring = np.column_stack([4.0 + 0.3 * np.cos(angle), 1.0 + 0.3 * np.sin(angle)])
    pose = np.array([[1.0, 2.0, 0.7]])
    given = tuple(se2.transform(pose[0], np.array([4.15, 0.9])).tolist())
    _, position = observations(GivenLandmark("c", given, 0.3), one_cloud(ring), pose, np.zeros(1))
    np.testing.assert_allclose(position, [[4.0, 1.0]], atol=0.01)
    _, plain = observations(GivenLandmark("c", given), one_cloud(ring), pose, np.zeros(1))
    np.testing.assert_allclose(plain, [[4.15, 0.9]], atol=1e-12)
    with pytest.raises(ConfigError, match=r"no column of radius 0\.6"):
        observations(GivenLandmark("c", given, 0.6), one_cloud(ring), pose, np.zeros(1))


def test_each_visit_observes_a_column_where_its_own_cloud_saw_it():
    """A second visit whose pose is 0.1 m off in the map, and one after it that sees a single point less and counts no more."""
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    ring = 0.3 * np.column_stack([np.cos(angle), np.sin(angle)])
    truth = np.array([[1.0, 2.0, 0.7], [3.0, -1.0, -0.4], [3.5, -1.0, -0.4]])
    centres = se2.transform(se2.inverse(truth), np.array([4.0, 1.0]))
    seen = [centres[0] + ring, centres[1] + ring, centres[2] + ring[1:]]
    points, counts = np.concatenate(seen), [len(own) for own in seen]
    owner = np.repeat(np.arange(3, dtype=np.int32), counts)
    three = clouds.Clouds(np.append(0, np.cumsum(counts)), points, np.zeros_like(points), owner, np.zeros(len(points)))
    poses = truth + np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.1, 0.0, 0.0]])
    keyframe, position = observations(GivenLandmark("c", (4.05, 1.0), 0.3), three, poses, np.array([0.0, 20.0, 20.5]))
    assert keyframe.tolist() == [0, 1]
    np.testing.assert_allclose(position, centres[:2], atol=0.01)


def test_a_cloud_s_own_column_is_what_it_saw_near_the_place():
    """Another column a metre away does not count, on whichever side of the place it stands."""
    angle = np.linspace(0, 2 * np.pi, 40)
    ring = 0.3 * np.column_stack([np.cos(angle), np.sin(angle)])
    for far in (1.05, -1.05):
        both = np.concatenate([ring + np.array([2.0, 1.0]), ring + np.array([2.0, 1.0 + far])])
        np.testing.assert_allclose(_column_in(both, np.array([2.1, 0.95]), 0.3), [2.0, 1.0], atol=1e-3)


@pytest.mark.parametrize(("length", "named"), [(3.0, False), (3.29, False), (3.31, True), (2.69, True)])
def test_a_distance_off_by_more_than_three_sigma_is_a_warning(length, named):
    edges = PointDistanceEdges(*(np.array([k]) for k in (0, 1)), *np.zeros((2, 1, 2)), np.array([3.0]), np.array([0.1]))
    distance = GivenLandmarkDistance(("a", "b"), 3.0, 0.1)
    task = task_of(constraints=Constraints(landmark_distances=(distance,)))
    graph = Graph(np.array([[0.0, 0.0, 0.0], [length, 0.0, 0.0]]))
    (figures,) = outcome(task, Ties(edges, np.array([0])), graph)
    assert figures == {"landmarks": "a - b", "measured": 3.0, "map": length}
    assert [n.kind for n in warned(task.stages)] == (["landmark-distance"] if named else [])


def test_all_ties_of_a_distance_weigh_as_much_as_it_does():
    cloud = one_cloud([[1.0, 0.0]] * 5)
    n = 5
    many = clouds.Clouds(
        np.arange(n + 1) * 5, np.tile(cloud.points, (n, 1)), np.zeros((5 * n, 2)), np.repeat(np.arange(n), 5), np.zeros(5 * n)
    )
    given = Constraints(
        landmarks=(GivenLandmark("a", (1.0, 0.0)), GivenLandmark("b", (1.1, 0.0))),
        landmark_distances=(GivenLandmarkDistance(("a", "b"), 3.0, 0.1), GivenLandmarkDistance(("b", "a"), 3.0, 0.2)),
    )
    tied = ties(given, many, np.zeros((n, 3)), 10.0 * np.arange(n))
    for number, sigma in enumerate((0.1, 0.2)):
        own = tied.edges.sigma[tied.measured == number]
        assert np.sum(own**-2.0) == pytest.approx(sigma**-2.0)


def test_the_file_names_landmarks_and_distances():
    text = """
[[landmark]]
name = "C1"
position = [4.0, 6.5]
radius = 0.35
[[landmark]]
name = "C2"
position = [8.0, 6.5]
[[landmark_distance]]
landmarks = ["C1", "C2"]
distance = 4.0
"""
    read = parse_constraints(text)
    assert [(k.name, k.radius) for k in read.landmarks] == [("C1", 0.35), ("C2", 0.0)]
    assert read.landmark_distances[0].sigma == 0.02
    assert read + Constraints() == read
    for wrong, stated in (
        (text.replace("distance = 4.0", "distance = -4.0"), "distance"),
        (text.replace("name = ", "nmae = ", 1), "name"),
        (text.replace('["C1", "C2"]', '["C1"]'), "landmarks"),
        (text.replace("radius = 0.35", "radius = nan"), "radius"),
    ):
        with pytest.raises(ConfigError, match=stated):
            parse_constraints(wrong)
    with pytest.raises(ConfigError, match="no \\[\\[landmark\\]\\]"):
        ties(Constraints(landmark_distances=read.landmark_distances), one_cloud([[0, 0]]), np.zeros((1, 3)), np.zeros(1))
