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


def drawn(monkeypatch, *calls, columns=80):
    """Return what a bar writes that is called at times, s: (time, stage, done, total, share)."""
    stream, now = Terminal(), [0.0]
    progress = console.Progress(stream, clock=lambda: now[0])
    monkeypatch.setattr(progress, "_columns", lambda: columns)
    pieces = []
    for now[0], *call in calls:
        before = len(stream.getvalue())
        progress(*call)
        pieces.append(stream.getvalue()[before:])
    return progress, stream, pieces


def test_a_bar_is_drawn_ten_times_a_second_at_most_and_at_the_end_of_a_stage(monkeypatch):
    calls = [(1.0, "grid", 1, 9), (1.05, "grid", 2, 9), (1.1, "grid", 3, 9), (1.15, "grid", 9, 9), (1.16, "summary", 1, 9)]
    progress, stream, pieces = drawn(monkeypatch, *calls)
    assert [bool(piece) for piece in pieces] == [True, False, True, True, True]
    assert pieces[0] == f"\r{console.progress_line('grid', 1 / 9, 0.0)}"
    # The line of another stage is wiped before.
    assert pieces[4].startswith("\r" + " " * len(console.progress_line("grid", 1.0, 0.0)) + "\r\r[")
    progress.close()
    assert stream.getvalue().endswith("\r" + " " * len(console.progress_line("summary", 1 / 9, 0.0)) + "\r")
    before = stream.getvalue()
    progress.close()
    assert stream.getvalue() == before


def test_a_bar_states_the_time_left_of_its_stage_or_of_the_whole(monkeypatch):
    calls = [(10.0, "grid", 0, 4), (20.0, "grid", 1, 4), (30.0, "grid", 1, 4, 0.5), (31.0, "grid", 5, 0)]
    _, _, pieces = drawn(monkeypatch, *calls)
    assert "about" not in pieces[0]
    assert "[#####               ]  25 %  grid  about 30.0 s left" in pieces[1]
    assert "[##########          ]  50 %  grid  about 30.0 s left" in pieces[2]
    assert pieces[3].rstrip(" ") == "\rgrid ..."
    assert len(pieces[3]) == len(pieces[2])


def test_a_bar_is_no_wider_than_the_terminal_and_has_nothing_that_it_obeys(monkeypatch):
    _, _, pieces = drawn(monkeypatch, (1.0, "a\x1b[31m stage with a long name", 1, 2), columns=40)
    assert pieces[0] == "\r" + "[##########          ]  50 %  a\\x1b[31m stage"[:39]


def test_a_line_takes_the_place_of_the_bar_which_is_quiet_where_that_is_wanted(monkeypatch, capsys):
    progress, stream, _ = drawn(monkeypatch, (1.0, "grid", 1, 2))
    for write in (console.say, console.note, lambda text: console.fail(text, 1)):
        progress._draw("bar")
        write("text")
        assert stream.getvalue().endswith("\rbar\r   \r") or stream.getvalue().endswith("\r   \r")
    progress.close()
    console.set_up(quiet=True)
    assert not console.Progress(Terminal()).active
    assert [console.fail("why", code) for code in (1, 130)] == [1, 130]
    assert capsys.readouterr().err.endswith("uwblite: error: why\nuwblite: why\n")


@pytest.mark.parametrize(
    ("share", "elapsed", "told"),
    [(0.05, 10.0, False), (0.06, 10.0, True), (0.5, 2.0, False), (0.5, 2.1, True), (1.0, 10.0, False), (-1.0, 10.0, False)],
)
def test_the_time_left_is_told_once_something_is_known_of_it(share, elapsed, told):
    assert ("left" in console.progress_line("grid", share, elapsed)) is told


class Full(io.StringIO):
    """A stream behind which a disk is full, or a reader is gone."""

    def __init__(self, error):
        super().__init__()
        self.error = error

    def write(self, text):
        raise self.error

    def fileno(self):
        raise ValueError


@pytest.mark.parametrize(
    ("error", "lost"),
    [(OSError(28, "No space left on device"), "stdout: No space left on device; free some"), (BrokenPipeError(), "")],
)
def test_a_stdout_that_takes_nothing_is_told_at_the_end_and_a_reader_that_left_is_not(monkeypatch, capsys, error, lost):
    monkeypatch.setattr("sys.stdout", Full(error))
    console.say("result")
    assert console.flush() is not bool(lost)
    assert (f"uwblite: error: {lost}" if lost else "") in capsys.readouterr().err
    assert console.flush()
    assert capsys.readouterr().err == ""
    monkeypatch.setattr("sys.stderr", Full(error))
    console.note("nobody reads that")
    assert console.flush()


@pytest.mark.parametrize(
    ("number", "hint"),
    [
        (13, "; check who owns it, or choose another place"),
        (30, "; choose a place that can be written to"),
        (5, ""),
        (None, ""),
    ],
)
def test_an_error_of_the_system_has_its_place_and_the_way_out_where_there_is_one(number, hint):
    assert console.os_error_text(OSError(number, "why", "x.log")) == f"x.log: why{hint}"
    assert console.os_error_text(OSError(number, "why")) == f"why{hint}"
    assert console.os_error_text(TimeoutError()) == "TimeoutError"
    assert console.os_error_text(OSError("words")) == "words"
