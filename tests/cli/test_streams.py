"""Closed and full streams, Ctrl-C at any moment, and names that no terminal should see: one line each, and no traceback."""

import gzip
import json
import os
import signal
import subprocess
import sys
import threading
import time
import weakref
from pathlib import Path
from types import SimpleNamespace

import pytest

import uwblite
from uwblite.cli import console, main
from uwblite.cli.interruption import interruptible, stopped_by

ENVIRONMENT = os.environ | {
    "UWBLITE": f"{sys.executable} -m uwblite", "PYTHONPATH": str(Path(uwblite.__file__).parents[1])
}  # fmt: skip

LINES = 400
"""Of the small recording: 14 s of it."""
HOSTILE = b"s\xff\x1b[31m\nred.log"


def shell(command, folder, **names):
    """Run a shell command in which $UWBLITE is the program; return exit code, stdout and stderr."""
    done = subprocess.run(["sh", "-c", command], cwd=folder, env=ENVIRONMENT | names, capture_output=True, check=False)
    return done.returncode, done.stdout, done.stderr


@pytest.fixture(scope="module")
def folder(tmp_path_factory, room_log):
    folder = tmp_path_factory.mktemp("streams")
    with gzip.open(room_log) as packed:
        text = b"".join(packed.readlines()[:LINES])
    (folder / "small.log").write_bytes(text)
    with open(os.fsencode(folder) + b"/" + HOSTILE, "wb") as file:
        file.write(text)
    return folder


@pytest.mark.parametrize("words", ["--help", "--version", "map --help", "check small.log --json"])
def test_a_full_stdout_is_one_line(folder, words):
    code, _, output = shell(f"$UWBLITE {words} >/dev/full", folder)
    assert (code, output.count(b"\n")) == (1, 1)
    assert output.startswith(b"uwblite: error: stdout: No space left on device")


@pytest.mark.parametrize(
    ("words", "code", "streams"), [
        (words, code, streams)
        for words, code in (("--help", 0), ("check small.log", 0), ("frob", 2))
        for streams in (">&-", "2>&-", ">&- 2>&-", "2>/dev/full", ">&- 2>/dev/full <&-")
        # What loads numpy takes a second; the map below has no streams at all.
        if words in ("--help", "frob") or streams.endswith("<&-")
    ]
)  # fmt: skip
def test_the_work_is_done_without_anybody_who_listens(folder, words, code, streams):
    got, _, output = shell(f"$UWBLITE {words} {streams}", folder)
    assert got == code
    assert b"Traceback" not in output


def test_a_result_is_whole_though_nobody_listens(folder):
    code, _, _ = shell("$UWBLITE map small.log --out silent >&- 2>&-", folder)
    assert code in (0, 3)
    assert json.loads((folder / "silent" / "report.json").read_text())["files"]


def test_closed_standard_input_is_one_line(folder):
    code, _, output = shell("$UWBLITE check - <&-", folder)
    assert (code, output.count(b"\n")) == (1, 1)
    assert b"standard input is closed" in output


@pytest.mark.slow
def test_names_that_are_no_text_reach_no_terminal_and_spoil_no_result(folder):
    name = os.fsdecode(HOSTILE)
    for command in ('$UWBLITE check "$NAME"', '$UWBLITE map "$NAME" --out "$OUT" --force', '$UWBLITE check "$NAME.x"'):
        code, out, output = shell(command, folder, NAME=name, OUT=os.fsdecode(b"o\xff\x1bc"))
        assert code in (0, 1, 3), output
        assert (out + output).decode().replace("\n", "").isprintable()
        assert b"internal" not in output
    [made] = [p for p in folder.iterdir() if p.name.startswith("o")]
    report = json.loads((made / "report.json").read_text())
    assert report["inputs"][0]["source"].encode()
    assert b"\x1b" not in (made / "report.html").read_bytes()


def test_a_line_holds_nothing_that_a_terminal_obeys(capsys):
    console.say("a\x1b[2Jb\nc\u202ed\udcff")
    console.note("\x9b1m\r")
    console.fail("x\x07\ny", 1)
    console.Progress()("stage\x1b", 1, 2)
    out, output = capsys.readouterr()
    assert out == "a\\x1b[2Jb\\nc\\u202ed\\xff\n"
    assert output == "\\x9b1m\\r\nuwblite: error: x\\x07 y\n"
    main(["map", "\x1b[31mx.log", "y\x1b", "--out", "z", "--frob\x1b"])
    assert "\x1b" not in capsys.readouterr().err


INTERRUPTED = """
import os, signal, sys
class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == {name!r}:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Finder())
sys.argv = ["uwblite", "map", "small.log", "--out", "interrupted"]
from uwblite.__main__ import start
sys.exit(start())
"""


@pytest.mark.parametrize(
    "name",
    ["uwblite.cli", "argparse", "uwblite.cli.map", "numpy", "scipy.spatial"],
)  # fmt: skip
def test_ctrl_c_while_modules_load_is_one_line(folder, name):
    program = [sys.executable, "-c", INTERRUPTED.format(name=name)]
    done = subprocess.run(program, cwd=folder, env=ENVIRONMENT, capture_output=True, text=True, check=False, timeout=300)
    assert (done.returncode, done.stderr) == (130, "uwblite: interrupted\n")
    assert not (folder / "interrupted").exists()


def test_what_a_library_makes_of_ctrl_c_is_still_ctrl_c(monkeypatch, capsys):
    from uwblite.cli import config

    def broken(_):
        try:
            os.kill(os.getpid(), 2)
        except KeyboardInterrupt:
            raise ImportError("numpy could not be imported") from None

    monkeypatch.setattr(config, "run", broken)
    assert main(["config"]) == 130
    assert capsys.readouterr().err == "uwblite: interrupted\n"


def test_ctrl_c_in_a_callback_whose_exceptions_python_drops_is_none_the_less_ctrl_c(monkeypatch, capsys):
    from uwblite.cli import config

    class Module:
        """As a lock of Python's imports, whose end calls back."""

    def lost(_):
        module = Module()
        kept = weakref.ref(module, lambda _: os.kill(os.getpid(), signal.SIGINT))
        del module
        time.sleep(30)
        return len([kept])

    monkeypatch.setattr(config, "run", lost)
    hook = sys.unraisablehook
    assert main(["config"]) == 130
    assert capsys.readouterr().err == "uwblite: interrupted\n"
    assert sys.unraisablehook is hook


def test_until_ctrl_c_is_handled_nothing_is_imported_that_python_has_not_loaded():
    """Each module takes milliseconds, in which Ctrl-C would be a traceback."""
    program = "import sys; before = set(sys.modules); import uwblite.__main__; print(*sorted(set(sys.modules) - before))"
    done = subprocess.run(
        [sys.executable, "-c", program], env=ENVIRONMENT, capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.split() == ["uwblite", "uwblite.__main__"]


def test_in_a_thread_and_where_ctrl_c_is_ignored_signals_are_left_as_they_are():
    usual = signal.getsignal(signal.SIGINT)
    kept = []

    def look():
        with interruptible() as came:
            kept.append((came, signal.getsignal(signal.SIGINT)))

    thread = threading.Thread(target=look)
    thread.start()
    thread.join()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        look()
    finally:
        signal.signal(signal.SIGINT, usual)
    assert kept == [([], usual), ([], signal.SIG_IGN)]
    look()
    assert kept[-1][1] is not usual
    assert signal.getsignal(signal.SIGINT) is usual


def test_signals_that_stop_a_verb_are_kept_in_their_order_and_given_back():
    usual = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    with stopped_by(signal.SIGINT, signal.SIGTERM) as stopped:
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGINT)
        assert stopped == [signal.SIGTERM, signal.SIGINT]
    assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] == usual


def test_other_exceptions_that_python_drops_go_where_they_went(monkeypatch):
    dropped = []
    monkeypatch.setattr(sys, "unraisablehook", dropped.append)
    with interruptible() as came:
        sys.unraisablehook(SimpleNamespace(exc_type=ValueError))
        assert [error.exc_type for error in dropped] == [ValueError]
        assert came == []
