"""Stretches that doubts are about are marked; a doubt about the whole marks nothing as better than the rest."""

from dataclasses import replace

import numpy as np
from helpers.results import small_result

from uwblite.findings import Finding, doubt, warning


def doubted(result, *findings):
    return replace(result, findings=findings)


def test_poses_within_the_stretches_of_doubts_are_not_trusted():
    result = small_result()
    stamps = result.stamps
    spans = ((float(stamps[3]), float(stamps[5])), (float(stamps[9]), float(stamps[9])))
    found = doubted(result, Finding("path-displaced", "doubt", "", stretches=spans, recording=1), warning("gyro", ""))
    trusted = found.trusted(stamps, result.recording)
    assert np.flatnonzero(~trusted).tolist() == [k for k in (3, 4, 5, 9) if result.recording[k] == 0]
    assert [len(path) for path in found.doubted_paths()] == [3, 1]
    assert found.trusted(stamps, result.recording + 1).all()


def test_a_doubt_about_the_whole_leaves_no_pose_trusted_and_marks_none():
    result = small_result()
    whole = doubt("uncertain", "")
    part = Finding("path-displaced", "doubt", "", stretches=((0.0, 1e9),), recording=1)
    for findings in ((whole,), (part, whole)):
        found = doubted(result, *findings)
        assert not found.trusted(result.stamps, result.recording).any()
        assert found.doubted_stretches == ()
    assert doubted(result).trusted(result.stamps, result.recording).all()
