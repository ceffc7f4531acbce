"""The tool that puts faults into recordings: what it calls a verdict, and the tables that it writes."""

from dataclasses import replace

import faults
import numpy as np
import pytest
from faulting.causes import causes_of
from faulting.every import FAULTS
from faulting.outcome import SENSORS, VERDICTS, Outcome, by_kind, cell, counted, summary

NAN = float("nan")
RIGHT = Outcome("lab", "wheels swapped", "all", 0.012, 0.3, -np.inf, 0, (), (), 0, 1.0)
DOUBTED = replace(RIGHT, exit_code=3, stated=("the map may be mirrored",), kinds=("mirrored", "uncertain"))


@pytest.mark.parametrize(
    ("outcome", "expected"),
    [
        (RIGHT, "right 0.01"),
        (DOUBTED, "doubted 0.01"),
        (replace(DOUBTED, ate=4.94), "caught 4.94"),
        (replace(DOUBTED, beyond=0.2, anchor=2.43), "caught 0.01, anchor 2.4"),
        (replace(RIGHT, ate=0.51), "**SILENT** 0.51"),
        (replace(RIGHT, ate=0.499), "right 0.50"),
        (replace(RIGHT, beyond=0.01, anchor=1.9), "**SILENT** 0.01, anchor 1.9"),
        (replace(DOUBTED, name="none"), "**FALSE ALARM** 0.01"),
        (replace(DOUBTED, name="none", ate=0.81), "caught 0.81"),
        (replace(RIGHT, ate=NAN, exit_code=1, stated=("the ranges look like millimetres",)), "refused"),
        (replace(RIGHT, ate=NAN, exit_code=4, stated=("KeyError: 'a' (x.py:3)",)), "**CRASH**"),
        (replace(RIGHT, ate=NAN, exit_code=4, stated=("stopped after 60 s",)), "**TOO LONG**"),
    ],
)
def test_a_cell_has_the_verdict_and_the_error(outcome, expected):
    assert outcome.verdict in VERDICTS
    assert cell(outcome) == expected


@pytest.mark.parametrize(("code", "kinds", "stated", "named"), [
    (3, ("mirrored", "uncertain"), ("", ""), True), (3, ("uncertain", "mirrored"), ("", ""), False), (0, (), (), None),
    (1, (), ("the odometry's positions look like millimetres",), True), (1, (), ("two robots in one log",), False),
])  # fmt: skip
def test_the_true_cause_is_named_first(code, kinds, stated, named):
    outcome = replace(RIGHT, exit_code=code, kinds=kinds, stated=stated, causes=("mirrored", "millimetres"))
    assert outcome.named is named
    assert ("by another name" in cell(outcome)) is (named is False)
    assert replace(outcome, causes=()).named is None


def test_every_fault_knows_its_cause():
    """Kinds that exist, or words; a recording without a fault has none."""
    page = (faults.ROOT / "docs" / "formats.md").read_text()
    for fault in FAULTS:
        causes = causes_of(fault)
        assert bool(causes) is (fault != "none"), fault
        assert all(f"`{cause}`" in page for cause in causes if "-" in cause), causes


DONE = [
    DOUBTED,
    replace(RIGHT, sensors="no-lidar", ate=0.08),
    replace(DOUBTED, world="kasdorf", kinds=("uncertain",), ate=0.6),
    replace(RIGHT, name="laser mirrored", ate=0.7),
]


def test_each_kind_of_fault_is_one_row():
    """Sensors that a kind is not tried with leave their cell empty; doubts that more columns share come first."""
    head, rows = by_kind(DONE)
    assert head == ["fault", "lab, all sensors", "lab, no lidar", "kasdorf, all sensors", "doubts"]
    assert rows == [
        ["wheels swapped", "doubted 0.01", "right 0.08", "caught 0.60", "uncertain, mirrored"],
        ["laser mirrored", "**SILENT** 0.70", "", "", ""],
    ]


def test_verdicts_are_counted_by_recording_and_in_all():
    head, rows = counted(DONE)
    assert [dict(zip(head, row, strict=True))["SILENT"] for row in rows] == ["1", "0", "0"]
    assert sum(int(count) for row in rows for count in row[1:]) == len(DONE)
    assert summary(DONE).startswith("2 kinds of fault in 4 recordings: right 1, doubted 1, caught 1, refused 0,")


def test_the_page_gets_both_parts_and_keeps_the_rest(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# Page\n\n<!-- faults in short -->\nold\n<!-- end of faults in short -->\n\nkept\n")
    faults.write_page(page, DONE, 3.0)
    written = page.read_text()
    assert f"<!-- faults in short -->\n{summary(DONE)}.\n<!-- end" in written
    assert written.index("kept") < written.index("<!-- faults -->")
    assert "| wheels swapped | doubted 0.01 | right 0.08 |" in written
    assert "A map is wrong when" in written
    faults.write_page(page, DONE, 3.0)
    assert page.read_text() == written


@pytest.mark.parametrize(("options", "written"), [([], True), (["--print"], False), (["--only", "swapped"], False)])
def test_a_run_of_some_cases_leaves_the_page(monkeypatch, options, written):
    """Its tables would take the place of those of all."""
    pages = []
    monkeypatch.setattr(faults, "clean_cases", lambda *_: {})
    monkeypatch.setattr(faults, "outcomes", lambda *_: iter(DONE))
    monkeypatch.setattr(faults, "write_page", lambda page, done, minutes: pages.append((page.name, done, minutes)))
    assert faults.main([*options, "--minutes", "2"]) == 1
    assert pages == [("accuracy.md", DONE, 2.0)] * written


def test_every_fault_is_tried_with_sensors_that_exist():
    assert all(set(sensors) <= set(SENSORS) for _, sensors in FAULTS.values())


def test_sound_recordings_are_of_every_robot():
    cases = faults.clean_cases(["room"], 0.2, 1, list(faults.ROBOTS))
    assert set(cases) == {"room" + robot for robot in faults.ROBOTS}
    assert len({case.log.scans.ranges.shape[1] for case in cases.values()}) == len(cases)
