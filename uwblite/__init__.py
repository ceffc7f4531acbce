# SPDX-License-Identifier: MIT
"""uwblite: maps from wheel odometry, UWB ranges to unknown anchors and a short-range 2D lidar.

Units are SI and radians throughout; a unit stands in a name only where it is not SI. Frames follow REP-103 and
REP-105 (x forward, y left, yaw counter-clockwise): ``map`` is the optimised frame, ``odom`` the drifting frame of
the wheels, ``base`` the robot, ``laser`` the lidar. ``T_a_b`` is the pose of frame b in frame a, so adjacent
letters cancel: ``T_a_c = compose(T_a_b, T_b_c)``.

Reading order: ``se2``, ``sensor_log``, ``mapping`` (the page that is the algorithm), then the stages it names.
Importing this package loads nothing but itself; names below are resolved on first use.
"""

TYPE_CHECKING = False
"""True for those who check types; importing `typing` for it would take longer than all before the first line runs."""

if TYPE_CHECKING:  # at run time __getattr__ resolves them
    from .io.carmen import read_log
    from .mapping import MappingConfig, MapResult, SensorLog, build_map

__version__ = "0.1.0"

_LAZY = {
    "SensorLog": "sensor_log",
    "read_log": "io.carmen",
    "build_map": "mapping",
    "MappingConfig": "mapping",
    "MapResult": "map_result",
}

__all__ = ["MapResult", "MappingConfig", "SensorLog", "__version__", "build_map", "read_log"]


def __getattr__(name: str) -> object:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f".{_LAZY[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted(__all__)
