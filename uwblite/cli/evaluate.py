"""`uwblite evaluate`: a result against true poses, relations, anchors and columns."""

import argparse
import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ConfigError, FormatError, UsageError
from ..evaluation.map import LandmarkErrors, Landmarks, find_columns, landmark_errors, landmark_errors_along
from ..evaluation.relations import FAR, RelationErrors, evaluate_relations
from ..evaluation.trajectory import (
    AnchorErrors,
    Paired,
    TrajectoryErrors,
    evaluate_anchors,
    evaluate_trajectory,
    in_order,
)
from ..io.csv_table import read_csv
from ..io.map_server import read_map
from ..io.stored_result import read_result, repair_result
from ..io.tum import read_relations, read_tum
from . import console

_DEGREES = math.degrees(1.0)
Shown = tuple[dict[str, Any], list[str]]
"""Figures ready for JSON, and lines of text."""

DEFAULT_RADIUS = 0.3
"""m, of a column whose radius is not given."""


def run(args: argparse.Namespace) -> int:
    if not args.truth and not args.relations:
        raise UsageError("give --truth, --relations, or both")
    if not args.truth and (args.anchors or args.landmarks):
        raise UsageError("--anchors and --landmarks need --truth, which lays the map over them")
    if args.recording and len(args.truth or ()) > 1:
        raise ConfigError("--recording is for a single --truth; several are of recording 1, 2, ...")
    folder = Path(args.dir)
    repair_result(folder)
    comparisons = list(_comparisons(args, folder))
    summary = {name: figures for name, figures, _ in comparisons if name}
    console.report(args.json, summary, [line for _, _, lines in comparisons for line in lines])
    return 0


def _comparisons(args: argparse.Namespace, folder: Path) -> Iterator[tuple[str, Any, list[str]]]:
    """Yield each comparison's name ("" = text alone), figures and lines."""
    first = args.recording or 1
    if args.relations:
        yield "relations", *_relations(folder, args.relations, first)
    if not args.truth:
        return
    recordings = [_paired(folder, truth, number) for number, truth in enumerate(args.truth, first)]
    together, several = Paired.one_after_another(recordings), len(recordings) > 1
    trajectory = evaluate_trajectory(*together, max_gap=args.max_gap, rpe_delta=args.delta)
    yield "trajectory", *_shown_trajectory(trajectory, len(together.true_stamps), "together" if several else "trajectory")
    if several:
        alone = [(evaluate_trajectory(*r, max_gap=args.max_gap, rpe_delta=args.delta), len(r.true_stamps)) for r in recordings]
        shown = [_shown_trajectory(*errors, f"recording {k} alone") for k, errors in enumerate(alone, 1)]
        yield "recordings", [figures for figures, _ in shown], [line for _, lines in shown for line in lines]
    if args.anchors:
        yield "anchors", *_shown_anchors(_anchors(folder / "anchors.csv", args.anchors, trajectory))
    if args.landmarks:
        yield from _columns(args, folder, together, trajectory)


def _columns(
    args: argparse.Namespace, folder: Path, paired: Paired, trajectory: TrajectoryErrors
) -> Iterator[tuple[str, Any, list[str]]]:
    """Compare columns with the map, and with where the trajectory draws them."""
    path = folder / "map.yaml"
    grid = read_map(path) if path.exists() else None
    occupied = None if grid is None else trajectory.in_truth(grid.occupied_points())
    estimate, true_poses = paired.compared(trajectory)
    truth, pairs = read_landmarks(args.landmarks)
    if grid is not None and occupied is not None:
        columns = find_columns(occupied, truth, search_radius=args.search_radius, cell=grid.geometry.resolution)
        yield "landmarks", *_shown_landmarks(landmark_errors(columns, truth, pairs), "columns in the map")
    if trajectory.heading is not None:
        drawn = landmark_errors_along(truth, true_poses, estimate, pairs)
        figures, lines = _shown_landmarks(drawn, "columns as the trajectory draws them")
        yield "landmarks_along_trajectory", figures, lines[:1]
    if occupied is None:
        yield "", None, ["no map.yaml in the folder: columns are not judged"]


def _relations(folder: Path, path: str, number: int) -> Shown:
    result = read_result(folder)
    if number > len(result.trajectories):
        raise ConfigError(f"{folder} is a map of {len(result.trajectories)} recordings, not of {number}")
    trajectory = in_order(*result.trajectories[number - 1])
    errors = evaluate_relations(*trajectory, read_relations(path), result.laser_delay)
    return _shown_relations(errors, result.laser_delay)


def _paired(folder: Path, truth: str, number: int) -> Paired:
    """Return the trajectory of a recording, counted from 1, in a folder of a result, and its truth."""
    estimate = folder / ("trajectory.tum" if number == 1 else f"trajectory_{number}.tum")
    if number > 1 and folder.is_dir() and not estimate.exists():
        raise ConfigError(f"{folder} has no {estimate.name}: it is a map of fewer recordings")
    return Paired.of(read_tum(estimate), read_tum(truth))


def _anchors(path: Path, truth: str, trajectory: TrajectoryErrors) -> AnchorErrors:
    estimate, true = read_csv(path), read_csv(truth)
    places, true_places = estimate.numbers("x", "y", default=float("nan")), true.numbers("x", "y")
    return evaluate_anchors(estimate.texts("id"), places, true.texts("id"), true_places, trajectory.T_truth_map)


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


def _shown_trajectory(t: TrajectoryErrors, true_count: int, title: str) -> Shown:
    named = {"ate": t.ate, "heading": t.heading, "rpe_position": t.rpe_position, "rpe_heading": t.rpe_heading}
    summary: dict[str, Any] = {"true_poses": true_count, "compared": len(t.matched), "rpe_delta": t.rpe_delta}
    summary |= {"T_truth_map": t.T_truth_map.tolist()}
    summary |= {name: None if errors is None else _plain(errors) for name, errors in named.items()}
    per = f"per {t.rpe_delta:g} m"
    rows = (
        ("  position (ATE)", t.ate, "m", 1.0),
        ("  heading", t.heading, "deg", _DEGREES),
        ("  relative (RPE)", t.rpe_position, f"m {per}", 1.0),
        ("  relative heading", t.rpe_heading, f"deg {per}", _DEGREES),
    )
    lines = [f"{title:<24}{'rmse':>11}{'mean':>11}{'median':>11}{'max':>11}"]
    lines += [_row(name, (s.rmse, s.mean, s.median, s.max), unit, scale) for name, s, unit, scale in rows if s is not None]
    lines += ["  the truth has no heading: positions only"] if t.heading is None else []
    return summary, [*lines, f"  {len(t.matched)} of {true_count} true poses compared"]


def _row(name: str, values: tuple[float, ...], unit: str, scale: float = 1.0) -> str:
    return f"{name:<24}" + "".join(f"{scale * value:11.4f}" for value in values) + f"  {unit}"


def _shown_relations(errors: RelationErrors, laser_delay: float) -> Shown:
    count, missing = len(errors.answered), int((~errors.answered).sum())
    t, r = errors.translations, errors.rotations
    summary: dict[str, Any] = {"count": count, "not_answered": missing, "share_far": errors.far, "laser_delay": laser_delay}
    summary |= {"translation": _plain(t), "rotation": _plain(r)}
    return summary, [
        f"{'relations':<24}{'mean':>11}{'sd':>11}{'median':>11}{'max':>11}",
        _row("  translation", (t.mean, t.std, t.median, t.max), "m"),
        _row("  rotation", (r.mean, r.std, r.median, r.max), "deg", _DEGREES),
        f"{count} relations, {missing} not answered; {errors.far:.1%} beyond {FAR:g} m or not answered; "
        f"asked at the lidar's clock {laser_delay:+.3f} s",
    ]


def _shown_anchors(a: AnchorErrors) -> Shown:
    errors = dict(zip(a.ids, a.distances.tolist(), strict=True))
    lines = [f"anchors: rmse {a.rmse:.3f} m over {len(a.ids)}"] if a.ids else ["anchors: none could be compared"]
    lines += [f"  {name:<8} {distance:8.3f} m" for name, distance in errors.items()]
    return {**_plain(a), "errors": errors}, lines + ([f"  without an estimate: {', '.join(a.missing)}"] if a.missing else [])


def _shown_landmarks(e: LandmarkErrors, title: str) -> Shown:
    rows = zip(e.pairs, e.true_distances.tolist(), e.distances.tolist(), e.errors.tolist(), strict=True)
    pairs = [{"a": a, "b": b, "true": t, "found": d, "error": x} for (a, b), t, d, x in rows]
    lines = [f"{title}: mean distance error {e.mean:.4f} m over {len(e.pairs)} pairs" if pairs else f"{title}: none found"]
    row = "  {0:<14} true {true:8.3f}   found {found:8.3f}   error {error:7.4f} m"
    lines += [row.format(f"{p['a']} - {p['b']}", **p) for p in pairs]
    lines += [f"  not found: {', '.join(e.missing)}"] if e.missing else []
    return {"mean": e.mean if pairs else None, "pairs": pairs, "missing": list(e.missing)}, lines


def _plain(figures: Any) -> dict[str, Any]:
    """Return the plain numbers and names of a dataclass; arrays are left out."""
    plain = {f.name: getattr(figures, f.name) for f in dataclasses.fields(figures)}
    return {k: v for k, v in plain.items() if isinstance(v, float | int | str | tuple)}
