"""Points between the beams of a coarse lidar: on walls, and only there."""

from dataclasses import replace

import numpy as np
import pytest

from uwblite import se2
from uwblite.lidar.clouds import _on_one_line, filled
from uwblite.odometry.attached import ScanPoints


def scan_of(walls, beams=181, noise=0.0, number=0):
    """What beams a degree apart, from -90 to 90 degrees, see of lines x cos a + y sin a = d within 20 m."""
    angle = np.radians(np.linspace(-90.0, 90.0, beams))
    ranges = np.full(beams, np.inf)
    for facing, distance in walls:
        with np.errstate(divide="ignore"):
            reach = distance / np.cos(angle - facing)
        ranges = np.where((reach > 0.0) & (reach < ranges), reach, ranges)
    ranges = ranges + noise * np.random.default_rng(1).standard_normal(beams)
    ray = np.flatnonzero(ranges < 20.0)
    points = ranges[ray, None] * np.column_stack([np.cos(angle[ray]), np.sin(angle[ray])])
    return ScanPoints(np.full(len(ray), number), points, np.zeros_like(points), ray, np.full(len(ray), number))


def test_walls_are_dense_and_every_new_point_is_on_one():
    """A room: a wall 8 m ahead, walls 5 m to either side; the chords run along them, corners stay as they are."""
    walls = [(0.0, 8.0), (np.pi / 2, 5.0), (-np.pi / 2, 5.0)]
    rays = scan_of(walls, noise=0.01)
    found = filled(rays)
    off = np.min([np.abs(found.points @ [np.cos(a), np.sin(a)] - d) for a, d in walls], axis=0)
    assert off.max() < 0.05
    ahead = np.sort(found.points[np.abs(found.points[:, 0] - 8.0) < 0.05, 1])
    assert np.diff(ahead).max() < 0.12
    assert np.diff(np.sort(rays.points[np.abs(rays.points[:, 0] - 8.0) < 0.05, 1])).max() > 0.14
    kept = {tuple(p) for p in found.points.tolist()}
    assert kept.issuperset(map(tuple, rays.points.tolist()))


def test_what_no_line_joins_stays_apart():
    """Hits at random distances, a lost beam, and hits of different scans."""
    rays = scan_of([(0.0, 8.0)])
    rng = np.random.default_rng(2)
    scattered = rays.points * rng.uniform(0.3, 1.0, (len(rays.points), 1))
    wild = ScanPoints(rays.keyframe, scattered, rays.origins, rays.ray, rays.scan)
    assert len(filled(wild).points) < 1.1 * len(rays.points)
    middle = len(rays.ray) // 2
    kept = np.arange(len(rays.ray)) != middle
    holed = ScanPoints(*(getattr(rays, n)[kept] for n in ("keyframe", "points", "origins", "ray", "scan")))
    lost = rays.points[middle]
    assert np.min(np.hypot(*(filled(holed).points - lost).T)) > 0.1
    each = ScanPoints(rays.keyframe, rays.points, rays.origins, rays.ray, np.arange(len(rays.ray)))
    assert len(filled(each).points) == len(each.points)


def test_dense_and_empty_scans_stay_as_they_are():
    box = [(k * np.pi / 2, 1.5) for k in range(4)]
    dense = scan_of(box, beams=721)
    assert filled(dense).points.tolist() == dense.points.tolist()
    assert len(filled(scan_of([])).points) == 0


@pytest.mark.parametrize("turn", [0.0, 0.9, np.pi / 2, 2.5])
@pytest.mark.parametrize(("beams", "dense"), [(181, True), (361, True), (601, False)])
def test_gaps_are_filled_between_coarse_beams_whatever_way_they_look(turn, beams, dense):
    """Beams 1 and 0.5 degrees apart, and 0.3, of which nothing is made up."""
    rays = scan_of([(0.0, 13.0)], beams=beams)
    turned = replace(rays, points=se2.rotate(turn, rays.points))
    found = filled(turned)
    assert (len(found.points) > 1.2 * len(rays.points)) is dense
    assert dense or len(found.points) == len(rays.points)
    np.testing.assert_allclose(found.points @ [np.cos(turn), np.sin(turn)], 13.0, atol=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_a_gap_is_filled_by_the_rules_for_each_hit(seed):
    """Hit by hit: the next beam of the same scan, a gap that is wide but not too wide, beams that are coarse there and not too
    long, and one of the neighbouring gaps on the same line."""
    rng = np.random.default_rng(seed)
    count = 400
    angle = np.cumsum(rng.choice([0.004, 0.006, 0.01, 0.017], count))
    ranges = np.repeat(rng.uniform(2.0, 17.0, count // 8), 8) * (1.0 + 0.003 * rng.standard_normal(count))
    points = ranges[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    origins = np.tile([0.1, -0.2], (count, 1))
    ray, scan = np.cumsum(rng.choice([1, 2], count, p=[0.95, 0.05])), np.arange(count) // 100
    rays = ScanPoints(scan, points, origins, ray, scan)

    def joined(k):
        return 0 <= k < count - 1 and scan[k + 1] == scan[k] and ray[k + 1] == ray[k] + 1

    def on(k, other):
        """Whether the step from hit k goes on along the step from another one."""
        if not joined(other) or np.hypot(*(points[other + 1] - points[other])) >= 0.6:
            return False
        step, beside = points[k + 1] - points[k], points[other + 1] - points[other]
        length = np.hypot(*step)
        along, across = step @ beside / length, abs(step[0] * beside[1] - step[1] * beside[0]) / length
        return along > 0.4 * length and across < 0.04 + 0.08 * along

    expected = []
    for k in range(count):
        if not joined(k):
            expected.append(False)
            continue
        step, beam = points[k + 1] - points[k], points[k] - origins[k]
        turn = abs(step[0] * beam[1] - step[1] * beam[0]) / (beam @ beam)
        wide, near = 0.1 < np.hypot(*step) < 0.6, np.hypot(*beam) < 15.0
        expected.append(bool(wide and near and turn > 0.0075 and (on(k, k - 1) or on(k, k + 1))))
    assert _on_one_line(rays).tolist() == np.flatnonzero(expected).tolist()
    assert sum(expected) > 10
    done = filled(rays)
    # Each gap is divided into equal parts of at most 0.1 m, in the order of the beams.
    parts = [int(np.ceil(np.hypot(*(points[k + 1] - points[k])) / 0.1)) if gap else 1 for k, gap in enumerate(expected)]
    filled_up = [np.linspace(points[k], points[min(k + 1, count - 1)], n, endpoint=False) for k, n in enumerate(parts)]
    np.testing.assert_allclose(done.points, np.concatenate(filled_up))
    np.testing.assert_array_equal(done.ray, np.repeat(ray, parts))
    np.testing.assert_array_equal(done.scan, np.repeat(scan, parts))
    np.testing.assert_array_equal(done.keyframe, done.scan)
    np.testing.assert_allclose(done.origins, [[0.1, -0.2]] * len(done.ray))
