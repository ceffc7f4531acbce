"""What the page is told of a result: its drawing, accepted closures first, anchors as they are in the table."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from helpers.results import small_folder

from uwblite.constraints import Constraints
from uwblite.io.stored_result import read_result
from uwblite.server.shown_results import described, shown_result


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shown") / "hall"
    small_folder(folder, command="uwblite map run.log", settings="x = 1")
    return read_result(folder)


def shown(result):
    return json.loads(json.dumps(described(shown_result(result, "grid.png"), Constraints()), allow_nan=False))


def test_everything_is_plain_json_with_accepted_closures_first(stored):
    page = shown(stored)
    assert page["name"] == "hall"
    accepted = [c["accepted"] for c in page["closures"]]
    assert accepted == sorted(accepted, reverse=True)
    assert [c["number"] for c in page["closures"]] == [0, 1, 2]
    assert [int(k) for k in re.findall('data-closure="(.)"', page["svg"])] == [0, 1, 2]
    assert (page["accepted"], page["candidates"]) == (1, 3)
    np.testing.assert_allclose(page["anchors"][0]["sigma"], [0.04, 0.02])
    assert page["anchors"][0]["pinned"] is None


def test_the_picture_lies_where_the_grid_does(stored):
    geometry = stored.grid.geometry
    image = re.search('<image[^>]*>', shown(stored)["svg"])[0]
    x, y, width, height = (float(re.search(f'{name}="([^"]*)"', image)[1]) for name in (" x", "y", "width", "height"))
    np.testing.assert_allclose([x, -y - height], geometry.origin)
    np.testing.assert_allclose([x + width, -y], geometry.corner)


def test_a_result_without_a_grid_has_no_picture(stored):
    bare = shown_result(replace(stored, grid=None), "grid.png")
    assert bare.grid_png is None
    assert "<image" not in bare.svg


def test_a_long_path_is_thinned_from_its_start(stored):
    poses = np.column_stack([np.arange(9001.0), np.zeros(9001), np.zeros(9001)])
    svg = shown(replace(stored, trajectories=((np.arange(9001.0), poses),)))["svg"]
    path = re.search('class="path path0" points="([^"]*)"', svg)[1].split()
    assert len(path) <= 4000
    xs = [float(p.split(",")[0]) for p in path]
    assert (xs[0], xs[-1]) == (0.0, 9000.0)
    assert np.ptp(np.diff(xs[:-1])) == 0.0


def test_an_anchor_without_a_place_has_none(stored):
    lost = replace(stored.anchors[0], position=np.full(2, np.nan), covariance=np.full((2, 2), np.nan))
    page = shown(replace(stored, anchors=(lost, *stored.anchors[1:])))
    assert page["anchors"][0]["place"] is None
    assert page["anchors"][0]["sigma"] is None
    assert re.findall('data-anchor="(.)"', page["svg"]) == ["1"]
