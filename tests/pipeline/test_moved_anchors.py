"""When two recordings' places of an anchor are not the same."""

import numpy as np
import pytest

from uwblite.pipeline.moved_anchors import _LEAST_MOVE, _MOVED, _differ


@pytest.mark.parametrize(("metres", "sigmas", "differ"), [(1.01, 1.01, True), (0.99, 1.01, False), (1.01, 0.99, False)])
def test_places_differ_by_distance_and_by_their_uncertainty(metres, sigmas, differ):
    """More than the least move, and more than its Mahalanobis distance, along the less certain direction."""
    direction = np.array([0.6, 0.8])
    along = (metres * _LEAST_MOVE) ** 2 / (sigmas**2 * _MOVED)
    across = np.array([-0.8, 0.6])
    covariance = along * np.outer(direction, direction) + 0.01 * along * np.outer(across, across)
    assert _differ(metres * _LEAST_MOVE * direction, covariance) is differ
