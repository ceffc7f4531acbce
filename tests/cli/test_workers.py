"""Who does the work: this process, some processes, or a scheduler that may be absent."""

import argparse
import contextlib
import multiprocessing
import os
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

import uwblite
from uwblite.cli import VERBS, main, workers
from uwblite.errors import ConfigError


def parsed(words):
    parser = argparse.ArgumentParser()
    VERBS["map"].add_arguments(parser)
    return parser.parse_args(["run.log", "--out", "map", *words])


def test_processes_and_a_scheduler_exclude_each_other(capsys):
    assert parsed(["--jobs", "3"]).jobs == 3
    assert parsed(["--scheduler", "tcp://head:8786"]).scheduler == "tcp://head:8786"
    with pytest.raises(SystemExit):
        parsed(["--jobs", "2", "--scheduler", "tcp://head:8786"])


def test_one_job_needs_no_executor_and_two_answer_in_order():
    with workers.workers(1) as executor:
        assert executor is None
    with workers.workers(2) as executor:
        assert list(executor.map(abs, range(-3, 3))) == [3, 2, 1, 0, 1, 2]


def waiting(name, folder):
    """Leave a file, and another one after longer than any test lasts."""
    (folder / name).touch()
    time.sleep(600.0)
    (folder / "done").touch()


def interrupted(executor, folder):
    """Hand out seven tasks and be interrupted once two of them run."""
    for name in "abcdefg":
        executor.submit(waiting, name, folder)
    while not {"a", "b"} <= {path.name for path in folder.iterdir()}:
        time.sleep(0.01)
    raise KeyboardInterrupt


def test_what_processes_do_ends_with_an_interrupt(tmp_path):
    """A pool hands out one task more than it has processes; Ctrl-C waits for none of them."""
    with pytest.raises(KeyboardInterrupt), workers.workers(2) as executor:
        interrupted(executor, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"a", "b"}
    assert not multiprocessing.active_children()


def test_without_the_package_the_command_that_installs_it_is_reported(monkeypatch, room_log, tmp_path, capsys):
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    assert main(["map", str(room_log), "--out", str(tmp_path / "map"), "--scheduler", "tcp://127.0.0.1:1"]) == 1
    output = capsys.readouterr().err
    assert "distributed" in output
    assert "pip" in output
    assert not (tmp_path / "map").exists()


def test_a_scheduler_that_does_not_answer_is_one_line(monkeypatch):
    pytest.importorskip("distributed", reason="dask.distributed is not installed (extra: cluster)")
    monkeypatch.setattr(workers, "_SECONDS_TO_CONNECT", 0.2)
    with (
        pytest.raises(ConfigError, match=r"no scheduler answers at tcp://127\.0\.0\.1:1 "),
        workers.cluster("tcp://127.0.0.1:1"),
    ):
        pass


def test_workers_with_another_uwblite_are_refused_and_other_libraries_named(monkeypatch, capsys):
    from uwblite.cli.workers import versions

    class Client:
        def __init__(self, theirs):
            self.theirs = theirs

        def run(self, function, on_error):
            assert on_error == "return"
            return self.theirs

    workers._compare_versions(Client({"a": versions()}))
    with pytest.raises(ConfigError, match=r"worker a has uwblite 0\.0, this is .*; install the same"):
        workers._compare_versions(Client({"a": {**versions(), "uwblite": "0.0"}}))
    with pytest.raises(ConfigError, match="worker b cannot import this uwblite"):
        workers._compare_versions(Client({"b": ModuleNotFoundError("No module named 'uwblite'")}))
    assert capsys.readouterr().err == ""
    workers._compare_versions(Client({"a": {**versions(), "numpy": "1.0"}}))
    assert "worker a has numpy 1.0 for" in capsys.readouterr().err
    workers._compare_versions(Client({}))
    assert "no worker yet" in capsys.readouterr().err


KILLED = """
import os, sys, time
from uwblite.cli.workers import processes

def number(_):
    time.sleep(0.3)
    return os.getpid()

if __name__ == "__main__":
    with processes(2) as executor:
        print(*set(executor.map(number, range(6))), flush=True)
        time.sleep(600)
"""


@pytest.mark.skipif(not hasattr(os, "getppid"), reason="needs the number of the parent")
def test_workers_end_with_the_process_that_started_them(tmp_path):
    """A worker that waits for work hears nothing of a main process that was killed, and would wait for ever."""
    (tmp_path / "killed.py").write_text(KILLED)
    environment = os.environ | {"PYTHONPATH": str(Path(uwblite.__file__).parents[1])}
    main_process = subprocess.Popen([sys.executable, "killed.py"], cwd=tmp_path, env=environment, stdout=subprocess.PIPE)
    found = [int(word) for word in main_process.stdout.readline().split()]
    main_process.kill()
    main_process.communicate(timeout=120)  # ends when the last worker has closed what it inherited
    assert len(found) == 2


def test_the_executor_of_a_scheduler_is_given_and_its_connection_closed(monkeypatch):
    seen = []

    class Client:
        def __init__(self, address, timeout):
            seen.append((address, timeout))

        def run(self, function, on_error):
            return {"a": function()}

        def get_executor(self, pure):
            seen.append(pure)
            return contextlib.nullcontext("executor")

        def close(self):
            seen.append("closed")

    monkeypatch.setitem(sys.modules, "distributed", SimpleNamespace(Client=Client))
    with workers.workers(1, "tcp://head:8786") as executor:
        assert executor == "executor"
    assert seen == [("tcp://head:8786", 10), False, "closed"]
    seen.clear()
    monkeypatch.setattr(workers, "_compare_versions", lambda client: (_ for _ in ()).throw(ConfigError("other")))
    with pytest.raises(ConfigError, match="other"), workers.cluster("tcp://head:8786"):
        pass
    assert seen[-1] == "closed"
