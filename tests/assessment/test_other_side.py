"""Another trajectory that the ranges fit about as well is a doubt."""

from types import SimpleNamespace

import pytest

from uwblite.assessment import other_side
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.pipeline.progress import Stages


@pytest.mark.parametrize(
    ("more", "off", "lidar", "doubts"),
    [(3.9, 0.41, False, 1), (-9.0, 0.41, False, 1), (4.1, 0.41, False, 0), (3.9, 0.39, False, 0), (3.9, 0.41, True, 0)],
)
def test_another_side_that_fits_as_well_is_a_doubt(monkeypatch, more, off, lidar, doubts):
    here, there = (SimpleNamespace(chi2=lambda c=c: 100.0 + c) for c in (0.0, more))
    monkeypatch.setattr(other_side, "minima", lambda *_: [here, there])
    monkeypatch.setattr(other_side, "apart", lambda one, other: off * (one is not other))
    stages = Stages(None, None)
    recordings = type("One", (), {"have_scans": lidar, "__len__": lambda _: 1})()
    task = SimpleNamespace(recordings=recordings, stages=stages, config=MappingConfig())
    stages.findings.extend(other_side.check_other_minimum(SimpleNamespace(graph=here, other_minimum=None, placed=None), task))
    assert [d.kind for d in stages.doubts] == ["other-side"] * doubts
