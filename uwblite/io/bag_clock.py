"""Times of a bag's messages: those of their headers, or of their recording where a header bears none."""

from typing import Any

import numpy as np

_OTHER_CLOCK = 5.0
"""s; messages are recorded sooner after they were made."""
_SIMULATED = 1e8
"""s; a clock that counts since 1970 passed it in 1973."""


class BagClock:
    """Collects how much later messages were recorded than they were made, by sensor."""

    def __init__(self) -> None:
        self.unstamped = 0
        self.late: dict[str, list[float]] = {}
        self._earliest = np.inf

    def time(self, sensor: str, stamp: Any, recorded: float) -> float:
        """Return the time, s, of a message of a sensor with the stamp of a header, recorded at a time, s."""
        seconds = float(stamp.sec) + 1e-9 * float(stamp.nanosec)
        if seconds <= 0.0:
            self.unstamped += recorded != seconds  # a simulated clock begins at 0
            return recorded
        self._earliest = min(self._earliest, seconds)
        self.late.setdefault(sensor, []).append(recorded - seconds)
        return seconds

    def offset(self, sensor: str, reference: str = "odometry") -> float:
        """Return what is to be added to a sensor's stamps, s, where they are of another clock than the reference's; else 0."""
        if not self.late.get(sensor) or not self.late.get(reference):
            return 0.0
        off = float(np.median(self.late[sensor]) - np.median(self.late[reference]))
        return off if abs(off) > _OTHER_CLOCK else 0.0

    def warnings(self) -> list[str]:
        """Return what is odd about the times."""
        found = [f"{self.unstamped} messages carry no time; the time of recording is used"] if self.unstamped else []
        delays = [np.asarray(late) for late in self.late.values()]
        delay = float(np.median(np.concatenate(delays))) if delays else 0.0
        moved = {sensor: off for sensor in self.late if (off := self.offset(sensor))}
        for sensor, off in moved.items():
            found.append(
                f"the stamps of the {sensor} are of another clock than the odometry's, {abs(off):.1f} s"
                f" {'behind' if off > 0.0 else 'ahead'}: by the time of recording they were moved by {off:+.1f} s"
            )
        if abs(delay) > _OTHER_CLOCK and not moved:
            why = "the sensors' computers have other clocks"
            if self._earliest < _SIMULATED < self._earliest + delay:
                why = "the stamps are of a simulation, or count since a computer was started"
            found.append(f"headers and recording differ by {delay:.1f} s: {why}")
        return found
