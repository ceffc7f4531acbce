"""When the odometry's unit is another one, and what is said of it."""

from types import SimpleNamespace

import pytest

from uwblite.pipeline.progress import Stages
from uwblite.pipeline.radio_stages import odometry_unit_factors


@pytest.mark.parametrize(("errors", "factors"), [
    ([0.11], [1.0]), ([0.13], [1.13]), ([-0.13], [0.87]), ([None], [1.0]), ([0.05, 1.0], [1.0, 2.0]),
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
