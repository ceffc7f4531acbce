"""Surface that speaks for a place, and the share that matches where fewest points do: by loops over points, in corridors."""

import numpy as np
import pytest
from helpers.laser_walks import CORRIDOR, HALL, scanned

from uwblite import se2
from uwblite.lidar.cloud_rasters import rasterize
from uwblite.lidar.visibility import OverlapPolicy, directional_overlap, free_around, net_overlap, seen_beyond

GATE, SPACING = 0.15, 0.02
FIRST, SECOND = np.array([0]), np.array([1])
POSES = np.array([[0.0, 0.0, 0.7], [1.0, 0.5, 1.1]])
NICHES = np.array([[x, y, x + 0.5, y] for x, y in ((-4.0, -0.8), (-1.5, 0.8), (2.2, -0.7), (3.1, 0.8), (6.0, -0.8))])
NICHES = np.concatenate([CORRIDOR, NICHES, [[x, y, x, np.sign(y)] for x0, y, x1, _ in NICHES for x in (x0, x1)]])
"""A corridor along x with pillars at irregular places."""


@pytest.fixture(autouse=True)
def all_points(monkeypatch):
    monkeypatch.setattr(OverlapPolicy, "points", 10_000)


def net(clouds, pose, free):
    """Return the net overlap, m, of the first two clouds."""
    return SPACING * float(net_overlap(rasterize(clouds, 0.05, 0.5), free, FIRST, SECOND, np.array([pose]), GATE)[0])


def by_loops(clouds, pose, free):
    """Return the least surface of 3,600 directions, each by every point's nearest one."""
    (p, n), (q, m) = clouds.cloud(0), clouds.cloud(1)
    moved = se2.transform(pose, q), se2.rotate(np.full(len(m), pose[2]), m)
    total = np.zeros((2, 2))
    for (own, normals), (other, facing), space, frame in (
        ((p, n), moved, free[1], se2.inverse(pose)), (moved, (p, n), free[0], np.zeros(3)),
    ):  # fmt: skip
        for point, normal in zip(own, normals, strict=True):
            if not normal.any():
                continue
            distance = np.hypot(*(other - point).T)
            k = np.argmin(distance)
            good = distance[k] <= GATE and normal @ facing[k] > np.sqrt(0.5)
            seen = seen_beyond(space, se2.transform(frame, point[None]))[1][0] > 0
            total += np.outer(normal, normal) * (1.0 if good else -OverlapPolicy.against * seen)
    angle = np.linspace(0.0, np.pi, 3600)
    u = np.stack([np.cos(angle), np.sin(angle)])
    return SPACING * np.min(np.einsum("an,ab,bn->n", u, total, u))


@pytest.mark.parametrize("off", [[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.0, 0.4, 0.05]])
def test_it_is_the_least_over_all_directions(off):
    """A raster's cell is 5 cm, so points within that of the gate may count otherwise: one metre of 30 here."""
    clouds = scanned(POSES, HALL, 0.01, 1, beams=360, reach=9.0)
    pose, free = se2.between(*POSES) + off, free_around(clouds)
    assert abs(net(clouds, pose, free) - by_loops(clouds, pose, free)) < 1.0


def test_points_left_out_count_by_those_looked_up(monkeypatch):
    clouds = scanned(POSES, HALL, 0.01, 1, beams=720, reach=9.0)
    true, free = se2.between(*POSES), free_around(clouds)
    whole = net(clouds, true, free)
    monkeypatch.setattr(OverlapPolicy, "points", len(clouds.points) // 4)
    assert abs(net(clouds, true, free) - whole) < 0.15 * whole


def test_clouds_that_meet_in_part_speak_for_the_true_place_alone():
    """Two scans in a corridor share some faces of pillars; slid along it, walls match as before and pillars contradict."""
    clouds = scanned(np.array([[0.0, 0.0, 0.0], [1.5, 0.0, 0.0]]), NICHES, 0.01, 2, beams=720, reach=6.0)
    free = free_around(clouds)
    right = net(clouds, [1.5, 0.0, 0.0], free)
    assert right > 1.0  # both ways; each sees 0.3 m of the ends of three pillars that the other sees, and of some a part
    for slid in (-2.0, 0.0, 0.6, 2.4, 4.4, 6.0):
        assert net(clouds, [slid, 0.0, 0.0], free) < 0.3 * right


def test_where_free_space_is_not_asked_all_points_count_as_in_view():
    clouds = scanned(np.array([[-1.0, 0.0, 0.0], [4.0, 0.0, 0.0]]), NICHES, 0.01, 2, beams=720, reach=6.0)
    true = [5.0, 0.0, 0.0]
    assert net(clouds, true, None) < net(clouds, true, free_around(clouds))


def test_clouds_out_of_each_others_view_say_nothing():
    clouds = scanned(POSES, HALL, 0.01, 1, beams=360, reach=9.0)
    assert net(clouds, [90.0, 0.0, 0.0], free_around(clouds)) == 0.0
    assert net(clouds, [90.0, 0.0, 0.0], None) < 0.0


def test_clouds_without_any_point_say_nothing():
    assert net(scanned(np.zeros((2, 3)), HALL, reach=0.1), np.zeros(3), None) == 0.0


def test_what_other_clouds_there_are_does_not_matter():
    """One seen elsewhere in front of the pair and one behind it, a pair of which with fewer points is asked about as well."""
    pair = scanned(POSES, HALL, 0.0, beams=360, reach=9.0)
    more = scanned(np.array([[3.0, 1.0, 0.0], *POSES, [-3.0, 0.0, 1.0]]), HALL, 0.0, beams=360, reach=9.0)
    for free in (False, True):
        alone = net(pair, se2.between(*POSES), free_around(pair) if free else None)
        among = net_overlap(
            rasterize(more, 0.05, 0.5), free_around(more) if free else None, np.array([1, 0, 3]), np.array([2, 3, 0]),
            np.tile(se2.between(*POSES), (3, 1)), GATE,
        )  # fmt: skip
        assert SPACING * among[0] == pytest.approx(alone, rel=1e-9)


def share(clouds, pose):
    return float(directional_overlap(rasterize(clouds, 0.05, 0.5), FIRST, SECOND, np.array([pose]), GATE)[0])


def share_by_loops(clouds, pose):
    """Return the least share of 3,600 directions, each by every point's nearest one."""
    clouds = [clouds.cloud(0), clouds.cloud(1)]
    moved = se2.transform(pose, clouds[1][0]), se2.rotate(np.full(len(clouds[1][0]), pose[2]), clouds[1][1])
    asked, matched = np.zeros((2, 2)), np.zeros((2, 2))
    for (p, n), (q, m) in ((clouds[0], moved), (moved, clouds[0])):
        for point, normal in zip(p, n, strict=True):
            distance = np.hypot(*(q - point).T)
            k = np.argmin(distance)
            asked += np.outer(normal, normal)
            matched += np.outer(normal, normal) * (distance[k] <= GATE and normal @ m[k] > np.sqrt(0.5))
    asked += OverlapPolicy.noise * np.trace(asked) * np.eye(2)
    angle = np.linspace(0.0, np.pi, 3600)
    u = np.stack([np.cos(angle), np.sin(angle)])
    return np.min(np.einsum("an,ab,bn->n", u, matched, u) / np.einsum("an,ab,bn->n", u, asked, u))


def test_the_share_is_the_least_over_all_directions():
    """A raster's cell is 5 cm, so points within that of the gate may count otherwise; the hall has walls of both kinds."""
    poses = np.array([[0.0, 0.0, 0.7], [1.0, 0.5, 1.1]])
    clouds, true = scanned(poses, HALL, 0.01, 1, beams=720, reach=9.0), se2.between(*poses)
    for off in ([0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.0, 0.4, 0.05]):
        assert abs(share(clouds, true + off) - share_by_loops(clouds, true + off)) < 0.05


def test_the_walls_of_a_corridor_share_their_direction_however_the_robot_turned():
    """Both clouds see its two walls alone: added in one frame these face one way, and what matches across is all of it."""
    poses = np.array([[0.0, 0.0, 0.4], [1.0, 0.3, 1.6]])
    clouds, true = scanned(poses, CORRIDOR, 0.0, 1, beams=360, reach=5.0), se2.between(*poses)
    for off in (0.0, 0.1):
        pose = se2.compose(true, [0.0, 0.0, off])
        assert abs(share(clouds, pose) - share_by_loops(clouds, pose)) < 0.05


def test_walls_alone_match_in_no_place_of_a_corridor():
    """All points match, but what faces along the corridor is the noise of the normals."""
    clouds = scanned(np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]]), CORRIDOR, 0.01, 2, reach=6.0)
    assert share(clouds, np.array([2.0, 0.0, 0.0])) < 0.5
    assert share(clouds, np.array([0.5, 0.0, 0.0])) < 0.5


def test_clouds_without_any_point_match_nowhere():
    assert share(scanned(np.zeros((2, 3)), HALL, reach=0.1), np.zeros(3)) == 0.0


def test_clouds_without_common_points_share_nothing():
    clouds = scanned(np.array([[0.0, 0.0, 0.0], [1.0, 0.5, 0.4]]), HALL, 0.01, 1, beams=720, reach=9.0)
    assert share(clouds, np.array([90.0, 0.0, 0.0])) == 0.0
