"""Turns of varying length become scans of one geometry."""

import math

import pytest

from uwblite.drivers.spinning import Fan, Samples, SweepAssembler

FAN = Fan(360, 0.1, 12.0)


def turns(world, count, readings, duration, begin=100.0, skip=lambda turn, place: False):
    """Give an assembler some turns of `readings` readings that do not stand at the rays; return its scans."""
    assembler, scans = SweepAssembler(FAN), []
    total = round(count * readings)
    for i in range(0, total, 10):
        phase = [(i + k + 0.37) / readings for k in range(10)]
        if skip(int(phase[0]), phase[0] % 1.0):
            continue
        places = tuple(p % 1.0 for p in phase)
        ranges = tuple(world(p) for p in places)
        times = [begin + p * duration for p in phase]
        scans += assembler.add(times, Samples(times[-1], None, duration / readings, places, places, ranges))
    return scans, assembler


def wall(place):
    """A wall 2 m ahead, seen within 60 degrees; beyond it nothing."""
    bearing = -2 * math.pi * place
    return 2.0 / math.cos(bearing) if math.cos(bearing) > 0.5 else math.nan


@pytest.mark.parametrize("readings", [300.0, 363.3, 450.0, 727.27])
def test_a_flat_wall_stays_flat_whatever_the_number_of_readings(readings):
    scans, _ = turns(wall, 5, readings, 0.1)
    assert len(scans) in (3, 4)  # the first turn has no beginning, and the last may have no end
    for scan in scans:
        assert len(scan.ranges) == 360
        assert scan.angle_increment == pytest.approx(-2 * math.pi / 360)
        seen = [(i, r) for i, r in enumerate(scan.ranges) if not math.isnan(r)]
        assert len(seen) >= 118
        for i, reach in seen:
            ahead = reach * math.cos(scan.angle_min + i * scan.angle_increment)
            # Linear in 1/range: wrong by an eighth of the spacing squared. The last ray may be a neighbour's reading.
            small = 2.0 * (2 * math.pi / min(readings, 360)) ** 2 / 8
            assert ahead == pytest.approx(2.0, abs=small if abs(math.remainder(i, 360)) < 59 else 0.08)


def test_no_point_appears_between_two_surfaces():
    scans, _ = turns(lambda place: 1.0 if place < 0.5 else 4.0, 4, 301.7, 0.1)
    assert {round(r, 6) for scan in scans for r in scan.ranges} == {1.0, 4.0}


@pytest.mark.parametrize("duration", [0.08, 0.1, 0.17])
def test_every_ray_has_its_time(duration):
    scans, _ = turns(wall, 6, 404.4, duration)
    for k, scan in enumerate(scans, start=1):
        assert scan.stamp == pytest.approx(100.0 + k * duration, abs=1e-9)
        assert scan.time_increment == pytest.approx(duration / 360, rel=1e-9)


def test_a_motor_that_drifts_moves_the_ends_of_a_turn_by_less_than_it_drifts():
    """The increment stays within 1 %, and the middle ray's time is exact."""
    assembler, time, scans, truth = SweepAssembler(FAN), 100.0, [], []
    for turn in range(60):
        duration = 0.1 * (1 + 0.03 * math.sin(turn / 7))
        truth.append((time, duration))
        for k in range(0, 400, 8):
            places = tuple((k + i + 0.5) / 400 for i in range(8))
            times = [time + p * duration for p in places]
            scans += assembler.add(times, Samples(times[-1], None, duration / 400, places, places, (2.0,) * 8))
        time += duration
    increments = {scan.time_increment for scan in scans}
    assert len(increments) < 20
    for scan, (begin, duration) in zip(scans, truth[1:], strict=False):
        middle = scan.stamp + 180 * scan.time_increment
        assert middle == pytest.approx(begin + duration / 2, abs=2e-4)
        assert scan.stamp == pytest.approx(begin, abs=0.005 * duration + 2e-4)


def test_a_gap_is_unknown_and_a_turn_with_too_few_rays_is_lost():
    scans, _ = turns(lambda _p: 2.0, 4, 360.0, 0.1, skip=lambda turn, place: turn == 1 and 0.25 < place < 0.5)
    unknown = [i for i, r in enumerate(scans[0].ranges) if math.isnan(r)]
    assert 70 < len(unknown) < 95
    assert min(unknown) >= 90
    assert max(unknown) < 185
    scans, assembler = turns(lambda _p: 2.0, 4, 360.0, 0.1, skip=lambda turn, place: turn == 1 and 0.25 < place < 0.9)
    assert len(scans) == 2 - 1
    assert assembler.lost == 1


@pytest.mark.parametrize(("stand", "lost"), [(0.02, 0), (0.1, 1), (2.0, 1)])
def test_a_turn_in_which_the_motor_stood_is_lost(stand, lost):
    """The lidar measured on meanwhile, always in one direction: when its rays were measured, nobody knows."""
    assembler, scans, time, place = SweepAssembler(FAN), [], 100.0, 0.0
    while place < 5.0:
        times, places = [], []
        for _ in range(10):
            time += 0.1 / 400
            place += 0.0 if 0.25 < time - 100.0 <= 0.25 + stand else 1.0 / 400
            times.append(time)
            places.append(place % 1.0)
        scans += assembler.add(times, Samples(time, None, 0.1 / 400, tuple(places), tuple(places), (2.0,) * 10))
    assert assembler.lost == lost
    assert len(scans) == 4 - lost


def test_readings_that_point_elsewhere_than_the_motor_keep_their_own_time():
    assembler, scans = SweepAssembler(FAN), []
    for i in range(0, 1200, 10):
        phase = [(i + k + 0.5) / 400 for k in range(10)]
        places = tuple(p % 1.0 for p in phase)
        bearings = tuple(p + 0.01 for p in places)
        times = [50.0 + 0.1 * p for p in phase]
        scans += assembler.add(times, Samples(times[-1], None, 0.1 / 400, places, bearings, (3.0,) * 10))
    # Ray 0 is seen when the motor is 0.01 turns before zero.
    assert scans[0].stamp == pytest.approx(50.1 - 0.001, abs=1e-6)
