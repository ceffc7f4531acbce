"""Prediction of later steps of a descent from the last ones: the decrease of the cost to expect, and the damping."""

import numpy as np

_KEPT = 0.5
"""Share of the predicted decrease below which the cost along a step is not quadratic, so that it predicts no later steps."""


def extrapolated(decrease: float, last: float, promised: float) -> float:
    """Return the sum of the geometric series that the last two decreases begin, where the steps reach their predicted
    decrease."""
    if not np.isfinite(last) or decrease < _KEPT * promised:
        return max(decrease, promised)
    return decrease * (decrease / (last - decrease)) if decrease < last else np.inf


def relaxed(ratio: float) -> float:
    """Return the factor of lambda after a step that decreased the cost by this ratio of the predicted decrease."""
    return max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3)


def as_much_again(decrease: float, last: float, promised: float) -> float:
    """Return the remaining decrease if every step halves it, as a robust kernel's reweighting does at best."""
    return max(decrease, promised)
