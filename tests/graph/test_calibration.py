"""Calibration: names, priors and the tables that say which edge uses which unknown."""

from dataclasses import replace

import numpy as np
import pytest

from uwblite.graph.calibration import (
    CalibrationConfig,
    block,
    indices,
    odometry_indices,
    optimize_with_heights,
    prior_edges,
    range_indices,
    scan_indices,
    unknowns,
    with_free,
    with_nonnegative_heights,
)
from uwblite.graph.graph import Calibration, Graph
from uwblite.graph.range_edges import RangeEdges
from uwblite.graph.solver import SolverConfig

IDS = ("1E05", "5C0B", "91A3")
GIVEN = np.array([False, True, False])


def test_every_unknown_has_a_name_of_its_own_a_unit_and_a_meaning():
    listed = unknowns(CalibrationConfig(), IDS, GIVEN)
    assert len({u.key.label for u in listed}) == len(listed)
    assert all(u.unit and u.meaning and u.sigma > 0 for u in listed)
    assert {f"bias:{a}" for a in IDS} <= {u.key.label for u in listed}


def test_what_recordings_have_in_common_is_listed_once():
    first, second = (unknowns(CalibrationConfig(), IDS, GIVEN, recording) for recording in (0, 1))
    common = {u.key for u in first if u.key.recording is None}
    assert common
    assert {u.key.recording for u in second} == {1}
    assert {u.key._replace(recording=1) for u in first if u.key not in common} == {u.key for u in second}


def test_height_is_unknown_only_where_none_is_given():
    names = {u.key.label for u in unknowns(CalibrationConfig(), IDS, GIVEN)}
    assert {n for n in names if n.startswith("height2:")} == {"height2:1E05", "height2:91A3"}


@pytest.mark.parametrize(
    ("field", "names"),
    [
        ("odometry_scale", {"odometry_scale"}), ("heading_scale", {"heading_scale"}), ("heading_rate", {"heading_rate"}),
        ("heading_per_metre", {"heading_per_metre"}), ("laser_offset", {"laser_x", "laser_y"}),
        ("laser_angle", {"laser_theta"}), ("laser_delay", {"laser_delay"}), ("range_scale", {"range_scale"}),
        ("tag_offset", {"tag_x", "tag_y"}), ("range_delay", {"range_delay"}), ("sideways_scale", {"sideways_scale"}),
        ("sideways_per_turn", {"sideways_per_turn"}), ("sideways_per_metre", {"sideways_per_metre"}),
        ("ahead_per_sideways", {"ahead_per_sideways"}),
        ("range_bias", {f"bias:{a}" for a in IDS}), ("anchor_height", {"height2:1E05", "height2:91A3"}),
    ],
)
def test_a_prior_of_zero_switches_its_unknowns_off_and_no_others(field, names):
    every = {u.key.label for u in unknowns(CalibrationConfig(), IDS, GIVEN)}
    left = {u.key.label for u in unknowns(CalibrationConfig(**{field: 0.0}), IDS, GIVEN)}
    assert every - left == names
    assert left <= every


def test_priors_weigh_one_standard_deviation_as_one():
    listed = unknowns(CalibrationConfig(), IDS, GIVEN)
    sigma = np.array([u.sigma for u in listed])
    graph = Graph(np.zeros((1, 3)), calibration=Calibration(block(listed).keys, 2.0 * sigma))
    residuals = prior_edges(listed).residuals(graph)
    np.testing.assert_allclose(residuals, 2.0)
    assert np.all(prior_edges(listed).residuals(Graph(np.zeros((1, 3)), calibration=block(listed))) == 0.0)


def test_a_height_of_so_much_is_a_prior_on_its_square():
    with_heights, without = (
        sorted(u.sigma for u in unknowns(CalibrationConfig(anchor_height=3.0), IDS, given)) for given in (GIVEN, ~GIVEN | GIVEN)
    )
    assert [s for s in with_heights if s > 1.0] == [9.0, 9.0]
    assert not [s for s in without if s > 1.0]


def test_released_unknowns_join_those_that_were_free():
    listed = unknowns(CalibrationConfig(), IDS, GIVEN)
    fixed = np.ones(len(listed), dtype=bool)
    fixed[0] = False
    graph = Graph(np.zeros((1, 3)), calibration=block(listed), fixed_calibration=fixed)
    released = with_free(graph, "bias", "laser_delay").fixed_calibration
    free = {u.key.label for u, is_fixed in zip(listed, released, strict=True) if not is_fixed}
    assert free == {listed[0].key.label, "laser_delay", *(f"bias:{a}" for a in IDS)}
    assert fixed.sum() == len(listed) - 1


def test_tables_name_the_right_scalar_in_the_right_column():
    calibration = block(unknowns(CalibrationConfig(), IDS, GIVEN))
    anchor = np.array([2, 0, 1, 1])
    table = range_indices(calibration, anchor, IDS)
    assert table.shape == (4, 6)
    for row, a in zip(table, anchor, strict=True):
        stated = [calibration.keys[k].label if k >= 0 else None for k in row]
        height = None if GIVEN[a] else f"height2:{IDS[a]}"
        assert stated == ["range_scale", f"bias:{IDS[a]}", height, "tag_x", "tag_y", "range_delay"]
    wheels = odometry_indices(calibration, 3)
    assert wheels.shape == (3, 8)
    for row in wheels:
        assert [calibration.keys[k].label for k in row] == [
            "odometry_scale",
            "heading_scale",
            "heading_per_metre",
            "heading_rate",
            "sideways_per_turn",
            "sideways_scale",
            "sideways_per_metre",
            "ahead_per_sideways",
        ]
    assert [calibration.keys[k].label for k in scan_indices(calibration)] == [
        "laser_x",
        "laser_y",
        "laser_theta",
        "laser_delay",
    ]


def test_what_is_switched_off_has_index_minus_one():
    nothing = CalibrationConfig(**dict.fromkeys(CalibrationConfig.__dataclass_fields__, 0.0))
    calibration = block(unknowns(nothing, IDS, GIVEN))
    assert calibration.keys == ()
    assert len(prior_edges(unknowns(nothing, IDS, GIVEN))) == 0
    assert np.all(range_indices(calibration, np.array([0, 1]), IDS) == -1)
    assert np.all(odometry_indices(calibration, 2) == -1)
    assert np.all(scan_indices(calibration) == -1)
    assert indices(calibration, "range_scale").tolist() == [-1]


def test_no_anchors_no_range_table():
    calibration = block(unknowns(CalibrationConfig(), (), np.zeros(0, dtype=bool)))
    assert all(key.anchor is None for key in calibration.keys)
    assert range_indices(calibration, np.zeros(0, dtype=np.intp), ()).shape == (0, 6)


def test_heights_below_zero_are_fixed_there_and_nothing_else_changes():
    calibration = block(unknowns(CalibrationConfig(), IDS, GIVEN))
    low, high = calibration.index("height2", "1E05"), calibration.index("height2", "91A3")
    bias = calibration.index("bias", "1E05")
    values = np.zeros(len(calibration.values))
    values[[low, high, bias]] = -0.3, 0.4, -0.2
    before = np.arange(len(values)) == bias
    graph = Graph(np.zeros((1, 3)), np.zeros((3, 2)), (), calibration, fixed_calibration=before)
    graph = with_nonnegative_heights(graph.updated(graph.poses, graph.anchors, values))
    values[low] = 0.0
    np.testing.assert_array_equal(graph.calibration.values, values)
    assert np.flatnonzero(graph.fixed_calibration).tolist() == sorted([low, bias])


def ranges_shortened_near_the_anchors(rng):
    """Return a graph of fixed poses around three anchors as high as the tag; near them ranges are too short."""
    listed = [u for u in unknowns(CalibrationConfig(), IDS, np.zeros(3, dtype=bool)) if u.key.kind in ("bias", "height2")]
    calibration, anchors = block(tuple(listed)), np.array([[1.0, 1.0], [6.0, 2.0], [3.0, 5.0]])
    poses = np.column_stack([rng.uniform(-1.0, 8.0, (60, 2)), np.zeros(60)])
    pose, anchor = np.repeat(np.arange(60), 3), np.tile(np.arange(3), 60)
    way = np.hypot(*(poses[pose, :2] - anchors[anchor]).T)
    measured = way - np.array([0.8, 0.5, 0.0])[anchor] / way + rng.normal(0.0, 0.05, len(way))
    none, table = np.zeros(len(way)), range_indices(calibration, anchor, IDS)
    plane = np.zeros((len(way), 2))
    edges = RangeEdges(pose, anchor, measured, none + 0.05, plane, none, plane, np.zeros(2), none, table)
    graph = Graph(poses, anchors + 0.3, (prior_edges(tuple(listed)), edges), calibration)
    return replace(graph, fixed_poses=np.ones(60, dtype=bool), fixed_calibration=np.zeros(len(listed), dtype=bool))


@pytest.mark.parametrize("seed", range(3))
def test_heights_put_back_to_zero_leave_everything_else_at_the_optimum(seed):
    """The derivative of the cost along all that is free is 0, by differences; along heights at 0 the cost falls below only."""
    graph = ranges_shortened_near_the_anchors(np.random.default_rng(seed))
    graph, _ = optimize_with_heights(graph, SolverConfig(relative_decrease=1e-12))
    heights = np.flatnonzero(graph.calibration.of_kinds("height2"))
    assert graph.fixed_calibration[heights[:2]].all()
    assert (graph.calibration.values[heights] >= 0.0).all()

    def slope(x, value):
        """Return the derivative of the cost along a value, and the value's standard deviation where all else is fixed."""
        costs = []
        for step in (-1e-4, 0.0, 1e-4):
            x[value] += step
            costs.append(graph.updated(graph.poses, anchors, calibration).chi2())
            x[value] -= step
        return (costs[2] - costs[0]) / 2e-4, 1.0 / np.sqrt(0.5 * (costs[2] - 2.0 * costs[1] + costs[0]) / 1e-8)

    anchors, calibration = graph.anchors.copy(), graph.calibration.values.copy()
    for value in np.ndindex(anchors.shape):
        derivative, sigma = slope(anchors, value)
        assert abs(derivative) * sigma < 1e-2
    for value, fixed in enumerate(graph.fixed_calibration):
        derivative, sigma = slope(calibration, value)
        assert derivative > 0.0 if fixed else abs(derivative) * sigma < 1e-2


def test_each_tag_has_its_place_and_each_anchor_its_error_from_it():
    """Two tags, the second one 0.4 m higher: heights below both where none is given."""
    config = CalibrationConfig()
    texts = {u.key.label: u.meaning for u in unknowns(config, ("A", "B"), np.array([False, True]), rises=(0.0, 0.4))}
    assert {k: v for k, v in texts.items() if k.startswith(("tag", "bias", "height"))} == {
        "tag_x": "correction of the tag's x on the base", "tag_y": "correction of the tag's y on the base",
        "tag_x@tag2": "correction of tag 2's x on the base", "tag_y@tag2": "correction of tag 2's y on the base",
        "bias:A": "constant error of ranges to anchor A", "bias:B": "constant error of ranges to anchor B",
        "bias:A@tag2": "constant error of ranges to anchor A from tag 2",
        "bias:B@tag2": "constant error of ranges to anchor B from tag 2",
        "height2:A": "squared height of anchor A above the tag", "height2:A@tag2": "squared height of anchor A above tag 2",
    }  # fmt: skip
    level = {u.key.label for u in unknowns(config, ("A",), np.array([False]), rises=(0.0, 0.0))}
    assert {name for name in level if name.startswith("height")} == {"height2:A"}
    assert all(u.meaning.endswith(" in recording 2") for u in unknowns(config, ("A",), np.array([False]), recording=1))
