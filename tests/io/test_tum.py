import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uwblite import se2
from uwblite.errors import FormatError
from uwblite.io.tum import read_tum, write_tum

NUMBER = st.floats(-1e4, 1e4)


@given(st.lists(st.tuples(st.floats(0, 2e9), NUMBER, NUMBER, st.floats(-20, 20)), min_size=1, max_size=20))
def test_what_is_written_is_read(tmp_path_factory, rows):
    table = np.array(rows)
    path = tmp_path_factory.mktemp("tum") / "a.tum"
    write_tum(path, table[:, 0], table[:, 1:])
    stamps, poses = read_tum(path)
    np.testing.assert_allclose(stamps, table[:, 0], atol=1e-6)
    np.testing.assert_allclose(poses[:, :2], table[:, 1:3], atol=1e-6)
    np.testing.assert_allclose(se2.wrap_angle(poses[:, 2] - table[:, 3]), 0.0, atol=1e-8)


def test_lines_are_what_evo_demands(tmp_path):
    write_tum(tmp_path / "a.tum", np.array([1510931552.25, 2.0]), np.array([[1.0, -2.0, np.pi / 2], [-1e-9, 0.0, 0.0]]))
    lines = (tmp_path / "a.tum").read_text().splitlines()
    assert lines[0] == "1510931552.250000 1.000000 -2.000000 0 0 0 0.707106781 0.707106781"
    assert all(len(line.split(" ")) == 8 and line == line.strip() for line in lines)


def test_evo_reads_it(tmp_path):
    file_interface = pytest.importorskip("evo.tools.file_interface")
    poses = np.array([[1.0, 2.0, 0.3], [2.0, 2.5, -3.0], [2.5, 2.5, 3.1]])
    write_tum(tmp_path / "a.tum", np.arange(3.0), poses)
    trajectory = file_interface.read_tum_trajectory_file(str(tmp_path / "a.tum"))
    np.testing.assert_allclose(trajectory.positions_xyz[:, :2], poses[:, :2], atol=1e-6)
    np.testing.assert_allclose(trajectory.get_orientations_euler()[:, 2], poses[:, 2], atol=1e-6)
    assert trajectory.check()[0]


def test_rolled_and_pitched_poses_keep_their_yaw(tmp_path):
    from scipy.spatial.transform import Rotation

    q = Rotation.from_euler("ZYX", [1.2, 0.2, -0.1]).as_quat()
    text = "# comment\n\n\ufeff".replace("\ufeff", "") + "  3.5 1 2 9 {} {} {} {}\r\n".format(*q)
    (tmp_path / "a.tum").write_text(text)
    stamps, poses = read_tum(tmp_path / "a.tum")
    np.testing.assert_allclose(poses, [[1, 2, 1.2]], atol=1e-9)
    assert stamps.tolist() == [3.5]


@pytest.mark.parametrize(
    ("text", "outputs"),
    [
        ("", "empty"),
        ("# only a comment\n", "no poses"),
        ("1 2 3 4 5 6 7\n", "a.tum:1: 7 columns"),
        ("1 2 3 0 0 0 0 1\n1 2 3 0 0 0 0 x\n", "a.tum:2: b'x' is not a number"),
        ("1 2 3 0 0 0 0 1\n\n1 nan 3 0 0 0 0 1\n", "a.tum:3: a number is not finite"),
        ("1 2 3 0 0 0 0 1e200\n", "not finite"),
    ],
)
def test_wrong_lines_are_named(tmp_path, text, outputs):
    (tmp_path / "a.tum").write_text(text)
    with pytest.raises(FormatError, match=outputs):
        read_tum(tmp_path / "a.tum")


@given(st.binary(max_size=200) | st.text("0123456789.e-+naif \n#", max_size=200).map(str.encode))
def test_anything_else_is_a_format_error(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("tum") / "a.tum"
    path.write_bytes(data)
    try:
        stamps, poses = read_tum(path)
    except FormatError:
        return
    assert np.isfinite(stamps).all()
    assert np.isfinite(poses).all()
