"""Recordings, tasks and estimates of the pipeline around planted poses: what rules and stages really take."""

import numpy as np

from uwblite.constraints import Constraints
from uwblite.odometry import keyframes
from uwblite.pipeline.estimate import Estimate, Task
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.pipeline.progress import Stages
from uwblite.pipeline.recordings import Recordings, _joined
from uwblite.radio.bootstrap_attempt import BootstrapResult
from uwblite.sensor_log import LaserScans, LogNotes, Odometry, SensorLog

from .laser_walks import chained


def log_of(poses, stamps, *, lidar=False, ranges=None, **more) -> SensorLog:
    """Return a recording whose odometry is exact at poses (k, 3) and stamps (k,), with a lidar that sees a wall or without."""
    if lidar:
        more["scans"] = LaserScans(stamps, np.full((len(stamps), 3), 2.0, np.float32), -0.1, 0.1, 0.0, 0.02, 8.0)
    return SensorLog(Odometry(stamps, poses), ranges, **more)


def recordings_of(poses, stamps=None, of_keyframe=None, *, lidar=False, each=()) -> Recordings:
    """Return recordings with a keyframe at each pose (k, 3) and moment (k,), s; by default one of a pose a second.

    Parameters
    ----------
    of_keyframe : (k,) recording of each keyframe, in their order. lidar : whether they have one, or which.
    each : what further each recording has, by the names of SensorLog; `name` is that of its file.
    """
    stamps = np.arange(float(len(poses))) if stamps is None else stamps
    number = np.zeros(len(poses), dtype=np.intp) if of_keyframe is None else np.asarray(of_keyframe)
    assert np.all(np.diff(number) >= 0), "keyframes are numbered from recording to recording"
    count = max(int(number.max(initial=0)) + 1, len(each))
    have = [lidar] * count if isinstance(lidar, bool) else lidar
    logs = []
    for n in range(count):
        more = dict(each[n]) if n < len(each) else {}
        more.setdefault("notes", LogNotes(source=more.pop("name", "")))
        logs.append(log_of(poses[number == n], stamps[number == n], lidar=bool(have[n]), **more))
    frames = [keyframes.at(log, log.odometry.stamps, np.zeros(len(log.odometry.stamps), dtype=bool)) for log in logs]
    return _joined(logs, frames)


def standing(count=1, **options) -> Recordings:
    """Return so many recordings of a robot that stands for a second."""
    return recordings_of(np.zeros((2 * count, 3)), None, np.repeat(np.arange(count), 2), **options)


def task_of(recordings=None, config=None, constraints=None, *, lidar=False, stages=None) -> Task:
    """Return the task of recordings, by default of one of a robot that stands."""
    recordings = standing(lidar=lidar) if recordings is None else recordings
    return Task(recordings, config or MappingConfig(), constraints or Constraints(), stages or Stages(None, None))


def estimate_of(graph, *, placed=None, anchor_ids=None, odometry=None, ranges=None, **more) -> Estimate:
    """Return the estimate of a graph, its wheels exact; by default all anchors are placed."""
    count = len(graph.anchors)
    placed = np.ones(count, dtype=bool) if placed is None else np.asarray(placed)
    ids = tuple(f"A{k}" for k in range(len(placed))) if anchor_ids is None else tuple(anchor_ids)
    none = np.zeros(len(placed), dtype=bool)
    more.setdefault("bootstrap", BootstrapResult(graph, placed, ((),) * len(placed), none))
    odometry = chained(graph.poses, np.array([0.01, 0.01, 0.01])) if odometry is None else odometry
    return Estimate(graph, odometry, ranges, ids, **more)
