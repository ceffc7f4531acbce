"""Calibration: names, priors and the tables that say which edge uses which unknown."""

import numpy as np
import pytest

from uwblite.graph.calibration import (
    LASER,
    CalibrationConfig,
    block,
    indices,
    odometry_indices,
    prior_edges,
    range_indices,
    unknowns,
    with_free,
)
from uwblite.graph.graph import Calibration, Graph

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
        ("odometry_scale", {"odometry_scale"}),
        ("heading_scale", {"heading_scale"}),
        ("heading_rate", {"heading_rate"}),
        ("heading_per_metre", {"heading_per_metre"}),
        ("laser_offset", {"laser_x", "laser_y"}),
        ("laser_angle", {"laser_theta"}),
        ("laser_delay", {"laser_delay"}),
        ("range_scale", {"range_scale"}),
        ("tag_offset", {"tag_x", "tag_y"}),
        ("range_delay", {"range_delay"}),
        ("sideways_scale", {"sideways_scale"}),
        ("sideways_per_turn", {"sideways_per_turn"}),
        ("sideways_per_metre", {"sideways_per_metre"}),
        ("ahead_per_sideways", {"ahead_per_sideways"}),
        ("range_bias", {f"bias:{a}" for a in IDS}),
        ("anchor_height", {"height2:1E05", "height2:91A3"}),
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
    assert [calibration.keys[k].label for k in indices(calibration, *LASER)] == [
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
    assert np.all(indices(calibration, *LASER) == -1)
    assert indices(calibration, "range_scale").tolist() == [-1]


def test_no_anchors_no_range_table():
    calibration = block(unknowns(CalibrationConfig(), (), np.zeros(0, dtype=bool)))
    assert all(key.anchor is None for key in calibration.keys)
    assert range_indices(calibration, np.zeros(0, dtype=np.intp), ()).shape == (0, 6)


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
