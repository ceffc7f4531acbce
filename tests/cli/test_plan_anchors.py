"""`uwblite plan-anchors` as a user calls it."""

import json

import numpy as np
import pytest
from helpers.results import small_folder

from uwblite.cli import main
from uwblite.io.png import decode_png


@pytest.fixture
def mapped(tmp_path):
    small_folder(tmp_path / "map")
    return tmp_path


@pytest.mark.slow
def test_places_go_to_a_table_and_a_picture(mapped, capsys):
    words = ["plan-anchors", "--map", str(mapped / "map"), "--count", "2", "--out", str(mapped / "plan")]
    assert main(words) == 0
    output = capsys.readouterr().out
    assert output.startswith("2 anchors today: expected error of a position")
    rows = (mapped / "plan.csv").read_text().splitlines()
    assert rows[0] == "id,x,y,mean_error,error_95"
    assert [row.split(",")[0] for row in rows[1:]] == ["new1", "new2"]
    image = decode_png((mapped / "plan.png").read_bytes())
    assert image.shape[1] > image.shape[0]
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 10
    assert main(words) == 1
    assert "exists" in capsys.readouterr().err
    assert main([*words, "--force", "--json", "--from-nothing"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["today"]["anchors"] == 0
    assert len(figures["anchors"]) == 2


def test_the_map_alone_is_planned_for_as_if_there_were_no_anchors(mapped, capsys):
    plans = []
    for words in (["--map", str(mapped / "map" / "map.yaml")], ["--map", str(mapped / "map"), "--from-nothing"]):
        assert main(["plan-anchors", *words, "--out", str(mapped / "alone"), "--force", "--json"]) == 0
        plans.append(json.loads(capsys.readouterr().out))
    assert plans[0]["today"]["anchors"] == 0
    assert plans[0]["anchors"] == plans[1]["anchors"]


def test_a_map_without_a_grid_and_no_map_at_all(mapped, capsys):
    (mapped / "map" / "map.yaml").unlink()
    assert main(["plan-anchors", "--map", str(mapped / "map")]) == 1
    assert "no map.yaml" in capsys.readouterr().err
    assert main(["plan-anchors", "--map", str(mapped)]) == 1
    assert "holds no result" in capsys.readouterr().err
