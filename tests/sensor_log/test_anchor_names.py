"""Names of anchors at several places."""

from uwblite.sensor_log.anchor_names import last_places


def test_the_last_place_counts_whether_moved_within_or_between_recordings():
    names = ("A", "A@2", "A@10", "A@9", "B", "B#2", "B@2", "C")
    assert last_places(names) == {"A": "A@10", "B": "B#2", "C": "C"}
    assert last_places(("D", "D#2", "D@3#2")) == {"D": "D@3#2"}


def test_a_radio_may_be_called_so_itself():
    assert last_places(("E@2", "F#x", "")) == {"E@2": "E@2", "F#x": "F#x", "": ""}
