"""Whether a map states that it knows the shape of the path."""

from types import SimpleNamespace

import numpy as np
import pytest

from uwblite.assessment.certainty import check_certainty
from uwblite.pipeline.progress import Stages


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
