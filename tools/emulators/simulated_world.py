"""A simulated building as the world of the emulators: any lidar can look about in it. Needs numpy, as the simulator does."""

from collections.abc import Iterator

import numpy as np
from simulation import laser
from simulation.floorplans import ANCHOR_IDS
from simulation.recording import Recording

from .world import Epoch, Pose, RoomWorld

NEAR = 25.0
"""m around the robot within which walls are looked at."""
AGAIN = 1.0
"""s after which the walls near the robot are chosen again."""


class SimulatedWorld(RoomWorld):
    """What a robot measures that drives as a recording of the simulator does.

    Parameters
    ----------
    recording : truth, odometry and ranges; its own scans are not used.
    reach : m, of the lidar.
    sigma : m, of a reading.
    """

    def __init__(self, recording: Recording, reach: float = 12.0, sigma: float = 0.01) -> None:
        self.recording, self._reach, self._sigma = recording, reach, sigma
        self._random = np.random.default_rng(recording.settings.seed + 77)
        self._near: tuple[float, np.ndarray, np.ndarray] = (-np.inf, *(np.empty((0, n)) for n in (4, 3)))
        calibration = recording.calibration["laser"]
        self._mounting = np.array([calibration[name] for name in ("x", "y", "theta")])

    def poses(self) -> Iterator[Pose]:
        """Yield the odometry."""
        for time, (x, y, theta) in zip(self.recording.stamps.tolist(), self.recording.odometry.tolist(), strict=True):
            yield Pose(time, x, y, theta)

    def true_poses(self) -> Iterator[Pose]:
        """Yield where the robot really is, which a gyro measures."""
        for time, (x, y, theta) in zip(self.recording.stamps.tolist(), self.recording.truth.tolist(), strict=True):
            yield Pose(time, x, y, theta)

    def epochs(self) -> Iterator[Epoch]:
        """Yield the ranging rounds."""
        stamps, first = np.unique(self.recording.range_stamps, return_index=True)
        for time, start, end in zip(stamps.tolist(), first, [*first[1:], len(self.recording.ranges)], strict=True):
            part = slice(start, end)
            names = [int(ANCHOR_IDS[a], 16) for a in self.recording.range_anchors[part]]
            mm = [round(1000 * r) for r in self.recording.ranges[part].tolist()]
            yield Epoch(time, [(name, value, 100) for name, value in zip(names, mm, strict=True)][:4])

    def length(self) -> float:
        """Return the time of the last odometry, s."""
        return float(self.recording.stamps[-1])

    def look(self, times: list[float], bearings: list[float]) -> list[int]:
        """Return what the lidar sees at world times, mm, at bearings in turns clockwise; 0 = nothing."""
        at = np.clip(times, *self.recording.stamps[[0, -1]])
        pose = np.stack([np.interp(at, self.recording.stamps, self.recording.truth[:, k]) for k in range(3)], axis=1)
        c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
        x, y, theta = self._mounting
        origin = pose[:, :2] + np.stack([c * x - s * y, s * x + c * y], axis=1)
        walls, columns = self._things_near(float(at[0]), origin[0])
        angles = pose[:, 2] + theta - 2 * np.pi * np.asarray(bearings)
        seen = nearest(origin, angles, walls, columns)
        seen = seen + self._sigma * self._random.standard_normal(len(seen))
        return [round(1000 * r) if r < self._reach else 0 for r in seen.tolist()]

    def _things_near(self, time: float, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        since, walls, columns = self._near
        if abs(time - since) > AGAIN:
            plan = self.recording.plan
            w, c = laser.near(plan.walls, plan.columns, place, min(NEAR, self._reach + 2.0))
            walls, columns = plan.walls[w], plan.columns[c]
            self._near = time, walls, columns
        return walls, columns


def nearest(origins: np.ndarray, angles: np.ndarray, walls: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the distance (n,) at which rays end, inf = nowhere: `laser.cast` for a few rays, with all walls at once.

    Parameters
    ----------
    origins, angles : (n, 2) and (n,) of the rays. walls, columns : (w, 4) and (c, 3), as in `laser.cast`.
    """
    (dx, dy), (ox, oy) = (np.stack([np.cos(angles), np.sin(angles)])[:, :, None], origins.T[:, :, None])
    ex, ey = walls[:, 2] - walls[:, 0], walls[:, 3] - walls[:, 1]
    ax, ay = walls[:, 0] - ox, walls[:, 1] - oy
    with np.errstate(divide="ignore", invalid="ignore"):
        cross = dx * ey - dy * ex
        t, u = (ax * ey - ay * ex) / cross, (ax * dy - ay * dx) / cross
    ends = np.where((t > 0.0) & (u >= 0.0) & (u <= 1.0), t, np.inf)
    bx, by = columns[:, 0] - ox, columns[:, 1] - oy
    depth2 = columns[:, 2] ** 2 - (bx * dy - by * dx) ** 2
    t = bx * dx + by * dy - np.sqrt(np.maximum(depth2, 0.0))
    round_ends = np.where((depth2 > 0.0) & (t > 0.0), t, np.inf)
    return np.minimum(ends.min(axis=1, initial=np.inf), round_ends.min(axis=1, initial=np.inf))
