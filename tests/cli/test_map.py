"""`uwblite map` and `uwblite check` on the sample recording, end to end."""

import contextlib
import gzip
import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
from helpers.planted import drive, odometry, ranges, recording, wander
from helpers.results import FILES, contents

from uwblite import se2
from uwblite.cli import main
from uwblite.io.carmen import read_log, write_log
from uwblite.io.folders import sole_writer
from uwblite.io.tum import read_tum
from uwblite.sensor_log import SensorMounting


@pytest.fixture(scope="module")
def mapped(room_map):
    """Folder with the map of the sample recording, the exit code, and what was said."""
    return room_map / "map", int((room_map / "code").read_text()), (room_map / "said.txt").read_text()


def test_the_sample_is_mapped_with_every_file(mapped):
    folder, code, _ = mapped
    assert code in (0, 3)
    assert set(contents(folder)) == FILES


def test_what_is_reported_has_units_sigmas_paths_and_the_next_step(mapped):
    folder, _, output = mapped
    number = r"[-+]?\d+\.\d+"
    assert re.search(rf"anchor 5C0B: x {number} \u00b1\d\.\d\d m, y {number} \u00b1\d\.\d\d m, bias .* m, 190 ranges", output)
    assert str(folder / "map.png") in output
    assert f"next: open {folder / 'report.html'} in a browser, or: uwblite view {folder}" in output


def test_the_trajectory_follows_the_truth(mapped, room_log):
    from uwblite.cli import main as run

    truth = room_log.parent / "room" / "truth.tum"
    import contextlib
    import io

    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        assert run(["evaluate", str(mapped[0]), "--truth", str(truth), "--json"]) == 0
    # Lidar noise is 0.01 m, a cell 0.05 m: three centimetres over 46 m of driving in one room.
    assert json.loads(output.getvalue())["trajectory"]["ate"]["rmse"] < 0.03


def test_every_odometry_stamp_has_a_pose(mapped):
    stamps, _ = read_tum(mapped[0] / "trajectory.tum")
    assert len(stamps) == 4801
    assert np.all(np.diff(stamps) > 0)


@pytest.mark.slow
def test_two_runs_give_the_same_bytes_whatever_the_number_of_workers(minute_map, tmp_path, capsys):
    assert main(["map", str(minute_map.parent / "run.log.gz"), "--out", str(tmp_path / "2"), "--jobs", "2", "-q"]) in (0, 3)
    first, second = contents(minute_map), contents(tmp_path / "2")
    assert {name for name in first if first[name] != second[name]} <= {"report.json"}
    one, two = (json.loads(c["report.json"]) for c in (first, second))
    one.pop("timings"), two.pop("timings")
    assert one == two


def test_the_command_in_the_report_gives_the_same_bytes(short_log, tmp_path, monkeypatch, capsys):
    """It is pasted from the page, in the folder of the recording, where nothing but the recording is."""
    import html
    import shlex
    import shutil

    options = ["--preset", "paper", "--resolution", "0.1", "--crop=-1,-1,2,3.5", "--without", "loops", "--scale-map"]
    code = main(["map", str(short_log), "--out", str(tmp_path / "first"), *options, "--no-timings"])
    first = contents(tmp_path / "first")
    where, command = re.search(r"<p>(The command[^<]*)</p><pre>(.*?)</pre>", first["report.html"].decode()).groups()
    assert where.endswith(f"in the folder of {short_log.name}:")
    (tmp_path / "elsewhere").mkdir()
    shutil.copy(short_log, tmp_path / "elsewhere")
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert main([*shlex.split(html.unescape(command))[1:], "--no-timings"]) == code
    assert contents("map_again") == first


@pytest.mark.usefixtures("judged")
def test_the_same_log_in_another_folder_gives_the_same_bytes(radio_only, tmp_path, monkeypatch):
    """What a result says does not depend on where the recording lies, nor on how its path was written."""
    import shutil

    (tmp_path / "elsewhere").mkdir()
    shutil.copy(radio_only / "straight.log", tmp_path / "elsewhere" / "straight.log")
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert main(["map", "straight.log", "--out", str(tmp_path / "map"), "--no-timings", "-q"]) == 3
    one, two = contents(radio_only / "straight"), contents(tmp_path / "map")
    assert one == two
    assert not [path for path in (tmp_path, radio_only) if str(path).encode() in b"".join(one.values())]


def test_the_corrected_log_has_the_scans_where_the_map_has_them(mapped, room_log):
    raw, log = read_log(room_log), read_log(mapped[0].parent / "corrected.log")
    np.testing.assert_array_equal(log.scans.stamps, raw.scans.stamps)
    np.testing.assert_array_equal(log.scans.ranges, raw.scans.ranges)
    stamps, poses = read_tum(mapped[0] / "trajectory.tum")
    shift = se2.interpolate_trajectory(stamps, poses, log.odometry.stamps)[:, :2] - log.odometry.poses[:, :2]
    # The lidar's clock and half a turn of it lie between the stamps and the poses: 0.1 s at 0.3 m/s at most.
    assert np.hypot(shift[:, 0], shift[:, 1]).max() < 0.03


def test_a_corrected_log_is_refused_before_the_work_where_it_cannot_be_written(room_log, tmp_path, capsys):
    there = tmp_path / "there.log"
    there.write_text("")
    for logs, name, why in (
        ([room_log, "second.log"], tmp_path / "new.log", "one CARMEN log"),
        (["record.bag"], tmp_path / "new.log", "one CARMEN log"),
        ([room_log], there, "give --force"),
    ):
        words = [*map(str, logs), "--out", str(tmp_path / "map"), "--corrected-log", str(name)]
        assert main(["map", *words]) == 2
        assert why in capsys.readouterr().err
    assert not (tmp_path / "map").exists()


def test_a_corrected_log_without_scans_is_said(short_log, tmp_path, capsys):
    lines = gzip.decompress(short_log.read_bytes()).splitlines(keepends=True)
    (tmp_path / "in.log").write_bytes(b"".join(line for line in lines if b"LASER" not in line))
    words = [str(tmp_path / "in.log"), "--out", str(tmp_path / "map"), "--corrected-log", str(tmp_path / "out.log")]
    assert main(["map", *words]) in (0, 3)
    assert "out.log has no scans" in capsys.readouterr().err


def test_a_result_is_not_replaced_unasked(mapped, room_log, capsys):
    before = contents(mapped[0])
    assert main(["map", str(room_log), "--out", str(mapped[0])]) == 1
    assert "--force" in capsys.readouterr().err
    assert contents(mapped[0]) == before


@pytest.mark.slow
def test_mounting_and_settings_of_the_command_line_count(minute_log, tmp_path, capsys):
    words = ["--laser-pose=0.1,0,0", "--tag", "-0.05,0,0.6", "--resolution", "0.1", "--without", "loops", "--scale-map"]
    assert main(["map", str(minute_log), "--out", str(tmp_path / "map"), *words]) in (0, 3)
    yaml = (tmp_path / "map" / "map.yaml").read_text()
    assert "resolution: 0.1" in yaml
    assert "use_loops = false" in (tmp_path / "map" / "config.toml").read_text()
    report = json.loads((tmp_path / "map" / "report.json").read_text())
    assert "--laser-pose=0.1,0.0,0.0" in report["command"]
    assert (tmp_path / "map" / "map_scale.png").exists()


def test_a_dry_run_maps_and_writes_nothing(short_log, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("uwblite.cli.making.build_map", None)
    assert main(["map", str(short_log), "--dry-run"]) == 0
    line = r".*short.log.gz: about \d+ s of a desktop computer, \d+ MB, a map of \d+ x \d+ m\n"
    assert re.fullmatch(line, capsys.readouterr().out)
    assert main(["map", str(short_log), "--dry-run", "--json", "--out", "map", "--set", "use_lidar=true"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["recordings"]
    assert row["expected cost of map"]["megabytes"] > 50
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_check_of_the_sample(room_log, capsys):
    assert main(["check", str(room_log), "--map"]) == 0
    text = capsys.readouterr().out
    assert "bias guess" in text
    assert "next: uwblite map" in text
    assert "nothing to complain about" in text
    assert re.search(r"relative error of travelled distance: \+2\.\d\d \u00b10\.\d\d % \(odometry_scale\)", text)
    assert "\u2212" not in text


def test_there_is_nothing_to_complain_about_in_what_the_readme_cuts_off_the_sample(room_log, tmp_path, capsys):
    assert main(["convert", str(room_log), str(tmp_path / "run.log"), "--end", "60", "-q"]) == 0
    assert main(["check", str(tmp_path / "run.log")]) == 0
    assert "nothing to complain about" in capsys.readouterr().out


def test_check_shows_programs_figures_and_cost(short_log, capsys):
    assert main(["check", str(short_log), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["figures"]["lidar"]["beams"] == 682
    assert summary["expected cost of map"]["megabytes"] > 50


def test_check_exits_with_3_where_a_finding_spoils_the_map(minute_log, capsys):
    assert main(["check", str(minute_log), "--laser-flipped"]) == 3
    assert "mounted upright" in capsys.readouterr().out


def test_walls_are_turned_along_the_axes_and_the_map_cropped(minute_log, room_log, tmp_path, capsys):
    folder = tmp_path / "map"
    words = ["--align", "walls", "--crop=-2,-1,3,3", "--without", "uwb", "--json"]
    assert main(["map", str(minute_log), "--out", str(folder), *words]) in (0, 3)
    assert not json.loads(capsys.readouterr().out)["anchors"]
    _, poses = read_tum(folder / "trajectory.tum")
    # The room's walls lie along the axes of its truth; the recording began at a known heading there.
    _, truth = read_tum(room_log.parent / "room" / "truth.tum")
    turned = np.degrees(np.median(poses[:, 2] - truth[: len(poses), 2])) % 90.0
    assert min(turned, 90.0 - turned) < 1.0
    assert np.allclose(poses[0, :2], 0.0, atol=1e-6)
    assert (folder / "map.pgm").read_bytes().startswith(b"P5\n100 80\n")
    assert "origin: [-2, -1, 0]" in (folder / "map.yaml").read_text()


def anchors_of(folder):
    import csv

    with open(folder / "anchors.csv") as file:
        return {row["id"]: (float(row["x"]), float(row["y"])) for row in csv.DictReader(file)}


@pytest.fixture(scope="module")
def radio_only(tmp_path_factory):
    """Two recordings without a lidar: one that wanders among four anchors, one that drives straight past three."""
    folder = tmp_path_factory.mktemp("radio")
    rng = np.random.default_rng(7)
    level = SensorMounting(anchor_height=0.0)
    stamps, truth = wander(rng, 40.0)
    around = np.array([[6.5, 1.0], [-5.5, 5.0], [-2.0, -6.5], [1.0, 7.0]])
    wheels = odometry(stamps, truth, rng, noise=0.01, turn_noise=0.01)
    write_log(folder / "around.log", recording(wheels, ranges(rng, stamps, truth, around), mounting=level))
    stamps, truth = drive([(0.5, 0.0, 0.0)], [40.0])
    aside = np.array([[4.0, 3.0], [10.0, -4.0], [16.0, 2.5]])
    wheels = odometry(stamps, truth, rng, noise=0.005, turn_noise=0.001)
    write_log(folder / "straight.log", recording(wheels, ranges(rng, stamps, truth, aside), mounting=level))
    return folder


@pytest.fixture(scope="module")
def judged(radio_only):
    """Exit code and standard output of `uwblite map` for both, the doubted one as text and as JSON; the maps lie beside."""
    said = []
    for name, words in (("around", ["--json"]), ("straight", []), ("straight", ["--json", "--force"])):
        command = ["map", str(radio_only / f"{name}.log"), "--out", str(radio_only / name), "--no-timings", *words]
        with contextlib.redirect_stdout(io.StringIO()) as output:
            code = main(command)
        said.append((name, code, "--json" in words, output.getvalue()))
    return said


def test_a_result_to_trust_exits_with_0_and_one_in_doubt_with_3(radio_only, judged):
    for name, code, as_json, output in judged:
        report = json.loads((radio_only / name / "report.json").read_text())
        assert code == (0 if name == "around" else 3)
        assert bool(report["doubts"]) == (code == 3)
        assert (radio_only / name / "trajectory.tum").exists()
        if as_json:
            summary = json.loads(output)
            assert (summary["trusted"], summary["exit_code"]) == (code == 0, code)
            assert summary["doubts"] == report["doubts"]
        else:
            doubts = [line.removeprefix("DOUBT: ") for line in output.splitlines() if line.startswith("DOUBT: ")]
            assert doubts == [doubt["text"] for doubt in report["doubts"]]
            assert all("mirror-ambiguous" in doubt for doubt in doubts)


@pytest.mark.slow
def test_broken_lines_are_reported_counted_and_skipped(radio_only, tmp_path, capsys):
    lines = (radio_only / "around.log").read_text().splitlines(keepends=True)
    lines[40:40] = ["ODOM 1 2\n"]
    lines[90:90] = ["UWB A00 far 100 1 r 1\n"]
    (tmp_path / "broken.log").write_text("".join(lines))
    assert main(["map", str(tmp_path / "broken.log"), "--out", str(tmp_path / "map")]) == 0
    output = capsys.readouterr().err
    assert "uwblite: 2 broken lines skipped; the first is line 41: ODOM has too few fields" in output
    report = json.loads((tmp_path / "map" / "report.json").read_text())
    assert report["inputs"][0]["broken_lines"] == 2
    assert main(["map", str(radio_only / "around.log"), "--out", str(tmp_path / "whole")]) == 0
    assert "broken" not in capsys.readouterr().err
    assert contents(tmp_path / "map")["trajectory.tum"] == contents(tmp_path / "whole")["trajectory.tum"]


def test_too_many_broken_lines_are_refused_and_nothing_is_written(radio_only, tmp_path, capsys):
    lines = (radio_only / "around.log").read_text().splitlines(keepends=True)
    (tmp_path / "broken.log").write_text("".join(line + "ODOM 1 2\n" * (k % 10 == 0) for k, line in enumerate(lines)))
    assert main(["map", str(tmp_path / "broken.log"), "--out", str(tmp_path / "map")]) == 1
    output = capsys.readouterr().err
    assert "messages are broken (allowed: 5%)" in output
    assert f"{tmp_path / 'broken.log'}:2:" in output
    assert not (tmp_path / "map").exists()


@pytest.mark.slow
def test_a_second_map_lies_in_the_frame_of_the_first_and_names_what_was_moved(mapped, room_log, tmp_path, capsys):
    from uwblite.io.csv_table import read_csv

    truth = read_csv(room_log.parent / "room" / "truth_anchors.csv")
    place = dict(zip(truth.texts("id"), truth.numbers("x", "y").tolist(), strict=True))
    lines = [f"{name},{x + 3.0 * (name == 'DD07')},{y},0.05,0.05,ok" for name, (x, y) in place.items()]
    (tmp_path / "earlier.csv").write_text("\n".join(["id,x,y,sigma_x,sigma_y,status", *lines]) + "\n")
    words = ["--anchors-from", str(tmp_path / "earlier.csv"), "--set", "grid.resolution=0.1"]
    assert main(["map", str(room_log), "--out", str(tmp_path / "map"), *words]) in (0, 3)
    assert "warning: anchor DD07 stands" in capsys.readouterr().out
    found = anchors_of(tmp_path / "map")
    for name, position in place.items():
        # Four minutes in a small room leave biases open; its walls hold the rest. The frame is what is asked for here.
        assert np.hypot(*np.subtract(found[name], position)) < 0.4, name


def test_a_file_of_constraints_pins_the_map(short_log, tmp_path, capsys):
    (tmp_path / "known.toml").write_text("[[pose]]\nstamp = 0\npose = [10, 20, 1.5707963]\nsigma = [0.001, 0.001, 0.001]\n")
    words = ["--constraints", str(tmp_path / "known.toml"), "--without", "lidar"]
    assert main(["map", str(short_log), "--out", str(tmp_path / "map"), *words]) in (0, 3)
    assert not (tmp_path / "map" / "map.pgm").exists()
    _, poses = read_tum(tmp_path / "map" / "trajectory.tum")
    assert np.allclose(poses[0], (10, 20, np.pi / 2), atol=0.01)
    assert "--constraints" in json.loads((tmp_path / "map" / "report.json").read_text())["command"]
    (tmp_path / "known.toml").write_text("[[anchor]]\nid = 'FFFF'\nposition = [1, 2]\n")
    assert main(["map", str(short_log), "--out", str(tmp_path / "other"), *words]) == 1
    assert "no ranges to anchor FFFF" in capsys.readouterr().err


@pytest.mark.slow
def test_a_forbidden_closure_is_listed_as_such(room_log, tmp_path, capsys):
    (tmp_path / "known.toml").write_text("[[forbidden_closure]]\nstamps = [30, 200]\nwithin = 30\n")
    words = ["--constraints", str(tmp_path / "known.toml"), "--without", "uwb"]
    assert main(["map", str(room_log), "--out", str(tmp_path / "map"), *words]) in (0, 3)
    closures = json.loads((tmp_path / "map" / "report.json").read_text())["closures"]
    for c in closures:
        apart = sorted((c["stamp_i"], c["stamp_j"]))
        if apart[0] <= 60 and apart[1] >= 170 and apart[1] <= 230:
            assert not c["accepted"]
    assert any("forbidden" in c["reason"] for c in closures)


def test_localize_finds_a_part_in_the_map(mapped, room_log, tmp_path, capsys):
    part = tmp_path / "part.log"
    assert main(["convert", str(room_log), str(part), "--start", "120", "--end", "150"]) == 0
    words = ["--map", str(mapped[0]), "--out", str(tmp_path / "p.tum"), "--picture", str(tmp_path / "p.png")]
    before = contents(mapped[0])
    capsys.readouterr()
    assert main(["localize", str(part), *words, "--covariance", str(tmp_path / "p.csv"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["overlap"] > 0.9
    stamps, poses = read_tum(tmp_path / "p.tum")
    there, whole = read_tum(mapped[0] / "trajectory.tum")
    from uwblite.se2 import interpolate_trajectory

    error = np.hypot(*(poses - interpolate_trajectory(there, whole, stamps))[:, :2].T)
    assert np.sqrt(np.mean(error**2)) < 0.03
    assert (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")
    assert contents(mapped[0]) == before
    assert main(["localize", str(part), *words, "--json"]) == 1
    assert "--force" in capsys.readouterr().err
    assert main(["localize", str(part), "--map", str(tmp_path), "--out", str(tmp_path / "q.tum")]) == 1


@pytest.mark.slow
def test_two_recordings_become_one_map_through_their_anchors(mapped, room_log, tmp_path, capsys):
    parts = [tmp_path / "first.log", tmp_path / "second.log"]
    assert main(["convert", str(room_log), str(parts[0]), "--end", "110"]) == 0
    assert main(["convert", str(room_log), str(parts[1]), "--start", "120"]) == 0
    assert main(["map", *map(str, parts), "--out", str(tmp_path / "map")]) in (0, 3)
    assert "anchor 5C0B:" in capsys.readouterr().out
    report = json.loads((tmp_path / "map" / "report.json").read_text())
    assert [Path(i["source"]).name for i in report["inputs"]] == ["first.log", "second.log"]
    there, whole = read_tum(mapped[0] / "trajectory.tum")
    from uwblite.se2 import between, compose, interpolate_trajectory, inverse

    # Both recordings lie as in the map of the whole: where the first begins there is where it begins here.
    first, start = read_tum(tmp_path / "map" / "trajectory.tum")
    T = compose(interpolate_trajectory(there, whole, first[:1])[0], inverse(start[0]))
    second, poses = read_tum(tmp_path / "map" / "trajectory_2.tum")
    apart = between(interpolate_trajectory(there, whole, second), compose(T, poses))
    assert np.sqrt(np.mean(np.sum(apart[:, :2] ** 2, axis=1))) < 0.06


@pytest.mark.slow
def test_a_folder_of_localize_is_exchanged_as_a_whole(mapped, room_log, tmp_path, monkeypatch):
    part = tmp_path / "part.log"
    main(["convert", str(room_log), str(part), "--start", "100", "--end", "125"])
    words = ["localize", str(part), "--map", str(mapped[0]), "--out", str(tmp_path / "where")]
    assert main([*words, "--picture", str(tmp_path / "where" / "mine.png")]) == 0
    before = {p.name: p.read_bytes() for p in (tmp_path / "where").iterdir()}
    assert set(before) == {"trajectory.tum", "trajectory_covariance.csv", "mine.png", "report.json"}

    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("uwblite.cli.localize.write_png", full)
        assert main([*words, "--force"]) == 1
    assert {p.name: p.read_bytes() for p in (tmp_path / "where").iterdir()} == before
    assert main([*words, "--force"]) == 0
    assert {p.name for p in (tmp_path / "where").iterdir()} == {*before, "path.png"}
    assert sorted(p.name for p in tmp_path.iterdir()) == ["part.log", "where"]


def test_localize_fills_a_folder_but_never_the_map_s(mapped, room_log, tmp_path, capsys):
    part, out = tmp_path / "part.log", tmp_path / "there"
    assert main(["convert", str(room_log), str(part), "--start", "150", "--end", "165"]) == 0
    before = contents(mapped[0])
    assert main(["localize", str(part), "--map", str(mapped[0]), "--out", str(mapped[0]), "--force"]) == 1
    assert "is the map itself" in capsys.readouterr().err
    assert main(["localize", str(part), "--map", str(mapped[0]), "--out", str(part)]) == 1
    assert "name a folder" in capsys.readouterr().err
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    (pictures / "path.png").write_bytes(b"mine")
    assert main(["localize", str(part), "--map", str(mapped[0]), "--out", str(pictures), "--force"]) == 1
    assert "path.png was not written by uwblite" in capsys.readouterr().err
    assert contents(pictures) == {"path.png": b"mine"}
    assert main(["localize", str(part), "--map", str(mapped[0]), "--out", str(out)]) == 0
    assert "lie on walls of the map" in capsys.readouterr().out
    assert set(contents(out)) == {"trajectory.tum", "trajectory_covariance.csv", "path.png", "report.json"}
    report = json.loads((out / "report.json").read_text())
    assert report["overlap"] > 0.9
    assert report["map"] == str(mapped[0])
    assert main(["localize", str(part), "--map", str(mapped[0]), "--out", str(out)]) == 1
    assert "--force" in capsys.readouterr().err
    assert contents(mapped[0]) == before


@pytest.mark.slow
def test_localize_in_a_map_without_anchors_goes_by_its_walls(mapped, room_log, tmp_path, capsys):
    import shutil

    bare = tmp_path / "bare"
    shutil.copytree(mapped[0], bare)
    header = (bare / "anchors.csv").read_text().splitlines()[0]
    (bare / "anchors.csv").write_text(header + "\n")
    part = tmp_path / "part.log"
    assert main(["convert", str(room_log), str(part), "--start", "120", "--end", "180"]) == 0
    capsys.readouterr()
    assert main(["localize", str(part), "--map", str(bare), "--out", str(tmp_path / "p.tum"), "--json"]) in (0, 3)
    summary = json.loads(capsys.readouterr().out)
    assert summary["overlap"] > 0.9
    assert any("walls alone" in w["text"] for w in summary["warnings"])
    (bare / "map.yaml").unlink()
    assert main(["localize", str(part), "--map", str(bare), "--out", str(tmp_path / "q.tum")]) == 1
    assert "neither an anchor with a place nor" in capsys.readouterr().err


@pytest.mark.slow
def test_every_third_scan_makes_a_map_too(minute_log, tmp_path, capsys):
    """What is not read is counted and not held; the command in the report says so."""
    assert main(["map", str(minute_log), "--out", str(tmp_path / "map"), "--every-nth-scan", "3"]) in (0, 3)
    report = json.loads((tmp_path / "map" / "report.json").read_text())
    whole = read_log(minute_log).scans
    assert report["recording"]["scans"] == -(-len(whole.stamps) // 3)
    assert "--every-nth-scan=3" in report["command"]


def test_a_second_run_into_the_same_folder_is_refused_before_it_computes(tmp_path, room_log, capsys):
    with sole_writer(tmp_path / "map"):
        assert main(["map", str(room_log), "--out", str(tmp_path / "map"), "--force"]) == 1
    assert "another run is writing" in capsys.readouterr().err
    assert not (tmp_path / "map").exists()


@pytest.mark.parametrize("verb", ["map", "localize", "record", "convert", "optimize"])
def test_an_empty_name_is_wrong_usage(verb, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = {"convert": ["x.log", ""], "localize": ["x.log", "--map", "m", "--out", ""], "record": ["--out", ""]}
    assert main([verb, *words.get(verb, ["x", "--out", " "])]) == 2
    assert "an empty name names no file or folder" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("option", ["--config", "--constraints", "--anchors-from", "--uwb-mapping", "--corrected-log"])
def test_an_option_with_an_empty_name_is_not_taken_as_not_given(option, capsys):
    assert main(["map", "x.log", "--out", "m", option, ""]) == 2
    assert f"{option}: an empty name names no file or folder" in capsys.readouterr().err
