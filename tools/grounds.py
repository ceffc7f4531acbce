"""Maps of simulated recordings, and other recordings in the same buildings; shared by the tools that measure the live pose."""

import one_thread  # noqa: F401

import tempfile
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from simulation import logfile
from simulation.laser import LaserModel
from simulation.real_rooms import RealRooms
from simulation.recording import Settings, simulate
from trials import Trial, loaded

from uwblite.evaluation.trajectory import evaluate_trajectory
from uwblite.io.result_text import RunRecord
from uwblite.io.results import write_result
from uwblite.io.stored_result import StoredResult, read_result
from uwblite.localization.known_map import KnownMap, from_result
from uwblite.mapping import build_map
from uwblite.pipeline.mapping_config import preset

MINUTES = {"hall": 15.0, "lab": 10.0, "warehouse": 40.0, "arena": 15.0, "room": 3.0, "corridor": 15.0}
"""Of the recording that a map is made of."""
SPEED = {"warehouse": 0.5}
"""m/s of the robots in a world, where it is not 0.2: half an hour of that passes a tenth of the warehouse."""
WEAK_GRAZING = np.deg2rad(70.0)
"""Angle at which a weak lidar loses half of the rays at 3 m."""
PLAYED = 10.0
"""Minutes of another recording in the same building."""


@dataclass(frozen=True)
class Place:
    """A building and a recording of it."""

    world: str
    building: int
    seed: int
    easy: bool = False
    """Rooms without errors that stay with places, and without people."""
    weak: bool = False
    """The lidar loses a sixth of its returns by distance, angle and paint, and another robot carries it a little turned."""

    @property
    def settings(self) -> Settings:
        """Of the recording that the map is made of."""
        rooms = None if self.easy else RealRooms()
        minutes = MINUTES[self.world]
        speed = SPEED.get(self.world, 0.2)
        laser = LaserModel(grazing=WEAK_GRAZING, weak=0.2, dark=0.2) if self.weak else LaserModel()
        if rooms is not None and self.weak:
            rooms = replace(rooms, grazing=WEAK_GRAZING)
        return Settings(self.world, self.seed, minutes, speed, scan_rate=5.0, building=self.building, rooms=rooms, laser=laser)

    @property
    def name(self) -> str:
        """Of its folder."""
        return f"{self.world}-{self.building}-{self.seed}" + "-easy" * self.easy + "-weak" * self.weak


@dataclass(frozen=True)
class Ground:
    """A map and where it lies over the building."""

    result: StoredResult
    known: KnownMap
    T_truth_map: np.ndarray
    """(3,)."""


def mapped(place: Place, name: str = "default", keep: Path | None = None) -> Ground:
    """Map a recording with a preset; what is kept in a folder is used again."""
    with _folder(keep) as folder:
        home = Path(folder) / place.name
        trial, made = _recorded(place.settings, home / "mapped"), home / f"map-{name}"
        if not made.exists():
            record = RunRecord("tools/grounds.py", "")
            write_result(made, [trial.log], build_map(trial.log, preset(name)), record)
        result = read_result(made)
        path = evaluate_trajectory(*result.trajectories[0], trial.stamps, trial.poses)
        return Ground(result, from_result(result), path.T_truth_map)


def played(place: Place, keep: Path | None = None) -> Trial:
    """Return another path of another robot, from another day, in the same building."""
    with _folder(keep) as folder:
        settings = replace(place.settings, seed=place.seed + 1, minutes=PLAYED, scan_rate=10.0)
        if place.weak:
            settings = replace(settings, laser_error=(0.005, -0.005, -0.012))
        return _recorded(settings, Path(folder) / place.name / "played")


def _recorded(settings: Settings, home: Path) -> Trial:
    if not (home / "run.log").exists():
        home.mkdir(parents=True, exist_ok=True)
        logfile.write(simulate(settings), home)
    return loaded(home)


def _folder(keep: Path | None) -> "nullcontext[Path] | tempfile.TemporaryDirectory[str]":
    return tempfile.TemporaryDirectory(prefix="uwblite-") if keep is None else nullcontext(keep)
