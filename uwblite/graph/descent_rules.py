"""What a step of a descent says about those to come: how much they still bring, and how much damping they need."""

import numpy as np

_KEPT = 0.5
"""Share of its promise below which a step went where the cost is no parabola, and predicts none of those to come."""


def extrapolated(decrease: float, last: float, promised: float) -> float:
    """Return the sum of the geometric series that the last two decreases begin, where the steps keep what they promise."""
    if not np.isfinite(last) or decrease < _KEPT * promised:
        return max(decrease, promised)
    return decrease * (decrease / (last - decrease)) if decrease < last else np.inf


def relaxed(ratio: float) -> float:
    """Return the factor of lambda after a step that decreased the cost by this ratio of what it promised."""
    return max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3)


def as_much_again(decrease: float, last: float, promised: float) -> float:
    """Return what is still to come where every step halves it, as a robust kernel's reweighting does at best."""
    return max(decrease, promised)
