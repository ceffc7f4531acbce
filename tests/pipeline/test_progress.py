"""What the stages report: figures with their times, what is forgotten, and a caller who stops."""

import pytest

from uwblite.errors import Cancelled
from uwblite.findings import Fact
from uwblite.pipeline.progress import Stages


def test_stages_take_the_time_since_the_one_before():
    calls, times = [], iter([10.0, 12.5, 13.0])
    stages = Stages(lambda stage, done, total: calls.append((str(stage), done, total)), lambda: next(times))
    stages.end("one", edges=3)
    stages.reporter("two")(4, 9)
    stages.end("two")
    assert [(s.name, s.seconds, s.figures) for s in stages.done] == [("one", 2.5, {"edges": 3}), ("two", 0.5, {})]
    assert calls == [("one", 1, 1), ("two", 4, 9), ("two", 1, 1)]
    without = Stages(None, None)
    without.end("one")
    assert without.done[0].seconds == 0.0


def test_a_callback_that_returns_false_stops_and_none_goes_on():
    Stages(lambda *call: None, None).end("one")
    with pytest.raises(Cancelled, match="stopped by the caller during one"):
        Stages(lambda *call: False, None).report("one", 1, 2)


def test_facts_are_kept_in_their_order():
    stages = Stages(None, None)
    stages.note("clock-offset", offset=0.1)
    stages.note("scans-astray", scans=1, used=2)
    assert stages.facts == [Fact.of("clock-offset", offset=0.1), Fact.of("scans-astray", scans=1, used=2)]


def test_passes_count_how_often_stages_ran():
    """Each recording is bootstrapped once; clouds were made twice: five stages of four."""
    stages = Stages(None, None)
    for recording in (1, 2):
        stages.end("bootstrap", recording=recording)
    for name in ("clouds", "map", "clouds"):
        stages.end(name)
    assert stages.passes == 1.25
