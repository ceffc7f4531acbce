"""tools/quickstart: what it asks a new user to paste works, from any folder and with a bare environment."""

import os
import re
import shutil
import subprocess
import sys

import pytest
from conftest import ROOT

pytestmark = pytest.mark.skipif(os.name != "posix", reason="quickstart is a shell script")


@pytest.fixture
def clone(tmp_path):
    """A copy of what quickstart needs, in a folder with a blank in its name, installed already."""
    folder = tmp_path / "my robots" / "uwblite"
    for name in ("tools", "uwblite", "tests/data"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    programs = folder / ".venv" / "bin"
    programs.mkdir(parents=True)
    script(programs / "python", f'exec "{sys.executable}" "$@"')
    script(programs / "uwblite", f'PYTHONPATH="{folder}" exec "{sys.executable}" -m uwblite "$@"')
    (programs / "activate").write_text(f'PATH="{programs}:$PATH"\n')
    return folder


def script(path, line):
    path.write_text(f"#!/bin/sh\n{line}\n")
    path.chmod(0o755)


def in_bare_shell(commands, cwd):
    bare = {"PATH": "/usr/bin:/bin", "HOME": str(cwd)}
    return subprocess.run(["sh", "-e"], input=commands, cwd=cwd, env=bare, capture_output=True, text=True, check=False)


def to_paste(output):
    """Return the commands that quickstart shows, as the user would copy them."""
    return output.partition("Next, paste:\n")[2]


@pytest.mark.slow
def test_the_commands_it_ends_with_work_when_pasted(clone, tmp_path):
    done = in_bare_shell(f'"{clone}/tools/quickstart"', tmp_path)
    assert done.returncode == 0, done.stderr
    pasted = in_bare_shell(to_paste(done.stdout), tmp_path)
    assert pasted.returncode == 0, pasted.stdout + pasted.stderr
    assert "ATE" in pasted.stdout or "trajectory" in pasted.stdout
    for line in done.stdout.splitlines():
        if line.startswith(("The picture", "The report")):
            assert os.path.getsize(line.partition(":")[2].strip()) > 0


def test_every_document_that_sets_it_up_reports_how_to_go_on():
    """Whoever follows a page in its order has `uwblite` and `python` on the path before the first of them is used."""
    for page in (ROOT / "README.md", ROOT / "docs" / "getting_started.md"):
        text = page.read_text()
        assert text.index("tools/quickstart") < text.index(". .venv/bin/activate") < text.index("\nuwblite "), page.name
    for page in (ROOT / "CONTRIBUTING.md",):
        assert "\npython tools/" not in page.read_text(), "python may not exist; python3 or .venv/bin/python does"


def test_installing_it_puts_the_folder_on_the_path():
    """An import hook loses to the clone's own folder, which is a namespace package to whoever works beside it."""
    assert "--config-settings editable_mode=compat --editable" in (ROOT / "tools" / "quickstart").read_text()


def test_the_tests_that_continuous_integration_names_exist():
    text = (ROOT / ".ci" / "run").read_text()
    names = set(re.findall(r"\b(test_[a-z0-9_]+\.py|[a-z]+/test_[a-z0-9_]+\.py)", text))
    for start, stems in re.findall(r"((?:[a-z]+/)*test_)\{([a-z0-9_,]+)\}\.py", text):
        names |= {f"{start.removeprefix('tests/')}{stem}.py" for stem in stems.split(",")}
    assert len(names) >= 15
    assert [name for name in sorted(names) if not (ROOT / "tests" / name).is_file()] == []
