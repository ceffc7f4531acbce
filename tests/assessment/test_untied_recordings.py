"""A recording whose common anchors mostly stand elsewhere is a doubt, unless a closure ties it to the others."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.planted_graphs import plain_ranges

from uwblite.assessment.untied_recordings import check_untied_recordings
from uwblite.pipeline.progress import Stages


def doubted(heard, closures=(), few=()):
    """Return the recordings that are doubted: heard are the anchors of each, closures pairs of recordings, few heard twice."""
    ids = tuple(sorted({name for names in heard for name in names}))
    one = [(n, name) for n, names in enumerate(heard) for name in names]
    pose, anchor = np.array([(n, ids.index(name)) for n, name in one for _ in range(2 if (n, name) in few else 3)]).T
    i, j = np.array(closures, dtype=np.intp).reshape(-1, 2).T
    estimate = SimpleNamespace(
        ranges=plain_ranges(pose, anchor, np.ones(len(pose)), 0.1), anchor_ids=ids, placed=np.ones(len(ids), dtype=bool),
        closures=SimpleNamespace(edges=SimpleNamespace(i=i, j=j)),
    )  # fmt: skip
    each = [SimpleNamespace(number=n, name=f"recording {n + 1}") for n in range(len(heard))]
    stages = Stages(None, None)
    recordings = SimpleNamespace(each=each, of_keyframe=np.arange(len(heard)))
    stages.findings.extend(check_untied_recordings(estimate, SimpleNamespace(recordings=recordings, stages=stages)))
    assert all(notice.kind == "untied-parts" for notice in stages.doubts)
    return {notice.figures["recording"]: notice.figures["moved"] for notice in stages.doubts}


@pytest.mark.parametrize(("heard", "doubts"), [
    ([["A", "B"], ["A", "B"]], {}),
    ([["A", "B", "C"], ["A", "B", "C#2"]], {2: ["C"]}),
    ([["A", "B", "C", "D"], ["A", "B", "C", "D#2"]], {}),
    ([["A", "B", "C", "D"], ["A", "B", "C#2", "D#2"]], {2: ["C", "D"]}),
    ([["A", "B", "C"], ["A", "B", "C#2"], ["A", "B", "C#2"]], {1: ["C"]}),
    ([["A", "A@2", "B", "C"], ["A@2", "B", "C"]], {}),
    ([["A", "B", "C", "C#2"]], {}),
])  # fmt: skip
def test_anchors_that_agree_are_a_majority_or_a_doubt(heard, doubts):
    assert doubted(heard) == doubts


def test_a_closure_with_another_recording_ties_and_one_of_its_own_does_not():
    heard = [["A", "B", "C"], ["A", "B", "C#2"]]
    assert doubted(heard, [(0, 1)]) == {}
    assert doubted(heard, [(1, 1)]) == {2: ["C"]}


def test_an_anchor_heard_twice_says_nothing():
    heard = [["A", "B", "C"], ["A", "B", "C#2"]]
    assert doubted(heard, few=[(1, "C#2")]) == {}
