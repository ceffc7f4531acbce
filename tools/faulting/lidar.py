"""Faults of the lidar."""

from dataclasses import replace

import numpy as np

from uwblite import se2
from uwblite.sensor_log import LaserScans

from .case import Case, Fault, Rng, shifted, with_scans


def repeated_scan(start: float) -> Fault:
    """The lidar repeats one scan from a share of the recording on."""

    def change(scans: LaserScans) -> LaserScans:
        first, readings = int(start * len(scans.stamps)), scans.ranges.copy()
        readings[first:] = readings[first]
        return replace(scans, ranges=readings)

    return lambda case, rng: with_scans(case, change)


def laser_factor(factor: float) -> Fault:
    """Scale all readings and the lidar's largest range."""
    return lambda case, rng: with_scans(
        case, lambda s: replace(s, ranges=(s.ranges * factor).astype(np.float32), range_max=s.range_max * factor)
    )


def longer_from_half(factor: float) -> Fault:
    """From half-way on all readings are longer by a factor: the lidar was changed for another."""
    return lambda case, rng: with_scans(case, lambda s: replace(s, ranges=np.where(
        (s.stamps >= case.middle)[:, None] & (s.ranges < s.range_max), s.ranges * np.float32(factor), s.ranges
    )))


def mirrored_laser(case: Case, rng: Rng) -> Case:
    """Beams in the wrong order."""
    return with_scans(case, lambda s: replace(s, ranges=s.ranges[:, ::-1].copy()))


def noise_scans(case: Case, rng: Rng) -> Case:
    """Readings that have nothing to do with any place."""
    return with_scans(
        case, lambda s: replace(s, ranges=rng.uniform(0.1, s.range_max, s.ranges.shape).astype(np.float32))
    )


def late_half(case: Case, rng: Rng) -> Case:
    """Every other scan is stamped an hour late."""
    return shifted(case, lambda t: 3600.0 * (np.arange(len(t)) % 2), "lidar")


def turned_laser(case: Case, rng: Rng) -> Case:
    """The lidar is mounted a quarter turn away from what stands in the log."""
    return with_scans(case, lambda s: replace(s, angle_min=s.angle_min + 0.5 * np.pi))


def reversed_scans(case: Case, rng: Rng) -> Case:
    """The scans stand in the log in reversed order."""
    return with_scans(case, lambda s: replace(s, ranges=s.ranges[::-1].copy()))


def other_half(case: Case, rng: Rng) -> Case:
    """Each half of the recording has the scans of the other one: two files were joined in the wrong order."""
    return with_scans(case, lambda s: replace(s, ranges=np.roll(s.ranges, len(s.stamps) // 2, axis=0)))


def covered_beams(case: Case, rng: Rng) -> Case:
    """A cable hangs before a third of the beams from half-way on."""

    def change(s: LaserScans) -> LaserScans:
        readings, beams = s.ranges.copy(), s.ranges.shape[1] // 3
        late = s.stamps >= case.middle
        readings[late, beams : 2 * beams] = rng.normal(0.25, 0.005, (int(late.sum()), beams)).astype(np.float32)
        return replace(s, ranges=readings)

    return with_scans(case, change)


def offset_laser(case: Case, rng: Rng) -> Case:
    """The lidar measures 0.3 m too much, always."""
    return with_scans(case, lambda s: replace(s, ranges=np.where(s.ranges < s.range_max, s.ranges + np.float32(0.3), s.ranges)))


def turned_by(angle: float) -> Fault:
    """The lidar is mounted away from what stands in the log, rad."""
    return lambda case, rng: with_scans(case, lambda s: replace(s, angle_min=s.angle_min + angle))


def knocked(angle: float) -> Fault:
    """Half-way the lidar is knocked and from then on looks elsewhere, rad."""

    def fault(case: Case, rng: Rng) -> Case:
        def change(s: LaserScans) -> LaserScans:
            beams = round(angle / abs(s.angle_increment))
            readings, later = s.ranges.copy(), s.stamps >= case.middle
            readings[later] = np.nan
            readings[later, : readings.shape[1] - beams] = s.ranges[later, beams:]
            return replace(s, ranges=readings)

        return with_scans(case, change)

    return fault


def scans_lost_in_bursts(case: Case, rng: Rng) -> Case:
    """Half of the scans are lost, 5 s at a time."""

    def change(s: LaserScans) -> LaserScans:
        kept = (s.stamps - s.stamps[0]) % 10.0 < 5.0
        return replace(s, stamps=s.stamps[kept], ranges=s.ranges[kept])

    return with_scans(case, change)


def companion(case: Case, rng: Rng) -> Case:
    """A person walks in front of the robot all the time, on two legs, 0.6 to 0.9 m ahead."""

    def change(s: LaserScans) -> LaserScans:
        angles = s.angle_min + s.angle_increment * np.arange(s.ranges.shape[1])
        readings = s.ranges.copy()
        for side in (-1.0, 1.0):
            away = 0.75 + 0.15 * np.sin(2.0 * np.pi * s.stamps / 1.1) * side
            bearing = side * 0.15 / away + 0.1 * np.sin(2.0 * np.pi * s.stamps / 7.0)
            hit = np.abs(angles - bearing[:, None]) < 0.06 / away[:, None]
            legs = away[:, None] + rng.normal(0.0, 0.01, readings.shape)
            readings = np.where(hit, legs, readings).astype(np.float32)
        return replace(s, ranges=readings)

    return with_scans(case, change)


def mirrors(case: Case, rng: Rng) -> Case:
    """A third of the walls, in places of 2 m, are mirrors: the lidar sees twice as far there."""

    def change(s: LaserScans) -> LaserScans:
        base = se2.interpolate_trajectory(case.log.odometry.stamps, case.truth, s.stamps)
        angle = s.angle_min + s.angle_increment * np.arange(s.ranges.shape[1]) + base[:, 2:3]
        seen = np.where(np.isfinite(s.ranges), s.ranges, 0.0)
        x, y = base[:, :1] + seen * np.cos(angle), base[:, 1:2] + seen * np.sin(angle)
        mirror = (np.floor(x / 2.0) + 2.0 * np.floor(y / 2.0)) % 3.0 == 0.0
        return replace(s, ranges=np.where(mirror, 2.0 * s.ranges, s.ranges).astype(np.float32))

    return with_scans(case, change)


def dirty_window(case: Case, rng: Rng) -> Case:
    """From half-way on nothing beyond 1.5 m comes back."""

    def change(s: LaserScans) -> LaserScans:
        lost = (s.stamps >= case.middle)[:, None] & (s.ranges > 1.5)
        return replace(s, ranges=np.where(lost, np.float32(np.inf), s.ranges))

    return with_scans(case, change)


def blind_half(case: Case, rng: Rng) -> Case:
    """From half-way on half of the beams report an error."""

    def change(s: LaserScans) -> LaserScans:
        readings = s.ranges.copy()
        readings[s.stamps >= case.middle, : readings.shape[1] // 2] = np.nan
        return replace(s, ranges=readings)

    return with_scans(case, change)


def shuffled_beams(case: Case, rng: Rng) -> Case:
    """Every scan begins at another beam: the driver loses the start of the turn."""

    def change(s: LaserScans) -> LaserScans:
        begin = rng.integers(0, s.ranges.shape[1], len(s.stamps))
        column = (np.arange(s.ranges.shape[1]) + begin[:, None]) % s.ranges.shape[1]
        return replace(s, ranges=np.take_along_axis(s.ranges, column, axis=1))

    return with_scans(case, change)


def tilted(reach: float) -> Fault:
    """From half-way on the lidar is tilted and sees the floor ahead, so many metres away."""

    def change(s: LaserScans, case: Case, rng: Rng) -> LaserScans:
        ahead = np.cos(s.angles)
        floor = np.where(ahead > 0.1, reach / np.maximum(ahead, 0.1), np.inf)
        nearer = np.fmin(s.ranges, floor * rng.normal(1.0, 0.02, s.ranges.shape)).astype(np.float32)
        return replace(s, ranges=np.where((s.stamps >= case.middle)[:, None], nearer, s.ranges))

    return lambda case, rng: with_scans(case, lambda s: change(s, case, rng))


def leaning(angle: float) -> Fault:
    """The lidar leans to its right, rad: walls are farther, and to the right it sees the floor 0.3 m below it."""

    def change(s: LaserScans) -> LaserScans:
        rise = np.arcsin(np.sin(angle) * np.sin(s.angles))
        floor = np.where(rise < 0.0, 0.3 / np.maximum(np.sin(-rise), 1e-6), np.inf)
        walls = s.ranges / np.cos(rise)
        return replace(s, ranges=np.where(floor < s.range_max, np.fmin(walls, floor), walls))

    return lambda case, rng: with_scans(case, change)


def reach_as_hits(reach: float) -> Fault:
    """What the lidar does not see it reports as walls at its reach, m."""

    def change(s: LaserScans) -> LaserScans:
        seen = np.isfinite(s.ranges) & (s.ranges < reach)
        return replace(s, ranges=np.where(seen, s.ranges, np.float32(reach)), range_max=max(s.range_max, 1.2 * reach))

    return lambda case, rng: with_scans(case, change)


def turning_mount(angle: float) -> Fault:
    """The lidar turns on its mount steadily, by so much in the end, rad."""

    def change(s: LaserScans) -> LaserScans:
        age, beams = (s.stamps - s.stamps[0]) / np.ptp(s.stamps), s.ranges.shape[1]
        column = np.arange(beams) + np.round(age * angle / abs(s.angle_increment)).astype(np.intp)[:, None]
        readings = np.take_along_axis(s.ranges, np.clip(column, 0, beams - 1), axis=1)
        return replace(s, ranges=np.where((column >= 0) & (column < beams), readings, np.float32(np.nan)))

    return lambda case, rng: with_scans(case, change)


def angles_times(factor: float) -> Fault:
    """The driver states a wrong angle between beams."""
    return lambda case, rng: with_scans(
        case, lambda s: replace(s, angle_min=factor * s.angle_min, angle_increment=factor * s.angle_increment)
    )


def own_body(angle: float, distance: float) -> Fault:
    """A tray of the robot stands before the lidar: a sector, rad, sees it at its distance, m, all the time."""

    def fault(case: Case, rng: Rng) -> Case:
        def change(s: LaserScans) -> LaserScans:
            readings, beams = s.ranges.copy(), round(angle / abs(s.angle_increment))
            first = readings.shape[1] // 5
            tray = readings[:, first : first + beams]
            readings[:, first : first + beams] = distance + rng.normal(0.0, 0.006, tray.shape)
            return replace(s, ranges=readings)

        return with_scans(case, change)

    return fault


def sent_twice(case: Case, rng: Rng) -> Case:
    """The driver sends at twice the lidar's rate: every other scan is the one before, with a stamp of its own."""

    def change(s: LaserScans) -> LaserScans:
        readings = s.ranges.copy()
        readings[1::2] = readings[: len(readings) // 2 * 2 : 2]
        return replace(s, ranges=readings)

    return with_scans(case, change)


def alternating_halves(case: Case, rng: Rng) -> Case:
    """Packets are lost: half of the beams is missing in each scan, the left and the right one in turn."""

    def change(s: LaserScans) -> LaserScans:
        readings, middle = s.ranges.copy(), s.ranges.shape[1] // 2
        readings[::2, :middle] = readings[1::2, middle:] = np.float32(np.nan)
        return replace(s, ranges=readings)

    return with_scans(case, change)


def swapped_rotation(case: Case, rng: Rng) -> Case:
    """From half-way on the beams come in the other order: the lidar was restarted with another setting."""
    return with_scans(
        case, lambda s: replace(s, ranges=np.where((s.stamps >= case.middle)[:, None], s.ranges[:, ::-1], s.ranges))
    )


def dust(share: float) -> Fault:
    """From half-way on a share of the beams ends at dust before the lidar, 0.1 to 1.2 m away."""

    def change(s: LaserScans, case: Case, rng: Rng) -> LaserScans:
        hit = (rng.random(s.ranges.shape) < share) & (s.stamps >= case.middle)[:, None]
        near = np.fmin(s.ranges, rng.uniform(0.1, 1.2, s.ranges.shape)).astype(np.float32)
        return replace(s, ranges=np.where(hit, near, s.ranges))

    return lambda case, rng: with_scans(case, lambda s: change(s, case, rng))


def stated_elsewhere(ahead: float, left: float, turn: float) -> Fault:
    """The lidar's pose on the base is stated wrongly, m and rad."""

    def fault(case: Case, rng: Rng) -> Case:
        mounting = case.log.mounting
        pose = mounting.T_base_laser + np.array([ahead, left, turn])
        return replace(case, log=replace(case.log, mounting=replace(mounting, T_base_laser=pose)))

    return fault
