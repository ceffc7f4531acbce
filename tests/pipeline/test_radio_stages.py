"""When the odometry's unit is another one, and what is said of it."""

from types import SimpleNamespace

import numpy as np
import pytest

from uwblite.constraints import Constraints, GivenAnchor
from uwblite.graph.graph import Calibration, UnknownKey
from uwblite.pipeline.progress import Stages
from uwblite.pipeline.radio_stages import odometry_unit_factors
from uwblite.pipeline.recordings import Recordings


@pytest.mark.parametrize(("errors", "factors"), [
    ([0.11], [1.0]), ([0.13], [1.13]), ([-0.13], [0.87]), ([None], [1.0]), ([0.05, 0.5], [1.0, 1.5]),
])  # fmt: skip
def test_wheels_are_in_another_unit_from_an_eighth_on(errors, factors):
    """Of several recordings the one is named; no factor where the scale is no unknown."""
    values = [0.0 if e is None else e for e in errors]
    calibration = SimpleNamespace(index=lambda kind, recording: -1 if errors[recording] is None else recording, values=values)
    each, stages = [SimpleNamespace(name=f"{n}.log", number=n) for n in range(len(errors))], Stages(None, None)
    recordings = type("Recordings", (), {"each": each, "__len__": lambda self: len(each)})()
    estimate, task = SimpleNamespace(graph=SimpleNamespace(calibration=calibration)), SimpleNamespace(recordings=recordings)
    task.stages = stages
    assert odometry_unit_factors(estimate, task).tolist() == factors
    wrong = [n for n, factor in enumerate(factors) if factor != 1.0]
    assert [w.figures for w in stages.warnings] == [{"recording": n + 1, "factor": factors[n]} for n in wrong]
    named = [w.text.startswith(f"{n}.log: ") for n, w in zip(wrong, stages.warnings, strict=True)]
    assert named == [len(errors) > 1] * len(wrong)


@pytest.mark.parametrize(
    ("factor", "lidar", "given", "warned", "doubted"),
    [
        (1.1, False, 0, 0, 0),
        (1.41, False, 0, 1, 0),
        (2.06, False, 0, 0, 1),
        (0.515, False, 0, 0, 1),
        (0.515, True, 0, 1, 0),
        (0.515, False, 2, 1, 0),
        (4.0, False, 0, 1, 0),
    ],
)
def test_a_factor_of_two_that_nothing_else_decides_is_a_doubt(factor, lidar, given, warned, doubted):
    stages = Stages(None, None)
    calibration = Calibration((UnknownKey("odometry_scale", recording=0),), np.array([factor - 1.0]))
    recordings = Recordings((SimpleNamespace(name="run.log", number=0, has_scans=lidar),), *(np.zeros(0),) * 4)
    given = Constraints(anchors=tuple(GivenAnchor(name, (0.0, 0.0)) for name in "AB"[:given]))
    task = SimpleNamespace(stages=stages, recordings=recordings, given=given)
    factors = odometry_unit_factors(SimpleNamespace(graph=SimpleNamespace(calibration=calibration)), task)
    assert factors == pytest.approx([factor if warned or doubted else 1.0])
    assert (len(stages.warnings), len(stages.doubts)) == (warned, doubted)
