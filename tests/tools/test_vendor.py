"""A part of the package, copied under another name, does its work and has nothing besides."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ROOT

import uwblite

spec = importlib.util.spec_from_file_location("vendor", ROOT / "tools" / "vendor.py")
vendor = importlib.util.module_from_spec(spec)
spec.loader.exec_module(vendor)

SOLVE = """
import numpy as np
from acme._copy.graph.graph import Graph
from acme._copy.graph.pose_edges import RelativePoseEdges
from acme._copy.graph import point_edges, range_edges
from acme._copy.graph.solver import optimize
edges = RelativePoseEdges([0, 1, 0], [1, 2, 2], [[1, 0, 0], [1, 0, 0], [2, 0, 0]], [np.eye(3)] * 3)
solved, summary = optimize(Graph(np.zeros((3, 3)), edges=(edges,)))
assert summary.converged and abs(solved.poses[2, 0] - 2.0) < 1e-9
"""
WORK = {
    "map": """
from acme._copy import MappingConfig, build_map, read_log
from acme._copy.config import override
from acme._copy.io.results import write_result
from acme._copy.io.result_text import RunRecord
log = read_log(ROOM).crop(end=20.0)
result = build_map(log, override(MappingConfig(), ["grid.resolution=0.1"]))
write_result("out", [log], result, RunRecord("", ""))
assert result.grid is not None
""",
    "solve": SOLVE,
    "covariances": SOLVE
    + """
from acme._copy.graph.marginals import marginals
assert marginals(solved).covariances.poses.shape == (3, 3, 3)
""",
    "localize": """
from acme._copy.io.carmen import read_log
from acme._copy.localization import Localizer
from acme._copy.localization.known_map import from_result
from acme._copy.localization.localize import localize
from acme._copy.io.stored_result import read_result
""",
    "drivers": """
import sys
sys.modules["numpy"] = sys.modules["scipy"] = sys.modules["serial"] = None
from acme._copy.drivers.devices import open_device
session, port = open_device("lidar", "ld06:/dev/ttyUSB0")
session.start(0.0)
session.feed(b"\\x00" * 50, 0.1)
""",
    "record": """
import sys
sys.modules["numpy"] = sys.modules["scipy"] = None
from acme._copy.drivers import devices, link, log_file, recorder, transport
""",
}
"""What a program does with each part."""


def test_every_part_is_tested():
    assert set(WORK) == set(vendor.PARTS)


@pytest.mark.parametrize("part", [pytest.param(p, marks=pytest.mark.slow) if p == "map" else p for p in WORK])
def test_a_copy_works_under_another_name(part, tmp_path, room_log):
    target = tmp_path / "acme" / "_copy"
    count, size = vendor.copy(part, target)
    (target.parent / "__init__.py").touch()
    code = f"import sys; ROOM = {str(room_log)!r}\n{WORK[part]}\nassert not [m for m in sys.modules if m.startswith('uwblite')]"
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "OPENBLAS_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    words = [sys.executable, "-c", code]
    done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    files = [f for f in target.rglob("*") if f.is_file()]
    assert (count, size) == (len(files), sum(f.stat().st_size for f in files))
    assert (target / "LICENSE").read_bytes() == (ROOT / "LICENSE").read_bytes()
    assert f"uwblite {uwblite.__version__}" in (target / "VERSION").read_text()
    assert f"for: {part}" in (target / "VERSION").read_text()


def test_a_copy_holds_what_it_needs_and_no_more():
    files = {part: vendor.files_for(modules) for part, modules in vendor.PARTS.items()}
    rooms = {part: {f.relative_to(vendor.PACKAGE).parts[0] for f in found} for part, found in files.items()}
    assert len(files["solve"]) < len(files["covariances"]) < 30
    assert rooms["covariances"] <= {"graph", "arrays.py", "config.py", "errors.py", "se2.py"}
    assert rooms["drivers"] <= {"drivers", "clocks", "errors.py"}
    assert "cli" not in set().union(*rooms.values())
    assert "server" not in set().union(*rooms.values())


def test_the_package_itself_names_its_licence():
    assert "SPDX-License-Identifier: MIT" in Path(uwblite.__file__).read_text()


def test_what_is_there_is_not_lost(tmp_path, monkeypatch, capsys):
    (tmp_path / "mine.py").touch()
    for words in (["--for", "drivers"], ["--for", "drivers", "--force"]):
        monkeypatch.setattr(sys, "argv", ["vendor.py", str(tmp_path), *words])
        with pytest.raises(SystemExit):
            vendor.main()
    assert "no earlier copy" in capsys.readouterr().err
    assert (tmp_path / "mine.py").exists()
    monkeypatch.setattr(sys, "argv", ["vendor.py", str(tmp_path / "a"), "--for", "drivers"])
    assert vendor.main() == 0
    assert "for drivers: drivers.devices" in capsys.readouterr().out
    monkeypatch.setattr(sys, "argv", ["vendor.py", str(tmp_path / "a"), "--for", "drivers", "--force"])
    assert vendor.main() == 0
