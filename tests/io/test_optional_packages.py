"""The advice to install a package is a command that works for the Python it is given to."""

import subprocess
import sys

import pytest

from uwblite.io import optional_packages
from uwblite.io.optional_packages import install_command, missing_package


def test_in_an_environment_pip_is_that_of_the_environment(monkeypatch):
    monkeypatch.setattr(sys, "prefix", "/home/me/a b")
    monkeypatch.setattr(sys, "executable", "/home/me/a b/bin/python")
    assert install_command("rosbags") == "'/home/me/a b/bin/python' -m pip install rosbags"


def test_pipx_has_its_own_way(monkeypatch):
    monkeypatch.setattr(sys, "prefix", "/home/me/.local/share/pipx/venvs/uwblite")
    assert install_command("rosbags") == "pipx inject uwblite rosbags"


def test_a_system_that_refuses_pip_is_not_reported_to_use_it(monkeypatch, tmp_path):
    marker = tmp_path / "EXTERNALLY-MANAGED"
    monkeypatch.setattr(optional_packages, "_marker", lambda: str(marker))
    monkeypatch.setattr(sys, "prefix", sys.base_prefix)
    monkeypatch.setattr(sys, "executable", "/usr/bin/python3")
    assert install_command("rosbags") == "/usr/bin/python3 -m pip install rosbags"
    marker.touch()
    command = install_command("rosbags")
    assert command.startswith("/usr/bin/python3 -m venv --system-site-packages ~/uwb && ~/uwb/bin/pip install rosbags")


def test_the_error_names_purpose_and_command():
    error = missing_package("rosbags", "reading bags")
    assert str(error) == f"reading bags needs the package rosbags: {install_command('rosbags')}"


@pytest.mark.slow
def test_the_command_runs(tmp_path):
    """The pip that is named exists and answers (a dry run of a package that is there already needs no network)."""
    command = install_command("numpy").replace("install", "install --dry-run --no-index --no-deps").replace("~", str(tmp_path))
    done = subprocess.run(["sh", "-c", command.partition(";")[0]], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
