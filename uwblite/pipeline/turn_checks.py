"""The odometry in turns: its scale, which must be one constant that no single wrong turn changes; and the point about which
the robot turns."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ..findings import Finding, doubt
from ..graph.calibration import TURNING, with_free
from ..graph.marginals import marginals
from ..graph.optimizer import Optimizer
from ..graph.pose_edges import ScanEdges
from ..odometry.turn_scale import TurnScale, turn_scales
from ..problem.evidence import prior_sigma, with_prior_sigma
from .estimate import Estimate, Task


def with_constant_turn_scales(estimate: Estimate, task: Task) -> Estimate:
    """Fix each scale of turns at the lidar's from step to step, where the scale of the whole estimate contradicts it.

    A turn that the wheels missed, or a heading lost in a fast turn, then stays a local error. Where the scale of the steps is
    the larger correction, the estimate keeps its own, and the map is checked at the end: the lidar may be wrong.
    """
    graph = estimate.graph
    if estimate.steps is None:
        return estimate
    values, fixed = graph.calibration.values.copy(), graph.fixed_calibration.copy()
    for index, found in turn_scales(estimate.odometry, estimate.steps, graph).items():
        if fixed[index]:
            values[index] = found.value
        elif found.contradicts(used := float(values[index])) and abs(found.value) < abs(used):
            task.stages.warn(
                "turn-scale",
                f"from step to step the lidar turns {_shown(found)} times as much as the odometry, but the whole fits best "
                f"with {1.0 + used:.2f}: single turns of the odometry are wrong; the steps' scale is used",
                name=graph.calibration.keys[index].label, by_steps=found.value, sigma=found.sigma, by_all=used,
            )  # fmt: skip
            values[index], fixed[index] = found.value, True
    return replace(estimate, graph=replace(graph.updated(graph.poses, graph.anchors, values), fixed_calibration=fixed))


def check_turn_scales(estimate: Estimate, task: Task) -> Iterator[Finding]:
    """Doubt a map whose scale of turns is not that of the lidar's own steps, or differs between parts of the recording."""
    for edges in estimate.graph.edges:
        if isinstance(edges, ScanEdges):
            for index, found in turn_scales(estimate.odometry, edges, estimate.graph).items():
                yield from _judge(found, float(estimate.graph.calibration.values[index]), task)


def _judge(found: TurnScale, used: float, task: Task) -> Iterator[Finding]:
    """Return the text about what is wrong with the scale that a map uses."""
    if found.varies:
        parts = ", ".join(f"{1.0 + value:.2f}" for value in found.stretches)
        yield doubt(
            "turn-scale",
            f"the lidar turns {parts} times as much as the odometry in the four quarters of the recording: no calibration "
            "changes so; the map's heading is wrong, or the odometry failed",
            stretches=found.stretches.tolist(),
        )  # fmt: skip
    elif abs(used - found.value) > _WRONG and found.contradicts(used):
        yield doubt(
            "turn-scale",
            f"the map multiplies the odometry's turns by {1.0 + used:.2f}, but from step to step the lidar turns "
            f"{_shown(found)} times as much: a turn of the map or a loop closure is wrong",
            by_steps=found.value, sigma=found.sigma, by_all=used,
        )  # fmt: skip


def _shown(found: TurnScale) -> str:
    """Return the factor of turns with its standard deviation."""
    return f"{1.0 + found.value:.2f} \u00b1 {found.sigma:.2f}"


_WRONG = 0.1
"""Difference of the scale of turns that noise does not explain: a tenth of all turns missing or too much."""


def with_slip_in_turns(estimate: Estimate, task: Task) -> Estimate:
    """Let the robot turn about another point than the base's origin, where the lidar seems to be mounted off its place.

    Wheels that slip in turns (skid steering) have exactly the same residuals as a lidar mounted elsewhere: a base whose origin
    is shifted has the same scans and the same wheels. So the offset h that the lidar has without slip is split by the prior
    probabilities: p that the robot slips, 1 - p that the lidar's given mounting is wrong. Priors N(0, p h^2) of the slip
    and N(0, (1 - p) h^2) of the mounting give mean p h and variance p (1 - p) h^2, those of the two alternatives. Where no
    mounting is given, the base's origin is the point about which it turns.
    """
    graph, config = estimate.graph, task.config.calibration
    at, slips = graph.calibration.index("laser_x"), graph.calibration.of_kinds(TURNING)
    offset = graph.calibration.get("laser_x")
    given = all(np.any(r.log.mounting.T_base_laser != 0.0) for r in task.recordings.each if r.has_scans)
    if not given or not slips.any() or abs(offset) < _SMALL or graph.fixed_calibration[at]:
        return estimate
    if abs(offset) < _SIGNIFICANT * marginals(estimate.problem).covariances.calibration[at]:
        return estimate
    widths = (config.sideways_per_turn, min(_BY_TAPE, config.laser_offset), config.laser_offset)
    slip, right, other = (np.exp(-0.5 * (offset / width) ** 2) / width for width in widths)
    share = float(_SLIPS * slip / max(_SLIPS * slip + (1.0 - _WRONG_FRAME) * right + _WRONG_FRAME * other, _NEVER))
    sigma = prior_sigma(graph)
    sigma[slips] = max(abs(offset) * np.sqrt(share), _SMALL)
    sigma[at] = max(abs(offset) * np.sqrt(1.0 - share), _SMALL)
    estimate = replace(estimate, graph=with_free(with_prior_sigma(graph, sigma), TURNING))
    return estimate.with_estimates_of(Optimizer().optimize(estimate.problem, task.config.solver)[0])


_SMALL = 0.01
"""m; a mounting, or the origin of a base, is not known better than this."""
_BY_TAPE = 0.03
"""Standard deviation of a mounting that is given and right, m."""
_SIGNIFICANT = 3.0
"""Standard deviations from which an offset of the lidar is significant."""
_WRONG_FRAME = 0.1
"""Share of given mountings that belong to another robot or frame, and are off by the setting `laser_offset`."""
_NEVER = 1e-300
"""Probability density of an offset without a known cause; it is then assigned to the mounting."""
_SLIPS = 0.5
"""Prior odds of a robot that slips in turns against one that does not."""
