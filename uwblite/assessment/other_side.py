"""Another trajectory, on the other side of a line of anchors, that the ranges fit about as well."""

from collections.abc import Iterator

import numpy as np

from ..findings import Finding, doubt
from ..pipeline.estimate import Estimate, Task
from ..pipeline.line_sides import LinePolicy, sides
from ..problem.alternatives import apart


def check_other_side(estimate: Estimate, task: Task) -> Iterator[Finding]:
    """Doubt a map without lidar that has another optimum, which all measurements together do not exclude either."""
    graph, other = estimate.graph, estimate.other_side
    if task.recordings.have_scans or len(task.recordings) > 1:
        return
    known = other is not None and other.poses.shape == graph.poses.shape and other.anchors.shape == graph.anchors.shape
    further = graph.with_estimates_of(other) if other is not None and known else None
    for there in sides(graph, estimate.placed, task.config.solver, further):
        off = apart(there.graph, graph)
        if there.open and off > LinePolicy.elsewhere:
            text = (
                f"the ranges fit another trajectory about as well, on the other side of the line of the anchors for a time and "
                f"{off:.1f} m (rms) away (odds {np.exp(there.log_odds):.2g}): place an anchor off that line, or give the "
                "places of the anchors"
            )
            yield doubt("other-side", text, apart=off, log_odds=there.log_odds)
            return
