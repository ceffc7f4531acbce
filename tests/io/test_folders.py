"""Folders replaced as a whole: what goes, what stays, what a crash leaves. Kills and full disks: see test_results.py."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from uwblite.errors import ConfigError
from uwblite.io import folders
from uwblite.io.files import WAITING
from uwblite.io.folders import mend, replacing_folder


def owned(name):
    return name.startswith("our")


def fill(folder, **texts):
    with replacing_folder(folder, owned) as waiting:
        for name, text in texts.items():
            (waiting / name).write_text(text)


def texts(folder):
    return {p.name: p.read_text() for p in folder.iterdir()}


@pytest.mark.parametrize("name", ["map", "map[1]*?", "größe und maß", "-f", ".hidden"])
def test_a_folder_appears_and_is_replaced_whatever_its_name(tmp_path, name):
    folder = tmp_path / "deep" / name
    fill(folder, our_a="1", our_b="1")
    fill(folder, our_b="2")
    assert texts(folder) == {"our_b": "2"}
    assert [p.name for p in folder.parent.iterdir()] == [name]


def test_what_belongs_to_others_stays(tmp_path):
    folder = tmp_path / "map"
    fill(folder, our_a="1", our_b="1")
    (folder / "theirs").write_text("theirs")
    os.symlink(folder / "our_a", folder / "our_link")
    fill(folder, our_b="2")
    assert texts(folder) == {"our_b": "2", "theirs": "theirs"}


def test_a_file_that_others_put_there_at_the_last_moment_is_kept(tmp_path, monkeypatch):
    folder = tmp_path / "map"
    fill(folder, our_a="1")
    plain = folders._exchange

    def late(one, other):
        (folder / "theirs").write_text("late")
        return plain(one, other)

    monkeypatch.setattr(folders, "_exchange", late)
    fill(folder, our_a="2")
    assert texts(folder) == {"our_a": "2", "theirs": "late"}


def test_an_error_leaves_everything(tmp_path):
    folder = tmp_path / "map"
    fill(folder, our_a="1")

    def interrupted():
        with replacing_folder(folder, owned) as waiting:
            (waiting / "our_a").write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert texts(folder) == {"our_a": "1"}
    assert [p.name for p in tmp_path.iterdir()] == ["map"]


def test_a_folder_in_the_place_of_a_file_is_said_before_anything_is_replaced(tmp_path):
    folder = tmp_path / "map"
    fill(folder, our_a="1")
    (folder / "our_b").mkdir()
    with pytest.raises(ConfigError, match="our_b is a folder"):
        fill(folder, our_a="2", our_b="2")
    assert sorted(p.name for p in folder.iterdir()) == ["our_a", "our_b"]
    assert (folder / "our_a").read_text() == "1"


def test_few_open_files_are_enough(tmp_path):
    """A dozen for whatever number of files; what cannot be opened leaves nothing behind."""
    program = (
        "import resource, sys; from pathlib import Path; from uwblite.io.folders import replacing_folder\n"
        "resource.setrlimit(resource.RLIMIT_NOFILE, (12, 12))\n"
        "with replacing_folder(sys.argv[1], lambda name: True) as waiting:\n"
        "    [(waiting / str(k)).write_text('x') for k in range(40)]\n"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(folders.__file__).parents[2])}
    subprocess.run([sys.executable, "-c", program, str(tmp_path / "map")], check=True, env=environment)
    assert [p.name for p in tmp_path.iterdir()] == ["map"]
    assert len(list((tmp_path / "map").iterdir())) == 40


def test_what_killed_writers_left_goes(tmp_path):
    folder = tmp_path / "map"
    fill(folder, our_a="1")
    for left in (tmp_path / f".map{WAITING}dead", folder / f"{WAITING}dead"):
        left.mkdir()
        (left / "our_a").write_text("half")
    other = tmp_path / f".mapper{WAITING}alive"
    other.mkdir()
    fill(folder, our_a="2")
    assert texts(folder) == {"our_a": "2"}
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(["map", other.name])


def test_a_broken_replacement_is_finished_and_nothing_else_is_taken_for_one(tmp_path):
    folder, ready = tmp_path / "map", tmp_path / "map" / folders._READY
    fill(folder, our_a="1", our_b="1")
    assert not mend(folder, owned)
    ready.mkdir()
    (ready / "our_b").write_text("2")
    assert not mend(folder, owned)
    # our_c was renamed already when the power failed; our_a is of the old result; theirs must not be touched.
    (ready / "files").write_text("our_b\nour_c\ntheirs\n../our_d")
    (ready / "theirs").write_text("planted")
    (folder / "our_c").write_text("2")
    (folder / "theirs").write_text("theirs")
    assert mend(folder, owned)
    assert texts(folder) == {"our_b": "2", "our_c": "2", "theirs": "theirs"}
    assert not mend(folder, owned)
    assert not mend(tmp_path / "nowhere", owned)


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="needs a file system in which nothing can be made")
def test_an_error_names_the_folder_that_was_asked_for():
    with pytest.raises(OSError, match="uwblite_map") as refused, replacing_folder("/proc/uwblite_map", owned):
        pass
    assert refused.value.filename == "/proc/uwblite_map"
