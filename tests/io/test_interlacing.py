"""Scanners that interlace are told from those that lose a beam by what their scans show."""

import numpy as np
import pytest

from uwblite.io.readings import beams_lie_between

BEAMS, STEP = 180, np.radians(1.0)


def scans(shift, *, turning=0.0, noise=0.0, count=60, change=None):
    """Return scans of 181 and 180 beams of a room of 6 x 4 m in turn, the latter from a shift on, beams, and their lines."""
    rng, lines = np.random.default_rng(1), np.arange(count)
    longer = lines % 2 == 0 if change is None else lines < change
    seen = []
    for line, long in zip(lines, longer, strict=True):
        first = -0.5 * np.pi + turning * line + (0.0 if long else shift * STEP)
        bearing = first + STEP * np.arange(BEAMS + bool(long))
        away = 1.0 / np.maximum(np.abs(np.cos(bearing)) / 3.0, np.abs(np.sin(bearing)) / 2.0)
        seen.append(away + noise * rng.standard_normal(len(bearing)))
    pick = [np.array([s for s, k in zip(seen, longer, strict=True) if k == kind]) for kind in (True, False)]
    return (*pick, (lines[longer], lines[~longer]))


@pytest.mark.parametrize("turning", [0.0, 0.02, -0.05])
@pytest.mark.parametrize("noise", [0.0, 0.01, 0.05])
def test_the_offset_is_that_at_which_following_scans_agree(turning, noise):
    assert beams_lie_between(*scans(0.5, turning=turning, noise=noise))
    assert not beams_lie_between(*scans(0.0, turning=turning, noise=noise))


def test_readings_that_saw_nothing_do_not_count():
    longer, shorter, lines = scans(0.5, noise=0.01)
    longer[:, 60:], shorter[::2] = np.nan, np.nan
    assert beams_lie_between(longer, shorter, lines)
    assert not beams_lie_between(np.full_like(longer, np.nan), shorter, lines)


def test_a_scanner_that_was_changed_once_does_not_interlace():
    assert not beams_lie_between(*scans(0.5, change=30))
