"""What to do while the robot still drives, the most useful first: pure rules over a recording's state and its latest map."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..io.stored_result import StoredResult

_SILENT, _PERIODS = 3.0, 5.0
"""s, and periods of it, without a message of a sensor that sent before."""
_AT_REST = 10.0
"""s after which a log that does not grow, and a sensor that never sent, is reported."""
_ANCHOR_LOST = 60.0
"""s without a range of an anchor that was in reach before."""
_VAGUE = 0.5
"""m; a sigma of an anchor or of the robot beyond which knowing more is worth the way."""
_OPEN_LOOP = 30.0
"""m driven since the last loop closure, beyond which closing the next is worth the way."""
_LISTED = 6
"""Names that a line of advice shows."""


@dataclass(frozen=True, slots=True)
class SensorState:
    """A sensor of the recording."""

    count: int
    rate: float
    """Per second over the last seconds."""
    silent: float
    """s that other sensors have sent since its last message."""


def advice(
    sensors: Mapping[str, SensorState],
    anchors: Mapping[str, float],
    recorded: float,
    at_rest: float,
    result: StoredResult | None,
) -> list[str]:
    """Return sentences in the order of their worth.

    Parameters
    ----------
    anchors : s since the last range of each anchor.
    recorded, at_rest : length of the recording, s, and s since the log has grown.
    result : the latest map.
    """
    found = _about_sensors(sensors, recorded, at_rest)
    if result is not None:
        found += _about_anchors(result) + _about_loops(result)
        found += [f"the map is doubted: {text_of(doubt)}" for doubt in result.report.get("doubts") or ()]
    gone = sorted(name for name, silent in anchors.items() if silent > _ANCHOR_LOST)
    if gone and at_rest < _AT_REST and "radio" in sensors and sensors["radio"].silent < _SILENT:
        found.append(f"no range for more than a minute: {_listed(gone)}; out of reach, or without power")
    return found


def silent_after(sensor: SensorState) -> float:
    """Return the silence of a sensor that is worth a word, s."""
    return max(_SILENT, _PERIODS / sensor.rate) if sensor.rate > 0.0 else _SILENT


def _about_sensors(sensors: Mapping[str, SensorState], recorded: float, at_rest: float) -> list[str]:
    if not sensors:
        return ["nothing is recorded yet: is the recorder running, and is this its log?"]
    if at_rest > _AT_REST:
        return [f"the log has not grown for {at_rest:.0f} s: is the recorder still running?"]
    late = sorted(((s.silent, name) for name, s in sensors.items() if s.silent > silent_after(s)), reverse=True)
    found = [f"no message from the {name} for {silent:.0f} s: check its cable and power" for silent, name in late]
    missing = [name for name in ("odometry", "lidar", "radio") if name not in sensors and recorded > _AT_REST]
    return found + [f"no message came from the {name} at all: it is not recorded, or it is silent" for name in missing]


def _about_anchors(result: StoredResult) -> list[str]:
    anchors = result.anchors
    found = [f"anchor {a.id} may be mirrored: drive a curve near it" for a in anchors if a.status == "mirror-ambiguous"]
    found += [f"anchor {a.id} has no place yet: drive around it, within its reach" for a in anchors if a.status == "unplaced"]
    placed = [a for a in anchors if np.isfinite(a.covariance).all()]
    sigmas = [(float(np.sqrt(np.linalg.eigvalsh(a.covariance)[-1])), a.id) for a in placed]
    worst = sorted((s for s in sigmas if s[0] > _VAGUE), reverse=True)
    return found + [f"anchor {name} is known to {sigma:.1f} m only: pass it on another side" for sigma, name in worst[:2]]


def _about_loops(result: StoredResult) -> list[str]:
    stamps, poses = result.trajectories[-1]
    if len(stamps) < 2 or result.grid is None:
        return []
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    own = len(result.trajectories)
    closed = [t for c in result.closures if c.accepted for t, r in zip(c.stamps, c.recordings, strict=True) if r == own]
    since = float(steps[stamps[1:] > max(closed, default=-np.inf)].sum())
    drift = float(np.sqrt(np.trace(result.keyframe_covariances[-1][:2, :2]))) if len(result.keyframe_covariances) else 0.0
    if not closed and since > _OPEN_LOOP:
        return ["come back to the start to close the loop: no place has been seen twice yet"]
    if drift > _VAGUE:
        return [f"the robot's place is known to {drift:.1f} m only: come back to a place seen before to close the loop"]
    if since > 2.0 * _OPEN_LOOP:
        return [f"no loop was closed on the last {since:.0f} m: come back to a place seen before"]
    return []


def text_of(notice: object) -> str:
    """Return the words of a doubt or warning, which may be a text or a table with a text."""
    return str(notice.get("text", "")) if isinstance(notice, dict) else str(notice)


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:_LISTED]) + (f" and {len(names) - _LISTED} more" if len(names) > _LISTED else "")
