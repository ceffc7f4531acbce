"""uwblite evaluate on results whose errors are known."""

import json
import re

import numpy as np
import pytest
from helpers import planted

from uwblite import se2
from uwblite.cli import main
from uwblite.grid.geometry import GridGeometry
from uwblite.grid.occupancy_grid import OccupancyGrid
from uwblite.io.map_server import write_map
from uwblite.io.tum import read_tum, write_tum

COLUMNS = np.array([[2.0, 2.0, 0.3], [6.0, 2.0, 0.3], [2.0, 5.0, 0.25]])
WALLS = np.array([[0.0, 0, 8, 0], [8, 0, 8, 7], [8, 7, 0, 7], [0, 7, 0, 0]])
T_MAP_TRUTH = np.array([3.0, -1.0, 0.8])


@pytest.fixture
def result(tmp_path):
    """Write a perfect result in another frame, with its truth; return the folder and the words of the command."""
    angle = np.linspace(0, 2 * np.pi, 400)
    truth = np.stack([4 + 1.2 * np.cos(angle), 3.5 + 1.2 * np.sin(angle), se2.wrap_angle(angle + np.pi / 2)], axis=1)
    stamps = 100.0 + 0.1 * np.arange(400)
    folder = tmp_path / "map"
    folder.mkdir()
    write_tum(folder / "trajectory.tum", stamps, se2.compose(T_MAP_TRUTH, truth))
    write_tum(tmp_path / "truth.tum", stamps, truth)
    anchors = {"DD07": (0.0, 0.0), "1E05": (8.0, 0.0), "91A3": (8.0, 7.0)}
    (tmp_path / "anchors.csv").write_text("id,x,y\n" + "".join(f"{k},{x},{y}\n" for k, (x, y) in anchors.items()))
    moved = {k: se2.transform(T_MAP_TRUTH, xy) for k, xy in anchors.items() if k != "1E05"}
    moved["DD07"] = moved["DD07"] + [0.3, 0.4]
    (folder / "anchors.csv").write_text("id,x,y,sigma_x\n" + "".join(f"{k},{x},{y},0.1\n" for k, (x, y) in moved.items()))
    rows = [f"C{i},{x},{y},{r},{'C2 C3' if i == 1 else ''}\n" for i, (x, y, r) in enumerate(COLUMNS, 1)]
    (tmp_path / "columns.csv").write_text("name,x,y,radius,neighbours\n" + "".join(rows))
    draw_map(folder)
    return tmp_path, ["evaluate", str(folder), "--truth", str(tmp_path / "truth.tum")]


def draw_map(folder, resolution=0.04):
    points = se2.transform(T_MAP_TRUTH, planted.surface_points(WALLS, COLUMNS))
    geometry = GridGeometry.around(points.min(axis=0), points.max(axis=0), resolution, 10**7)
    odds = np.zeros((geometry.rows, geometry.cols), dtype=np.float32)
    odds[geometry.cell_of(points)] = 4.0
    write_map(folder, OccupancyGrid(geometry, odds))


def options(root):
    return [
        w
        for name in ("anchors", "columns")
        for w in (f"--{name.replace('columns', 'landmarks')}", str(root / f"{name}.csv"))
    ]


def test_everything_in_json(result, capsys):
    root, words = result
    assert main([*words, *options(root), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["trajectory"]["ate"]["rmse"] < 1e-5
    assert found["trajectory"]["heading"]["rmse"] < 1e-6
    assert found["trajectory"]["compared"] == 400
    np.testing.assert_allclose(found["trajectory"]["T_truth_map"], se2.inverse(T_MAP_TRUTH), atol=1e-5)
    assert found["anchors"]["missing"] == ["1E05"]
    assert found["anchors"]["errors"]["DD07"] == pytest.approx(0.5, abs=1e-4)
    assert found["anchors"]["errors"]["91A3"] == pytest.approx(0.0, abs=1e-4)
    assert [(p["a"], p["b"]) for p in found["landmarks"]["pairs"]] == [("C1", "C2"), ("C1", "C3")]
    assert found["landmarks"]["mean"] < 0.02
    assert found["landmarks_along_trajectory"]["mean"] < 1e-4


def test_table(result, capsys):
    root, words = result
    assert main([*words, *options(root)]) == 0
    text = capsys.readouterr().out
    for part in (
        "position (ATE)",
        "heading",
        "relative (RPE)",
        "400 of 400",
        "anchors: rmse 0.354 m",
        "C1 - C2",
        "without an estimate: 1E05",
    ):
        assert part in text


def test_trajectory_alone(result, capsys):
    root, words = result
    (root / "map" / "map.yaml").unlink()
    assert main(words) == 0
    assert "columns" not in capsys.readouterr().out
    assert main([*words, *options(root)]) == 0
    assert "no map.yaml" in capsys.readouterr().out


def test_truth_without_heading(result, capsys):
    root, words = result
    lines = (root / "truth.tum").read_text().splitlines()
    (root / "truth.tum").write_text("".join(" ".join([*line.split()[:4], "0 0 0 1"]) + "\n" for line in lines))
    assert main([*words, "--json", "--landmarks", str(root / "columns.csv")]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["trajectory"]["heading"] is None
    assert "landmarks_along_trajectory" not in found


def test_errors_are_one_line(result, capsys):
    root, words = result
    assert main(["evaluate", str(root / "nowhere"), "--truth", str(root / "truth.tum")]) == 1
    assert "trajectory.tum" in capsys.readouterr().err
    assert main([*words, "--delta", "-1"]) == 2
    assert "above 0" in capsys.readouterr().err
    (root / "anchors.csv").write_text("name,x,y\nA,1,2\n")
    assert main([*words, "--anchors", str(root / "anchors.csv")]) == 1
    assert "no column 'id'" in capsys.readouterr().err
    assert main(["evaluate", str(root / "map")]) == 2


def test_each_recording_of_a_joint_map_and_all_together(result, capsys):
    """The second recording lies askew in the common frame: alone it is perfect, together they are not."""
    root, words = result
    stamps, truth = read_tum(root / "truth.tum")
    askew = se2.compose(np.array([0.2, 0.0, 0.0]), se2.compose(T_MAP_TRUTH, truth))
    write_tum(root / "map" / "trajectory_2.tum", stamps - 95.0, askew)
    write_tum(root / "truth_2.tum", stamps - 95.0, truth)
    second = ["--truth", str(root / "truth_2.tum")]
    assert main([*words, *second, "--json", "--anchors", str(root / "anchors.csv")]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["trajectory"]["compared"] == 800
    assert found["trajectory"]["ate"]["rmse"] == pytest.approx(0.1, abs=1e-4)
    assert [own["ate"]["rmse"] < 1e-5 for own in found["recordings"]] == [True, True]
    assert main([*words[:2], *second, "--recording", "2", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["trajectory"]["ate"]["rmse"] < 1e-5
    assert main([*words, *second]) == 0
    text = capsys.readouterr().out
    assert "together" in text
    assert "recording 2 alone" in text
    assert main([*words[:2], *second, "--recording", "3"]) == 1
    assert "has no trajectory_3.tum" in capsys.readouterr().err
    assert main([*words, *second, "--recording", "2"]) == 1
    assert "--recording is for a single --truth" in capsys.readouterr().err


@pytest.mark.parametrize("row", ["C1,1,2,0", "C1,1,2,-1", "C1,nan,2,0.3", "C1,1e300,2,0.3"])
def test_columns_that_cannot_be_are_refused(result, capsys, row):
    root, words = result
    (root / "odd.csv").write_text(f"name,x,y,radius\n{row}\nC2,1,1,0.2\n")
    assert main([*words, "--landmarks", str(root / "odd.csv")]) == 1
    assert capsys.readouterr().err.startswith("uwblite: error: ")


def test_relations_are_judged_at_the_lidars_clock(result, capsys):
    """The lidar is found 0.5 s late, a relation lies outside, and neither truth nor map is needed."""
    place, (verb, folder, *_) = result
    stamps, truth = read_tum(place / "truth.tum")
    (place / "map" / "report.json").write_text('{"calibration": [{"name": "laser_delay", "value": 0.5}]}')
    pairs = np.array([[20, 30], [300, 40], [50, 390]])
    seen = se2.between(truth[pairs[:, 0]], truth[pairs[:, 1]])
    lines = [
        f"{stamps[i] - 0.5:.3f} {stamps[j] - 0.5:.3f} {x} {y} 0 0 0 {angle}"
        for (i, j), (x, y, angle) in zip(pairs.tolist(), seen.tolist(), strict=True)
    ]
    relations = place / "truth.relations"
    relations.write_text("\n".join([*lines, f"{stamps[0] - 60:.3f} {stamps[9]:.3f} 0 0 0 0 0 0"]) + "\n")
    assert main([verb, folder, "--relations", str(relations), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)["relations"]
    assert answer["count"] == 4
    assert answer["not_answered"] == 1
    assert answer["share_far"] == 0.25
    assert answer["translation"]["mean"] < 1e-4
    assert answer["rotation"]["mean"] < 1e-4
    assert main([verb, folder, "--relations", str(relations), "--truth", str(place / "truth.tum")]) == 0
    out = capsys.readouterr().out
    assert "4 relations, 1 not answered; 25.0% beyond 0.5 m or not answered" in out
    assert "position (ATE)" in out


def test_something_to_judge_by_is_needed(result, capsys):
    _, (verb, folder, *_) = result
    assert main([verb, folder]) == 2
    assert "give --truth, --relations, or both" in capsys.readouterr().err


def test_a_recording_that_a_map_does_not_have_is_named(result, capsys):
    root, words = result
    (root / "relations").write_text("100.1 101.2 0.5 0 0 0 0 0.3\n")
    assert main([*words[:2], "--relations", str(root / "relations"), "--recording", "3"]) == 1
    assert "is a map of 1 recordings, not of 3" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--anchors", "--landmarks"])
def test_what_is_judged_by_the_truth_needs_it(result, capsys, option):
    root, words = result
    (root / "relations").write_text("100.1 101.2 0.5 0 0 0 0 0.3\n")
    judged = [option, str(root / "anchors.csv")]
    assert main([*words[:2], "--relations", str(root / "relations"), *judged]) == 2
    assert "need --truth" in capsys.readouterr().err


def numbers(line):
    """Return the numbers that stand alone in a line."""
    return [float(word) for word in re.findall(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?![\w.])", line)]


def uneven(root):
    """Spread the trajectory's poses about the truth: every figure is another one."""
    stamps, poses = read_tum(root / "map" / "trajectory.tum")
    wave = np.sin(np.outer(np.arange(len(stamps)) ** 1.3, [0.1, 0.07, 0.05]))
    write_tum(root / "map" / "trajectory.tum", stamps, se2.compose(poses, wave * [0.2, 0.1, 0.05]))


def test_the_table_states_the_figures(result, capsys):
    root, words = result
    uneven(root)
    assert main([*words, *options(root), "--delta", "2", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert main([*words, *options(root), "--delta", "2"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert found["trajectory"]["rpe_delta"] == 2.0
    rows = (("position (ATE)", "ate", 1.0, "m"), ("heading", "heading", 180.0 / np.pi, "deg"),
            ("relative (RPE)", "rpe_position", 1.0, "m per 2 m"),
            ("relative heading", "rpe_heading", 180.0 / np.pi, "deg per 2 m"))  # fmt: skip
    assert lines[0].split() == ["trajectory", "rmse", "mean", "median", "max"]
    for line, (title, name, unit, of) in zip(lines[1:5], rows, strict=True):
        figures = [unit * found["trajectory"][name][each] for each in ("rmse", "mean", "median", "max")]
        assert len(set(figures)) == 4
        assert line.strip().startswith(title)
        assert line.endswith(f"  {of}")
        assert numbers(line)[:4] == pytest.approx(figures, abs=5.1e-5)
    assert lines[5] == "  400 of 400 true poses compared"
    anchors = found["anchors"]
    assert numbers(lines[6]) == pytest.approx([anchors["rmse"], 2], abs=5.1e-4)
    stated = {line.split()[0]: float(line.split()[1]) for line in lines[7:9]}
    assert stated == pytest.approx(anchors["errors"], abs=5.1e-4)
    assert lines[9] == "  without an estimate: 1E05"
    landmarks = found["landmarks"]
    assert lines[10] == f"columns in the map: mean distance error {landmarks['mean']:.4f} m over 2 pairs"
    for line, pair in zip(lines[11:13], landmarks["pairs"], strict=True):
        assert line.strip().startswith(f"{pair['a']} - {pair['b']} ")
        assert numbers(line) == pytest.approx([pair["true"], pair["found"], pair["error"]], abs=5.1e-4)
        assert pair["error"] == pytest.approx(abs(pair["found"] - pair["true"]))
    drawn = found["landmarks_along_trajectory"]["mean"]
    assert lines[13:] == [f"columns as the trajectory draws them: mean distance error {drawn:.4f} m over 2 pairs"]


def test_longer_stretches_longer_gaps_and_farther_columns_are_judged_where_that_is_asked_for(result, capsys):
    root, words = result
    uneven(root)

    def figures(*more):
        assert main([*words, "--json", *more]) == 0
        return json.loads(capsys.readouterr().out)

    usual = figures()["trajectory"]
    assert usual["rpe_delta"] == 1.0
    assert figures("--delta", "3")["trajectory"]["rpe_position"]["rmse"] != usual["rpe_position"]["rmse"]
    stamps, poses = read_tum(root / "map" / "trajectory.tum")
    kept = (stamps < 110.05) | (stamps > 110.75)
    write_tum(root / "map" / "trajectory.tum", stamps[kept], poses[kept])
    assert [figures(*more)["trajectory"]["compared"] for more in ([], ["--max-gap", "0.5"])] == [400, 400 - int((~kept).sum())]
    rows = [f"C{i},{x + 0.7},{y},{r}\n" for i, (x, y, r) in enumerate(COLUMNS, 1)]
    (root / "columns.csv").write_text("name,x,y,radius\n" + "".join(rows))
    columns = ["--landmarks", str(root / "columns.csv")]
    assert figures(*columns)["landmarks"]["missing"] == []
    assert figures(*columns, "--search-radius", "0.2")["landmarks"]["missing"] == ["C1", "C2", "C3"]
