"""The offset of the lidar's clock: whether the recording shows one, and the same in all of its parts."""

import numpy as np

from ..arrays import Floats
from ..errors import SolverError
from ..graph.marginals import marginals
from ..graph.solver import optimize
from ..problem.alternatives import EvidencePolicy
from ..problem.evidence import log_odds_of_constant, prior_sigma, without_prior
from ..problem.solution import rough, stretch
from .estimate import Estimate, Task

TOLERANCE = 0.004
"""Offset of the lidar's clock that clouds may have, s: an odometry that is wrong by 0.3 rad/s then costs 0.07 degrees."""
_PARTS = 8
"""Parts of a recording whose offsets are compared."""
_LEAST = 20
"""Least number of keyframes in a part."""


def late(estimate: Estimate, task: Task) -> float:
    """Return by how much the lidar's clock is later than that with which the clouds were made, s; 0 where that is not shown.

    Undecided, the offset stays an unknown of the problem, with its prior.
    """
    calibration = estimate.graph.calibration
    at = calibration.index("laser_delay")
    off = calibration.get("laser_delay") - estimate.lidar.delay
    if at < 0 or estimate.graph.fixed_calibration[at] or abs(off) < TOLERANCE:
        return 0.0
    values, sigmas = _by_parts(estimate, at, task)
    prior = float(prior_sigma(estimate.graph)[at])
    return off if log_odds_of_constant(values - estimate.lidar.delay, sigmas, prior) > EvidencePolicy.positive else 0.0


def _by_parts(estimate: Estimate, at: int, task: Task) -> tuple[Floats, Floats]:
    """Return the offset (p,), s, that wheels and lidar show in parts of the recordings, and its standard deviation (p,)."""
    problem, prior = estimate.problem, float(prior_sigma(estimate.graph)[at])
    values, sigmas = [], []
    for recording in task.following(estimate).recordings.each:
        rows = np.arange(recording.rows.start, recording.rows.stop)
        for part in np.array_split(rows, max(1, min(_PARTS, len(rows) // _LEAST))):
            try:
                alone = optimize(stretch(problem, int(part[0]), int(part[-1]) + 1), rough(task.config.solver))[0]
                sigma = float(marginals(alone).covariances.calibration[at])
            except SolverError:
                continue
            values.append(float(alone.calibration.values[at]))
            sigmas.append(sigma)
    return without_prior(np.array(values), np.array(sigmas), prior)
