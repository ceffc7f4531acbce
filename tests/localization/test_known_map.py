"""What a localisation takes from a map's folder."""

import re
from dataclasses import replace

import numpy as np
import pytest
from helpers.results import small_log, small_result

from uwblite.errors import FormatError
from uwblite.io.results import RunRecord, write_result
from uwblite.io.stored_result import StoredAnchor, read_result
from uwblite.localization.known_map import from_result, known_anchors


def test_ranges_are_corrected_by_what_the_maps_own_left_over(tmp_path):
    result = small_result()
    table = {**result.range_table, "residual": np.full(len(result.range_table["stamp"]), 0.3)}
    write_result(tmp_path / "map", [small_log()], replace(result, range_table=table), RunRecord("", ""))
    known = from_result(read_result(tmp_path / "map"))
    assert known.anchors.ids == ("5C0B",)
    on_path = known.anchors.errors[0].at(result.graph.poses[:5, :2])
    # Measured minus expected of 0.3 m: ranges were 0.3 m long.
    np.testing.assert_allclose(on_path, 0.3, atol=0.05)
    (tmp_path / "map" / "range_errors.csv").write_text("stamp,anchor,error,x,y,theta\n1,5C0B,oops,0,0,0\n")
    with pytest.raises(FormatError, match="oops"):
        from_result(read_result(tmp_path / "map"))
    (tmp_path / "map" / "range_errors.csv").unlink()
    assert from_result(read_result(tmp_path / "map")).anchors.errors == ()


def test_the_bend_of_the_map_is_in_the_pose_where_it_is(tmp_path):
    result = small_result()
    bent = np.stack([np.diag([4e-4, 1e-4, 1e-6]), np.diag([0.04, 0.01, 1e-4])])
    poses = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 1.0]])
    stated = replace(result, shape_poses=poses, shape_covariances=bent)
    write_result(tmp_path / "map", [small_log()], stated, RunRecord("", ""))
    known = from_result(read_result(tmp_path / "map"))
    near, far = known.covariance_at(np.array([[1.0, 1.0], [9.0, 0.0]]))
    np.testing.assert_allclose(far - near, bent[1] - bent[0])
    report = tmp_path / "map" / "report.json"
    for broken in ('"shape": 3', '"shape": {"poses": [[0, 0, 0]], "covariances": [[[1]]]}'):
        text = re.sub(r'"shape": \{[^}]*\}', broken, report.read_text())
        assert broken in text
        report.write_text(text)
        plain = from_result(read_result(tmp_path / "map"))
        assert np.isfinite(plain.covariance_at(np.zeros(2))).all()
        assert not len(plain.shape[0])
        report.write_text(text.replace(broken, '"shape": {}'))


def anchors_of(*rows):
    return tuple(StoredAnchor(name, np.array([x, 0.0]), np.eye(2), status) for name, status, x in rows)


def test_of_a_moved_anchor_the_last_place_counts_even_where_it_is_unsure():
    stored = anchors_of(("A", "ok", 0.0), ("A@2", "ok", 5.0), ("B", "ok", 1.0), ("B@2", "mirror-ambiguous", 9.0))
    found = known_anchors(stored, {})
    assert found.ids == ("A",)
    np.testing.assert_array_equal(found.positions, [[5.0, 0.0]])
