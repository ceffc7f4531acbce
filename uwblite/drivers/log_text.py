"""Content of a recording: measurements, parameters and comments, as lines of a log."""

from collections.abc import Callable

from .events import GyroHeading, Measurement, OdometryPose, RangeEpoch
from .link import Link, Mounting
from .log_file import LogFile, gyro_line, number_text, pose_line, range_lines, scan_line


class LogText:
    """Lines on their way to the log.

    Parameters
    ----------
    log : where to write. mounting : sensors on the base.
    monotonic : s, a clock that never leaps. start : its time when the recording began, s.
    wall_offset : s to add to it for the log's timestamps. host : name of this computer.
    """

    def __init__(
        self, log: LogFile, mounting: Mounting, monotonic: Callable[[], float], start: float, wall_offset: float, host: str
    ) -> None:  # fmt: skip
        self._log, self._mounting, self._now = log, mounting, monotonic
        self._start, self._offset, self._host = start, wall_offset, host
        self._pose: OdometryPose | None = None
        self._params: dict[str, str] = {}
        self._lines: list[str] = []

    def flush(self) -> None:
        """Hand the lines to the log; DataError where it cannot be written any more."""
        self._log.write(self._lines)
        self._lines = []

    def head(self, comments: list[str]) -> None:
        """Write the head of the log."""
        self._log.head.append("# CARMEN Logfile")
        self._lines.append("# CARMEN Logfile")
        for line in comments:
            self.comment(line)
        for name, value in self._mounting.params:
            self.param(name, value)

    def comment(self, text: str) -> None:
        """Write a COMMENT with the time since the start."""
        self._lines.append(f"COMMENT {number_text(self._elapsed())[:-3]} {' '.join(text.split())}")

    def param(self, name: str, value: str) -> None:
        """Write a PARAM unless it stands there already."""
        if self._params.get(name) != value:
            self._params[name] = value
            line = f"PARAM {name} {value} {self._tail(self._now())}"
            self._lines.append(line)
            self._log.head.append(line)

    def write(self, measured: Measurement, link: Link) -> None:
        """Write a measurement, and count what is counted by its content."""
        tail, counts = self._tail(measured.stamp), link.counts
        spread = getattr(measured, "spread", 0.0)
        counts.spread, counts.widest = counts.spread + spread, max(counts.widest, spread)
        if isinstance(measured, OdometryPose):
            self._pose = measured
            self._lines.append(pose_line(measured, tail))
        elif isinstance(measured, GyroHeading):
            self._lines.append(gyro_line(measured, tail))
        elif isinstance(measured, RangeEpoch):
            self._lines += range_lines(measured, tail, link.number)
            counts.anchors.update(reading.anchor_id for reading in measured.readings)
        else:
            self.param(link.param_name("laser_time_increment"), f"{measured.time_increment:.9f}")
            self.param(link.param_name("laser_range_min"), f"{measured.range_min:.3f}")
            lasers = (self._mounting.laser, *self._mounting.more_lasers, (0.0, 0.0, 0.0))
            laser = lasers[min(link.number, len(lasers)) - 1]
            self._lines.append(scan_line(measured, laser, self._pose, tail, link.number))

    def _elapsed(self) -> float:
        return max(0.0, self._now() - self._start)

    def _tail(self, stamp: float) -> str:
        return f"{stamp + self._offset:.6f} {self._host} {self._elapsed():.6f}"
