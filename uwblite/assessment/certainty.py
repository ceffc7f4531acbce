"""How well a map knows the shape of the path, by its own covariances."""

from collections.abc import Iterator

import numpy as np

from ..findings import Finding, doubt
from ..pipeline.estimate import Estimate, Task


def check_certainty(estimate: Estimate, sigma: float, task: Task) -> Iterator[Finding]:
    """Doubt a map whose own uncertainties are so large that its shape is not known well.

    Parameters
    ----------
    sigma : m, rms of the places' expected errors after alignment, the unit of length apart.
    """
    if sigma > allowed_error(estimate):
        extent = _extent(estimate)
        text = (
            f"the shape of the path is known to {sigma:.1f} m (rms) only, in an area {extent:.0f} m across: too few ranges and "
            "scans constrain the trajectory; add anchors, or drive where the lidar sees walls"
        )
        yield doubt("uncertain", text, sigma=sigma, extent=extent)


def allowed_error(estimate: Estimate) -> float:
    """Return the expected error of places, m, above which a map is doubted."""
    return min(_UNCERTAIN, _UNCERTAIN_SHARE * _extent(estimate))


def _extent(estimate: Estimate) -> float:
    """Return the diagonal of the area that the path covers, m."""
    return float(np.hypot(*np.ptp(estimate.graph.poses[:, :2], axis=0)))


_UNCERTAIN, _UNCERTAIN_SHARE = 0.4, 0.05
"""Expected error of places, m and as a share of the area's diameter. Of maps at this limit one in five is off by more than
half a metre; rooms mapped by odometry and ranges have 0.08 to 0.15 m."""
