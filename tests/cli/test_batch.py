"""`uwblite batch`: a folder and a row for each recording, kept when it runs again, whatever becomes of the others."""

import argparse
import csv
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from conftest import ROOT
from helpers.results import contents

from uwblite.cli import VERBS, batch, console, main, memory
from uwblite.cli.inputs import name_recordings_once
from uwblite.errors import ConfigError
from uwblite.io.carmen import read_log, write_log


@pytest.fixture(scope="module")
def recordings(tmp_path_factory, room_log):
    """Three recordings: twenty seconds, what is none, and one whose tag measured nothing."""
    folder, log = tmp_path_factory.mktemp("recordings"), read_log(room_log)
    silent = replace(log.ranges, ranges=np.zeros(len(log.ranges.ranges)))
    write_log(folder / "monday.log", log.crop(0.0, 20.0))
    write_log(folder / "tuesday.log.gz", replace(log, ranges=silent).crop(60.0, 68.0))
    (folder / "notes.log").write_text("bread, milk\n")
    return [str(folder / name) for name in ("monday.log", "notes.log", "tuesday.log.gz")]


@pytest.fixture(scope="module")
def made(recordings, tmp_path_factory):
    """The batch of them, and its exit code."""
    out = tmp_path_factory.mktemp("batch") / "maps"
    return out, main(["batch", *recordings, "--out", str(out), "--no-timings", "-q"])


def rows(out):
    with open(out / "batch.csv", newline="") as stream:
        return list(csv.DictReader(stream))


def test_a_failure_does_not_stop_the_others_and_every_recording_has_a_row(made, recordings):
    out, code = made
    assert code == 1
    assert [row["recording"] for row in rows(out)] == recordings
    assert [row["outcome"] for row in rows(out)] == ["mapped", "failed", "doubted"]
    assert "no odometry in 1 lines" in rows(out)[1]["reason"]
    assert sorted(p.name for p in out.iterdir()) == ["batch.csv", "batch.html", "monday", "tuesday"]


def test_the_figures_are_those_of_the_reports(made):
    for row in (rows(made[0])[k] for k in (0, 2)):
        report = json.loads((made[0] / row["folder"] / "report.json").read_text())
        assert int(row["ranges"]) == report["recording"]["ranges"]
        assert int(row["anchors"]) == len(report["anchors"]) == 4
        assert float(row["width"]) == pytest.approx(report["map"]["cols"] * report["map"]["resolution"], abs=0.005)


def test_the_page_leads_to_every_report(made):
    page = (made[0] / "batch.html").read_text()
    assert page.count("report.html") == 2
    assert "3 recordings: 1 mapped; 1 doubted; 1 failed" in page


def test_each_map_is_the_one_that_map_makes(made, recordings, tmp_path):
    main(["map", recordings[2], "--out", str(tmp_path / "alone"), "--no-timings", "-q"])
    assert contents(tmp_path / "alone") == contents(made[0] / "tuesday")


def inode(folder):
    """Return what changes where a folder is exchanged for another."""
    return os.stat(folder).st_ino


def test_what_is_finished_is_kept_and_what_was_made_otherwise_is_not_replaced_unasked(made, recordings, tmp_path, capsys):
    out = tmp_path / "maps"
    one = [*recordings[:1], "--out", str(out), "--without", "lidar"]
    assert main(["batch", *one]) in (0, 3)
    first = inode(out / "monday")
    assert main(["batch", *one]) in (0, 3)
    assert "1 of 1 recordings are mapped already" in capsys.readouterr().err
    assert inode(out / "monday") == first
    assert main(["batch", *one, "--set", "keyframes.distance=0.5"]) == 1
    assert "already holds a result" in rows(out)[0]["reason"]
    assert inode(out / "monday") == first
    assert main(["batch", *one, "--set", "keyframes.distance=0.5", "--force"]) in (0, 3)
    assert inode(out / "monday") != first


def test_a_table_of_another_s_is_not_replaced(recordings, tmp_path, capsys):
    (tmp_path / "batch.csv").write_text("mine\n")
    assert main(["batch", *recordings[:1], "--out", str(tmp_path), "--force"]) == 1
    assert "was not written by uwblite" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["batch.csv"]


def test_maps_at_a_time_that_may_not_fit_are_named(recordings, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(memory, "limits", lambda: [memory.Limit("the limit of this test", 400_000_000)])
    words = ["batch", *recordings[:1], "--out", str(tmp_path / "maps"), "--without", "lidar", "--jobs", "4"]
    assert main(words) in (0, 3)
    said = capsys.readouterr().err
    assert f"{recordings[0]}: 4 such maps at a time need about" in said
    assert "fewer --jobs" in said


def test_a_process_that_is_killed_costs_its_own_recording_alone(recordings, tmp_path, monkeypatch):
    """As the system does where memory runs out; processes that are forked know the function that is put in here."""
    monkeypatch.setattr(batch, "map_one", killed_on_notes)
    tasks = batch.tasks_of(batch_args(recordings, tmp_path))
    outcomes = dict(batch._outcomes(dict(enumerate(tasks)), batch_args(recordings, tmp_path, "--jobs", "2")))
    assert [bool(outcomes[k].error) for k in range(3)] == [False, True, False]
    assert "killed" in outcomes[1].error


def killed_on_notes(task):
    if task.logs[0].endswith("notes.log"):
        os.kill(os.getpid(), signal.SIGKILL)
    return batch.Outcome()


def batch_args(recordings, out, *more):
    import argparse

    parser = argparse.ArgumentParser()
    VERBS["batch"].add_arguments(parser)
    return parser.parse_args([*recordings, "--out", str(out), *more])


@pytest.mark.slow
def test_a_batch_that_is_killed_goes_on_where_it_was_and_is_alone_in_its_folder(made, recordings, tmp_path):
    """It stands still after a row, a second batch is refused, and it is killed; the same command again makes the same bytes."""
    out = tmp_path / "maps"
    words = [sys.executable, "-m", "uwblite", "batch", *recordings, "--out", str(out), "--no-timings", "-q"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    first = subprocess.Popen(words, env=environment, start_new_session=True)
    try:
        while not (out / "batch.csv").exists() or not rows(out):
            assert first.poll() is None
            time.sleep(0.02)
        os.killpg(first.pid, signal.SIGSTOP)
        other = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=120)
        assert other.returncode == 1
        assert f"another run is writing {out}" in other.stderr
    finally:
        os.killpg(first.pid, signal.SIGKILL)
        first.wait()
    assert len(rows(out)) < len(recordings)
    kept = inode(out / "monday")
    again = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=300)
    assert again.returncode == made[1]
    assert inode(out / "monday") == kept
    for name in ("monday", "tuesday"):
        assert contents(out / name) == contents(made[0] / name)


def test_folders_have_the_names_of_the_recordings():
    assert batch.folder_names(["a/x.log", "b/y.log.gz", "z.mcap", "csv/"]) == ["x", "y", "z", "csv"]
    assert batch.folder_names(["a/run.log", "b/run.log", "c/other.log"]) == ["a_run", "b_run", "other"]
    with pytest.raises(ConfigError, match=r"a/run.log and a/run.log.gz would both go to the folder a_run"):
        batch.folder_names(["a/run.log", "a/run.log.gz"])


def test_wrong_settings_are_one_error_before_anything_is_done(recordings, tmp_path, capsys):
    assert main(["batch", *recordings, "--out", str(tmp_path / "maps"), "--set", "gird.resolution=1"]) == 2
    assert not (tmp_path / "maps").exists()


def test_json_is_one_object(made, recordings, capsys):
    assert main(["batch", *recordings, "--out", str(made[0]), "--no-timings", "--json", "-q"]) == 1
    answer = json.loads(capsys.readouterr().out)
    assert [row["outcome"] for row in answer["recordings"]] == ["mapped", "failed", "doubted"]


@pytest.mark.slow
def test_a_cluster_makes_the_same_bytes_though_a_worker_is_killed(made, recordings, tmp_path):
    pytest.importorskip("distributed", reason="dask.distributed is not installed (extra: cluster)")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    ready, running = tmp_path / "scheduler.json", []

    def start(what, *words):
        words = [sys.executable, "-m", "distributed.cli.dask_" + what, *words, "--no-dashboard"]
        running.append(subprocess.Popen(words, env=environment, stderr=subprocess.DEVNULL))
        return running[-1]

    try:
        start("scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(ready))
        # It is there for a moment before it is written.
        while not ready.exists() or not ready.read_text().rstrip().endswith("}"):
            time.sleep(0.05)
        address = json.loads(ready.read_text())["address"]
        one, _ = (start("worker", address, "--nthreads", "1", "--no-nanny") for _ in range(2))
        words = ["batch", *recordings, "--out", str(tmp_path / "maps"), "--no-timings", "-q", "--scheduler", address]
        running.append(work := subprocess.Popen([sys.executable, "-m", "uwblite", *words], env=environment))
        while not (tmp_path / "maps" / "batch.csv").exists() or not rows(tmp_path / "maps"):
            time.sleep(0.05)
        one.kill()
        assert work.wait(timeout=120) == made[1]
    finally:
        for process in running:
            process.kill()
            process.wait()
    for name in ("monday", "tuesday"):
        assert contents(tmp_path / "maps" / name) == contents(made[0] / name)
    assert contents_of_table(tmp_path / "maps") == contents_of_table(made[0])


def contents_of_table(out):
    return [(out / f"batch.{kind}").read_bytes() for kind in ("csv", "html")]


def test_a_recording_that_is_named_twice_counts_once(room_log, tmp_path, monkeypatch):
    """As `*.log` names the parts of one that was cut; counted twice, all its errors would seem smaller than they are."""
    other = tmp_path / "other.log"
    other.touch()
    said = []
    monkeypatch.setattr(console, "note", said.append)
    args = argparse.Namespace(logs=[str(room_log), str(other), str(room_log)])
    for _ in range(2):
        name_recordings_once(args)
        assert args.logs == [str(room_log), str(other)]
    [text] = said
    assert "3 files are 2 recordings" in text
