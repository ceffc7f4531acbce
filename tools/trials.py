"""Simulated recordings with their truth, and how far a map of one is from it; shared by the tools that measure accuracy."""

import one_thread  # noqa: F401

import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import numpy as np
from numpy.typing import NDArray
from simulation import logfile
from simulation.recording import Recording, Settings, simulate

from uwblite import se2
from uwblite.cli.evaluate import read_landmarks
from uwblite.evaluation.map import LandmarkErrors, Landmarks, find_columns, landmark_errors, landmark_errors_along
from uwblite.evaluation.relations import evaluate_relations
from uwblite.evaluation.trajectory import evaluate_anchors, evaluate_trajectory
from uwblite.io.carmen import read_log
from uwblite.io.csv_table import read_csv
from uwblite.io.tum import read_relations, read_tum
from uwblite.map_result import MapResult
from uwblite.sensor_log import SensorLog

Floats = NDArray[np.float64]
Task = TypeVar("Task")
Answer = TypeVar("Answer")

SHARED = Path(os.environ.get("UWBLITE_SHARED_DATA", ROOT.parent / "shared" / "data"))


@dataclass(frozen=True)
class Trial:
    """A recording and what is true of it."""

    log: SensorLog
    stamps: Floats
    """(n,) s, of the true poses."""
    poses: Floats
    """(n, 3) T_truth_base."""
    anchors: dict[str, Floats]
    """(2,) m by id."""
    columns: Landmarks | None = None
    pairs: tuple[tuple[str, str], ...] | None = None
    """Pairs of columns whose distance is judged; None = all."""


@dataclass(frozen=True)
class Figures:
    """How far a map is from the truth; plain numbers, so that they travel between processes."""

    ate: float
    """m."""
    heading: float
    """rad, rms; nan where the truth has none."""
    column: float
    """m, mean absolute error of the distances between columns found in the map; nan without a map or columns."""
    drawn: float
    """m, the same for the columns as the trajectory draws them: needs no map, and judges the most smeared one."""
    pairs: tuple[tuple[str, str, float, float], ...]
    """Names, error in the map (nan = a column was not found) and error as drawn, m."""
    missing: tuple[str, ...]
    """Columns that were not found in the map."""
    anchors: float
    """m, rms; nan without any."""
    anchor_errors: tuple[tuple[str, float], ...]
    """m by id; inf = not placed."""
    closures: tuple[int, int]
    """Accepted, candidates."""
    doubts: tuple[str, ...]
    stages: tuple[tuple[str, float], ...]
    """Name, s."""

    @property
    def seconds(self) -> float:
        """Wall time of the whole map, s."""
        return sum(s for _, s in self.stages)


def made(settings: Settings) -> Trial:
    """Simulate a recording and read it back from a log in a temporary folder."""
    return as_read(simulate(settings))


def as_read(recording: Recording) -> Trial:
    """Return a simulated recording as it reads from its log, and what is true of it."""
    with tempfile.TemporaryDirectory(prefix="uwblite-") as folder:
        logfile.write(recording, Path(folder))
        return loaded(Path(folder))


def loaded(folder: Path) -> Trial:
    """Read what tools/simulate.py wrote."""
    log = read_log(next(p for p in (folder / "run.log", folder / "run.log.gz") if p.exists()))
    stamps, poses = read_tum(folder / "truth.tum")
    table = read_csv(folder / "truth_anchors.csv")
    anchors = dict(zip(table.texts("id"), table.numbers("x", "y"), strict=True))
    columns, pairs = read_landmarks(str(folder / "columns.csv"))
    return Trial(log, stamps, poses, anchors, columns, pairs)


def judged(result: MapResult, trial: Trial, max_gap: float = 1.0) -> Figures:
    """Compare a map with the truth."""
    path = evaluate_trajectory(result.stamps, result.trajectory, trial.stamps, trial.poses, max_gap=max_gap)
    nan = float("nan")
    in_map = drawn = None
    if trial.columns is not None and len(trial.columns.names):
        seen = trial.poses[path.matched]
        estimate = se2.interpolate_trajectory(result.stamps, result.trajectory, trial.stamps[path.matched])
        drawn = landmark_errors_along(trial.columns, seen, estimate, trial.pairs)
        if result.grid is not None:
            occupied = se2.transform(path.T_truth_map, result.grid.occupied_points())
            found = find_columns(occupied, trial.columns, cell=result.grid.geometry.resolution)
            in_map = landmark_errors(found, trial.columns, trial.pairs)
    ids = tuple(a.id for a in result.anchors)
    places = np.array([a.position for a in result.anchors]).reshape(-1, 2)
    true_places = np.array(list(trial.anchors.values())).reshape(-1, 2)
    anchors = evaluate_anchors(ids, places, tuple(trial.anchors), true_places, path.T_truth_map)
    by_id = dict(zip(anchors.ids, anchors.distances.tolist(), strict=True))
    return Figures(
        ate=path.ate.rmse,
        heading=nan if path.heading is None else path.heading.rmse,
        column=nan if in_map is None or not in_map.pairs else in_map.mean,
        drawn=nan if drawn is None or not drawn.pairs else drawn.mean,
        pairs=_pairs(in_map, drawn),
        missing=() if in_map is None else in_map.missing,
        anchors=anchors.rmse,
        anchor_errors=tuple((i, by_id.get(i, float("inf"))) for i in ids),
        closures=(sum(c.accepted for c in result.closures), len(result.closures)),
        doubts=tuple(map(str, result.doubts)),
        stages=tuple((s.name, s.seconds) for s in result.stages),
    )


def _pairs(in_map: LandmarkErrors | None, drawn: LandmarkErrors | None) -> tuple[tuple[str, str, float, float], ...]:
    if drawn is None:
        return ()
    found = {} if in_map is None else dict(zip(in_map.pairs, in_map.errors.tolist(), strict=True))
    rows = zip(drawn.pairs, drawn.errors.tolist(), strict=True)
    return tuple((a, b, found.get((a, b), float("nan")), error) for (a, b), error in rows)


MIRRORED = ("labyrinth",)
"""Recordings that are doubted with reason, and judged up to the mirror image: without lidar the odometry's turns alone decide
between the two, and here they are counted the other way round (tests/test_mapping.py)."""


def true_path(folder: Path, log: SensorLog) -> tuple[Floats, Floats]:
    """Return stamps and poses of the reference."""
    for name in ("truth.tum", "truth_position.tum"):
        if (folder / name).exists():
            return read_tum(folder / name)
    assert log.scans is not None
    rows = np.loadtxt(folder / "reference_poses_matched.csv", delimiter=",", skiprows=1)
    # Its steps count the scans of this log; its scan index those of the thinned log it was matched with.
    return log.scans.stamps[rows[:, 0].astype(int)], rows[:, 2:5]


def real_error(folder: Path, log: SensorLog, result: MapResult, truth: tuple[Floats, Floats] | None = None) -> float:
    """Return the error of the map of a recording of others, m: the mean over relations, where there are any, else the ATE.

    truth : stamps and poses of the reference; None = those of the folder, whose steps count all scans.
    """
    if truth is None and (folder / "truth.relations.gz").exists():
        relations, delay = read_relations(folder / "truth.relations.gz"), result.graph.calibration.get("laser_delay")
        return evaluate_relations(result.stamps, result.trajectory, relations, delay).translations.mean
    sides = [(1.0, 1.0, 1.0), (1.0, -1.0, -1.0)][: 2 if folder.name in MIRRORED else 1]
    truth = true_path(folder, log) if truth is None else truth
    # Some of them have one odometry pose in many seconds.
    return min(evaluate_trajectory(result.stamps, result.trajectory * side, *truth, max_gap=30.0).ate.rmse for side in sides)


def spread_out(work: Callable[[Task], Answer], tasks: Sequence[Task], jobs: int) -> Iterator[Answer]:
    """Yield work(task) in the order of the tasks, in so many processes."""
    if jobs <= 1:
        yield from map(work, tasks)
        return
    with ProcessPoolExecutor(jobs) as pool:
        yield from pool.map(work, tasks)


def table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Return a Markdown table; numbers get three decimals, nan a dash."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    lines += ["| " + " | ".join(_cell(c) for c in row) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def _cell(value: Any) -> str:
    if isinstance(value, float | np.floating):
        return "-" if np.isnan(value) else f"{value:.3f}"
    return str(value)


def write_section(path: Path, name: str, text: str) -> None:
    """Replace the part of a document between the marks of this name, or add it at the end."""
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    document = path.read_text() if path.exists() else ""
    part = f"{begin}\n{text.strip()}\n{end}"
    pattern = re.compile(re.escape(begin) + ".*?" + re.escape(end), re.DOTALL)
    document = pattern.sub(lambda _: part, document) if pattern.search(document) else f"{document.rstrip()}\n\n{part}\n"
    path.write_text(document.lstrip())
