"""The package as users get it: wheel and sdist complete, clean and installable; one version everywhere."""

import email
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile

import pytest
from conftest import ROOT

import uwblite

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """Folder with a copy of what git knows."""
    folder = tmp_path_factory.mktemp("source")
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False).stdout
    for name in filter(None, listed.split("\0")) if listed else pytest.skip("no git checkout: what is built is not known"):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / name)
    return folder


@pytest.fixture(scope="module")
def built(source, tmp_path_factory):
    """Folder with wheel and sdist, built from a copy of the sources."""
    for package in ("build", "setuptools", "wheel"):
        if importlib.util.find_spec(package) is None:
            pytest.skip(f"{package} is absent")
    out = tmp_path_factory.mktemp("dist")
    subprocess.run(
        [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out), str(source)], check=True, capture_output=True
    )
    return out


def test_debians_own_tools_build_the_wheel_without_the_network(source, tmp_path):
    """setuptools 66 of Debian 12 knows no `license` that is a string; the document's command is the one that is run."""
    python = shutil.which("python3", path="/usr/bin")
    code = "from importlib.util import find_spec; import sys; sys.exit(not all(map(find_spec, ('pip', 'setuptools', 'wheel'))))"
    if python is None or subprocess.run([python, "-c", code], check=False).returncode:
        pytest.skip("the system's Python has no pip, setuptools and wheel")
    text = (ROOT / "docs" / "getting_started.md").read_text()
    (words,) = re.findall(r"^python3 -m (pip wheel .*)$", text, re.MULTILINE)
    copy, built = shutil.copytree(source, tmp_path / "copy"), tmp_path / "copy" / "out"
    done = subprocess.run([python, "-m", *words.split(), "--no-index"], cwd=copy, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (wheel,) = built.glob("*.whl")
    with zipfile.ZipFile(wheel) as packed:
        assert "uwblite/py.typed" in packed.namelist()
        assert any(n.endswith("LICENSE") for n in packed.namelist())


def test_the_wheel_is_pure_and_complete(built):
    (wheel,) = built.glob("*.whl")
    assert wheel.name == f"uwblite-{uwblite.__version__}-py3-none-any.whl"
    with zipfile.ZipFile(wheel) as packed:
        names = set(packed.namelist())
        metadata = email.message_from_bytes(packed.read(f"uwblite-{uwblite.__version__}.dist-info/METADATA"))
        entry = packed.read(f"uwblite-{uwblite.__version__}.dist-info/entry_points.txt").decode()
    modules = {p.relative_to(ROOT).as_posix() for p in (ROOT / "uwblite").rglob("*.py")} | {"uwblite/py.typed"}
    assert {n for n in names if ".dist-info/" not in n} == modules
    assert any(n.endswith("LICENSE") for n in names)
    assert metadata["Version"] == uwblite.__version__
    assert metadata["Requires-Python"] == ">=3.11"
    needed = {re.split(r"[<>=;\s]", r)[0] for r in metadata.get_all("Requires-Dist") if "extra" not in r}
    assert needed == {"numpy", "scipy", "pyserial"}
    assert not [r for r in metadata.get_all("Requires-Dist") if "<" in r.split(";")[0]]
    assert "uwblite = uwblite.__main__:start" in entry


def test_the_sdist_builds_the_same_wheel(built, tmp_path):
    (sdist,) = built.glob("*.tar.gz")
    with tarfile.open(sdist) as packed:
        packed.extractall(tmp_path, **({"filter": "data"} if hasattr(tarfile, "data_filter") else {}))
    (source,) = tmp_path.iterdir()
    command = [sys.executable, "-m", "build", "--no-isolation", "--wheel", "--outdir", str(tmp_path / "again"), str(source)]
    subprocess.run(command, check=True, capture_output=True)
    (first,), (second,) = built.glob("*.whl"), (tmp_path / "again").glob("*.whl")
    with zipfile.ZipFile(first) as one, zipfile.ZipFile(second) as two:
        assert sorted(one.namelist()) == sorted(two.namelist())


def test_the_sdist_carries_its_tests(built, tmp_path):
    """Everything that git knows is in it, so that whoever packages it can run the tests; a few of them are run here."""
    (sdist,) = built.glob("*.tar.gz")
    with tarfile.open(sdist) as packed:
        names = {name.partition("/")[2] for name in packed.getnames()}
        packed.extractall(tmp_path, **({"filter": "data"} if hasattr(tarfile, "data_filter") else {}))
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\n")
    assert {name for name in listed if name and not name.startswith(".git")} <= names
    (source,) = tmp_path.iterdir()
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "tests/io/test_tum.py", "tests/test_se2.py"]
    done = subprocess.run(command, cwd=source, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def test_twine_finds_nothing(built):
    if importlib.util.find_spec("twine") is None:
        pytest.skip("twine is absent")
    command = [sys.executable, "-m", "twine", "check", "--strict", *map(str, built.iterdir())]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def test_the_installed_wheel_maps(built, tmp_path, short_log):
    (wheel,) = built.glob("*.whl")
    site = tmp_path / "site"
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target", str(site), str(wheel)]
    subprocess.run(command, check=True, capture_output=True)
    environment = {**os.environ, "PYTHONPATH": str(site)}
    code = "import sys, uwblite; from uwblite.cli import main; print(uwblite.__file__); sys.exit(main(sys.argv[1:]))"
    done = subprocess.run(
        [sys.executable, "-c", code, "map", str(short_log), "--out", "map"],
        cwd=tmp_path, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode in (0, 3), done.stderr
    assert done.stdout.splitlines()[0].startswith(str(site))
    assert (tmp_path / "map" / "map.png").exists()


def test_the_changelog_and_citation_know_this_package():
    assert f"## {uwblite.__version__}" in (ROOT / "CHANGELOG.md").read_text()
    assert "arXiv:2106.03648" in (ROOT / "CITATION.cff").read_text()
