"""Files whose names tell nothing, or something else: told by their content, read or refused with the verb that helps."""

import gzip

import numpy as np
import pytest
from helpers.results import small_log

from uwblite.errors import FormatError
from uwblite.io.carmen import write_log
from uwblite.io.carmen_writer import scan_lines
from uwblite.io.formats import format_of, format_of_content, read_graph, read_recording
from uwblite.io.librsf import read_librsf

SQUARE = "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 1.57\nEDGE_SE2 0 1 1 0 1.57 10 0 0 10 0 25\n"
TORO = "VERTEX2 0 0 0 0\nVERTEX2 1 1 0 0\nEDGE2 0 1 1 0 0 10 0 10 25 0 0\n"
ISAM_EDGE = "EDGE2 0 1 1 0 0 3 0 0 3 0 5\n"
ISAM = "ODOMETRY 0 1 1 0 0 3 0 0 3 0 5\nLANDMARK 1 100 1 0.5 4 0 4\n"
PYFG = "VERTEX_SE2 0.0 A0 0 0 0\nVERTEX_SE2 1.0 A1 1 0 0\nEDGE_SE2 1.0 A0 A1 1 0 0 0.1 0 0 0.1 0 0.04\n"
TUM = "1.0 0 0 0 0 0 0 1\n2.0 1 0 0 0 0 0 1\n"
LIBRSF = "odom2diff 0.1 0.2 0.2 0.1 0.01 0.01\n"
CARMEN = "# a comment\nODOM 0 0 0 0 0 0 1.0 robot 1.0\n"


@pytest.mark.parametrize(
    ("text", "kind"),
    [(SQUARE, "g2o"), (TORO, "g2o"), (ISAM_EDGE, "g2o"), (ISAM, "isam"), (PYFG, "pyfg"), (TUM, "tum"), (LIBRSF, "librsf"),
     (CARMEN, "log"), ("#ROSBAG V2.0\n", "bag"), ("hello\n", ""), ("", ""), ("1.0 0.1 0.2\n", "numbers"),
     ("\x0c\x80CSensoryFrame\x02\0", "rawlog")],
)  # fmt: skip
@pytest.mark.parametrize("packed", [False, True])
def test_content_tells_the_format(tmp_path, text, kind, packed):
    file = tmp_path / "file.txt"
    file.write_bytes(gzip.compress(text.encode()) if packed else text.encode())
    if not (packed and kind == "bag"):
        assert format_of_content(str(file)) == kind
        assert format_of(str(file)) == kind


@pytest.mark.parametrize("ending", [".g2o", ".graph", ".toro", ".txt", ".pyfg", ""])
@pytest.mark.parametrize("text", [SQUARE, TORO, PYFG])
def test_a_graph_of_any_name_is_read(tmp_path, ending, text):
    file = tmp_path / f"graph{ending}"
    file.write_text(text)
    assert len(read_graph(str(file)).graph.poses) == 2


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (ISAM_EDGE, "not positive semi-definite in TORO's order .* iSAM and gtsam write another EDGE2"),
        (ISAM, "its lines are 1 ODOMETRY, 1 LANDMARK. ODOMETRY and LANDMARK are iSAM's"),
        ("hello world\n", "holds no poses; its lines are 1 hello"),
        (CARMEN, "is a recording, no pose graph: uwblite map"),
        ("#ROSBAG V2.0\n", "is a recording, no pose graph: uwblite map"),
    ],
)
@pytest.mark.parametrize("ending", [".g2o", ".txt"])
def test_what_is_no_graph_is_named(tmp_path, text, why, ending):
    file = tmp_path / f"graph{ending}"
    file.write_text(text)
    if ending == ".g2o" and text == CARMEN:
        why = "holds no poses; its lines are 1 ODOM"
    with pytest.raises(FormatError, match=why):
        read_graph(str(file))


def test_angles_in_degrees_are_hinted(tmp_path):
    file = tmp_path / "graph.g2o"
    file.write_text(SQUARE.replace("1.57 10", "90 10"))
    assert "1 of 1 edges turn by more than a turn (the first by 90 in line 3)" in read_graph(str(file)).warnings[0]
    file.write_text(SQUARE)
    assert not read_graph(str(file)).warnings


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (SQUARE, "is a pose graph without scans .* uwblite optimize"),
        (PYFG, "is a pose graph without scans .* uwblite optimize"),
        (ISAM, "is a pose graph of iSAM"),
        ("0.1 0.2 0.3\n0.1 0.2 0.3\n", "is a table of numbers without names, as MRPT exports"),
        ("\x0c\x80CSensoryFrame\x02\0", "is a binary rawlog of MRPT"),
        (TUM, "is a trajectory, no recording: uwblite convert makes a folder of it"),
    ],
)
def test_what_is_no_recording_is_named_with_the_verb_that_helps(tmp_path, text, why):
    file = tmp_path / "run.txt"
    file.write_text(text)
    with pytest.raises(FormatError, match=why):
        read_recording(str(file))


def test_a_graph_with_scans_is_a_recording(tmp_path):
    """g2o's tools attach a ROBOTLASER1 to each vertex: its poses are the odometry."""
    log = small_log()
    write_log(tmp_path / "run.log", log)
    lines = list(scan_lines(log))
    vertices = [f"VERTEX_SE2 {k} {k} 0 0\n".encode() for k in range(len(lines))]
    edges = [f"EDGE_SE2 {k} {k + 1} 1 0 0 10 0 0 10 0 25\n".encode() for k in range(len(lines) - 1)]
    graph = b"".join(x for pair in zip(vertices, lines, strict=True) for x in pair) + b"".join(edges)
    (tmp_path / "scans.g2o").write_bytes(graph)
    read = read_recording(str(tmp_path / "scans.g2o"))
    np.testing.assert_allclose(read.scans.ranges, read_recording(str(tmp_path / "run.log")).scans.ranges)
    np.testing.assert_allclose(read.odometry.poses, log.odometry.at(log.scans.stamps), atol=1e-5)
    assert len(read_graph(str(tmp_path / "scans.g2o")).graph.poses) == len(lines)


def test_speeds_of_wheels_are_integrated(tmp_path):
    """A circle of one metre about the left, driven at 0.5 m/s: libRSF's base is half the distance between the wheels."""
    lines = []
    for k in range(101):
        t, base = 0.1 * k, 0.2
        lines.append(f"odom2diff {t} {0.5 * (1 - base):.6f} {0.5 * (1 + base):.6f} {base} 0.01 0.01 0.01")
        lines.append(f"range2 {t} {2.5 + 0.01 * k} 0.1 3.0 4.0 105.000 0")
        lines.append(f"gt2 {t} 0 0")
    (tmp_path / "run.txt").write_text("\n".join(lines) + "\n")
    log = read_librsf(tmp_path / "run.txt")
    np.testing.assert_allclose(log.odometry.poses[-1], [np.sin(5.0), 1.0 - np.cos(5.0), 5.0 - 2 * np.pi], atol=1e-6)
    assert log.ranges.anchor_ids == ("105",)
    np.testing.assert_allclose(log.ranges.ranges, 2.5 + 0.01 * np.arange(101))
    assert log.notes.skipped == {"gt2": 101}
    with_sideways = [line.replace(" 0.2 0.01", " 0.0 0.2 0.01") for line in lines]
    (tmp_path / "new.txt").write_text("\n".join(with_sideways) + "\n")
    np.testing.assert_allclose(read_librsf(tmp_path / "new.txt").odometry.poses, log.odometry.poses)
    assert format_of(str(tmp_path / "run.txt")) == "librsf"


@pytest.mark.parametrize("line", ["odom2diff 0.1 0.4 0.6 0.2 0 0 0", "odom2 0.1 0.5 0 1", "range2 0.1 2.5 0.1 3.0 4.0 105"])
def test_a_line_of_librsf_needs_no_more_words_than_are_read(tmp_path, line):
    """With one word less it is refused, with the words that must be there it is read."""
    kind, *words = line.split()
    before = "odom2 0.0 0.5 0 1 0 0 0\n"
    (tmp_path / "run.txt").write_text(f"{before}{line}\n")
    log = read_librsf(tmp_path / "run.txt")
    assert len(log.odometry.stamps) == 1 + (kind != "range2")
    assert (log.ranges is not None) is (kind == "range2")
    (tmp_path / "run.txt").write_text(f"{before}{kind} {' '.join(words[:-1])}\n")
    with pytest.raises(FormatError, match=f":2: {kind} has {len(words)} words, expected {len(words) + 1}"):
        read_librsf(tmp_path / "run.txt")


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("range2 1 2 0.1 0 0 5\n", "holds no odometry"),
        ("odom2diff 1 2\n", ":1: odom2diff has 3 words, expected 8"),
        ("odom2diff 1 x 2 0.2 0 0 0\n", ":1: b'x' is no finite number"),
        ("odom2diff 1 nan 2 0.2 0 0 0\n", ":1: b'nan' is no finite number"),
    ],
)
def test_text_of_librsf_that_is_wrong(tmp_path, text, why):
    (tmp_path / "run.txt").write_text(text)
    with pytest.raises(FormatError, match=why):
        read_librsf(tmp_path / "run.txt")
