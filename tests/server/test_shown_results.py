"""What the page is told of a result: thinned paths, accepted closures first, where the picture lies."""

import json
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


def test_everything_is_plain_json_with_accepted_closures_first(stored):
    shown = json.loads(json.dumps(described(shown_result(stored), Constraints()), allow_nan=False))
    assert shown["name"] == "hall"
    accepted = [c["accepted"] for c in shown["closures"]]
    assert accepted == sorted(accepted, reverse=True)
    assert [c["number"] for c in shown["closures"]] == [0, 1, 2]
    assert (shown["accepted"], shown["candidates"]) == (1, 3)
    np.testing.assert_allclose(shown["anchors"][0]["sigma"], [0.04, 0.02])
    assert shown["anchors"][0]["pinned"] is None


def test_the_picture_lies_where_the_grid_does(stored):
    geometry = stored.grid.geometry
    image = described(shown_result(stored), Constraints())["image"]
    np.testing.assert_allclose([image["x"], image["y"]], geometry.origin)
    np.testing.assert_allclose([image["x"] + image["width"], image["y"] + image["height"]], geometry.corner)


def test_a_result_without_a_grid_has_no_picture(stored):
    bare = shown_result(replace(stored, grid=None))
    assert bare.grid_png is None
    assert described(bare, Constraints())["image"] is None


def test_a_long_path_is_thinned_from_its_start(stored):
    poses = np.column_stack([np.arange(7001.0), np.zeros(7001), np.zeros(7001)])
    long = replace(stored, trajectories=((np.arange(7001.0), poses),))
    path = described(shown_result(long), Constraints())["paths"][0]
    assert len(path) <= 3000
    assert path[0] == [0.0, 0.0]
    steps = np.diff(np.array(path)[:, 0])
    assert (steps == steps[0]).all()


def test_an_anchor_without_a_place_has_none(stored):
    lost = replace(stored.anchors[0], position=np.full(2, np.nan), covariance=np.full((2, 2), np.nan))
    shown = described(shown_result(replace(stored, anchors=(lost, *stored.anchors[1:]))), Constraints())
    assert shown["anchors"][0]["place"] is None
    assert shown["anchors"][0]["sigma"] is None
