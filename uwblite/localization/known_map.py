"""Input of a live localisation: anchors with their calibration, walls, and the mounting of the laser on the robot."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..arrays import Floats
from ..errors import DataError
from ..io.stored_result import StoredAnchor, StoredResult
from ..radio.range_errors import range_errors
from ..sensor_log.sensors import last_places
from .range_model import BIAS_SIGMA, KnownAnchors
from .walls import UNIFORM_VARIANCE, Walls, walls_of

_DRAWN = np.diag(np.square((0.014, 0.014, 0.003)))
"""m^2, rad^2; variance of a wall, and of a robot's laser upon it, in cells of 0.05 m: lidars measure a surface by its colour to
0.01 m, and mountings are known to 0.01 m. In larger cells a wall lies anywhere within half a cell."""
_ROOM_BENT = _DRAWN
"""m^2, rad^2; a map of a room or two, which does not say how far it is bent, is bent by no more than its walls are off."""
_UNBENT = np.zeros((0, 2)), np.zeros((0, *_DRAWN.shape))
"""Shape of a map that does not say it."""
_SIGMA, _LEAST_SIGMA = 0.1, 0.05
"""m; spread of ranges to an anchor for which the map does not contain it, and the least one in another recording."""


@dataclass(frozen=True, slots=True, eq=False)
class KnownMap:
    """An earlier map, prepared for look-up."""

    anchors: KnownAnchors
    walls: Walls | None
    """None: the map has no grid."""
    laser_correction: Floats
    """(3,) pose by which the laser's place on the base differs from what recordings say; m, m, rad."""
    laser_delay: float = 0.0
    """s; a scan stamped t was taken at t + laser_delay by the odometry's clock."""
    shape: tuple[Floats, Floats] = _UNBENT
    """Places (p, 2), m, and by how much the map is bent there, covariances (p, 3, 3), m and rad."""

    def covariance_at(self, places: Floats) -> Floats:
        """Return the covariances (..., 3, 3) of the map's own errors at places (..., 2): no filter averages these."""
        cells = 0.0 if self.walls is None else self.walls.rounding**2 * UNIFORM_VARIANCE
        drawn = _DRAWN + np.diag((cells, cells, 0.0))
        where, bent = self.shape
        if not len(where):
            return np.broadcast_to(drawn + _ROOM_BENT, (*places.shape[:-1], *drawn.shape))
        away = np.square(places[..., None, :] - where).sum(axis=-1)
        return np.asarray(drawn + bent[np.argmin(away, axis=-1)])


def from_result(result: StoredResult) -> KnownMap:
    """Return what a folder that `uwblite map` wrote contains.

    Raises
    ------
    DataError : it contains neither an anchor with a place nor a grid.
    """
    report = result.report
    entries = {str(e.get("name")): e.get("value") for e in report.get("calibration") or () if isinstance(e, dict)}
    calibration = {name: number for name, value in entries.items() if np.isfinite(number := _number(value))}
    anchors = _with_errors(known_anchors(result.anchors, calibration), result)
    if not anchors.ids and result.grid is None:
        raise DataError(f"{result.folder} holds neither an anchor with a place nor map.yaml: no robot can be localized in it")
    correction = np.array([calibration.get(f"laser_{name}", 0.0) for name in ("x", "y", "theta")])
    missing = _number(stated.get("missing_share")) if isinstance(stated := report.get("map"), dict) else np.nan
    walls = None if result.grid is None else walls_of(replace(result.grid, missing_share=missing))
    return KnownMap(anchors, walls, correction, calibration.get("laser_delay", 0.0), _shape(report))


def known_anchors(stored: tuple[StoredAnchor, ...], calibration: dict[str, float]) -> KnownAnchors:
    """Return the anchors that have a certain place; of one that was moved, the last place."""
    by_name = {a.id: a for a in stored}
    places = {radio: by_name[name] for radio, name in last_places(by_name).items()}
    last = {radio: a for radio, a in places.items() if a.status == "ok" and np.isfinite(a.position).all()}
    sigma = np.array([a.residual_rms if np.isfinite(a.residual_rms) else _SIGMA for a in last.values()])
    # Of an anchor's place along a range from anywhere; nan where the map does not say it.
    variance = np.nan_to_num(np.array([0.5 * float(np.trace(a.covariance)) for a in last.values()]), posinf=0.0)
    return KnownAnchors(
        tuple(last),
        np.array([a.position for a in last.values()]).reshape(-1, 2),
        np.array([a.bias if np.isfinite(a.bias) else 0.0 for a in last.values()]),
        np.array([max(calibration.get(f"height2:{a.id}", 0.0), 0.0) for a in last.values()]),
        np.maximum(sigma, _LEAST_SIGMA),
        np.sqrt(BIAS_SIGMA**2 + variance),
        calibration.get("range_scale", 0.0),
    )


def _with_errors(anchors: KnownAnchors, result: StoredResult) -> KnownAnchors:
    """Return the anchors with the remaining errors of the result's own ranges to them."""
    stored = result.ranges
    index = {name: k for k, name in enumerate(map(last_places({a.id for a in result.anchors}).get, anchors.ids))}
    anchor = np.array([index.get(name, -1) for name in stored.anchors], dtype=np.intp)
    own = np.flatnonzero(anchor >= 0)
    if not len(own):
        return anchors
    anchor, tags = anchor[own], stored.tags[own]
    away = anchors.positions[anchor] - tags
    bearings = np.arctan2(away[:, 1], away[:, 0]) - stored.headings[own]
    return replace(anchors, errors=range_errors(anchor, tags, bearings, stored.errors[own], len(anchors.ids)))


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else float("nan")


def _shape(report: dict[str, Any]) -> tuple[Floats, Floats]:
    """Return places (p, 2) and covariances (p, 3, 3) of a report's entry `shape`; none where it has none that is sound."""
    try:
        poses, covariances = (np.array(report["shape"][name], dtype=np.float64) for name in ("poses", "covariances"))
        places, covariances = poses.reshape(len(poses), -1)[:, :2], covariances.reshape(len(poses), *_DRAWN.shape)
    except (KeyError, TypeError, ValueError):
        return _UNBENT
    sound = np.isfinite(places).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2))
    return places[sound], covariances[sound]
