"""What of a match is handed on: free space is asked only for promising matches, with the points of both sub-maps."""

from types import SimpleNamespace

import numpy as np
from helpers.laser_walks import HALL, scanned

from uwblite.loop_closure import matching
from uwblite.loop_closure.closures import LoopClosureConfig


def test_free_space_is_asked_with_the_points_of_both_sub_maps(monkeypatch):
    clouds = scanned(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.3], [2.0, 0.0, 0.6]]), HALL)
    config, asked = LoopClosureConfig(), []

    def violations(free_a, a, free_b, b, pose):
        asked.append((free_a, free_b, pose))
        np.testing.assert_array_equal(a, clouds.cloud("abc".index(free_a))[0])
        np.testing.assert_array_equal(b, clouds.cloud("abc".index(free_b))[0])
        return 0.25

    monkeypatch.setattr(matching, "violates_free_space", violations)
    least = min(config.overlap, config.overlap_after_search)
    share, rms = np.array([least, least - 0.01, 1.0, 1.0]), np.array([config.sigma, 0.0, config.sigma * 1.01, 0.0])
    candidates = SimpleNamespace(target=np.array([0, 0, 0, 1]), source=np.array([1, 1, 2, 2]))
    best = SimpleNamespace(share=share, rms=rms, pose=["first", "few", "far", "last"])
    batch = SimpleNamespace(candidates=candidates, config=config, free=["a", "b", "c"], clouds=clouds)
    assert matching._free_space_violations(batch, best).tolist() == [0.25, 0.0, 0.0, 0.25]
    assert asked == [("a", "b", "first"), ("b", "c", "last")]
    batch.free = None
    assert matching._free_space_violations(batch, best).tolist() == [0.0] * 4
