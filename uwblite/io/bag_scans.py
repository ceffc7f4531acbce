"""Scans in a bag: sensor_msgs/LaserScan of one lidar, its header fields validated."""

from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..sensor_log import LaserScans
from .scan_geometry import ScanGeometry, largest_reading, resampled, resampling_warning, without_reach


class ScanReadings:
    """Collects the messages of one topic."""

    def __init__(self) -> None:
        self._scans: dict[str, list[tuple[float, NDArray[np.float32]]]] = {}
        self._header: dict[str, tuple[ScanGeometry, float, float, float]] = {}
        """Geometry, time_increment, range_min and range_max of the first scan of each frame."""
        self.odd, self.resized = Counter[str](), Counter[str]()
        self._noted = dict[str, int]()

    def take(self, stamp: float, message: Any) -> None:
        """Take a message."""
        frame, readings = message.header.frame_id.lstrip("/"), np.array(message.ranges, dtype=np.float32)
        have = self._geometry(message, len(readings))
        if have is None:
            self.odd[frame] += 1
            return
        if frame not in self._header:
            self._header[frame] = (have, *self._limits(message))
        want, _, range_min, range_max = self._header[frame]
        _clean(readings, range_min, range_max)
        if have.beams != want.beams or _turned(have, want):
            if not want.is_of_one_lidar_with(have):
                self.odd[frame] += 1
                return
            self.resized[frame] += 1
            readings = resampled(readings[None], have, want)[0]
        self._scans.setdefault(frame, []).append((stamp, readings))

    @property
    def frame(self) -> str:
        """The frame of most scans; '' without any."""
        return max(self._scans, key=lambda name: (len(self._scans[name]), name), default="")

    def scans(self, offset: float, warnings: list[str]) -> LaserScans | None:
        """Return the scans of the commonest frame, moved in time by an offset, s; None without any."""
        warnings += [text.format(count=count) for text, count in self._noted.items()]
        if self.odd.total():
            warnings.append(f"{self.odd.total()} scans of another geometry, or without readings, were skipped")
        if not self._scans:
            return None
        frame = self.frame
        if others := {name: len(rows) for name, rows in self._scans.items() if name != frame}:
            counts = ", ".join(f"{count} of {name or 'a frame without name'}" for name, count in sorted(others.items()))
            warnings.append(
                f"the scans' topic bears scans of several frames, as of two lidars: those of {frame} are used, others left out"
                f" ({counts}); give each lidar a topic of its own"
            )
        geometry, time_increment, range_min, range_max = self._header[frame]
        rows = self._scans[frame]
        if self.resized[frame]:
            warnings.append(resampling_warning(self.resized[frame], len(rows), geometry.beams))
        stamps = np.array([stamp for stamp, _ in rows]) + offset
        order = np.argsort(stamps, kind="stable")
        readings = np.stack([rows[k][1] for k in order])
        if range_max == np.inf:
            range_max = largest_reading(readings)
            readings[readings > np.float32(range_max)] = np.inf
            warnings.append(without_reach(range_max))
        return LaserScans(
            stamps[order], readings, geometry.angle_min, geometry.angle_increment, time_increment, range_min, range_max
        )

    def _geometry(self, message: Any, beams: int) -> ScanGeometry | None:
        """Return where the beams of a message point; None where it has none, or its fields do not tell."""
        first, last, step = (float(getattr(message, f"angle_{name}", np.nan)) for name in ("min", "max", "increment"))
        if not beams or not np.isfinite(first):
            return None
        spanned = (last - first) / max(beams - 1, 1)
        usable = np.isfinite(step) and step != 0.0 and abs(step) * (beams - 1) < _TURN
        agree = not np.isfinite(spanned) or abs((last - first) - step * (beams - 1)) <= 2.0 * abs(step)
        if usable:
            if not agree:
                self._note(
                    "angle_min, angle_max and angle_increment contradict each other in {count} scans"
                    f" (the increment {np.degrees(step):.3g} degrees, by the ends {np.degrees(spanned):.3g}): the increment"
                    " counts"
                )
            return ScanGeometry(first, step, beams)
        if not np.isfinite(spanned) or spanned == 0.0 or abs(last - first) > _TURN:
            return None
        self._note("angle_increment is no angle in {count} scans: angle_min and angle_max give it")
        return ScanGeometry(first, spanned, beams)

    def _limits(self, message: Any) -> tuple[float, float, float]:
        """Return time_increment, range_min and range_max, of the last inf where none is stated."""
        sweep, least, most = (float(getattr(message, name)) for name in ("time_increment", "range_min", "range_max"))
        sweep = sweep if np.isfinite(sweep) and sweep >= 0.0 else 0.0
        least = least if np.isfinite(least) and least >= 0.0 else 0.0
        return sweep, least, most if np.isfinite(most) and most > least else np.inf

    def _note(self, text: str) -> None:
        key = next((known for known in self._noted if known[:_SAME] == text[:_SAME]), text)
        self._noted[key] = self._noted.get(key, 0) + 1


_TURN = 2.1 * np.pi
"""rad; more than a turn."""
_SAME = 30
"""Characters by which a note is known; figures come later."""


def _turned(one: ScanGeometry, other: ScanGeometry) -> bool:
    first, step = one.angle_min - other.angle_min, one.angle_increment - other.angle_increment
    return abs(first) > 1e-3 or abs(step) > 1e-6


def _clean(readings: NDArray[np.float32], range_min: float, range_max: float) -> None:
    """Make readings +inf for nothing seen and nan for too near and error, in the memory given.

    REP-117 distinguishes these; drivers older than it write 0 for no echo.
    """
    with np.errstate(invalid="ignore"):
        nothing = (readings == 0.0) | (readings >= np.float32(range_max))
        readings[~(readings >= range_min)] = np.nan
    readings[nothing] = np.inf
