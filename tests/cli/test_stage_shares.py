"""The time left over all stages: it knows every stage of a real map, never runs backwards, and ends near the end."""

import itertools

import pytest

from uwblite.cli import console
from uwblite.cli.map import Overall
from uwblite.mapping import Stage, build_map


@pytest.mark.parametrize("lidar", [True, False])
def test_every_stage_of_a_map_is_known_and_the_share_only_rises(log, lidar):
    overall, shares, strangers = Overall(lidar=lidar), [0.0], set()
    known = {name for name, _ in overall._shares}
    first = log.odometry.stamps[0]

    def progress(stage, done, total):
        shares.append(overall.take(stage, done, total))
        if stage.name not in known:
            strangers.add(stage.name)

    build_map(log.crop(first, first + 25.0).without(lidar=not lidar), progress=progress)
    assert strangers == set()
    assert shares == sorted(shares)
    assert shares[-1] > 0.95
    assert len(set(shares)) > 5


def test_rounds_share_what_is_left_of_their_stage():
    overall = Overall()
    rounds = [overall.take(Stage("loop closure", k), 1, 1) for k in range(1, 6)]
    steps = [b - a for a, b in itertools.pairwise(rounds)]
    assert all(b == pytest.approx(a / 2) for a, b in itertools.pairwise(steps))
    assert Overall().take(Stage("joint refinement"), 0, 10) > rounds[-1]


def test_unknown_stages_and_empty_ones_change_nothing():
    overall = Overall()
    steps = (("clouds", 1, 2), ("something new", 1, 1), ("keyframes", 0, 0))
    assert len({overall.take(Stage(name), done, total) for name, done, total in steps}) == 1


def test_the_line_reports_the_time_left_once_it_can_be_reported():
    assert "left" not in console.progress_line("clouds", 0.02, 60.0)
    assert "left" not in console.progress_line("clouds", 0.5, 1.0)
    assert console.progress_line("clouds", 0.25, 30.0) == "[#####               ]  25 %  clouds  about 1 min 30 s left"
