"""The table of a batch: figures of the reports, escaped names, empty cells where there is no figure."""

import csv
import io

from helpers.results import EVIL

from uwblite.report.batch import BatchRow, row_of, table_csv, table_html

REPORT = {
    "recording": {"duration": 60.0, "travelled": 20.5, "ranges": 100, "scans": 300},
    "trusted": False,
    "doubts": [{"kind": "anchor-unplaced"}, {"kind": "wheels"}, {"kind": "wheels"}],
    "warnings": [{}],
    "anchors": [{"status": "ok"}, {"status": "unplaced"}],
    "closures": [{"accepted": True}, {"accepted": False}],
    "map": {"rows": 100, "cols": 200, "resolution": 0.05},
}


def test_a_report_becomes_a_row():
    row = row_of("a.log", "a", REPORT)
    assert (row.outcome, row.reason) == ("doubted", "anchor-unplaced, wheels")
    assert [row.figures[name] for name in ("anchors", "anchors_ok", "closures", "closure_candidates")] == [2, 1, 1, 2]
    assert [row.figures[name] for name in ("width", "height", "seconds")] == [10.0, 5.0, None]
    assert row_of("a.log", "a", {**REPORT, "map": None, "trusted": True, "doubts": []}).figures["width"] is None


def test_the_csv_is_read_back_with_empty_cells_and_quotes():
    rows = [row_of("a.log", "a", REPORT), BatchRow('b, "c".log', "b", "failed", "no odometry, sorry")]
    first, second = csv.DictReader(io.StringIO(table_csv(rows)))
    assert first["travelled"] == "20.50"
    assert first["seconds"] == ""
    assert second["recording"] == 'b, "c".log'
    assert second["duration"] == ""


def test_names_are_escaped_and_failures_have_no_link():
    page = table_html([row_of(f"a{EVIL}.log", f"a{EVIL}#?", REPORT), BatchRow("b.log", "b", "failed", EVIL)], "maps" + EVIL)
    assert "alert('x')" not in page
    assert page.count("<a href=") == 1
    assert 'href="a%3Cscript' in page
