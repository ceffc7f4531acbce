"""Counted work, and the stages that did it: operations by kind, the same on every computer, so that what costs more shows
without a clock.

One counter belongs to a computation. Graphs and clouds refer to it, and so do all that are made from them: what solves or
searches them adds to it there. A stage's work is what came since the stage before, see pipeline/progress.py.
"""

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from ..config import documented

Work = Counter[str]
"""Operations by kind, one of KINDS."""

FACTORISATIONS, ENTRIES, PRODUCTS = "factorisations", "factor entries", "products"
LOOK_UPS, SCORES, POINTS, RAYS = "look-ups", "scores", "points", "rays"
KINDS = {
    FACTORISATIONS: "matrices factorised",
    ENTRIES: "entries of these factors; of an iterative solution, those multiplied in its steps",
    PRODUCTS: "products of two columns of Jacobians, one for each edge, in normal equations",
    LOOK_UPS: "points of clouds whose nearest neighbours were looked up",
    SCORES: "products of a point, or a cell, with a shift in exhaustive searches",
    POINTS: "points of clouds made of scans",
    RAYS: "readings traced into the grid, and rays linearised on walls and columns",
}


@documented
@dataclass(frozen=True, slots=True, eq=False)
class StageSummary:
    """One stage: its input and its result."""

    name: str
    seconds: float
    """Wall time; filled in by the caller's clock, 0 where no clock was given."""
    figures: dict[str, Any] = field(default_factory=dict)
    """Named counts and figures (JSON-ready)."""
    work: dict[str, int] = field(default_factory=dict)
    """Operations counted by kind, see KINDS; the same on every computer."""
