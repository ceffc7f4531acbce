"""The scale of the wheels' turns: a calibration where it is one constant, never what a turn that went wrong makes of it."""

from dataclasses import replace

from ..graph.pose_edges import ScanEdges
from ..odometry.turn_scale import TurnScale, turn_scales
from .estimate import Estimate, Task


def with_constant_turn_scales(estimate: Estimate, task: Task) -> Estimate:
    """Fix each scale of turns at the lidar's from step to step, where the scale of the whole estimate contradicts it.

    A turn that the wheels missed, or a heading lost in a fast turn, then stays an error of its place. Where the steps ask for
    the larger correction, the estimate keeps its own, and the map is judged at the end: the lidar may be what is wrong.
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


def check_turn_scales(estimate: Estimate, task: Task) -> None:
    """Doubt a map whose scale of turns is not that of the lidar's own steps, or differs between parts of the recording."""
    for edges in estimate.graph.edges:
        if isinstance(edges, ScanEdges):
            for index, found in turn_scales(estimate.odometry, edges, estimate.graph).items():
                _judge(found, float(estimate.graph.calibration.values[index]), task)


def _judge(found: TurnScale, used: float, task: Task) -> None:
    """Say what is wrong with the scale that a map uses."""
    if found.varies:
        parts = ", ".join(f"{1.0 + value:.2f}" for value in found.stretches)
        task.stages.doubt(
            "turn-scale",
            f"the lidar turns {parts} times as much as the odometry in the four quarters of the recording: no wheels change "
            "so; the map lost its heading, or the odometry broke down",
            stretches=found.stretches.tolist(),
        )  # fmt: skip
    elif abs(used - found.value) > _WRONG and found.contradicts(used):
        task.stages.doubt(
            "turn-scale",
            f"the map multiplies the odometry's turns by {1.0 + used:.2f}, but from step to step the lidar turns "
            f"{_shown(found)} times as much: a turn is wrong in the map, or closures are",
            by_steps=found.value, sigma=found.sigma, by_all=used,
        )  # fmt: skip


def _shown(found: TurnScale) -> str:
    """Return the factor of turns with its standard deviation."""
    return f"{1.0 + found.value:.2f} \u00b1 {found.sigma:.2f}"


_WRONG = 0.1
"""Difference of the scale of turns that does not come from noise: a tenth of all turns missing or too much."""
