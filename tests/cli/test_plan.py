"""`uwblite plan` as a user calls it."""

import csv
import json
import re

import numpy as np
import pytest
from helpers.planning_worlds import grid_of
from helpers.results import small_folder

from uwblite.cli import main
from uwblite.io.map_server import write_map
from uwblite.io.png import decode_png


@pytest.fixture
def rooms(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    wall = "#" * 8 + "." * 6 + "#" * 26
    write_map(tmp_path, grid_of("\n".join(["." * 40] * 20 + [wall] + ["." * 40] * 20)), name="rooms")
    return ["plan", "--map", "rooms.yaml", "--radius", "0.2"]


def test_a_path_goes_to_a_table_and_a_picture(rooms, tmp_path, capsys):
    words = [*rooms, "--from", "3,1,1.5", "--to", "3,3", "--via", "2,1", "--step", "0.2"]
    assert main(words) == 0
    output = capsys.readouterr().out
    assert output.splitlines()[-1] == "files: plan.csv plan.png"
    rows = list(csv.DictReader((tmp_path / "plan.csv").read_text().splitlines()))
    assert list(rows[0]) == ["x", "y", "theta", "distance", "clearance"]
    table = np.array([[float(v) for v in row.values()] for row in rows])
    assert table[0, :3] == pytest.approx([3.0, 1.0, 1.5])
    assert table[-1, :2] == pytest.approx([3.0, 3.0])
    assert table[:, 4].min() >= 0.2
    assert 2.0 in table[:, 0]
    pixels = decode_png((tmp_path / "plan.png").read_bytes()).astype(np.intp)
    assert len(np.unique(pixels @ [65536, 256, 1])) > 10
    assert main(words) == 1
    assert "exists" in capsys.readouterr().err
    assert main([*words, "--force", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert np.array(answer["poses"]) == pytest.approx(table[:, :3], abs=1e-4)
    assert answer["length"] == pytest.approx(table[-1, 3], abs=1e-4)


def test_a_picture_of_somebody_else_is_not_replaced(rooms, tmp_path, capsys):
    (tmp_path / "plan.png").write_bytes(b"mine")
    assert main([*rooms, "--from", "3,1", "--to", "3,1.5", "--force"]) != 0
    assert "plan.png was not written by uwblite" in capsys.readouterr().err
    assert (tmp_path / "plan.png").read_bytes() == b"mine"


def test_no_way_names_the_nearest_reachable_point_and_writes_nothing(rooms, tmp_path, capsys):
    words = [*rooms[:-1], "0.35", "--from", "3,1", "--to", "3,3", "--json"]
    assert main(words) == 1
    output = capsys.readouterr()
    assert "no path to (3.00, 3.00) with a radius of 0.35 m in cells of 0.1 m; the nearest reachable point is (" in output.err
    answer = json.loads(output.out)
    assert answer["exit_code"] == 1
    assert answer["nearest"][1] < 2.0
    assert not (tmp_path / "plan.csv").exists()
    assert main([*rooms, "--from", "3,2.05", "--to", "3,3"]) == 1
    assert "cannot stand at the start (3.00, 2.05)" in capsys.readouterr().err


def test_a_result_of_map_is_planned_in_with_its_anchors(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    small_folder(tmp_path / "map")
    words = ["plan", "--map", "map", "--radius", "0", "--from", "0,0", "--to", "1,-3.2", "--unknown", "price"]
    assert main(words) in (0, 1)
    assert "internal" not in capsys.readouterr().err
    (tmp_path / "map" / "map.yaml").unlink()
    assert main([*words, "--force"]) == 1
    assert "no map.yaml" in capsys.readouterr().err


@pytest.mark.parametrize("bad", [
    "--from 1", "--from 1,2,3,4", "--from 1e308,0", "--to nan,1", "--radius -1", "--radius 1e300", "--step 0",
])  # fmt: skip
def test_wrong_words_are_usage_errors(rooms, capsys, bad):
    assert main([*rooms, "--from", "3,1", "--to", "3,3", *bad.split()]) == 2
    assert "error" in capsys.readouterr().err


def test_a_start_in_unknown_space_is_said(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_map(tmp_path, grid_of("\n".join(["." * 40] * 20 + ["?" * 40] * 20)))
    words = ["plan", "--map", "map.yaml", "--radius", "0.2", "--from", "2,1", "--to", "2,3"]
    assert main(words) == 0
    # A metre to the first free row, the radius and at most three cells beyond.
    stated = float(re.search(r"the first (\S+) m leave it", capsys.readouterr().out)[1])
    assert 1.2 <= stated < 1.5
    assert main([*words, "--force", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["leaving"] == pytest.approx(stated, abs=0.005)
