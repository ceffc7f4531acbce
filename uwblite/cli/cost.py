"""What `uwblite map` will cost on this computer: fitted to runs of the simulated buildings, scaled by a short trial."""

import time

_SECONDS_PER_METRE = 0.034
"""Of driving, with lidar: matching of clouds, graph; on the computer of docs/performance.md."""
_SECONDS_PER_METRE_WITHOUT_LIDAR = 0.01
_SECONDS_PER_READING = 1.2e-7
"""Of the laser: parsing and tracing."""
_BYTES_PER_READING = 2.0
_BYTES_PER_METRE = 0.45e6
_BYTES_PER_CELL = 20.0
_BYTES_AT_LEAST = 70e6
_TRIAL_SECONDS = 0.0135
"""What the trial takes on that computer."""


def expected_seconds(path: float, ranges: int, scans: int, beams: int) -> float:
    """Return the expected wall time of a map, s; path is the distance driven, m."""
    per_metre = _SECONDS_PER_METRE if scans else _SECONDS_PER_METRE_WITHOUT_LIDAR
    return (0.5 + per_metre * path + 1e-4 * ranges + _SECONDS_PER_READING * scans * beams) * _slowness()


def expected_megabytes(path: float, scans: int, beams: int, cells: int) -> float:
    """Return the expected peak memory of a map, MB."""
    lidar = _BYTES_PER_METRE * path + _BYTES_PER_READING * scans * beams + _BYTES_PER_CELL * cells
    return 1e-6 * (_BYTES_AT_LEAST + (lidar if scans else 0.05 * _BYTES_PER_METRE * path))


def _slowness() -> float:
    """Return how many times slower than that computer this one is, by the best of three short trials."""
    import numpy as np

    values = np.linspace(0.0, 1.0, 200_000)
    best = float("inf")
    for _ in range(3):
        began = time.perf_counter()
        np.sort(np.sin(values * 1e4))
        best = min(best, time.perf_counter() - began)
    return best / _TRIAL_SECONDS
