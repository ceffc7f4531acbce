"""The documents: every command runs, every example works, every link leads somewhere, the generated page is current."""

import argparse
import fnmatch
import importlib
import importlib.util
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import make_docs
import pytest
from conftest import ROOT

from uwblite.cli import VERBS, main
from uwblite.config import leaves
from uwblite.io.constraints_file import parse_constraints
from uwblite.io.uwb_mapping import parse_mappings
from uwblite.map_result import OUTCOMES
from uwblite.pipeline.mapping_config import MappingConfig

DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def blocks(document, language):
    """Yield (words behind the language, text) of the fenced blocks of a language."""
    for info, text in re.findall(r"^```(.*?)\n(.*?)^```", document.read_text(), re.M | re.S):
        words = info.split()
        if words and words[0] == language:
            yield words[1:], text


def commands(text):
    """Return the commands of a shell block as lists of words."""
    lines = text.replace("\\\n", " ").splitlines()
    return [words for line in lines if (words := shlex.split(line, comments=True))]


def parses(words):
    """Return whether the command line understands these words, without running them."""
    if words in (["--version"], ["--help"]):
        return True
    parser = argparse.ArgumentParser(allow_abbrev=False, exit_on_error=False)
    VERBS[words[0]].add_arguments(parser)
    for option in ("-q", "-v", "--debug"):
        parser.add_argument(option, action="store_true")
    try:
        parser.parse_args(words[1:])
    except (SystemExit, argparse.ArgumentError):
        return False
    return True


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda p: p.name)
def test_every_command_is_understood(document):
    for _, text in blocks(document, "sh"):
        for words in commands(text):
            name = words[0].rsplit("/", 1)[-1]
            if name == "uwblite":
                assert parses(words[1:]), words


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda p: p.name)
def test_every_setting_that_is_named_exists(document):
    """By its group, in backticks or behind --set; a star stands for the rest of a name."""
    known = {name for name, _ in leaves(MappingConfig)}
    groups = {name.partition(".")[0] for name in known if "." in name}
    marked = " ".join(re.findall(r"`[^`\n]+`|--set \S+", document.read_text()))
    named = re.findall(r"(?<![/\w.])([a-z_]+)\.([a-z_]+\*?|\*)(?![\w(/.])", marked)
    named = {f"{group}.{rest}" for group, rest in named if group in groups and rest not in ("py", "md", "csv", "yaml")}
    assert {name for name in named if not any(fnmatch.fnmatch(k, name) for k in known)} == set()


@pytest.mark.parametrize("verb", VERBS)
def test_the_examples_of_every_verb_are_understood(verb):
    epilog = VERBS[verb].epilog
    examples = [re.sub(r"\s\s+\S.*", "", line.strip()) for line in epilog.replace("\\\n", " ").splitlines()]
    examples = [re.sub(r"\s+", " ", line) for line in examples if line.startswith("uwblite ")]
    assert examples
    for line in examples:
        words = shlex.split(line.split(" > ")[0].replace("...", ""))
        if verb != "record" or "--out" in words:
            assert parses(words[1:]), line


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    """A folder with what the README has made of the sample recording: run.log, second.log and the truth; and their map."""
    folder = tmp_path_factory.mktemp("prepared")
    (folder / "tests").symlink_to(ROOT / "tests")
    [text] = [text for info, text in blocks(ROOT / "README.md", "sh") if "sample" in info]
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.chdir(folder)
        for words in commands(text):
            if words[0] == "uwblite":
                assert main(words[1:]) == 0
            elif words[0] == "cd":
                monkeypatch.chdir(words[1])
            else:
                subprocess.run(words, check=True)
        # What git ignores is all that the documents' commands leave in a clone.
        assert {p.name for p in folder.iterdir()} == {"tests", "out"}
        assert main(["map", "run.log", "--out", "map", "-q"]) == 0
        return Path.cwd()


@pytest.fixture
def workspace(prepared, tmp_path, monkeypatch):
    """A folder as a reader of the README has it before the first map."""
    shutil.copytree(prepared, tmp_path, symlinks=True, ignore=shutil.ignore_patterns("map"), dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def needed(words):
    """Return the package that a block needs and that is not installed."""
    package = {"evo": "evo", "bag": "rosbags"}.get(words[0]) if words else None
    return package if package and importlib.util.find_spec(package) is None else None


@pytest.mark.slow
@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda p: p.name)
def test_every_command_runs(document, prepared, workspace, capsys):
    skipped = []
    for info, text in blocks(document, "sh"):
        if "norun" in info or "sample" in info:
            continue
        if package := needed(info):
            skipped.append(package)
            continue
        if "map" in info:
            provide_map(prepared)
        for words in commands(text):
            if words[0] == "tools/quickstart":
                assert " ".join(words) in (ROOT / ".ci" / "run").read_text()
                continue
            if words == [".", ".venv/bin/activate"]:
                continue
            assert words[0] != "cd", "the documents stay in the folder of the README"
            allowed = (0, 3) if words[1:2] in (["map"], ["check"]) else (0,)
            if words[0] == "uwblite":
                code, output = main(words[1:]), capsys.readouterr()
            else:
                environment = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg", "HOME": str(workspace)}
                done = subprocess.run(
                    [shutil.which(words[0]) or tool_beside(words[0]), *words[1:]],
                    capture_output=True, text=True, check=False, timeout=300, env=environment,
                )  # fmt: skip
                code, output = done.returncode, done.stdout + done.stderr
            assert code in allowed, f"{words}: {output}"
    if skipped:
        pytest.skip(f"absent: {', '.join(skipped)}; the other commands ran")


def provide_map(prepared):
    """Make the folder map that a block begins with."""
    shutil.rmtree("map", ignore_errors=True)
    shutil.copytree(prepared / "map", "map")


def tool_beside(name):
    """Return a program installed beside this Python."""
    return os.path.join(os.path.dirname(sys.executable), name)


@pytest.mark.slow
@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda p: p.name)
def test_every_python_example_works(document, prepared, workspace, capsys):
    for info, text in blocks(document, "python"):
        if "map" in info:
            provide_map(prepared)
        exec(compile(text, document.name, "exec"), {})


@pytest.mark.slow
def test_every_python_example_passes_mypy(tmp_path):
    files = []
    for document in DOCUMENTS:
        for number, (_, text) in enumerate(blocks(document, "python")):
            files.append(tmp_path / f"{document.stem.lower()}_{number}.py")
            files[-1].write_text(text)
    assert len(files) >= 10
    words = [sys.executable, "-m", "mypy", "--config-file", str(ROOT / "pyproject.toml"), "--strict", *map(str, files)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_sample_mappings_are_valid():
    for info, text in blocks(ROOT / "docs" / "formats.md", "toml"):
        assert parse_constraints(text) if "constraints" in info else parse_mappings(text)


@pytest.mark.parametrize("document", [*DOCUMENTS, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"], ids=lambda p: p.name)
def test_links_within_the_repository_lead_somewhere(document):
    for target in re.findall(r"\]\(([^)#]+)", document.read_text()):
        if "://" not in target:
            assert (document.parent / target).exists(), target


def test_the_generated_pages_are_current(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["make_docs.py", "--check"])
    assert make_docs.main() == 0, capsys.readouterr().out


def test_first_screen_of_the_readme():
    head = (ROOT / "README.md").read_text().splitlines()[:25]
    assert any(line.startswith("![") for line in head)
    assert any(line.startswith("tools/quickstart test ") for line in head)
    assert any("What it is not" in line for line in head)


KIND = re.compile(r"""\b(?:warn|doubt|warning|Finding|add|say)\(\s*f?"([a-z{}.a-z-]+)",""")


def test_every_kind_of_warning_and_doubt_is_listed():
    """Kinds that name a status, like ``anchor-{anchor.status}``, are listed one by one."""
    page = (ROOT / "docs" / "formats.md").read_text()
    listed = set(re.findall(r"`([a-z-]+)`", page[page.index("### Warnings and doubts") :].split("\n## ")[0]))
    sources = [file.read_text() for file in (ROOT / "uwblite").rglob("*.py")]
    used = {kind for source in sources for kind in KIND.findall(source)}
    assert len(used) > 20
    missing = {kind for kind in used if kind not in listed and "{" not in kind}
    assert not missing
    assert {f"anchor-{status}" for status in ("unplaced", "mirror-ambiguous", "distrusted")} <= listed
    assert set(OUTCOMES) <= listed


@pytest.mark.parametrize("page", sorted(p.relative_to(ROOT / "docs").as_posix() for p in (ROOT / "docs").rglob("*.md")))
def test_every_page_is_linked_from_the_readme(page):
    assert f"docs/{page}" in (ROOT / "README.md").read_text()
