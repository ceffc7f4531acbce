"""Another trajectory, on the other side of a line of anchors, that the ranges fit about as well."""

from collections.abc import Iterator

from ..findings import Finding, doubt
from ..pipeline.estimate import Estimate, Task
from ..pipeline.other_minima import apart, minima


def check_other_minimum(estimate: Estimate, task: Task) -> Iterator[Finding]:
    """Doubt a map without lidar that has another optimum, which all measurements together do not exclude either."""
    graph, other = estimate.graph, estimate.other_minimum
    if task.recordings.have_scans or len(task.recordings) > 1:
        return
    known = other is not None and other.poses.shape == graph.poses.shape and other.anchors.shape == graph.anchors.shape
    starts = (graph.with_estimates_of(other),) if other is not None and known else ()
    for there in minima(graph, estimate.placed, task.config.solver, starts):
        more, off = there.chi2() - graph.chi2(), apart(there, graph)
        if more < _AS_WELL and off > _ELSEWHERE:
            text = (
                f"the ranges fit another trajectory about as well, on the other side of the line of the anchors for a time and "
                f"{off:.1f} m (rms) away (chi2 {more:+.1f}): place an anchor off that line, or give the places of the anchors"
            )
            yield doubt("other-side", text, apart=off, chi2=more)
            return


_AS_WELL, _ELSEWHERE = 4.0, 0.4
"""Difference of chi2 up to which an optimum is not excluded, two standard deviations, and rms distance, m, from which on it
matters which of two is true."""
