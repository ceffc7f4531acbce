"""A result against true poses, relations, anchors, columns and walls, for `uwblite evaluate`."""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import se2
from ..arrays import Floats
from ..errors import ConfigError, FormatError
from ..evaluation.map import landmark_errors, landmark_errors_along, wall_errors
from ..evaluation.relations import Relations, evaluate_relations
from ..evaluation.trajectory import AnchorErrors, TrajectoryErrors, evaluate_anchors, evaluate_trajectory
from ..io.csv_table import read_csv
from ..io.map_server import read_map
from ..io.results import repair_result
from ..io.stored_result import read_result
from ..io.tum import read_relations, read_tum
from ..lidar.columns import Landmarks, find_columns
from . import error_lines

Timed = tuple[Floats, Floats, Floats, Floats]
"""Stamps (n,) s and poses (n, 3) of a result, and the true ones."""

DEFAULT_RADIUS = 0.3
"""m, of a column whose radius is not given."""
_PAUSE = 1e6
"""s between two recordings that are compared as one: more than any gap that is bridged."""


def compare(args: argparse.Namespace) -> tuple[dict[str, Any], list[str]]:
    """Return what is compared as a JSON-ready summary and as lines of text."""
    folder = Path(args.dir)
    repair_result(folder)
    summary: dict[str, Any] = {}
    lines: list[str] = []
    for name, figures, text in _comparisons(args, folder):
        if name:
            summary[name] = figures
        lines += text
    return summary, lines


def _comparisons(args: argparse.Namespace, folder: Path) -> Iterator[tuple[str, Any, list[str]]]:
    """Yield each comparison's name ("" = text alone), figures and lines."""
    first = args.recording or 1
    if args.relations:
        yield "relations", *_relations(folder, args.relations, first)
    if not args.truth:
        return
    recordings = [_recording(folder, truth, number) for number, truth in enumerate(args.truth, first)]
    together, several = _one_after_another(recordings), len(recordings) > 1
    trajectory = evaluate_trajectory(*together, max_gap=args.max_gap, rpe_delta=args.delta)
    yield "trajectory", *error_lines.of_trajectory(trajectory, len(together[2]), "together" if several else "trajectory")
    if several:
        alone = [(evaluate_trajectory(*r, max_gap=args.max_gap, rpe_delta=args.delta), len(r[2])) for r in recordings]
        shown = [error_lines.of_trajectory(*own, f"recording {k} alone") for k, own in enumerate(alone, 1)]
        yield "recordings", [figures for figures, _ in shown], [line for _, lines in shown for line in lines]
    if args.anchors:
        yield "anchors", *error_lines.of_anchors(_anchors(folder / "anchors.csv", args.anchors, trajectory.T_truth_map))
    if args.landmarks or args.walls:
        yield from _surfaces(args, folder, together, trajectory)


def _surfaces(
    args: argparse.Namespace, folder: Path, compared: Timed, trajectory: TrajectoryErrors
) -> Iterator[tuple[str, Any, list[str]]]:
    """Compare columns and walls with the map, and columns with where the trajectory draws them."""
    path, (stamps, poses, true_stamps, true_poses) = folder / "map.yaml", compared
    grid = read_map(path) if path.exists() else None
    occupied = None if grid is None else se2.transform(trajectory.T_truth_map, grid.occupied_points())
    truth, pairs = read_landmarks(args.landmarks) if args.landmarks else (None, None)
    if truth is not None:
        if grid is not None and occupied is not None:
            found = find_columns(occupied, truth, search_radius=args.search_radius, cell=grid.geometry.resolution)
            yield "landmarks", *error_lines.of_landmarks(landmark_errors(found, truth, pairs), "columns in the map")
        if trajectory.heading is not None:
            estimate = se2.interpolate_trajectory(stamps, poses, true_stamps[trajectory.matched])
            drawn = landmark_errors_along(truth, true_poses[trajectory.matched], estimate, pairs)
            figures, lines = error_lines.of_landmarks(drawn, "columns as the trajectory draws them")
            yield "landmarks_along_trajectory", figures, lines[:1]
    if args.walls and occupied is not None:
        posts = np.empty((0, 3)) if truth is None else np.column_stack([truth.positions, truth.radii])
        walls, seen_from = read_csv(args.walls).numbers("x1", "y1", "x2", "y2"), true_poses[trajectory.matched, :2]
        yield "walls", *error_lines.of_walls(wall_errors(occupied, walls, posts, seen_from, tolerance=args.tolerance))
    if occupied is None:
        yield "", None, ["no map.yaml in the folder: columns and walls are not judged"]


def _relations(folder: Path, path: str, number: int) -> error_lines.Shown:
    """Compare a recording of a result with relations."""
    result = read_result(folder)
    if number > len(result.trajectories):
        raise ConfigError(f"{folder} is a map of {len(result.trajectories)} recordings, not of {number}")
    trajectory = _in_order(*result.trajectories[number - 1])
    found = evaluate_relations(*trajectory, Relations(*read_relations(path)), result.laser_delay)
    return error_lines.of_relations(found, result.laser_delay)


def _recording(folder: Path, truth: str, number: int) -> Timed:
    """Return stamps and poses of a recording in a result, and the true ones."""
    own = folder / ("trajectory.tum" if number == 1 else f"trajectory_{number}.tum")
    if number > 1 and folder.is_dir() and not own.exists():
        raise ConfigError(f"{folder} has no {own.name}: it is a map of fewer recordings")
    return (*_in_order(*read_tum(own)), *_in_order(*read_tum(truth)))


def _one_after_another(recordings: Sequence[Timed]) -> Timed:
    """Return all recordings as one; their stamps are moved apart, for they may be of the same hour or of clocks set again."""
    if len(recordings) == 1:
        return recordings[0]
    moved: list[Timed] = []
    free = 0.0
    for stamps, poses, true_stamps, true_poses in recordings:
        begin = free - min(stamps[0], true_stamps[0])
        moved.append((stamps + begin, poses, true_stamps + begin, true_poses))
        free = max(moved[-1][0][-1], moved[-1][2][-1]) + _PAUSE
    return tuple(np.concatenate(column) for column in zip(*moved, strict=True))  # type: ignore[return-value]


def _in_order(stamps: Floats, poses: Floats) -> tuple[Floats, Floats]:
    """Return a trajectory with its stamps in order."""
    order = np.argsort(stamps, kind="stable")
    return stamps[order], poses[order]


def _anchors(path: Path, truth: str, T_truth_map: Floats) -> AnchorErrors:
    estimate, true = read_csv(path), read_csv(truth)
    places, true_places = estimate.numbers("x", "y", default=float("nan")), true.numbers("x", "y")
    return evaluate_anchors(estimate.texts("id"), places, true.texts("id"), true_places, T_truth_map)


def read_landmarks(path: str) -> tuple[Landmarks, tuple[tuple[str, str], ...] | None]:
    """Return the columns of a table, and the pairs whose distances count (None = all)."""
    table = read_csv(path)
    names, places = table.texts("name"), table.numbers("x", "y")
    radii = table.numbers("radius", default=DEFAULT_RADIUS)[:, 0]
    if not (np.isfinite(places).all() and (radii > 0).all()):
        raise FormatError("places must be numbers, and radii positive", path)
    neighbours = [text.split() for text in table.texts("neighbours", default="")]
    pairs = tuple((a, b) for a, others in zip(names, neighbours, strict=True) for b in others)
    return Landmarks(names, places, radii), pairs or None
