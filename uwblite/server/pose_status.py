"""Content of the page of a robot that is being localised."""

import math
from collections import deque
from typing import Any, ClassVar

import numpy as np

from ..localization.live_feed import CONSEQUENCES
from ..localization.pose_estimator import LocalizerState

_EVERY = 0.2
"""s between states that are shown."""
_TRAIL = 300
"""Points of the way that is shown: the last minute."""
_MOST_ALTERNATIVES = 8


class PoseStatus:
    """Thins the states out, and remembers the way."""

    nothing: ClassVar[dict[str, Any]] = {
        "pose": None,
        "summary": "no data yet",
        "advice": ["the pose is not known: nothing has come in yet; is the recorder running, and is this its log?"],
    }
    """What there is to show before the first state."""

    def __init__(self) -> None:
        self._trail: deque[list[float]] = deque(maxlen=_TRAIL)
        self._shown = -math.inf

    def take(self, state: LocalizerState) -> dict[str, Any] | None:
        """Return what there is to show of a state; None where the last one will do."""
        if 0.0 <= state.stamp - self._shown < _EVERY and not state.age:
            return None
        self._shown = state.stamp
        known = bool(np.isfinite(state.pose).all())
        if state.lost:
            self._trail.clear()
        elif known:
            self._trail.append(state.pose[:2].round(2).tolist())
        sigma = np.sqrt(np.diag(state.covariance))
        place = f", known to {math.hypot(sigma[0], sigma[1]):.2f} m" if np.isfinite(sigma).all() and not state.lost else ""
        advice = []
        if state.age:
            advice.append(f"the pose is {state.age:.0f} s old: no data; is the recorder still running?")
        else:
            if state.lost:
                advice.append(f"the pose is not known: {state.reason or 'drive on, past walls and anchors'}")
            advice += [f"nothing from {name} for {age:.0f} s: {CONSEQUENCES[name]}" for name, age in state.silent.items()]
        age = f"{state.age:.0f} s old, " if state.age else ""
        moved = "has been moved since the map was made, or its line of sight is blocked"
        advice += [f"anchor {name} {moved}" for name in state.moved_anchors]
        return {
            "summary": f"t = {state.stamp:.1f} s, {age}quality {state.quality:.2f}{place}",
            "advice": advice,
            "late": state.lost and state.age > 0.0,
            "fine": "The pose is known.",
            "pose": state.pose.round(3).tolist() if known else None,
            "covariance": state.covariance[:2, :2].tolist() if known and np.isfinite(state.covariance).all() else None,
            "alternatives": state.alternatives[:_MOST_ALTERNATIVES].round(2).tolist(),
            "lost": state.lost,
            "trail": list(self._trail),
        }
