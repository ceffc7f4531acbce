"""Packages that single formats need: how to install one here, named by the error that misses it."""

import os
import shlex
import sys
import sysconfig
from pathlib import Path

from ..errors import ConfigError


def missing_package(package: str, purpose: str) -> ConfigError:
    """Return the error for a package that is not installed, with a command that installs it for this Python."""
    return ConfigError(f"{purpose} needs the package {package}: {install_command(package)}")


def install_command(package: str) -> str:
    """Return the shell command that gives this Python a package.

    A Python that belongs to the system refuses pip (PEP 668); there the command makes an environment that sees what the
    system has installed, uwblite included.
    """
    if "pipx" in Path(sys.prefix).parts:
        return f"pipx inject uwblite {package}"
    python = shlex.quote(sys.executable or "python3")
    if sys.prefix != sys.base_prefix or not os.path.exists(_marker()):
        return f"{python} -m pip install {package}"
    made = f"{python} -m venv --system-site-packages ~/uwb && ~/uwb/bin/pip install {package}"
    return f"{made}; then use ~/uwb/bin/python -m uwblite"


def _marker() -> str:
    """Return the file by which a system keeps pip away (PEP 668)."""
    return os.path.join(sysconfig.get_path("stdlib"), "EXTERNALLY-MANAGED")
