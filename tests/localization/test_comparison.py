"""Which of the places that a search found are new."""

import numpy as np

from uwblite.localization.comparison import _no_repetition
from uwblite.localization.verdict import CERTAIN


def test_a_place_near_an_earlier_one_stays_only_if_it_is_far_better():
    poses = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.3, 0.1, 0.0], [2.0, 0.0, 0.0], [0.3, 0.0, 1.0]])
    weight = np.array([-10.0, -10.0 + CERTAIN - 0.1, -10.0 + CERTAIN + 0.1, -30.0, -30.0])
    np.testing.assert_array_equal(_no_repetition(poses, weight, 1), [True, False, True, True, True])
    np.testing.assert_array_equal(_no_repetition(poses, weight, 5), np.ones(5, bool))
