"""Ranges as edges: where the tag was, and what of a range lies in the plane."""

from dataclasses import replace

import numpy as np
from helpers.planted_graphs import plain_ranges

from uwblite import se2
from uwblite.graph.graph import Graph


def edges():
    """Return three ranges from two poses, the tag ahead of the base, with lever arms and turns of their own."""
    plain = plain_ranges(np.array([0, 1, 1]), np.zeros(3, dtype=int), np.array([5.0, 13.0, 2.0]), 0.1)
    arm = np.array([[0.0, 0.0], [0.3, -0.2], [0.1, 0.4]])
    turn, height = np.array([0.0, 0.5, -1.2]), np.array([3.0, 5.0, 2.5])
    return replace(plain, tag=np.array([0.2, 0.1]), lever_arm=arm, turn=turn, height=height)


def test_a_range_in_the_plane_is_a_cathete():
    """3, 4, 5 and 5, 12, 13; of a range shorter than the height a centimetre is left."""
    np.testing.assert_allclose(edges().planar_ranges(), [4.0, 12.0, 0.01])


def test_what_a_range_is_known_to_be_too_long_by_does_not_count():
    """A range of 5.5 m that is late by 0.5 m is one of 5 m, also among others of which nothing is known."""
    late = replace(edges(), ranges=np.array([5.5, 13.0, 2.0]), late=np.array([0.5, 0.0, 0.0]))
    graph = Graph(np.array([[1.0, 2.0, 0.4], [-3.0, 0.5, 2.0]]), np.array([[2.0, 6.0]]), ())
    np.testing.assert_allclose(late.planar_ranges(), edges().planar_ranges())
    np.testing.assert_allclose(late.residuals(graph), edges().residuals(graph))
    np.testing.assert_allclose(late.linearize(graph).residuals, late.residuals(graph))
    np.testing.assert_allclose(late.rows(np.array([0])).corrected, [5.0])


def test_the_tag_is_on_the_base_as_it_stood_at_the_range():
    poses = np.array([[1.0, 2.0, 0.4], [-3.0, 0.5, 2.0]])
    for row, where in enumerate(edges().tag_positions(poses)):
        e = edges()
        base = se2.compose(poses[e.pose[row]], [*e.lever_arm[row], e.turn[row]])
        np.testing.assert_allclose(where, se2.transform(base, e.tag))
        np.testing.assert_allclose(e.headings(poses)[row], base[2])
