"""`uwblite evaluate`: compare a result with the truth."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .options import number

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

    from ..evaluation.map import LandmarkErrors, WallErrors
    from ..evaluation.trajectory import AnchorErrors, ErrorStatistics, TrajectoryErrors
    from ..lidar.columns import Landmarks

    Timed = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
    """Stamps (n,) s and poses (n, 3) of a result, and the true ones."""

HELP = "compare a map, its trajectory and anchors with the truth"
EPILOG = """\
examples:
  uwblite evaluate map/ --truth truth.tum
  uwblite evaluate map/ --truth truth.tum --anchors truth_anchors.csv --landmarks columns.csv
  uwblite evaluate map/ --truth truth.tum --json
  uwblite evaluate map/ --relations truth.relations.gz
  uwblite evaluate both/ --truth monday.tum --truth tuesday.tum    a map of two recordings
  uwblite evaluate both/ --truth tuesday.tum --recording 2         only the second of them

The trajectory is laid over the truth by the best rigid motion, without scale; ATE and RPE are those of evo_ape -a and
evo_rpe. Several truths, in one frame, are of the recordings in their order: each is judged alone and all together, under
one motion. Columns are searched in the map; the distances between them are what is judged.

files (lengths in metres):
  --truth      stamp x y z qx qy qz qw        identity quaternions throughout = the heading is not known
  --anchors    id,x,y
  --landmarks  name,x,y,radius[,neighbours]   neighbours: names separated by blanks; only these distances are judged
  --walls      x1,y1,x2,y2
  --relations  stamp1 stamp2 x y z roll pitch yaw: the scan of stamp2 as seen from that of stamp1. Poses are asked at the
               lidar's clock, as the map found it; relations without an answer are counted and reported
"""

DEFAULT_RADIUS = 0.3
"""m, of a column whose radius is not given."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument("dir", help="folder that uwblite map wrote: trajectory.tum, anchors.csv, map.yaml")
    parser.add_argument("--truth", metavar="FILE.tum", action="append", help="true poses; one per recording")
    parser.add_argument("--relations", metavar="FILE", help="true relative poses of scans (Kuemmerle et al. 2009)")
    counted, length = number(above=0, whole=True), number(above=0)
    parser.add_argument("--recording", metavar="N", type=counted, help="the recording that a single truth is of (1)")
    parser.add_argument("--anchors", metavar="FILE.csv", help="true anchors")
    parser.add_argument("--landmarks", metavar="FILE.csv", help="true columns")
    parser.add_argument("--walls", metavar="FILE.csv", help="true walls")
    parser.add_argument("--delta", type=length, default=1.0, metavar="M", help="m of path per stretch of the RPE (1)")
    parser.add_argument("--max-gap", type=length, default=1.0, metavar="S", help="leave out truth in longer gaps, s (1)")
    parser.add_argument("--search-radius", type=length, default=1.0, metavar="M", help="m around a column's place (1)")
    parser.add_argument("--tolerance", type=length, default=0.1, metavar="M", help="m from a wall that count as on it (0.1)")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of the table")


def run(args: argparse.Namespace) -> int:
    """Carry out the verb."""
    from ..errors import ConfigError, UsageError
    from . import console

    if not args.truth and not args.relations:
        raise UsageError("give --truth, --relations, or both")
    if not args.truth and (args.anchors or args.landmarks or args.walls):
        raise UsageError("--anchors, --landmarks and --walls need --truth, which lays the map over them")
    if args.recording and len(args.truth or ()) > 1:
        raise ConfigError("--recording is for a single --truth; several are of recording 1, 2, ...")
    summary, lines = evaluate(args)
    if args.json:
        console.say_json(summary)
    else:
        for line in lines:
            console.say(line)
    return 0


def evaluate(args: argparse.Namespace) -> tuple[dict[str, Any], list[str]]:
    """Return what is compared as a JSON-ready summary and as lines of text."""
    import numpy as np

    from .. import se2
    from ..evaluation.map import landmark_errors, landmark_errors_along
    from ..evaluation.trajectory import evaluate_trajectory
    from ..io.results import repair_result
    from ..lidar.columns import find_columns

    folder = Path(args.dir)
    repair_result(folder)
    relation_figures, relation_lines = _relations(folder, args.relations, args.recording or 1) if args.relations else ({}, [])
    if not args.truth:
        return relation_figures, relation_lines
    recordings = [_recording(folder, truth, number) for number, truth in enumerate(args.truth, args.recording or 1)]
    stamps, poses, true_stamps, true_poses = _one_after_another(recordings)
    trajectory = evaluate_trajectory(stamps, poses, true_stamps, true_poses, max_gap=args.max_gap, rpe_delta=args.delta)
    summary: dict[str, Any] = {**relation_figures, "trajectory": _trajectory_summary(trajectory, len(true_stamps))}
    lines = relation_lines + _trajectory_lines(
        trajectory, len(true_stamps), "together" if len(recordings) > 1 else "trajectory"
    )
    if len(recordings) > 1:
        alone = [evaluate_trajectory(*recording, max_gap=args.max_gap, rpe_delta=args.delta) for recording in recordings]
        summary["recordings"] = [
            _trajectory_summary(own, len(recording[2])) for own, recording in zip(alone, recordings, strict=True)
        ]
        for number, (own, recording) in enumerate(zip(alone, recordings, strict=True), 1):
            lines += _trajectory_lines(own, len(recording[2]), f"recording {number} alone")
    if args.anchors:
        anchors = _anchors(folder / "anchors.csv", args.anchors, trajectory.T_truth_map)
        summary["anchors"] = {**_plain(anchors), "errors": dict(zip(anchors.ids, anchors.distances.tolist(), strict=True))}
        lines += _anchor_lines(anchors)
    judge_map = (folder / "map.yaml").exists() and (args.landmarks or args.walls)
    occupied, cell = _occupied(folder / "map.yaml", trajectory.T_truth_map) if judge_map else (None, 0.0)
    truth, pairs = read_landmarks(args.landmarks) if args.landmarks else (None, None)
    if truth is not None:
        if occupied is not None:
            found = landmark_errors(find_columns(occupied, truth, search_radius=args.search_radius, cell=cell), truth, pairs)
            summary["landmarks"] = _landmark_summary(found)
            lines += _landmark_lines(found, "columns in the map")
        if trajectory.heading is not None:
            seen = true_poses[trajectory.matched]
            estimate = se2.interpolate_trajectory(stamps, poses, true_stamps[trajectory.matched])
            drawn = landmark_errors_along(truth, seen, estimate, pairs)
            summary["landmarks_along_trajectory"] = _landmark_summary(drawn)
            lines += _landmark_lines(drawn, "columns as the trajectory draws them")[:1]
    if args.walls and occupied is not None:
        posts = np.empty((0, 3)) if truth is None else np.column_stack([truth.positions, truth.radii])
        walls = _walls(args.walls, posts, occupied, true_poses[trajectory.matched, :2], args.tolerance)
        summary["walls"] = _plain(walls)
        lines += [
            f"walls: {100 * walls.precision:.1f} % of the occupied cells lie within {walls.tolerance:g} m of a true surface, "
            f"{100 * walls.recall:.1f} % of the visible walls is drawn"
        ]
    if occupied is None and (args.landmarks or args.walls):
        lines.append("no map.yaml in the folder: columns and walls are not judged")
    return summary, lines


def _relations(folder: Path, path: str, number: int) -> tuple[dict[str, Any], list[str]]:
    """Judge a recording of a result by relations; return the figures as JSON-ready summary and as lines of text."""
    import math

    from ..errors import ConfigError
    from ..evaluation.relations import FAR, Relations, evaluate_relations
    from ..io.relations_file import read_relations
    from ..io.stored_result import read_result

    result = read_result(folder)
    if number > len(result.trajectories):
        raise ConfigError(f"{folder} is a map of {len(result.trajectories)} recordings, not of {number}")
    relations = Relations(*read_relations(path))
    found = evaluate_relations(*in_order(*result.trajectories[number - 1]), relations, result.laser_delay)
    missing = len(relations) - int(found.answered.sum())
    t, r, degrees = found.translations, found.rotations, math.degrees(1.0)
    lines = [
        f"{'relations':<24}{'mean':>11}{'sd':>11}{'median':>11}{'max':>11}",
        f"{'  translation':<24}{t.mean:11.4f}{t.std:11.4f}{t.median:11.4f}{t.max:11.4f}  m",
        f"{'  rotation':<24}" + "".join(f"{degrees * v:11.4f}" for v in (r.mean, r.std, r.median, r.max)) + "  deg",
        f"{len(relations)} relations, {missing} not answered; {found.far:.1%} beyond {FAR:g} m or not answered; "
        f"asked at the lidar's clock {result.laser_delay:+.3f} s",
    ]
    summary = {
        "count": len(relations), "not_answered": missing, "share_far": found.far, "laser_delay": result.laser_delay,
        "translation": _plain(t), "rotation": _plain(r),
    }  # fmt: skip
    return {"relations": summary}, lines


def _recording(folder: Path, truth: str, number: int) -> "Timed":
    """Return stamps and poses of a recording in a result, and the true ones."""
    from ..errors import ConfigError
    from ..io.tum import read_tum

    own = folder / ("trajectory.tum" if number == 1 else f"trajectory_{number}.tum")
    if number > 1 and folder.is_dir() and not own.exists():
        raise ConfigError(f"{folder} has no {own.name}: it is a map of fewer recordings")
    return (*in_order(*read_tum(own)), *in_order(*read_tum(truth)))


def _one_after_another(recordings: "Sequence[Timed]") -> "Timed":
    """Return all recordings as one; their stamps are moved apart, for they may be of the same hour or of clocks set again."""
    import numpy as np

    if len(recordings) == 1:
        return recordings[0]
    moved: list[Timed] = []
    free = 0.0
    for stamps, poses, true_stamps, true_poses in recordings:
        begin = free - min(stamps[0], true_stamps[0])
        moved.append((stamps + begin, poses, true_stamps + begin, true_poses))
        free = max(moved[-1][0][-1], moved[-1][2][-1]) + _PAUSE
    return tuple(np.concatenate(column) for column in zip(*moved, strict=True))  # type: ignore[return-value]


_PAUSE = 1e6
"""s between two recordings that are judged as one: more than any gap that is bridged."""


def in_order(stamps: "NDArray[np.float64]", poses: "NDArray[np.float64]") -> "tuple[NDArray[np.float64], NDArray[np.float64]]":
    """Return a trajectory with its stamps in order."""
    import numpy as np

    order = np.argsort(stamps, kind="stable")
    return stamps[order], poses[order]


def _anchors(path: Path, truth: str, T_truth_map: "NDArray[np.float64]") -> "AnchorErrors":
    from ..evaluation.trajectory import evaluate_anchors
    from ..io.csv_table import read_csv

    estimate, true = read_csv(path), read_csv(truth)
    true_places = true.numbers("x", "y")
    return evaluate_anchors(
        estimate.texts("id"), estimate.numbers("x", "y", default=float("nan")), true.texts("id"), true_places, T_truth_map
    )


def read_landmarks(path: str) -> "tuple[Landmarks, tuple[tuple[str, str], ...] | None]":
    """Return the columns of a table, and the pairs it wants judged (None = all)."""
    import numpy as np

    from ..errors import FormatError
    from ..io.csv_table import read_csv
    from ..lidar.columns import Landmarks

    table = read_csv(path)
    names = table.texts("name")
    if not (np.isfinite(table.numbers("x", "y")).all() and (table.numbers("radius", default=DEFAULT_RADIUS) > 0).all()):
        raise FormatError("places must be numbers, and radii positive", path)
    radii = table.numbers("radius", default=DEFAULT_RADIUS)[:, 0]
    neighbours = [text.split() for text in table.texts("neighbours", default="")]
    pairs = tuple((a, b) for a, others in zip(names, neighbours, strict=True) for b in others)
    return Landmarks(names, table.numbers("x", "y"), radii), pairs or None


def _occupied(path: Path, T_truth_map: "NDArray[np.float64]") -> "tuple[NDArray[np.float64], float]":
    """Return the centres of the occupied cells in the frame of the truth, and the size of a cell, m."""
    from .. import se2
    from ..io.map_server import read_map

    grid = read_map(path)
    return se2.transform(T_truth_map, grid.occupied_points()), grid.geometry.resolution


def _walls(
    path: str,
    posts: "NDArray[np.float64]",
    occupied: "NDArray[np.float64]",
    viewpoints: "NDArray[np.float64]",
    tolerance: float,
) -> "WallErrors":
    from ..evaluation.map import wall_errors
    from ..io.csv_table import read_csv

    return wall_errors(occupied, read_csv(path).numbers("x1", "y1", "x2", "y2"), posts, viewpoints, tolerance=tolerance)


def _plain(figures: Any) -> dict[str, Any]:
    """Return the plain numbers and names of a dataclass; arrays are left out."""
    import dataclasses

    plain = {f.name: getattr(figures, f.name) for f in dataclasses.fields(figures)}
    return {k: v for k, v in plain.items() if isinstance(v, float | int | str | tuple)}


def _trajectory_summary(t: "TrajectoryErrors", true_count: int) -> dict[str, Any]:
    named = {"ate": t.ate, "heading": t.heading, "rpe_position": t.rpe_position, "rpe_heading": t.rpe_heading}
    figures: dict[str, Any] = {k: None if v is None else _plain(v) for k, v in named.items()}
    return {
        "true_poses": true_count,
        "compared": len(t.matched),
        "rpe_delta": t.rpe_delta,
        "T_truth_map": t.T_truth_map.tolist(),
        **figures,
    }


def _trajectory_lines(t: "TrajectoryErrors", true_count: int, title: str = "trajectory") -> list[str]:
    import math

    def row(name: str, s: "ErrorStatistics", unit: str, scale: float = 1.0) -> str:
        numbers = "".join(f"{scale * v:11.4f}" for v in (s.rmse, s.mean, s.median, s.max))
        return f"{name:<24}{numbers}  {unit}"

    head = f"{title:<24}{'rmse':>11}{'mean':>11}{'median':>11}{'max':>11}"
    lines = [head, row("  position (ATE)", t.ate, "m")]
    if t.heading is not None:
        lines.append(row("  heading", t.heading, "deg", math.degrees(1.0)))
    if t.rpe_position is not None and t.rpe_heading is not None:
        per = f"per {t.rpe_delta:g} m"
        lines += [
            row("  relative (RPE)", t.rpe_position, f"m {per}"),
            row("  relative heading", t.rpe_heading, f"deg {per}", math.degrees(1.0)),
        ]
    if t.heading is None:
        lines.append("  the truth has no heading: positions only")
    lines.append(f"  {len(t.matched)} of {true_count} true poses compared")
    return lines


def _anchor_lines(a: "AnchorErrors") -> list[str]:
    lines = [f"anchors: rmse {a.rmse:.3f} m over {len(a.ids)}"] if a.ids else ["anchors: none could be compared"]
    lines += [f"  {name:<8} {distance:8.3f} m" for name, distance in zip(a.ids, a.distances.tolist(), strict=True)]
    return lines + ([f"  without an estimate: {', '.join(a.missing)}"] if a.missing else [])


def _landmark_summary(e: "LandmarkErrors") -> dict[str, Any]:
    rows = zip(e.pairs, e.true_distances.tolist(), e.distances.tolist(), e.errors.tolist(), strict=True)
    pairs = [{"a": a, "b": b, "true": t, "found": d, "error": x} for (a, b), t, d, x in rows]
    return {"mean": e.mean if e.pairs else None, "pairs": pairs, "missing": list(e.missing)}


def _landmark_lines(e: "LandmarkErrors", title: str) -> list[str]:
    lines = [f"{title}: mean distance error {e.mean:.4f} m over {len(e.pairs)} pairs" if e.pairs else f"{title}: none found"]
    rows = zip(e.pairs, e.true_distances.tolist(), e.distances.tolist(), e.errors.tolist(), strict=True)
    lines += [f"  {a + ' - ' + b:<14} true {t:8.3f}   found {d:8.3f}   error {x:7.4f} m" for (a, b), t, d, x in rows]
    return lines + ([f"  not found: {', '.join(e.missing)}"] if e.missing else [])
