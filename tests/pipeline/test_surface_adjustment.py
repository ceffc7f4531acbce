"""Poses adjusted to rays on walls and columns, in a simulated building."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted import aligned_error
from simulation.real_rooms import RealRooms
from simulation.recording import Settings
from trials import made

from uwblite import mapping
from uwblite.mapping import MappingConfig, build_map
from uwblite.pipeline.surface_adjustment import adjust_surfaces


@pytest.fixture(scope="module")
def around():
    """A map of four minutes in a hall with errors of real rooms, and what stood before and after the adjustment."""
    trial, seen = made(Settings(world="hall", seed=4, minutes=4.0, rooms=RealRooms())), {}

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
    np.testing.assert_allclose(after.joint.sqrt_information, 2.0 * around["before"].joint.sqrt_information)
    assert np.array_equal(after.graph.fixed_calibration, around["before"].graph.fixed_calibration)


def test_without_pairs_of_clouds_nothing_is_adjusted(around):
    none = replace(around["before"], joint=None)
    assert adjust_surfaces(none, around["task"]) is none
