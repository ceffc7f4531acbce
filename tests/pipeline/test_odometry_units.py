"""When the odometry's unit is another one, and what is said of it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.told import doubted, warned

from uwblite.constraints import Constraints, GivenAnchor
from uwblite.graph.graph import Calibration, UnknownKey
from uwblite.pipeline.estimate import OtherHeights
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.pipeline.odometry_units import odometry_unit_factors, with_given_mounting_and_clock, with_units_checked
from uwblite.pipeline.progress import Stages
from uwblite.pipeline.recordings import Recordings
from uwblite.sensor_log import LogNotes


@pytest.mark.parametrize(("errors", "factors"), [
    ([0.11], [1.0]), ([0.17], [1.17]), ([-0.13], [0.87]), ([None], [1.0]), ([0.05, 0.5], [1.0, 1.5]),
])  # fmt: skip
def test_wheels_are_in_another_unit_from_an_eighth_on(errors, factors):
    """Of several recordings the one is named; no factor where the scale is no unknown."""
    values = [0.0 if e is None else e for e in errors]
    calibration = SimpleNamespace(index=lambda kind, recording: -1 if errors[recording] is None else recording, values=values)
    each, stages = [SimpleNamespace(name=f"{n}.log", number=n, has_scans=False) for n in range(len(errors))], Stages(None, None)
    recordings = type("Recordings", (), {"each": each, "__len__": lambda self: len(each)})()
    estimate = SimpleNamespace(graph=SimpleNamespace(calibration=calibration), other_heights=None)
    task = SimpleNamespace(recordings=recordings, config=None, stages=stages, given=Constraints())
    assert odometry_unit_factors(estimate, task).tolist() == factors
    wrong = [n for n, factor in enumerate(factors) if factor != 1.0]
    assert [w.figures for w in warned(stages)] == [{"recording": n + 1, "factor": factors[n]} for n in wrong]
    named = [w.text.startswith(f"{n}.log: ") for n, w in zip(wrong, warned(stages), strict=True)]
    assert named == [len(errors) > 1] * len(wrong)


@pytest.mark.parametrize(
    ("factor", "lidar", "given", "height", "warnings", "doubts"),
    [
        (1.1, None, 0, None, 0, 0),
        (1.41, None, 0, None, 1, 0),
        (2.06, None, 0, None, 0, 1),
        (0.515, None, 0, None, 0, 1),
        (0.515, 1.0, 0, None, 1, 0),
        (0.515, None, 2, None, 1, 0),
        (4.0, None, 0, None, 1, 0),
        (1.13, None, 0, None, 0, 1),
        (1.13, 1.0, 0, None, 1, 0),
        (1.13, None, 2, None, 1, 0),
        (1.1, None, 0, 4.7, 0, 0),
        (1.41, 1.0, 0, 4.7, 0, 1),
        (1.41, float("nan"), 0, 4.7, 0, 1),
        (1.41, 1.35, 0, 4.7, 1, 0),
        (0.7, None, 0, 4.7, 0, 1),
    ],
)
def test_a_factor_that_nothing_else_decides_is_a_doubt(factor, lidar, given, height, warnings, doubts):
    """Twice, half and yards may be the radio's; anchors that hang high may look like either unit, where no lidar sees the ways.

    lidar: its ways by those of the wheels, nan where it shows none, None without.
    """
    stages = Stages(None, None)
    calibration = Calibration((UnknownKey("odometry_scale", recording=0),), np.array([factor - 1.0]))
    log = SimpleNamespace(screening=lidar and SimpleNamespace(lidar_by_wheels=lidar))
    recording = SimpleNamespace(name="run.log", number=0, has_scans=lidar is not None, log=log)
    recordings = Recordings((recording,), *(np.zeros(0),) * 4)
    given = Constraints(anchors=tuple(GivenAnchor(name, (0.0, 0.0)) for name in "AB"[:given]))
    task = SimpleNamespace(stages=stages, recordings=recordings, given=given, config=None)
    other = None if height is None else OtherHeights(height, taken=False, apart=1.0)
    estimate = SimpleNamespace(graph=SimpleNamespace(calibration=calibration), other_heights=other)
    factors = odometry_unit_factors(estimate, task)
    assert factors == pytest.approx([factor if warnings or doubts else 1.0])
    assert (len(warned(stages)), len(doubted(stages))) == (warnings, doubts)
    assert all(("4.7 m above the tag" in notice.text) == (height is not None) for notice in doubted(stages))


@pytest.mark.parametrize(("ways", "checked"), [
    ([1.1], True), ([0.9], True), ([1.13], False), ([0.23], False), ([None], False), ([float("nan")], False),
    ([1.0, 0.95], True), ([1.0, float("nan")], False), ([1.0, 1.3], False),
])  # fmt: skip
def test_wheels_whose_ways_a_lidar_measures_are_in_metres_whatever_the_ranges_say(ways, checked):
    """None: a recording that was not screened."""
    logs = [SimpleNamespace(screening=None if w is None else SimpleNamespace(lidar_by_wheels=w)) for w in ways]
    config = MappingConfig()
    found = with_units_checked(config, logs)
    assert (found.calibration.odometry_unit <= found.calibration.odometry_scale) == checked
    assert replace(found, calibration=config.calibration) == config
    if not checked:
        assert found is config


@pytest.mark.parametrize(("late", "radio", "lidar"), [
    ([()], 0.1, 0.1), ([("scans",)], 0.1, 0.0), ([("odometry",)], 0.0, 0.0), ([(), ("odometry", "scans")], 0.0, 0.0),
])  # fmt: skip
def test_against_stamps_of_receipt_no_clock_has_an_offset(late, radio, lidar):
    mounting = SimpleNamespace(laser_is_base=False)
    logs = [SimpleNamespace(screening=SimpleNamespace(in_bursts=s), mounting=mounting, scans=0, notes=LogNotes()) for s in late]
    config = MappingConfig()
    found = with_given_mounting_and_clock(config, logs)
    expected = replace(config.calibration, range_delay=radio, laser_delay=lidar)
    assert found == replace(config, calibration=expected)


@pytest.mark.parametrize(("is_base", "fixed"), [([True], True), ([True, False], False), ([True, None], True), ([None], False)])
def test_a_laser_whose_poses_the_log_gives_is_where_it_is_said_to_be(is_base, fixed):
    """None: a recording without lidar."""
    logs = [
        SimpleNamespace(
            screening=None, notes=LogNotes(), mounting=SimpleNamespace(laser_is_base=bool(b)), scans=None if b is None else 0
        )
        for b in is_base
    ]
    assert with_given_mounting_and_clock(MappingConfig(), logs).calibration.laser_offset == (0.0 if fixed else 0.1)
