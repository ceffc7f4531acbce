"""The scale of turns of a map against that of the lidar's own steps, which no single wrong turn changes."""

from collections.abc import Iterator

from ..findings import Finding, doubt
from ..graph.pose_edges import ScanEdges
from ..odometry.turn_scale import TurnScale, turn_scales
from ..pipeline.estimate import Estimate, Task
from .decisions import shown


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
            f"{shown(found.value, found.sigma)} times as much: a turn of the map or a loop closure is wrong",
            by_steps=found.value, sigma=found.sigma, by_all=used,
        )  # fmt: skip


_WRONG = 0.1
"""Difference of the scale of turns that noise does not explain: a tenth of all turns missing or too much."""
