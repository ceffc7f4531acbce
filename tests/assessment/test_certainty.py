"""Whether a map states that it knows the shape of the path."""

import numpy as np
import pytest
from helpers.planted_graphs import plain_ranges
from helpers.planted_tasks import estimate_of, recordings_of, task_of

from uwblite.assessment.certainty import check_certainty
from uwblite.graph.graph import Graph


@pytest.mark.parametrize(
    ("across", "ranges", "sigma", "doubted"),
    [
        (50.0, True, 0.39, False), (50.0, True, 0.41, True), (4.0, True, 0.19, False), (4.0, True, 0.21, True),
        (450.0, False, 2.9, False), (450.0, False, 3.1, True), (4.0, False, 0.19, False), (4.0, False, 0.21, True),
    ],
)  # fmt: skip
def test_a_path_whose_shape_is_known_roughly_only_is_doubted(across, ranges, sigma, doubted):
    """With ranges to the same error everywhere; without, a chain of steps errs by the root of its length."""
    poses = across * np.array([[0.0, 0.0, 0.0], [0.6, 0.8, 0.0]])
    measured = plain_ranges(np.array([0]), np.array([0]), np.array([1.0]), 0.1) if ranges else None
    estimate = estimate_of(Graph(poses, np.zeros((1, 2))), ranges=measured)
    found = list(check_certainty(estimate, sigma, task_of(recordings_of(poses))))
    assert [finding.severity for finding in found] == ["doubt"] * doubted
