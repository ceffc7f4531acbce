"""Another trajectory that the ranges fit about as well is a doubt."""

from types import SimpleNamespace

import pytest

from uwblite.assessment import other_side
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.pipeline.progress import Stages
from uwblite.problem.alternatives import Explanation


@pytest.mark.parametrize(
    ("log_odds", "off", "lidar", "doubts"),
    [(-4.9, 0.41, False, 1), (4.0, 0.41, False, 1), (-5.1, 0.41, False, 0), (-4.9, 0.39, False, 0), (-4.9, 0.41, True, 0)],
)
def test_another_side_that_fits_as_well_is_a_doubt(monkeypatch, log_odds, off, lidar, doubts):
    here, there = Explanation("here", 0.0), Explanation("there", log_odds)
    monkeypatch.setattr(other_side, "sides", lambda *_: [here, there])
    monkeypatch.setattr(other_side, "apart", lambda one, other: off * (one != other))
    stages = Stages(None, None)
    recordings = type("One", (), {"have_scans": lidar, "__len__": lambda _: 1})()
    task = SimpleNamespace(recordings=recordings, stages=stages, config=MappingConfig())
    stages.findings.extend(
        other_side.check_other_side(SimpleNamespace(graph="here", other_side=None, placed=None), task)
    )
    assert [d.kind for d in stages.doubts] == ["other-side"] * doubts
