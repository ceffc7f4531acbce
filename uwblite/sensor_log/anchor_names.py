"""Names of anchors that were moved: a map has one for each of their places."""

import re
from collections.abc import Collection

_PLACE = re.compile(r"(.+?)(?:@(\d+))?(?:#(\d+))?", re.DOTALL)
"""``ID@2``: the second place within a recording; ``ID#2``: the second one of several recordings."""


def _parts(name: str, names: Collection[str]) -> tuple[str, int, int]:
    """Return the radio's name of an anchor, and the numbers of its place in the order of time.

    A radio may be called ``ID@2`` itself: that is another place of ``ID`` only where there is an ``ID``.
    """
    found = _PLACE.fullmatch(name)
    if found is None or found[1] not in names:
        return name, 1, 1
    return found[1], int(found[3] or 1), int(found[2] or 1)


def name_and_number(name: str) -> tuple[str, int]:
    """Return the name of an anchor in its recording and which of its places there is meant: ``ID`` is 1, ``ID@2`` is 2 ..."""
    base, mark, number = name.rpartition("@")
    return (base, int(number)) if mark and number.isdigit() else (name, 1)


def place_name(radio: str, number: int, recording: int) -> str:
    """Return the name of a radio's place, the first, second ... (1, 2, ...) of those that it has in a recording (0, 1, ...).

    Of the first recording in which it is heard, which has the number 0 here, the recording is not named.
    """
    return radio + (f"@{number}" if number > 1 else "") + (f"#{recording + 1}" if recording else "")


def first_place(anchor: str) -> str:
    """Return the name of an anchor where the first of several recordings has it: ``ID@2`` of ``ID@2#3``."""
    return re.sub(r"#\d+$", "", anchor)


def radio_name(anchor: str) -> str:
    """Return the radio's name of an anchor, given the name of one of its places, such as ``5C0B@2#3``."""
    return re.sub(r"(@\d+)?(#\d+)?$", "", anchor)


def last_places(names: Collection[str]) -> dict[str, str]:
    """Return of each anchor of a map, by its radio's name, the name of its last place."""
    return {_parts(name, names)[0]: name for name in sorted(names, key=lambda n: _parts(n, names)[1:])}
