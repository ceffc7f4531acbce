"""Rays of scans of planted walls."""

import numpy as np

from uwblite.odometry.attached import ScanPoints

from .planted import cast


def seen(walls, poses, noise=0.0, seed=0, beams=1000, reach=5.6) -> ScanPoints:
    """Return the rays of one scan from each pose (k, 3), with noise as a share of the distance beyond 1 m."""
    bearings = np.tile(np.linspace(-3.1, 3.1, beams), len(poses))
    scan, ray = np.divmod(np.arange(len(bearings)), beams)
    away = cast(poses[scan], bearings, np.asarray(walls, dtype=float))
    hit = away < reach
    away, bearings = away[hit], bearings[hit]
    away = away + noise * np.maximum(away, 1.0) * np.random.default_rng(seed).standard_normal(len(away))
    points = away[:, None] * np.column_stack([np.cos(bearings), np.sin(bearings)])
    return ScanPoints(scan[hit], points, np.zeros_like(points), ray[hit], scan[hit])
