"""A small, complete map result made by hand, for tests of what is done with results, and what its folder holds."""

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from uwblite import se2
from uwblite.findings import doubt, warning
from uwblite.graph.graph import Graph, UnknownKey
from uwblite.graph.pose_edges import RelativePoseEdges
from uwblite.graph.range_edges import RangeEdges
from uwblite.graph.work import StageSummary
from uwblite.grid.geometry import GridGeometry
from uwblite.grid.occupancy_grid import OccupancyGrid
from uwblite.io.result_text import RunRecord
from uwblite.io.results import write_result
from uwblite.map_result import AnchorEstimate, CalibrationEstimate, LoopClosure, MapResult
from uwblite.sensor_log import LaserScans, LogNotes, Odometry, SensorLog, UwbRanges

FILES = {
    "anchors.csv", "config.toml", "graph.g2o", "graph.pyfg", "graph_stamps.csv", "map.pgm", "map.png", "map.yaml",
    "range_errors.csv", "report.html", "report.json", "trajectory.tum", "trajectory_covariance.csv",
}  # fmt: skip
"""What `uwblite map` writes of one recording with lidar."""

EVIL = "<script>alert('x')</script>&\"\u202e"


def contents(folder):
    """Return the bytes of every file of a folder by name."""
    return {p.name: p.read_bytes() for p in Path(folder).iterdir()}


def small_folder(folder, *, evil="", command="uwblite map x", settings=""):
    """Write that result of `small_log` to a folder, drawn and packed once."""
    folder.mkdir(parents=True)
    for name, data in _small_files(evil, command, settings).items():
        (folder / name).write_bytes(data)


@cache
def _small_files(evil, command, settings):
    with TemporaryDirectory() as place:
        write_result(Path(place) / "map", [small_log()], small_result(evil=evil), RunRecord(command, settings))
        return contents(Path(place) / "map")


def small_result(*, evil: str = "", lidar: bool = True, each: int = 1, seconds: float = 0.0) -> MapResult:
    """Return a result of a square path with two anchors and three closures; `evil` is put into every text of it."""
    k = 24 * each
    turn = np.linspace(0, 4 * np.pi, k, endpoint=False)
    poses = np.stack([3 * np.cos(turn), 2 * np.sin(turn), se2.wrap_angle(turn + np.pi / 2)], axis=1)
    stamps = 1000.0 + np.arange(k) * 0.5
    covariances = np.tile(np.diag([1e-4, 2e-4, 1e-5]), (k, 1, 1))
    rng = np.random.default_rng(3)
    anchors = np.array([[4.0, 3.0], [-4.0, -3.0]])
    pose, anchor = np.repeat(np.arange(k), 2), np.tile([0, 1], k)
    distance = np.hypot(*(poses[pose, :2] - anchors[anchor]).T)
    edges = RangeEdges(
        pose,
        anchor,
        distance,
        np.full(2 * k, 0.1),
        np.zeros((2 * k, 2)),
        np.zeros(2 * k),
        np.zeros((2 * k, 2)),
        np.zeros(2),
        np.zeros(2 * k),
        np.full((2 * k, 6), -1),
    )
    i = np.arange(k - 1)
    motion = np.array([[0.5, 0.0, 0.1]] * (k - 1))
    chain = RelativePoseEdges(i, i + 1, motion, np.tile(np.eye(3) * 50, (k - 1, 1, 1)))
    closures = (
        LoopClosure(0, 12, np.zeros(3), np.eye(3) * 100, 0.02, 0.8, "accepted", "consistent with the others" + evil),
        LoopClosure(2, 14, np.ones(3), np.eye(3) * 100, 0.09, 0.3, "few-matches", "overlap too small" + evil),
        LoopClosure(3, 15, np.ones(3), np.eye(3) * 100, 0.09, 0.3, "few-matches", "overlap too small" + evil),
    )
    geometry = GridGeometry(0.1, np.array([-5.0, -4.0]), 80, 100)
    log_odds = np.where(rng.uniform(size=(80, 100)) < 0.1, 4.0, -4.0).astype(np.float32)
    log_odds[:10] = 0.0
    agrees = (rng.uniform(size=2 * k) > 0.1).astype(np.float64)
    return MapResult(
        stamps,
        poses,
        np.repeat(np.arange(each), 24),
        stamps,
        np.repeat(np.arange(each), 24),
        covariances,
        Graph(poses, anchors, (chain, edges)),
        (
            AnchorEstimate("5C0B" + evil, anchors[0], np.diag([0.0016, 0.0004]), k, 0.94, 0.46, 0.02, 0.05, "ok"),
            AnchorEstimate(
                "91A3",
                anchors[1],
                np.array([[0.01, 0.004], [0.004, 0.01]]),
                k,
                0.5,
                0.1,
                0.2,
                0.3,
                "mirror-ambiguous",
                "the path is straight" + evil,
                np.array([-4.0, 3.0]),
            ),
        ),
        (
            CalibrationEstimate(
                UnknownKey("odometry_scale"), -0.012, 0.002, "1", "error of travelled distance" + evil, "estimated"
            ),
            CalibrationEstimate(
                UnknownKey("laser_delay"), 0.0, 0.03, "s", "clock offset", "prior", "the robot hardly turns" + evil
            ),
        ),
        closures,
        {
            "stamp": stamps[pose],
            "anchor": anchor.astype(np.float64),
            "range": distance,
            "residual": rng.normal(0, 0.05, 2 * k),
            "weight": agrees,
            "agrees": agrees,
            "x": poses[pose, 0],
            "y": poses[pose, 1],
            "theta": poses[pose, 2],
            "recording": np.repeat(np.arange(each), 24)[pose].astype(np.float64),
        },
        OccupancyGrid(geometry, log_odds, 24) if lidar else None,
        (StageSummary("first optimisation", seconds, {"chi2": 40.0, "dof": 50, "iterations": 7, "note": "x" + evil}),),
        (
            warning("anchor-mirror-ambiguous", "anchor 91A3 may be mirrored" + evil, anchor="91A3" + evil),
            *([doubt("few-closures" + evil, "few closures" + evil)] if evil else []),
        ),
    )


def small_log(*, name: str = "run.log") -> SensorLog:
    """Return a recording that such a result could come from."""
    stamps = 1000.0 + np.arange(24) * 0.5
    poses = np.stack([0.1 * np.arange(24), np.zeros(24), np.zeros(24)], axis=1)
    ranges = UwbRanges(stamps, np.zeros(24, dtype=np.intp), np.full(24, 3.0), np.full(24, 100.0), ("5C0B",))
    scans = LaserScans(stamps, np.full((24, 90), 2.0, dtype=np.float32), -0.78, 0.0175, 0.0, 0.02, 5.6)
    return SensorLog(Odometry(stamps, poses), ranges, scans, notes=LogNotes(source=name, sha256="ab" * 32, lines=72))
