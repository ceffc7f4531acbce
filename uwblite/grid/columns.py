"""A round column of known radius among the occupied cells of a map, or the points of a cloud."""

import numpy as np
from scipy.spatial import cKDTree

from ..arrays import Floats

_LEAST_ARC = 0.35
"""Share of the circle's cells that must be there: a column seen from one side shows about half of it."""
_AROUND = 0.5
"""m beyond the circles that are tried: what stands around them counts too."""


def find_column(cells: Floats, place: Floats, radius: float, reach: float, cell: float) -> Floats:
    """Return where a column stands: the place with most cells on its circle and fewest around it.

    Parameters
    ----------
    cells : (n, 2) m, their centres. place : (2,) m, where the column should be. radius : m, its own.
    reach : m, how far from that place it is searched for. cell : m, size of a cell.

    Returns
    -------
    (2,) m, its centre; nan where there is none.
    """
    cells = cells[np.hypot(*(cells - place).T) <= reach + radius + _AROUND]
    ticks = np.arange(-reach, reach + 0.5 * cell, 0.5 * cell)
    lattice = np.stack(np.meshgrid(ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 2)
    lattice = lattice[np.hypot(*lattice.T) <= reach] + place
    if not len(cells) or not len(lattice):
        return np.full(2, np.nan)
    score, arc = _scores(lattice, cells, radius, cell)
    score = score - 0.02 * np.hypot(*(lattice - place).T) / cell
    best = int(np.argmax(np.where(arc >= _LEAST_ARC, score, -np.inf)))
    if arc[best] < _LEAST_ARC or score[best] <= 0.0:
        return np.full(2, np.nan)
    return fit_circle(cells, lattice[best], radius, 1.5 * cell)


def _scores(centres: Floats, cells: Floats, radius: float, cell: float) -> tuple[Floats, Floats]:
    """Return for each centre (m,) its score, and the share of the circle's directions in which a cell lies on it."""
    tree, directions = cKDTree(cells), 24
    angle = 2.0 * np.pi * np.arange(directions) / directions
    rim = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    on_rim = tree.query((centres[:, None] + rim).reshape(-1, 2), distance_upper_bound=cell)[0]
    arc = np.isfinite(on_rim).reshape(len(centres), directions).mean(axis=1)
    clear = (radius + 3.0 * cell) / radius * rim
    in_clear = tree.query((centres[:, None] + clear).reshape(-1, 2), distance_upper_bound=cell)[0]
    spoilt = np.isfinite(in_clear).reshape(len(centres), directions).mean(axis=1)
    offset = np.where(np.isfinite(on_rim), on_rim, cell).reshape(len(centres), directions).mean(axis=1)
    return arc - spoilt - 0.5 * offset / cell, arc


def fit_circle(cells: Floats, centre: Floats, radius: float, gate: float) -> Floats:
    """Return the centre (2,) after Gauss-Newton on the distances to the circle with Tukey's weights within the gate."""
    for _ in range(20):
        ray = cells - centre
        distance = np.hypot(*ray.T)
        residual = distance - radius
        near = np.abs(residual) < gate
        if near.sum() <= 2:
            return centre
        weight = (1.0 - (residual[near] / gate) ** 2) ** 2
        unit = ray[near] / np.maximum(distance[near], np.finfo(np.float64).tiny)[:, None]
        # A column seen from one side is hardly measured across the line of sight: the initial value fixes it there.
        normal = (weight[:, None, None] * unit[:, :, None] * unit[:, None, :]).sum(axis=0) + 0.01 * np.eye(2)
        centre = centre + np.linalg.solve(normal, (weight * residual[near]) @ unit)
    return centre
