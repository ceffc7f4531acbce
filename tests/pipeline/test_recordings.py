"""Several recordings in one map: a common frame by anchors, moved anchors named, calibration of each its own."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.planted import box, odometry, ranges, recording, scans, wander
from simulation import logfile
from simulation.recording import Settings, simulate

from uwblite import se2
from uwblite.errors import DataError
from uwblite.evaluation.trajectory import evaluate_trajectory
from uwblite.graph.calibration import unknowns
from uwblite.io.carmen import read_log
from uwblite.io.tum import read_tum
from uwblite.mapping import MappingConfig, build_map
from uwblite.pipeline.recordings import check_distinct, gather
from uwblite.sensor_log import SensorMounting

PLACES = np.array([[6.0, 4.5], [-6.0, 4.0], [5.5, -4.5], [-5.0, -4.0]])
ROOM = box(14, 11)
LEVEL = SensorMounting(anchor_height=0.0)


def drive(seed, places=PLACES, *, lidar=True, start=0.0, turn=0.0, length=22.0, mounting=LEVEL):
    """A recording of the room and its truth; its odometry begins in a frame of its own."""
    rng = np.random.default_rng(seed)
    stamps, truth = wander(rng, length)
    seen = scans(stamps, truth, ROOM, beams=120, rng=rng, noise=0.01) if lidar else None
    radio = ranges(rng, stamps, truth, places, sigma=0.04, tag=tuple(mounting.tag_position[:2].tolist()))
    wheels = odometry(stamps, truth, rng, noise=0.003, turn_noise=0.002)
    wheels = replace(wheels, poses=se2.compose(np.array([3.0, -2.0, turn]), wheels.poses))
    log = recording(wheels, radio, seen, mounting=mounting)
    shifted = replace(
        log,
        odometry=replace(log.odometry, stamps=log.odometry.stamps + start),
        ranges=replace(log.ranges, stamps=log.ranges.stamps + start),
        scans=None if log.scans is None else replace(log.scans, stamps=log.scans.stamps + start),
    )
    return shifted, truth


def joint_ate(result, truths):
    """Error of all trajectories laid over the truth by one motion, and of each by its own."""
    truth = np.concatenate(truths)
    order = np.arange(len(truth), dtype=float)
    both = evaluate_trajectory(order, result.trajectory, order, truth).ate.rmse
    each = [
        evaluate_trajectory(order[: len(t)], result.trajectory[result.recording == n], order[: len(t)], t).ate.rmse
        for n, t in enumerate(truths)
    ]
    return both, each


@pytest.fixture(scope="module")
def two():
    return [drive(1), drive(2, start=500.0, turn=2.0)]


@pytest.fixture(scope="module")
def merged(two):
    return build_map([log for log, _ in two])


def test_two_sound_recordings_make_a_map_without_doubts(merged):
    assert merged.doubts == ()
    assert merged.warnings == ()


@pytest.mark.slow
def test_two_recordings_share_a_frame(two, merged):
    both, _ = joint_ate(merged, [truth for _, truth in two])
    alone = [build_map(log) for log, _ in two]
    single = [joint_ate(r, [t])[0] for r, (_, t) in zip(alone, two, strict=True)]
    # The common frame costs nothing: no worse than the worse of the two, but for chance of a millimetre or two.
    assert both < max(single) + 0.002


def test_every_stamp_reports_its_recording(two, merged):
    for n, (log, _) in enumerate(two):
        np.testing.assert_array_equal(merged.stamps[merged.recording == n], log.odometry.stamps)
    assert len(merged.keyframe_stamps) == len(merged.graph.poses)


def test_the_map_lies_in_the_frame_of_the_first(two, merged):
    np.testing.assert_allclose(merged.trajectory[0], two[0][0].odometry.poses[0], atol=1e-6)


def test_clouds_of_different_recordings_are_matched(merged):
    count = int(np.sum(merged.recording == 0))
    stamps = merged.keyframe_stamps
    first = np.flatnonzero(np.diff(stamps) > 100.0)[0]
    assert any(c.accepted and c.i <= first < c.j for c in merged.closures)
    assert count < len(merged.stamps)


def test_wheels_and_biases_are_each_recording_s_own(merged):
    names = [c.name for c in merged.calibration]
    assert {"odometry_scale", "odometry_scale#2", "laser_x", "range_scale", "tag_x#2"} <= set(names)
    assert "laser_x#2" not in names
    assert len(set(names)) == len(names)
    assert [a.id for a in merged.anchors] == sorted(a.id for a in merged.anchors)
    assert all(f"bias:{a.id}#2" in names for a in merged.anchors)


def test_names_of_a_further_recording_are_its_own():
    config, given_heights = MappingConfig().calibration, np.zeros(1, dtype=bool)
    first, second = (unknowns(config, ("A",), given_heights, n) for n in (0, 1))
    assert not {u.key for u in first} & {u.key for u in second}
    assert len(first) - len(second) == 5


def test_ranges_of_all_are_counted_and_listed(two, merged):
    for k, anchor in enumerate(merged.anchors):
        measured = sum(int(np.sum(log.ranges.anchor == k)) for log, _ in two)
        assert anchor.ranges == measured
    assert len(merged.range_table["stamp"]) == sum(len(log.ranges.stamps) for log, _ in two)


@pytest.mark.slow
@pytest.mark.parametrize("shift", [(4.5, -1.0), (0.9, 0.7)])
def test_a_moved_anchor_is_named_and_stands_at_both_places(two, shift):
    there = PLACES + np.array([[0, 0], shift, [0, 0], [0, 0]])
    logs = [two[0][0], drive(2, there, start=500.0, turn=2.0)[0]]
    result = build_map(logs)
    name = logs[0].ranges.anchor_ids[1]
    reported = [w for w in result.warnings if "was moved" in w.text]
    assert len(reported) == 1
    assert f"anchor {name} was moved: in recording 2" in reported[0].text
    places = {a.id: a.position for a in result.anchors}
    stamps, first = logs[0].odometry.stamps, result.trajectory[result.recording == 0]
    laid = evaluate_trajectory(stamps, first, stamps, two[0][1]).T_truth_map
    off = se2.rotate(laid[2], places[f"{name}#2"] - places[name])
    np.testing.assert_allclose(off, shift, atol=0.25)
    assert joint_ate(result, [truth for _, truth in two])[0] < 0.03


@pytest.mark.slow
def test_other_robots_mounting_is_respected(two):
    """The second robot carries its tag elsewhere, and its laser sees with other beams."""
    mounting = replace(LEVEL, tag_position=np.array([0.25, -0.15, 0.0]))
    other, truth = drive(3, start=500.0, turn=-1.0, mounting=mounting)
    thin = replace(
        other.scans, ranges=other.scans.ranges[:, ::2], angle_increment=2 * other.scans.angle_increment,
        time_increment=2 * other.scans.time_increment,
    )  # fmt: skip
    result = build_map([two[0][0], replace(other, scans=thin)])
    assert joint_ate(result, [two[0][1], truth])[0] < 0.03
    assert not [w for w in result.warnings if "moved" in w.text]


@pytest.mark.slow
def test_one_of_them_may_lack_lidar(two):
    blind = two[1][0].without(lidar=True)
    result = build_map([two[0][0], blind])
    both, each = joint_ate(result, [truth for _, truth in two])
    assert each[0] < 0.02
    assert both < 0.2
    assert result.grid is not None


@pytest.mark.slow
def test_wheels_and_radio_alone_share_a_frame(two):
    result = build_map([log.without(lidar=True) for log, _ in two])
    assert joint_ate(result, [truth for _, truth in two])[0] < 0.15


@pytest.mark.slow
def test_a_third_links_two_that_share_nothing():
    """West has ranges to A and B, east to C and D; the third to all. Order does not matter."""
    whole, truth = drive(4, lidar=False, start=900.0)
    parts = []
    for seed, keep in ((5, (0, 1)), (6, (2, 3))):
        log, own = drive(seed, lidar=False, start=300.0 * seed)
        radio = log.ranges
        kept = np.isin(radio.anchor, keep)
        ids = tuple(radio.anchor_ids[k] for k in keep)
        radio = replace(
            radio, stamps=radio.stamps[kept], anchor=np.searchsorted(keep, radio.anchor[kept]), ranges=radio.ranges[kept],
            quality=radio.quality[kept], anchor_ids=ids,
        )  # fmt: skip
        parts.append((replace(log, ranges=radio), own))
    with pytest.raises(DataError, match=r"recording 2.*shares 0 placed anchors"):
        build_map([log for log, _ in parts])
    logs, truths = zip(parts[0], parts[1], (whole, truth), strict=True)
    result = build_map(logs)
    assert len(result.anchors) == 4
    assert joint_ate(result, truths)[0] < 0.3


@pytest.mark.slow
def test_equal_input_gives_equal_bytes(two):
    short = [log.crop(end=log.odometry.stamps[0] + 10.0) for log, _ in two]
    one, other = build_map(short), build_map(short)
    assert one.trajectory.tobytes() == other.trajectory.tobytes()
    assert one.grid.log_odds.tobytes() == other.grid.log_odds.tobytes()


def test_a_list_of_one_is_that_one(two):
    log = two[0][0].crop(end=4.0)
    assert build_map([log]).trajectory.tobytes() == build_map(log).trajectory.tobytes()


def test_no_recording_and_no_ranges_are_reported(two):
    with pytest.raises(DataError, match="no recording"):
        build_map([])
    with pytest.raises(DataError, match=r"recording 2.*shares 0 placed anchors.*two or more"):
        build_map([two[0][0], two[1][0].without(uwb=True)])


def test_paths_of_recordings_lie_apart(two):
    recordings = gather([log for log, _ in two], MappingConfig().keyframes)
    assert len(recordings) == 2
    change = np.flatnonzero(np.diff(recordings.of_keyframe))
    assert len(change) == 1
    assert np.all(np.diff(recordings.path) >= 0)
    assert np.diff(recordings.path)[change[0]] > 100.0
    assert [s.rows.stop - s.rows.start for s in recordings.each] == [len(s.frames) for s in recordings.each]


@pytest.mark.slow
def test_two_recordings_through_a_simulated_hall(tmp_path):
    """Odometry of either drifts by metres; the map of both is as good as that of one."""
    logs, truths, single = [], [], []
    for seed in (31, 32):
        folder = tmp_path / str(seed)
        logfile.write(simulate(Settings(world="hall", minutes=2.0, seed=seed, scan_rate=4.0)), folder)
        logs.append(read_log(folder / "run.log"))
        stamps, poses = read_tum(folder / "truth.tum")
        truths.append(se2.interpolate_trajectory(stamps, poses, logs[-1].odometry.stamps))
        single.append(joint_ate(build_map(logs[-1]), truths[-1:])[0])
    result = build_map(logs)
    assert joint_ate(result, truths)[0] <= max(single) + 0.002
    assert result.warnings == ()


def test_recordings_of_one_log_are_refused_and_robots_that_stand_alike_are_not(two):
    """A copy, and a part that overlaps by four seconds; of two that stand, odometry at one place is no sign."""
    (one, _), (other, _) = two
    later = one.crop(start=float(one.odometry.stamps[-1]) - 4.0)
    for copy in (one, later, replace(one, ranges=None)):
        with pytest.raises(DataError, match=r"recordings 2 \(.*\) and 3 \(.*\) are of one log"):
            check_distinct([other, one, copy])
    still = replace(one, odometry=replace(one.odometry, poses=np.zeros_like(one.odometry.poses)))
    check_distinct([still, still])


def test_recordings_lie_a_kilometre_apart_on_the_way():
    """So that keyframes of two are never taken for one visit, however near their places are."""
    logs = [drive(seed, lidar=False, length=8.0)[0] for seed in (1, 2, 3)]
    together = gather(logs, MappingConfig().keyframes)
    for number in (1, 2):
        (last,), (first,) = (np.flatnonzero(together.of_keyframe == n)[[end]] for n, end in ((number - 1, -1), (number, 0)))
        assert together.path[first] - together.path[last] == pytest.approx(1000.0)
    assert together.travelled == pytest.approx(together.path[-1] - 2000.0)
    assert np.all(np.diff(together.path) >= 0.0)
