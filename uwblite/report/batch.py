"""The table of a batch: what became of every recording, as CSV and as a page that leads to each result."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import quote

from .page import document
from .printable import csv_field, escape

OUTCOMES = {"mapped": "good", "doubted": "warn", "failed": "bad"}
"""What may become of a recording, and its shade; a doubted map is written, but should not be trusted."""
_COLUMNS = {
    "duration": "duration, s",
    "travelled": "travelled, m",
    "ranges": "ranges",
    "scans": "scans",
    "anchors": "anchors",
    "anchors_ok": "anchors ok",
    "closures": "closures",
    "closure_candidates": "candidates",
    "width": "width, m",
    "height": "height, m",
    "warnings": "warnings",
    "seconds": "took, s",
}
"""Figures of a row, and their headings; anchors_ok have the status ok, closures are accepted, seconds are wall time."""
_STYLE = "body{padding:1rem}.scroll{overflow-x:auto}td,th{padding:.2rem .6rem;border-bottom:1px solid var(--line)}"


@dataclass(frozen=True, slots=True)
class BatchRow:
    """What became of one recording."""

    recording: str
    """As it was named."""
    folder: str
    """Of its result, in the folder of the batch."""
    outcome: str
    """One of OUTCOMES."""
    reason: str = ""
    """Kinds of the doubts, or the error."""
    figures: dict[str, float | None] = field(default_factory=lambda: dict.fromkeys(_COLUMNS))
    """By column; None where there is no map, or the result does not contain it."""

    def plain(self) -> dict[str, Any]:
        """Return the row by columns."""
        row = {"recording": self.recording, "folder": self.folder, "outcome": self.outcome, "reason": self.reason}
        return row | self.figures


def row_of(recording: str, folder: str, report: dict[str, Any]) -> BatchRow:
    """Return the row of a result."""
    grid, anchors, closures = report["map"], report["anchors"], report["closures"]
    figures = {name: report["recording"][name] for name in ("duration", "travelled", "ranges", "scans")} | {
        "anchors": len(anchors),
        "anchors_ok": sum(anchor["status"] == "ok" for anchor in anchors),
        "closures": sum(closure["accepted"] for closure in closures),
        "closure_candidates": len(closures),
        "width": None if grid is None else grid["cols"] * grid["resolution"],
        "height": None if grid is None else grid["rows"] * grid["resolution"],
        "warnings": len(report["warnings"]),
        "seconds": report.get("timings", {}).get("total"),
    }
    reason = ", ".join(dict.fromkeys(doubt["kind"] for doubt in report["doubts"]))
    return BatchRow(recording, folder, "mapped" if report["trusted"] else "doubted", reason, figures)


def table_csv(rows: Sequence[BatchRow]) -> str:
    """Return the table as CSV: a heading, a line a recording, empty where there is no figure."""
    lines = [",".join(BatchRow("", "", "").plain())]
    lines += [",".join(csv_field(_text(value)) for value in row.plain().values()) for row in rows]
    return "\n".join(lines) + "\n"


def table_html(rows: Sequence[BatchRow], title: str) -> str:
    """Return the table as a page; a recording's name leads to its report, which must lie beside the page."""
    counts = "; ".join(f"{sum(row.outcome == outcome for row in rows)} {outcome}" for outcome in OUTCOMES)
    head = "".join(f"<th>{name}</th>" for name in ("recording", "outcome", "reason", *_COLUMNS.values()))
    table = f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(map(_table_row, rows))}</tbody></table>"
    name = escape(title)
    body = f"<h1>{name}</h1><p>{len(rows)} recordings: {counts}</p><div class=scroll>{table}</div>"
    return document(f"{name} \u2013 uwblite", body, _STYLE)


def _table_row(row: BatchRow) -> str:
    name = escape(row.recording)
    if row.outcome != "failed":
        name = f'<a href="{escape(quote(row.folder))}/report.html">{name}</a>'
    cells = "".join(f"<td>{_text(value)}</td>" for value in row.figures.values())
    return f"<tr><td>{name}</td><td class={OUTCOMES[row.outcome]}>{row.outcome}</td><td>{escape(row.reason)}</td>{cells}</tr>"


def _text(value: object) -> str:
    return "" if value is None else f"{value:.2f}" if isinstance(value, float) else str(value)
