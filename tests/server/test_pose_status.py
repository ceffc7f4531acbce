"""A robot on the page: what is known of it, and what to do when nothing is."""

import json
from dataclasses import replace

import numpy as np
import pytest

from uwblite.localization import LocalizerState
from uwblite.server.live import PoseStatus

KNOWN = LocalizerState(10.0, np.array([1.0, 2.0, 0.5]), np.diag([4e-4, 9e-4, 1e-4]), 0.9, np.zeros(3), False)


def test_a_known_pose_with_its_way():
    status = PoseStatus()
    first = status.take(KNOWN)
    assert first["pose"] == [1.0, 2.0, 0.5]
    assert first["advice"] == []
    assert "quality 0.90, known to 0.04 m" in first["summary"]
    assert status.take(replace(KNOWN, stamp=10.1)) is None
    later = status.take(replace(KNOWN, stamp=10.3, pose=np.array([1.5, 2.0, 0.5])))
    assert later["trail"] == [[1.0, 2.0], [1.5, 2.0]]
    assert later["ellipse"] == pytest.approx([2 * 0.03, 2 * 0.02, 90.0])
    json.dumps(later, allow_nan=False)


def test_a_lost_one_reports_why_and_forgets_its_way():
    status = PoseStatus()
    status.take(KNOWN)
    lost = replace(
        KNOWN, stamp=11.0, pose=np.full(3, np.nan), covariance=np.full((3, 3), np.nan), lost=True, reason="two places fit",
        alternatives=np.array([[1.0, 1.0, 0.0], [5.0, 5.0, 3.0]]), moved_anchors=("91A3",),
    )  # fmt: skip
    shown = status.take(lost)
    assert shown["pose"] is shown["ellipse"] is None
    assert shown["advice"][0] == "the pose is not known: two places fit"
    assert shown["advice"][1].startswith("anchor 91A3 has been moved")
    assert shown["trail"] == []
    assert len(shown["alternatives"]) == 2
    json.dumps(shown, allow_nan=False)


def test_a_log_that_begins_again_is_shown_at_once():
    status = PoseStatus()
    status.take(replace(KNOWN, stamp=1e6))
    assert status.take(KNOWN) is not None


def test_silence_is_shown_at_once_with_the_age_of_the_pose():
    status = PoseStatus()
    assert status.nothing["advice"]
    status.take(KNOWN)
    deaf = status.take(replace(KNOWN, stamp=10.5, silent={"uwb": 6.2}))
    assert deaf["advice"] == ["nothing from uwb for 6 s: the pose rests on scans and odometry"]
    old = status.take(replace(KNOWN, age=3.0, silent={"uwb": 9.2, "odometry": 3.0}))
    assert "3 s old" in old["advice"][0]
    assert "3 s old" in old["summary"]
    assert not old["late"]
    assert status.take(replace(KNOWN, age=12.0, lost=True, reason="no data for 12 s"))["late"]
