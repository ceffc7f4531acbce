"""Driving advice is followed by a simulated second drive: afterwards it is not given again, and the map is better."""

import re
from dataclasses import dataclass

import numpy as np
import pytest
from helpers import planted

from uwblite import se2
from uwblite.assessment.recording import diagnose
from uwblite.io.result_text import RunRecord
from uwblite.io.results import write_result
from uwblite.io.stored_result import read_result
from uwblite.mapping import build_map
from uwblite.sensor_log import SensorMounting
from uwblite.server.advice import advice

RIGHT, LEFT = (0.0, 0.0, -np.pi / 4), (0.0, 0.0, np.pi / 4)
AHEAD = (0.5, 0.0, 0.0)
CURVE = (0.5, 0.0, 0.35)


def ahead(metres):
    return AHEAD, metres / 0.5


def corner(turn=LEFT, quarters=1):
    return turn, 2.0 * quarters


def room(x, y, width, depth):
    return planted.box(width, depth) + np.array([x, y, x, y])


HALL = np.concatenate([room(0.0, 0.0, 8.0, 6.0), room(0.8, 0.6, 1.0, 0.6), room(-0.8, -0.4, 0.6, 1.0)])
"""A hall of 8 x 6 m with two pillars."""
ROUND = [ahead(5.0), corner(), ahead(3.5), corner(), ahead(5.0), corner(), ahead(3.5), corner()]


@dataclass
class Place:
    """A building, its anchors and what the sensors reach there."""

    walls: np.ndarray = None
    anchors: tuple = ()
    start: tuple = (-2.6, -2.0, 0.0)
    lidar: float = 12.0
    scans: tuple = (2.0, 120)
    """1/s, and beams of each."""
    radio: float = np.inf
    silent: tuple = (np.inf, np.inf)
    """s, when the lidar is silent."""


def recorded(place, legs):
    """Return a recording of legs (twist, s), wheels a little off, and the true poses."""
    rng = np.random.default_rng(3)
    stamps, truth = planted.drive([twist for twist, _ in legs], [s for _, s in legs], start=place.start)
    wheels = planted.odometry(stamps, truth, rng, scale=1.01, drift=0.01, noise=0.005, turn_noise=0.005)
    radio = planted.ranges(rng, stamps, truth, np.array(place.anchors)) if len(place.anchors) else None
    if radio is not None:
        radio = radio.rows(np.flatnonzero(radio.ranges < place.radio))
    scans = None
    if place.walls is not None:
        rate, beams = place.scans
        scans = planted.scans(stamps, truth, place.walls, rate, beams, range_max=place.lidar, noise=0.01, rng=rng)
        first, last = place.silent
        scans = scans.rows(np.flatnonzero((scans.stamps < first) | (scans.stamps > last)))
    return planted.recording(wheels, radio, scans, SensorMounting(anchor_height=0.0)), truth


def said(log, result, folder):
    """Return all that check, map and watch say of a recording."""
    found = [f"{f.text}: {f.cure}" for f in diagnose(log).findings]
    found += [f.text for f in (*result.warnings, *result.doubts)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("uwblite.io.results.draw_map", lambda drawn, caption: np.zeros((2, 3, 3), dtype=np.uint8))
        write_result(folder, [log], result, RunRecord("uwblite map x", ""))
    return found + advice({}, {}, 0.0, 0.0, read_result(folder))


CORRIDOR = np.concatenate([room(0, 0, 20, 14), room(0, 0, 16, 10), room(3, 5.8, 0.4, 0.4), room(-4, -6.6, 0.8, 0.4)])
"""A corridor around a block of 16 x 10 m."""
WIDE = np.concatenate([room(0, 0, 60, 60), room(-25, -27, 2, 1), room(-20, -26, 1, 1)])
CORNERS = ((-3.5, 2.5), (3.5, -2.5), (3.5, 2.5))
WEST = [corner(LEFT, 2), ahead(1.0), corner(RIGHT), ahead(4.0), corner(RIGHT)]
EAST = [ahead(0.6), corner(RIGHT), ahead(4.0), corner(RIGHT), ahead(0.6), corner(RIGHT), ahead(4.0), corner(RIGHT)]
OUT = [ahead(16.0), corner(), ahead(12.0), corner(), ahead(16.0)]
BACK = [corner(LEFT, 2), ahead(16.0), corner(RIGHT), ahead(12.0), corner(RIGHT), ahead(14.0)]
MIDDLE = [ahead(6.0), corner(), ahead(4.0), corner(), ahead(6.0)]
BY_THE_WALLS = [ahead(3.0), corner(), ahead(6.0), corner(LEFT, 2), ahead(6.0), corner(LEFT, 2), ahead(4.0)]
ROWS = {
    "near and around": (
        Place(HALL, ((7.0, 0.5),), radio=8.6),
        [*WEST, ahead(3.0)],
        [*WEST, ahead(5.4), *EAST],
        (
            "only . usable ranges: it cannot be placed; drive nearer to it",
            "no anchor could be placed: .*; drive curves near the anchors",
            "has no place yet: drive around it, within its reach",
        ),
    ),
    "a curve": (
        Place(None, ((3.0, 2.0), (6.0, -1.5), (9.0, 2.5)), start=(0.0, 0.0, 0.0)),
        [ahead(12.0)],
        [ahead(12.0), (CURVE, 18.0), ahead(4.0), (CURVE, 9.0)],
        (
            "in reach on a straight path only: .* drive a curve within its reach",
            "may be mirrored: drive a curve near it",
            "known to .* m only: pass it on another side",
        ),
    ),
    "through the building": (
        Place(HALL, CORNERS),
        [ahead(0.6), ((0.0, 0.0, 0.0), 8.0)],
        [ahead(0.6), ((0.0, 0.0, 0.0), 8.0), ahead(4.4), *ROUND[1:], *ROUND[:4]],
        (
            "the robot hardly moves: .* Drive through the building",
            "known to .* m only: pass it on another side",
        ),
    ),
    "along the walls": (
        Place(WIDE, start=(0.0, 0.0, 0.0), lidar=4.0),
        MIDDLE,
        (Place(WIDE, start=(-24.0, -22.0, -np.pi / 2), lidar=4.0), BY_THE_WALLS),
        (
            "of the beams hit anything within 4.0 m: .* drive along the walls",
            "too few ranges and scans constrain the trajectory; .* drive where the lidar sees walls",
            "come back to a place seen before to close the loop",
        ),
    ),
    "the first part once more": (
        Place(CORRIDOR, start=(-7.0, -6.0, 0.0), lidar=6.0, scans=(3.0, 180), silent=(34.0, 60.0)),
        OUT,
        [*OUT, *BACK],
        (
            "the lidar is silent, .* drive through the first part once more",
            "no loop closure was accepted: .* drive through places twice",
            "come back to the start to close the loop",
        ),
    ),
}
"""Place, first drive, second drive (in another place where one is named), and what is advised after the first."""


@pytest.mark.parametrize("row", ROWS)
def test_advice_that_is_followed_helps(tmp_path, row):
    place, first, second, advised = ROWS[row]
    log, truth = recorded(place, first)
    before = build_map(log)
    sentences = said(log, before, tmp_path / "before")
    for pattern in advised:
        assert any(re.search(pattern, text) for text in sentences), (pattern, sentences)
    place, second = second if isinstance(second, tuple) else (place, second)
    log, truth = recorded(place, second)
    after = build_map(log)
    sentences = said(log, after, tmp_path / "after")
    for pattern in advised:
        assert not any(re.search(pattern, text) for text in sentences), (pattern, sentences)
    assert before.doubts
    assert not after.doubts
    assert planted.aligned_error(after.trajectory[:, :2], truth[:, :2]) < 0.05
    for anchor in after.anchors:
        number = int(anchor.id[1:])
        assert anchor.status == "ok"
        expected = se2.transform(se2.inverse(np.array(place.start)), np.array(place.anchors[number]))
        np.testing.assert_allclose(anchor.position, expected, atol=0.2)
