"""An anchor that is moved during a recording has two rows, and the map holds."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.room_recording import ANCHORS, recording, two_rounds

from uwblite import se2
from uwblite.mapping import build_map
from uwblite.pipeline.anchor_moves import name_and_number


def test_names_of_places():
    assert name_and_number("5C0B") == ("5C0B", 1)
    assert name_and_number("5C0B@3") == ("5C0B", 3)
    assert name_and_number("user@home") == ("user@home", 1)


@pytest.mark.slow
@pytest.mark.parametrize("lidar", [False, True])
def test_a_moved_anchor_has_a_row_for_each_place(lidar):
    truth = two_rounds()
    log = recording(truth).without(lidar=not lidar)
    tag = se2.interpolate_trajectory(log.odometry.stamps, log.odometry.poses, log.ranges.stamps)[:, :2]
    old, new = np.array(ANCHORS["B2"]), np.array([2.8, 5.2])
    moved = (log.ranges.anchor == log.ranges.anchor_ids.index("B2")) & (log.ranges.stamps > 180.0)
    ranges = log.ranges.ranges + moved * (np.hypot(*(new - tag).T) - np.hypot(*(old - tag).T))
    result = build_map(replace(log, ranges=replace(log.ranges, ranges=ranges)))
    by_id = {a.id: a for a in result.anchors}
    assert set(by_id) == {"A1", "B2", "B2@2", "C3"}
    assert [n.kind for n in result.warnings if n.kind == "moved-anchor"] == ["moved-anchor"]
    # The map begins at the first pose, which is the truth's.
    for name, place in (("B2", old), ("B2@2", new), ("A1", ANCHORS["A1"])):
        assert by_id[name].status == "ok"
        assert np.hypot(*(by_id[name].position - place)) < 0.3
    assert by_id["B2"].since < 101.0
    assert abs(by_id["B2@2"].since - 180.0) < 5.0
    assert np.isnan(by_id["A1"].since)


@pytest.mark.slow
def test_anchors_that_change_names_at_once_are_distinguished():
    log = recording(two_rounds())
    ranges, following = log.ranges, np.array([1, 2, 0])
    renamed = np.where(ranges.stamps > 180.0, following[ranges.anchor], ranges.anchor)
    result = build_map(replace(log, ranges=replace(ranges, anchor=renamed)))
    by_id = {a.id: a for a in result.anchors}
    names = ranges.anchor_ids
    assert set(by_id) == {*names, *(f"{name}@2" for name in names)}
    for k, name in enumerate(names):
        assert np.hypot(*(by_id[name].position - ANCHORS[name])) < 0.3
        assert np.hypot(*(by_id[f"{names[following[k]]}@2"].position - ANCHORS[name])) < 0.3
