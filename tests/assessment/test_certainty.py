"""Whether a map states that it knows the shape of the path."""

from types import SimpleNamespace

import numpy as np
import pytest

from uwblite.assessment import certainty
from uwblite.assessment.certainty import check_certainty
from uwblite.pipeline.mapping_config import MappingConfig
from uwblite.pipeline.progress import Stages
from uwblite.problem.alternatives import Explanation


@pytest.mark.parametrize(
    ("across", "ranges", "sigma", "doubted"),
    [
        (50.0, (), 0.39, False), (50.0, (), 0.41, True), (4.0, (), 0.19, False), (4.0, (), 0.21, True),
        (450.0, None, 2.9, False), (450.0, None, 3.1, True), (4.0, None, 0.19, False), (4.0, None, 0.21, True),
    ],
)  # fmt: skip
def test_a_path_whose_shape_is_known_roughly_only_is_doubted(across, ranges, sigma, doubted):
    """With ranges to the same error everywhere; without, a chain of steps errs by the root of its length."""
    stages, poses = Stages(None, None), across * np.array([[0.0, 0.0, 0.0], [0.6, 0.8, 0.0]])
    estimate = SimpleNamespace(graph=SimpleNamespace(poses=poses), ranges=ranges)
    stages.findings.extend(check_certainty(estimate, sigma, SimpleNamespace(stages=stages)))
    assert bool(stages.doubts) == doubted


@pytest.mark.parametrize(
    ("log_odds", "off", "lidar", "doubts"),
    [(-4.9, 0.41, False, 1), (4.0, 0.41, False, 1), (-5.1, 0.41, False, 0), (-4.9, 0.39, False, 0), (-4.9, 0.41, True, 0)],
)
def test_another_side_that_fits_as_well_is_a_doubt(monkeypatch, log_odds, off, lidar, doubts):
    here, there = Explanation("here", 0.0), Explanation("there", log_odds)
    monkeypatch.setattr(certainty, "sides", lambda *_: [here, there])
    monkeypatch.setattr(certainty, "apart", lambda one, other: off * (one != other))
    stages = Stages(None, None)
    recordings = type("One", (), {"have_scans": lidar, "__len__": lambda _: 1})()
    task = SimpleNamespace(recordings=recordings, stages=stages, config=MappingConfig())
    stages.findings.extend(
        certainty.check_other_side(SimpleNamespace(graph="here", other_side=None, placed=None), task)
    )
    assert [d.kind for d in stages.doubts] == ["other-side"] * doubts
