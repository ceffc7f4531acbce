"""The result's folder: complete, repeatable, replaced as a whole or not at all."""

import base64
import csv
import io
import json
import os
import re
import resource
import shutil
import signal
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
from helpers.results import EVIL, FILES, contents, small_log, small_result

from uwblite.errors import ConfigError
from uwblite.grid.occupancy_grid import OCCUPIED
from uwblite.io import folders, results
from uwblite.io.png import decode_png
from uwblite.io.result_text import RunRecord, anchors_csv, covariance_csv
from uwblite.io.results import check_target, write_result
from uwblite.io.stored_result import is_of_result, repair_result
from uwblite.io.tum import read_tum

SMALL_PICTURE = np.zeros((2, 3, 3), dtype=np.uint8)

RECORD = RunRecord("uwblite map run.log --out map_again", "use_uwb = true\n", {"uwblite": "0.1.0"})


@pytest.fixture
def small_picture(monkeypatch):
    """A picture of six pixels in every result: for tests of how files are exchanged, whatever is in them."""
    monkeypatch.setattr(results, "draw_map", lambda drawn, caption: SMALL_PICTURE)


def test_all_files_of_the_contract_are_written(tmp_path):
    names = write_result(tmp_path / "a" / "map", [small_log()], small_result(), RECORD)
    assert set(names) == set(contents(tmp_path / "a" / "map")) == FILES
    assert names[0] == "map.png"
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["map"]


def test_the_page_shows_the_picture_of_the_grid_a_pixel_a_cell(tmp_path):
    result = small_result()
    write_result(tmp_path / "map", [small_log()], result, RECORD)
    page = (tmp_path / "map" / "report.html").read_text()
    (shown,) = re.findall(r'<image class="grid"[^>]* href="data:image/png;base64,([^"]*)"', page)
    pixels = decode_png(base64.b64decode(shown))
    assert pixels.shape[:2] == result.grid.log_odds.shape
    dark = pixels.reshape(*pixels.shape[:2], -1)[..., 0] < 100
    np.testing.assert_array_equal(dark[::-1], result.grid.states() == OCCUPIED)


def test_a_folder_that_cannot_be_written_is_named(tmp_path, monkeypatch):
    """That which exists already, of those in which the result would lie."""
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path)
    with pytest.raises(PermissionError) as caught:
        check_target(tmp_path / "a" / "map", force=False)
    assert caught.value.filename == str(tmp_path)
    (tmp_path / "a").mkdir()
    check_target(tmp_path / "a" / "map", force=False)


def test_same_result_same_bytes(tmp_path):
    for name in ("one", "two"):
        write_result(tmp_path / name, [small_log()], small_result(seconds=len(name)), RECORD)
    assert contents(tmp_path / "one") == contents(tmp_path / "two")


def test_timings_are_the_only_difference_of_two_runs(tmp_path):
    for name, seconds in (("one", 1.5), ("two", 2.5)):
        record = replace(RECORD, seconds=seconds, reading_seconds=0.1 * seconds, peak_rss_bytes=int(1e6 * seconds))
        write_result(tmp_path / name, [small_log()], small_result(seconds=seconds), record)
    one, two = contents(tmp_path / "one"), contents(tmp_path / "two")
    assert {name for name in one if one[name] != two[name]} == {"report.json"}
    first, second = (json.loads(c["report.json"]) for c in (one, two))
    assert first.pop("timings")["total"] == 1.5
    assert second.pop("timings")["peak_rss_bytes"] == 2_500_000
    assert first == second


@pytest.mark.usefixtures("small_picture")
def test_report_json_holds_every_stage(tmp_path):
    write_result(tmp_path / "map", [small_log()], small_result(), RECORD)
    report = json.loads((tmp_path / "map" / "report.json").read_text())
    assert report["schema"] == 3
    assert report["inputs"][0]["sha256"] == "ab" * 32
    assert report["trusted"] is True
    assert [c["accepted"] for c in report["closures"]] == [True, False, False]
    assert report["closures"][1]["reason"] == "overlap too small"
    assert report["anchors"][0]["bias"] == 0.46
    assert report["calibration"][1]["reason"] == "the robot hardly turns"
    assert set(report["files"]) == FILES - {"report.json"}
    assert report["recording"]["scans"] == 24


def test_anchors_csv_survives_any_id():
    result = small_result(evil=EVIL + ',"\n')
    rows = list(csv.DictReader(io.StringIO(anchors_csv(result))))
    assert rows[0]["id"] == "5C0B" + EVIL + ',"\n'
    assert float(rows[0]["sigma_x"]) == pytest.approx(0.04)
    assert rows[1]["status"] == "mirror-ambiguous"
    assert (float(rows[1]["alternative_x"]), float(rows[1]["alternative_y"])) == (-4.0, 3.0)
    header = anchors_csv(result).splitlines()[0]
    assert header.startswith("id,x,y,sigma_x,sigma_y,ranges,used_share,bias,bias_sigma,residual_rms,status")


def test_an_unplaced_anchor_has_empty_fields():
    lost = replace(small_result().anchors[0], position=np.full(2, np.nan), covariance=np.full((2, 2), np.nan))
    row = next(csv.DictReader(io.StringIO(anchors_csv(replace(small_result(), anchors=(lost,))))))
    assert row["x"] == row["sigma_x"] == ""


def test_covariances_are_the_upper_triangle():
    result = small_result()
    lines = covariance_csv(result.keyframe_stamps, result.keyframe_covariances, result.keyframe_recording).splitlines()
    assert lines[0] == "stamp,xx,xy,xtheta,yy,ytheta,thetatheta,recording,trusted"
    assert [float(v) for v in lines[1].split(",")] == pytest.approx([1000.0, 1e-4, 0, 0, 2e-4, 0, 1e-5, 1, 1])
    assert len(lines) == 25


@pytest.mark.usefixtures("small_picture")
def test_each_recording_has_its_trajectory(tmp_path):
    write_result(tmp_path / "map", [small_log()], small_result(each=2), RECORD)
    stamps, _ = read_tum(tmp_path / "map" / "trajectory_2.tum")
    assert len(stamps) == 24
    assert stamps[0] == 1012.0
    for name in ("graph_stamps.csv", "trajectory_covariance.csv"):
        with (tmp_path / "map" / name).open() as file:
            rows = list(csv.DictReader(file))
        assert [row["recording"] for row in rows] == ["1"] * 24 + ["2"] * 24


@pytest.mark.usefixtures("small_picture")
def test_without_lidar_there_is_no_map_and_an_old_one_goes(tmp_path):
    folder = tmp_path / "map"
    write_result(folder, [small_log()], small_result(), replace(RECORD, scale_map=True))
    assert (folder / "map_scale.png").exists()
    (folder / "notes.txt").write_text("mine")
    write_result(folder, [small_log()], small_result(lidar=False), RECORD)
    assert set(contents(folder)) == (FILES - {"map.pgm", "map.yaml"}) | {"notes.txt"}


@pytest.mark.usefixtures("small_picture")
@pytest.mark.parametrize("foreign", ["beside nothing", "changed", "added", "instead of report.json"])
def test_a_file_that_uwblite_did_not_write_is_never_replaced(tmp_path, foreign):
    """A folder of pictures of one's own; a map that was cleaned up by hand; a file that the result did not have."""
    folder = tmp_path / "map"
    folder.mkdir()
    if foreign != "beside nothing":
        write_result(folder, [small_log()], small_result(lidar=foreign != "added"), RECORD)
    name = {"added": "map.pgm", "instead of report.json": "report.json"}.get(foreign, "map.png")
    (folder / name).write_bytes(b"mine")
    before = contents(folder)
    with pytest.raises(ConfigError, match=r"was not written by uwblite, or was changed since; move it away"):
        check_target(folder, force=True)
    with pytest.raises(ConfigError, match=r"was not written by uwblite"):
        write_result(folder, [small_log()], small_result(), RECORD)
    assert contents(folder) == before
    for file in folder.iterdir() if foreign == "instead of report.json" else [folder / name]:
        file.rename(tmp_path / file.name)
    write_result(folder, [small_log()], small_result(), RECORD)
    assert (tmp_path / name).read_bytes() == b"mine"


@pytest.mark.usefixtures("small_picture")
def test_an_earlier_result_is_not_replaced_unasked(tmp_path):
    folder = tmp_path / "map"
    check_target(folder, force=False)
    write_result(folder, [small_log()], small_result(), RECORD)
    with pytest.raises(ConfigError, match="`force`"):
        check_target(folder, force=False)
    check_target(folder, force=True)
    with pytest.raises(ConfigError, match="not a folder"):
        check_target(folder / "map.yaml", force=True)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").touch()
    check_target(tmp_path / "other", force=False)


@pytest.mark.usefixtures("small_picture")
@pytest.mark.parametrize("fresh", [True, False])
def test_a_full_disk_leaves_the_previous_result(tmp_path, monkeypatch, fresh):
    folder = tmp_path / "map"
    if not fresh:
        write_result(folder, [small_log()], small_result(), RECORD)
    before = contents(folder) if not fresh else {}

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(results, "render", full)
    with pytest.raises(OSError, match="No space"):
        write_result(folder, [small_log()], small_result(evil="x"), RECORD)
    assert (contents(folder) if folder.exists() else {}) == before
    assert [p.name for p in tmp_path.iterdir()] == ([] if fresh else ["map"])


def killed_behind(what, folder):
    """Write in a process of its own, killed behind a step; return how it ended."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    plain = getattr(results, what)

    def stop(*args, **options):
        plain(*args, **options)
        os.kill(os.getpid(), signal.SIGKILL)

    setattr(results, what, stop)
    write_result(folder, [small_log()], small_result(evil="x"), RunRecord("c", "k"))
    os._exit(0)


@pytest.mark.usefixtures("small_picture")
@pytest.mark.parametrize("what", ["write_png", "write_pyfg", "write_tum", "render", "summary"])
@pytest.mark.parametrize("fresh", [True, False])
def test_a_killed_writer_leaves_the_previous_result(tmp_path, what, fresh):
    folder = tmp_path / "map"
    if not fresh:
        write_result(folder, [small_log()], small_result(), RECORD)
    before = contents(folder) if not fresh else None
    assert killed_behind(what, folder) == -signal.SIGKILL
    visible = {p.name: p.read_bytes() for p in folder.iterdir() if not p.name.startswith(".")} if folder.exists() else None
    assert visible == before
    write_result(folder, [small_log()], small_result(), RECORD)
    assert set(contents(folder)) == FILES
    assert [p.name for p in tmp_path.iterdir()] == ["map"]


@pytest.mark.usefixtures("small_picture")
@pytest.mark.parametrize("foreign", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_kill_at_any_step_leaves_one_result_whole(tmp_path, monkeypatch, foreign):
    """Before every step by which names change, the writer is killed; the next reader finds the old result or the new one."""
    monkeypatch.setattr(os, "fsync", lambda handle: None)
    write_result(tmp_path / "new", [small_log()], small_result(evil="x"), RECORD)
    new = contents(tmp_path / "new")
    write_result(tmp_path / "old", [small_log()], small_result(lidar=False), RECORD)
    old = contents(tmp_path / "old")
    seen = set()
    for step in range(60):
        folder = tmp_path / "map"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(tmp_path / "old", folder)
        if foreign:
            (folder / "mine").mkdir()
            (folder / "mine" / "notes.txt").write_text("mine")
        ended = killed_at(step, folder)
        repair_result(folder)
        found = {name: data for name, data in files_of(folder).items() if is_of_result(name)}
        assert found in (old, new), step
        assert not foreign or (folder / "mine" / "notes.txt").read_text() == "mine"
        seen.add("new" if found == new else "old")
        if ended == 0:
            break
        assert ended == -signal.SIGKILL
    assert ended == 0
    assert step > (12 if foreign else 1)
    assert seen == {"old", "new"}


def killed_at(step, folder):
    """Write in a process of its own, killed before the given step; return how it ended."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    left = [step]

    def counted(plain):
        def call(*args, **options):
            if left[0] == 0:
                os.kill(os.getpid(), signal.SIGKILL)
            left[0] -= 1
            return plain(*args, **options)

        return call

    def complete(path, plain=folders.sync_files):
        if left[0] == step:
            os.replace, os.unlink, shutil.rmtree = counted(os.replace), counted(os.unlink), counted(shutil.rmtree)
            Path.unlink, folders._exchange = counted(Path.unlink), counted(folders._exchange)
        plain(path)

    folders.sync_files = complete
    write_result(folder, [small_log()], small_result(evil="x"), RECORD)
    os._exit(0)


def files_of(folder):
    return {p.name: p.read_bytes() for p in Path(folder).iterdir() if p.is_file()}


@pytest.mark.usefixtures("small_picture")
def test_a_result_in_use_by_others_keeps_its_folder(tmp_path, monkeypatch):
    folder = tmp_path / "map"
    write_result(folder, [small_log()], small_result(lidar=False), RECORD)
    folder.chmod(0o750)
    (tmp_path / "link").symlink_to(folder)
    write_result(tmp_path / "link", [small_log()], small_result(), RECORD)
    assert (tmp_path / "link").is_symlink()
    assert set(contents(folder)) == FILES
    assert folder.stat().st_mode & 0o777 == 0o750
    (folder / "notes.txt").write_text("mine")
    inode = folder.stat().st_ino
    write_result(folder, [small_log()], small_result(lidar=False), RECORD)
    assert folder.stat().st_ino == inode
    (folder / "notes.txt").unlink()
    monkeypatch.chdir(folder)
    write_result(".", [small_log()], small_result(), RECORD)
    assert (Path.cwd().stat().st_ino, set(contents("."))) == (inode, FILES)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["link", "map"]


@pytest.mark.usefixtures("small_picture")
def test_a_system_that_cannot_exchange_folders_renames_files(tmp_path, monkeypatch):
    folder = tmp_path / "map"
    write_result(folder, [small_log()], small_result(), RECORD)
    monkeypatch.setattr(folders, "_exchange", lambda one, other: False)
    write_result(folder, [small_log()], small_result(lidar=False, evil="x"), RECORD)
    assert set(contents(folder)) == FILES - {"map.pgm", "map.yaml"}
    assert [p.name for p in tmp_path.iterdir()] == ["map"]


@pytest.mark.usefixtures("small_picture")
def test_every_file_is_on_the_disk_before_it_counts(tmp_path, monkeypatch):
    """Each file and its folder are synced after their last write, before the name of the folder changes."""
    synced, events = set(), []
    plain_sync, plain_replace = os.fsync, os.replace

    def fsync(handle):
        synced.add(os.stat(handle).st_ino)
        plain_sync(handle)

    def replace_(old, new):
        if Path(old).is_dir():
            events.append({p.name for p in Path(old).iterdir() if p.stat().st_ino not in synced})
            assert Path(old).stat().st_ino in synced
        plain_replace(old, new)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(os, "replace", replace_)
    write_result(tmp_path / "map", [small_log()], small_result(), RECORD)
    assert events == [set()]


def write_within(folder, limit):
    """Write a result in a process whose files may have so many bytes; end with 7 where the error names the folder's file."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    try:
        write_result(folder, [small_log()], small_result(evil="x"), RunRecord("c", "k"))
    except OSError as error:
        os._exit(7 if str(error.filename).startswith(f"{folder}/") else 1)
    os._exit(0)


@pytest.mark.usefixtures("small_picture")
@pytest.mark.parametrize(("limit", "foreign"), [(0, True), (100, False), (3000, True), (9000, False)])
def test_running_out_of_space_leaves_the_previous_result(tmp_path, limit, foreign):
    folder = tmp_path / "map"
    write_result(folder, [small_log()], small_result(), RECORD)
    if foreign:
        (folder / "notes.txt").write_text("mine")
    before = contents(folder)
    writing = get_context("fork").Process(target=write_within, args=(folder, limit))
    writing.start()
    writing.join()
    assert writing.exitcode == 7
    assert contents(folder) == before
    assert [p.name for p in tmp_path.iterdir()] == ["map"]


@pytest.mark.usefixtures("small_picture")
def test_nothing_is_written_outside_the_folder(tmp_path):
    hostile = small_log(name="../../../etc/passwd\0\n.log")
    write_result(tmp_path / "map", [hostile], small_result(evil="/../../x"), RECORD)
    assert [p.name for p in tmp_path.iterdir()] == ["map"]
    assert set(contents(tmp_path / "map")) == FILES


@pytest.mark.usefixtures("small_picture")
def test_times_of_closures_keep_their_microseconds(tmp_path):
    result = small_result()
    late = replace(result, keyframe_stamps=1.7e9 + np.arange(len(result.keyframe_stamps)) * 0.123457)
    write_result(tmp_path / "map", [small_log()], late, RunRecord(command="", config=""))
    for closure in json.loads((tmp_path / "map" / "report.json").read_text())["closures"]:
        for end in "ij":
            assert abs(closure[f"stamp_{end}"] - late.keyframe_stamps[closure[end]]) < 1e-6


@pytest.mark.parametrize(
    ("preset", "changed", "line"),
    [
        ("", (), "defaults"),
        ("", ("use_loops=false",), "defaults with use_loops=false"),
        ("paper", ("a=1", "b=2"), "paper with a=1, b=2"),
    ],
)
def test_the_report_names_the_settings_that_were_changed(tmp_path, preset, changed, line):
    write_result(tmp_path / "map", [small_log()], small_result(), RunRecord("c", "", preset=preset, changed=changed))
    assert f"<td>{line}</td>" in (tmp_path / "map" / "report.html").read_text()
    assert json.loads((tmp_path / "map" / "report.json").read_text())["changed_settings"] == list(changed)
