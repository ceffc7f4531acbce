"""The table of a batch: what became of every recording, as CSV and as a page that leads to each result."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any
from urllib.parse import quote

from .page import document
from .printable import csv_field, escape

OUTCOMES = ("mapped", "doubted", "failed")


@dataclass(frozen=True, slots=True)
class BatchRow:
    """What became of one recording; figures are None where there is no map."""

    recording: str
    """As it was named."""
    folder: str
    """Of its result, in the folder of the batch."""
    outcome: str
    """One of OUTCOMES; a doubted map is written, but should not be trusted."""
    reason: str = ""
    """Kinds of the doubts, or the error."""
    duration: float | None = None
    """s."""
    travelled: float | None = None
    """m."""
    ranges: int | None = None
    scans: int | None = None
    anchors: int | None = None
    anchors_ok: int | None = None
    """Those with status ok."""
    closures: int | None = None
    """Accepted."""
    closure_candidates: int | None = None
    width: float | None = None
    """Of the map along x, m."""
    height: float | None = None
    """Of the map along y, m."""
    warnings: int | None = None
    seconds: float | None = None
    """Wall time of reading, mapping and writing; None where the result does not contain it."""


_COLUMNS = tuple(f.name for f in fields(BatchRow))
_HEADINGS = {
    "duration": "duration, s",
    "travelled": "travelled, m",
    "anchors_ok": "anchors ok",
    "width": "width, m",
    "closure_candidates": "candidates",
    "height": "height, m",
    "seconds": "took, s",
}


def row_of(recording: str, folder: str, report: dict[str, Any]) -> BatchRow:
    """Return the row of a result."""
    figures, grid = report["recording"], report["map"]
    cell = 0.0 if grid is None else grid["resolution"]
    return BatchRow(
        recording,
        folder,
        "mapped" if report["trusted"] else "doubted",
        ", ".join(dict.fromkeys(doubt["kind"] for doubt in report["doubts"])),
        figures["duration"],
        figures["travelled"],
        figures["ranges"],
        figures["scans"],
        len(report["anchors"]),
        sum(anchor["status"] == "ok" for anchor in report["anchors"]),
        sum(closure["accepted"] for closure in report["closures"]),
        len(report["closures"]),
        None if grid is None else grid["cols"] * cell,
        None if grid is None else grid["rows"] * cell,
        len(report["warnings"]),
        report.get("timings", {}).get("total"),
    )


def table_csv(rows: Sequence[BatchRow]) -> str:
    """Return the table as CSV: a heading, a line a recording, empty where there is no figure."""
    lines = [",".join(_COLUMNS), *(",".join(csv_field(_text(getattr(row, name))) for name in _COLUMNS) for row in rows)]
    return "\n".join(lines) + "\n"


def table_html(rows: Sequence[BatchRow], title: str) -> str:
    """Return the table as a page; a recording's name leads to its report, which must lie beside the page."""
    counts = "; ".join(f"{sum(row.outcome == outcome for row in rows)} {outcome}" for outcome in OUTCOMES)
    head = "".join(f"<th>{escape(_HEADINGS.get(name, name))}</th>" for name in _COLUMNS if name != "folder")
    body = "".join(_table_row(row) for row in rows)
    table = f"<div class=scroll><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
    name = escape(title)
    body = f"<h1>{name}</h1><p>{len(rows)} recordings: {counts}</p>{table}"
    return document(f"{name} \u2013 uwblite", body, _STYLE)


_STYLE = "body{padding:1rem}.scroll{overflow-x:auto}td,th{padding:.2rem .6rem;border-bottom:1px solid var(--line)}"
_SHADES = {"mapped": "good", "doubted": "warn", "failed": "bad"}


def _table_row(row: BatchRow) -> str:
    name = escape(row.recording)
    if row.outcome != "failed":
        name = f'<a href="{escape(quote(row.folder))}/report.html">{name}</a>'
    rest = (escape(_text(getattr(row, column))) for column in _COLUMNS[3:])
    cells = "".join(f"<td class=words>{text}</td>" if " " in text else f"<td>{text}</td>" for text in rest)
    return f"<tr><td>{name}</td><td class={_SHADES[row.outcome]}>{row.outcome}</td>{cells}</tr>"


def _text(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.2f}" if isinstance(value, float) else str(value)
