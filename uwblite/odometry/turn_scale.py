"""Ratio of the turns by lidar and by wheels, step by step: a scale of turns that is robust to a single wrong turn.

In least squares over all poses, a single turn that the wheels missed, or a stretch with a clock offset between lidar and
wheels, has a squared influence and changes the scale of all turns. The median over steps is not affected.
"""

from dataclasses import dataclass

import numpy as np

from .. import se2
from ..arrays import MEDIAN_TO_MEAN, Floats, Ints, spread_about_median, weighted_median
from ..graph.graph import Graph
from ..graph.pose_edges import OdometryEdges, ScanEdges

_TURNING = 0.1
"""rad; steps that turn by less, on average of lidar and wheels, do not show a ratio."""
_ENOUGH = 40
"""Least number of turning steps that show a scale."""
_STRETCHES = 4
"""Parts of a recording, equal in turning steps, whose scales are compared."""


@dataclass(frozen=True, slots=True, eq=False)
class TurnScale:
    """Relative error of the turns of one recording's wheels, measured by the lidar from step to step."""

    value: float
    """Turn by the lidar / turn by the wheels - 1, 1: what ``heading_scale`` should be."""
    sigma: float
    """Standard deviation, by the scatter of steps (correlated within a turn) and by that of the stretches, 1."""
    stretches: Floats
    """(4,) the same of each quarter of the turning steps."""
    stretch_sigma: float
    """Standard deviation of one stretch, by the scatter of steps, 1."""

    def contradicts(self, heading_scale: float) -> bool:
        """Return whether a scale from the whole estimate cannot be that of the steps."""
        return abs(heading_scale - self.value) > max(_SIGMAS * self.sigma, _ALIKE)

    @property
    def varies(self) -> bool:
        """Whether the stretches have different scales, so that it is not a constant of these wheels."""
        return bool(np.ptp(self.stretches) > max(_SIGMAS * self.stretch_sigma, _DIFFERENT))


_SIGMAS = 5.0
"""Standard deviations beyond which scales differ."""
_ALIKE = 0.05
"""Difference of scales that floors, tyres and the noise of the wheels explain."""
_DIFFERENT = 0.25
"""Difference between stretches that no floor explains."""


def turn_scales(wheels: OdometryEdges, steps: ScanEdges, graph: Graph) -> dict[int, TurnScale]:
    """Return the scale of turns by the position of its ``heading_scale`` in the calibration block.

    The ratio of two noisy turns is taken as the direction of the vector (wheels, lidar), whose weighted median over the
    steps favours neither; weights are the lengths. Recordings with fewer than 40 turning steps are left out.

    Parameters
    ----------
    wheels : edges between consecutive keyframes. steps : scan edges; those between consecutive keyframes count.
    graph : its calibration holds the drifts per metre and per second.
    """
    row, lidar = _neighbours(wheels, steps)
    drift = np.append(graph.calibration.values, 0.0)[wheels.calibration[row, 2:4]]
    turned = wheels.motion[row, 2] + drift[:, 0] * wheels.length[row] + drift[:, 1] * wheels.duration[row]
    # Wheels that count nothing at all stand still or are broken: this is no scale error.
    clear = (np.abs(turned) + np.abs(lidar) > 2.0 * _TURNING) & np.any(wheels.motion[row] != 0.0, axis=1)
    of_recording = wheels.calibration[row, 1]
    found = {}
    for index in np.unique(of_recording[clear & (of_recording >= 0)]).tolist():
        own = clear & (of_recording == index)
        if own.sum() >= _ENOUGH:
            found[index] = _scale(lidar[own], turned[own], _turns(row[own], turned[own] + lidar[own]))
    return found


def _neighbours(wheels: OdometryEdges, steps: ScanEdges) -> tuple[Ints, Floats]:
    """Return the rows (s,) of the wheels' edges that scan edges measure as well, in their order, and turns (s,), rad."""
    own = np.flatnonzero(np.abs(steps.i - steps.j) == 1)
    first = np.minimum(steps.i, steps.j)[own]
    row = np.minimum(np.searchsorted(wheels.i, first), len(wheels) - 1)
    same = wheels.i[row] == first
    turned = np.where(steps.j > steps.i, steps.T_i_j[:, 2], -steps.T_i_j[:, 2])[own]
    order = np.argsort(row[same], kind="stable")
    return row[same][order], turned[same][order]


def _turns(row: Ints, turned: Floats) -> Ints:
    """Return which turn each step (s,) belongs to: steps soon after each other that turn the same way are of one.

    Parameters
    ----------
    row : (s,) of the odometry's edges, increasing. turned : (s,) its sign is the step's way of turning.
    """
    other = (np.diff(row) > _SOON) | (np.sign(turned[1:]) != np.sign(turned[:-1]))
    return np.concatenate([[0], np.cumsum(other)])


_SOON = 4
"""Steps from one turning step to the next of the same turn."""


def _scale(lidar: Floats, wheels: Floats, turn: Ints) -> TurnScale:
    """Return the scale of turning steps (s,) in the order of time; turn : (s,) increasing number of each one's turn."""
    weight = np.hypot(lidar, wheels)
    direction = np.arctan2(lidar, wheels)
    centre = 0.25 * np.pi
    for _ in range(2):
        # Left and right turns give one direction, known up to half a turn.
        direction = centre + se2.wrap_angle(2.0 * (direction - centre)) / 2.0
        centre = weighted_median(direction, weight)
    parts = np.array_split(np.arange(len(weight)), _STRETCHES)
    centres = np.array([weighted_median(direction[p], weight[p]) for p in parts])
    steepness = 1.0 + np.tan(centre) ** 2
    count = _independent(direction - centre, weight, turn)
    by_steps = steepness * MEDIAN_TO_MEAN * spread_about_median(direction) / np.sqrt(count)
    by_stretches = steepness * float(np.std(centres, ddof=1)) / np.sqrt(_STRETCHES)
    scales = np.tan(centres) - 1.0
    return TurnScale(
        float(np.tan(centre)) - 1.0, float(max(by_steps, by_stretches)), scales, float(by_steps * np.sqrt(_STRETCHES))
    )


def _independent(error: Floats, weight: Floats, turn: Ints) -> float:
    """Return the effective number of independent steps of weighted ones (s,) whose errors are partly correlated within a turn.

    Tyres slip, and floors give way, for as long as a turn lasts. The correlation of neighbouring steps of one turn is taken
    from how often their errors have the same sign: of normal values with correlation r it is 1/2 + arcsin(r) / pi.
    """
    same = np.sign(error[1:] * error[:-1])[turn[1:] == turn[:-1]]
    alike = float(np.sin(0.5 * np.pi * np.clip(same.mean(), 0.0, 1.0))) if len(same) else 0.0
    sums, squares = np.bincount(turn, weight), np.square(weight).sum()
    return float(weight.sum() ** 2 / (squares + alike * (np.square(sums).sum() - squares)))
