"""The console: what goes where, the bar on a terminal only, readers that leave early."""

import io
import logging

import pytest
from helpers.results import small_log, small_result

from uwblite.cli import console, main
from uwblite.io.result_text import RunRecord
from uwblite.io.results import write_result


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_report_and_note_go_to_their_streams(capsys):
    console.say("result")
    console.note("beside")
    assert capsys.readouterr() == ("result\n", "beside\n")


def test_quiet_drops_notes_only(capsys):
    console.set_up(quiet=True)
    console.say("result")
    console.note("beside")
    assert capsys.readouterr() == ("result\n", "")


def test_an_error_is_one_line(capsys):
    assert console.fail("first\nsecond", 1) == 1
    assert capsys.readouterr().err == "uwblite: error: first second\n"


def test_what_ascii_cannot_write_does_no_harm(monkeypatch):
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr("sys.stdout", stream)
    console.say("sal\u00f3n: x 12.31 \u00b10.04 m")
    stream.flush()
    assert stream.buffer.getvalue() == b"sal?n: x 12.31 +-0.04 m\n"


def test_progress_is_silent_off_a_terminal():
    stream = io.StringIO()
    progress = console.Progress(stream)
    progress("closures", 1, 2)
    assert stream.getvalue() == ""


def test_progress_draws_time_left_and_is_wiped():
    now = iter([0.0, 10.0, 20.0])
    stream = Terminal()
    progress = console.Progress(stream, clock=lambda: next(now))
    progress("closures", 0, 4)
    progress("closures", 1, 4)
    assert "25 %  closures  about 30.0 s left" in stream.getvalue()
    progress.close()
    assert stream.getvalue().endswith("\r")


@pytest.mark.parametrize(
    ("share", "text"),
    [
        (None, "grid ..."),
        (0.2, f"[####{' ' * 16}]  20 %  grid  about 12.0 s left"),
        (1.4, f"[{'#' * 20}] 100 %  grid"),
    ],
)
def test_progress_line(share, text):
    assert console.progress_line("grid", share, 3.0) == text


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.04, "0.0 s"), (59.96, "1 min 00 s"), (245, "4 min 05 s"), (3720, "1 h 02 min")]
)
def test_durations(seconds, text):
    assert console.duration(seconds) == text


def test_operating_system_errors_report_the_way_out():
    assert console.os_error_text(OSError(28, "No space left on device", "map.pgm")) == (
        "map.pgm: No space left on device; free some space, or write to another disk with --out"
    )
    assert console.os_error_text(FileNotFoundError(2, "No such file or directory", "x.log")) == (
        "x.log: No such file or directory; check the spelling"
    )


def test_how_much_is_said_is_chosen_by_every_command_anew(tmp_path, capsys):
    """Quiet, it says of two recordings in one map nothing beside its result; the next command does."""
    record = RunRecord("uwblite map run.log again.log", "")
    write_result(tmp_path / "map", [small_log(), small_log(name="again.log")], small_result(each=2), record)
    for words, said in ((["-q"], False), ([], True), (["--quiet"], False)):
        assert main(["convert", str(tmp_path / "map"), str(tmp_path / "path.tum"), "--force", *words]) == 0
        output = capsys.readouterr()
        assert ("holds 2 trajectories" in output.err) is said
        assert "24 poses" in output.out
    levels = {(): logging.WARNING, ("-v",): logging.INFO, ("-vv",): logging.DEBUG, ("-q",): logging.ERROR}
    for words, level in levels.items():
        assert main(["convert", str(tmp_path / "map"), str(tmp_path / "path.tum"), "--force", *words]) == 0
        assert logging.getLogger("uwblite").level == level
