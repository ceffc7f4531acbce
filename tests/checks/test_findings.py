"""The rhythm of a sensor: which silences are worth a warning."""

import numpy as np
import pytest

from uwblite.checks.findings import Findings, timing


@pytest.mark.parametrize(
    ("silences", "seconds", "rank"),
    [(0, 0.0, None), (1, 2.0, "note"), (2, 2.0, "note"), (4, 2.0, "warning"), (1, 5.5, "warning")],
)
def test_silences_are_a_warning_by_their_share_or_their_length(silences, seconds, rank):
    """More than a fiftieth of some 300 s in all, or one of more than 5 s."""
    steps = np.full(3000, 0.1)
    steps[500 : 500 + 300 * silences : 300] = seconds
    found = Findings()
    figures = timing(np.cumsum(steps), "lidar", found, expected_gap=1.0)
    assert figures["gaps"] == silences
    assert [f.rank for f in found.ranked()] == ([] if rank is None else [rank])
