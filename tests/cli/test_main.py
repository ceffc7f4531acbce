"""The command line's frame: verbs, exit codes, errors as one line, nothing heavy before it is needed."""

import errno
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

import uwblite
from uwblite import __version__
from uwblite.cli import VERBS, main
from uwblite.cli.console import os_error_text


def run(*words, **options):
    return subprocess.run(
        [sys.executable, "-m", "uwblite", *words], capture_output=True, text=True, check=False, timeout=120, **options
    )


def test_help_leads_with_examples_and_names_verbs_and_exit_codes(capsys):
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    assert text.index("examples:") < text.index("commands:") < text.index("exit codes:")
    for verb in VERBS:
        assert re.search(rf"^  {verb} +\w", text, re.M), verb


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_explains_itself_examples_first(verb, capsys):
    assert main([verb, "--help"]) == 0
    text = capsys.readouterr().out
    assert text.startswith(f"usage: uwblite {verb}")
    assert text.index("examples:") < text.index("common options")


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"uwblite {__version__}\n"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "usage: uwblite"),
        (["mpa"], "unknown command 'mpa'; did you mean 'map'?"),
        (["xyzzy"], "unknown command 'xyzzy'\n"),
        (["-q"], "needs a command"),
        (["map"], "required"),
        (["map", "x.log", "--out", "y", "--no-such"], "--no-such"),
        (["map", "x.log", "--out", "y", "--laser-pose", "-1,2"], "'-1,2' is not 3 numbers"),
        (["map", "x.log", "--out", "y", "--jobs", "0"], "above 0"),
        (["map", "x.log", "--out=--"], "argument --out: '--' is no value"),
        (["check", "x.log", "--scan-topic=--"], "argument --scan-topic: '--' is no value"),
    ],
)
def test_wrong_usage_exits_with_2(words, message, capsys):
    assert main(words) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("content", [b"", b"\0\1\2binary", b"\x1f\x8b\x08\0broken gzip", b"hello\nworld\n"])
def test_a_bad_log_is_one_line_and_exit_1(tmp_path, content, capsys):
    file = tmp_path / "bad.log"
    file.write_bytes(content)
    for words in (["map", str(file), "--out", str(tmp_path / "out")], ["check", str(file)]):
        assert main(words) == 1
        out, err = capsys.readouterr()
        assert out == ""
        assert re.fullmatch(r"uwblite: error: [^\n]*bad\.log[^\n]*\n", err)
    assert not (tmp_path / "out").exists()


def test_a_folder_and_a_missing_file_are_one_line(tmp_path, capsys):
    for path in (tmp_path, tmp_path / "missing.log"):
        assert main(["map", str(path), "--out", str(tmp_path / "out")]) == 1
        assert capsys.readouterr().err.count("\n") == 1


def test_standard_input_is_read(short_log, monkeypatch, capsys):
    import gzip
    import io

    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(gzip.decompress(short_log.read_bytes()))))
    assert main(["check", "-"]) == 0
    assert "361 odometry readings" in capsys.readouterr().out


def test_an_unforeseen_fault_is_one_line_and_a_traceback_on_request(monkeypatch, capsys):
    from uwblite.cli import config

    def fault(_):
        raise ZeroDivisionError("x")

    monkeypatch.setattr(config, "run", fault)
    assert main(["config"]) == 1
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "internal error: ZeroDivisionError: x" in err
    assert main(["config", "--debug"]) == 1
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (KeyboardInterrupt(), 130, "uwblite: interrupted"),
        (MemoryError(), 1, "out of memory"),
        (OSError(28, "No space left on device", "map.pgm"), 1, "map.pgm: No space left on device; free some space"),
        (ImportError("libx.so: failed to map segment"), 1, "error: a library could not be loaded: libx.so: failed to map"),
    ],
)
def test_what_the_system_throws(monkeypatch, capsys, error, code, message):
    from uwblite.cli import config

    def fault(_):
        raise error

    monkeypatch.setattr(config, "run", fault)
    assert main(["config"]) == code
    assert message in capsys.readouterr().err


def test_a_current_folder_that_is_gone_is_said():
    command = f'mkdir gone && cd gone && rmdir ../gone && "{sys.executable}" -m uwblite batch x.log --out y'
    environment = os.environ | {"PYTHONPATH": str(Path(uwblite.__file__).parents[1])}
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(command, shell=True, capture_output=True, text=True, check=False, cwd=folder, env=environment)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert done.stderr.startswith("uwblite: error: the current folder is no more")


def test_a_file_that_fails_is_named_even_where_the_current_folder_is_gone(tmp_path, monkeypatch):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert os_error_text(OSError(errno.EACCES, "denied", "/x.log")).startswith("/x.log: denied; check who owns it")
    assert os_error_text(OSError(errno.ENOENT, "not there")).startswith("the current folder is no more")


def test_a_reader_that_leaves_early_does_not_disturb():
    done = subprocess.run(
        f"{sys.executable} -m uwblite map --help | head -1", shell=True, capture_output=True, text=True, check=False, timeout=60
    )
    assert done.stderr == ""
    assert done.stdout.count("\n") == 1


def test_settings_are_printed_checked_and_overridden(tmp_path, capsys):
    assert main(["config", "--set", "grid.resolution=0.02"]) == 0
    text = capsys.readouterr().out
    assert "resolution = 0.02" in text
    assert "# " in text
    file = tmp_path / "my.toml"
    file.write_text(text)
    assert main(["config", "--config", str(file), "--no-comments"]) == 0
    assert "resolution = 0.02" in capsys.readouterr().out
    file.write_text("[grid]\nresolutoin = 1\n")
    assert main(["config", "--config", str(file)]) == 2
    assert "did you mean 'grid.resolution'" in capsys.readouterr().err
    assert main(["config", "--config", str(tmp_path / "none.toml")]) == 1
    assert main(["config", "--preset", "papre"]) == 2
    assert "papre" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("growth.drift=1", "unknown setting 'growth'"),
        ("loop_closure.uniqueness=1", "it is now a constant of LoopClosureConfig, 0.85"),
        ("loop_closure.partnerz=1", "did you mean 'loop_closure.partners'"),
        ("turn_laser=false", "unknown setting 'turn_laser'"),
    ],
)
def test_names_of_settings_that_are_gone_report_what_became_of_them(setting, words, tmp_path, capsys):
    assert main(["config", "--set", setting]) == 2
    assert words in capsys.readouterr().err
    name, value = setting.split("=")
    file = tmp_path / "old.toml"
    file.write_text(f"{name} = {value}\n")
    assert main(["config", "--config", str(file)]) == 2
    output = capsys.readouterr().err
    assert words in output
    assert output.count("\n") == 1


def test_advanced_settings_are_listed_on_request_and_where_they_were_changed(capsys):
    def listed(*words):
        assert main(["config", "--no-comments", *words]) == 0
        return capsys.readouterr().out

    assert "slow_share" not in listed()
    assert "slow_share = 0.5" in listed("--all")
    assert "slow_share = 0.0" in listed("--preset", "paper")
    assert listed().count(" = ") <= 70


@pytest.mark.parametrize("verb", ["map", "localize", "check", "record"])
def test_numbers_that_begin_with_a_minus_need_no_equals_sign(verb, capsys):
    needed = {"localize": ["--map", "nowhere"], "check": []}.get(verb, []) + ([] if verb == "check" else ["--out", "nowhere/x"])
    log = [] if verb == "record" else ["missing.log"]
    assert main([verb, *log, *needed, "--laser-pose", "-0.1,0,-1e-3", "--tag", "-.05,0,.6"]) in (1, 2)
    assert "expected one argument" not in capsys.readouterr().err


PLAN = {"--map": "map", "--from": "0,0", "--to": "1,1", "--radius": "0.2"}


@pytest.mark.parametrize("missing", PLAN)
def test_a_plan_needs_a_map_both_ends_and_a_radius(missing, capsys):
    assert main(["plan", *(word for pair in PLAN.items() if pair[0] != missing for word in pair)]) == 2
    assert f"the following arguments are required: {missing}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "output"),
    [
        (["map", "x.log", "--out", "y", "--resolutoin", "1"], "unknown option --resolutoin; did you mean --resolution?"),
        (["map", "x.log", "--out", "y", "--resolutoin=1"], "unknown option --resolutoin; did you mean --resolution?"),
        (["check", "a.log", "b.log"], "one argument too many: b.log"),
        (["map", "x.log"], "the following arguments are required: --out"),
    ],
)
def test_a_usage_error_is_short_and_reports_what_was_meant(words, output, capsys):
    assert main(words) == 2
    first, second = capsys.readouterr().err.splitlines()
    assert first == f"uwblite {words[0]}: error: {output}"
    assert second == f"`uwblite {words[0]} --help` shows the options, examples first"


def test_numerical_libraries_have_one_thread_and_small_pages_unless_the_environment_says_otherwise():
    names = ["OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMPY_MADVISE_HUGEPAGE"]
    code = f"import os; from uwblite.__main__ import start; start(); print(*map(os.getenv, {names}))"
    environment = {k: v for k, v in os.environ.items() if k not in names} | {"OMP_NUM_THREADS": "3"}
    program = [sys.executable, "-c", code, "--version"]
    done = subprocess.run(program, env=environment, capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.splitlines()[-1] == "1 3 1 0"
