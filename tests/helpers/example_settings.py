"""Settings of every type that a field may have."""

import dataclasses
from typing import Literal

from uwblite.config import setting


@dataclasses.dataclass(frozen=True, slots=True)
class Inner:
    """A stage of the walk."""

    max_iterations: int = setting(300, minimum=1, maximum=10_000)
    """Most rounds of matching."""
    distance: float = setting(0.1, above=0.0)
    """Outlier distance, m. Larger: wider basin,
    more false matches."""
    kernel: Literal["none", "huber"] = "none"
    """Robust kernel."""
    pose: tuple[float, float, float] = (0.0, -1.0, 0.5)
    """A pose: m, m, rad."""
    optional: float | None = None
    """Height, m."""


@dataclasses.dataclass(frozen=True, slots=True)
class Outer:
    """All settings."""

    icp: Inner = Inner()
    """Matching."""
    robust: bool = True
    """Whether to be."""
    name: str = "a"
    offset: float = -1.0
    """May be negative, for its default is."""
    weights: tuple[float, ...] = (1.0, 2.0)
    heights: dict[str, float] = dataclasses.field(default_factory=dict)
