"""A step of the odometry that no scan measures and that is far off is found again by the clouds of both its sides."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.laser_walks import chained, walked

from uwblite import se2
from uwblite.graph.calibration import scan_indices
from uwblite.graph.graph import Calibration, Graph
from uwblite.graph.pose_edges import ScanEdges
from uwblite.graph.solver import SolverConfig
from uwblite.lidar.correlative_matching import CorrelativeConfig
from uwblite.lidar.submaps import SubmapConfig
from uwblite.lidar.visibility import observed_free_space
from uwblite.loop_closure.closures import LoopClosureConfig
from uwblite.loop_closure.loose_links import (
    LinkPolicy,
    _pieces,
    contradicted,
    loose_links,
    loosened,
    propose,
    spanned,
    untied_breaks,
)
from uwblite.loop_closure.verification import find, reconcile
from uwblite.odometry.wheels import OdometryNoiseConfig

NOISE, LINK = np.array([0.01, 0.005, 0.006]), 30
STOOD = np.array([0.0005, 0.0005, 0.001])
"""What an odometry is sure of while it counts nothing, m, m, rad."""
CONFIG, SOLVER = LoopClosureConfig(), SolverConfig()
ACCURACY = np.array([0.03, 0.03, 0.015])
"""Of a match of clouds with 1 cm of noise from a few hundred points, m, m, rad; generous by a factor of 3."""


@pytest.fixture(scope="module")
def walk():
    return walked(5, metres=30.0)


def scan_edges(truth, steps):
    """Return exact scan edges over some steps of the chain."""
    none, root = np.zeros((len(steps), 3)), np.tile(np.diag([100.0, 100.0, 300.0]), (len(steps), 1, 1))
    z = se2.between(truth[steps], truth[steps + 1])
    return ScanEdges(steps, steps + 1, z, root, none, none, scan_indices(Calibration()))


def broken(truth, error, link=LINK):
    """Return the graph whose odometry is wrong by an error (3,) at a link that no scan measures, and these edges."""
    wheels = replace(chained(truth, NOISE), kernel=OdometryNoiseConfig().kernel)
    motion, root = wheels.motion.copy(), wheels.sqrt_information.copy()
    motion[link] = se2.compose(motion[link], error)
    root[link] = np.diag(1.0 / STOOD)
    wheels = replace(wheels, motion=motion, length=motion[:, 0], sqrt_information=root)
    poses = [truth[0]]
    for step in np.where(np.arange(len(truth) - 1)[:, None] == link, motion, se2.between(truth[:-1], truth[1:])):
        poses.append(se2.compose(poses[-1], step))
    steps = np.setdiff1d(np.arange(len(truth) - 1), [link])
    return Graph(np.array(poses)).with_edges(wheels, scan_edges(truth, steps)), wheels


def tied(graph, wheels, clouds, recording=None):
    recording = np.zeros(len(graph.poses), dtype=np.intp) if recording is None else recording
    links = loose_links(wheels, graph)
    candidates, pieces = propose(graph, clouds, wheels, links, recording, CONFIG, SubmapConfig())
    free = observed_free_space(clouds, pieces, graph.poses)
    return links, find(candidates, pieces, CONFIG, CorrelativeConfig(), None, free)


@pytest.mark.parametrize("error", [[0.0, 0.0, 0.45], [-0.3, 0.05, -0.4], [0.5, 0.3, 0.0]], ids=["turn", "both", "way"])
def test_a_link_that_only_a_false_odometry_holds_is_measured_by_the_clouds_of_both_sides(walk, error):
    truth, _, clouds = walk
    graph, wheels = broken(truth, np.array(error))
    links, found = tied(graph, wheels, clouds)
    assert links.tolist() == [LINK]
    assert len(found.edges) > 1
    off = np.abs(se2.between(se2.between(truth[found.edges.i], truth[found.edges.j]), found.edges.T_i_j))
    assert np.all(off < ACCURACY)

    loose = loosened(wheels, spanned(wheels, found.edges), CONFIG)
    solved, kept = reconcile(replace(graph, edges=(loose, *graph.edges[1:])), found, CONFIG, SOLVER)
    wrong = contradicted(wheels, solved) & spanned(wheels, kept.edges)
    assert np.flatnonzero(wrong).tolist() == [LINK]
    ends = [se2.between(poses[LINK], poses[LINK + 1]) for poses in (solved.poses, truth)]
    assert np.all(np.abs(se2.between(*ends)) < ACCURACY)


def test_a_sound_odometry_is_not_loosened(walk):
    truth, _, clouds = walk
    graph, _ = broken(truth, np.zeros(3))
    wheels = chained(truth, NOISE)
    graph = graph.with_edges(wheels, scan_edges(truth, np.setdiff1d(np.arange(len(wheels)), [LINK])))
    links, found = tied(graph, wheels, clouds)
    assert links.tolist() == [LINK]
    assert len(found.edges) > 1
    loose = loosened(wheels, spanned(wheels, found.edges), CONFIG)
    solved, _ = reconcile(replace(graph, edges=(loose, *graph.edges[1:])), found, CONFIG, SOLVER)
    assert not contradicted(wheels, solved).any()


def test_links_that_scans_fix_or_that_see_nothing_are_left_alone(walk):
    truth, _, clouds = walk
    graph, wheels = broken(truth, np.array([0.0, 0.0, 0.45]))
    whole = graph.with_edges(wheels, scan_edges(truth, np.arange(len(truth) - 1)))
    assert len(loose_links(wheels, replace(whole, poses=truth))) == 0
    blind = clouds.only(clouds.owner > LINK + 10)
    assert len(tied(graph, wheels, blind)[1].edges) == 0


def test_many_loose_links_are_no_exceptions(walk):
    """A lidar that hardly follows anywhere is not searched with at every step."""
    truth, _, _ = walk
    wheels = chained(truth, NOISE)
    for count, found in ((5, 5), (20, 0)):
        steps = np.setdiff1d(np.arange(len(wheels)), np.arange(count))
        assert len(loose_links(wheels, Graph(truth).with_edges(wheels, scan_edges(truth, steps)))) == found


def test_pieces_stay_in_the_recording_of_their_link(walk):
    truth, _, clouds = walk
    graph, wheels = broken(truth, np.zeros(3))
    recording = (np.arange(len(truth)) > LINK + 1).astype(np.intp)
    candidates, pieces = propose(graph, clouds, wheels, np.array([LINK]), recording, CONFIG, SubmapConfig())
    assert len(candidates.target) > 0
    assert pieces.last.max() <= LINK + 2


@pytest.mark.parametrize("border", [27, 35])
def test_pieces_reach_over_no_other_link(walk, border):
    truth, _, clouds = walk
    graph, wheels = broken(truth, np.zeros(3))
    links, recording = np.array([24, 30, 32, 38]), (np.arange(len(truth)) > border).astype(np.intp)
    candidates, pieces = propose(graph, clouds, wheels, links, recording, CONFIG, SubmapConfig())
    over = (pieces.first[:, None] <= links) & (pieces.last[:, None] > links + 1)
    assert not over.any()
    assert np.array_equal(recording[pieces.first], recording[pieces.last - 1])
    ends = np.sort(pieces.reference.reshape(-1, 2), axis=1)
    assert np.all(((ends[:, :1] <= links) & (ends[:, 1:] > links)).any(axis=0))
    assert np.array_equal(candidates.source, candidates.target + 1)
    assert pieces.first[pieces.last == border + 1].size > 0


def test_pieces_end_at_the_next_link(walk):
    """Of links behind keyframes 10 and 14: six keyframes before and behind each, as far as no other link lies between."""
    _, _, clouds = walk
    recording = np.zeros(len(clouds), dtype=np.intp)
    first, last, reference = _pieces(np.array([10, 14]), np.array([11, 15]), clouds, recording)
    several = {(int(r), int(a), int(b)) for r, a, b in zip(reference[:, 0], first[:, 0], last[:, 0], strict=True)}
    assert several == {(10, 5, 11), (11, 11, 15), (14, 11, 15), (15, 15, 21)}
    single = {tuple(row) for row in np.column_stack([reference, first[:, 1], last[:, 1]]).tolist()}
    enough = clouds.counts >= LinkPolicy.points
    expected = {(b, a + n, a + n, a + n + 1) for b, a in ((10, 11), (14, 15)) for n in range(3) if enough[a + n]}
    expected |= {(a, b - n, b - n, b - n + 1) for b, a in ((10, 11), (14, 15)) for n in range(3) if enough[b - n]}
    assert single == expected


def one_edge(truth, i, j, root):
    none = np.zeros((1, 3))
    z = se2.between(truth[[i]], truth[[j]])
    return ScanEdges(np.array([i]), np.array([j]), z, np.diag(root)[None], none, none, scan_indices(Calibration()))


ALL, ALONG = (100.0, 100.0, 300.0), (5.0, 100.0, 300.0)
"""What a match fixes, 1/m, 1/m, 1/rad: everything, or the way along a wall to 0.2 m only."""


@pytest.mark.parametrize(
    ("across", "found"),
    [
        ([], True),
        ([(30, 31, ALONG)], True),
        ([(30, 31, ALL)], False),
        ([(28, 32, ALL)], False),
        # Keyframes 3 m apart were laid onto each other where the chain had put them; another visit was searched for.
        ([(27, 33, ALL)], True),
        ([(5, 55, ALONG)], True),
        ([(5, 55, ALL)], False),
    ],
)
def test_a_break_is_tied_by_scans_that_leave_no_direction_free(across, found):
    truth = np.column_stack([0.5 * np.arange(60.0), np.zeros((60, 2))])
    wheels, measured = chained(truth, NOISE), np.arange(59) != LINK
    edges = [scan_edges(truth, np.flatnonzero(measured)), *(one_edge(truth, *edge) for edge in across)]
    graph = Graph(truth).with_edges(wheels, *edges)
    assert untied_breaks(wheels, graph, measured, truth[:, 0]).tolist() == ([LINK] if found else [])


def test_keyframes_between_two_breaks_are_no_part_and_a_few_at_the_ends_neither():
    truth = np.column_stack([0.5 * np.arange(60.0), np.zeros((60, 2))])
    wheels = chained(truth, NOISE)
    for breaks, found in (([30, 32], [32]), ([2], []), ([30, 56], [30]), (np.arange(59), [])):
        measured = ~np.isin(np.arange(59), breaks)
        graph = Graph(truth).with_edges(wheels, scan_edges(truth, np.flatnonzero(measured)))
        assert untied_breaks(wheels, graph, measured, truth[:, 0]).tolist() == found
