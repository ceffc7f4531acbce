"""When searches count as agreeing."""

import numpy as np
import pytest
from helpers.localization_room import ODD, grid_of

from uwblite.localization import hypotheses, verdict
from uwblite.localization.known_map import known_map
from uwblite.localization.odometer import Odometer
from uwblite.localization.pose_estimator import PoseEstimator

POSE = np.array([1.0, 2.0, 0.3])


@pytest.mark.parametrize(("between", "found"), [(verdict.UNSURE, True), ("2 places are as likely", False)])
def test_a_search_that_is_less_sure_lets_two_others_agree_and_one_that_contradicts_does_not(between, found):
    odometer = Odometer()
    odometer.add(0.0, np.zeros(3))
    estimator = PoseEstimator(known_map((), grid_of(ODD)), odometer)
    estimator._bank = hypotheses.started(POSE[None], 0.01 * np.eye(3)[None], 0)
    for stamp, reason in ((1.0, ""), (2.0, between), (3.0, "")):
        step = np.array([1.5, 0.0, 0.0])
        estimator.move(step)
        odometer.add(stamp, stamp * step)
        estimator._reason = reason
        estimator._decide(estimator._bank.poses[0], 2.0)
    assert estimator._certain is found
