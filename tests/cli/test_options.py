"""Options in place of the settings and arguments that texts of the library name."""

import argparse

import pytest
from conftest import ROOT

from uwblite.cli import VERBS, console
from uwblite.cli.options import OPTIONS, name_options, name_options_in
from uwblite.findings import doubt


@pytest.mark.parametrize(
    ("said", "shown"),
    [
        ("upside down (`mounting.laser_flipped`)?", "upside down (--laser-flipped)?"),
        ("yards (`range_unit=0.9144`)", "yards (`uwblite convert --range-unit=0.9144`)"),
        ("cut at `end=12`", "cut at `uwblite convert run.log before.log --end=12`"),
        ("`use_lidar=true`, `frame`, a ` alone", "`use_lidar=true`, `frame`, a ` alone"),
    ],
)  # fmt: skip
def test_names_become_options(said, shown):
    assert name_options(said) == shown


def test_what_is_printed_and_what_is_written_says_the_same(capsys):
    console.say("give `mounting.tag_position`")
    console.note("use `force`")
    console.fail("choose another `folder`", 1)
    out, err = capsys.readouterr()
    assert out == "give --tag\n"
    assert err == "use --force\nuwblite: error: choose another --out\n"
    (found,) = name_options_in([doubt("odd", "see `crop`")])
    assert (found.text, found.kind) == ("see --crop", "odd")
    assert console.plain({"text": "use `force`"}) == {"text": "use --force"}


def test_every_option_exists_and_every_name_is_said():
    known = set()
    for verb in VERBS.values():
        parser = argparse.ArgumentParser()
        verb.add_arguments(parser)
        known |= set(parser._option_string_actions)
    core = (f for f in (ROOT / "uwblite").rglob("*.py") if "cli" not in f.parts)
    texts = "".join(f.read_text(encoding="utf-8") for f in core)
    for name, option in OPTIONS.items():
        assert next(word for word in option.split() if word.startswith("--")) in known
        assert any(f"`{said}" in texts for said in (name, *COMPOSED.get(name, ()))), name


COMPOSED = {"start": ("{edge}=",), "end": ("{edge}=",), "laser_unit": ("{option}_unit=",), "odometry_unit": ("{option}_unit=",)}
"""How texts name what they put together from parts."""
