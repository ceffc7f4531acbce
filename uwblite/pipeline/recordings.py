"""One or more recordings, their keyframes in one numbering."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .. import keyframes
from ..arrays import Floats, Ints
from ..constraints import Clock
from ..errors import DataError
from ..keyframes import KeyframeConfig, Keyframes
from ..sensor_log import SensorLog

_APART = 1000.0
"""Travelled distance between the end of a recording and the begin of the next, m: never the same epoch."""


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """One recording among others."""

    number: int
    """0, 1, ..."""
    log: SensorLog
    frames: Keyframes
    first: int
    """The graph's number of its first keyframe."""

    @property
    def rows(self) -> slice:
        """Its keyframes among all."""
        return slice(self.first, self.first + len(self.frames))

    @property
    def has_scans(self) -> bool:
        """Whether it has lidar."""
        return self.log.scans is not None and len(self.log.scans.stamps) > 0

    @property
    def anchor_ids(self) -> tuple[str, ...]:
        """Names of the anchors it heard."""
        return self.log.ranges.anchor_ids if self.log.ranges is not None else ()

    def dense_trajectory(self, poses: Floats, stamps: Floats | None = None) -> Floats:
        """Return T_map_base (n, 3) at stamps (default: all of its odometry's), given the poses of all keyframes."""
        return keyframes.dense_trajectory(self.log.odometry, self.frames, poses[self.rows], stamps)

    @property
    def name(self) -> str:
        """What to call it in messages."""
        source = self.log.notes.source
        return f"recording {self.number + 1}{f' ({source})' if source else ''}"


@dataclass(frozen=True, slots=True, eq=False)
class Recordings:
    """All recordings of a map, their keyframes in one numbering."""

    each: tuple[Recording, ...]
    of_keyframe: Ints
    """(k,) recording of each keyframe."""
    stamps: Floats
    """(k,) s, each on its recording's clock."""
    path: Floats
    """(k,) travelled distance, m; recordings lie far apart."""
    twist: Floats
    """(k, 3) velocity of the base at each keyframe, own frame, m/s, m/s, rad/s."""

    def __len__(self) -> int:
        return len(self.each)

    @property
    def have_scans(self) -> bool:
        """Whether any of them has lidar."""
        return any(recording.has_scans for recording in self.each)

    @property
    def travelled(self) -> float:
        """Distance of all together, m."""
        return sum(float(recording.frames.path.sum()) for recording in self.each)

    @property
    def clock(self) -> Clock:
        """When the keyframes were."""
        return Clock(self.stamps, self.of_keyframe)


def gather(logs: Sequence[SensorLog], config: KeyframeConfig) -> Recordings:
    """Choose the keyframes of all recordings and number them through.

    Raises
    ------
    DataError : there is no recording.
    """
    if not logs:
        raise DataError("no recording to map; give one or more")
    each: list[Recording] = []
    paths: list[Floats] = []
    first, start = 0, 0.0
    for number, log in enumerate(logs):
        frames = keyframes.of(log, config)
        each.append(Recording(number, log, frames, first))
        paths.append(start + np.concatenate([[0.0], np.cumsum(frames.path)]))
        first, start = first + len(frames), float(paths[-1][-1]) + _APART
    return Recordings(
        tuple(each),
        np.repeat(np.arange(len(each)), [len(s.frames) for s in each]),
        np.concatenate([s.frames.stamps for s in each]),
        np.concatenate(paths),
        np.concatenate([s.frames.twist for s in each]),
    )
