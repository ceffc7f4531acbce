"""The finding of every kind of fact states the fact's figures, rounded as people read them, and is as severe as they are."""

import re

import pytest

from uwblite.assessment.facts import RULES, check_recordings, listed, say, spans
from uwblite.findings import DOUBT, WARNING, Fact
from uwblite.screening.units import likely_unit

TOLD = [
    ("made-up-stamps", {"period": 0.125}, ["0.125 s"], WARNING),
    ("stamps-of-receipt", {"sensors": ["odometry", "lidar"]}, ["odometry and lidar"], WARNING),
    ("clock-set-back", {"sensor": "lidar", "by": 3.26}, ["lidar", "3.3 s"], DOUBT),
    ("clock-jump", {"clock": "odometry", "by": 3.26, "at": 41.6, "sensor": "lidar", "moved": -3.26},
     ["odometry", "3.3 s", "42 s", "lidar", "-3.3 s"], WARNING),
    ("late-ranges", {"late": 12.4, "grows": 0.0}, ["12 s"], DOUBT),
    ("late-ranges", {"late": -0.4, "grows": 3.6}, ["0 s late", "+4 s more"], DOUBT),
    ("antenna-delay", {"anchors": ["A", "B"], "metres": 153.7}, ["A, B", "154 m"], WARNING),
    ("stamps-in-bursts", {"readings": "ranges", "size": 7.6, "period": 0.256}, ["ranges", "about 8", "0.26 s"], WARNING),
    ("repeated-odometry", {"count": 17}, ["17"], WARNING),
    ("odometry-glitches", {"count": 17, "first": 3.26}, ["17", "3.3 s"], WARNING),
    ("odometry-breaks", {"at": [1.26, 2.0], "largest": 0.456}, ["t = 1.3, 2.0 s", "0.46 m"], WARNING),
    ("odometry-gap", {"seconds": 41.6, "begin": 3.4}, ["42 s", "t = 3 s"], WARNING),
    ("hardly-moving", {"way": 0.126, "seconds": 61.6, "turned": 1.26}, ["0.13 m", "62 s", "1.3 rad"], DOUBT),
    ("laser-turned-away", {"degrees": 41.6, "pose": [0.1234, -2.0, 0.5]}, ["+42 degrees", "0.123,-2.000,0.500"], WARNING),
    ("late-scans", {"count": 17, "total": 300}, ["17 of 300"], WARNING),
    ("scans-do-not-match", {"share": 0.126}, ["13%"], DOUBT),
    ("repeated-ranges", {"anchor": "A1", "stretches": [(1.4, 3.6)]}, ["anchor A1", "t = 1 to 4 s"], WARNING),
    ("heading-against-path", {"inverted": "x", "settled": True}, ["x was inverted"], WARNING),
    ("heading-against-path", {"inverted": "x", "settled": False},
     ["x was inverted", "nothing in the recording shows"], WARNING),
    ("laser-turned-over", {"flipped": True}, ["taken as mounted upside down", "settle it by `mounting.laser_flipped`"], DOUBT),
    ("laser-turned-over", {"flipped": False}, ["mounted upright", "settle it by leaving out `mounting.laser_flipped`"], DOUBT),
    ("repeated-scans", {"count": 17, "total": 300, "stretches": [(1.0, 1.4)], "often": True},
     ["17 of 300", "(t = 1 s)", "sends scans again"], WARNING),
    ("repeated-scans", {"count": 17, "total": 300, "stretches": [(1.0, 9.0)], "often": False}, ["was stuck"], WARNING),
    ("repeated-readings", {"count": 17, "total": 300, "value": 5.6, "reach": True},
     ["17 of 300", "5.6 m", "its reach"], WARNING),
    ("repeated-readings", {"count": 17, "total": 300, "value": 0.25, "reach": False}, ["0.25 m", "a code"], WARNING),
    ("anchor-heights", {"height": 2.26, "taken": True, "apart": 0.34},
     ["2.3 m", "taken as high; if they are low", "0.3 m"], DOUBT),
    ("anchor-heights", {"height": 2.26, "taken": False, "apart": 0.34}, ["taken as low; if they are high"], DOUBT),
    ("landmark-distance", {"landmarks": "A-B", "map": 3.1416, "measured": 3.5}, ["A-B", "3.142 m", "3.500 m"], WARNING),
    ("clock-offset", {"offset": 0.0625}, ["+0.062 s"], WARNING),
    ("free-space-violation", {"share": 0.126, "moving": 0.034}, ["13% of", "only 3%"], DOUBT),
    ("wheels-stand-still", {"begin": 3.4, "end": 41.6, "by_scans": True}, ["3 to 42 s", "motion between scans"], WARNING),
    ("wheels-stand-still", {"begin": 3.4, "end": 41.6, "by_scans": False}, ["3 to 42 s", "rests on ranges"], DOUBT),
    ("own-body", {"count": 17, "total": 300, "sectors": [(-90.4, -80.0), (10.0, 20.0), (30.0, 40.0), (50.0, 60.0)]},
     ["17 of 300", "-90 to -80, 10 to 20, 30 to 40 ..."], WARNING),
    ("new-anchor", {"anchor": "A1", "recording": 4, "silent": [1, 2, 3]},
     ["A1", "recording 4", "recordings 1, 2 and 3"], WARNING),
    ("absent-anchor", {"anchor": "A1", "recording": 1, "silent": [2]},
     ["A1", "after recording 1", ": recording 2 drove"], WARNING),
    ("turn-scale", {"by_steps": 0.126, "sigma": 0.034, "by_all": -0.026}, ["1.13 ± 0.03", "0.97"], WARNING),
    ("scans-astray", {"scans": 17, "used": 300}, ["17 scans", "300 others"], DOUBT),
    ("exchanged-names", {"at": 41.6, "exchanged": True, "anchors": ["A", "B"]}, ["42 s", "those of A, B fit"], DOUBT),
    ("exchanged-names", {"at": 41.6, "exchanged": False, "anchors": []}, ["fit no places at all: check"], DOUBT),
    ("ranges-outside-odometry", {"count": 17, "total": 300, "sensor": "ranges", "most": True, "off": 41.6},
     ["17 of 300 ranges", "about 42 s"], DOUBT),
    ("scans-outside-odometry", {"count": 17, "total": 300, "sensor": "scans", "most": False, "off": 41.6},
     ["17 of 300 scans"], WARNING),
    ("carried", {"silent": 12.4, "at": [3.4, 41.6]}, ["silent for 12 s", "t = 3, 42 s"], DOUBT),
    ("carried", {"silent": 0.0, "at": [3.4]}, ["at t = 3 s the robot is suddenly elsewhere"], DOUBT),
    ("marked-ranges", {"count": 17, "total": 300, "value": 65.535, "alone": True}, ["17 of 300", "65.535 m"], DOUBT),
    ("marked-ranges", {"count": 17, "total": 300, "value": 0.0, "alone": False}, ["17 of 300", "0 m"], WARNING),
    *((
        "wheels-against-ranges", {"begin": 1.0, "at": 41.6, "end": 90.0, "what": what, "value": 35.6},
      ["42 s", *words], WARNING,
    ) for what, words in {
        "turned": ["+36 degrees"], "mirrored": ["other way round"], "elsewhere": ["carried"], "turns": ["stuck or slips"],
    }.items()),
    ("gyro", {"used": 0.876, "bias": -0.001234, "rests": True}, ["88%", "-0.00123 rad/s", "by the robot's rests"], WARNING),
    ("gyro", {"used": 0.876, "bias": 0.5, "why": "it broke off"}, ["against the wheels", "; it broke off"], WARNING),
    ("gyro", {"why": "it stands"}, ["it stands"], WARNING),
    ("wheels-against-lidar", {"start": 100.0, "stretches": [(103.4, 141.6)], "slips": True},
     ["t = 3 to 42 s", "they slip there"], WARNING),
    ("wheels-against-lidar", {"start": 100.0, "stretches": [(103.4, 141.6)], "slips": False},
     ["t = 3 to 42 s", "one of the two is stuck"], DOUBT),
    ("wheels-against-lidar", {"start": 0.0, "stretches": [], "slips": False}, ["nothing in common"], DOUBT),
    ("scan-duration", {"recording": 2, "name": "b.log", "stated": 0.1, "duration": 0.1246, "increment": 2.3456789e-4},
     ["b.log: ", "0.125 s from", "not 0.100 s", "to 0.000235 s", "0.012 s earlier"], WARNING),
    ("odometry-unit", {"recording": 2, "name": "", "factor": 1.0936, "checked": False, "high": None}, ["1.094 times"], DOUBT),
    ("odometry-unit", {"recording": 2, "name": "", "factor": 1.0936, "checked": True, "high": None}, ["1.094 times"], WARNING),
    ("odometry-unit", {"recording": 2, "name": "b.log", "factor": 1.0936, "checked": True, "high": 2.26},
     ["b.log: ", "2.3 m above the tag"], DOUBT),
    *(("odometry-unit", {"recording": 1, "name": "", "factor": factor, "checked": checked, "high": None},
       ["radius and diameter"] if severity == DOUBT else ["was multiplied by that"], severity)
      for factor, checked, severity in ((2.1, False, DOUBT), (1.88, False, DOUBT), (0.48, False, DOUBT),
                                        (0.53, False, DOUBT),
                                        (2.1, True, WARNING), (2.15, False, WARNING), (1.86, False, WARNING))),
    ("moved-anchor", {"anchor": "A1", "distance": 1.236}, ["A1", "1.24 m from its earlier place"], WARNING),
    ("moved-anchor", {"anchor": "A1", "distance": 1.236, "recording": 2, "new_id": "A1#2"},
     ["in recording 2", "1.24 m", "A1#2"], WARNING),
    ("moved-anchor", {"anchor": "A1", "distance": 1.26, "recording": 2, "new_id": "A1@2", "between": (3.4, 41.6, 7),
                      "several": True},
     ["recording 2: anchor A1", "1.3 m between t = 3 and 42 s", "7 ranges", "A1@2"], WARNING),
    ("moved-anchor", {"anchor": "A1", "distance": 1.26, "recording": 1, "new_id": "A1@2", "between": (3.4, 41.6, 0)},
     ["at about t = 42 s;", "A1@2"], WARNING),
    ("path-displaced", {"recording": 2, "stretch": (103.4, 141.6), "start": 100.0, "anchors": ["A", "B"], "apart": 1.26,
                        "turned": 7.6}, ["t = 3 to 42 s", "A, B", "1.3 m", "8 deg"], DOUBT),
    ("worse-than-parts", {"recording": 2, "stretch": (103.4, 141.6), "start": 100.0, "off": 1.26, "turned": 7.6},
     ["t = 3 to 42 s", "1.3 m", "8 deg"], DOUBT),
    ("coarse-grid", {"resolution": 0.5, "asked": 0.05, "cells": 40.0}, ["0.5 m instead of 0.05 m", "40 million"], WARNING),
    ("coarse-grid", {"resolution": 0.51, "asked": 0.05, "cells": 40.0}, ["0.51 m"], DOUBT),
]  # fmt: skip
"""Kind of a fact, its figures, what its finding says, and how severe it is."""


@pytest.mark.parametrize(("kind", "figures", "words", "severity"), TOLD)
def test_a_finding_states_the_figures_of_its_fact(kind, figures, words, severity):
    (finding,) = say([Fact(kind, figures)])
    assert (finding.kind, finding.severity) == (kind, severity)
    for word in words:
        assert word in finding.text
    assert not re.search(r"[{}|]|None|nan", finding.text)
    assert finding.figures
    assert finding.anchor == figures.get("anchor", "")
    if "recording" in figures and kind not in ("new-anchor", "absent-anchor"):
        assert finding.recording == figures["recording"]
    if "stretch" in figures:
        assert finding.stretches == (figures["stretch"],)
    if kind == "wheels-against-lidar":
        assert finding.stretches == tuple(figures["stretches"])


def test_every_kind_of_fact_is_told():
    assert {kind for kind, *_ in TOLD} == set(RULES)


def test_sensors_of_findings_and_cures():
    sensors = {kind: next(say([Fact(kind, figures)])).sensor for kind, figures, *_ in TOLD}
    assert {kind: sensor for kind, sensor in sensors.items() if sensor} == {
        "clock-set-back": "lidar", "late-ranges": "radio", "antenna-delay": "radio", "exchanged-names": "radio",
        "wheels-against-ranges": "odometry", "worse-than-parts": "lidar",
    }  # fmt: skip
    (kind, figures, *_), = [row for row in TOLD if row[0] == "worse-than-parts"]
    assert "`end=3`" in next(say([Fact(kind, figures)])).cure


def test_figures_of_a_rule_are_rounded_or_are_those_of_the_fact():
    (unit,) = say([Fact("odometry-unit", {"recording": 2, "name": "", "factor": 1.234567, "checked": True, "high": None})])
    assert unit.figures == {"recording": 2, "factor": 1.2346}
    assert likely_unit(1.234567) in unit.text
    (plain,) = say([Fact("late-scans", {"count": 1, "total": 2})])
    assert plain.figures == {"count": 1, "total": 2}


def test_of_many_times_and_stretches_the_first_are_named():
    assert listed([1.26, 2.0], 1) == "1.3, 2.0"
    assert listed([1.0] * 5) == "1, 1, 1, 1, 1"
    assert listed([1.0] * 6) == "1, 1, 1, 1, 1 ..."
    assert listed([1.0] * 3, most=2) == "1, 1 ..."
    assert spans([(1.0, 2.0)] * 3) == "t = 1 to 2 s, t = 1 to 2 s, t = 1 to 2 s"
    assert spans([(1.0, 1.2)] * 5) == "t = 1 s, t = 1 s, t = 1 s, and 2 more stretches"


def test_findings_of_several_recordings_name_theirs(log):
    from dataclasses import replace

    from uwblite.screening.screen import screen

    seen = screen(log.crop(0.0, 20.0))
    facts = (Fact("late-scans", {"count": 1, "total": 2}),)
    one = replace(seen, screening=replace(seen.screening, facts=facts))
    assert [(f.recording, f.text[:10]) for f in check_recordings([one])] == [(1, "1 of 2 sca")]
    both = check_recordings([log, one])
    assert [(f.recording, f.text.startswith("recording 2: 1 of 2 scans")) for f in both] == [(2, True)]
