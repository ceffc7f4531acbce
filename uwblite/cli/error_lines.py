"""Errors of `uwblite evaluate`, each kind as a JSON-ready table and as lines of text."""

import dataclasses
import math
from typing import Any

from ..evaluation.map import LandmarkErrors, WallErrors
from ..evaluation.relations import FAR, RelationErrors
from ..evaluation.trajectory import AnchorErrors, ErrorStatistics, TrajectoryErrors

_DEGREES = math.degrees(1.0)

Shown = tuple[dict[str, Any], list[str]]


def of_trajectory(t: TrajectoryErrors, true_count: int, title: str) -> Shown:
    named = {"ate": t.ate, "heading": t.heading, "rpe_position": t.rpe_position, "rpe_heading": t.rpe_heading}
    summary = {
        "true_poses": true_count, "compared": len(t.matched), "rpe_delta": t.rpe_delta, "T_truth_map": t.T_truth_map.tolist(),
        **{name: None if errors is None else _plain(errors) for name, errors in named.items()},
    }  # fmt: skip
    lines = [f"{title:<24}{'rmse':>11}{'mean':>11}{'median':>11}{'max':>11}", _row("  position (ATE)", t.ate, "m")]
    if t.heading is not None:
        lines.append(_row("  heading", t.heading, "deg", _DEGREES))
    if t.rpe_position is not None and t.rpe_heading is not None:
        per = f"per {t.rpe_delta:g} m"
        lines.append(_row("  relative (RPE)", t.rpe_position, f"m {per}"))
        lines.append(_row("  relative heading", t.rpe_heading, f"deg {per}", _DEGREES))
    if t.heading is None:
        lines.append("  the truth has no heading: positions only")
    return summary, [*lines, f"  {len(t.matched)} of {true_count} true poses compared"]


def _row(name: str, s: ErrorStatistics, unit: str, scale: float = 1.0) -> str:
    return f"{name:<24}" + "".join(f"{scale * v:11.4f}" for v in (s.rmse, s.mean, s.median, s.max)) + f"  {unit}"


def of_relations(found: RelationErrors, laser_delay: float) -> Shown:
    count, missing = len(found.answered), int((~found.answered).sum())
    t, r = found.translations, found.rotations
    summary = {
        "count": count, "not_answered": missing, "share_far": found.far, "laser_delay": laser_delay,
        "translation": _plain(t), "rotation": _plain(r),
    }  # fmt: skip
    return summary, [
        f"{'relations':<24}{'mean':>11}{'sd':>11}{'median':>11}{'max':>11}",
        f"{'  translation':<24}{t.mean:11.4f}{t.std:11.4f}{t.median:11.4f}{t.max:11.4f}  m",
        f"{'  rotation':<24}" + "".join(f"{_DEGREES * v:11.4f}" for v in (r.mean, r.std, r.median, r.max)) + "  deg",
        f"{count} relations, {missing} not answered; {found.far:.1%} beyond {FAR:g} m or not answered; "
        f"asked at the lidar's clock {laser_delay:+.3f} s",
    ]


def of_anchors(a: AnchorErrors) -> Shown:
    errors = dict(zip(a.ids, a.distances.tolist(), strict=True))
    lines = [f"anchors: rmse {a.rmse:.3f} m over {len(a.ids)}"] if a.ids else ["anchors: none could be compared"]
    lines += [f"  {name:<8} {distance:8.3f} m" for name, distance in errors.items()]
    return {**_plain(a), "errors": errors}, lines + ([f"  without an estimate: {', '.join(a.missing)}"] if a.missing else [])


def of_landmarks(e: LandmarkErrors, title: str) -> Shown:
    rows = zip(e.pairs, e.true_distances.tolist(), e.distances.tolist(), e.errors.tolist(), strict=True)
    pairs = [{"a": a, "b": b, "true": t, "found": d, "error": x} for (a, b), t, d, x in rows]
    lines = [f"{title}: mean distance error {e.mean:.4f} m over {len(e.pairs)} pairs" if pairs else f"{title}: none found"]
    row = "  {0:<14} true {true:8.3f}   found {found:8.3f}   error {error:7.4f} m"
    lines += [row.format(f"{p['a']} - {p['b']}", **p) for p in pairs]
    lines += [f"  not found: {', '.join(e.missing)}"] if e.missing else []
    return {"mean": e.mean if pairs else None, "pairs": pairs, "missing": list(e.missing)}, lines


def of_walls(walls: WallErrors) -> Shown:
    return _plain(walls), [
        f"walls: {100 * walls.precision:.1f} % of the occupied cells lie within {walls.tolerance:g} m of a true surface, "
        f"{100 * walls.recall:.1f} % of the visible walls is drawn"
    ]


def _plain(figures: Any) -> dict[str, Any]:
    """Return the plain numbers and names of a dataclass; arrays are left out."""
    plain = {f.name: getattr(figures, f.name) for f in dataclasses.fields(figures)}
    return {k: v for k, v in plain.items() if isinstance(v, float | int | str | tuple)}
