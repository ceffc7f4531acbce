"""The bundle for nav2, read by a reader of YAML and held against what its nodes ask for."""

import numpy as np
import pytest
from helpers.results import EVIL, small_folder

from uwblite.errors import ConfigError
from uwblite.grid.occupancy_grid import FREE, OCCUPIED, UNKNOWN
from uwblite.io.map_server import read_map
from uwblite.io.ros_results import FILES, write_nav2_bundle
from uwblite.io.stored_result import read_result

yaml = pytest.importorskip("yaml")


@pytest.fixture
def bundle(tmp_path):
    small_folder(tmp_path / "map")
    result = read_result(tmp_path / "map")
    assert write_nav2_bundle(tmp_path / "nav2", result) == FILES
    return tmp_path / "nav2", result


def read(folder, name):
    return yaml.safe_load((folder / name).read_text())


def test_every_node_finds_the_parameters_that_it_asks_for(bundle):
    folder, result = bundle
    assert sorted(p.name for p in folder.iterdir()) == sorted(FILES)
    params = read(folder, "nav2_params.yaml")
    assert "amcl" not in params
    servers = {name: part["ros__parameters"] for name, part in params.items() if "ros__parameters" in part}
    assert servers["lifecycle_manager_map"]["node_names"] == ["map_server", "filter_mask_server", "costmap_filter_info_server"]
    for name in ("map_server", "filter_mask_server"):
        assert (folder / servers[name]["yaml_filename"]).is_file()
        assert servers[name]["frame_id"] == "map"
    info = servers["costmap_filter_info_server"]
    assert (info["type"], info["base"], info["multiplier"]) == (0, 0.0, 1.0)
    assert info["mask_topic"] == servers["filter_mask_server"]["topic_name"]
    # A costmap looks for a topic without / in a namespace of its own.
    assert info["mask_topic"].startswith("/")
    assert info["filter_info_topic"].startswith("/")
    for name in ("global_costmap", "local_costmap"):
        costmap = params[name][name]["ros__parameters"]
        assert costmap["filters"][0] == "keepout_filter"
        assert costmap["keepout_filter"]["filter_info_topic"] == info["filter_info_topic"]
    # What comes after the mask sees it: the walls of unknown space are inflated too.
    assert params["global_costmap"]["global_costmap"]["ros__parameters"]["filters"][-1] == "inflation_layer"
    whole = params["global_costmap"]["global_costmap"]["ros__parameters"]
    assert all(whole[plugin]["plugin"].startswith("nav2_costmap_2d::") for plugin in (*whole["plugins"], *whole["filters"]))
    assert whole["resolution"] == pytest.approx(result.grid.geometry.resolution)


def test_map_and_mask_lie_upon_each_other(bundle):
    folder, result = bundle
    assert set(read(folder, "keepout_mask.yaml")) == set(read(folder, "map.yaml"))
    grid, mask = read_map(folder / "map.yaml"), read_map(folder / "keepout_mask.yaml")
    assert np.array_equal(grid.states(), result.grid.states())
    assert np.array_equal(grid.geometry.origin, mask.geometry.origin)
    assert np.array_equal(mask.states(), np.where(grid.states() == UNKNOWN, OCCUPIED, FREE))


def test_initial_pose_is_where_the_recording_ended(bundle):
    folder, result = bundle
    pose = read(folder, "initial_pose.yaml")
    assert pose["header"]["frame_id"] == "map"
    x, y, theta = result.trajectories[0][1][-1]
    place, turn = pose["pose"]["pose"]["position"], pose["pose"]["pose"]["orientation"]
    assert [place["x"], place["y"]] == pytest.approx([x, y], abs=1e-6)
    assert np.remainder(2 * np.arctan2(turn["z"], turn["w"]) - theta, 2 * np.pi) == pytest.approx(0.0, abs=1e-6)
    covariance = np.array(pose["pose"]["covariance"]).reshape(6, 6)
    assert all(isinstance(v, float) for v in pose["pose"]["covariance"])
    assert covariance[np.ix_((0, 1, 5), (0, 1, 5))] == pytest.approx(result.keyframe_covariances[-1], abs=1e-8)
    assert np.count_nonzero(covariance[2:5]) == 0


def test_anchors_keep_their_names_and_covariances(bundle):
    folder, result = bundle
    anchors = read(folder, "anchors.yaml")["anchors"]
    assert [a["id"] for a in anchors] == [a.id for a in result.anchors]
    for answer, anchor in zip(anchors, result.anchors, strict=True):
        assert answer["position"] == pytest.approx(anchor.position.tolist(), nan_ok=True)
        assert np.array(answer["covariance"]).reshape(2, 2) == pytest.approx(anchor.covariance, abs=1e-8, nan_ok=True)


def test_names_out_of_a_recording_are_text(tmp_path):
    small_folder(tmp_path / "map", evil=EVIL, command="uwblite map x", settings="")
    result = read_result(tmp_path / "map")
    write_nav2_bundle(tmp_path / "nav2", result)
    assert [a["id"] for a in read(tmp_path / "nav2", "anchors.yaml")["anchors"]] == [a.id for a in result.anchors]


def test_without_a_grid_there_is_no_bundle(tmp_path):
    small_folder(tmp_path / "map")
    (tmp_path / "map" / "map.yaml").unlink()
    with pytest.raises(ConfigError, match="nav2 needs a map"):
        write_nav2_bundle(tmp_path / "nav2", read_result(tmp_path / "map"))
    assert not (tmp_path / "nav2").exists()
