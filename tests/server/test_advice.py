"""What is worth most is said first, in words with figures and what to do."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.results import small_folder

from uwblite.io.stored_result import read_result
from uwblite.server.advice import SensorState, advice

FINE = {"odometry": SensorState(900, 20.0, 0.0), "lidar": SensorState(450, 10.0, 0.1), "radio": SensorState(90, 2.0, 0.4)}


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    folder = tmp_path_factory.mktemp("advice") / "map"
    small_folder(folder)
    found = read_result(folder)
    good = tuple(replace(a, covariance=np.eye(2) * 1e-4, status="ok") for a in found.anchors)
    calm = np.tile(np.eye(3) * 1e-6, (len(found.keyframe_stamps), 1, 1))
    return replace(found, anchors=good, keyframe_covariances=calm, report={})


def test_nothing_is_reported_where_all_is_well(result):
    assert advice(FINE, {"A": 0.3}, 60.0, 0.0, result) == []
    assert advice(FINE, {}, 60.0, 0.0, None) == []


def test_silent_sensors_come_first_the_longest_before_all(result):
    silent = FINE | {"lidar": SensorState(450, 10.0, 12.0), "radio": SensorState(90, 2.0, 30.0)}
    mirrored = replace(result, anchors=(replace(result.anchors[0], status="mirror-ambiguous"),))
    output = advice(silent, {}, 60.0, 0.0, mirrored)
    assert output[0].startswith("no message from the radio for 30 s")
    assert output[1].startswith("no message from the lidar for 12 s")
    assert output[2] == f"anchor {result.anchors[0].id} may be mirrored: drive a curve near it"


def test_a_slow_sensor_is_not_silent_between_its_messages():
    slow = FINE | {"radio": SensorState(9, 0.2, 10.0)}
    assert advice(slow, {}, 60.0, 0.0, None) == []


def test_what_was_never_in_reach_and_a_log_that_rests():
    assert advice({}, {}, 0.0, 0.0, None)[0].startswith("nothing is recorded yet")
    output = advice({"odometry": FINE["odometry"]}, {}, 60.0, 0.0, None)
    assert [s.partition(" at all")[0] for s in output] == [
        "no message came from the lidar", "no message came from the radio",
    ]  # fmt: skip
    assert advice(FINE, {}, 60.0, 42.0, None) == ["the log has not grown for 42 s: is the recorder still running?"]


def test_anchors_without_a_place_or_with_a_vague_one(result):
    a, b = result.anchors
    bad = (replace(a, status="unplaced", covariance=np.full((2, 2), np.nan)), replace(b, covariance=np.diag([0.01, 0.81])))
    output = advice(FINE, {}, 60.0, 0.0, replace(result, anchors=bad))
    assert output == [
        f"anchor {a.id} has no place yet: drive around it, within its reach",
        f"anchor {b.id} is known to 0.9 m only: pass it on another side",
    ]


def test_a_loop_that_is_open_asks_to_be_closed(result):
    open_loop = replace(result, closures=())
    long = np.linspace(0.0, 50.0, len(result.trajectories[0][0]))
    straight = replace(open_loop, trajectories=((result.trajectories[0][0], np.stack([long, 0 * long, 0 * long], axis=1)),))
    assert advice(FINE, {}, 60.0, 0.0, straight)[0].startswith("come back to the start to close the loop")
    drifted = replace(result, keyframe_covariances=result.keyframe_covariances + np.eye(3) * 0.2)
    assert "to close the loop" in advice(FINE, {}, 60.0, 0.0, drifted)[0]


def test_doubts_of_the_map_and_anchors_out_of_reach(result):
    doubted = replace(result, report={"doubts": [{"kind": "poor-fit", "text": "measurements lie far off"}]})
    output = advice(FINE, {"A": 70.0, "B": 1.0}, 100.0, 0.0, doubted)
    assert output == [
        "the map is doubted: measurements lie far off",
        "no range for more than a minute: A; out of reach, or without power",
    ]
