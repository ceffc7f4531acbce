"""How well a map knows the shape of the path: by its covariances, and by another optimum across a line of anchors."""

from collections.abc import Iterator

import numpy as np

from ..findings import Finding, doubt
from ..pipeline.estimate import Estimate, Task
from ..pipeline.range_alternatives import RangePolicy, sides
from ..problem.alternatives import apart


def check_certainty(estimate: Estimate, sigma: float, task: Task) -> Iterator[Finding]:
    """Doubt a map whose own uncertainties are so large that its shape is not known well.

    Parameters
    ----------
    sigma : m, rms of the places' expected errors after alignment, the unit of length apart.
    """
    if sigma > allowed_error(estimate):
        extent = _extent(estimate)
        text = (
            f"the shape of the path is known to {sigma:.1f} m (rms) only, in an area {extent:.0f} m across: too few ranges and "
            "scans constrain the trajectory; add anchors, or drive where the lidar sees walls"
        )
        yield doubt("uncertain", text, sigma=sigma, extent=extent)


def allowed_error(estimate: Estimate) -> float:
    """Return the expected error of places, m, above which a map is doubted.

    Ranges hold every place to the same error; without, that of a chain of steps grows with the root of its length.
    """
    extent, room = _extent(estimate), _UNCERTAIN / _UNCERTAIN_SHARE
    larger = np.sqrt(max(extent / room, 1.0)) if estimate.ranges is None else 1.0
    return min(_UNCERTAIN * larger, _UNCERTAIN_SHARE * extent)


def _extent(estimate: Estimate) -> float:
    """Return the diagonal of the area that the path covers, m."""
    return float(np.hypot(*np.ptp(estimate.graph.poses[:, :2], axis=0)))


_UNCERTAIN, _UNCERTAIN_SHARE = 0.4, 0.05
"""Expected error of places, m and as a share of the area's diameter. Of maps at this limit one in five is off by more than
half a metre; rooms mapped by odometry and ranges have 0.08 to 0.15 m."""


def check_other_side(estimate: Estimate, task: Task) -> Iterator[Finding]:
    """Doubt a map without lidar that has another optimum, which all measurements together do not exclude either."""
    graph, other = estimate.graph, estimate.other_side
    if task.recordings.have_scans or len(task.recordings) > 1:
        return
    known = other is not None and other.poses.shape == graph.poses.shape and other.anchors.shape == graph.anchors.shape
    further = graph.with_estimates_of(other) if other is not None and known else None
    for there in sides(graph, estimate.placed, task.config.solver, further):
        off = apart(there.graph, graph)
        if there.open and off > RangePolicy.elsewhere:
            text = (
                f"the ranges fit another trajectory about as well, on the other side of the line of the anchors for a time and "
                f"{off:.1f} m (rms) away (odds {np.exp(there.log_odds):.2g}): place an anchor off that line, or give the "
                "places of the anchors"
            )
            yield doubt("other-side", text, apart=off, log_odds=there.log_odds)
            return
