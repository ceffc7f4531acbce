"""The rhythm of a sensor: rate, silences, equal stamps."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from ..arrays import Floats
from ..findings import NOTE, WARNING, Finding

_FINEST = 1e-6
"""s; stamps are written no finer, and differences below are those of numbers that are no times."""
_SOME = 0.02
"""Share of the time in silences, or of equal stamps, from which on they cost accuracy."""
_LONG = 5.0
"""s; a single silence that costs accuracy."""


def rhythm(stamps: Floats, *, expected_gap: float, repeated: float | None = None) -> dict[str, float]:
    """Return the figures of a sensor's rhythm.

    Parameters
    ----------
    stamps : (n,) s, non-decreasing.
    expected_gap : a silence longer than this is a gap, s (or five periods, where that is longer).
    repeated : share of equal stamps that is not right, where some are; None = any is wrong.
    """
    steps = np.diff(stamps)
    some = steps > _FINEST
    period = float(np.median(steps[some])) if some.any() else 0.0
    gap = max(expected_gap, 5.0 * period)
    longest = int(np.argmax(steps)) if len(steps) else 0
    equal = float(np.mean(steps == 0)) if len(steps) else 0.0
    return {
        "count": len(stamps),
        "duration s": round(float(stamps[-1] - stamps[0]), 3),
        "rate Hz": round(1.0 / period, 3) if period else 0.0,
        "longest gap s": round(float(steps.max(initial=0.0)), 3),
        "longest gap at s": round(float(stamps[longest] - stamps[0]), 3),
        "gaps": int(np.sum(steps > gap)),
        "gaps longer than s": round(gap, 3),
        "silent s": round(float(steps[steps > gap].sum()), 3),
        "share of equal stamps": round(equal, 4),
        "share of wrongly equal stamps": round(equal if repeated is None else repeated, 4),
    }


def check_silences(sensor: str, figures: dict[str, Any]) -> Iterator[Finding]:
    """Say when a sensor was silent; a warning where that is for long, or for much of the recording."""
    if not figures["gaps"]:
        return
    much = figures["silent s"] > _SOME * figures["duration s"] or figures["longest gap s"] > _LONG
    text = (
        f"{figures['gaps']} silences longer than {figures['gaps longer than s']:.1f} s; the longest is "
        f"{figures['longest gap s']:.1f} s at t = {figures['longest gap at s']:.1f} s"
    )
    cure = "check cable, power and processor load at these times"
    yield Finding("silences", WARNING if much else NOTE, text, cure, sensor)


def check_equal_stamps(sensor: str, figures: dict[str, Any]) -> Iterator[Finding]:
    """Warn of stamps that equal the one before: of low resolution, or of readings that arrived in one piece."""
    share = figures["share of wrongly equal stamps"]
    if share > _SOME:
        text = f"{100 * share:.0f} % of the stamps equal the one before"
        cure = "stamps of low resolution, or readings that arrived in one piece: stamp each reading when it is made"
        yield Finding("equal-stamps", NOTE if sensor == "radio" else WARNING, text, cure, sensor)
