"""The files of a recording: the CARMEN log, and the truth beside it."""

import gzip
import json
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .floorplans import FloorPlan
from .recording import Recording

Floats = NDArray[np.float64]


def write(recording: Recording, directory: Path, compress: bool = False) -> None:
    """Write run.log(.gz) and the truth files."""
    directory.mkdir(parents=True, exist_ok=True)
    with (directory / ("run.log.gz" if compress else "run.log")).open("wb") as file:
        if compress:
            with gzip.GzipFile("", "wb", 6, file, mtime=0) as packed:
                packed.writelines(log_lines(recording))
        else:
            file.writelines(log_lines(recording))
    plan, truth = recording.plan, recording.truth
    half = 0.5 * truth[:, 2]
    rows = np.column_stack([recording.stamps, truth[:, :2], np.sin(half), np.cos(half)])
    _lines(directory / "truth.tum", "", (f"{t:.6f} {x:.5f} {y:.5f} 0 0 0 {z:.8f} {w:.8f}" for t, x, y, z, w in rows))
    anchors = zip(plan.anchor_ids, recording.anchors.tolist(), strict=False)
    height = recording.settings.anchor_height
    _lines(directory / "truth_anchors.csv", "id,x,y,height", (f"{i},{x:.4f},{y:.4f},{height:.3f}" for i, (x, y) in anchors))
    _lines(directory / "columns.csv", "name,x,y,radius,neighbours", _column_rows(plan))
    _lines(directory / "walls.csv", "x1,y1,x2,y2", (",".join(f"{v:.4f}" for v in w) for w in plan.walls.tolist()))
    _lines(directory / "posts.csv", "x,y,radius", (",".join(f"{v:.4f}" for v in c) for c in plan.columns.tolist()))
    (directory / "truth_calibration.json").write_text(json.dumps(recording.calibration, indent=1, sort_keys=True) + "\n")


def _column_rows(plan: FloorPlan) -> list[str]:
    rows = []
    for name, (x, y, radius) in zip(plan.landmarks, plan.columns.tolist(), strict=False):
        neighbours = " ".join(b for a, b in plan.pairs if a == name)
        rows.append(f"{name},{x:.4f},{y:.4f},{radius:.3f},{neighbours}")
    return rows


def _lines(path: Path, header: str, rows: Iterable[str]) -> None:
    with path.open("w") as file:
        file.writelines(line + "\n" for line in chain([header] if header else [], rows))


def log_lines(recording: Recording) -> Iterator[bytes]:
    """Yield the lines of the recording as a CARMEN log, in the order in which a logger would have written them."""
    settings = recording.settings
    params = {
        "laser_time_increment": f"{settings.laser.time_increment:.8f}",
        "uwb_tag_offset_x": f"{settings.tag[0]:.3f}",
        "uwb_tag_offset_y": f"{settings.tag[1]:.3f}",
    }
    if not settings.laser.stated:
        del params["laser_time_increment"]
    if settings.write_heights:
        params |= {"uwb_tag_height": f"{settings.tag_height:.3f}", "uwb_anchor_height": f"{settings.anchor_height:.3f}"}
    yield b"# CARMEN Logfile\n"
    yield f"# simulated {settings.world}, seed {settings.seed}\n".encode()
    yield from (f"PARAM {name} {value} 0 sim 0\n".encode() for name, value in params.items())
    # A logger writes what has arrived: a scan after its sweep, a range after its slot. Stamps therefore run out of order.
    written = np.concatenate([recording.stamps + 0.002, recording.scan_stamps + 0.102, recording.range_stamps + 0.03])
    # The messages of one sensor come in their own order; each is made when its turn comes, for scans of hours are large.
    kinds = (_odometry_lines(recording), _scan_lines(recording), _range_lines(recording))
    kind = np.repeat(np.arange(3), [len(recording.stamps), len(recording.scan_stamps), len(recording.range_stamps)])
    yield from (next(kinds[k]) for k in kind[np.argsort(written, kind="stable")].tolist())


def _wrap(theta: Floats) -> Floats:
    return (theta + np.pi) % (2.0 * np.pi) - np.pi


def _odometry_lines(r: Recording) -> Iterator[bytes]:
    t, pose = r.stamps, r.odometry
    step = np.diff(pose, axis=0, append=pose[-1:]) * r.settings.odometry_rate
    forward = step[:, 0] * np.cos(pose[:, 2]) + step[:, 1] * np.sin(pose[:, 2])
    rows = np.column_stack([pose[:, :2], _wrap(pose[:, 2]), forward, step[:, 2], t, t + 0.002])
    for x, y, a, v, w, stamp, written in map(np.ndarray.tolist, rows):
        yield f"ODOM {x:.6f} {y:.6f} {a:.6f} {v:.4f} {w:.4f} 0 {stamp:.6f} sim {written:.6f}\n".encode()


def _scan_lines(r: Recording) -> Iterator[bytes]:
    model, (mx, my, mt) = r.settings.laser, r.settings.laser_pose
    span = (model.beams - 1) * model.increment
    head = f"ROBOTLASER1 2 {model.angles[0]:.9f} {span:.9f} {model.increment:.9f} {model.max_range:.3f} 0.01 0 {model.beams} "
    wide = len(f"{model.max_range:.3f}")
    text = "".join(f"{mm / 1000:{wide}.3f} " for mm in range(int(model.max_range * 1000) + 1))
    words = np.frombuffer(text.encode(), dtype=f"S{wide + 1}")
    c, s = np.cos(r.scan_poses[:, 2]), np.sin(r.scan_poses[:, 2])
    x, y = r.scan_poses[:, 0], r.scan_poses[:, 1]
    where = np.column_stack(
        [x + c * mx - s * my, y + s * mx + c * my, _wrap(r.scan_poses[:, 2] + mt), x, y, _wrap(r.scan_poses[:, 2])]
    )
    start = head.encode()
    for scan, pose, t in zip(r.scans, map(np.ndarray.tolist, where), r.scan_stamps.tolist(), strict=True):
        end = "0 " + " ".join(f"{v:.6f}" for v in pose) + f" 0 0 0 0 0 {t:.6f} sim {t + 0.102:.6f}\n"
        yield start + words[scan].tobytes() + end.encode()


def _range_lines(r: Recording) -> Iterator[bytes]:
    rows = zip(r.range_anchors.tolist(), r.ranges.tolist(), r.range_stamps.tolist(), strict=True)
    ids = r.plan.anchor_ids
    return (f"UWB {ids[a]} {d:.3f} 100 {t:.6f} sim {t + 0.03:.6f}\n".encode() for a, d, t in rows)
