"""A result that was written is read back as it was."""

import json
import shutil

import numpy as np
import pytest
from helpers.results import small_log, small_result

from uwblite.errors import FormatError
from uwblite.io.result_text import RunRecord
from uwblite.io.results import write_result
from uwblite.io.stored_result import read_result


@pytest.fixture(scope="module", params=[1, 2])
def made(request, tmp_path_factory):
    folder, result = tmp_path_factory.mktemp("made") / "map", small_result(each=request.param)
    write_result(folder, [small_log()] * request.param, result, RunRecord("uwblite map x", ""))
    return result, folder


@pytest.fixture
def written(made, tmp_path):
    """A result and a folder of its own."""
    shutil.copytree(made[1], tmp_path / "map")
    return made[0], tmp_path / "map"


def test_everything_comes_back(written):
    result, folder = written
    back = read_result(folder)
    assert len(back.trajectories) == len(np.unique(result.recording))
    np.testing.assert_allclose(np.concatenate([p for _, p in back.trajectories])[:, :2], result.trajectory[:, :2], atol=1e-6)
    np.testing.assert_allclose(back.keyframe_covariances, result.keyframe_covariances, rtol=1e-5)
    np.testing.assert_allclose(back.keyframe_stamps, result.keyframe_stamps, atol=1e-6)
    np.testing.assert_array_equal(back.keyframe_recordings, result.keyframe_recording + 1)
    assert [a.id for a in back.anchors] == [a.id for a in result.anchors]
    for one, two in zip(back.anchors, result.anchors, strict=True):
        np.testing.assert_allclose(one.position, two.position, atol=1e-6)
        np.testing.assert_allclose(one.covariance, two.covariance, atol=1e-6)
    assert [c.accepted for c in back.closures] == [c.accepted for c in result.closures]
    for one, two in zip(back.closures, result.closures, strict=True):
        np.testing.assert_allclose(one.places, result.trajectory[[two.i, two.j], :2], atol=1e-6)
    np.testing.assert_array_equal(back.grid.states(), result.grid.states())


def test_what_is_no_result_is_one_clear_error(tmp_path):
    with pytest.raises(FormatError, match="holds no result of a map"):
        read_result(tmp_path)


def test_a_damaged_report_is_named_and_a_missing_one_is_none(written):
    folder = written[1]
    for damaged in ("{", "[" * 200_000):
        (folder / "report.json").write_text(damaged)
        with pytest.raises(FormatError, match=r"report.json.*no JSON"):
            read_result(folder)
    (folder / "report.json").write_text("[]")
    with pytest.raises(FormatError, match="not the report"):
        read_result(folder)
    (folder / "report.json").unlink()
    assert read_result(folder).closures == ()


def test_closures_of_unknown_keyframes_are_left_out(written):
    folder = written[1]
    report = json.loads((folder / "report.json").read_text())
    report["closures"][0]["i"] = 10_000
    (folder / "report.json").write_text(json.dumps(report))
    assert len(read_result(folder).closures) == 2


def test_tables_that_do_not_fit_are_named(written):
    folder = written[1]
    table = (folder / "trajectory_covariance.csv").read_text()
    (folder / "trajectory_covariance.csv").write_text(table.replace(",1,1\n", ",7,1\n"))
    with pytest.raises(FormatError, match="recording 7"):
        read_result(folder)
    (folder / "trajectory_covariance.csv").write_text(table.replace("1000.000000", "soon"))
    with pytest.raises(FormatError, match="stamp is 'soon', not a number"):
        read_result(folder)


@pytest.mark.parametrize("name", ["anchors.csv", "map.yaml", "trajectory_covariance.csv"])
def test_what_is_there_and_no_file_is_not_taken_for_missing(written, name):
    _, folder = written
    (folder / name).unlink()
    (folder / name).mkdir()
    with pytest.raises(FormatError, match="Is a directory"):
        read_result(folder)


def test_more_anchors_than_any_map_has_are_refused(written):
    _, folder = written
    table = folder / "anchors.csv"
    head, first = table.read_text().splitlines()[:2]
    rows = [",".join([f"A{k}", *first.split(",")[1:]]) for k in range(1001)]
    table.write_text("\n".join([head, *rows]) + "\n")
    with pytest.raises(FormatError, match=r"has 1001 anchors, more than 1000: it must be the anchors\.csv of one map"):
        read_result(folder)
    table.write_text("\n".join([head, *rows[1:]]) + "\n")
    assert len(read_result(folder).anchors) == 1000
