"""The odometry in turns: its scale, which must be one constant that no single wrong turn changes; and the point about which
the robot turns."""

from dataclasses import replace

import numpy as np

from ..graph.calibration import TURNING, with_free
from ..graph.marginals import marginals
from ..graph.solver import Optimizer
from ..odometry.wheels import turn_scales
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
            label = graph.calibration.keys[index].label
            task.stages.note("turn-scale", name=label, by_steps=found.value, sigma=found.sigma, by_all=used)
            values[index], fixed[index] = found.value, True
    return replace(estimate, graph=replace(graph.updated(graph.poses, graph.anchors, values), fixed_calibration=fixed))


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
