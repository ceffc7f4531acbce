"""Findings: a sound recording has none that matter, and each fault put into it is named."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.room_recording import recording, two_rounds

from uwblite.assessment import facts
from uwblite.assessment.recording import diagnose, screened
from uwblite.assessment.sensor_checks import check_sensors
from uwblite.findings import Fact, doubt, warning
from uwblite.sensor_log import LaserScans, LogNotes, Odometry, OdometryBreaks, Screening, SensorLog, SensorMounting

PER_RANGE = ("stamps", "anchor", "ranges", "quality")


@pytest.fixture(scope="module")
def poses():
    """A round and a half."""
    return two_rounds()[:2400]


@pytest.fixture(scope="module")
def sound(poses):
    return recording(poses)


@pytest.fixture(scope="module")
def without_scans(sound):
    """The same without scans, whose check takes nearly all the time."""
    return sound.without(lidar=True)


SENSORS = {
    "odometry": {"moves-across-heading", "slow-odometry"},
    "radio": {"no-ranges", "few-in-reach", "one-anchor", "missed-ranges", "few-ranges", "spikes", "straight-path"},
    "lidar": {"no-lidar", "empty-scans", "few-hits", "error-codes"},
    "log": {"broken-lines", "reader", "refused", "odometry-alone"},
}
"""Findings, by the sensor to look at."""


def texts(log, **options):
    findings = diagnose(log, **options).findings
    named = {kind: sensor for sensor, kinds in SENSORS.items() for kind in kinds}
    assert [f.sensor for f in findings if f.kind in named] == [named[f.kind] for f in findings if f.kind in named]
    assert all(f.sensor in ("odometry", "radio", "lidar") for f in findings if f.kind in ("silences", "equal-stamps"))
    return [f"{f.severity}: {f.text}" for f in findings]


def assert_named(log, rank, part, **options):
    found = texts(log, **options)
    assert any(t.startswith(rank) and part in t for t in found), found


def test_a_sound_recording_has_nothing_to_complain_about(sound):
    diagnosis = diagnose(sound)
    assert not [f for f in diagnosis.findings if f.severity != "note"]
    figures = diagnosis.figures
    assert figures["odometry"]["rate Hz"] == pytest.approx(20.0, abs=0.01)
    assert figures["uwb"]["anchors"]["A1"]["noise m"] == pytest.approx(0.03, rel=0.3)
    assert figures["uwb"]["coverage"]["at least 3"] > 0.95


def test_a_laser_upside_down_is_named_and_so_is_a_needless_flip(poses, sound):
    assert_named(recording(poses, flipped=True), "doubt", "upside down")
    assert "doubt" not in str(texts(replace(recording(poses, flipped=True), mounting=SensorMounting(laser_flipped=True))))
    assert_named(replace(sound, mounting=SensorMounting(laser_flipped=True)), "doubt", "mounted upright")


def with_poses(log, poses):
    return replace(log, odometry=replace(log.odometry, poses=poses))


def test_units_and_axes_of_the_wheels(without_scans):
    poses = without_scans.odometry.poses
    assert_named(with_poses(without_scans, poses * (1000, 1000, 1)), "doubt", "millimetres")
    assert_named(with_poses(without_scans, np.column_stack([poses[:, :2], np.degrees(poses[:, 2])])), "doubt", "degrees")
    assert_named(with_poses(without_scans, poses * (1, 1, -1)), "warning", "turns against its path")
    assert_named(with_poses(without_scans, poses * (1e-3, 1e-3, 1)), "doubt", "hardly moves")


def test_wheels_against_the_lidar_are_a_warning_until_a_map_judges_them_by_the_ranges(without_scans):
    """Other doubts of the screening are the map's as well."""
    against = Fact.of("wheels-against-lidar", start=0.0, stretches=((1.0, 5.0),), slips=False)
    slow = Fact.of("hardly-moving", way=0.1, seconds=100.0, turned=0.1)
    screening = Screening((against, slow), OdometryBreaks.none())
    found = {f.kind: f for f in diagnose(without_scans, repaired=replace(without_scans, screening=screening)).findings}
    assert found["wheels-against-lidar"].severity == "warning"
    assert "unless its ranges agree with the lidar" in found["wheels-against-lidar"].cure
    assert found["hardly-moving"].severity == "doubt"
    assert "the map will be doubted" in found["hardly-moving"].cure


def test_what_the_screening_refuses_is_examined_as_it_was_read(without_scans):
    late = replace(without_scans.odometry, stamps=1e9 * without_scans.odometry.stamps)
    wrong = replace(without_scans, odometry=late)
    assert screened(wrong) is None
    assert screened(without_scans).screening is not None
    assert "equal-stamps" not in {f.kind for f in diagnose(wrong, refused="the stamps are wrong").findings}
    assert_named(wrong, "doubt", "the stamps are wrong", refused="the stamps are wrong")


def test_jumps_gaps_and_equal_stamps(without_scans):
    jumped = without_scans.odometry.poses.copy()
    jumped[700:] += (2.0, 0.0, 0.0)
    assert_named(with_poses(without_scans, jumped), "warning", "jumps at t = 34.9 s (by up to 2.00 m)")
    stamps = without_scans.odometry.stamps
    late = replace(without_scans.odometry, stamps=stamps + np.where(np.arange(len(stamps)) > 700, 9.0, 0.0))
    assert_named(replace(without_scans, odometry=late), "note", "longest is 9.1 s")
    coarse = replace(without_scans.odometry, stamps=np.floor(stamps * 5) / 5)
    assert_named(replace(without_scans, odometry=coarse), "warning", "stamps equal the one before")


def test_the_ranges_of_one_round_share_its_stamp_and_that_is_right(without_scans):
    stated = [f.text for f in diagnose(without_scans).findings if "equal the one before" in f.text]
    assert stated == []
    coarse = replace(without_scans.ranges, stamps=np.floor(without_scans.ranges.stamps))
    assert_named(replace(without_scans, ranges=coarse), "note", "stamps equal the one before")


def with_ranges(log, values):
    return replace(log, ranges=replace(log.ranges, ranges=values))


def test_ranges_zero_absurd_spiky_or_in_millimetres(without_scans):
    values, mine = without_scans.ranges.ranges, without_scans.ranges.anchor == 1
    rng = np.random.default_rng(2)
    struck = mine & (rng.uniform(size=len(values)) < 0.2)
    assert_named(with_ranges(without_scans, np.where(struck, 0.0, values)), "warning", "anchor B2: ")
    figures = diagnose(with_ranges(without_scans, np.where(struck, 0.0, values))).figures["uwb"]["anchors"]["B2"]
    sound = diagnose(without_scans).figures["uwb"]["anchors"]["B2"]
    assert (figures["zeros"], figures["absurd"]) == (struck.sum(), 0)
    assert figures["spikes"] <= sound["spikes"] + 2
    assert figures["noise m"] < 2.0 * sound["noise m"]
    negative = diagnose(with_ranges(without_scans, np.where(struck, -3.0, values))).figures["uwb"]["anchors"]["B2"]
    assert negative["absurd"] == struck.sum()
    few = mine & (np.arange(len(values)) % 30 == 1)
    spiky = diagnose(with_ranges(without_scans, np.where(few, values + 4.0, values))).figures["uwb"]["anchors"]["B2"]
    assert spiky["spikes"] == pytest.approx(few.sum(), abs=2)
    assert_named(with_ranges(without_scans, values * 1000), "doubt", "millimetres")


def test_coverage_and_straight_paths(without_scans):
    only = without_scans.ranges.anchor == 0
    ranges = replace(without_scans.ranges, **{n: getattr(without_scans.ranges, n)[only] for n in PER_RANGE}, anchor_ids=("A1",))
    assert_named(replace(without_scans, ranges=ranges), "note", "there is one anchor")
    half = ranges.stamps < 110
    short = replace(ranges, **{n: getattr(ranges, n)[half] for n in PER_RANGE})
    straight = without_scans.odometry.poses * (1, 0, 0)
    assert_named(replace(with_poses(without_scans, straight), ranges=short), "warning", "either side")


def test_scans_in_millimetres_degrees_or_dark(sound):
    scans = sound.scans
    far = replace(scans, ranges=scans.ranges * 1000, range_max=5600.0, range_min=20.0)
    assert_named(replace(sound, scans=far), "doubt", "millimetres")
    assert_named(replace(sound, scans=replace(scans, angle_increment=1.5, angle_min=-120.0)), "doubt", "degrees")
    dark = replace(scans, ranges=np.full_like(scans.ranges, np.inf))
    assert_named(replace(sound, scans=dark), "warning", "only 0% of the beams")
    stuck = replace(scans, ranges=np.full_like(scans.ranges, 1.5))
    assert_named(replace(sound, scans=stuck), "warning", "scans equal the scan before")


def test_clocks_that_have_nothing_in_common(sound):
    scans = replace(sound.scans, stamps=sound.scans.stamps + 5000)
    assert_named(replace(sound, scans=scans), "doubt", "the clocks differ by about 5000")


def test_missing_sensors_and_notes_of_the_reader(without_scans):
    assert_named(without_scans.without(uwb=True), "warning", "no UWB ranges in use: the path rests on odometry alone")
    assert_named(without_scans, "warning", "no lidar in use: no map, and only the odometry's turns")
    cures = {finding.kind: finding.cure for finding in check_sensors([without_scans.without(uwb=True)])}
    assert cures == {"no-ranges": "check the tag if that is not meant", "no-lidar": "check the lidar if that is not meant"}
    notes = LogNotes(lines=1000, broken=30, broken_lines=((17, "not a number"),), warnings=("3 messages out of order",))
    noted = replace(without_scans, notes=notes)
    assert_named(noted, "warning", "30 of 1000 lines are broken and were skipped (line 17: not a number)")
    assert_named(noted, "warning", "3 messages out of order")


def test_what_a_map_finds_is_said_as_the_map_says_it(without_scans, room_result):
    scales = doubt("scales", "the ranges are 0.80 times the distances on the map")
    made = replace(room_result, findings=(scales, warning("moved-anchor", "an anchor was moved")))
    assert_named(without_scans, "doubt", scales.text, result=made)
    assert_named(without_scans, "warning", "an anchor was moved", result=made)
    assert_named(without_scans, "doubt", "nothing to map", refused="nothing to map")
    still = with_poses(without_scans, np.repeat(without_scans.odometry.poses[:1], len(without_scans.odometry.stamps), axis=0))
    (found,) = [f for f in diagnose(still).findings if "hardly moves" in f.text]
    made = replace(room_result, findings=(found,))
    assert sum(f.text == found.text for f in diagnose(still, result=made).findings) == 1


def test_findings_are_ranked_and_json_ready(sound):
    import json

    log = with_poses(sound.without(uwb=True), sound.odometry.poses * (1000, 1000, 1))
    diagnosis = diagnose(log)
    ranks = [f.severity for f in diagnosis.findings]
    assert ranks == sorted(ranks, key=["doubt", "warning", "note"].index)
    assert diagnosis.doubts
    json.dumps(diagnosis.figures, allow_nan=False)


@pytest.mark.parametrize("samples", [1, 2, 3, 6])
def test_the_shortest_recordings_are_examined_too(sound, samples):
    odometry = Odometry(sound.odometry.stamps[:samples], sound.odometry.poses[:samples])
    ranges = replace(sound.ranges, **{n: getattr(sound.ranges, n)[:samples] for n in PER_RANGE})
    scans = replace(sound.scans, stamps=sound.scans.stamps[:samples], ranges=sound.scans.ranges[:samples])
    assert diagnose(SensorLog(odometry, ranges, scans)).doubts


def test_the_rhythm_of_a_log_that_a_program_wrote_blames_no_cable():
    """A pose with each scan, as GMapping writes them; the same rhythm of a raw log is the sensors'."""
    stamps = np.concatenate([np.arange(0.0, 100.0, 2.0), np.arange(150.0, 250.0, 2.0)])
    poses = np.column_stack([0.2 * np.arange(len(stamps)), np.zeros((len(stamps), 2))])
    scans = LaserScans(stamps, np.full((len(stamps), 90), 2.0, np.float32), -0.8, 0.018, 0.0, 0.02, 5.6)
    for written in (False, True):
        notes = LogNotes(one_clock=written)
        found = [
            f
            for f in diagnose(SensorLog(Odometry(stamps, poses), None, scans, notes=notes)).findings
            if f.kind in ("silences", "slow-odometry")
        ]
        assert {f.kind for f in found} == {"silences", "slow-odometry"}
        assert all((f.severity == "note") == written for f in found if f.kind == "slow-odometry")
        assert any("cable" in f.cure for f in found) == (not written)


def test_a_stretch_within_a_second_is_a_moment():
    assert facts.spans([(39.1, 39.3), (60.0, 64.2)]) == "t = 39 s, t = 60 to 64 s"
