"""The constraints file of the page: the user's part stays, the page's part is written again, both are read as written."""

import numpy as np
import pytest

from uwblite.constraints import Constraints
from uwblite.errors import ConfigError
from uwblite.io.constraints_file import parse_constraints
from uwblite.io.stored_result import StoredClosure
from uwblite.server.edits import edits_text, parse_edits, wish_for, with_anchor, with_closure

OWN = '# surveyed on Monday\n[[anchor]]\nid = "A"\nposition = [1.0, 2.0]\n'
EPOCH = 1_700_000_000.123456


def closure(first=EPOCH, second=EPOCH + 60.25, recordings=(1, 2), pose=(0.5, -0.25, 0.125)):
    measured = None if pose is None else np.array(pose)
    return StoredClosure((first, second), recordings, np.zeros((2, 2)), True, "fits", measured)


def test_every_wish_is_read_back_as_it_was_made():
    edits = with_closure(Constraints(), closure(), "reject")
    edits = with_closure(edits, closure(first=EPOCH + 5), "force")
    edits = with_anchor(edits, 'B"\\#', (3.5, -1e-7))
    text = edits_text(OWN, edits)
    own, back = parse_edits(text)
    assert own.strip() == OWN.strip()
    assert back == edits
    assert edits_text(own, back) == text
    both = parse_constraints(text)
    assert [a.id for a in both.anchors] == ["A", 'B"\\#']
    assert both.closures[0].stamps == (EPOCH + 5, EPOCH + 60.25)
    assert both.closures[0].pose == (0.5, -0.25, 0.125)
    assert both.forbidden[0].recordings == (1, 2)


def test_a_later_edit_replaces_the_earlier():
    edits = Constraints()
    for wish in ("reject", "force", "reject", "leave"):
        edits = with_closure(edits, closure(), wish)
        assert wish_for(edits, closure()) == wish
    assert edits == Constraints()
    other = closure(recordings=(1, 1))
    assert wish_for(with_closure(edits, closure(), "reject"), other) == "leave"
    edits = with_anchor(with_anchor(edits, "A", (1.0, 1.0)), "A", (2.0, 2.0))
    assert [a.position for a in edits.anchors] == [(2.0, 2.0)]
    assert with_anchor(edits, "A", None) == Constraints()


def test_what_cannot_be_edited_is_reported():
    with pytest.raises(ConfigError, match="not 'burn'"):
        with_closure(Constraints(), closure(), "burn")
    with pytest.raises(ConfigError, match="cannot be forced"):
        with_closure(Constraints(), closure(pose=None), "force")
    with pytest.raises(ConfigError, match="unknown table"):
        parse_edits("[[nonsense]]\nx = 1\n")
    assert parse_edits("") == ("", Constraints())
