"""Mounting of a sensor on the robot, from the transforms (tf) in a bag."""

from collections.abc import Iterable
from difflib import get_close_matches
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..arrays import Floats
from ..errors import ConfigError


class Frames:
    """A tree of frames, each known by its pose in its parent; the first transform of each frame counts."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Floats]] = {}
        self.invalid: set[str] = set()
        """Frames of which a transform was no rotation, as all zeros are none, and was left out."""

    def add(self, transforms: Iterable[Any]) -> None:
        """Take the transforms of a tf2_msgs/TFMessage."""
        for t in transforms:
            shift, turn = t.transform.translation, t.transform.rotation
            pose = np.eye(4)
            quaternion = np.array([turn.x, turn.y, turn.z, turn.w])
            pose[:3, 3] = shift.x, shift.y, shift.z
            if not (1e-6 < np.abs(quaternion).max() < 1e6 and np.isfinite(pose).all()):
                self.invalid.add(_name(t.child_frame_id))
                continue
            pose[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
            self._parents.setdefault(_name(t.child_frame_id), (_name(t.header.frame_id), pose))

    @property
    def steps(self) -> list[str]:
        """The transforms, each as parent -> child."""
        return [f"{parent} -> {child}" for child, (parent, _) in sorted(self._parents.items())]

    def check(self, frame: str) -> None:
        """Raise ConfigError where a frame is missing in the transforms; without any transform every frame is accepted."""
        names = sorted(set(self._parents) | {parent for parent, _ in self._parents.values()})
        if names and _name(frame) not in names:
            near = get_close_matches(_name(frame), names, n=1)
            hint = f"did you mean {near[0]}? " if near else ""
            raise ConfigError(f"the transforms of the bag know no frame {frame}; {hint}they know {', '.join(names)}")

    def pose(self, base: str, frame: str) -> Floats | None:
        """Return T_base_frame (4, 4), None where the frames are not connected."""
        up, down = self._to_root(base), self._to_root(frame)
        common = next((name for name in down if name in up), None)
        if common is None:
            return None
        return np.asarray(np.linalg.inv(up[common]) @ down[common], dtype=np.float64)

    def _to_root(self, frame: str) -> dict[str, Floats]:
        """Return the pose of the frame in itself and in each of its ancestors, nearest first."""
        name, pose = _name(frame), np.eye(4)
        chain = {name: pose}
        while name in self._parents and self._parents[name][0] not in chain:
            parent, step = self._parents[name]
            pose = step @ pose
            chain[parent] = pose
            name = parent
        return chain


def planar(pose: Floats) -> tuple[Floats, bool]:
    """Return x, y, theta (3,) of a pose (4, 4), and whether its z axis points down (mounted upside down)."""
    return np.array([pose[0, 3], pose[1, 3], np.arctan2(pose[1, 0], pose[0, 0])]), bool(pose[2, 2] < 0)


def _name(frame: str) -> str:
    return frame.lstrip("/")
