"""Recordings among others: their keyframes in one numbering, and what is known of one or of several."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from .. import keyframes, se2
from ..arrays import Floats, Ints
from ..constraints import Clock
from ..errors import DataError
from ..graph.graph import Edges, Graph
from ..graph.pose_edges import OdometryEdges
from ..graph.range_edges import RangeEdges
from ..keyframes import KeyframeConfig, Keyframes
from ..radio.bootstrap import BootstrapResult
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


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """What is known of one recording, or of several joined: estimates and measurements."""

    graph: Graph
    """Estimates and calibration priors."""
    wheels: OdometryEdges
    radio: RangeEdges | None
    first: BootstrapResult | None
    """None without ranges."""
    anchor_ids: tuple[str, ...]
    """(a,) of the graph's anchors."""

    @property
    def edges(self) -> tuple[Edges, ...]:
        """Wheels, and ranges where there are any."""
        return (self.wheels,) if self.radio is None else (self.wheels, self.radio)


@dataclass(frozen=True, slots=True, eq=False)
class JoinResult:
    """All recordings in the frame of the first."""

    estimate: Estimate
    warnings: tuple[str, ...]
    """Anchors that were moved, in words."""


def moved_hypotheses(first: BootstrapResult | None, motion: Floats) -> BootstrapResult | None:
    """Return the first estimate, where there is one, with its places of anchors in a frame moved by T_new_old."""
    if first is None:
        return None
    moved = tuple(tuple(replace(h, position=se2.transform(motion, h.position)) for h in found) for found in first.hypotheses)
    return replace(first, hypotheses=moved)


def numbered(name: str, recording: int) -> str:
    """Return what an anchor is called that stands elsewhere in a recording than before."""
    return f"{name}#{recording + 1}"


def moved_anchor_text(name: str, distance: float, recording: int, own: str) -> str:
    """Return what to tell of a moved anchor."""
    return f"anchor {name} was moved: in recording {recording + 1} it stands {distance:.2f} m away, and is called {own}"
