"""Points between the beams of a coarse lidar: on walls, and only there."""

from dataclasses import replace

import numpy as np
import pytest

from uwblite import se2
from uwblite.lidar.beam_gaps import filled
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
