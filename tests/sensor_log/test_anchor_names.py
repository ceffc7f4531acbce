"""Names of anchors at several places."""

import pytest

from uwblite.sensor_log.sensors import first_place, last_places, name_and_number, place_name, radio_name


def test_names_of_places():
    assert name_and_number("5C0B") == ("5C0B", 1)
    assert name_and_number("5C0B@3") == ("5C0B", 3)
    assert name_and_number("user@home") == ("user@home", 1)
    assert [place_name("5C0B", *at) for at in ((1, 0), (3, 0), (1, 1), (3, 1))] == ["5C0B", "5C0B@3", "5C0B#2", "5C0B@3#2"]
    assert [first_place(name) for name in ("5C0B@3#2", "5C0B@3", "5C0B")] == ["5C0B@3", "5C0B@3", "5C0B"]


@pytest.mark.parametrize("anchor", ["5C0B", "5C0B#2", "5C0B@2", "5C0B@12#3"])
def test_all_places_of_an_anchor_have_one_radio_name(anchor):
    assert radio_name(anchor) == "5C0B"
    assert radio_name("a@b#c") == "a@b#c"


def test_the_last_place_counts_whether_moved_within_or_between_recordings():
    names = ("A", "A@2", "A@10", "A@9", "B", "B#2", "B@2", "C")
    assert last_places(names) == {"A": "A@10", "B": "B#2", "C": "C"}
    assert last_places(("D", "D#2", "D@3#2")) == {"D": "D@3#2"}


def test_a_radio_may_be_called_so_itself():
    assert last_places(("E@2", "F#x", "")) == {"E@2": "E@2", "F#x": "F#x", "": ""}
