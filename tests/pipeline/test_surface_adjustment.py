"""Poses adjusted to rays on walls and columns, in a simulated building."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted import aligned_error
from helpers.planted_rays import linearized
from simulation.real_rooms import RealRooms
from simulation.recording import Settings
from trials import made

from uwblite import mapping, se2
from uwblite.graph.calibration import LASER, with_free
from uwblite.graph.marginals import marginals
from uwblite.graph.normal_equations import filled
from uwblite.graph.solver import optimize
from uwblite.mapping import MappingConfig, build_map
from uwblite.pipeline.map_frame import moved
from uwblite.pipeline.surface_adjustment import _lidar, adjust_surfaces, for_covariances


@pytest.fixture(scope="module")
def around():
    """A map of a minute and a half in a hall with errors of real rooms, and what stood before and after the adjustment."""
    trial, seen = made(Settings(world="hall", seed=4, minutes=1.5, rooms=RealRooms())), {}

    def watched(estimate, task):
        seen.update(before=estimate, after=adjust_surfaces(estimate, task), task=task)
        return seen["after"]

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(mapping.surface_adjustment, "adjust_surfaces", watched)
        build_map(trial.log, MappingConfig())
    stamps = seen["task"].recordings.stamps
    seen["truth"] = np.column_stack([np.interp(stamps, trial.stamps, trial.poses[:, k]) for k in range(2)])
    return seen


def test_walls_and_columns_of_the_hall_are_found_and_poses_come_nearer_to_the_truth(around):
    figures = next(s.figures for s in around["task"].stages.done if s.name == "surfaces")
    assert figures["walls"] >= 2
    assert figures["columns"] >= 4
    errors = [aligned_error(around[k].graph.poses[:, :2], around["truth"]) for k in ("before", "after")]
    assert errors[1] < 0.8 * errors[0]


def test_pairs_of_clouds_are_told_what_the_adjusted_poses_say(around):
    after = around["after"]
    np.testing.assert_allclose(after.joint.T_i_j, after.joint.relative(after.graph), atol=1e-12)
    np.testing.assert_array_equal(after.joint.sqrt_information, around["before"].joint.sqrt_information)
    assert np.array_equal(after.graph.fixed_calibration, around["before"].graph.fixed_calibration)


def test_rays_make_covariances_smaller_in_whatever_frame_the_map_is(around):
    after, task = around["after"], around["task"]
    found = []
    for motion in (np.zeros(3), np.array([30.0, -7.0, 2.0])):
        graph = moved(replace(after.graph, edges=(*after.odometry_and_ranges, after.joint)), motion)
        stated, rays = for_covariances(after.surfaces, graph, task)
        found.append(marginals(stated, further=rays).covariances)
    plain = marginals(replace(after.graph, edges=(*after.odometry_and_ranges, after.joint))).covariances
    sizes = [np.sqrt(np.trace(c.poses[1:, :2, :2], axis1=1, axis2=2)) for c in (*found, plain)]
    np.testing.assert_allclose(sizes[1], sizes[0], rtol=1e-4)
    assert np.median(sizes[0] / sizes[2]) < 0.9


def test_rays_say_nothing_of_where_the_whole_map_is_and_how_it_is_turned(around):
    """Moved as one, far from the origin, poses and surfaces explain all rays as well as before."""
    after = around["after"]
    free = np.zeros(len(after.graph.poses), dtype=bool)
    graph = replace(after.graph, edges=(*after.odometry_and_ranges, after.joint), fixed_poses=free)
    stated, rays = for_covariances(after.surfaces, graph, around["task"])
    unknowns = filled(stated, last=()).unknowns
    found, number = rays(unknowns), unknowns.number["poses"]
    for motion in np.eye(3):
        of_poses = np.tile(motion, (len(number), 1)) + motion[2] * np.column_stack(
            [-graph.poses[:, 1], graph.poses[:, 0] + 60.0, np.zeros(len(number))]
        )
        moves = np.zeros(unknowns.size + 1)
        moves[number] = of_poses
        moves = moves[:-1]
        across = (found.across @ moves).reshape(found.own_slope.shape)
        known = moves @ (found.among @ moves) - np.einsum("bi,bij,bj->", across, np.linalg.inv(found.own), across)
        assert known < 0.1


@pytest.mark.parametrize(("kind", "step"), [("laser_x", 1e-4), ("laser_y", 1e-4), ("laser_theta", 1e-5), ("laser_delay", 1e-4)])
def test_rays_move_with_the_mounting_and_the_clock_of_the_lidar(around, kind, step):
    """Numeric derivatives. Analytic ones are taken where rays should have ended: off by their noise over the radius of a
    column, which is little for those within a standard deviation."""
    after, task = around["after"], around["task"]
    graph, rays = after.graph, after.surfaces.rays.rows(slice(0, None, 50))
    surfaces, column = after.surfaces.surfaces.seen_from(se2.inverse(graph.poses[0])), LASER.index(kind)
    values = graph.calibration.values.copy()
    values[graph.calibration.index(kind)] += step
    moved_lidar = _lidar(graph.updated(graph.poses, graph.anchors, values), after.joint, task)
    lidar = _lidar(graph, after.joint, task)
    one, other = (linearized(rays, surfaces, each.sensors, graph.poses) for each in (lidar, moved_lidar))
    numeric = (other.residual - one.residual) / step
    analytic = np.einsum("mb,mb->m", one.by_pose, lidar.by_lidar(graph.poses)[rays.keyframe, column])
    assert np.abs(numeric).max() > 1.0
    near = np.abs(one.residual) < 1.0
    assert near.mean() > 0.5
    np.testing.assert_allclose(analytic[near], numeric[near], atol=0.05 * np.abs(numeric).max())


def test_rays_do_not_tell_where_the_lidar_is_mounted_from_where_the_base_is(around):
    """A lidar further ahead on a base that is always as much further back sees the same."""
    after, task = around["after"], around["task"]
    graph = with_free(replace(after.graph, edges=(*after.odometry_and_ranges, after.joint)), "laser_x")
    graph = replace(graph, fixed_poses=np.zeros(len(graph.poses), dtype=bool))
    stated, rays = for_covariances(after.surfaces, graph, task)
    unknowns = filled(stated, last=()).unknowns
    found, moves, heading = rays(unknowns), np.zeros(unknowns.size + 1), graph.poses[:, 2]
    moves[unknowns.number["poses"]] = -np.column_stack([np.cos(heading), np.sin(heading), np.zeros(len(heading))])
    moves[unknowns.number["calibration"][graph.calibration.index("laser_x")]] = 1.0
    assert np.abs(found.among @ moves[:-1]).max() < 1e-9 * np.abs(found.among).max()


def test_without_pairs_of_clouds_nothing_is_adjusted(around):
    none = replace(around["before"], joint=None)
    assert adjust_surfaces(none, around["task"]) is none


def test_without_surfaces_the_pairs_alone_are_brought_to_their_optimum(around):
    """The rays of a lidar that sees nothing are on no wall. What stands before is a rough one."""
    before = around["before"]
    (one,) = around["task"].recordings.each
    scans = replace(one.log.scans, ranges=np.full_like(one.log.scans.ranges, np.inf))
    recordings = replace(around["task"].recordings, each=(replace(one, log=replace(one.log, scans=scans)),))
    found = adjust_surfaces(before, replace(around["task"], recordings=recordings))
    assert found.surfaces is None
    assert before.problem.chi2() > found.problem.chi2() >= optimize(found.problem)[0].chi2() * (1.0 - 1e-6)
