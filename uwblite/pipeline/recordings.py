"""One or more recordings: the part of each that is used, and their keyframes in one numbering.

A map uses the scans nearest to each keyframe, and traces one whenever the laser has moved far enough. In the recording of a
slow robot that is about every fifth scan.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from .. import se2
from ..arrays import ENOUGH, Bools, Floats, Ints, evenly, require_type
from ..constraints import Clock, Constraints
from ..errors import DataError
from ..grid.occupancy_grid import GridConfig
from ..grid.tracing import moved_scans
from ..odometry import keyframes
from ..odometry.attached import choose_scans
from ..odometry.keyframes import KeyframeConfig, Keyframes
from ..screening.screen import screen
from ..sensor_log import SensorLog
from .mapping_config import MappingConfig


class RecordingPolicy:
    """How recordings are told apart, and which scans a map needs."""

    apart: float = 1000.0
    """m of travel assumed between the end of a recording and the start of the next: they are different visits."""
    sparse: float = 0.11
    """s between samples of an odometry slower than 10 Hz, which interpolation does not bridge well."""
    same_moment: float = 1e-6
    """s; difference of stamps that is rounding."""
    scans_per_move: int = 2
    """Scans kept within the distance after which the grid traces the next one: odometry does not know that distance exactly."""


@dataclass(frozen=True, slots=True, eq=False)
class PosesBetween:
    """Poses at keyframes and at scans between them."""

    frames: Keyframes
    """At all of these moments (n)."""
    keyframe: Ints
    """(n,) keyframe of the recording from which each pose is seen, counted from its first."""
    since: Floats
    """(n, 3) T_keyframe_base; m, m, rad."""


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """One recording among others."""

    number: int
    """0, 1, ..."""
    log: SensorLog
    frames: Keyframes
    first: int
    """The graph's number of its first keyframe."""
    between: PosesBetween | None = None
    """None where the odometry alone tells the way from keyframe to keyframe."""

    @property
    def rows(self) -> slice:
        """Its keyframes among all."""
        return slice(self.first, self.first + len(self.frames))

    def has(self, keyframe: Ints) -> Bools:
        """Return which keyframes (m,) are its own."""
        return (keyframe >= self.rows.start) & (keyframe < self.rows.stop)

    @property
    def has_scans(self) -> bool:
        """Whether it has lidar."""
        return self.log.scans is not None and len(self.log.scans.stamps) > 0

    @property
    def anchor_ids(self) -> tuple[str, ...]:
        """Names of the anchors to which it has ranges."""
        return self.log.ranges.anchor_ids if self.log.ranges is not None else ()

    @property
    def trajectory_stamps(self) -> Floats:
        """(n,) s of its odometry, and of keyframes and scans where its samples are too far apart to interpolate between."""
        stamps, own = self.log.odometry.stamps, (self.between or self).frames.stamps
        after = np.searchsorted(stamps, own)
        inside = (after > 0) & (after < len(stamps))
        gap = np.diff(stamps)[after[inside] - 1] if inside.any() else np.zeros(0)
        return np.union1d(stamps, own[inside][gap > RecordingPolicy.sparse]) if (gap > RecordingPolicy.sparse).any() else stamps

    def dense_trajectory(self, poses: Floats, stamps: Floats | None = None) -> Floats:
        """Return T_map_base (n, 3) at stamps (default: all of its odometry's), given the poses of all keyframes."""
        frames, own = self.frames, poses[self.rows]
        if self.between is not None:
            frames, own = self.between.frames, se2.compose(own[self.between.keyframe], self.between.since)
        return keyframes.dense_trajectory(self.log.odometry, frames, own, stamps)

    def with_poses_between(self, stamps: Floats, keyframe: Ints, since: Floats) -> "Recording":
        """Return the recording with poses (m, 3) at further stamps (m,), seen from its keyframes (m,)."""
        own = np.arange(len(self.frames))
        moments = np.concatenate([self.frames.stamps, stamps])
        order = np.argsort(moments, kind="stable")
        frames = keyframes.at(self.log, moments[order], np.ones(len(order), dtype=bool))
        keyframe = np.concatenate([own, keyframe])[order]
        since = np.concatenate([np.zeros((len(own), *se2.POSE)), since])[order]
        return replace(self, between=PosesBetween(frames, keyframe, since))

    @property
    def name(self) -> str:
        """Name of the recording in messages."""
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
        """Times of the keyframes."""
        return Clock(self.stamps, self.of_keyframe)


def gather(logs: Sequence[SensorLog], config: KeyframeConfig) -> Recordings:
    """Choose the keyframes of recordings and number them through."""
    return _joined(logs, [keyframes.of(log, config) for log in logs])


def require_types(logs: object, config: object, constraints: object) -> None:
    """Raise DataError where what is to be mapped, or how, is of another type, or there is no recording."""
    several = logs if isinstance(logs, Sequence) and not isinstance(logs, str) else None
    for k, log in enumerate([logs] if several is None else several):
        require_type(log, "logs" if several is None else f"logs[{k}]", SensorLog)
    if several is not None and not several:
        raise DataError("there is no recording to map: logs is empty")
    if config is not None:
        require_type(config, "config", MappingConfig)
    if constraints is not None:
        require_type(constraints, "constraints", Constraints)


def check_distinct(logs: Sequence[SensorLog]) -> None:
    """Refuse recordings of which two have the same measurements.

    Raises
    ------
    DataError : two are copies or parts of one log that overlap.
    """
    for (n, one), (m, other) in combinations(enumerate(logs), 2):
        if _alike(one, other):
            raise DataError(
                f"recordings {n + 1} ({one.notes.source}) and {m + 1} ({other.notes.source}) are of one log, in part or "
                "as a whole: measurements would count twice; give each recording once"
            )


def _alike(one: SensorLog, other: SensorLog) -> bool:
    """Return whether two recordings have the same odometry at the same moments, of a robot that moves."""
    a, b = one.odometry, other.odometry
    _, i, j = np.intersect1d(a.stamps, b.stamps, return_indices=True)
    same = np.all(a.poses[i] == b.poses[j], axis=1)
    moving = np.any(a.poses[i] != a.poses[np.maximum(i - 1, 0)], axis=1)
    return int(np.sum(same & moving)) > ENOUGH


def later(recordings: Recordings, shift: float) -> Recordings:
    """Return the recordings with all keyframes of those with lidar later by a shift, s: the further delay of its clock."""
    shifts = [shift if s.has_scans else 0.0 for s in recordings.each]
    frames = [keyframes.at(s.log, s.frames.stamps + t, s.frames.alone) for s, t in zip(recordings.each, shifts, strict=True)]
    return _joined([s.log for s in recordings.each], frames)


def with_longer_scans(recordings: Recordings, longer: Floats) -> Recordings:
    """Return the recordings whose scans each take longer by so much (r,), s, about the same middles."""
    each = tuple(replace(r, log=r.log.with_longer_scans(d)) for r, d in zip(recordings.each, longer.tolist(), strict=True))
    return replace(recordings, each=each)


def denser(recordings: Recordings, steps: Ints, most: int, delay: float = 0.0) -> Recordings:
    """Return the recordings with the scans inside some steps as keyframes, too; clouds there are of single scans.

    Parameters
    ----------
    steps : (s,) keyframes at which the steps begin. most : keyframes added to one step. delay : of the lidar's clock, s.
    """
    frames = []
    for recording in recordings.each:
        stamps, log = recording.frames.stamps, recording.log
        starts = steps[(steps >= recording.first) & (steps < recording.first + len(stamps) - 1)] - recording.first
        scans = np.zeros(0) if log.scans is None else log.scans.middles + delay
        added = [_spread(scans, stamps[k], stamps[k + 1], most) for k in starts.tolist()]
        moments = np.union1d(stamps, np.concatenate([np.zeros(0), *added]))
        alone = np.isin(moments, np.concatenate([stamps[starts], stamps[starts + 1], *added]))
        frames.append(keyframes.at(log, moments, alone))
    return _joined([s.log for s in recordings.each], frames)


def _spread(stamps: Floats, begin: float, end: float, most: int) -> Floats:
    """Return the stamps strictly between two others; an even selection where they are too many."""
    first, last = np.searchsorted(stamps, (begin + RecordingPolicy.same_moment, end - RecordingPolicy.same_moment))
    within = stamps[first:last]
    return within if len(within) <= most else within[evenly(len(within), most + 2)[1:-1]]


def _joined(logs: Sequence[SensorLog], frames: Sequence[Keyframes]) -> Recordings:
    """Number keyframes of all recordings through."""
    each: list[Recording] = []
    paths: list[Floats] = []
    first, start = 0, 0.0
    for number, (log, keyframes_of) in enumerate(zip(logs, frames, strict=True)):
        each.append(Recording(number, log, keyframes_of, first))
        paths.append(start + np.concatenate([[0.0], np.cumsum(keyframes_of.path)]))
        first, start = first + len(keyframes_of), float(paths[-1][-1]) + RecordingPolicy.apart
    return Recordings(
        tuple(each),
        np.repeat(np.arange(len(each)), [len(s.frames) for s in each]),
        np.concatenate([s.frames.stamps for s in each]),
        np.concatenate(paths),
        np.concatenate([s.frames.twist for s in each]),
    )


def prepared(log: SensorLog, config: MappingConfig) -> SensorLog:
    """Return a recording screened, with the sensors in use and only the scans that a map needs.

    From one that was screened before, only unused sensors are removed.
    """
    log = log.without(uwb=not config.use_uwb, lidar=not config.use_lidar)
    if log.screening is not None:
        return log
    return thinned(screen(log, config.detect_laser_flip), config.keyframes, config.grid)


def thinned(log: SensorLog, frames: KeyframeConfig, grid: GridConfig) -> SensorLog:
    """Return the recording with the scans that a map of it may need; the notes count the others.

    Thinning the result again changes nothing. ``grid.move_distance = 0`` keeps all.
    """
    scans = log.scans
    if scans is None or not len(scans.stamps) or grid.move_distance <= 0.0:
        return log
    _, near = choose_scans(scans, keyframes.of(log, frames), frames)
    base = log.odometry.at(scans.stamps)
    laser = se2.compose(base, log.mounting.T_base_laser)
    traced = moved_scans(
        laser, grid.move_distance / RecordingPolicy.scans_per_move, grid.move_angle / RecordingPolicy.scans_per_move
    )
    kept = np.union1d(near, traced)
    if len(kept) == len(scans.stamps):
        return log
    left_out = log.notes.scans_left_out + len(scans.stamps) - len(kept)
    return replace(log, scans=scans.rows(kept), notes=replace(log.notes, scans_left_out=left_out))
