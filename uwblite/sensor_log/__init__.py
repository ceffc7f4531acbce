"""What was measured: one recording as arrays.

Every array is time-ordered. Times are seconds of one clock (the log's ipc_timestamp); lengths metres; angles radians.
"""

from .recording import (
    MOST_ANCHORS,
    MOST_METRES,
    MOST_SECONDS,
    LogNotes,
    OdometryBreaks,
    Screening,
    SensorLog,
    fault_of_id,
    one_word,
)
from .sensors import LONGEST_RANGE, SHORTEST_RANGE, Gyro, LaserScans, Odometry, SensorMounting, UwbRanges, plausible
from .stamps import in_bursts, odometry_in_bursts, stand_still

__all__ = [
    "LONGEST_RANGE",
    "MOST_ANCHORS",
    "MOST_METRES",
    "MOST_SECONDS",
    "SHORTEST_RANGE",
    "Gyro",
    "LaserScans",
    "LogNotes",
    "Odometry",
    "OdometryBreaks",
    "Screening",
    "SensorLog",
    "SensorMounting",
    "UwbRanges",
    "fault_of_id",
    "in_bursts",
    "odometry_in_bursts",
    "one_word",
    "plausible",
    "stand_still",
]
