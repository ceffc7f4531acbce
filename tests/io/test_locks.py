"""Writers of one place: a lock while a result is computed, whole results from writers at the same time."""

import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import uwblite
from uwblite.errors import ConfigError
from uwblite.io import folders
from uwblite.io.folders import replacing_folder, sole_writer


def test_a_second_run_is_reported_at_once(tmp_path):
    with sole_writer(tmp_path / "map"):
        with sole_writer(tmp_path / "other"):
            pass
        with pytest.raises(ConfigError, match="another run is writing"), sole_writer(f"{tmp_path}/x/../map"):
            pass
    with sole_writer(tmp_path / "map"):
        pass


def test_a_link_in_place_of_a_lock_is_not_followed(tmp_path, monkeypatch):
    """Whoever may write the folder of temporary files could have files made elsewhere by that."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with sole_writer("map"):
        (lock,) = tmp_path.iterdir()
    lock.symlink_to(tmp_path / "elsewhere")
    with sole_writer("map"):
        assert not (tmp_path / "elsewhere").exists()


def test_a_lock_is_not_inherited_by_other_programs(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with sole_writer("map"):
        (lock,) = tmp_path.iterdir()
        (handle,) = [int(f.name) for f in Path("/proc/self/fd").iterdir() if f.exists() and f.samefile(lock)]
        assert not os.get_inheritable(handle)


def test_a_killed_run_leaves_no_lock(tmp_path):
    program = "import os, sys\nfrom uwblite.io.folders import sole_writer\nwith sole_writer(sys.argv[1]):\n    os._exit(9)"
    environment = os.environ | {"PYTHONPATH": str(Path(uwblite.__file__).parents[1])}
    assert subprocess.run([sys.executable, "-c", program, tmp_path / "map"], env=environment, check=False).returncode == 9
    with sole_writer(tmp_path / "map"):
        pass


@pytest.mark.parametrize("place", ["new", "exchanged", "shared", "one by one"])
def test_writers_at_the_same_time_all_end_well_and_leave_one_whole_result(tmp_path, place, monkeypatch):
    folder = tmp_path / "map"
    if place != "new":
        folder.mkdir()
        (folder / "our_a").write_text("old")
    if place == "shared":
        (folder / "theirs").write_text("theirs")
    if place == "one by one":
        monkeypatch.setattr(folders, "_exchange", lambda one, other: False)

    def write(number):
        with replacing_folder(folder, lambda name: name.startswith("our")) as waiting:
            for name in ("our_a", "our_b", f"our_{number}"):
                (waiting / name).write_text(str(number))

    with ThreadPoolExecutor(8) as pool:
        for done in [pool.submit(write, number) for number in range(40)]:
            done.result()
    left = {p.name: p.read_text() for p in folder.iterdir()}
    assert left.pop("theirs", None) == ("theirs" if place == "shared" else None)
    [number] = set(left.values())
    assert set(left) == {"our_a", "our_b", f"our_{number}"}
    assert [p.name for p in tmp_path.iterdir()] == ["map"]
