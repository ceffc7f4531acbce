"""The command that maps again: the same recordings, settings and mounting, other constraints; nothing else of a report."""

from pathlib import Path

import pytest

from uwblite.errors import ConfigError
from uwblite.server.edits import remap_command

REPORT = {
    "inputs": [{"source": "a.log", "sha256": "aa"}, {"source": "b.log", "sha256": "bb"}],
    "command": "uwblite map a.log b.log --config config.toml --constraints mine.toml --laser-pose=0.1,0,0 --laser-flipped "
    "--tag -0.05,0,0.6 --anchors-from=old.csv --out map_again --force --debug",
}
RECORDINGS = {"aa": Path("/x/a copy.log"), "bb": Path("/x/b.log")}


def test_recordings_settings_and_mounting_are_those_of_the_result(tmp_path):
    (tmp_path / "config.toml").touch()
    words = remap_command(REPORT, tmp_path, RECORDINGS, Path("/x/c.toml"), Path("/x/out"))
    assert words == [
        "map", "/x/a copy.log", "/x/b.log", "--config", str(tmp_path / "config.toml"), "--laser-pose=0.1,0,0",
        "--laser-flipped", "--tag=-0.05,0,0.6", "--anchors-from=old.csv", "--constraints", "/x/c.toml", "--out", "/x/out",
    ]  # fmt: skip


def test_a_recording_that_is_not_at_hand_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"not at hand: b\.log; name it: uwblite view DIR RECORDING"):
        remap_command(REPORT, tmp_path, {"aa": Path("a")}, Path("c"), Path("o"))
    with pytest.raises(ConfigError, match="not at hand"):
        remap_command({}, tmp_path, RECORDINGS, Path("c"), Path("o"))


def test_a_command_that_cannot_be_read_adds_nothing(tmp_path):
    words = remap_command({**REPORT, "command": "uwblite 'map"}, tmp_path, RECORDINGS, Path("c"), Path("o"))
    assert words == ["map", "/x/a copy.log", "/x/b.log", "--constraints", "c", "--out", "o"]
