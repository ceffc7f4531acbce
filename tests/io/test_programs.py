"""Logs and graphs in the forms that programs publish them in: read with the right values, or refused with the true reason."""

import numpy as np
import pytest
from helpers.room_recording import two_rounds, walls_seen

from uwblite import se2
from uwblite.errors import FormatError
from uwblite.io.carmen import write_log
from uwblite.io.formats import read_graph, read_recording
from uwblite.sensor_log import LaserScans, Odometry, SensorLog

POSES = two_rounds()[:1200:8]
STAMPS = 1.2e9 + 0.4 * np.arange(len(POSES))
BEAMS = np.radians(np.arange(-90.0, 90.0))
READINGS = np.array([walls_seen(pose, BEAMS) for pose in POSES])


def of_readings(readings, digits=2):
    return " ".join(f"{r:.{digits}f}" for r in readings)


def triple(pose):
    return "{:.6f} {:.6f} {:.6f}".format(*pose)


def carmen_logger(pose, t, readings):
    """Return lines as CARMEN's logger writes them today."""
    laser = f"ROBOTLASER1 0 -1.570796 3.141593 0.017453 81.910000 0.010000 0 180 {of_readings(readings)} 0"
    end = f"{t:.6f} zaza {t - STAMPS[0]:.6f}"
    return f"ODOM {triple(pose)} 0.3 0.0 0.0 {end}", f"{laser} {triple(pose)} {triple(pose)} 0.3 0.0 0.5 0.3 1000.0 {end}"


def old_carmen(pose, t, readings):
    """Return lines as CARMEN wrote them before 2004."""
    end = f"{t:.6f} nohost {t - STAMPS[0]:.6f}"
    return f"ODOM {triple(pose)} 0.3 0 0 {end}", f"FLASER 180 {of_readings(readings)} {triple(pose)} {triple(pose)} {end}"


def gmapping(pose, t, readings):
    """Return lines of a corrected log: behind each scan an ODOM whose stamp was never set."""
    (_, laser), never = old_carmen(pose, t, readings), "8.54e-72 pippo 8.54e-72"
    return f"ODOM {triple(pose)} 0 0 0 {t:.6f} pippo {t:.6f}", laser, f"ODOM {triple(pose)} 0 0 0 {never}", "NEFF 29.97"


def player(pose, t, readings):
    """Return lines as converters of Player's logs write them: no ipc_timestamp, no laser but FLASER."""
    scan = f"FLASER 180 {of_readings(readings, 3)} {triple(pose)} {triple(pose)} player {t:.6f}"
    return f"ODOM {triple(pose)} 0 0 0 player {t:.6f}", scan


def from_rosbag(pose, t, readings):
    """Return lines as scripts write them from bags, with ROS' words for nothing seen and for errors."""
    words = [f"{r:.4f}" for r in readings]
    words[3], words[4] = "inf", "nan"
    head, end = "ROBOTLASER1 0 -1.5707963 3.1241393 0.0174533 30.0 0.01 0 180", f"{t:.6f} ros {t:.6f}"
    return f"ODOM {triple(pose)} 0 0 0 {end}", f"{head} {' '.join(words)} 0 {triple(pose)} {triple(pose)} 0 0 0 0 0 {end}"


def written(tmp_path, form):
    path = tmp_path / "run.log"
    if form is None:
        scans = LaserScans(STAMPS, READINGS.astype(np.float32), -np.pi / 2, np.pi / 180, 0.0, 0.02, 30.0)
        write_log(path, SensorLog(Odometry(STAMPS, POSES), None, scans))
        return path
    lines = [line for row in zip(POSES, STAMPS, READINGS, strict=True) for line in form(*row)]
    path.write_text("\n".join(["# CARMEN Logfile", "PARAM robot_length 0.5 1.0 zaza 1.0", *lines]) + "\n")
    return path


@pytest.mark.parametrize("form", [carmen_logger, old_carmen, gmapping, player, from_rosbag, None])
def test_carmen_logs_of_six_programs(tmp_path, form):
    """Poses, times and walls are those that were written, whatever the program."""
    log = read_recording(str(written(tmp_path, form)))
    assert not log.notes.broken
    np.testing.assert_allclose(log.odometry.stamps, STAMPS, atol=1e-5)
    np.testing.assert_allclose(log.odometry.poses[:, :2], POSES[:, :2], atol=1e-5)
    np.testing.assert_allclose(se2.wrap_angle(log.odometry.poses[:, 2] - POSES[:, 2]), 0.0, atol=1e-5)
    np.testing.assert_allclose(log.scans.stamps, STAMPS, atol=1e-5)
    np.testing.assert_allclose(log.scans.angle_min + log.scans.angle_increment * np.arange(180), BEAMS, atol=1e-3)
    expected = READINGS.copy()
    if form is from_rosbag:
        expected[:, 3], expected[:, 4] = np.inf, np.nan
    np.testing.assert_allclose(log.scans.ranges, expected, atol=0.006)
    assert any("corrected, as by GMapping" in w for w in log.notes.warnings) == (form is gmapping)


OTHERS = {
    "is a log of Player": "## Player version 2.1.0\n## File version 0.3.0\n1.2 16777343 6665 position2d 00 001 001 +0 +0 +0\n",
    "is a trace of GMapping .*gfs2log": "LASER_READING 2 1.00 1.00 0 0 0 1.2e9\nSM_UPDATE 1 0 0 0 1\nNEFF 30\n",
    "is a log of RHINO or Beesoft, in centimetres": "@SENS 21-12-97 12:34:56.123456\n#ROBOT 12.3 4.5 90.0\n",
    "is a log of RHINO or Beesoft": "POS 9 1: 1 2 90 0 0\nLASER-RANGE 9 1 0 2 180.0: 12.0 13.0\n",
    "is a laser log of ARIA": "LaserOdometryLog\n#Created by ARIA\nversion: 3\nrobot: 12 13 90\n",
}


@pytest.mark.parametrize(("why", "text"), OTHERS.items())
@pytest.mark.parametrize("name", ["run.log", "run.txt", "run"])
def test_logs_of_other_kinds_are_named(tmp_path, why, text, name):
    (tmp_path / name).write_text(text)
    with pytest.raises(FormatError, match=why):
        read_recording(str(tmp_path / name))


SQUARE = np.array([[0, 0, 0], [2, 0, np.pi / 2], [2, 2, np.pi], [0, 2, -np.pi / 2]], dtype=np.float64)
ENDS = ((0, 1), (1, 2), (2, 3), (3, 0))
INFORMATION = np.array([[30.0, 2.0, 1.0], [2.0, 20.0, 3.0], [1.0, 3.0, 50.0]])
ROW_BY_ROW, OF_TORO = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)), ((0, 0), (0, 1), (1, 1), (2, 2), (0, 2), (1, 2))
GTSAM = 8646911284551352320
"""gtsam's number of the symbol x0."""


def steps():
    """Yield ends and measurement of each edge; the last is off, so that the minimum is not where it starts."""
    for k, (i, j) in enumerate(ENDS):
        yield i, j, se2.between(SQUARE[i], SQUARE[j]) + (0.1, -0.05, 0.04) * np.array(k == 3)


def graph_text(vertex, edge, order=ROW_BY_ROW, first=0, inverse=False, matrix=INFORMATION):
    lines = [f"{vertex} {first + k} {triple(pose)}" for k, pose in enumerate(SQUARE) if vertex]
    numbers = " ".join(f"{matrix[place]:.9f}" for place in order)
    for i, j, T in steps():
        ends, T = ((j, i), se2.inverse(T)) if inverse else ((i, j), T)
        lines.append(f"{edge} {first + ends[0]} {first + ends[1]} {triple(T)} {numbers}")
    return "\n".join(lines) + "\n"


def pyfg_text():
    lines = [f"VERTEX_SE2 {k}.0 A{k} {triple(pose)}" for k, pose in enumerate(SQUARE)]
    numbers = " ".join(f"{np.linalg.inv(INFORMATION)[place]:.12f}" for place in ROW_BY_ROW)
    return "\n".join([*lines, *(f"EDGE_SE2 {j}.0 A{i} A{j} {triple(T)} {numbers}" for i, j, T in steps())]) + "\n"


GRAPHS = {
    "g2o": graph_text("VERTEX_SE2", "EDGE_SE2") + "FIX 0\nPARAMS_SE2OFFSET 0 0 0 0\n",
    "gtsam": graph_text("VERTEX_SE2", "EDGE_SE2", first=GTSAM),
    "gtsam, save2D": graph_text("VERTEX2", "EDGE2", OF_TORO, inverse=True),
    "TORO": graph_text("VERTEX2", "EDGE2", OF_TORO),
    "SE-Sync": graph_text("", "EDGE_SE2"),
    "PyFG": pyfg_text(),
}


@pytest.mark.parametrize("program", GRAPHS)
@pytest.mark.parametrize("name", ["graph.g2o", "graph.graph", "graph.txt"])
def test_graphs_of_each_program_are_the_same_graph(tmp_path, program, name):
    (tmp_path / name).write_text(GRAPHS[program])
    file = read_graph(str(tmp_path / name))
    graph, (edges,) = file.graph, file.graph.edges
    apart = se2.between(SQUARE, se2.between(graph.poses[:1], graph.poses))
    apart[:, 2] = se2.wrap_angle(apart[:, 2])
    np.testing.assert_allclose(apart, 0.0, atol=1e-5)
    order = (edges.j, edges.i) if program == "gtsam, save2D" else (edges.i, edges.j)
    assert list(zip(*(end.tolist() for end in order), strict=True)) == list(ENDS)
    wanted = np.array([T for _, _, T in steps()])
    measured = se2.inverse(edges.T_i_j) if program == "gtsam, save2D" else edges.T_i_j
    np.testing.assert_allclose(se2.between(wanted, measured), 0.0, atol=1e-5)
    L = edges.sqrt_information
    np.testing.assert_allclose(np.swapaxes(L, 1, 2) @ L, np.broadcast_to(INFORMATION, (4, 3, 3)), rtol=1e-5)
    assert file.pose_ids[0] == {"gtsam": str(GTSAM), "PyFG": "A0"}.get(program, "0")


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (graph_text("", "ODOMETRY", matrix=np.linalg.cholesky(INFORMATION).T), "ODOMETRY and LANDMARK are iSAM's"),
        (graph_text("", "EDGE2", matrix=np.diag([3.0, 3.0, 5.0])), "iSAM and gtsam write another EDGE2"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n", "VERTEX_SE3:QUAT: the graph is three-dimensional"),
        ("EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1" + " 1" * 21 + "\n", "EDGE_SE3:QUAT: the graph is three-dimensional"),
        ("VERTEX3 0 0 0 0 0 0 0\nEDGE3 0 1 1 0 0 0 0 0" + " 1" * 21 + "\n", "three-dimensional"),
        ("VERTEX_SE3:QUAT 0.0 A0 0 0 0 0 0 0 1\n", "three-dimensional"),
    ],
)
def test_graphs_that_are_not_read_are_refused_with_the_reason(tmp_path, text, why):
    for name in ("graph.g2o", "graph.txt"):
        (tmp_path / name).write_text(text)
        with pytest.raises(FormatError, match=why):
            read_graph(str(tmp_path / name))
