"""The log on disk: CARMEN text, appended line by line so that a crash costs at most the line being written.

Lines reach the kernel at once (unbuffered), so ``kill -9`` loses at most the last one, and a second thread asks the disk
to keep them every `sync` seconds, so a power cut loses at most that. When the file has reached `rotate` bytes the next
part begins, with the PARAM lines repeated, so that each part can be read alone.
"""

import contextlib
import math
import os
import re
import threading
from pathlib import Path

from ..errors import DataError
from .events import GyroHeading, LaserScan, Measurement, OdometryPose, RangeEpoch
from .link import Host, Link, Mounting

COUNT = 1e-6
"""s, resolution of the stamps in the log."""
TAIL, _PIECE = 1 << 18, 1 << 20
"""Bytes read to find the last state; copied at once."""
_OURS = re.compile(r"ODOM|GYRO|(ROBOTLASER|UWB)\d?")


def metre_text(value: float, limit: float) -> str:
    """Write a range: nothing seen (+inf) as the maximum range, invalid (nan) as 0.000."""
    if math.isnan(value):
        return "0.000"
    return f"{round(min(value, limit) * 1000) / 1000:.3f}"


def number_text(value: float) -> str:
    """Write a number with six decimals, without minus zero."""
    text = f"{value:.6f}"
    return text[1:] if text.startswith("-0.") and not text.strip("-0.") else text


def pose_line(pose: OdometryPose, tail: str) -> str:
    fields = (pose.x, pose.y, pose.theta, pose.speed, pose.turn_rate, 0.0)
    return f"ODOM {' '.join(number_text(field) for field in fields)} {tail}"


def gyro_line(gyro: GyroHeading, tail: str) -> str:
    return f"GYRO {number_text(gyro.heading)} {number_text(gyro.turn_rate)} {tail}"


def numbered(name: str, number: int) -> str:
    return name if number == 1 else f"{name}{number}"


def range_lines(epoch: RangeEpoch, tail: str, number: int = 1) -> list[str]:
    """Write one UWB line per reading, of the robot's first (1), second ... tag."""
    return [f"{numbered('UWB', number)} {r.anchor_id} {r.range:.3f} {r.quality} {tail}" for r in epoch.readings]


def scan_line(
    scan: LaserScan, laser: tuple[float, float, float], robot: OdometryPose | None, tail: str, number: int = 1
) -> str:
    """Write ROBOTLASER1, ROBOTLASER2 ... of a laser at x, y, theta on the base, with the robot's latest odometry.

    The reader interpolates odometry itself; this is for other readers.
    """
    count = len(scan.ranges)
    readings = " ".join([metre_text(value, scan.range_max) for value in scan.ranges])
    x, y, theta = (robot.x, robot.y, robot.theta) if robot else (0.0, 0.0, 0.0)
    cos, sin = math.cos(theta), math.sin(theta)
    laser_x, laser_y = x + cos * laser[0] - sin * laser[1], y + sin * laser[0] + cos * laser[1]
    laser_theta = math.remainder(theta + laser[2], 2 * math.pi)
    poses = " ".join(number_text(v) for v in (laser_x, laser_y, laser_theta, x, y, theta))
    velocity = f"{number_text(robot.speed)} {number_text(robot.turn_rate)}" if robot else "0.000000 0.000000"
    return (
        f"ROBOTLASER{number} 0 {scan.angle_min:.9f} {scan.angle_increment * (count - 1):.9f} {scan.angle_increment:.9f}"
        f" {scan.range_max:.3f} 0.010 0 {count} {readings} 0 {poses} {velocity} 0.0 0.0 0.0 {tail}"
    )


class LogFile:
    """The file, its parts and its syncing.

    Parameters
    ----------
    path : first part; further ones are named ``run.2.log``, ``run.3.log`` and so on.
    append : go on with a file that exists (after a crash); otherwise an existing file is an error.
    rotate : bytes per part, 0 = one part.
    sync : s between requests to the disk; 0 = after every write.
    """

    def __init__(self, path: Path, *, append: bool = False, rotate: int = 0, sync: float = 1.0) -> None:
        self.first, self.path, self.part = path, path, 1
        self.bytes = 0
        self.error = ""
        self._rotate, self._interval = rotate, sync
        self.head: list[str] = []
        """Lines to repeat at the head of each part."""
        if append:
            self.path, self.part = _last_part(path)
        elif path.exists():
            raise DataError(f"{path} exists; choose another name, or `append` to go on with it after a crash")
        try:
            self._fd = self._open(self.path)
        except OSError as error:
            raise DataError(f"{self.path}: cannot write ({error.strerror})") from None
        self._closing, self._dirty = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._keep_syncing, name="uwblite-sync", daemon=True)
        self._thread.start()

    def _open(self, path: Path) -> int:
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)
        self._size = os.fstat(fd).st_size
        if self._size and os.pread(fd, 1, self._size - 1) != b"\n":
            os.write(fd, b"\n")  # the line at which the last recorder died stays one broken line
        return fd

    def write(self, lines: list[str]) -> None:
        """Append lines, without their ends, in one write.

        Raises
        ------
        DataError : the disk is full or gone.
        """
        if not lines:
            return
        data = ("\n".join(lines) + "\n").encode("ascii", "replace")
        try:
            done = os.write(self._fd, data)
            while done < len(data):
                done += os.write(self._fd, data[done:])
            if self._interval == 0:
                os.fdatasync(self._fd)
        except OSError as error:
            with contextlib.suppress(OSError):
                os.ftruncate(self._fd, self._size)  # not half a line
            raise DataError(f"{self.path}: cannot write ({error.strerror}); free some space on the disk") from None
        self._size += len(data)
        self.bytes += len(data)
        self._dirty.set()
        if self._rotate and self._size >= self._rotate:
            try:
                self._next_part()
            except OSError as error:
                raise DataError(f"{_part(self.first, self.part + 1)}: cannot begin the next part ({error.strerror})") from None

    def _next_part(self) -> None:
        following, old = _part(self.first, self.part + 1), self._fd
        self._fd = self._open(following)
        os.write(old, f"COMMENT continued in {following.name}\n".encode())
        os.fdatasync(old)
        os.close(old)
        head = "\n".join(self.head) + "\n" if self.head else ""
        text = f"{head}COMMENT part {self.part + 1}, continues {self.path.name}\n"
        self.part, self.path = self.part + 1, following
        os.write(self._fd, text.encode("ascii", "replace"))
        self._size += len(text)

    def _keep_syncing(self) -> None:
        while not self._closing.wait(self._interval or 60.0):
            if self._dirty.is_set():
                self._dirty.clear()
                with contextlib.suppress(OSError):
                    os.fdatasync(self._fd)

    def restore(self) -> bool:
        """Write the log again where somebody deleted it, perhaps with its folder; return whether that was so.

        Raises
        ------
        DataError : it cannot be written there any more.
        """
        if os.fstat(self._fd).st_nlink:
            return False
        deleted, size = self._fd, 0
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._fd = self._open(self.path)
            while piece := os.pread(deleted, _PIECE, size):
                size += os.write(self._fd, piece)
        except OSError as error:
            raise DataError(f"{self.path}: was deleted, and cannot be written again ({error.strerror})") from None
        os.close(deleted)
        self._size += size
        return True

    def free_bytes(self) -> int:
        disk = os.fstatvfs(self._fd)
        return disk.f_bavail * disk.f_frsize

    def close(self) -> None:
        self._closing.set()
        self._thread.join(timeout=10.0)
        with contextlib.suppress(OSError):
            os.fdatasync(self._fd)
        os.close(self._fd)


def _part(first: Path, part: int) -> Path:
    """Return the file of a part of a log, counted from 1, by that of the first."""
    return first if part == 1 else first.with_suffix(f".{part}{first.suffix}")


def _last_part(first: Path) -> tuple[Path, int]:
    """Return the last part of a log that is there, and its number."""
    part = 1
    while _part(first, part + 1).exists():
        part += 1
    return _part(first, part), part


def last_state(first: Path) -> tuple[float | None, tuple[float, float, float]]:
    """Return the largest ipc timestamp near the end of a log of ours, s, and its last odometry; None and zero without any."""
    path, _ = _last_part(first)
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - TAIL))
        lines = file.read().decode("ascii", "replace").split("\n")[:-1]
    stamp, pose = None, (0.0, 0.0, 0.0)
    for line in lines:
        fields = line.split()
        if not fields or not _OURS.fullmatch(fields[0]):
            continue
        number = _number(fields[-3]) if len(fields) > 4 else None
        if number is not None:
            stamp = number if stamp is None else max(stamp, number)
        if fields[0] == "ODOM" and len(fields) == 10:
            values = [_number(field) for field in fields[1:4]]
            if None not in values:
                pose = (values[0] or 0.0, values[1] or 0.0, values[2] or 0.0)
    return stamp, pose


def _number(text: str) -> float | None:
    return float(text) if re.fullmatch(r"-?\d+(\.\d+)?", text) else None


class LogText:
    """Lines on their way to the log."""

    def __init__(self, log: LogFile, mounting: Mounting, host: Host) -> None:
        self._log, self._mounting, self._host = log, mounting, host
        self._start = host.monotonic()
        self._pose: OdometryPose | None = None
        self._params: dict[str, str] = {}
        self._lines: list[str] = []
        self._written: dict[tuple[type, int, str], float] = {}
        """s, wall time: the stamp of the last row of each series."""

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
            line = f"PARAM {name} {value} {self._tail(self._host.monotonic() + self._host.wall_offset)}"
            self._lines.append(line)
            self._log.head.append(line)

    def write(self, measured: Measurement, link: Link) -> None:
        """Write a measurement, and count what is counted by its content."""
        tail, counts = self._tail(self._rising(measured, link.number)), link.counts
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

    def _rising(self, measured: Measurement, number: int) -> float:
        """Return the stamp to write, s, later than that of the row before of the same sensor and anchor.

        Rows that arrive in one read, and those around a correction of a clock's map, have stamps that stand still or go back.
        Each becomes max(its own, the one before + one count of the log). No stamp gets further from the truth by that
        than one before it already was: one that moves stays as late as the row before at most, since it was made later.
        """
        names = [reading.anchor_id for reading in measured.readings] if isinstance(measured, RangeEpoch) else [""]
        series = [(type(measured), number, name) for name in names]
        least = max((self._written[key] for key in series if key in self._written), default=-math.inf) + COUNT
        stamp = float(f"{max(measured.stamp + self._host.wall_offset, least):.6f}")
        self._written.update(dict.fromkeys(series, stamp))
        return stamp

    def _elapsed(self) -> float:
        return max(0.0, self._host.monotonic() - self._start)

    def _tail(self, stamp: float) -> str:
        return f"{stamp:.6f} {self._host.name} {self._elapsed():.6f}"
