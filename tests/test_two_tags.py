"""A robot with two tags: each range has the lever arm of the tag that measured it."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import planted

from uwblite import se2
from uwblite.errors import DataError
from uwblite.graph.calibration import CalibrationConfig, block, unknowns
from uwblite.graph.graph import Graph
from uwblite.io.carmen import read_log, write_log
from uwblite.mapping import build_map
from uwblite.odometry import keyframes
from uwblite.odometry.attached import attach_ranges
from uwblite.odometry.keyframes import KeyframeConfig
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.radio.range_measurements import range_edges
from uwblite.radio.range_noise import RangeNoiseConfig
from uwblite.sensor_log import LONGEST_RANGE, SensorLog, SensorMounting, UwbRanges

ANCHORS = np.array([[-6.0, -5.0], [6.0, -5.5], [6.5, 5.0], [-5.5, 6.0]])
FRONT, REAR = (0.35, 0.05), (-0.40, -0.10)
MOUNTING = SensorMounting(tag_position=np.array([*FRONT, 0.6]), more_tags=np.array([[*REAR, 0.9]]), anchor_height=1.4)


def both(stamps, truth, rng, sigma=0.0, heights=True) -> UwbRanges:
    """Return the ranges of both tags in order of time, with the slant that their heights make."""
    parts = [planted.ranges(rng, stamps, truth, ANCHORS, sigma=0.0, tag=tag) for tag in (FRONT, REAR)]
    rise = [1.4 - 0.6, 1.4 - 0.9] if heights else [0.0, 0.0]
    slant = [np.hypot(part.ranges, h) for part, h in zip(parts, rise, strict=True)]
    stated = np.concatenate(slant) + sigma * rng.standard_normal(sum(map(len, slant)))
    when = np.concatenate([part.stamps for part in parts])
    order = np.argsort(when, kind="stable")
    tag = np.repeat([0, 1], [len(part.stamps) for part in parts])
    anchor = np.concatenate([part.anchor for part in parts])
    return UwbRanges(
        when[order], anchor[order], stated[order], np.full(len(when), 100.0), parts[0].anchor_ids, tag[order]
    )  # fmt: skip


def test_at_the_truth_every_range_of_either_tag_fits():
    rng = np.random.default_rng(5)
    stamps, truth = planted.wander(rng, 30.0)
    ranges, odometry = both(stamps, truth, rng), planted.odometry(stamps, truth)
    frames = keyframes.select(odometry, KeyframeConfig())
    attached = attach_ranges(ranges, odometry, frames, MOUNTING)
    listed = unknowns(CalibrationConfig(), ranges.anchor_ids, np.ones(4, dtype=bool))
    edges = range_edges(attached, ranges.anchor_ids, MOUNTING, block(listed), RangeNoiseConfig(1.0), LONGEST_RANGE)
    # The anchors in the frame of the odometry, which begins at 0.
    T_odom_map = se2.compose(frames.odometry[0], se2.inverse(truth[0]))
    graph = Graph(frames.odometry, se2.transform(T_odom_map, ANCHORS), calibration=block(listed))
    assert np.abs(edges.residuals(graph)).max() < 2e-3  # interpolation between samples of 0.1 s
    blind = replace(ranges, tag=None)
    attached = attach_ranges(blind, odometry, frames, MOUNTING)
    wrong = range_edges(attached, ranges.anchor_ids, MOUNTING, block(listed), RangeNoiseConfig(1.0), LONGEST_RANGE)
    assert np.abs(wrong.residuals(graph)).max() > 0.5


def test_velocities_are_those_of_the_tag_that_measured():
    rng = np.random.default_rng(6)
    stamps, truth = planted.drive([(0.0, 0.0, 0.8)], [10.0])
    ranges, odometry = both(stamps, truth, rng), planted.odometry(stamps, truth)
    frames = keyframes.select(odometry, KeyframeConfig())
    attached = attach_ranges(ranges, odometry, frames, MOUNTING)
    inner = (ranges.stamps > 0.2) & (ranges.stamps < 9.8)
    speed = np.hypot(*attached.velocity.T)
    for tag, place in enumerate((FRONT, REAR)):
        assert speed[inner & (ranges.tag == tag)] == pytest.approx(0.8 * np.hypot(*place), rel=1e-3)


def test_a_log_keeps_the_tags_apart_and_old_logs_have_one(tmp_path):
    rng = np.random.default_rng(7)
    stamps, truth = planted.wander(rng, 5.0)
    log = SensorLog(planted.odometry(stamps, truth), both(stamps, truth, rng), mounting=MOUNTING)
    write_log(tmp_path / "two.log", log)
    text = (tmp_path / "two.log").read_text()
    assert "\nUWB2 " in text
    assert "PARAM uwb2_tag_offset_x -0.400000 " in text
    again = read_log(tmp_path / "two.log")
    assert again.ranges.tag.tolist() == log.ranges.tag.tolist()
    assert again.mounting.tags == pytest.approx(MOUNTING.tags)
    (tmp_path / "one.log").write_text("".join(line for line in text.splitlines(True) if "UWB2" not in line))
    assert read_log(tmp_path / "one.log").ranges.tag is None
    (tmp_path / "untold.log").write_text("".join(line for line in text.splitlines(True) if "uwb2_" not in line))
    assert "uwb2_tag_offset_x" in read_log(tmp_path / "untold.log").notes.warnings[0]
    with pytest.raises(DataError, match="several tags"):
        log.ranges.require_one_tag("a bag")
    with pytest.raises(DataError, match="tags"):
        replace(log, mounting=SensorMounting())


@pytest.mark.parametrize("given", [True, False])
def test_each_tag_has_its_own_place_delay_and_height(given):
    """At the truth every range fits, where the second tag hangs 5 cm off its place and is late by 0.4 m of light."""
    rng = np.random.default_rng(9)
    stamps, truth = planted.wander(rng, 30.0)
    ranges, odometry = both(stamps, truth, rng), planted.odometry(stamps, truth)
    ranges = replace(ranges, ranges=ranges.ranges + 0.4 * (ranges.tag == 1))
    beside = np.array([[REAR[0] - 0.05, REAR[1], 0.9]])
    mounting = replace(MOUNTING, more_tags=beside, anchor_height=1.4 if given else None)
    frames = keyframes.select(odometry, KeyframeConfig())
    attached = attach_ranges(ranges, odometry, frames, mounting)
    ids = ranges.anchor_ids
    listed = unknowns(CalibrationConfig(), ids, np.full(4, given), rises=(0.0, 0.3))
    values = {"tag_x@tag2": 0.05, **{f"bias:{name}@tag2": 0.4 for name in ids}}
    for name in ids:
        values |= {f"height2:{name}": 0.8**2, f"height2:{name}@tag2": 0.5**2}
    calibration = replace(block(listed), values=np.array([values.get(u.key.label, 0.0) for u in listed]))
    edges = range_edges(attached, ids, mounting, calibration, RangeNoiseConfig(1.0), LONGEST_RANGE)
    T_odom_map = se2.compose(frames.odometry[0], se2.inverse(truth[0]))
    graph = Graph(frames.odometry, se2.transform(T_odom_map, ANCHORS), calibration=calibration)
    assert np.abs(edges.residuals(graph)).max() < 2e-3
    level = unknowns(CalibrationConfig(), ids, np.full(4, False), rises=(0.0, 0.0))
    assert not [u for u in level if u.key.kind == "height2" and u.key.tag]


@pytest.mark.slow
def test_the_map_uses_both_tags():
    """Without a lidar the heading comes from the wheels and, with two tags, from the radio as well."""
    rng = np.random.default_rng(8)
    stamps, truth = planted.wander(rng, 120.0)
    wheels = planted.odometry(stamps, truth, rng, scale=1.01, turn_scale=1.05, noise=0.01, turn_noise=0.03)
    ranges = both(stamps, truth, rng, sigma=0.03)
    log = SensorLog(wheels, ranges, mounting=MOUNTING)
    errors = {}
    for name, recording in (
        ("both", log),
        ("one", replace(log, ranges=ranges.rows(ranges.tag == 0))),
        ("taken for one", replace(log, ranges=replace(ranges, tag=None))),
    ):
        result = build_map(recording, MappingConfig())
        turn = se2.wrap_angle(result.trajectory[:, 2] - truth[:, 2])
        turn = se2.wrap_angle(turn - np.median(turn))
        errors[name] = np.degrees(np.sqrt(np.mean(turn**2)))
    assert errors["both"] < errors["one"]
    assert errors["both"] < 0.7 * errors["taken for one"]
